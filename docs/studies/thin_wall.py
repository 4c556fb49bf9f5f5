"""Rendered plate of 2 mm thickness with a hole, scanned from both sides.

It stands square to the laser. A known rotation by 180 deg about the scan's direction, as by a rotary table, shows its
back.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
import tomli_w
import trimesh
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


def write_plate(folder: Path) -> None:
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


def off_plate(vertices: np.ndarray) -> np.ndarray:
    """Return the distances (N,) of vertices from the nearer face, mm; NaN near and beyond the edges."""
    radius, z = np.hypot(vertices[:, 0], vertices[:, 1]), vertices[:, 2]
    on = (radius > HOLE_MM + _EDGE_MM) & (radius < OUTER_MM - _EDGE_MM)
    return np.where(on, np.abs(z) - THICKNESS_MM / 2, np.nan)
