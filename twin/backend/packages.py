"""Obtains libraries and programs: as packages of the system where that is allowed, else unpacked into an own folder."""

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

from uwlts.errors import SetupError

COMMAND_SECONDS = 900
"""Downloads of some 100 MB over a slow line."""
TREE = "tree"
"""Folder within an own folder that holds whole packages."""

Found = TypeVar("Found")
Report = Callable[[str], object]
Choose = Callable[[Sequence[str]], Sequence[str]]
"""With the options of apt-get to the packages wanted, the main one first; SetupError where none is offered."""
Place = Callable[[Path, Path], None]
"""Takes what is needed of an unpacked folder into an own folder."""


def copy_libraries(unpacked: Path, target: Path) -> None:
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


def move_tree(unpacked: Path, target: Path) -> None:
    """Move everything to `tree` in a folder, in place of an earlier one."""
    part = target / f"{TREE}.part{os.getpid()}"
    try:
        target.mkdir(parents=True, exist_ok=True)
        shutil.move(unpacked, part)
        shutil.rmtree(target / TREE, ignore_errors=True)
        part.replace(target / TREE)
    except OSError as error:
        shutil.rmtree(part, ignore_errors=True)
        raise SetupError(f"cannot write to {target}: {error}") from error


def obtain(
    find: Callable[[], Found],
    *,
    what: str,
    choose: Choose,
    wheel: str | None = None,
    place: Place = copy_libraries,
    folders: Sequence[Path],
    choice: str,
    report: Report,
) -> Found:
    """Find a library or program; else obtain it with apt-get as root, or unpacked from Debian packages or a wheel.

    ``find`` looks for what is called ``what``, also in ``folders``, or raises a SetupError that says where it looked.
    ``choose`` gives Debian's packages, ``wheel`` is the requirement that pip downloads, if there is one. ``place``
    takes what was unpacked into the first of ``folders`` that can be written to. The environment variable ``choice``
    names the user's own, and ``report`` is called with a line of text for each step. SetupError, with the reason of
    each, where the user's choice does not serve, or no way led to it.
    """
    try:
        return find()
    except SetupError as error:
        # The user's own choice is never replaced, and replacing it would not be noticed.
        if os.environ.get(choice):
            raise
        nothing_found = error
    standing = {folder: next(parent for parent in (folder, *folder.parents) if parent.exists()) for folder in folders}
    target = next((folder for folder, existing in standing.items() if os.access(existing, os.W_OK)), None)
    if target is None:
        raise SetupError(f"no folder to unpack {what} into: none of {list(map(str, folders))} can be written to")
    ways = [partial(_install_packages, choose), partial(_unpack_packages, choose, place)]
    if wheel is not None:
        ways.append(partial(_unpack_wheel, wheel, place))
    refusals = []
    for way in ways:
        try:
            with tempfile.TemporaryDirectory() as scratch:
                way(Path(scratch), target, lambda line: report(f"{what}: {line}"))
        except SetupError as error:
            refusals.append(f"\n  {error}")
            continue
        try:
            return find()
        except SetupError as error:
            nothing_found = error
    raise SetupError(f"{nothing_found}\nTried without success to obtain it:{''.join(refusals)}") from nothing_found


def _install_packages(choose: Choose, scratch: Path, target: Path, report: Report) -> None:
    """As root on Debian, Ubuntu and their relatives: install packages of the distribution."""
    if shutil.which("apt-get") is None or os.geteuid() != 0:
        raise SetupError("apt-get install: not possible, needs root and apt-get")

    def install(options: Sequence[str]) -> None:
        packages = choose(options)
        report(f"installing {' '.join(packages)} (apt-get install)")
        run_command(["apt-get", "install", "-y", "--no-install-recommends", "-o", "DPkg::Lock::Timeout=120", *packages])

    _with_fresh_lists(install, [], report)


def _unpack_packages(choose: Choose, place: Place, scratch: Path, target: Path, report: Report) -> None:
    """Without root: unpack packages, and those they need that the system lacks, into a folder."""
    if shutil.which("apt-get") is None:
        raise SetupError("apt-get download: not possible, needs apt-get")

    def unpack(options: Sequence[str]) -> None:
        packages = choose(options)
        # The simulation names exactly the packages that the system lacks, dependencies of dependencies included.
        simulate = ["apt-get", *options, "--simulate", "--no-install-recommends", "install", *packages]
        missing = re.findall(r"^Inst (\S+)", run_command(simulate), flags=re.MULTILINE)
        wanted = list(dict.fromkeys([*missing, packages[0]]))
        report(f"unpacking {' '.join(wanted)} into {target}")
        run_command(["apt-get", *options, "download", *wanted], folder=scratch)
        for archive in scratch.glob("*.deb"):
            run_command(["dpkg-deb", "--extract", str(archive), str(scratch / "unpacked")])
        place(scratch / "unpacked", target)

    # An ordinary user cannot renew the system's lists but can keep lists of his own.
    for folder in ("lists/partial", "cache/archives/partial"):
        Path(scratch, folder).mkdir(parents=True)
    settings = (f"Dir::State::Lists={scratch}/lists", f"Dir::Cache={scratch}/cache", "APT::Sandbox::User=")
    _with_fresh_lists(unpack, [word for setting in settings for word in ("-o", setting)], report)


def _with_fresh_lists(take: Callable[[Sequence[str]], None], options: Sequence[str], report: Report) -> None:
    """Take packages; if that fails, update the package lists with options of apt-get and try again."""
    try:
        take([])
    except SetupError:
        # Lists that are missing, or older than the archive, name files that are not there.
        report("reading the package lists (apt-get update)")
        run_command(["apt-get", *options, "update"])
        take(options)


def _unpack_wheel(requirement: str, place: Place, scratch: Path, target: Path, report: Report) -> None:
    """Without apt-get: unpack a wheel, by pip, into a folder."""
    report(f"unpacking the wheel {requirement} into {target}")
    pip = [sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check"]
    run_command([*pip, "download", "--no-deps", "--only-binary=:all:", "--dest", str(scratch), requirement])
    for wheel in scratch.glob("*.whl"):
        with zipfile.ZipFile(wheel) as archive:
            archive.extractall(scratch / "unpacked")
    place(scratch / "unpacked", target)


def first_offered(names: Sequence[str], options: Sequence[str]) -> str:
    """The first package that the package lists of apt-get's options offer; SetupError where they offer none."""
    policy = run_command(["apt-cache", *options, "policy", *names])
    offered = set(re.findall(r"^(\S+):\n  Installed: .*\n  Candidate: (?!\(none\))", policy, flags=re.MULTILINE))
    if name := next((name for name in names if name in offered), None):
        return name
    raise SetupError(f"apt-get: there is none of {', '.join(names)}")


def obtain_by_command(what: str, install: Callable[[Report], object]) -> int:
    """Command line of a module that installs something; exit status 0, or 2 with the reason."""
    try:
        print(f"{what}: {install(partial(print, flush=True))}")
    except SetupError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


def run_command(
    command: Sequence[str], *, folder: Path | None = None, seconds: float = COMMAND_SECONDS, shown: str = ""
) -> str:
    """Run a command and return what it printed; SetupError, in which it is called ``shown``, where it fails."""
    env = os.environ | {"LC_ALL": "C", "DEBIAN_FRONTEND": "noninteractive"}
    shown = shown or f"`{' '.join(command)}`"
    try:
        result = subprocess.run(
            command, cwd=folder, env=env, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=seconds
        )
    except FileNotFoundError as error:
        raise SetupError(f"{command[0]} is not on this machine") from error
    except subprocess.TimeoutExpired as error:
        raise SetupError(f"{shown} did not end within {seconds} s") from error
    if result.returncode != 0:
        end = "\n  ".join((result.stderr or result.stdout).strip().splitlines()[-5:])
        raise SetupError(f"{shown} failed, exit status {result.returncode}:\n  {end}")
    return result.stdout
