"""Objects of known shape for the study of inspections, as meshes and scenes, and the campaigns that render them.

The objects are a pipe of 300 mm diameter and 0.5 % ovality, and welds. The pipe is smooth, has a grid of small pits, or
has large pits; one is seen from six sides. All surfaces are known in closed form (`radius_mm`).
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w
import trimesh

import twin
import uwlts

DIAMETER_MM, OVALITY, AXIS_Z_MM = 300.0, 0.005, 150.0
OVAL_AT = np.radians(20.0)
"""Direction of the largest diameter, from -z towards y."""
SAG_MM = 0.002
"""Largest distance of facets from the surface, a tenth of the points' noise."""
SIDES_DEG = tuple(range(0, 360, 60))
WATERS = ("clear", "coastal")


@dataclass(frozen=True)
class Pits:
    """Pits (P,): positions along the axis and along the round pipe's circumference, diameters and depths, mm."""

    along: np.ndarray
    around: np.ndarray
    diameter: np.ndarray
    depth: np.ndarray


NO_PITS = Pits(*(np.zeros(0) for _ in range(4)))


def small_pits(draw: int = 0) -> Pits:
    """Return a grid of pits of 2, 3 and 5 mm diameter, with depths from 0.006 to 0.4 mm in equal logarithmic steps."""
    along, around = np.meshgrid(7.0 * np.arange(-4, 5), 7.0 * (np.arange(22) - 10.5), indexing="ij")
    count, rng = along.size, np.random.default_rng(21 + draw)
    order = rng.permutation(count)
    diameter = np.array([2.0, 3.0, 5.0])[order % 3]
    depth = np.exp(np.interp((order // 3 + rng.random(count)) / (count / 3), [0, 1], np.log([0.006, 0.4])))
    shift = rng.uniform(-0.7, 0.7, (2, count))
    return Pits(along.ravel() + shift[0], around.ravel() + shift[1], diameter, depth)


def large_pits(draw: int = 0) -> Pits:
    """Return separate pits of 0.3 to 5 mm depth, as left by corrosion."""
    along = [-18.0, 16.0, -14.0, 12.0, -17.0, 15.0, 0.0, -1.0, 2.0]
    around = [-58.0, -55.0, -22.0, -18.0, 22.0, 24.0, 52.0, 0.0, -40.0]
    diameter = [10.0, 16.0, 20.0, 14.0, 24.0, 12.0, 18.0, 3.0, 5.0]
    depth = [1.0, 2.0, 3.0, 4.0, 5.0, 0.5, 1.5, 0.3, 0.4]
    pits = Pits(*(np.array(each, float) for each in (along, around, diameter, depth)))
    if draw:
        rng = np.random.default_rng(draw)
        pits = Pits(
            pits.along, pits.around, *(each * rng.uniform(0.8, 1.05, 9) for each in (pits.diameter, pits.depth))
        )
    return pits


def welds(draw: int = 0) -> list[dict[str, Any]]:
    """Return welds with undercuts: a standard one, and random ones if the draw is not 0."""
    weld = {"kind": "weld", "beads": 1, "plate_mm": [80.0, 120.0], "length_mm": 60.0, "width_mm": 12.0}
    weld |= {"height_mm": 2.0, "undercut_depth_mm": 0.5, "undercut_width_mm": 2.5, "finish": "painted"}
    rng, result = np.random.default_rng(draw), [weld]
    for seed in range(1, 1 + (5 if draw else 0)):
        ranges = {"width_mm": (9, 14), "height_mm": (1.2, 2.5), "irregularity": (0.02, 0.1)}
        ranges |= {"undercut_depth_mm": (0.2, 0.9), "undercut_width_mm": (1.8, 3.2)}
        drawn = {name: float(rng.uniform(*ends)) for name, ends in ranges.items()}
        result.append(weld | drawn | {"seed": 10 * draw + seed})
    return result


def radius_mm(along: np.ndarray, angle: np.ndarray, pits: Pits) -> np.ndarray:
    """Return the distance from the axis at positions along it and angles from -z to y; pits are depth (1 - t^2)^2."""
    loss = np.zeros(np.broadcast(along, angle).shape)
    for x, s, diameter, depth in zip(pits.along, pits.around, pits.diameter, pits.depth, strict=True):
        t2 = ((along - x) ** 2 + (DIAMETER_MM / 2 * angle - s) ** 2) / (diameter / 2) ** 2
        loss = np.maximum(loss, depth * np.maximum(1 - t2, 0) ** 2)
    return DIAMETER_MM / 2 * (1 + OVALITY / 2 * np.cos(2 * (angle - OVAL_AT))) - loss


def pipe_mesh(pits: Pits, *, half_length: float, half_arc: float | None) -> trimesh.Trimesh:
    """The pipe, or its front within an arc, as triangles fine enough for its pits."""
    plain = np.sqrt(8 * SAG_MM * DIAMETER_MM / 2)
    step = plain
    if len(pits.depth):
        bend = float(np.max(8 * pits.depth / (pits.diameter / 2) ** 2))
        step = float(np.clip(np.sqrt(8 * SAG_MM / bend), 0.1, 0.2))
    half_angle = np.pi if half_arc is None else 2 * half_arc / DIAMETER_MM
    angle = np.linspace(-half_angle, half_angle, int(np.ceil(half_angle * DIAMETER_MM / step)) + 1)
    x = np.linspace(-half_length, half_length, int(np.ceil(2 * half_length / step)) + 1 if len(pits.depth) else 2)
    along, around = np.meshgrid(x, angle, indexing="ij")
    radius = radius_mm(along, around, pits)
    vertices = np.stack([along, radius * np.sin(around), -radius * np.cos(around)], axis=-1).reshape(-1, 3)
    corner = np.arange(along.size).reshape(along.shape)
    a, b, c, d = (each.ravel() for each in (corner[:-1, :-1], corner[:-1, 1:], corner[1:, 1:], corner[1:, :-1]))
    faces = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    return trimesh.Trimesh(vertices, faces, process=False)


def _scene(title: str, thing: dict[str, Any], motion: dict[str, Any]) -> dict[str, Any]:
    return {"title": title, "medium": "water", "motion": motion, "objects": [thing]}


def scenes(folder: Path, draw: int = 0) -> dict[str, dict[str, Any]]:
    """Scenes by their names; the meshes are written into the folder."""

    def pipe(mesh: str, turn_deg: float = 0.0) -> dict[str, Any]:
        place = {"position_mm": [0.0, 0.0, AXIS_Z_MM], "rotation_deg": [turn_deg, 0.0, 0.0]}
        return {"kind": "mesh", "path": f"{mesh}.ply", "reflectance": 0.4} | place

    for name, pits, half_length, half_arc in (
        ("pipe-before", NO_PITS, 60.0, None),
        ("pipe-after", small_pits(draw), 36.0, 105.0),
        ("pipe-corroded", large_pits(draw), 36.0, 105.0),
    ):
        pipe_mesh(pits, half_length=half_length, half_arc=half_arc).export(folder / f"{name}.ply")
    found = {
        "pipe-before": _scene("Pipe", pipe("pipe-before"), {"start_mm": -15.0, "step_mm": 0.5, "count": 61}),
        "pipe-after": _scene("Small pits", pipe("pipe-after"), {"start_mm": -32.0, "step_mm": 0.5, "count": 129}),
        "pipe-corroded": _scene("Pits", pipe("pipe-corroded"), {"start_mm": -31.5, "step_mm": 1.0, "count": 64}),
    }
    for side in SIDES_DEG:
        motion = {"start_mm": -20.0, "step_mm": 10.0, "count": 5}
        found[f"pipe-side-{side}"] = _scene(f"Pipe turned by {side} deg", pipe("pipe-before", side), motion)
    for number, weld in enumerate(welds(draw)):
        motion = {"start_mm": -25.0, "step_mm": 1.0, "count": 51}
        found[f"weld-{number}" if number else "weld"] = _scene("Weld with undercut", weld, motion)
    return found


def record(folder: Path, draw: int) -> None:
    """Write meshes, scenes and campaigns, render them, and calibrate; what is there is used."""
    folder.mkdir(parents=True, exist_ok=True)
    names = scenes(folder, draw)
    for water in WATERS:
        for name, scene in names.items():
            (folder / f"{name}-{water}.toml").write_text(tomli_w.dumps({"water": water} | scene), encoding="utf-8")
        recordings = [{"name": name, "scene": f"{name}-{water}.toml"} for name in names]
        campaign = {"base": "thesis", "title": f"inspection, {water}", "recordings": recordings}
        (folder / f"{water}.toml").write_text(tomli_w.dumps(campaign), encoding="utf-8")
    axial = {"direction": [0.0, 0.0, 1.0], "start_mm": -126.0, "step_mm": 17.6, "count": 12}
    calibration = [
        {"name": "target-bare", "scene": "target", "motion": {"step_mm": 18.0, "count": 16}},
        {"name": "target-air", "scene": "target-through-window", "motion": {"step_mm": 18.0, "count": 16}},
        {"name": "target-water", "scene": "target-through-window", "media": ["water"]}
        | {"motion": axial | {"lights": ["lamp", "laser"]}},
        {"scene": "step", "placements": ["near", "standoff", "far"]},
    ]
    campaign = {"base": "thesis", "title": "inspection, calibration", "recordings": calibration}
    (folder / "calibration.toml").write_text(tomli_w.dumps(campaign), encoding="utf-8")
    for name in ("calibration", *WATERS):
        twin.record(folder / f"{name}.toml", out=folder / name, seed=draw)
    if not (path := folder / "calibration" / "calibration.json").exists():
        views = {name: [folder / "calibration" / f"target-{name}.h5"] for name in ("bare", "air", "water")}
        steps = [folder / "calibration" / f"step-{place}-water.h5" for place in ("near", "standoff", "far")]
        uwlts.calibrate(air=views["bare"] + views["air"], water=views["water"], step=steps).save(path)


def cloud_of(folder: Path, water: str, name: str) -> uwlts.PointCloud:
    """Return the cloud of a recording, reconstructed once."""
    path = folder / water / f"{name}.cloud.h5"
    if not path.exists():
        cloud = uwlts.reconstruct(folder / water / f"{name}.h5", folder / "calibration" / "calibration.json")
        cloud.save(path)
    cloud = uwlts.read(path)
    assert isinstance(cloud, uwlts.PointCloud)
    return cloud
