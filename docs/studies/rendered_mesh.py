"""Meshes of the rendered scans of `inspection.py` against their true surfaces.

Errors are those of the vertices, along the normal, against the closed form of a corroded pipe, and
of both sides of a thin plate.
"""

from pathlib import Path

import numpy as np
from inspection_scenes import AXIS_Z_MM, WATERS, cloud_of, large_pits, radius_mm
from result_tables import table
from scipy.spatial import KDTree
from thin_wall import SIDES, off_plate, side_cloud

import uwlts

SEEN_MM = 1.0
"""Largest distance from a vertex to the nearest point; beyond it, the surface was not seen."""


def off_pipe(points: np.ndarray) -> np.ndarray:
    """Return the distances (N,) of points from the corroded pipe along its normal, from radius and slopes."""
    away = np.hypot(points[:, 1], AXIS_Z_MM - points[:, 2])
    angle = np.arctan2(points[:, 1], AXIS_Z_MM - points[:, 2])

    def radius(step_x: float = 0.0, step_s: float = 0.0) -> np.ndarray:
        return radius_mm(points[:, 0] + step_x, angle + step_s / 150.0, large_pits())

    slopes = [(radius(h, 0) - radius(-h, 0)) / (2 * h) for h in (0.01,)]
    slopes += [(radius(0, h) - radius(0, -h)) / (2 * h) for h in (0.01,)]
    return (away - radius()) / np.sqrt(1 + slopes[0] ** 2 + slopes[1] ** 2)


def row(name: str, made: uwlts.SurfaceMesh, off: np.ndarray, points: np.ndarray) -> list[str]:
    """Return a row of the table: errors (N,) of the vertices, coverage, and vertices on surfaces that were not seen."""
    beyond = KDTree(points).query(made.vertices_mm)[0] > SEEN_MM
    known = np.isfinite(off) & ~beyond
    error, std = off[known], made.std_mm[known]
    sizes = f"{np.sqrt(np.mean(error**2)):.1f}", f"{error.mean():+.1f}", f"{1e3 * np.sqrt(np.mean(std**2)):.1f}"
    inside = f"{100 * np.mean(np.abs(error) <= 1.96e3 * std):.0f} %"
    return [name, f"{len(off):,}", *sizes, inside, f"{100 * beyond.mean():.1f} %"]


def mesh_table(folder: Path) -> str:
    """Return the table of meshes of a folder with recordings."""
    rows = []
    for water in WATERS:
        cloud = cloud_of(folder, water, "pipe-corroded")
        made = uwlts.mesh(cloud)
        rows.append(row(f"corroded pipe, {water}", made, 1e3 * off_pipe(made.vertices_mm), cloud.points_mm))
    clouds = [side_cloud(folder, side) for side in SIDES]
    made = uwlts.mesh(*clouds, towards=[[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]])
    points = np.concatenate([cloud.points_mm for cloud in clouds])
    rows.append(row("plate of 2 mm, both sides", made, 1e3 * off_plate(made.vertices_mm), points))
    head = ["mesh", "vertices", "rms, µm", "bias, µm", "stated (1 std), µm", "truth within 95 %"]
    return table([*head, "beyond 1 mm of all points"], rows)
