"""Camera rays through a tilted flat window, from the entrance pupil to the medium behind the glass.

Snell's law in vector form (thesis Eq. 2.18, after Glassner 1989). All quantities are in the camera frame, in mm.
"""

import math
from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from uwlts.errors import RangeError
from uwlts.model.calibration import WindowModel


class RayStatus(IntEnum):
    """Status of a camera ray. Only rays with status OK have a point.

    NO_DIRECTION: the lens model cannot be inverted at the pixel. BEHIND_WINDOW: the ray runs away from the window.
    TOTAL_REFLECTION: a face of the window reflects all light. NO_CROSSING: the ray runs parallel to the sheet or away
    from it. BEHIND: the ray meets the sheet inside the housing or the glass, not in the medium. OUTSIDE_CALIBRATION:
    the polynomial calibration does not cover this part of the image.
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
    """Rays in the medium, camera frame."""

    origins: np.ndarray
    """(N, 3); points on the window's outer face, mm; the entrance pupil without a window. NaN if the status is not
    OK."""
    directions: np.ndarray
    """(N, 3); unit vectors away from the sensor. NaN if the status is not OK."""
    status: np.ndarray  # (N,) uint8; `RayStatus`


@dataclass(frozen=True, eq=False)
class RayDerivatives:
    """Rays in the medium, camera frame, mm, and their derivatives with respect to C parameters.

    ``origins`` and ``directions`` (unit vectors) have the shape (3, N); their derivatives ``origins_by`` and
    ``directions_by`` have the shape (C, 3, N).
    """

    origins: np.ndarray
    directions: np.ndarray
    origins_by: np.ndarray
    directions_by: np.ndarray


def require_index(index: float) -> None:
    """Raise RangeError unless the refractive index of a medium, relative to air, is from 1 to 2."""
    if not 1 <= index < 2:
        raise RangeError(f"the refractive index is {index:g}; expected a value relative to air, from 1 to 2")


def check_index(name: str, value: float) -> None:
    """Raise RangeError unless a refractive index or a ratio of two is finite and positive."""
    if not (math.isfinite(value) and value > 0):
        raise RangeError(f"{name} is {value:g}; expected a finite, positive number")


def refract(directions: np.ndarray, normal: np.ndarray, *, ratio: float) -> tuple[np.ndarray, np.ndarray]:
    """Refract rays at an interface by Snell's law in vector form (thesis Eq. 2.18).

    Eq. 2.18 holds for a normal that opposes the incident ray. With N = (0, 0, 1) along the camera's axis, as printed
    with Eq. 3.6 of the thesis, the equation sends the ray backwards. Here the normal may point to either side: the sign
    of the square root is that of the cosine between ray and normal.

    ``directions`` (N, 3) are unit vectors, ``normal`` (3,) or (N, 3) is the unit normal of the interface. ``ratio`` is
    the index before the interface divided by that behind it. Returns unit vectors (N, 3), NaN for rays that are NaN or
    totally reflected, and whether they are totally reflected (N,). RangeError if the ratio is not finite and positive.
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
    """Return the ratio of the tangents of a ray's angle to the normal, behind and before an interface (Snell's law).

    The ratio is 1 / sqrt(m^2 + (m^2 - 1) t^2). Here m is the ratio of the indices behind and before the interface, and
    t is the tangent before it.
    """
    return 1.0 / np.sqrt(index_squared + (index_squared - 1.0) * tangent_squared)


def tilt_direction(direction: np.ndarray, across: np.ndarray, slopes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return a direction tilted by slopes (k,) towards vectors (k, 3), and its derivatives (k, 3) by the slopes.

    The tilted direction is a unit vector (3,).
    """
    raw = direction + slopes @ across
    length = np.linalg.norm(raw)
    unit = raw / length
    return unit, (across - np.outer(across @ unit, unit)) / length


def window_normal(window: WindowModel) -> np.ndarray:
    """Return the unit normal (3,) of a window, directed away from the camera.

    Raises RangeError if the camera's axis runs along the glass.
    """
    normal = np.array(window.normal)
    length = np.linalg.norm(normal)
    if not abs(normal[2]) > 1e-6 * length:
        raise RangeError(f"the window's normal {window.normal} must have a component along the camera's axis (z)")
    return normal / math.copysign(length, normal[2])


def trace_window(directions: np.ndarray, window: WindowModel | None, *, medium_index: float) -> RaysInMedium:
    """Trace rays from the entrance pupil (the origin of the camera frame) through the window into the medium.

    One refraction follows thesis Eqs. 3.4 to 3.7; two refractions repeat them at the outer face. Without a window the
    rays do not change. In air (``medium_index`` 1), two refractions shift the rays, and one changes nothing.

    ``directions`` (N, 3) are unit vectors in air, camera frame. Rows that are not finite get the status NO_DIRECTION.

    Raises RangeError if the index is not finite and positive, or the camera's axis runs along the glass.
    """
    check_index("medium_index", medium_index)
    directions = np.asarray(directions, dtype=float)
    normal = window_normal(window) if window is not None else np.array([0.0, 0.0, 1.0])
    cosine = directions @ normal
    status = np.where(np.isfinite(cosine), np.uint8(RayStatus.OK), np.uint8(RayStatus.NO_DIRECTION))
    if window is None:
        origins = np.zeros_like(directions)
    else:
        backwards = cosine <= 0
        status[backwards] = RayStatus.BEHIND_WINDOW
        cosine[backwards] = np.nan
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
    """Trace rays (3, N) as `trace_window`, with derivatives; return None if a ray does not reach the medium.

    The derivatives are with respect to the c parameters of ``rays_by`` (c, 3, N), then those of window and media: the
    window's distance, the two slopes of its normal, thickness and index of the glass, the medium's index. At a face,
    index times direction changes only along the normal (Snell's law): n' r' = n r + (root - n cosine) normal, with
    root^2 = n'^2 - n^2 + (n cosine)^2.
    """
    count = len(rays_by)
    of_distance, _, _, of_thickness, of_glass, of_medium = np.eye(count + 6)[count:]
    by = np.concatenate([rays_by, np.zeros((6, *rays.shape))])
    normal_by = np.zeros((count + 6, 3))
    slopes = np.array(window.normal[:2]) / window.normal[2]
    normal, normal_by[count + 1 : count + 3] = tilt_direction(np.eye(3)[2], np.eye(3)[:2], slopes)
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
