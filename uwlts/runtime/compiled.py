"""Loops over lines and pixels that are compiled to machine code on their first call and cached on disk."""

from __future__ import annotations

import gc
import inspect
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

import numpy as np
from numba import njit
from numba.core import event
from numba.core.dispatcher import Dispatcher

_Parameters = ParamSpec("_Parameters")
_Result = TypeVar("_Result")

_FASTMATH = {"reassoc", "contract", "arcp", "nsz", "nnan"}
"""LLVM's fast-math flags for vectorization: sums may be reassociated, and NaN must not occur; infinities may."""

_OPTIONS: dict[str, Any] = {"fastmath": _FASTMATH, "error_model": "numpy", "nogil": True, "no_cfunc_wrapper": True}

_NO_ARRAYS: dict[str, Any] = {**_OPTIONS, "_nrt": False}
"""Without Numba's runtime, which counts references to arrays, compilation takes 10 % less time."""


# glibc returns freed arrays to the system and requests them again page by page, unless a larger block, of up to
# 32 MiB, was freed before (mallopt(3), M_MMAP_THRESHOLD). This took a fifth of the time of reconstruction.
np.empty(24 << 20, np.uint8)


class _WithoutCollection(event.Listener):
    """Disables garbage collection while Numba compiles, which otherwise takes 10 % of the time."""

    depth = 0

    def on_start(self, event: event.Event) -> None:
        if self.depth == 0:
            self._collects = gc.isenabled()
            gc.disable()
        self.depth += 1

    def on_end(self, event: event.Event) -> None:
        self.depth -= 1
        if self.depth == 0 and self._collects:
            gc.enable()


event.register("numba:compile", _WithoutCollection())


def compiled(function: Callable[_Parameters, _Result]) -> Callable[_Parameters, _Result]:
    """Compile a function with Numba that allocates no arrays.

    It may call other such functions; those in other packages may not call functions of a third package. Without a
    writable folder for the cache it is compiled again in every process.
    """
    return _compile_cached(function, _NO_ARRAYS)


def compiled_with_arrays(function: Callable[_Parameters, _Result]) -> Callable[_Parameters, _Result]:
    """Compile a function with Numba like `compiled`, but one that allocates arrays."""
    return _compile_cached(function, _OPTIONS)


def _compile_cached(
    function: Callable[_Parameters, _Result], options: dict[str, Any]
) -> Callable[_Parameters, _Result]:
    try:
        kept: Any = njit(cache=True, **options)(function)
        # Numba recompiles a function only if its own file has changed; here also if the functions it calls have.
        called = (function.__globals__.get(name) for name in function.__code__.co_names)
        files = {
            inspect.getfile(each) for each in (function, *(c.py_func for c in called if isinstance(c, Dispatcher)))
        }
        kept._cache._cache_file._source_stamp = tuple(map(_read_stamp, sorted({Path(file).parent for file in files})))
    except (RuntimeError, AttributeError):
        return njit(**options)(function)
    return kept


def compiled_part(function: Callable[_Parameters, _Result]) -> Callable[_Parameters, _Result]:
    """Compile a function that is only called by `compiled` functions.

    It has no conversion of arguments and is cached only within its callers, which halves the time to compile a short
    one.
    """
    options: dict[str, Any] = {**_NO_ARRAYS, "no_cpython_wrapper": True}
    return njit(**options)(function)


def compiled_inline(function: Callable[_Parameters, _Result]) -> Callable[_Parameters, _Result]:
    """Compile a function with a single caller as a part of that caller, and not separately."""
    return njit(inline="always", **_NO_ARRAYS)(function)


@cache
def _read_stamp(folder: Path) -> tuple[tuple[str, int, int], ...]:
    """Return names, times and sizes of the source files of a folder's package: the one directly below ``uwlts``."""
    package = next((each for each in (folder, *folder.parents) if each.parent.name == "uwlts"), folder)
    found = ((path, path.stat()) for path in sorted(package.rglob("*.py")))
    return tuple((str(path.relative_to(package)), status.st_mtime_ns, status.st_size) for path, status in found)
