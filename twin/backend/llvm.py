"""Finds, checks and installs the libLLVM with which Dr.Jit compiles its kernels.

Call `prepare_llvm` before mitsuba or drjit is imported. Versions 14 to 16 are refused: with them the first kernel can
abort the whole process (`LLVM ERROR: Cannot select: ... fminimum`), which no program can catch.

`python -m twin.backend.llvm` shows which libraries there are, chooses one and runs a kernel with it;
`python -m twin.backend.llvm --install` obtains one first where there is none. Exit status 0, or 2 when there is none.
"""

import argparse
import ctypes
import json
import math
import os
import re
import sys
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from twin.backend import packages
from twin.backend.packages import run_command
from uwlts.errors import SetupError
from uwlts.runtime.shared_library import file_of, load_with_companions, own_folders

VARIABLE = "DRJIT_LIBLLVM_PATH"
MINIMUM_MAJOR = 17
"""The oldest version with which Dr.Jit's kernels do not abort."""
RUNTIME_LIBRARY = "libatomic.so.1"
"""Dr.Jit's own wheel is linked against it, and minimal systems without a compiler lack it."""
DEBIAN_PACKAGES = tuple(f"libllvm{major}" for major in (19, 22, 21, 20, 18, 17))
"""19 first: the version that Dr.Jit 1.5.0 was measured with."""
DEBIAN_RUNTIME = "libatomic1"
WHEEL = "karellen-llvm-core==23.1.4.post8"
"""A wheel that ships the shared library. Dr.Jit 1.5.0 renders with this version of it."""
PROBE_SECONDS = 120
"""Loading takes about 0.1 s; on a slow network drive much longer."""
TRIAL_SECONDS = 300
"""A kernel takes a few seconds, and imports may come from a slow network drive."""
SINGLE_PRECISION_INTEGERS = 2**24
"""Integers below this are exact as 32-bit floats."""

_NAME = re.compile(r"libLLVM(-\d+(\.\d+)*)?\.so(\..+)?")
_NAMED_VERSION = re.compile(r"libLLVM(?:-(\d+)(?:\.(\d+))?|\.so\.(\d+)\.(\d+))")
_SYSTEM_FOLDERS = ("local/lib", "local/lib64", "lib", "lib64", "lib/*-linux-gnu", "lib/llvm*/lib", "lib64/llvm*/lib")
_HOW_TO_INSTALL = """\
Install what is missing:
  Debian, Ubuntu:  apt-get install libllvm19 libatomic1   (as root; any of libllvm17 and newer)
  Fedora:          dnf install llvm-libs libatomic   (as root)
  Arch:            pacman -S llvm-libs gcc-libs   (as root)
  without root:    python -m twin.backend.llvm --install"""
_EXAMINE = """
import json, sys
sys.path.insert(0, sys.argv[1])
from twin.backend.llvm import describe
print(json.dumps(describe(sys.argv[2])))
"""
# The number makes the kernel a new one, so that it is compiled rather than taken from Dr.Jit's cache on disk.
_TRIAL = """
from twin.backend.llvm import prepare_llvm
prepare_llvm()
import drjit as dr
from drjit.llvm import Float
dr.eval(dr.minimum(dr.arange(Float, 4) + {number!r}, 2))
"""


@dataclass(frozen=True)
class LlvmLibrary:
    """A libLLVM that Dr.Jit can use, with the version that the library itself states.

    ``companions`` are libraries that it or Dr.Jit needs and the system lacks, to be loaded first, in this order.
    """

    path: Path
    version: tuple[int, int, int]
    companions: tuple[Path, ...] = ()

    def __str__(self) -> str:
        return f"libLLVM {'.'.join(map(str, self.version))}: {self.path}"


def prepare_llvm() -> LlvmLibrary:
    """Choose a libLLVM and set DRJIT_LIBLLVM_PATH, which Dr.Jit reads when it is imported.

    Where Dr.Jit is imported already, its library is checked instead, because it cannot be exchanged any more.
    SetupError where there is no suitable libLLVM, or Dr.Jit was imported without one.
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
    # The loader takes a library that is already in the process for one of the same name that libLLVM asks for.
    for companion in library.companions:
        ctypes.CDLL(str(companion))
    os.environ[VARIABLE] = str(library.path)
    return library


@contextmanager
def threads_kept() -> Iterator[int]:
    """The number of Dr.Jit's threads, restored afterwards."""
    import drjit as dr

    threads = dr.thread_count()
    try:
        yield threads
    finally:
        dr.set_thread_count(threads)


def find_llvm(folders: Iterable[Path] | None = None) -> LlvmLibrary:
    """Choose the newest libLLVM that Dr.Jit can work with, and make sure that Dr.Jit's runtime library is there.

    It is searched in ``folders``, without them everywhere (`search_folders`). A library named by the environment
    variable DRJIT_LIBLLVM_PATH is the user's choice and the only one considered: it is used or refused, never replaced.
    SetupError, which lists what was found and how to install one, where none is suitable.
    """
    if chosen := os.environ.get(VARIABLE):
        try:
            library = examine(Path(chosen))
        except SetupError as error:
            raise SetupError(
                f"the environment variable {VARIABLE} names {error}\n"
                f"Let it name a libLLVM of version {MINIMUM_MAJOR} or newer, or unset it to have one searched."
            ) from error
    else:
        library = _newest(folders)
    return replace(library, companions=library.companions + _runtime_library(library.path.parent))


def _newest(folders: Iterable[Path] | None) -> LlvmLibrary:
    """The newest suitable library; one whose file name claims an older version than the best so far is not loaded."""
    best: LlvmLibrary | None = None
    unsuitable = ""
    for path in sorted(list_candidates(folders), key=named_version, reverse=True):
        if best is not None and named_version(path) <= best.version:
            break
        try:
            found = examine(path)
            best = found if best is None or found.version > best.version else best
        except SetupError as error:
            unsuitable += f"\n  {error}"
    if best is None:
        found = unsuitable or "\n  none"
        raise SetupError(
            f"no suitable libLLVM: Dr.Jit needs the shared library of LLVM {MINIMUM_MAJOR} or newer. Found:{found}\n"
            f"{_HOW_TO_INSTALL}\nor let the environment variable {VARIABLE} name a libLLVM."
        )
    return best


def _runtime_library(beside: Path) -> tuple[Path, ...]:
    """Nothing where the system has the library, else the one that lies beside libLLVM or in an own folder."""
    if sys.platform != "linux":
        return ()
    try:
        ctypes.CDLL(RUNTIME_LIBRARY)
    except OSError as error:
        found = (file_of(RUNTIME_LIBRARY, folder) for folder in (beside, *own_folders("llvm")))
        if path := next(filter(None, found), None):
            return (path,)
        raise SetupError(f"Dr.Jit needs {RUNTIME_LIBRARY}, which this machine lacks.\n{_HOW_TO_INSTALL}") from error
    return ()


def examine(path: Path) -> LlvmLibrary:
    """Load a library and ask for its version, as the file name is not trusted; SetupError where it cannot be used.

    A library of the wrong kind can end the process that loads it, and two libLLVM in one process may disturb each
    other, so this happens in a child process.
    """
    child = [sys.executable, "-I", "-S", "-c", _EXAMINE, str(Path(__file__).parents[2]), str(path)]
    found = json.loads(run_command(child, seconds=PROBE_SECONDS, shown=f"{path}: loading it"))
    if "fault" in found:
        raise SetupError(f"{path}: {found['fault']}")
    return LlvmLibrary(path, tuple(found["version"]), tuple(map(Path, found["companions"])))


def describe(library: str) -> dict[str, object]:
    """Load a library into this process: its "version" and "companions", or the "fault" that makes it unsuitable."""
    try:
        handle, companions = load_with_companions(library)
    except OSError as error:
        return {"fault": f"it does not load: {error}"}
    if not hasattr(handle, "LLVMContextCreate"):
        return {"fault": "it is no libLLVM: it lacks the function LLVMContextCreate"}
    wanted = f"version {MINIMUM_MAJOR} or newer is needed"
    if not hasattr(handle, "LLVMGetVersion"):
        return {"fault": f"too old: it has no LLVMGetVersion; {wanted}"}
    numbers = [ctypes.c_uint() for _ in range(3)]
    handle.LLVMGetVersion(*map(ctypes.byref, numbers))
    version = [number.value for number in numbers]
    if version[0] < MINIMUM_MAJOR:
        return {"fault": f"version {'.'.join(map(str, version))}; {wanted}"}
    return {"version": version, "companions": companions}


def named_version(path: Path) -> tuple[float, ...]:
    """Version that a file name claims, e.g. (19, 1) for libLLVM.so.19.1; (inf,), to be looked at first, for none."""
    match = _NAMED_VERSION.match(path.name)
    return (math.inf,) if match is None else tuple(int(number) for number in match.groups() if number is not None)


def list_candidates(folders: Iterable[Path] | None = None) -> list[Path]:
    """Files named like a libLLVM in the folders, links resolved, each file once; unreadable folders hold none."""
    found: dict[Path, None] = {}
    for folder in search_folders() if folders is None else folders:
        with suppress(OSError):
            paths = [path for path in sorted(folder.iterdir()) if _NAME.fullmatch(path.name)]
            found |= dict.fromkeys(path.resolve() for path in paths if path.is_file())
    return list(found)


def search_folders() -> list[Path]:
    """The project's own folders first, then those of the environment in use, then the usual ones of the system."""
    folders = own_folders("llvm")
    folders += [Path(folder) for folder in os.environ.get("LD_LIBRARY_PATH", "").split(":") if folder]
    folders += [Path(prefix, "lib") for prefix in (sys.prefix, os.environ.get("CONDA_PREFIX")) if prefix]
    folders += [folder for pattern in _SYSTEM_FOLDERS for folder in sorted(Path("/usr").glob(pattern))]
    return folders


def install_llvm(report: packages.Report = lambda line: None) -> LlvmLibrary:
    """Find a suitable libLLVM, or obtain one: with apt-get as root, else unpacked from Debian packages or a wheel.

    ``report`` is called with a line of text for each step. It is unpacked into `.llvm` in the source tree, or the
    user's cache folder. SetupError, with the reason of each, where none of the ways led to a library.
    """
    return packages.obtain(
        find_llvm,
        what="libLLVM",
        choose=lambda options: [packages.first_offered(DEBIAN_PACKAGES, options), DEBIAN_RUNTIME],
        wheel=WHEEL,
        folders=own_folders("llvm"),
        choice=VARIABLE,
        report=report,
    )


def main(arguments: list[str] | None = None) -> int:
    """Command line of this module; returns the exit status."""
    parser = argparse.ArgumentParser(
        prog="python -m twin.backend.llvm", description="Find or install the libLLVM for Dr.Jit."
    )
    parser.add_argument("--install", action="store_true", help="obtain a libLLVM if there is no suitable one")
    install = parser.parse_args(arguments).install
    # A child process compiles the kernel, where an abort inside LLVM does no harm.
    trial = [sys.executable, "-c", _TRIAL.format(number=float(time.time_ns() % SINGLE_PRECISION_INTEGERS))]
    try:
        for path in () if install else list_candidates():
            try:
                print(f"found: {examine(path)}")
            except SetupError as unsuitable:
                print(f"found: {unsuitable}")
        print(install_llvm(partial(print, flush=True)) if install else f"chosen: {find_llvm()}")
        run_command(trial, seconds=TRIAL_SECONDS, shown="a trial kernel of Dr.Jit")
    except SetupError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
