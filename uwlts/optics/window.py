"""Camera rays through a flat window of any tilt: from the entrance pupil to the medium behind the glass.

Snell's law in vector form (thesis Eq. 2.18, after Glassner 1989). Everything is in the camera frame, in mm.
"""

import math
from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from uwlts.errors import RangeError
from uwlts.model.calibration import WindowModel


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

    ``origins`` (N, 3), mm, lie on the window's outer face (in the entrance pupil where there is no window);
    ``directions`` (N, 3) are unit vectors away from the sensor; both are NaN where ``status`` (N,), uint8 of
    `RayStatus`, is not OK.
    """

    origins: np.ndarray
    directions: np.ndarray
    status: np.ndarray


@dataclass(frozen=True, eq=False)
class RayDerivatives:
    """Rays in the medium, camera frame, mm, and their derivatives.

    ``origins`` (3, N), ``directions`` (3, N) of length one, and both by C quantities: ``origins_by`` and
    ``directions_by`` (C, 3, N).
    """

    origins: np.ndarray
    directions: np.ndarray
    origins_by: np.ndarray
    directions_by: np.ndarray


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


def tangent_ratio(index_squared: float, tangent_squared: np.ndarray) -> np.ndarray:
    """Tangent of a ray's angle to the normal behind an interface over that before it, by Snell's law.

    With m the index behind the interface over that before it and t the tangent before: 1 / sqrt(m^2 + (m^2 - 1) t^2).
    """
    return 1.0 / np.sqrt(index_squared + (index_squared - 1.0) * tangent_squared)


def leaning(direction: np.ndarray, across: np.ndarray, slopes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Unit vector (3,) that leans from a direction by slopes (k,) towards others (k, 3), and its derivatives (k, 3)."""
    raw = direction + slopes @ across
    length = np.linalg.norm(raw)
    unit = raw / length
    return unit, (across - np.outer(across @ unit, unit)) / length


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


def trace_derivatives(
    rays: np.ndarray, rays_by: np.ndarray, window: WindowModel, *, medium_index: float
) -> RayDerivatives | None:
    """Rays (3, N) behind the window, as of `trace_window`, with derivatives; None where a ray does not get there.

    The columns are those of ``rays_by`` (c, 3, N), then the window's distance, the two slopes of its normal, the
    thickness and the index of the glass, and the medium's index. At a face index times direction changes along the
    normal only (Snell's law): n' r' = n r + (root - n cosine) normal, with root^2 = n'^2 - n^2 + (n cosine)^2.
    """
    count = len(rays_by)
    of_distance, _, _, of_thickness, of_glass, of_medium = np.eye(count + 6)[count:]
    by = np.concatenate([rays_by, np.zeros((6, *rays.shape))])
    normal_by = np.zeros((count + 6, 3))
    slopes = np.array(window.normal[:2]) / window.normal[2]
    normal, normal_by[count + 1 : count + 3] = leaning(np.eye(3)[2], np.eye(3)[:2], slopes)
    distance_by = window.distance_mm * normal_by[:, 2] + normal[2] * of_distance
    faces = [(window.distance_mm * normal[2], distance_by, medium_index, of_medium)]
    if window.refractions == 2:
        faces = [(*faces[0][:2], window.glass_index, of_glass), (window.thickness_mm, of_thickness, *faces[0][2:])]
    origins, origins_by = np.zeros_like(rays), np.zeros_like(by)
    index, index_by = 1.0, np.zeros(count + 6)
    for extent, extent_by, behind, behind_by in faces:
        cosine, cosine_by = normal @ rays, normal_by @ rays + np.einsum("i,cin->cn", normal, by)
        if not (cosine > 0).all():
            return None
        reach = extent / cosine
        reach_by = (extent_by[:, None] - reach * cosine_by) / cosine
        origins, origins_by = origins + reach * rays, origins_by + reach_by[:, None] * rays + reach * by
        refracted = refract(rays.T, normal, ratio=index / behind)[0].T
        root = behind * (normal @ refracted)
        if not (root > 0).all():
            return None
        cosine, cosine_by = index * cosine, index_by[:, None] * cosine + index * cosine_by
        root_by = ((behind * behind_by - index * index_by)[:, None] + cosine * cosine_by) / root
        by = index * by + index_by[:, None, None] * rays
        by += (root_by - cosine_by)[:, None] * normal[:, None] + (root - cosine) * normal_by[:, :, None]
        by = (by - behind_by[:, None, None] * refracted) / behind
        rays, index, index_by = refracted, behind, behind_by
    return RayDerivatives(origins, rays, origins_by, by)
