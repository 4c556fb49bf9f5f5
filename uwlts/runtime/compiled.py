"""Loops over lines and pixels, compiled to machine code when they are first called and kept on disk from then on."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

from numba import njit
from numba.core.dispatcher import Dispatcher

_Parameters = ParamSpec("_Parameters")
_Result = TypeVar("_Result")

_FASTMATH = {"reassoc", "contract", "arcp", "nsz", "nnan"}
"""LLVM's fast-math flags for vectorization: sums may be reassociated, and NaN must not occur; infinities may."""

_OPTIONS: dict[str, Any] = {"fastmath": _FASTMATH, "error_model": "numpy", "nogil": True, "no_cfunc_wrapper": True}


def compiled(function: Callable[_Parameters, _Result]) -> Callable[_Parameters, _Result]:
    """A function compiled by Numba. It may call such functions, of other packages only those that call none of another.

    Without a folder that can be written it is compiled anew in every process.
    """
    try:
        kept: Any = njit(cache=True, **_OPTIONS)(function)
        # Numba takes a function as unchanged where its own file is; here a change of what it calls shows as well.
        called = (function.__globals__.get(name) for name in function.__code__.co_names)
        files = {
            inspect.getfile(each) for each in (function, *(c.py_func for c in called if isinstance(c, Dispatcher)))
        }
        kept._cache._cache_file._source_stamp = tuple(map(_stamp, sorted({Path(file).parent for file in files})))
    except (RuntimeError, AttributeError):
        return njit(**_OPTIONS)(function)
    return kept


def compiled_part(function: Callable[_Parameters, _Result]) -> Callable[_Parameters, _Result]:
    """A part of `compiled` functions that Python itself does not call.

    Without what converts arguments, and kept only within its callers, a short one takes half the time to compile.
    """
    options: dict[str, Any] = {**_OPTIONS, "no_cpython_wrapper": True}
    return njit(**options)(function)


@cache
def _stamp(folder: Path) -> tuple[tuple[str, int, int], ...]:
    """Names, times and sizes of the source files of a folder's package: the one next below ``uwlts``."""
    package = next((each for each in (folder, *folder.parents) if each.parent.name == "uwlts"), folder)
    found = ((path, path.stat()) for path in sorted(package.rglob("*.py")))
    return tuple((str(path.relative_to(package)), status.st_mtime_ns, status.st_size) for path, status in found)
