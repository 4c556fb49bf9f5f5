"""Obtains a libLLVM for Dr.Jit: as a system package where that is allowed, else unpacked into a folder of one's own."""

import os
import re
import shutil
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Callable, Sequence
from pathlib import Path

from twin.llvm_search import VARIABLE, LlvmLibrary, find_llvm, own_folders
from uwlts.errors import SetupError

# 19 first: the version that Dr.Jit 1.5.0 was measured with.
DEBIAN_PACKAGES = tuple(f"libllvm{major}" for major in (19, 22, 21, 20, 18, 17))
DEBIAN_RUNTIME = "libatomic1"
# A wheel that ships the shared library. Dr.Jit 1.5.0 renders with this version of it.
WHEEL = "karellen-llvm-core==23.1.4.post8"
COMMAND_SECONDS = 900


def install_llvm(
    *,
    folders: Sequence[Path] | None = None,
    target: Path | None = None,
    report: Callable[[str], object] = lambda line: None,
) -> LlvmLibrary:
    """Find a suitable libLLVM, or obtain one: with apt-get as root, else unpacked from Debian packages or a wheel.

    Parameters
    ----------
    folders
        Where to look for one that is there already; without it everywhere.
    target
        Folder to unpack into; without it `.llvm` in the source tree, or the user's cache folder.
    report
        Called with a line of text for each step.

    Raises
    ------
    SetupError
        None of the ways led to a library; the message gives the reason of each.
    """
    try:
        return find_llvm(folders)
    except SetupError as error:
        # The user's own choice is never replaced, and replacing it would not be noticed.
        if os.environ.get(VARIABLE):
            raise
        nothing_found = error
    target = target or _writable_folder()
    looked_in = None if folders is None else [target, *folders]
    refusals = []
    for way in (_install_system_package, _unpack_debian_packages, _unpack_wheel):
        try:
            way(target, report)
        except SetupError as error:
            refusals.append(f"\n  {error}")
            continue
        try:
            return find_llvm(looked_in)
        except SetupError as error:
            nothing_found = error
    raise SetupError(f"{nothing_found}\nTried without success to obtain one:{''.join(refusals)}") from nothing_found


def _install_system_package(target: Path, report: Callable[[str], object]) -> None:
    """As root on Debian, Ubuntu and their relatives: packages of the distribution."""
    if shutil.which("apt-get") is None or os.geteuid() != 0:
        raise SetupError("apt-get install: not possible, needs root and apt-get")
    package = _debian_package([])
    if package is None:
        report("libLLVM: reading the package lists (apt-get update)")
        _run(["apt-get", "update"])
        package = _debian_package([])
    if package is None:
        raise SetupError(f"apt-get install: there is none of {', '.join(DEBIAN_PACKAGES)}")
    report(f"libLLVM: installing {package} and {DEBIAN_RUNTIME} (apt-get install)")
    install = ["apt-get", "install", "-y", "--no-install-recommends", "-o", "DPkg::Lock::Timeout=120"]
    install += [package, DEBIAN_RUNTIME]
    try:
        _run(install)
    except SetupError:
        # Lists older than the archive name files that are gone.
        _run(["apt-get", "update"])
        _run(install)


def _unpack_debian_packages(target: Path, report: Callable[[str], object]) -> None:
    """Without root: the package, and those it depends on that the system lacks, unpacked into the target folder."""
    if shutil.which("apt-get") is None:
        raise SetupError("apt-get download: not possible, needs apt-get")
    with tempfile.TemporaryDirectory() as scratch:
        try:
            _download_and_unpack(Path(scratch), target, [], report)
        except SetupError:
            # The system's lists are missing or old. An ordinary user cannot renew them but can keep lists of his own.
            options = [f"Dir::State::Lists={scratch}/lists", f"Dir::Cache={scratch}/cache", "APT::Sandbox::User="]
            for folder in ("lists/partial", "cache/archives/partial"):
                Path(scratch, folder).mkdir(parents=True)
            options = [word for option in options for word in ("-o", option)]
            report("libLLVM: reading the package lists into a temporary folder (apt-get update)")
            _run(["apt-get", *options, "update"])
            _download_and_unpack(Path(scratch), target, options, report)


def _download_and_unpack(scratch: Path, target: Path, options: Sequence[str], report: Callable[[str], object]) -> None:
    package = _debian_package(options)
    if package is None:
        raise SetupError(f"apt-get download: there is none of {', '.join(DEBIAN_PACKAGES)}")
    # The simulation names exactly the packages that the system lacks, dependencies of dependencies included.
    simulate = ["apt-get", *options, "--simulate", "--no-install-recommends", "install"]
    plan = _run([*simulate, package, DEBIAN_RUNTIME])
    missing = re.findall(r"^Inst (\S+)", plan, flags=re.MULTILINE)
    packages = list(dict.fromkeys([*missing, package]))
    report(f"libLLVM: unpacking {' '.join(packages)} into {target}")
    _run(["apt-get", *options, "download", *packages], folder=scratch)
    for archive in scratch.glob("*.deb"):
        _run(["dpkg-deb", "--extract", str(archive), str(scratch / "unpacked")])
    _copy_libraries(scratch / "unpacked", target)


def _unpack_wheel(target: Path, report: Callable[[str], object]) -> None:
    """Without apt-get: the shared library from a wheel, through pip."""
    with tempfile.TemporaryDirectory() as scratch:
        report(f"libLLVM: unpacking the wheel {WHEEL} into {target}")
        pip = [sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check"]
        _run([*pip, "download", "--no-deps", "--only-binary=:all:", "--dest", scratch, WHEEL])
        for wheel in Path(scratch).glob("*.whl"):
            with zipfile.ZipFile(wheel) as archive:
                archive.extractall(Path(scratch, "unpacked"))
        _copy_libraries(Path(scratch, "unpacked"), target)


def _debian_package(options: Sequence[str]) -> str | None:
    """The first of the packages that can be installed according to the package lists."""
    policy = _run(["apt-cache", *options, "policy", *DEBIAN_PACKAGES])
    offered = set(re.findall(r"^(\S+):\n  Installed: .*\n  Candidate: (?!\(none\))", policy, flags=re.MULTILINE))
    return next((package for package in DEBIAN_PACKAGES if package in offered), None)


def _copy_libraries(unpacked: Path, target: Path) -> None:
    """Copy all shared libraries into one flat folder, in which libLLVM finds its companions."""
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


def _writable_folder() -> Path:
    """The first of the project's own folders that the user can write to."""
    for folder in own_folders():
        existing = next(parent for parent in (folder, *folder.parents) if parent.exists())
        if os.access(existing, os.W_OK):
            return folder
    raise SetupError(f"no folder to unpack a libLLVM into: none of {own_folders()} can be written to")


def _run(command: Sequence[str], folder: Path | None = None) -> str:
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
