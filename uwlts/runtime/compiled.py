"""Loops over lines and pixels, compiled to machine code when they are first called and kept on disk from then on."""

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
"""Without Numba's runtime, which counts references to arrays, a function takes a tenth less to compile."""


# Freed arrays are kept for the next ones. glibc gives memory back to the system, to be had anew page by page, unless a
# larger block, of up to 32 MiB, was freed before (mallopt(3), M_MMAP_THRESHOLD). A fifth of points' time went there.
np.empty(24 << 20, np.uint8)


class _WithoutCollection(event.Listener):
    """Keeps Python from collecting garbage while Numba compiles: it makes a lot, and a tenth of the time went there."""

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
    """A function compiled by Numba that makes no arrays but takes all that it needs.

    It may call such functions, of other packages only those that call none of another. Without a folder that can be
    written it is compiled anew in every process.
    """
    return _kept(function, _NO_ARRAYS)


def compiled_with_arrays(function: Callable[_Parameters, _Result]) -> Callable[_Parameters, _Result]:
    """As `compiled`, of a function that makes arrays."""
    return _kept(function, _OPTIONS)


def _kept(function: Callable[_Parameters, _Result], options: dict[str, Any]) -> Callable[_Parameters, _Result]:
    try:
        kept: Any = njit(cache=True, **options)(function)
        # Numba takes a function as unchanged where its own file is; here a change of what it calls shows as well.
        called = (function.__globals__.get(name) for name in function.__code__.co_names)
        files = {
            inspect.getfile(each) for each in (function, *(c.py_func for c in called if isinstance(c, Dispatcher)))
        }
        kept._cache._cache_file._source_stamp = tuple(map(_stamp, sorted({Path(file).parent for file in files})))
    except (RuntimeError, AttributeError):
        return njit(**options)(function)
    return kept


def compiled_part(function: Callable[_Parameters, _Result]) -> Callable[_Parameters, _Result]:
    """A part of `compiled` functions that Python itself does not call.

    Without what converts arguments, and kept only within its callers, a short one takes half the time to compile.
    """
    options: dict[str, Any] = {**_NO_ARRAYS, "no_cpython_wrapper": True}
    return njit(**options)(function)


def compiled_inline(function: Callable[_Parameters, _Result]) -> Callable[_Parameters, _Result]:
    """A part that is called at one place: it is compiled within the function there, and not once more by itself."""
    return njit(inline="always", **_NO_ARRAYS)(function)


@cache
def _stamp(folder: Path) -> tuple[tuple[str, int, int], ...]:
    """Names, times and sizes of the source files of a folder's package: the one next below ``uwlts``."""
    package = next((each for each in (folder, *folder.parents) if each.parent.name == "uwlts"), folder)
    found = ((path, path.stat()) for path in sorted(package.rglob("*.py")))
    return tuple((str(path.relative_to(package)), status.st_mtime_ns, status.st_size) for path, status in found)
