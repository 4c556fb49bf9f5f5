"""Search and check of the libLLVM that Dr.Jit uses to compile kernels.

Call `prepare_llvm` before mitsuba or drjit is imported. Versions 14 to 16 are refused: their first kernel can abort the
whole process (`LLVM ERROR: Cannot select: ... fminimum`), which no program can catch. On x86-64 Linux a suitable
library is a dependency of this project; elsewhere it comes from the system.

`python -m twin.backend.llvm` chooses a library and runs a kernel with it. The exit status is 0, or 2 without a library.
"""

import ctypes
import os
import re
import subprocess
import sys
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from uwlts.errors import SetupError

VARIABLE = "DRJIT_LIBLLVM_PATH"
MINIMUM_MAJOR = 17
"""Oldest version whose kernels do not abort."""
RUNTIME_LIBRARY = "libatomic.so.1"  # Dr.Jit's wheel is linked against it; minimal systems without a compiler lack it
TRIAL_SECONDS = 300
"""Time limit of the trial kernel: it takes a few seconds, but imports from a network drive may be slow."""
SINGLE_PRECISION_INTEGERS = 2**24  # integers below this are exact in single precision

_NAME = re.compile(r"libLLVM(-\d+(\.\d+)*)?\.so(\..+)?")
_SYSTEM_FOLDERS = ("local/lib", "local/lib64", "lib", "lib64", "lib/*-linux-gnu", "lib/llvm*/lib", "lib64/llvm*/lib")
_HOW_TO_INSTALL = """\
Install what is missing:
  x86-64 Linux:    pip install 'karellen-llvm-core>=19.1.7,<20'   (libatomic comes from the system). Whoever installed
                   it starts this Python once, which completes the installation.
  Debian, Ubuntu:  apt-get install libllvm19 libatomic1   (as root; any of libllvm17 and newer)
  Fedora:          dnf install llvm-libs libatomic   (as root)
  Arch:            pacman -S llvm-libs gcc-libs   (as root)"""
# The number makes the kernel unique, so that it is compiled and not loaded from Dr.Jit's cache on disk.
_TRIAL = """
from twin.backend.llvm import prepare_llvm
prepare_llvm()
import drjit as dr
from drjit.llvm import Float
dr.eval(dr.minimum(dr.arange(Float, 4) + {number!r}, 2))
"""


@dataclass(frozen=True)
class LlvmLibrary:
    """A libLLVM that Dr.Jit can use, with the version stated by the library itself."""

    path: Path
    version: tuple[int, int, int]

    def __str__(self) -> str:
        return f"libLLVM {'.'.join(map(str, self.version))}: {self.path}"


def prepare_llvm() -> LlvmLibrary:
    """Choose a libLLVM and set DRJIT_LIBLLVM_PATH, which Dr.Jit reads on import.

    If Dr.Jit has already been imported, check its library, which can no longer be exchanged.

    Raises SetupError if there is no suitable libLLVM, or Dr.Jit was imported without one.
    """
    if "drjit" in sys.modules:
        major, minor, patch = sys.modules["drjit"].detail.llvm_version()
        if major < MINIMUM_MAJOR:
            held = f"libLLVM {major}.{minor}.{patch}" if major > 0 else "no libLLVM"
            raise SetupError(
                f"Dr.Jit was imported with {held}, but version {MINIMUM_MAJOR} or newer is needed: call "
                f"twin.backend.llvm.prepare_llvm() before the first import of drjit or mitsuba, or set {VARIABLE}"
            )
        return LlvmLibrary(Path(os.environ.get(VARIABLE, "libLLVM.so")), (major, minor, patch))
    library = find_llvm()
    os.environ[VARIABLE] = str(library.path)
    return library


@contextmanager
def preserve_threads() -> Iterator[int]:
    """Provide the number of Dr.Jit's threads, and restore it afterwards."""
    import drjit as dr

    threads = dr.thread_count()
    try:
        yield threads
    finally:
        dr.set_thread_count(threads)


def find_llvm(folders: Iterable[Path] | None = None) -> LlvmLibrary:
    """Return the first libLLVM that Dr.Jit can use, and check that Dr.Jit's runtime library exists.

    ``folders`` (default: `search_folders`) are searched in order. A library named by the environment variable
    DRJIT_LIBLLVM_PATH is the only one considered: it is used or refused, never replaced.

    Raises SetupError if no library is suitable; the message lists what was found and how to install one.
    """
    chosen, faults = os.environ.get(VARIABLE), ""
    for path in [Path(chosen)] if chosen else list_candidates(folders):
        try:
            library = check_library(path)
        except SetupError as error:
            faults += f"\n  {error}"
            continue
        if sys.platform == "linux":
            try:
                ctypes.CDLL(RUNTIME_LIBRARY)
            except OSError as error:
                raise SetupError(
                    f"Dr.Jit needs {RUNTIME_LIBRARY}, which this machine lacks.\n{_HOW_TO_INSTALL}"
                ) from error
        return library
    if chosen:
        raise SetupError(
            f"the environment variable {VARIABLE} names {faults.strip()}\n"
            f"Let it name a libLLVM of version {MINIMUM_MAJOR} or newer, or unset it to have one searched."
        )
    found = faults or "\n  none"
    raise SetupError(
        f"no suitable libLLVM: Dr.Jit needs the shared library of LLVM {MINIMUM_MAJOR} or newer. Found:{found}\n"
        f"{_HOW_TO_INSTALL}\nor let the environment variable {VARIABLE} name a libLLVM."
    )


def check_library(path: Path) -> LlvmLibrary:
    """Load a library and query its version, as the file name is not reliable.

    Raises SetupError if the library does not load, is no libLLVM, or is too old.
    """
    try:
        library = ctypes.CDLL(str(path))
    except OSError as error:
        raise SetupError(f"{path}: it does not load: {error}") from error
    if not hasattr(library, "LLVMGetVersion"):
        raise SetupError(f"{path}: it is no libLLVM, or too old: it lacks the function LLVMGetVersion")
    numbers = [ctypes.c_uint() for _ in range(3)]
    library.LLVMGetVersion(*map(ctypes.byref, numbers))
    major, minor, patch = (number.value for number in numbers)
    if major < MINIMUM_MAJOR:
        raise SetupError(f"{path}: version {major}.{minor}.{patch}; version {MINIMUM_MAJOR} or newer is needed")
    return LlvmLibrary(path, (major, minor, patch))


def list_candidates(folders: Iterable[Path] | None = None) -> list[Path]:
    """Return files named like a libLLVM in the folders, with links resolved and without duplicates.

    Unreadable folders are skipped.
    """
    found: dict[Path, None] = {}
    for folder in search_folders() if folders is None else folders:
        with suppress(OSError):
            # Newest first: names sort mostly by version.
            paths = [path for path in sorted(folder.iterdir(), reverse=True) if _NAME.fullmatch(path.name)]
            found |= dict.fromkeys(path.resolve() for path in paths if path.is_file())
    return list(found)


def search_folders() -> list[Path]:
    """Return the folders of LD_LIBRARY_PATH and of the current environment, then those of the system."""
    folders = [Path(folder) for folder in os.environ.get("LD_LIBRARY_PATH", "").split(":") if folder]
    folders += [Path(prefix, "lib") for prefix in (sys.prefix, os.environ.get("CONDA_PREFIX")) if prefix]
    folders += [folder for pattern in _SYSTEM_FOLDERS for folder in sorted(Path("/usr").glob(pattern))]
    return folders


def main() -> int:
    """Run the command line of this module; return the exit status."""
    try:
        print(f"chosen: {find_llvm()}")
        _try_kernel()
    except SetupError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


def _try_kernel() -> None:
    """Compile and run a kernel in a child process, which survives an abort inside LLVM."""
    trial = [sys.executable, "-c", _TRIAL.format(number=float(time.time_ns() % SINGLE_PRECISION_INTEGERS))]
    try:
        done = subprocess.run(trial, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=TRIAL_SECONDS)
    except subprocess.TimeoutExpired as error:
        raise SetupError(f"a trial kernel of Dr.Jit did not finish within {TRIAL_SECONDS} s") from error
    if done.returncode != 0:
        end = "\n  ".join(done.stderr.strip().splitlines()[-5:])
        raise SetupError(f"a trial kernel of Dr.Jit failed, exit status {done.returncode}:\n  {end}")


if __name__ == "__main__":
    sys.exit(main())
