"""Predictions for drawn sensors, against the errors and detection limits of other campaigns.

    python -m docs.studies.prediction runs/prediction --sensors 30 --write
    python -m docs.studies.prediction runs/steps --sensors 24 --first-seed 8400 --scans step-scan
    python -m docs.studies.prediction detection runs/detection --write

Lens, baseline, angle, window and water of each sensor are drawn, and the deviations of the built sensor. Two campaigns
are rendered with imperfections of the sizes that the sensor states. Each one predicts the other: its stated uncertainty
is compared with the other's errors, and its a90 with the other's. Sensors that are in the folder are kept.
"""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w
from cyclopts import App

import twin
from docs.studies.result_tables import publish, table
from twin.design.sensor_arrays import adjust_to_standoff, extract_parameters
from twin.experiments.result import ExperimentResult
from twin.scene.description import load_scene
from uwlts.errors import Error
from uwlts.model.library import load_sensor, merge_tables, validate_description
from uwlts.model.sensor import Sensor, Table

CAMPAIGNS = 2
IMAGE = {"width_px": 480, "height_px": 384}
AIR = {"start_mm": -95.0, "step_mm": 27.0, "count": 8}
WATER = {"start_mm": -70.0, "step_mm": 20.0, "count": 8}
PLACES = {"near": {"position_mm": [0.0, 0.0, -30.0]}, "far": {"position_mm": [0.0, 0.0, 50.0]}}
CALIBRATIONS: list[dict[str, Any]] = [
    {"name": "target-bare", "scene": "target", "motion": AIR},
    {"name": "target-air", "scene": "target-through-window", "motion": AIR},
    {"name": "target-water", "scene": "target-through-window", "media": ["water"], "motion": WATER},
    {"scene": "step.toml", "placements": ["near", "far"]},
]
SCANS: list[dict[str, Any]] = [
    {"name": "spheres-near", "scene": "spheres.toml", "placements": ["near"]},
    {"name": "spheres-far", "scene": "spheres.toml", "placements": ["far"]},
    {"name": "step-scan", "scene": "step-scan", "motion": {"step_mm": 2.0, "count": 11}},
    {"name": "pipe-around", "scene": "pipe-around"},
    {"name": "pits", "scene": "pits.toml", "motion": {"start_mm": -24.0, "step_mm": 1.0, "count": 49}},
    {"name": "undercut", "scene": "undercut", "motion": {"step_mm": 2.0, "count": 13}},
]
UNCERTAINTY = {
    "window_distance_mm": 7.0,
    "window_tilt_deg": 0.1,
    "laser_window_tilt_deg": 0.1,
    "bow_deg": 0.1,
    "stage_alignment_deg": 0.1,
    # The target of the scenes is matt.
    "target_stripe_px": 0.02,
}
"""Stated uncertainties that differ from those of the thesis's sensor: those of the deviations drawn here."""
IMPERFECTIONS = {"target_stretch_std": 1e-4, "glass_thickness_std_mm": 0.05, "glass_index_std": 1e-3, "waist_std": 0.1}
"""Imperfections in addition to those of the thesis's campaign: those that the sensor states by default."""
_PIPE = load_scene("pits").objects[0]
SCENES = {
    "step": {"base": "step", "placements": PLACES},
    "pits": {
        "base": "pits",
        "objects": [_PIPE.model_dump(mode="json", exclude_none=True) | {"pit_depth_mm": [0.05, 0.6]}],
    },
    "spheres": {
        "base": "spheres",
        "placements": PLACES,
        "placement": "near",
        "motion": {"start_mm": -18.0, "step_mm": 4.0, "count": 10},
    },
}


def draw(seed: int) -> tuple[Sensor, Sensor, float]:
    """Return a sensor as described and as built, and the turbidity of its water."""
    rng = np.random.default_rng([1823, seed])
    camera_mm, angle_deg = rng.uniform(300.0, 480.0), rng.uniform(27.0, 42.0)
    view_mm = rng.uniform(185.0, 215.0)
    window = {"distance_mm": rng.uniform(25.0, 70.0), "thickness_mm": rng.uniform(4.0, 10.0)}
    camera = IMAGE | {
        # 4.6875 mm see 185 mm at 378.5 mm.
        "focal_length_mm": 4.6875 * camera_mm / 378.5 * 185.0 / view_mm,
        "f_number": float(rng.choice([4.0, 5.6])),
        "window": window | {"tilt_x_deg": rng.uniform(-4.0, 4.0)},
    }
    laser = {
        "baseline_mm": camera_mm * math.tan(math.radians(angle_deg)),
        "triangulation_angle_deg": angle_deg,
        # Stripes narrower than a pixel are refused as hot pixels.
        "waist_radius_mm": 1.1 * view_mm / IMAGE["width_px"],
    }
    turbidity = rng.uniform(0.0, 2.0)
    changes: Table = {
        "name": f"drawn-{seed}",
        "notes": "",
        "camera": camera,
        "laser": laser,
        "uncertainty": UNCERTAINTY,
    }
    plain = validate_description(Sensor, merge_tables(load_sensor("thesis-small").model_dump(), changes), "drawn")
    fitted = adjust_to_standoff(np, extract_parameters([plain], [plain.medium("water")]), ("focus", "waist", "volume"))
    placed: Table = {
        "camera": {"focus_distance_mm": fitted.focus_mm.item()},
        "laser": {"waist_distance_mm": fitted.waist_distance_mm.item()},
        "volume": {"near_mm": fitted.near_mm.item(), "far_mm": fitted.far_mm.item()},
    }
    sensor = validate_description(Sensor, merge_tables(plain.model_dump(), placed), "drawn")
    off = rng.standard_normal(12).tolist()
    centre = [IMAGE["width_px"] / 2 + 3.0 * off[0], IMAGE["height_px"] / 2 + 3.0 * off[1]]
    deviations: Table = {
        "camera": {
            "focal_length_mm": camera["focal_length_mm"] * (1 + 0.02 * off[2]),
            "principal_point_px": centre,
            "distortion": {
                "k1": -0.06 + 0.03 * off[3],
                "k2": 0.06 + 0.03 * off[4],
                "p1": 5e-4 * off[10],
                "p2": 5e-4 * off[11],
            },
            "window": {"distance_mm": max(window["distance_mm"] + 7.0 * off[5], 15.0)},
        },
        "laser": {
            "baseline_mm": laser["baseline_mm"] + 0.8 * off[6],
            "triangulation_angle_deg": angle_deg + 0.15 * off[7],
            "roll_deg": 0.2 * off[8],
            "window": {"tilt_y_deg": 0.1 * off[9]},
        },
    }
    return sensor, validate_description(Sensor, merge_tables(sensor.model_dump(), deviations), "built"), turbidity


def predict(folder: Path, seed: int, scans: tuple[str, ...] = ()) -> dict[str, Any]:
    """Render and evaluate the campaigns of a drawn sensor; return a prediction of each, or why one failed.

    Of the scans, those named are recorded; by default all.
    """
    place = folder / f"sensor-{seed}"
    place.mkdir(parents=True, exist_ok=True)
    sensor, built, turbidity = draw(seed)
    for name, described in {"sensor": sensor, "built": built}.items():
        text = tomli_w.dumps(described.model_dump(mode="json", exclude_none=True))
        (place / f"{name}.toml").write_text(text, encoding="utf-8")
    for name, scene in SCENES.items():
        (place / f"{name}.toml").write_text(tomli_w.dumps(scene), encoding="utf-8")
    campaign = {"base": "thesis", "title": f"drawn {seed}", "sensor": "sensor.toml", "as_built": "built.toml"}
    campaign |= {"water": turbidity, "imperfections": IMPERFECTIONS}
    campaign["recordings"] = [*CALIBRATIONS, *(each for each in SCANS if each["name"] in scans or not scans)]
    (place / "campaign.toml").write_text(tomli_w.dumps(campaign), encoding="utf-8")
    drawn = {"seed": seed, "sensor": sensor.model_dump(mode="json"), "turbidity": turbidity}
    try:
        found = [
            twin.predict(
                campaign=place / "campaign.toml", out=place / "out", campaigns=1, first=first, spp=8, workers=1
            )
            for first in range(CAMPAIGNS * seed, CAMPAIGNS * (seed + 1))
        ]
    except Error as error:
        return drawn | {"failure": str(error)}
    return drawn | {"predictions": [each.model_dump(mode="json") for each in found]}


def figure_of(name: str, scan: str) -> str:
    """Return the kind of a figure."""
    if name.startswith("diameter error"):
        return "pipe diameter, five sides" if scan == "pipe-around" else "sphere diameter"
    kinds = {"SSE": "sphere spacing", "height": "step height"}
    kinds |= {"ovality": "ovality of the pipe", "depth": f"depth of {scan}"}
    return next(words for start, words in kinds.items() if name.startswith(start))


def compare_errors(sensors: list[list[ExperimentResult]]) -> dict[str, np.ndarray]:
    """Return errors and the other campaign's uncertainties (K, 2) in mm by kind of figure; k = 2."""
    pairs: dict[str, list[tuple[float, float]]] = {}
    for predictions in sensors:
        for own, other in (predictions, predictions[::-1]):
            stated = {(each.scan, each.name): each.stated_mm for each in own.table.errors()}
            for each in other.table.errors():
                if (u := stated.get((each.scan, each.name))) is not None and "known" not in each.name:
                    pairs.setdefault(figure_of(each.name, each.scan), []).extend((e, u) for e in each.errors_mm)
    return {kind: np.array(some) for kind, some in pairs.items()}


def error_rows(pairs: dict[str, np.ndarray]) -> list[list[str]]:
    """Return the rows of the table of errors; the last one contains all."""
    rows = []
    for kind, some in (*pairs.items(), ("all", np.concatenate(list(pairs.values())))):
        error, u = some.T
        ratio = error / (u / 2)
        rms, inside = np.sqrt(np.mean(ratio**2)), np.mean(np.abs(error) <= u)
        rows.append([kind, f"{len(some)}", f"{np.sqrt(np.mean(u**2)):.3f}", f"{rms:.2f}", f"{100 * inside:.1f}"])
    return rows


def detection_cells(sensors: list[list[ExperimentResult]]) -> list[str]:
    """Return the cells of the table of pits: sensors, pits in a campaign, and found relative to predicted a90."""
    ratios, scaled, counts = [], [], []
    for predictions in sensors:
        first, second = (next(each for each in p.detections if each.flaw == "pit") for p in predictions)
        counts += [len(each.found) for each in (first, second)]
        (a90, bound), (other, other_bound) = ((each.a90_mm, each.a90_95_mm) for each in (first, second))
        if a90 is None or bound is None or other is None or other_bound is None:
            continue
        ratios.append(math.log(other / a90))
        # A bound at 95 % is 1.645 standard deviations away.
        scaled.append(1.645 * ratios[-1] / math.hypot(math.log(bound / a90), math.log(other_bound / other)))
    within = sum(1 / 1.2 <= math.exp(ratio) <= 1.2 for ratio in ratios)
    print(f"ln(found / predicted) / its standard uncertainty: rms {np.sqrt(np.mean(np.square(scaled))):.2f}")
    ratio = f"{math.exp(float(np.mean(ratios))):.2f}"
    return [f"{len(ratios)}", f"{min(counts)} to {max(counts)}", ratio, f"{within} of {len(ratios)}"]


def main(
    folder: Path, *, sensors: int = 30, first_seed: int = 8000, scans: tuple[str, ...] = (), write: bool = False
) -> None:
    """Render and compare; with `--write`, put the tables into their page. With ``scans``, only these are recorded."""
    folder.mkdir(parents=True, exist_ok=True)
    found = []
    for seed in range(first_seed, first_seed + sensors):
        path = folder / f"{seed}.json"
        if not path.exists():
            path.write_text(json.dumps(predict(folder, seed, scans)), encoding="utf-8")
        found.append(json.loads(path.read_text(encoding="utf-8")))
        print(seed, found[-1].get("failure", "done"), flush=True)
    done = [
        [ExperimentResult.model_validate(each) for each in sensor["predictions"]]
        for sensor in found
        if "failure" not in sensor
    ]
    head = ["figure", "errors", "U predicted, mm", "error / stated, rms", "within U, %"]
    tables = {"prediction": table(head, error_rows(compare_errors(done)))}
    if not scans:
        head = ["sensors", "pits in a campaign", "a90 found / predicted, mean", "within 20 %"]
        tables["prediction of a90"] = table(head, [detection_cells(done)])
    publish(tables, write=write)


def detect(folder: Path, *, every: int = 2, write: bool = False) -> None:
    """Print the probability of detection with the small sensor in two waters; with `--write`, put it into its page."""
    rows = []
    for water in ("clear", "coastal"):
        found = twin.predict(
            "thesis-small",
            campaign="detection",
            water=water,
            out=folder / water,
            campaigns=1,
            every=every,
            spp=8,
            workers=1,
        )
        for each in found.detections:
            hits = f"{sum(each.found)} of {len(each.found)}"
            depths = ("-" if depth is None else f"{depth:.3f}" for depth in (each.a90_mm, each.a90_95_mm))
            flaw = f"{each.flaw}s, {each.width_mm:g} mm wide"
            rows.append([water, flaw, hits, f"{each.false_calls}", *depths])
    head = ["water", "flaws", "found", "false calls", "a90, mm", "a90/95, mm"]
    publish({"detection of flaws": table(head, rows)}, write=write)


if __name__ == "__main__":
    app = App(help=__doc__, help_format="plaintext", default_command=main)
    app.command(detect, name="detection")
    app()
