"""Camera rays through a flat window of any tilt: from the entrance pupil to the medium behind the glass.

Snell's law in vector form (thesis Eq. 2.18, after Glassner 1989). Everything is in the camera frame, in mm.
"""

import math
from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from uwlts.model.calibration import WindowModel
from uwlts.model.errors import RangeError


class RayStatus(IntEnum):
    """Result for a camera ray; anything but OK has no point.

    NO_DIRECTION: the lens model has no inverse at the pixel. BEHIND_WINDOW: the ray never reaches the window going
    forward. TOTAL_REFLECTION: a face of the window lets nothing through. NO_CROSSING: the ray runs parallel to the
    sheet or away from it. BEHIND: the ray passes the sheet inside the housing or the glass, not in the medium.
    OUTSIDE_CALIBRATION: a polynomial calibration says nothing about this place of the image.
    """

    OK = 0
    NO_DIRECTION = 1
    BEHIND_WINDOW = 2
    TOTAL_REFLECTION = 3
    NO_CROSSING = 4
    BEHIND = 5
    OUTSIDE_CALIBRATION = 6


@dataclass(frozen=True)
class RaysInMedium:
    """Rays as they run in the medium, in the camera frame.

    Attributes
    ----------
    origins : (N, 3) float64, mm, on the window's outer face (the entrance pupil where there is no window)
    directions : (N, 3) float64, unit vectors away from the sensor
    status : (N,) uint8, `RayStatus`; origins and directions are NaN where it is not OK
    """

    origins: np.ndarray
    directions: np.ndarray
    status: np.ndarray


def require_index(index: float) -> None:
    """Refuse a refractive index relative to air that no medium to measure in has; RangeError."""
    if not 1 <= index < 2:
        raise RangeError(f"the refractive index is {index:g}; expected that of a medium relative to air, from 1 to 2")


def check_index(name: str, value: float) -> None:
    """Raise RangeError unless a refractive index or a ratio of two is finite and positive."""
    if not (math.isfinite(value) and value > 0):
        raise RangeError(f"{name} is {value:g}; a refractive index is finite and positive")


def refract(directions: np.ndarray, normal: np.ndarray, *, ratio: float) -> tuple[np.ndarray, np.ndarray]:
    """Directions behind an interface, by Snell's law in vector form (thesis Eq. 2.18).

    Eq. 2.18 holds for a normal that opposes the incident ray; with N = (0, 0, 1) along the camera's axis, as the
    thesis prints it beside Eq. 3.6, it sends the ray backwards. Here the normal may point to either side: the sign of
    the square root follows the side from which the ray comes.

    Parameters
    ----------
    directions : (N, 3)
        Unit vectors of the incident rays; a row of NaN stays NaN.
    normal : (3,) or (N, 3)
        Unit normal of the interface, for all rays or for each.
    ratio : float
        Index before the interface over index behind it; RangeError where it is not finite and positive.

    Returns
    -------
    refracted : (N, 3)
        Unit vectors, NaN where the ray is totally reflected.
    total_reflection : (N,) bool
    """
    check_index("the ratio of refractive indices", ratio)
    rays, normal = np.asarray(directions, dtype=float).T, np.asarray(normal, dtype=float)
    cosine = normal @ rays if normal.ndim == 1 else np.einsum("ji,ij->j", normal, rays)
    squared = 1.0 - ratio**2 * (1.0 - cosine * cosine)
    total_reflection = squared < 0
    if total_reflection.any():
        squared[total_reflection] = np.nan
    along_normal = np.copysign(np.sqrt(squared), cosine) - ratio * cosine
    refracted = ratio * rays + along_normal * (normal[:, None] if normal.ndim == 1 else normal.T)
    return refracted.T, total_reflection


def window_normal(window: WindowModel) -> np.ndarray:
    """Unit normal (3,) of a window, along a camera ray; RangeError where the camera looks along the glass."""
    normal = np.array(window.normal)
    length = np.linalg.norm(normal)
    if not abs(normal[2]) > 1e-6 * length:
        raise RangeError(f"the window's normal {window.normal} must have a part along the camera's axis (z)")
    return normal / math.copysign(length, normal[2])


def trace_window(directions: np.ndarray, window: WindowModel | None, *, medium_index: float) -> RaysInMedium:
    """Follow rays from the entrance pupil, the camera frame's origin, through the window into the medium.

    Thesis Eqs. 3.4 to 3.7 for one refraction, once more at the outer face for two. Without a window the rays stay as
    they are. In air (``medium_index`` 1) a window shifts the rays and a single interface does nothing.

    ``directions`` (N, 3) are unit vectors in air, camera frame; rows that are not finite get the status NO_DIRECTION.
    RangeError where the index is not finite and positive, or the window's plane runs along the camera's axis.
    """
    check_index("medium_index", medium_index)
    directions = np.asarray(directions, dtype=float)
    normal = window_normal(window) if window is not None else np.array([0.0, 0.0, 1.0])
    cosine = directions @ normal
    status = np.where(np.isfinite(cosine), np.uint8(RayStatus.OK), np.uint8(RayStatus.NO_DIRECTION))
    if window is None:
        origins = np.zeros_like(directions)
    else:
        away = cosine <= 0
        status[away] = RayStatus.BEHIND_WINDOW
        cosine[away] = np.nan
        origins = (window.distance_mm * normal[2] / cosine * directions.T).T
        index = 1.0
        if window.refractions == 2:
            index = window.glass_index
            directions, reflected = refract(directions, normal, ratio=1.0 / index)
            status[reflected & (status == RayStatus.OK)] = RayStatus.TOTAL_REFLECTION
            origins += (window.thickness_mm / (directions @ normal) * directions.T).T
        directions, reflected = refract(directions, normal, ratio=index / medium_index)
        status[reflected & (status == RayStatus.OK)] = RayStatus.TOTAL_REFLECTION
    failed = status != RayStatus.OK
    if failed.any():
        origins, directions = (np.where(failed[:, None], np.nan, array) for array in (origins, directions))
    return RaysInMedium(origins, directions, status)
