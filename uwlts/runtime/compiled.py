"""Loops over lines and pixels, compiled to machine code when they are first called and kept on disk from then on."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar

from numba import njit

_Parameters = ParamSpec("_Parameters")
_Result = TypeVar("_Result")

_FREEDOM = {"reassoc", "contract", "arcp", "nsz", "nnan"}
"""What vector units need: sums may be reordered, and nothing compared is NaN. Infinity keeps its meaning."""


def compiled(function: Callable[_Parameters, _Result]) -> Callable[_Parameters, _Result]:
    """A function compiled by Numba; without a folder that can be written, anew in every process."""
    options: dict[str, Any] = {"fastmath": _FREEDOM, "error_model": "numpy", "nogil": True}
    try:
        return njit(cache=True, **options)(function)
    except RuntimeError:
        return njit(**options)(function)
