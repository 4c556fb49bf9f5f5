"""Mesh of a rendered plate of 2 mm thickness, scanned from both sides, and Open3D's Poisson reconstruction of it.

    python docs/studies/thin_wall.py runs/inspection                # plate, scenes and campaign
    twin record runs/inspection/plate.toml --out runs/inspection/plate
    python docs/studies/thin_wall.py runs/inspection docs/pictures  # after docs/studies/inspection.py's calibration
    python docs/studies/poisson_mesh.py runs/inspection             # in an environment with Open3D
    python docs/studies/thin_wall.py runs/inspection docs/pictures  # again, with its mesh

A round plate with a hole stands square to the laser. A known rotation by 180 deg about the scan's direction, as by a
rotary table, shows its back.
"""

from dataclasses import replace
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import tomli_w
import trimesh
from cyclopts import App
from result_tables import publish, table
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

import uwlts
from uwlts.storage.capture_writer import CaptureWriter

THICKNESS_MM, OUTER_MM, HOLE_MM = 2.0, 24.0, 6.0
"""Thickness and radii."""
SIDES = {"front": 0.0, "back": 180.0}
_EDGE_MM = 0.5
"""Vertices within this distance of an edge are not compared with the faces, because of the camera's blur."""


def plate_mesh() -> trimesh.Trimesh:
    """The plate with its hole, about its middle, square to z."""
    angle = np.linspace(0, 2 * np.pi, 361)[:-1]
    half = THICKNESS_MM / 2
    rings = [(OUTER_MM, -half), (HOLE_MM, -half), (HOLE_MM, half), (OUTER_MM, half)]
    vertices = np.concatenate(
        [np.column_stack([r * np.cos(angle), r * np.sin(angle), np.full(len(angle), z)]) for r, z in rings]
    )
    a, b = np.arange(360), np.roll(np.arange(360), -1)
    faces = []
    for ring in range(4):
        here, there = 360 * ring, 360 * ((ring + 1) % 4)
        faces += [np.column_stack([here + a, there + a, there + b]), np.column_stack([here + a, there + b, here + b])]
    return trimesh.Trimesh(vertices, np.concatenate(faces), process=True)


def write_scenes(folder: Path) -> None:
    """Write the plate, its scenes and their campaign."""
    made = plate_mesh()
    made.fix_normals()
    made.export(folder / "plate.ply")
    for side, turn in SIDES.items():
        plate = {"kind": "mesh", "path": "plate.ply", "reflectance": 0.4, "rotation_deg": [turn, 0.0, 0.0]}
        scene = {"title": f"Plate, {side}", "medium": "water", "water": "clear", "objects": [plate]}
        scene["motion"] = {"start_mm": -26.0, "step_mm": 1.0, "count": 53}
        (folder / f"plate-{side}.toml").write_text(tomli_w.dumps(scene), encoding="utf-8")
    recordings = [{"name": f"plate-{side}", "scene": f"plate-{side}.toml"} for side in SIDES]
    campaign = {"base": "thesis", "title": "inspection, plate", "recordings": recordings}
    (folder / "plate.toml").write_text(tomli_w.dumps(campaign), encoding="utf-8")


def side_cloud(folder: Path, side: str) -> uwlts.PointCloud:
    """The cloud of a side in the plate's frame, by the known turn."""
    posed = folder / "plate" / f"plate-{side}-posed.h5"
    if not posed.exists():
        turned = Rotation.from_euler("x", -SIDES[side], degrees=True).as_matrix()
        with (
            uwlts.read(folder / "plate" / f"plate-{side}.h5") as capture,
            CaptureWriter(posed, capture.header, dtype=capture.dtype) as writer,
        ):
            for number, frame in enumerate(capture):
                pose = np.eye(4)
                pose[:3, :3] = turned
                pose[:3, 3] = turned @ (frame.stage_mm * np.array(capture.header.stage_direction))
                writer.append(replace(frame, pose=pose, time_s=float(number + 1)))
    return uwlts.reconstruct(posed, folder / "calibration" / "calibration.json")


def row(name: str, vertices: np.ndarray, faces: np.ndarray, points: np.ndarray) -> list[str]:
    """Return a row of the table: errors of the faces, thickness, coverage, area over the hole, vertices far away."""
    radius, z = np.hypot(vertices[:, 0], vertices[:, 1]), vertices[:, 2]
    on = (radius > HOLE_MM + _EDGE_MM) & (radius < OUTER_MM - _EDGE_MM)
    errors, shares = [], []
    flat = np.mgrid[-OUTER_MM:OUTER_MM:0.5, -OUTER_MM:OUTER_MM:0.5].reshape(2, -1).T
    flat = flat[(np.hypot(*flat.T) > HOLE_MM + _EDGE_MM) & (np.hypot(*flat.T) < OUTER_MM - _EDGE_MM)]
    for sign in (-1, 1):
        own = on & (sign * z > 0)
        errors.append(sign * z[own] - THICKNESS_MM / 2)
        shares.append(np.mean(KDTree(vertices[own, :2]).query(flat)[0] < 1.0) if own.any() else 0.0)
    whole = trimesh.Trimesh(vertices, faces, process=False)
    middles = whole.triangles_center
    in_hole = np.hypot(middles[:, 0], middles[:, 1]) < HOLE_MM - _EDGE_MM
    closed = float(whole.area_faces[in_hole].sum())
    beyond = KDTree(points).query(vertices)[0] > 1.0
    rms = 1e3 * np.sqrt(np.mean(np.concatenate(errors) ** 2))
    thick = np.median(errors[0]) + np.median(errors[1])
    return [
        name,
        f"{len(vertices):,}",
        f"{rms:.1f}",
        f"{1e3 * thick:+.1f}",
        f"{100 * min(shares):.1f} %",
        f"{closed:.1f}",
        f"{100 * beyond.mean():.1f} %",
    ]


def draw(path: Path, meshes: dict[str, trimesh.Trimesh], points: np.ndarray) -> None:
    """Cuts through the middle of the hole."""
    figure, axes = plt.subplots(len(meshes), 1, figsize=(9, 2.2 * len(meshes)), sharex=True, layout="constrained")
    for ax, (name, made) in zip(np.atleast_1d(axes), meshes.items(), strict=True):
        near = np.abs(points[:, 0]) < 0.3
        ax.plot(points[near, 1], points[near, 2], ".", color="#bbbbbb", markersize=2, label="points")
        cut = trimesh.intersections.mesh_plane(made, [1.0, 0.0, 0.0], [0.05, 0.0, 0.0])
        for number, (start, end) in enumerate(np.asarray(cut)[:, :, 1:]):
            label = "mesh" if number == 0 else None
            ax.plot([start[0], end[0]], [start[1], end[1]], color="#2152ac", linewidth=1.2, label=label)
        ax.set(ylabel="Z / mm", title=name, ylim=(-2.2, 2.2))
    ax.set(xlabel="along the cut through the hole / mm")
    np.atleast_1d(axes)[0].legend(frameon=False, loc="center")
    figure.savefig(path)


def main(folder: Path, pictures: Path | None = None, *, write: bool = False) -> None:
    """Write the scenes; with a folder for pictures, evaluate the rendered scans instead."""
    if pictures is None:
        write_scenes(folder)
    else:
        judge(folder, pictures, write=write)


def judge(folder: Path, pictures: Path, *, write: bool) -> None:
    """Mesh both sides, print the table and draw the cut."""
    clouds = [side_cloud(folder, side) for side in SIDES]
    made = uwlts.mesh(*clouds, towards=[[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]])
    points = np.concatenate([cloud.points_mm for cloud in clouds])
    towards = np.repeat([[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]], [len(cloud) for cloud in clouds], axis=0)
    np.savez(folder / "mesh-plate-clear.npz", points=points, towards=towards)
    meshes = {"uwlts mesh": trimesh.Trimesh(made.vertices_mm, made.faces, process=False)}
    poisson = folder / "mesh-plate-clear.poisson.npz"
    if poisson.exists():
        saved = np.load(poisson)
        meshes["Open3D, screened Poisson"] = trimesh.Trimesh(saved["vertices"], saved["faces"], process=False)
    rows = [row(name, np.asarray(each.vertices), np.asarray(each.faces), points) for name, each in meshes.items()]
    head = ["mesh", "vertices", "rms, um", "thickness, um", "of both faces", "in the hole, mm2", "> 1 mm from points"]
    publish({"thin wall": table(head, rows)}, write=write)
    known = np.hypot(*made.vertices_mm[:, :2].T)
    on = (known > HOLE_MM + _EDGE_MM) & (known < OUTER_MM - _EDGE_MM)
    off = np.abs(np.abs(made.vertices_mm[on, 2]) - THICKNESS_MM / 2)
    print(
        f"stated {1e3 * np.sqrt(np.mean(made.std_mm[on] ** 2)):.1f} um, truth within 95 %: "
        f"{100 * np.mean(off <= 1.96 * made.std_mm[on]):.0f} %"
    )
    draw(pictures / "mesh-thin-wall.svg", meshes, points)


if __name__ == "__main__":
    App(help=__doc__, help_format="plaintext", default_command=main)()
