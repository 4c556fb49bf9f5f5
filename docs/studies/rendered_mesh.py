"""Meshes of rendered scans against their true surfaces, and Open3D's Poisson reconstruction of the same points.

    python docs/studies/rendered_mesh.py runs/inspection            # after docs/studies/inspection.py
    python docs/studies/poisson_mesh.py runs/inspection             # in an environment with Open3D
    python docs/studies/rendered_mesh.py runs/inspection            # again, with its meshes

Errors are those of the vertices, along the normal, against the closed form of a corroded pipe and of a flange's face.
"""

from pathlib import Path

import numpy as np
from cyclopts import App
from inspection import cloud_of
from inspection_scenes import AXIS_Z_MM, WATERS, large_pits, radius_mm
from result_tables import publish, table
from scipy.spatial import KDTree

import uwlts
from twin.scene.description import load_scene
from twin.scene.forms import Flange
from twin.scene.forms.parts import flange_face

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


def off_flange(folder: Path, water: str):
    """Return a function for distances from a flange's face; they are NaN beside the face."""
    flange = load_scene(str(folder / f"flange-{water}.toml")).objects[0]
    assert isinstance(flange, Flange)

    def off(points: np.ndarray) -> np.ndarray:
        return flange_face(flange, points[:, 0], points[:, 1]) - points[:, 2]

    return off


def row(name: str, vertices: np.ndarray, std: np.ndarray | None, off: np.ndarray, points: np.ndarray) -> list[str]:
    """Return a row of the table: number, rms, bias, coverage, and vertices on surfaces that were not seen."""
    beyond = KDTree(points).query(vertices)[0] > SEEN_MM
    known = np.isfinite(off) & ~beyond
    error = off[known]
    inside = "-" if std is None else f"{100 * np.mean(np.abs(error) <= 1.96 * std[known]):.0f} %"
    return [
        name,
        f"{len(vertices):,}",
        f"{1e3 * np.sqrt(np.mean(error**2)):.1f}",
        f"{1e3 * error.mean():+.1f}",
        "-" if std is None else f"{1e3 * np.sqrt(np.mean(std[known] ** 2)):.1f}",
        inside,
        f"{100 * beyond.mean():.1f} %",
        f"{100 * np.mean(~np.isfinite(off) & ~beyond):.1f} %",
    ]


def main(folder: Path, *, write: bool = False) -> None:
    """Mesh and print the table; with `--write`, put it into its page."""
    rows = []
    for water in WATERS:
        for name, cloud, off in (
            ("corroded pipe", cloud_of(folder, water, "pipe-corroded"), off_pipe),
            ("flange", cloud_of(folder, "flanges", f"flange-{water}"), off_flange(folder, water)),
        ):
            made = uwlts.mesh(cloud)
            rows.append(row(f"{name}, {water}", made.vertices_mm, made.std_mm, off(made.vertices_mm), cloud.points_mm))
            saved = folder / f"mesh-{name.split()[-1]}-{water}.npz"
            np.savez(saved, points=cloud.points_mm)
            poisson = saved.with_suffix(".poisson.npz")
            if poisson.exists():
                vertices = np.load(poisson)["vertices"]
                rows.append(row(f"{name}, {water}, Open3D", vertices, None, off(vertices), cloud.points_mm))
            print(rows[-1], flush=True)
    head = [
        "mesh",
        "vertices",
        "rms, um",
        "bias, um",
        "stated, um",
        "within 95 %",
        "where nothing was seen",
        "off the edges",
    ]
    publish({"rendered meshes": table(head, rows)}, write=write)


if __name__ == "__main__":
    App(help=__doc__, help_format="plaintext", default_command=main)()
