"""Conversion of numbers and arrays between Python and Dr.Jit, such that equal work gives equal kernels.

`FrozenFunctions` launches kernels again without tracing them.

Dr.Jit wraps NumPy's memory without copying and compiles its alignment into the kernel. It also compiles every plain
number and, if a vector's components are gathered, the size. Any of these would cause recompilation, which takes
seconds, between frames or sensors.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable
from typing import Any, TypeAlias

import drjit as dr
import mitsuba as mi
import numpy as np

# Mitsuba's array types depend on the variant. The stubs declare two unrelated families (`mitsuba.Float` and
# `drjit.auto.ad.Float`) and reject sums of points and vectors: annotations name the types without checking them.
Float: TypeAlias = Any
Bool: TypeAlias = Any
UInt32: TypeAlias = Any
Int32: TypeAlias = Any
Point2f: TypeAlias = Any
Point3f: TypeAlias = Any
Vector3f: TypeAlias = Any
Vector4f: TypeAlias = Any
SurfaceInteraction3f: TypeAlias = Any
PCG32: TypeAlias = Any
BSDFPtr: TypeAlias = Any

_ALIGNMENT_BYTES = 64  # a cache line, and the widest vector register


def to_jit(kind: type, values: np.ndarray) -> Float:
    """Return a one-dimensional array as ``mi.Float`` or ``mi.UInt32`` with aligned memory."""
    dtype = np.dtype(np.float32 if kind is mi.Float else np.uint32)
    size = values.size * dtype.itemsize
    memory = np.empty(size + _ALIGNMENT_BYTES, np.uint8)
    start = -memory.ctypes.data % _ALIGNMENT_BYTES
    aligned = memory[start : start + size].view(dtype)
    aligned[:] = values.ravel()
    return kind(aligned)


def to_numpy(vector: Point3f) -> np.ndarray:
    """Return the components of N vectors as (N, 3)."""
    return np.stack([component.numpy() for component in vector], axis=1)


def scalar_transform(matrix: np.ndarray) -> mi.ScalarTransform4f:
    """Return the transform (4, 4) of a shape fixed in the scene."""
    return mi.ScalarTransform4f(matrix)


def opaque(value: float) -> Float:
    """Return a number that is not compiled into kernels; 0 is, which removes work for absent effects.

    Two opaque numbers of equal value are separate kernel inputs: expressions of each are computed separately.
    """
    return dr.opaque(mi.Float, value) if value else mi.Float(0.0)


def opaque_point(place: np.ndarray) -> Point3f:
    """Return a point (3,) whose components are not compiled into kernels."""
    return mi.Point3f(*(opaque(float(x)) for x in place))


def opaque_transform(matrix: np.ndarray) -> mi.Transform4f:
    """Return a transform (4, 4) whose elements are not compiled into kernels."""
    opaque = mi.Matrix4f(matrix)
    dr.make_opaque(opaque)
    return mi.Transform4f(opaque)


def begin_kernels() -> None:
    """Start a new scope of Dr.Jit, so that kernels are the same in every frame, regardless of existing arrays.

    Within a scope, Dr.Jit shares plain numbers among all arrays and orders kernels by their first use. A new scope
    shares none with older arrays.
    """
    dr.detail.new_scope(dr.backend_v(mi.Float))


class FrozenFunctions:
    """Functions whose kernels are recorded when they are first called, and then launched without tracing them again.

    Tracing and assembly of large kernels take longer than their execution. The recordings belong to one scene and are
    kept as long as this object (`drjit.freeze`).
    """

    def __init__(self) -> None:
        self._frozen: dict[Hashable, tuple[_Body, Callable[..., Any]]] = {}

    def call(self, key: Hashable, function: Callable[..., Any], carriers: Iterable[object], *inputs: Any) -> Any:
        """Return ``function(*inputs)``, evaluated.

        Parameters
        ----------
        key
            Identifies the function and whatever changes its operations: later functions with the same key are not
            called. Numbers within a function are recorded with it, and must be opaque in ``carriers`` or ``inputs`` if
            they change.
        function
            Takes and returns arrays, or lists and data classes of them. If any result is a constant, the function is
            always traced: Dr.Jit would return the constant with its recorded width.
        carriers
            Objects of the twin with all other arrays that the function reads; see `find_arrays`.
        inputs
            Arguments of the function; their widths may change.
        """
        if key not in self._frozen:
            body = _Body()
            self._frozen[key] = body, dr.freeze(lambda carried, inputs: body(*inputs))
        body, frozen = self._frozen[key]
        if body.has_constants:
            results = function(*inputs)
            dr.eval(results)
            return results
        body.function = function
        try:
            return frozen(find_arrays(carriers), inputs)
        finally:
            del body.function


class _Body:
    """Holder of the function to record: Dr.Jit would compare the function itself with the recorded one."""

    function: Callable[..., Any]
    has_constants = False

    def __call__(self, *inputs: Any) -> Any:
        results = self.function(*inputs)
        constant = dr.VarState.Literal, dr.VarState.Mixed
        self.has_constants |= any(each.state in constant for each in find_arrays(results))
        return results


def find_arrays(thing: object) -> list[Any]:
    """Return the arrays and Mitsuba objects in an object of the twin, always in the same order."""
    arrays: dict[int, Any] = {}
    visited: set[int] = set()
    waiting = [thing]
    while waiting:
        each = waiting.pop()
        if isinstance(each, (dr.ArrayBase, mi.Object)):
            arrays[id(each)] = each
        elif isinstance(each, mi.Transform4f):
            waiting.append(each.matrix)  # its inverse is not computed unless it is used
        elif isinstance(each, (list, tuple)):
            waiting += each
        elif isinstance(each, dict):
            waiting += each.values()
        elif type(each).__module__.startswith("twin.") and id(each) not in visited:
            visited.add(id(each))
            waiting += vars(each).values()
    return list(arrays.values())
