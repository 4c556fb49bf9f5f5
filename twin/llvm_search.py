"""Finds the shared libraries libLLVM of this machine and chooses one that Dr.Jit can work with.

Dr.Jit compiles its kernels with libLLVM. Versions 14 to 16 are refused here because with them the first kernel can
abort the whole process (`LLVM ERROR: Cannot select: ... fminimum`), which no program can catch.
"""

import ctypes
import json
import math
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from uwlts.errors import SetupError

VARIABLE = "DRJIT_LIBLLVM_PATH"
MINIMUM_MAJOR = 17
# Dr.Jit's own wheel is linked against it, and minimal systems without a compiler lack it.
RUNTIME_LIBRARY = "libatomic.so.1"
PROBE_SECONDS = 120

_NAME = re.compile(r"libLLVM(-\d+(\.\d+)*)?\.so(\..+)?")
_NAMED_VERSION = re.compile(r"libLLVM(?:-(\d+)(?:\.(\d+))?|\.so\.(\d+)\.(\d+))")
_SYSTEM_FOLDERS = (
    "/usr/local/lib",
    "/usr/local/lib64",
    "/usr/lib",
    "/usr/lib64",
    "/usr/lib/*-linux-gnu",
    "/usr/lib/llvm*/lib",
    "/usr/lib64/llvm*/lib",
)
_HOW_TO_INSTALL = """\
Install what is missing:
  Debian, Ubuntu:  apt-get install libllvm19 libatomic1   (as root; any of libllvm17 and newer)
  Fedora:          dnf install llvm-libs libatomic   (as root)
  Arch:            pacman -S llvm-libs gcc-libs   (as root)
  without root:    python -m twin.llvm --install"""


@dataclass(frozen=True)
class LlvmLibrary:
    """A libLLVM that Dr.Jit can use.

    Attributes
    ----------
    path
        The shared library.
    version
        Major, minor and patch number, as the library itself states them.
    companions
        Libraries that it or Dr.Jit needs and the system lacks, to be loaded first, in this order.
    """

    path: Path
    version: tuple[int, int, int]
    companions: tuple[Path, ...] = ()

    def __str__(self) -> str:
        return f"libLLVM {'.'.join(map(str, self.version))}: {self.path}"


@dataclass(frozen=True)
class Unsuitable:
    """A library that was looked at and cannot be used, with the reason."""

    path: Path
    fault: str

    def __str__(self) -> str:
        return f"{self.path}: {self.fault}"


def find_llvm(folders: Iterable[Path] | None = None) -> LlvmLibrary:
    """Choose the newest libLLVM that Dr.Jit can work with, and see that Dr.Jit's runtime library is there.

    Parameters
    ----------
    folders
        Where to look; without it everywhere (`search_folders`). A library named by the environment variable
        DRJIT_LIBLLVM_PATH is the user's choice and the only one considered.

    Raises
    ------
    SetupError
        There is none, or the user's choice is unsuitable. The message lists what was found and how to install one.
    """
    chosen = os.environ.get(VARIABLE)
    library = _examine_choice(Path(chosen)) if chosen else _choose_newest(folders)
    return replace(library, companions=library.companions + _find_runtime_library(library.path.parent))


def _examine_choice(chosen: Path) -> LlvmLibrary:
    """The library that the user names, which is used or refused but never replaced by another."""
    examined = examine(chosen)
    if isinstance(examined, Unsuitable):
        raise SetupError(
            f"the environment variable {VARIABLE} names {examined}\n"
            f"Let it name a libLLVM of version {MINIMUM_MAJOR} or newer, or unset it to have one searched."
        )
    return examined


def _choose_newest(folders: Iterable[Path] | None) -> LlvmLibrary:
    """The newest suitable library; one whose file name claims an older version than the best so far is not loaded."""
    best: LlvmLibrary | None = None
    unsuitable = []
    for path in sorted(list_candidates(folders), key=named_version, reverse=True):
        if best is not None and named_version(path) <= best.version:
            break
        examined = examine(path)
        if isinstance(examined, Unsuitable):
            unsuitable.append(examined)
        elif best is None or examined.version > best.version:
            best = examined
    if best is None:
        raise SetupError(_explain_nothing_suitable(unsuitable))
    return best


def _find_runtime_library(beside: Path) -> tuple[Path, ...]:
    """Nothing where the system has the library, else the one that lies beside libLLVM or in an own folder."""
    if sys.platform != "linux":
        return ()
    try:
        ctypes.CDLL(RUNTIME_LIBRARY)
    except OSError as error:
        for folder in (beside, *own_folders()):
            for path in sorted(folder.glob(f"{RUNTIME_LIBRARY}*")):
                return (path,)
        raise SetupError(f"Dr.Jit needs {RUNTIME_LIBRARY}, which this machine lacks.\n{_HOW_TO_INSTALL}") from error
    return ()


def examine(path: Path) -> LlvmLibrary | Unsuitable:
    """Load the library in a child process, ask for its version and judge it. The file name is not trusted."""
    script = Path(__file__).with_name("llvm_probe.py")
    # The loader's messages are matched, so they must be the untranslated ones.
    environment = os.environ | {"LC_ALL": "C"}
    command = [sys.executable, "-I", "-S", str(script), str(path)]
    try:
        probe = subprocess.run(
            command, env=environment, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=PROBE_SECONDS
        )
    except subprocess.TimeoutExpired:
        return Unsuitable(path, f"loading it did not end within {PROBE_SECONDS} s")
    if probe.returncode != 0:
        last_line = (probe.stderr.strip().splitlines() or [""])[-1]
        return Unsuitable(path, f"loading it ended the process, exit status {probe.returncode} {last_line}".rstrip())
    return judge(path, json.loads(probe.stdout))


def judge(path: Path, description: dict) -> LlvmLibrary | Unsuitable:
    """Turn what the probe reports about a library into a usable library or the reason against it."""
    if "fault" in description:
        return Unsuitable(path, description["fault"])
    if description["version"] is None:
        return Unsuitable(path, f"too old: it has no LLVMGetVersion; version {MINIMUM_MAJOR} or newer is needed")
    version = tuple(description["version"])
    if version[0] < MINIMUM_MAJOR:
        return Unsuitable(path, f"version {'.'.join(map(str, version))}; version {MINIMUM_MAJOR} or newer is needed")
    return LlvmLibrary(path, version, tuple(map(Path, description["companions"])))


def named_version(path: Path) -> tuple[float, ...]:
    """Version that a file name claims, e.g. (19, 1) for libLLVM.so.19.1; (inf,), to be looked at first, for none."""
    match = _NAMED_VERSION.match(path.name)
    if match is None:
        return (math.inf,)
    return tuple(int(number) for number in match.groups() if number is not None)


def list_candidates(folders: Iterable[Path] | None = None) -> list[Path]:
    """Files named like a libLLVM in the folders, links resolved, each file once."""
    listed = [*_files_in(search_folders()), *_files_in_loader_cache()] if folders is None else _files_in(folders)
    return list(dict.fromkeys(path.resolve() for path in listed))


def search_folders() -> list[Path]:
    """The project's own folders first, then those of the environment in use, then the usual ones of the system."""
    folders = own_folders()
    folders += [Path(folder) for folder in os.environ.get("LD_LIBRARY_PATH", "").split(":") if folder]
    prefixes = [sys.prefix, os.environ.get("CONDA_PREFIX")]
    folders += [Path(prefix, "lib") for prefix in prefixes if prefix]
    for pattern in _SYSTEM_FOLDERS:
        folders += sorted(Path("/").glob(pattern.lstrip("/")))
    return folders


def own_folders() -> list[Path]:
    """Folders into which a libLLVM can be unpacked without administrator rights, the preferred one first."""
    folders = []
    root = Path(__file__).parent.parent
    if (root / "pyproject.toml").is_file():
        folders.append(root / ".llvm")
    cache = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    if os.path.isabs(cache):
        folders.append(Path(cache, "uwlts", "llvm"))
    return folders


def _files_in(folders: Iterable[Path]) -> list[Path]:
    """Files named like a libLLVM; a folder that is missing or closed to the user holds none."""
    found = []
    for folder in folders:
        try:
            names = sorted(entry.name for entry in folder.iterdir())
        except OSError:
            continue
        found += [folder / name for name in names if _NAME.fullmatch(name)]
    return [path for path in found if path.is_file()]


def _files_in_loader_cache() -> list[Path]:
    """Files named like a libLLVM in the system loader's cache."""
    # An ordinary user's PATH often lacks the folder of ldconfig.
    ldconfig = shutil.which("ldconfig", path=f"{os.environ.get('PATH', '')}:/sbin:/usr/sbin")
    if ldconfig is None:
        return []
    listing = subprocess.run([ldconfig, "-p"], stdin=subprocess.DEVNULL, capture_output=True, text=True)
    paths = [Path(target) for target in re.findall(r" => (.+)$", listing.stdout, flags=re.MULTILINE)]
    return [path for path in paths if _NAME.fullmatch(path.name) and path.is_file()]


def _explain_nothing_suitable(unsuitable: Sequence[Unsuitable]) -> str:
    found = "".join(f"\n  {library}" for library in unsuitable) or "\n  none"
    return (
        f"no suitable libLLVM: Dr.Jit needs the shared library of LLVM {MINIMUM_MAJOR} or newer. Found:{found}\n"
        f"{_HOW_TO_INSTALL}\n"
        f"or let the environment variable {VARIABLE} name a libLLVM."
    )
