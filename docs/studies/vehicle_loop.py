"""Loop of a vehicle over the sea floor, rendered, reconstructed and aligned: errors of its path and of lengths.

    python docs/studies/vehicle_loop.py FOLDER

The sensor matches its drawings. The distance between images is 2.5 mm.
"""

from pathlib import Path

import numpy as np
from cyclopts import App
from moving_scenes import truth_of
from vehicle_pass import crossings_of, length_error

import twin
import uwlts
from uwlts.storage.pose_files import trajectory_path

SPEED_MM_S, RADIUS_MM, SEED = 150.0, 150.0, 4
BIAS_MM_S, GYRO_DEG_S = 4.0, 0.03
"""Errors of the navigation: about 45 mm and 0.35 deg after the 12 s of the loop."""

SCENE = """
title = "Loop over the sea floor"
[motion]
kind = "vehicle"
waypoints = [{waypoints}]
speed_mm_per_s = {speed}
turn_deg_per_s = 60.0
frame_rate_hz = 60.0
states_covariance = true
position_std_mm = 0.01
clock_offset_s = 0.012
vibration_mm = 0.02
errors_seed = {seed}
mount = {{ position_mm = [-60.0, 20.0, 420.0], rotation_deg = [0.0, 0.0, 30.0] }}
[motion.sea]
significant_height_mm = 500.0
share = 0.3
tilt_deg = 0.3
[motion.navigation]
velocity_bias_mm_per_s = {bias}
gyro_bias_deg_per_s = {gyro}
bias_time_s = 3600.0
[[objects]]
kind = "seabed"
width_mm = 1000.0
height_mm = 900.0
position_mm = [50.0, 50.0, 0.0]
ripple_pitch_mm = 300.0
ripple_height_mm = 12.0
roughness_mm = 6.0
stones = 200
stone_diameter_mm = 60.0
smallest_stone_mm = 25.0
reflectance = 0.3
"""


def loop() -> str:
    """Return waypoints to the right, round three quarters of a circle, and down across the first leg at (100, 0)."""
    straight = [(x, 0.0, 0.0) for x in (-250.0, -100.0, 100.0, 250.0)]
    turns = np.arange(30.0, 271.0, 30.0)
    angle = np.radians(turns)
    circle = zip(250 + RADIUS_MM * np.sin(angle), RADIUS_MM * (1 - np.cos(angle)), turns, strict=True)
    down = [(250 - RADIUS_MM, y, 270.0) for y in (0.0, -120.0, -200.0)]
    places = [*straight, *circle, *down]
    return ", ".join(f"{{position_mm = [{x}, {y}, 0.0], rotation_deg = [0.0, 0.0, {turn}]}}" for x, y, turn in places)


def main(folder: Path) -> None:
    """Render and print all figures."""
    described = {"speed": SPEED_MM_S, "bias": BIAS_MM_S, "gyro": GYRO_DEG_S, "seed": SEED}
    folder.mkdir(parents=True, exist_ok=True)
    path, capture = folder / "loop.toml", folder / "loop.h5"
    path.write_text(SCENE.format(waypoints=loop(), **described))
    if not capture.exists():
        twin.simulate(path, sensor="thesis-small", spp=8, seed=SEED, out=capture)
    motion, truth = truth_of(capture)
    assert truth.pose is not None
    offset = motion.clock_offset_s
    reported = uwlts.read(trajectory_path(capture))
    cloud = uwlts.reconstruct(
        capture, uwlts.nominal("thesis-small", medium="water"), trajectory=reported, clock_offset_s=offset
    )
    found = uwlts.align_trajectory(cloud, reported, clock_offset_s=offset)
    print(*found.lines(), sep="\n")
    with uwlts.read(capture) as images:
        times = images.time_s[:] + offset
    true = truth.pose @ np.linalg.inv(motion.mount.matrix())
    before, after = (
        np.sqrt(np.mean(np.sum((each.poses_at(times) - true)[:, :3, 3] ** 2, axis=1)))
        for each in (reported, found.trajectory)
    )
    (crossing,) = crossings_of(truth.pose[:, :2, 3])
    lengths = [length_error(each, truth, crossing) for each in (cloud, found.cloud)]
    print(
        f"path {before:.1f} to {after:.1f} mm (rms), lengths between both passes {lengths[0]:.2f} to "
        f"{lengths[1]:.3f} mm"
    )


if __name__ == "__main__":
    App(help=__doc__, help_format="plaintext", default_command=main)()
