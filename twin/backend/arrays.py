"""Conversion of numbers and arrays between Python and Dr.Jit, such that equal work gives equal kernels.

Dr.Jit wraps NumPy's memory without copying and compiles its alignment into the kernel. It also compiles every plain
number and, if a vector's components are gathered, the size. Any of these would cause recompilation, which takes
seconds, between frames or sensors.
"""

from __future__ import annotations

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


def to_jit(values: np.ndarray) -> Float:
    """Return values as one-dimensional ``mi.Float`` with aligned memory."""
    size = 4 * values.size
    memory = np.empty(size + _ALIGNMENT_BYTES, np.uint8)
    start = -memory.ctypes.data % _ALIGNMENT_BYTES
    aligned = memory[start : start + size].view(np.float32)
    aligned[:] = values.ravel()
    return mi.Float(aligned)


def to_numpy(vector: Point3f) -> np.ndarray:
    """Return the components of N vectors as (N, 3)."""
    return np.stack([component.numpy() for component in vector], axis=1)


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
