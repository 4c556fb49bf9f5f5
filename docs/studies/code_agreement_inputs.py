"""Small but complete inputs for the comparison of two versions of the code: rendered scans, profiles, photographs.

`code_agreement.py` runs this with the packages of the older checkout: ``python code_agreement_inputs.py FOLDER``.
"""

import argparse
import shutil
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

import twin
import uwlts

SEED = 3
CAMPAIGN = """
title = "Agreement"
sensor = "thesis-small"
as_built = "thesis-small-as-built"
[imperfections]
circle_centre_std_mm = 0.002
stage_position_std_mm = 0.003
window_tilt_std_deg = 0.1
temperature_half_width_c = 2.0
"""
VERTICAL = {"direction": [0.0, 0.0, 1.0], "start_mm": -126.0, "step_mm": 20.0, "count": 10, "lights": ["lamp", "laser"]}
PIPE = {"start_mm": -20.0, "step_mm": 1.0, "count": 41}
LATER = """
base = "pitted-pipe"
[[objects]]
kind = "pitted_pipe"
diameter_mm = 100.0
length_mm = 120.0
ovality = 0.01
pits = 20
pit_diameter_mm = 10.0
pit_depth_mm = 2.6
position_mm = [0.0, 0.0, 50.0]
reflectance = 0.4
"""
"""The pipe with deeper pits."""
WELD = """
base = "weld"
[[objects]]
kind = "weld"
plate_mm = [80.0, 120.0]
beads = 1
along = "x"
length_mm = 60.0
width_mm = 12.0
height_mm = 2.0
undercut_depth_mm = 0.5
undercut_width_mm = 2.5
finish = "painted"
"""
DRIVE = [{"position_mm": [x, 2.0 * n, 0.0]} for n, x in enumerate((0.0, 300.0, 600.0))]
RECORDINGS: dict[str, dict[str, Any]] = {
    "target-bare": {"scene": "target", "motion": {"start_mm": -150.0, "step_mm": 30.0, "count": 9}},
    "target-air": {"scene": "target-through-window", "motion": {"start_mm": -150.0, "step_mm": 30.0, "count": 9}},
    "target-water": {"scene": "target-through-window", "media": ["water"], "motion": VERTICAL},
    "step-near": {"scene": "step", "placements": ["near"]},
    "step-standoff": {"scene": "step", "placements": ["standoff"]},
    "step-far": {"scene": "step", "placements": ["far"]},
    "step-today": {"scene": "step", "placements": ["standoff"], "motion": {"start_mm": -4.0}},
    "step-scan": {"scene": "step-scan", "placements": ["standoff"]},
    "spheres": {"scene": "spheres", "placements": ["standoff"], "motion": {"step_mm": 1.5, "count": 25}},
    "plane": {"scene": "plane", "placements": ["standoff"], "motion": {"step_mm": 10.0, "count": 15}},
    "pipe": {"scene": "pitted-pipe", "placements": ["standoff"], "motion": PIPE},
    "pipe-later": {"scene": "pipe-later.toml", "placements": ["standoff"], "motion": PIPE | {"start_mm": -19.5}},
    "weld": {"scene": "weld.toml", "placements": ["standoff"]},
    "shapes": {"scene": "shapes"},
    "shapes-again": {"scene": "shapes", "motion": {"start_mm": -16.5}},
    "robot-sphere": {"scene": "robot-sphere"},
    "robot-target": {"scene": "robot-target"},
    "rotary-sphere": {"scene": "rotary-sphere"},
    "vehicle": {"scene": "vehicle-pipe", "motion": {"waypoints": DRIVE}},
}

BOARD = 'kind = "chessboard"\ncolumns = 7\nrows = 6\nsquare_mm = 10.0\n'

LOOP_MM = np.array([[0, 0], [1100, 0], [1100, 700], [450, 700], [450, -500]], float)
"""Path of 4 m that crosses itself once."""
DRIFT_MM, DRIFT_DEG = 60.0, 0.3


def main() -> None:
    """Make all missing inputs in the folder."""
    parser = argparse.ArgumentParser()
    parser.add_argument("folder", type=Path)
    folder: Path = parser.parse_args().folder
    folder.mkdir(parents=True, exist_ok=True)
    render(folder)
    checkout = Path(uwlts.__file__).parents[1]
    copy_photographs(checkout / "tests" / "data" / "etna", folder / "photographs")
    write_mounts(folder)
    write_crossing(folder)


def render(folder: Path) -> None:
    """Render the scans of the stage and the platforms; complete scans are kept."""
    plan = folder / "campaign.toml"
    recordings = [_recording(name, **each) for name, each in RECORDINGS.items()]
    plan.write_text(CAMPAIGN + "".join(recordings), encoding="utf-8")
    for name, scene in {"pipe-later": LATER, "weld": WELD}.items():
        (folder / f"{name}.toml").write_text(scene, encoding="utf-8")
    twin.record(plan, out=folder / "scans", seed=SEED, spp=8)


def _recording(name: str, **fields: Any) -> str:
    lines = [f"{key} = {_toml(value)}" for key, value in ({"name": name} | fields).items()]
    return "\n[[recordings]]\n" + "\n".join(lines) + "\n"


def _toml(value: Any) -> str:
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{key} = {_toml(each)}" for key, each in value.items()) + " }"
    if isinstance(value, list):
        return "[" + ", ".join(map(_toml, value)) + "]"
    return f'"{value}"' if isinstance(value, str) else repr(value)


def copy_photographs(source: Path, folder: Path) -> None:
    """Copy the photographs of a board with a laser line, of a robot in air, and describe them."""
    shutil.copytree(source, folder, dirs_exist_ok=True)
    # The description beside this script: the older checkout may have none.
    shutil.copy(Path(__file__).parents[2] / "tests" / "data" / "etna.toml", folder / "import.toml")
    (folder / "target.toml").write_text(BOARD, encoding="utf-8")


def write_mounts(folder: Path) -> None:
    """Write profiles of a sphere and a plane by another maker's profiler on a robot, with its poses."""
    from tests.uwlts.mount_views import sphere_campaign

    campaigns = {
        "sphere": sphere_campaign(np.random.default_rng(SEED), robot_mm=0.03),
        "plane": sphere_campaign(np.random.default_rng(SEED + 1), poses=20, plane_only=True),
    }
    for name, campaign in campaigns.items():
        rows = [(n, *p) for n, profile in enumerate(campaign.profiles) for p in profile.tolist()]
        np.savetxt(folder / f"{name}-profiles.csv", rows, delimiter=",", header="pose,x,z", comments="")
        quaternions = Rotation.from_matrix(campaign.poses[:, :3, :3]).as_quat()
        poses = np.column_stack([campaign.poses[:, :3, 3], quaternions])
        np.savetxt(folder / f"{name}-poses.csv", poses, delimiter=",", header="x,y,z,qx,qy,qz,qw", comments="")


def write_crossing(folder: Path) -> None:
    """Write the cloud and the reported trajectory of a vehicle that crosses its own path."""
    from tests.uwlts.path_views import ride

    rng = np.random.default_rng(SEED)
    cloud, reported, _ = ride(rng, LOOP_MM, drift_mm=DRIFT_MM, drift_deg=DRIFT_DEG)
    # Checkouts of version 0.1 have functions in place of methods.
    for name, thing, write in (
        ("crossing.full.ply", cloud, "write_cloud"),
        ("crossing.csv", reported, "write_trajectory"),
    ):
        if hasattr(thing, "save"):
            thing.save(folder / name, overwrite=True)
        else:
            getattr(uwlts, write)(folder / name, thing, overwrite=True)


if __name__ == "__main__":
    main()
