"""Makes a suitable libLLVM known to Dr.Jit; call `prepare_llvm` before mitsuba or drjit is imported.

`python -m twin.llvm` shows which libraries there are, chooses one and runs a kernel with it;
`python -m twin.llvm --install` obtains one first where there is none. Exit status 0, or 2 when there is none.
"""

import argparse
import ctypes
import os
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

from twin.llvm_install import install_llvm
from twin.llvm_search import MINIMUM_MAJOR, VARIABLE, LlvmLibrary, examine, find_llvm, list_candidates
from uwlts.errors import SetupError

__all__ = ["LlvmLibrary", "find_llvm", "install_llvm", "prepare_llvm", "run_trial_kernel"]

TRIAL_SECONDS = 300
SINGLE_PRECISION_INTEGERS = 2**24
# The number makes the kernel a new one, so that it is compiled rather than taken from Dr.Jit's cache on disk.
_TRIAL = """
from twin.llvm import prepare_llvm
prepare_llvm()
import drjit as dr
from drjit.llvm import Float
dr.eval(dr.minimum(dr.arange(Float, 4) + {number!r}, 2))
"""


def prepare_llvm() -> LlvmLibrary:
    """Choose a libLLVM and set DRJIT_LIBLLVM_PATH, which Dr.Jit reads when it is imported.

    Where Dr.Jit is imported already, its library is checked instead, because it cannot be exchanged any more.

    Raises
    ------
    SetupError
        There is no suitable libLLVM, or Dr.Jit was imported without one.
    """
    if "drjit" in sys.modules:
        return _library_in_use()
    library = find_llvm()
    # The loader takes a library that is already in the process for one of the same name that libLLVM asks for.
    for companion in library.companions:
        ctypes.CDLL(str(companion))
    os.environ[VARIABLE] = str(library.path)
    return library


def run_trial_kernel() -> None:
    """Compile and run a small kernel in a child process, where an abort inside LLVM does no harm.

    Raises
    ------
    SetupError
        The kernel did not run; the message holds the end of what was printed.
    """
    command = [sys.executable, "-c", _TRIAL.format(number=float(time.time_ns() % SINGLE_PRECISION_INTEGERS))]
    try:
        trial = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=TRIAL_SECONDS)
    except subprocess.TimeoutExpired as error:
        raise SetupError(f"Dr.Jit did not finish a trial kernel within {TRIAL_SECONDS} s") from error
    if trial.returncode != 0:
        end = "\n  ".join(trial.stderr.strip().splitlines()[-5:])
        raise SetupError(f"Dr.Jit could not run a trial kernel (exit status {trial.returncode}):\n  {end}")


def _library_in_use() -> LlvmLibrary:
    """The libLLVM that an imported Dr.Jit holds."""
    version = tuple(sys.modules["drjit"].detail.llvm_version())
    if version[0] < MINIMUM_MAJOR:
        held = f"libLLVM {'.'.join(map(str, version))}" if version[0] > 0 else "no libLLVM"
        raise SetupError(
            f"Dr.Jit was imported before prepare_llvm() and holds {held}, but version {MINIMUM_MAJOR} or newer is "
            f"needed. Call twin.llvm.prepare_llvm() before the first import of drjit or mitsuba, or set {VARIABLE}."
        )
    return LlvmLibrary(Path(os.environ.get(VARIABLE) or _mapped_library()), version)


def _mapped_library() -> str:
    """File name of the libLLVM mapped into this process; its bare name where the system does not tell."""
    try:
        mapped = Path("/proc/self/maps").read_text().splitlines()
    except OSError:
        return "libLLVM.so"
    return next((line[line.index("/") :] for line in mapped if "/libLLVM" in line), "libLLVM.so")


def main(arguments: list[str] | None = None) -> int:
    """Command line of this module; returns the exit status."""
    parser = argparse.ArgumentParser(prog="python -m twin.llvm", description="Find or install the libLLVM for Dr.Jit.")
    parser.add_argument("--install", action="store_true", help="obtain a libLLVM if there is no suitable one")
    options = parser.parse_args(arguments)
    try:
        if options.install:
            print(install_llvm(report=partial(print, flush=True)))
        else:
            for path in list_candidates():
                print(f"found: {examine(path)}")
            print(f"chosen: {find_llvm()}")
        run_trial_kernel()
    except SetupError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
