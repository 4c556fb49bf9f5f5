"""Arrays between NumPy and Dr.Jit, moved so that equal work always gives equal kernels.

Dr.Jit wraps NumPy's memory without copying and compiles its alignment into the kernel; it also compiles the size into
the kernel that gathers a vector's components. Either would compile kernels anew from frame to frame.
"""

from __future__ import annotations

import mitsuba as mi
import numpy as np

_ALIGNMENT_BYTES = 64


def to_jit(kind: type, values: np.ndarray) -> mi.Float:
    """A one-dimensional array as ``mi.Float`` or ``mi.UInt32`` whose memory is always aligned."""
    dtype = np.dtype(np.float32 if kind is mi.Float else np.uint32)
    size = values.size * dtype.itemsize
    memory = np.empty(size + _ALIGNMENT_BYTES, np.uint8)
    start = -memory.ctypes.data % _ALIGNMENT_BYTES
    aligned = memory[start : start + size].view(dtype)
    aligned[:] = values.ravel()
    return kind(aligned)


def to_numpy(vector: mi.Point3f) -> np.ndarray:
    """The components of N vectors as (N, 3)."""
    return np.stack([component.numpy() for component in vector], axis=1)
