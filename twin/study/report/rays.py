"""Rays of a drawing: pixels to directions, and the way through flat windows by Snell's law in vector form.

Another method than that of the formulas, which solve for the ray to a point; a drawing that disagrees shows it.
"""

from __future__ import annotations

import numpy as np

from uwlts.placement import LaserPose
from uwlts.sensor import Camera, Medium, Sensor, Window

_BORDER = 41
"""Pixels along each side of the image."""

Face = tuple[np.ndarray, np.ndarray, float, float]
"""A flat face: a point of it, its normal along the light, and the indices before and behind it."""


def faces(sensor: Sensor, window: Window, medium: Medium, origin: np.ndarray, rotation: np.ndarray) -> list[Face]:
    """Both faces of a module's window in the camera frame; none where it is left out."""
    if not window.mounted:
        return []
    wavelength = sensor.laser.wavelength_nm
    glass, normal = window.index(wavelength), rotation @ window.normal()
    inner = origin + window.distance_mm * rotation[:, 2]
    outer = inner + window.thickness_mm * normal
    return [(inner, normal, 1.0, glass), (outer, normal, glass, medium.refractive_index(wavelength))]


def frame(axis: np.ndarray, across: np.ndarray) -> np.ndarray:
    """A module's frame (3, 3), columns x, y, z: z along its axis, x along ``across``."""
    return np.stack([across, np.cross(axis, across), axis], axis=1)


def traced(origin: np.ndarray, directions: np.ndarray, faces: list[Face]) -> tuple[np.ndarray, np.ndarray]:
    """Points (N, K, 3) where rays (N, 3) start and meet faces, and their directions behind the last.

    Snell's law in vector form: with r = n1 / n2 and c = d . n, d' = r d + (sqrt(1 - r^2 (1 - c^2)) - r c) n.
    """
    d = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    points = [np.broadcast_to(origin, d.shape)]
    with np.errstate(invalid="ignore", divide="ignore"):
        for place, normal, before, behind in faces:
            points.append(points[-1] + ((place - points[-1]) @ normal / (d @ normal))[:, None] * d)
            r, c = before / behind, d @ normal
            d = r * d + (np.sqrt(1 - r**2 * (1 - c**2)) - r * c)[:, None] * normal
    return np.stack(points, axis=1), d


def to_plane(points: np.ndarray, directions: np.ndarray, place: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Rays carried on to a plane, (N, K + 1, 3); NaN for a ray that does not get there."""
    last = points[:, -1]
    with np.errstate(invalid="ignore", divide="ignore"):
        way = (place - last) @ normal / (directions @ normal)
        end = last + np.where(way > 0, way, np.nan)[:, None] * directions
    return np.concatenate([points, end[:, None]], axis=1)


def borders_on_sheet(camera: Camera, faces: list[Face], pose: LaserPose) -> list[np.ndarray]:
    """Where the image's four sides lie in the sheet, (N, 3) each."""
    width, height = camera.width_px - 0.5, camera.height_px - 0.5
    corners = np.array([(-0.5, -0.5), (width, -0.5), (width, height), (-0.5, height)])
    share = np.linspace(0, 1, _BORDER)[:, None]
    sides = [a + share * (b - a) for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True)]
    return [
        to_plane(*traced(np.zeros(3), directions(camera, side), faces), pose.origin_mm, pose.normal)[:, -1]
        for side in sides
    ]


def border_towards(camera: Camera, across: np.ndarray) -> np.ndarray:
    """Pixels (2, 2) where lines from the principal point along +-``across`` (2,) leave the image."""
    centre = np.array(camera.principal_point())
    least, most = np.array([-0.5, -0.5]), np.array([camera.width_px - 0.5, camera.height_px - 0.5])
    with np.errstate(divide="ignore", invalid="ignore"):
        ends = [np.where(d > 0, most - centre, least - centre) / d for d in (across, -across)]
    lengths = [float(np.min(end[np.abs(across) > 1e-12])) for end in ends]
    return np.stack([centre + lengths[0] * across, centre - lengths[1] * across])


def directions(camera: Camera, pixels: np.ndarray) -> np.ndarray:
    """Rays (N, 3) of pixels (N, 2); Brown-Conrady undone by fixed-point steps. NaN where they do not converge."""
    wanted = (pixels - camera.principal_point()) / camera.focal_length_px()
    d, found = camera.distortion, wanted.copy()
    with np.errstate(all="ignore"):
        for _ in range(100):
            x, y = found.T
            r2 = x * x + y * y
            radial = 1 + r2 * (d.k1 + r2 * (d.k2 + r2 * d.k3))
            aside = 2 * d.p1 * x * y + d.p2 * (r2 + 2 * x * x), d.p1 * (r2 + 2 * y * y) + 2 * d.p2 * x * y
            shift = np.stack(aside, axis=1)
            missed = np.abs(found * radial[:, None] + shift - wanted).max(axis=1)
            found = (wanted - shift) / radial[:, None]
        found[~(missed * camera.focal_length_px() < 1e-3)] = np.nan
    return np.column_stack([found, np.ones(len(found))])
