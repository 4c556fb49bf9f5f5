"""Recordings for the studies of moving sensors: sensors with imperfections, their calibrations, and their scans.

The images of a joint calibration are rendered for each sensor and calibrated, in FOLDER/sensor-SENSOR. Then each scene
is rendered once for each seed of the platform's errors, to FOLDER/sensor-SENSOR/SCENE-SEED.h5. ``--denser N``
multiplies the number of images on straight paths by N:

    python docs/studies/moving_recordings.py FOLDER robot-sphere --sensors 1 2 3 4 5 --seeds 0 1
"""

import argparse
from itertools import pairwise
from pathlib import Path

import numpy as np

import twin
import uwlts
from twin.rendering_options import CPU, Options, use_variant
from twin.scene.campaign import list_takes, load_campaign
from twin.scene.description import load_scene

CAMPAIGN = """
base = "thesis"
title = "Calibration of a sensor"
recordings = [
    { name = "target-bare", scene = "target", motion = { step_mm = 18.0, count = 16 } },
    { name = "target-air", scene = "target-through-window", motion = { step_mm = 18.0, count = 16 } },
    { name = "target-water", scene = "target-through-window", media = ["water"], motion = { \
direction = [0.0, 0.0, 1.0], start_mm = -126.0, step_mm = 17.6, count = 12, lights = ["lamp", "laser"] } },
    { scene = "step", placements = ["near", "standoff", "far"] },
]
"""


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("folder", type=Path)
    parser.add_argument("scenes", nargs="+")
    parser.add_argument("--sensors", type=int, nargs="+", required=True)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--sensor", default="thesis")
    parser.add_argument("--denser", type=int, default=1)
    given = parser.parse_args()
    given.folder.mkdir(parents=True, exist_ok=True)
    plan = given.folder / "calibration.toml"
    plan.write_text(f'sensor = "{given.sensor}"\nas_built = "{given.sensor}-as-built"\n{CAMPAIGN}')
    for number in given.sensors:
        folder = given.folder / f"sensor-{number}"
        if not (folder / "calibration.json").exists():
            twin.record(plan, out=folder, seed=number, workers=1)
            calibration = uwlts.calibrate(
                air=[folder / "target-bare.h5", folder / "target-air.h5"],
                water=[folder / "target-water.h5"],
                step=sorted(path for path in folder.glob("step-*.h5") if ".truth." not in path.name),
            )
            calibration.save(folder / "calibration.json")
        take = list_takes(load_campaign(plan), seed=number)[0]
        for name in given.scenes:
            for seed in given.seeds:
                path = folder / f"{name}-{seed}.h5"
                if path.exists():
                    continue
                scene = load_scene(name)
                motion = scene.motion.model_dump() | {"errors_seed": seed}
                if given.denser > 1:
                    motion["waypoints"] = denser(motion["waypoints"], given.denser)
                scene = load_scene(name, motion=motion)
                use_variant(CPU)
                # It loads Dr.Jit, which needs the library that `use_variant` chooses.
                from twin.recording.record_scene import record_scene

                options = Options(spp=16, seed=1000 * number + seed)
                record_scene(scene, take.sensor, path, as_built=take.built, options=options, overwrite=True)
                print(f"wrote {path}", flush=True)


def denser(waypoints: list[dict], times: int) -> list[dict]:
    """Insert waypoints between neighbours with the same orientation."""
    result = []
    for first, second in pairwise(waypoints):
        result.append(first)
        if first["rotation_deg"] == second["rotation_deg"]:
            ends = np.array([first["position_mm"], second["position_mm"]])
            for share in np.arange(1, times) / times:
                result.append(first | {"position_mm": tuple(ends[0] + share * (ends[1] - ends[0]))})
    return [*result, waypoints[-1]]


if __name__ == "__main__":
    main()
