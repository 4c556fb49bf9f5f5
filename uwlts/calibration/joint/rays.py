"""Camera rays in the medium with their derivatives by the pixel, by lens, window and index: what every residual needs.

The rays are those of `uwlts.camera.directions` and `uwlts.refraction.trace_window`; their derivatives follow from the
same formulas by the chain rule, that of the inverse distortion by the implicit function theorem.
"""

from dataclasses import dataclass

import numpy as np

from uwlts.calibration.model import CameraModel, WindowModel
from uwlts.calibration.parameter_keys import LensParameter, WindowParameter
from uwlts.camera import directions

LENS = tuple(key for key in LensParameter if key is not LensParameter.F)
WINDOW = tuple(WindowParameter)
COLUMNS = ("u", "v", *LENS, *WINDOW, "medium_index")
"""By what rays are differentiated."""

_INNER = 8
"""Ideal image coordinates x and y, five numbers of the window, the medium's index."""


@dataclass(frozen=True, eq=False)
class RayDerivatives:
    """Rays in the medium, camera frame, mm, and their derivatives.

    Attributes
    ----------
    origins, directions : (3, N)
        Directions of length one.
    origins_by, directions_by : (C, 3, N)
        By the `COLUMNS`.
    """

    origins: np.ndarray
    directions: np.ndarray
    origins_by: np.ndarray
    directions_by: np.ndarray


def ray_derivatives(
    camera: CameraModel, window: WindowModel | None, pixels: np.ndarray, *, medium_index: float
) -> RayDerivatives | None:
    """Rays of pixels (N, 2) with their derivatives; None where a pixel has no ray in the medium."""
    seen = directions(camera, pixels).T
    if not np.isfinite(seen).all():
        return None
    x, y = seen[0] / seen[2], seen[1] / seen[2]
    ray, by = seen, np.zeros((_INNER, 3, len(x)))
    # Unit vector (x, y, 1) / length by x and y.
    by[0], by[1] = -seen * seen[0] * seen[2], -seen * seen[1] * seen[2]
    by[0, 0] += seen[2]
    by[1, 1] += seen[2]
    origin, origin_by = np.zeros_like(ray), np.zeros_like(by)
    if window is not None:
        traced = _through(window, ray, by, medium_index)
        if traced is None:
            return None
        origin, origin_by, ray, by = traced
    image_by = _ideal_image_by(camera, pixels, x, y)
    return RayDerivatives(origin, ray, _by_columns(origin_by, image_by), _by_columns(by, image_by))


def _by_columns(by_inner: np.ndarray, image_by: np.ndarray) -> np.ndarray:
    lens = by_inner[0][None] * image_by[:, None, 0] + by_inner[1][None] * image_by[:, None, 1]
    return np.concatenate([lens, by_inner[2:]])


def _ideal_image_by(camera: CameraModel, pixels: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Derivatives (11, 2, N) of the ideal image coordinates by u, v and the lens.

    The distorted image D(x, y; k) stays at ((u - cx) / fx, (v - cy) / fy), so that dD/d(x, y) d(x, y) is the change of
    the latter minus dD/dk dk (Brown-Conrady distortion as in OpenCV, module calib3d).
    """
    d = camera.distortion
    s = x * x + y * y
    radial = 1.0 + s * (d.k1 + s * (d.k2 + s * d.k3))
    slope = 2.0 * (d.k1 + s * (2.0 * d.k2 + s * 3.0 * d.k3))
    xx = radial + slope * x * x + 2.0 * d.p1 * y + 6.0 * d.p2 * x
    xy = slope * x * y + 2.0 * d.p1 * x + 2.0 * d.p2 * y
    yy = radial + slope * y * y + 6.0 * d.p1 * y + 2.0 * d.p2 * x
    zero = np.zeros_like(x)
    right = np.array(
        [
            (zero + 1.0 / camera.fx_px, zero),
            (zero, zero + 1.0 / camera.fy_px),
            (-(pixels[:, 0] - camera.cx_px) / camera.fx_px**2, zero),
            (zero, -(pixels[:, 1] - camera.cy_px) / camera.fy_px**2),
            (zero - 1.0 / camera.fx_px, zero),
            (zero, zero - 1.0 / camera.fy_px),
            (-x * s, -y * s),
            (-x * s**2, -y * s**2),
            (-2.0 * x * y, -s - 2.0 * y * y),
            (-s - 2.0 * x * x, -2.0 * x * y),
            (-x * s**3, -y * s**3),
        ]
    )
    determinant = xx * yy - xy * xy
    first = (yy * right[:, 0] - xy * right[:, 1]) / determinant
    second = (xx * right[:, 1] - xy * right[:, 0]) / determinant
    return np.stack([first, second], axis=1)


def _through(
    window: WindowModel, ray: np.ndarray, by: np.ndarray, medium_index: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray] | None:
    """Origins and directions behind the window with derivatives by the inner columns; None where a ray has none."""
    raw = np.array(window.normal) / window.normal[2]
    length = np.linalg.norm(raw)
    normal = raw / length
    normal_by = np.zeros((_INNER, 3))
    normal_by[3] = (np.array([1.0, 0, 0]) - normal * normal[0]) / length
    normal_by[4] = (np.array([0, 1.0, 0]) - normal * normal[1]) / length
    cosine, cosine_by = _along(ray, by, normal, normal_by)
    if not (cosine > 0).all():
        return None
    reach = window.distance_mm * normal[2] / cosine
    reach_by = (window.distance_mm * normal_by[:, 2])[:, None] / cosine - reach * cosine_by / cosine
    reach_by[2] += normal[2] / cosine
    origin, origin_by = reach * ray, reach_by[:, None] * ray + reach * by
    index, index_by = 1.0, np.zeros(_INNER)
    if window.refractions == 2:
        index = window.glass_index
        index_by[6] = 1.0
        refracted = _refracted(ray, by, normal, normal_by, 1.0 / index, -index_by / index**2)
        if refracted is None:
            return None
        ray, by = refracted
        cosine, cosine_by = _along(ray, by, normal, normal_by)
        reach = window.thickness_mm / cosine
        reach_by = -reach * cosine_by / cosine
        reach_by[5] += 1.0 / cosine
        origin, origin_by = origin + reach * ray, origin_by + reach_by[:, None] * ray + reach * by
    ratio_by = index_by / medium_index
    ratio_by[7] = -index / medium_index**2
    refracted = _refracted(ray, by, normal, normal_by, index / medium_index, ratio_by)
    return None if refracted is None else (origin, origin_by, *refracted)


def _along(ray: np.ndarray, by: np.ndarray, normal: np.ndarray, normal_by: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Cosine (N,) between rays and normal and its derivatives (8, N)."""
    return normal @ ray, normal_by @ ray + np.einsum("i,cin->cn", normal, by)


def _refracted(
    ray: np.ndarray, by: np.ndarray, normal: np.ndarray, normal_by: np.ndarray, ratio: float, ratio_by: np.ndarray
) -> tuple[np.ndarray, np.ndarray] | None:
    """Snell's law in vector form (thesis Eq. 2.18) and its derivatives; None at total reflection."""
    cosine, cosine_by = _along(ray, by, normal, normal_by)
    sine_square = 1.0 - cosine**2
    square = 1.0 - ratio**2 * sine_square
    if not (square > 0).all():
        return None
    root = np.sqrt(square)
    along = root - ratio * cosine
    root_by = (ratio**2 * cosine * cosine_by - ratio * ratio_by[:, None] * sine_square) / root
    along_by = root_by - ratio_by[:, None] * cosine - ratio * cosine_by
    refracted = ratio * ray + along * normal[:, None]
    refracted_by = (
        ratio_by[:, None, None] * ray + ratio * by + along_by[:, None] * normal[:, None] + along * normal_by[:, :, None]
    )
    return refracted, refracted_by
