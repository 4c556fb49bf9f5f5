"""Numbers and arrays between Python and Dr.Jit, moved so that equal work always gives equal kernels.

Dr.Jit wraps NumPy's memory without copying and compiles its alignment into the kernel; it also compiles the size into
the kernel that gathers a vector's components, and every plain number. Any of these would compile kernels anew, which
takes seconds, from frame to frame or from sensor to sensor.
"""

from __future__ import annotations

from typing import Any, TypeAlias

import drjit as dr
import mitsuba as mi
import numpy as np

# Mitsuba's arrays are those of the variant in use. The stubs give them two unrelated families of types (`mitsuba.Float`
# and `drjit.auto.ad.Float`) and refuse sums of points and vectors: annotations name the arrays without checking them.
Float: TypeAlias = Any
Bool: TypeAlias = Any
UInt32: TypeAlias = Any
Int32: TypeAlias = Any
Point2f: TypeAlias = Any
Point3f: TypeAlias = Any
Vector3f: TypeAlias = Any
SurfaceInteraction3f: TypeAlias = Any
PCG32: TypeAlias = Any
BSDFPtr: TypeAlias = Any

_ALIGNMENT_BYTES = 64


def to_jit(kind: type, values: np.ndarray) -> Float:
    """A one-dimensional array as ``mi.Float`` or ``mi.UInt32`` whose memory is always aligned."""
    dtype = np.dtype(np.float32 if kind is mi.Float else np.uint32)
    size = values.size * dtype.itemsize
    memory = np.empty(size + _ALIGNMENT_BYTES, np.uint8)
    start = -memory.ctypes.data % _ALIGNMENT_BYTES
    aligned = memory[start : start + size].view(dtype)
    aligned[:] = values.ravel()
    return kind(aligned)


def to_numpy(vector: Point3f) -> np.ndarray:
    """The components of N vectors as (N, 3)."""
    return np.stack([component.numpy() for component in vector], axis=1)


def scalar_transform(matrix: np.ndarray) -> mi.ScalarTransform4f:
    """A transform (4, 4) of a shape, fixed in the scene."""
    return mi.ScalarTransform4f(matrix)


def opaque(value: float) -> Float:
    """A number that is not compiled into kernels, but for 0, which saves work where something is absent.

    Two of the same value are two inputs of a kernel: what is computed from both is computed twice.
    """
    return dr.opaque(mi.Float, value) if value else mi.Float(0.0)


def opaque_point(place: np.ndarray) -> Point3f:
    """A point (3,) whose numbers are not compiled into kernels."""
    return mi.Point3f(*(opaque(float(x)) for x in place))


def opaque_transform(matrix: np.ndarray) -> mi.Transform4f:
    """A transform (4, 4) whose numbers are not compiled into kernels."""
    opaque = mi.Matrix4f(matrix)
    dr.make_opaque(opaque)
    return mi.Transform4f(opaque)


def begin_kernels() -> None:
    """Begin to write down kernels that are the same in every frame, whatever arrays are still in use from before.

    Dr.Jit shares a plain number among all arrays of one basic block that need it, and orders kernels by where each
    number came up first: those of a block of their own never meet older ones.
    """
    dr.detail.new_scope(dr.backend_v(mi.Float))
