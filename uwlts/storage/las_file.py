"""LAS and LAZ as other programs read them: points in m, in steps of 0.1 um, with fields of any name."""

from importlib import import_module
from io import BytesIO
from types import ModuleType
from typing import Literal

import numpy as np

from uwlts.errors import OutputError, SetupError

LAZ_STEP_M = 1e-7
"""Coordinates in LAZ are whole multiples of it from the middle of the cloud: 0.1 um, over 214 m to either side."""

_REACH_M = LAZ_STEP_M * (2**31 - 1)
INTENSITY_LIMITS = 0, 2**16 - 1


def las_content(
    points_mm: np.ndarray,
    intensity: np.ndarray,
    fields: dict[str, np.ndarray],
    *,
    time_s: np.ndarray | None = None,
    colours: np.ndarray | None = None,
    compressed: bool,
) -> bytes:
    """Content of a LAS or LAZ file of points (N, 3), their intensity (N,), fields (N,) by name, times (N,), and
    red, green and blue (N, 3) uint8."""
    laspy = library("laspy", "LAZ" if compressed else "LAS")
    if compressed:
        library("lazrs", "LAZ")
    points = 1e-3 * points_mm
    middle = las_middle(points.min(axis=0), points.max(axis=0))
    header = laspy.LasHeader(version="1.4", point_format=6 if colours is None else 7)
    header.offsets, header.scales = middle, np.full(3, LAZ_STEP_M)
    header.add_extra_dims([laspy.ExtraBytesParams(name=name, type=values.dtype) for name, values in fields.items()])
    table = laspy.LasData(header)
    table.x, table.y, table.z = points.T
    table.intensity = np.rint(np.nan_to_num(intensity)).clip(*INTENSITY_LIMITS).astype(np.uint16)
    if time_s is not None:
        table.gps_time = time_s
    if colours is not None:
        # 16 bits for each colour, all of them used, as the standard wants.
        table.red, table.green, table.blue = 257 * colours.T.astype(np.uint16)
    for name, values in fields.items():
        table[name] = values
    # In memory: the compressor has errors of its own where storage fails.
    content = BytesIO()
    table.write(content, do_compress=compressed)
    return content.getvalue()


def las_middle(low_m: np.ndarray, high_m: np.ndarray) -> np.ndarray:
    """Middle (3,) of a cloud, in m, from which coordinates are counted; OutputError where the cloud is too wide."""
    middle = np.round((low_m + high_m) / 2, 3)
    reach = max(np.abs(low_m - middle).max(), np.abs(high_m - middle).max())
    if not reach <= _REACH_M:
        raise OutputError(
            f"the cloud reaches {reach:.9g} m from its middle, LAZ in steps of {LAZ_STEP_M:g} m "
            f"only {_REACH_M:.0f} m: write PLY or E57"
        )
    return middle


def library(name: Literal["laspy", "lazrs", "copclib", "pye57"], format: str) -> ModuleType:
    """An optional library by its name; SetupError where it is not installed."""
    try:
        return import_module(name)
    except ImportError as error:
        raise SetupError(
            f"{format} needs the library {name}, which is not installed: pip install 'uwlts[clouds]', or write "
            "PLY or XYZ"
        ) from error


def brief(error: BaseException) -> str:
    """The message of a library's error in one line of 200 characters at most."""
    return " ".join(str(error).split())[:200]
