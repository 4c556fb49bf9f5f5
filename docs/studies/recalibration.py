"""Recalibration of drawn sensors by rendered passes over scenes without an artefact, against the rendered truth.

    python -m docs.studies.recalibration --first 1000 --count 10 --kinds shifted,turned,robot --checks 10 --write

Each campaign draws a sensor, its water, its stage and the errors of the poses from the sensor's table [uncertainty],
renders passes over one of five scenes, and recalibrates the described sensor. Lengths are those between the mean true
points of two parts of a pass (along Y) and of two passes (along Z), in the sensor's coordinates, scaled to 100 mm.

Checks: the calibration by the shifted passes is checked by three further passes of the same sensor over another scene,
without and with a fault.
"""

import tempfile
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w
from cyclopts import App
from scipy.spatial.transform import Rotation

import twin
import uwlts
from docs.studies.result_tables import publish, table
from twin.scene.description import Scene
from uwlts.model.library import load_sensor, merge_tables, validate_description
from uwlts.model.parameter_keys import MediumIndex
from uwlts.model.placement import laser_pose
from uwlts.model.sensor import Sensor
from uwlts.recalibration.as_built import as_built
from uwlts.storage.capture import open_capture
from uwlts.storage.capture_writer import CaptureWriter
from uwlts.storage.truth import read_truth, truth_path

POSE_MM, POSE_DEG = 0.01, 0.005
PASSES = {"reference": (0.0, 0.0, 0.0), "shifted": (40.0, 0.0, 0.0), "lower": (0.0, 60.0, 0.0)}
"""Shift along Y and along Z, mm, and turn about Z, deg."""
TURNED = {"0": (0.0, 0.0, 0.0), "90": (0.0, 0.0, 90.0), "180": (0.0, 0.0, 180.0), "lower": (0.0, 60.0, 0.0)}
ROBOT_MM, ROBOT_DEG = 0.05, 0.02
FAULTS = ("none", "scene moved", "pose scale", "warmer", "mirrored")
CHECKED = ["fault", "checks", "doubted", "names the pass or the scale"]
HEAD = ["passes", "campaigns", "Y before", "after", "error / stated", "Z before", "after", "error / stated"]
HEAD += ["index before, 1e-5", "after", "error / stated", "doubted"]
UNCERTAINTY = {
    "window_distance_mm": 5.0,
    "window_tilt_deg": 0.3,
    "focal_length": 5e-4,
    "temperature_k": 3.0,
    "drift_k": 0.2,
    "sheet_offset_mm": 1.0,
    "sheet_turn_deg": 0.3,
    "stage_scale": 1e-4,
    "stage_alignment_deg": 0.3,
    "stage_position_mm": 0.005,
}
"""As built by a drawing."""


def describe_sensor() -> Sensor:
    """Return the described sensor."""
    plain = load_sensor("thesis-small")
    table = merge_tables(
        plain.model_dump(exclude_none=True),
        {"name": "drawn", "uncertainty": UNCERTAINTY, "media": {"water": {"temperature_c": 15.0}}},
    )
    return validate_description(Sensor, table, "drawn")


def draw_sensor(sensor: Sensor, rng: np.random.Generator) -> Sensor:
    """Return a sensor as it may be built."""
    known, camera, laser, pose = sensor.uncertainty, sensor.camera, sensor.laser, laser_pose(sensor)
    window, glass = camera.window, laser.window

    def near(value: float, std: float) -> float:
        return float(value + std * rng.standard_normal())

    turn = np.radians(known.sheet_turn_deg) * rng.standard_normal(2)
    rotation = Rotation.from_rotvec(turn[0] * pose.fan + turn[1] * pose.axis).as_matrix()
    middle = np.array([0.0, 0.0, 317.0])
    origin = rotation @ (pose.origin_mm - middle) + middle + near(0.0, known.sheet_offset_mm) * pose.normal
    axis = rotation @ pose.axis
    changes = {
        "camera": {
            "focal_length_mm": near(camera.focal_length_mm, (known.focal_length or 0.0) * camera.focal_length_mm),
            "window": {
                "distance_mm": near(window.distance_mm, known.window_distance_mm),
                "tilt_x_deg": near(0.0, known.window_tilt_deg),
                "tilt_y_deg": near(0.0, known.window_tilt_deg),
                "thickness_mm": near(window.thickness_mm, known.glass_thickness_mm),
                "glass": near(window.index(laser.wavelength_nm), known.glass_index),
            },
        },
        "laser": {
            "origin_mm": origin.tolist(),
            "axis": axis.tolist(),
            "roll_deg": near(laser.roll_deg, 0.0),
            "bow_deg": near(laser.bow_deg, known.bow_deg),
            "window": {"tilt_x_deg": near(glass.tilt_x_deg, 0.0)},
        },
    }
    table = sensor.model_dump(exclude_none=True)
    del table["laser"]["baseline_mm"], table["laser"]["triangulation_angle_deg"]
    return validate_description(Sensor, merge_tables(table, changes), "drawn")


def draw_scene(rng: np.random.Generator, kind: int) -> list[dict[str, object]]:
    """Return objects of one of five kinds: sea floor, corroded pipe, crossing pipes, weld, and rubble of shapes."""
    seed, turn = int(rng.integers(2**31)), float(rng.uniform(-20, 20))
    match kind:
        case 0:
            return [{"kind": "seabed", "width_mm": 240.0, "height_mm": 260.0, "seed": seed, "reflectance": 0.3}]
        case 1:
            pipe = {
                "kind": "pitted_pipe",
                "diameter_mm": 110.0,
                "length_mm": 180.0,
                "pits": 30,
                "pit_diameter_mm": 14.0,
            }
            pipe |= {
                "pit_depth_mm": 3.0,
                "seed": seed,
                "position_mm": [0.0, 0.0, 40.0],
                "rotation_deg": [0.0, 0.0, turn],
            }
            return [pipe | {"reflectance": 0.4}]
        case 2:
            pipe = {"kind": "pipe", "length_mm": 180.0, "position_mm": [0.0, 0.0, 50.0], "reflectance": 0.4}
            turns = {90.0: [0.0, 0.0, turn], 60.0: [0.0, 0.0, turn + 90.0]}
            return [pipe | {"diameter_mm": size, "rotation_deg": angles} for size, angles in turns.items()]
        case 3:
            weld = {"kind": "weld", "plate_mm": [120.0, 160.0], "beads": 3, "spacing_mm": 30.0, "along": "x"}
            weld |= {"length_mm": 110.0, "width_mm": 14.0, "height_mm": 4.0, "ripple_pitch_mm": 8.0}
            return [weld | {"ripple_height_mm": 0.4, "finish": "painted", "rotation_deg": [turn, 12.0, 15.0]}]
        case _:
            balls = [
                {"kind": "sphere", "diameter_mm": float(rng.uniform(25, 60)), "finish": "painted"}
                | {
                    "position_mm": [
                        float(rng.uniform(-45, 45)),
                        float(rng.uniform(-60, 60)),
                        float(rng.uniform(20, 40)),
                    ]
                }
                for _ in range(12)
            ]
            floor = {"kind": "seabed", "width_mm": 240.0, "height_mm": 260.0, "seed": seed, "reflectance": 0.3}
            return [floor | {"position_mm": [0.0, 0.0, 40.0]}, *balls]


def draw_campaign(seed: int) -> tuple[Sensor, np.random.Generator]:
    """Return the sensor of a campaign with its water, as built, and the generator of what else is drawn."""
    rng = np.random.default_rng([2026, seed])
    sensor = describe_sensor()
    built = draw_sensor(sensor, rng)
    off_k = float(rng.normal(0.0, sensor.uncertainty.temperature_k))
    media = {key: each if each.kind == "air" else each.warmer_by(off_k) for key, each in built.media.items()}
    return built.model_copy(update={"media": media}), rng


def passes_of(turned: bool) -> dict[str, np.ndarray]:
    """Return the nominal poses (4, 4) of the sensor in the scene's frame, by name."""
    poses = {}
    for name, (along_y, lower, deg) in (TURNED if turned else PASSES).items():
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_euler("z", deg, degrees=True).as_matrix()
        pose[:3, 3] = (0.0, along_y, lower)
        poses[name] = pose
    return poses


def record(
    seed: int, folder: Path, *, turned: bool = False, later: bool = False, warmer: bool = False
) -> tuple[list[Path], np.ndarray]:
    """Render the passes of a campaign; return the captures and their stated poses (K, 4, 4).

    ``later`` passes of the same sensor see another scene. The second pass may be in ``warmer`` water, by 5 K.
    """
    sensor = describe_sensor()
    built, rng = draw_campaign(seed)
    objects, count = draw_scene(rng, seed % 5), 61
    scale = rng.normal(0.0, sensor.uncertainty.stage_scale)
    lean = np.tan(np.radians(sensor.uncertainty.stage_alignment_deg)) * rng.standard_normal(2)
    if later:
        rng = np.random.default_rng([2026, seed, 1])
        objects = draw_scene(rng, (seed + 1) % 5)
    captures, stated = [], []
    for number, (name, pose) in enumerate(passes_of(turned).items()):
        stated.append(pose)
        error = np.eye(4)
        error[:3, :3] = Rotation.from_rotvec(POSE_DEG * rng.standard_normal(3), degrees=True).as_matrix()
        error[:3, 3] = POSE_MM * rng.standard_normal(3)
        scaled = pose.copy()
        scaled[:3, 3] *= 1.0 + scale
        true = error @ scaled
        hot = 5.0 if warmer and number == 1 else 0.0
        whole = np.linalg.inv(true)
        media = {key: each if each.kind == "air" else each.warmer_by(hot) for key, each in built.media.items()}
        position = np.linspace(-45.0, 45.0, count)
        off = scale * position + sensor.uncertainty.stage_position_mm * rng.standard_normal(count)
        table = {
            "title": "passes",
            "medium": "water",
            "motion": {
                "start_mm": -45.0,
                "step_mm": 1.5,
                "count": count,
                "direction": [1.0, *lean.tolist()],
                "nominal_direction": [1.0, 0.0, 0.0],
                "position_errors_mm": off.tolist(),
            },
            "objects": objects,
            "placements": {
                "standoff": {
                    "position_mm": whole[:3, 3].tolist(),
                    "rotation_deg": Rotation.from_matrix(whole[:3, :3]).as_euler("xyz", degrees=True).tolist(),
                }
            },
        }
        out = folder / f"{seed}{'-later' * later}-{name}{'-warmer' * bool(hot)}.h5"
        captures.append(out)
        if out.exists():
            continue
        twin.simulate(
            validate_description(Scene, table, "passes"),
            out=out,
            sensor=sensor,
            as_built=built.model_copy(update={"media": media}),
            seed=seed * 10 + number,
            spp=8,
            water="clear",
            overwrite=True,
        )
    return captures, np.array(stated)


def measure(captures: list[Path], found: uwlts.Calibration) -> dict[str, float]:
    """Return the mean errors, mm, of lengths along Y and Z, scaled to 100 mm, against the true points."""
    parts = []
    for path in (captures[0], captures[-1]):
        with open_capture(path) as capture:
            truth = read_truth(truth_path(path))[1]
            cloud = uwlts.reconstruct(capture, found, with_uncertainty=False)
            travel = capture.stage_mm[cloud.frame][:, None] * np.array(found.stage_direction_of((1.0, 0.0, 0.0)))
        pose = truth.pose[cloud.frame]
        true = np.einsum("nji,nj->ni", pose[:, :3, :3], truth.point_mm[cloud.frame, cloud.line] - pose[:, :3, 3])
        good = np.isfinite(true).all(axis=1) & (truth.crossings[cloud.frame, cloud.line] == 1)
        parts.append((cloud.points_mm[good] - travel[good], true[good]))
    (high, high_true), (low, low_true) = parts
    low_y, high_y = np.quantile(high_true[:, 1], [0.1, 0.9])
    lower, upper = high_true[:, 1] < low_y, high_true[:, 1] > high_y
    along_y = np.mean(high[upper], axis=0)[1] - np.mean(high[lower], axis=0)[1]
    true_y = np.mean(high_true[upper], axis=0)[1] - np.mean(high_true[lower], axis=0)[1]
    along_z = np.mean(low, axis=0)[2] - np.mean(high, axis=0)[2]
    true_z = np.mean(low_true, axis=0)[2] - np.mean(high_true, axis=0)[2]
    return {"Y": 100.0 * (along_y - true_y) / true_y, "Z": 100.0 * (along_z - true_z) / true_z}


def run(seed: int, folder: Path, kind: str) -> dict[str, Any]:
    """Return ``rows`` of axis, error and stated uncertainty before and after, mm, the ``doubts``, and what was found.

    The row "index" is that of the water's index, times 10^5.

    A ``robot`` moves the shifted passes, or the turned ones (``turned robot``), but states poses with errors of 0.05 mm
    and 0.02 deg.
    """
    captures, poses = record(seed, folder, turned="turned" in kind)
    mm, deg = (ROBOT_MM, ROBOT_DEG) if "robot" in kind else (POSE_MM, POSE_DEG)
    if "robot" in kind:
        rng = np.random.default_rng([2026, seed, 2])
        for pose in poses:
            turn = np.sqrt(ROBOT_DEG**2 - POSE_DEG**2) * rng.standard_normal(3)
            pose[:3, :3] = Rotation.from_rotvec(turn, degrees=True).as_matrix() @ pose[:3, :3]
            pose[:3, 3] += np.sqrt(ROBOT_MM**2 - POSE_MM**2) * rng.standard_normal(3)
    sensor, described = describe_sensor(), folder / "described.toml"
    described.write_text(tomli_w.dumps(sensor.model_dump(exclude_none=True)), encoding="utf-8")
    try:
        found = uwlts.recalibrate(captures, calibration=described, poses=poses, pose_std_mm=mm, pose_std_deg=deg)
    except uwlts.Error as error:
        return {"rows": [], "doubts": (f"refused: {error}",)}
    before, after = (measure(captures, each) for each in (as_built(sensor, sensor.media["water"]), found.calibration))
    rows = [(each.axis, before[each.axis], each.before_mm, after[each.axis], each.after_mm) for each in found.lengths]
    true = draw_campaign(seed)[0].media["water"].refractive_index(sensor.laser.wavelength_nm)
    for each in found.parameters:
        if isinstance(each.key, MediumIndex):
            rows.append(
                ("index", *(1e5 * v for v in (each.before - true, each.std_before, each.after - true, each.std)))
            )
    return {"rows": rows, "doubts": found.doubts, "calibration": found.calibration}


def check(seed: int, folder: Path, calibration: uwlts.Calibration, fault: str) -> tuple[str, ...]:
    """Return the doubts about later passes of the same sensor with a fault; the second pass has it."""
    captures, poses = record(seed, folder, later=True, warmer=fault == "warmer")
    if fault == "scene moved":
        poses[1, :3, 3] += 0.1 * np.array([0.6, 0.0, 0.8])
    if fault == "pose scale":
        poses[:, :3, 3] /= 1.001
    if fault == "mirrored":
        mirrored = folder / f"{seed}-mirrored.h5"
        with (
            open_capture(captures[1]) as plain,
            CaptureWriter(mirrored, plain.header, dtype=np.dtype(np.uint8)) as writer,
        ):
            for frame in map(plain.__getitem__, range(len(plain))):
                writer.append(replace(frame, image=np.ascontiguousarray(frame.image[:, ::-1])))
        captures[1] = mirrored
    try:
        found = uwlts.recalibrate(
            captures, calibration=calibration, poses=poses, pose_std_mm=POSE_MM, pose_std_deg=POSE_DEG
        )
    except uwlts.Error as error:
        return (f"refused: {error}",)
    finally:
        if fault == "mirrored":
            captures[1].unlink()
    return found.doubts


def is_named(fault: str, doubts: tuple[str, ...]) -> bool:
    """Return whether a doubt names the pass with the fault, or the scale."""
    words = ("scale",) if fault == "pose scale" else ("shifted", "mirrored.h5")
    return any(word in doubt for doubt in doubts for word in words)


def summarise(kind: str, results: list[dict[str, Any]]) -> list[str]:
    """Return the row of a kind of campaigns, with the errors along both axes and of the index."""
    cells = [kind, str(len(results))]
    for axis in ("Y", "Z", "index"):
        own = np.array([row[1:] for result in results for row in result["rows"] if row[0] == axis]).reshape(-1, 4)
        rms = np.sqrt(np.mean(own**2, axis=0))
        ratio = own[:, 2] / own[:, 3]
        cells += [f"{each:.1f}" if axis == "index" else f"{each:.3f}" for each in rms[::2]]
        cells.append(f"{np.sqrt(np.mean(ratio**2)):.2f}")
    return [*cells, f"{sum(bool(result['doubts']) for result in results)} of {len(results)}"]


app = App(help=__doc__)


@app.default
def main(
    *,
    first: int = 0,
    count: int = 10,
    kinds: str = "shifted",
    checks: int = 0,
    keep: Path | None = None,
    name: str = "by passes",
    write: bool = False,
) -> None:
    """Run campaigns of kinds (shifted, turned, robot, turned robot) and checks with each fault; publish the tables."""
    rows, doubts = [], {fault: list[tuple[str, ...]]() for fault in FAULTS}
    for kind in kinds.split(","):
        results = []
        for seed in range(first, first + count):
            of_kind = "turned" if "turned" in kind else "shifted"
            with (
                tempfile.TemporaryDirectory() if keep is None else nullcontext(str(keep / of_kind / str(seed))) as made
            ):
                folder = Path(made)
                folder.mkdir(parents=True, exist_ok=True)
                results.append(run(seed, folder, kind))
                print(kind, seed, results[-1]["rows"], results[-1]["doubts"], flush=True)
                if kind == "shifted" and seed < first + checks and results[-1]["rows"]:
                    for fault in FAULTS:
                        doubts[fault].append(check(seed, folder, results[-1]["calibration"], fault))
                        print(fault, seed, doubts[fault][-1], flush=True)
        rows.append(summarise(kind, results))
    found = [
        [fault, str(len(each)), f"{sum(map(bool, each))} of {len(each)}"]
        + ["" if fault == "none" else f"{sum(is_named(fault, own) for own in each)} of {len(each)}"]
        for fault, each in doubts.items()
    ]
    tables = {f"recalibration {name}": table(HEAD, rows)} | (
        {f"checks {name}": table(CHECKED, found)} if checks else {}
    )
    publish(tables, write=write)


if __name__ == "__main__":
    app()
