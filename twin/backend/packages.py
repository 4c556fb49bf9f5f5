"""Obtains shared libraries: as packages of the system where that is allowed, else unpacked into an own folder."""

import os
import re
import shutil
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import TypeVar

from uwlts.model.errors import SetupError

COMMAND_SECONDS = 900
"""Downloads of some 40 MB over a slow line."""

Library = TypeVar("Library")
Report = Callable[[str], object]
Choose = Callable[[Sequence[str]], Sequence[str]]
"""With the options of apt-get to the packages wanted, the library's own first; SetupError where none is offered."""


def obtain(
    find: Callable[[Sequence[Path]], Library],
    *,
    what: str,
    choose: Choose,
    wheel: str,
    target: Path | None,
    folders: Sequence[Path],
    choice: str,
    report: Report,
) -> Library:
    """Find a library; else obtain it with apt-get as root, or unpacked from Debian packages or from a wheel.

    Parameters
    ----------
    find
        Finds it, also in folders that were unpacked into, or raises a SetupError that says where it looked.
    what
        Name of the library.
    choose, wheel
        Debian's packages, and the requirement that pip downloads.
    target, folders
        Folder to unpack into; the first of ``folders`` that can be written to unless given.
    choice
        Environment variable by which the user chooses a library.
    report
        Called with a line of text for each step.

    Raises
    ------
    SetupError
        The user's choice does not serve, or no way led to a library; the message gives the reason of each.
    """
    try:
        return find([])
    except SetupError as error:
        # The user's own choice is never replaced, and replacing it would not be noticed.
        if os.environ.get(choice):
            raise
        nothing_found = error
    target = target or _writable_folder(folders)
    refusals = []
    for way in (
        partial(_install_packages, choose),
        partial(_unpack_packages, choose, target),
        partial(_unpack_wheel, wheel, target),
    ):
        try:
            way(what=what, report=report)
        except SetupError as error:
            refusals.append(f"\n  {error}")
            continue
        try:
            return find([target])
        except SetupError as error:
            nothing_found = error
    raise SetupError(f"{nothing_found}\nTried without success to obtain it:{''.join(refusals)}") from nothing_found


def _install_packages(choose: Choose, *, what: str, report: Report) -> None:
    """As root on Debian, Ubuntu and their relatives: install packages of the distribution."""
    if shutil.which("apt-get") is None or os.geteuid() != 0:
        raise SetupError("apt-get install: not possible, needs root and apt-get")

    def install() -> None:
        packages = choose([])
        report(f"{what}: installing {' '.join(packages)} (apt-get install)")
        run_command(["apt-get", "install", "-y", "--no-install-recommends", "-o", "DPkg::Lock::Timeout=120", *packages])

    try:
        install()
    except SetupError:
        # Lists that are missing, or older than the archive, name files that are not there.
        report(f"{what}: reading the package lists (apt-get update)")
        run_command(["apt-get", "update"])
        install()


def _unpack_packages(choose: Choose, target: Path, *, what: str, report: Report) -> None:
    """Without root: unpack the libraries of packages, and of those they need that the system lacks, into a folder."""
    if shutil.which("apt-get") is None:
        raise SetupError("apt-get download: not possible, needs apt-get")
    with tempfile.TemporaryDirectory() as scratch:
        try:
            _download_and_unpack(choose, Path(scratch), target, [], what=what, report=report)
        except SetupError:
            # The system's lists are missing or old. An ordinary user cannot renew them but can keep lists of his own.
            options = [f"Dir::State::Lists={scratch}/lists", f"Dir::Cache={scratch}/cache", "APT::Sandbox::User="]
            for folder in ("lists/partial", "cache/archives/partial"):
                Path(scratch, folder).mkdir(parents=True)
            options = [word for option in options for word in ("-o", option)]
            report(f"{what}: reading the package lists into a temporary folder (apt-get update)")
            run_command(["apt-get", *options, "update"])
            _download_and_unpack(choose, Path(scratch), target, options, what=what, report=report)


def _download_and_unpack(
    choose: Choose, scratch: Path, target: Path, options: Sequence[str], *, what: str, report: Report
) -> None:
    packages = choose(options)
    # The simulation names exactly the packages that the system lacks, dependencies of dependencies included.
    simulate = ["apt-get", *options, "--simulate", "--no-install-recommends", "install", *packages]
    missing = re.findall(r"^Inst (\S+)", run_command(simulate), flags=re.MULTILINE)
    wanted = list(dict.fromkeys([*missing, packages[0]]))
    report(f"{what}: unpacking {' '.join(wanted)} into {target}")
    run_command(["apt-get", *options, "download", *wanted], folder=scratch)
    for archive in scratch.glob("*.deb"):
        run_command(["dpkg-deb", "--extract", str(archive), str(scratch / "unpacked")])
    _copy_libraries(scratch / "unpacked", target)


def _unpack_wheel(requirement: str, target: Path, *, what: str, report: Report) -> None:
    """Without apt-get: unpack the libraries of a wheel, by pip, into a folder."""
    with tempfile.TemporaryDirectory() as scratch:
        report(f"{what}: unpacking the wheel {requirement} into {target}")
        pip = [sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check"]
        run_command([*pip, "download", "--no-deps", "--only-binary=:all:", "--dest", scratch, requirement])
        for wheel in Path(scratch).glob("*.whl"):
            with zipfile.ZipFile(wheel) as archive:
                archive.extractall(Path(scratch, "unpacked"))
        _copy_libraries(Path(scratch, "unpacked"), target)


def _copy_libraries(unpacked: Path, target: Path) -> None:
    """Copy all shared libraries into one flat folder, in which they find each other."""
    try:
        target.mkdir(parents=True, exist_ok=True)
        for library in unpacked.rglob("lib*.so*"):
            if library.is_file() and not library.is_symlink():
                # Renamed into place: a library of that name may be in use, and must not change under its user.
                part = target / f"{library.name}.part{os.getpid()}"
                shutil.copyfile(library, part)
                part.replace(target / library.name)
    except OSError as error:
        raise SetupError(f"cannot write to {target}: {error}") from error


def _writable_folder(folders: Sequence[Path]) -> Path:
    """The first of some folders, there or not, that the user can write to; SetupError if there is none."""
    for folder in folders:
        existing = next(parent for parent in (folder, *folder.parents) if parent.exists())
        if os.access(existing, os.W_OK):
            return folder
    raise SetupError(f"no folder to unpack libraries into: none of {[str(each) for each in folders]} can be written to")


def run_command(command: Sequence[str], folder: Path | None = None) -> str:
    """Run a command and return what it printed; a command that is missing or fails is a SetupError."""
    environment = os.environ | {"LC_ALL": "C", "DEBIAN_FRONTEND": "noninteractive"}
    shown = " ".join(command)
    try:
        result = subprocess.run(
            command,
            cwd=folder,
            env=environment,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            timeout=COMMAND_SECONDS,
        )
    except FileNotFoundError as error:
        raise SetupError(f"{command[0]} is not on this machine") from error
    except subprocess.TimeoutExpired as error:
        raise SetupError(f"`{shown}` did not end within {COMMAND_SECONDS} s") from error
    if result.returncode != 0:
        end = "\n  ".join((result.stderr or result.stdout).strip().splitlines()[-5:])
        raise SetupError(f"`{shown}` failed:\n  {end}")
    return result.stdout
