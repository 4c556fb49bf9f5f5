"""A vehicle crosses its own path over the sea floor: rendered images, reconstructed and aligned, against the truth."""

import numpy as np
import pytest

import twin
import uwlts
from twin.scene.description import load_scene
from uwlts.storage.truth import read_truth

SPEED_MM_S, RADIUS_MM, SEED = 150.0, 150.0, 4
BIAS_MM_S, GYRO_DEG_S = 4.0, 0.03
"""Of the navigation: some 45 mm and 0.35 deg after the 12 s of the loop."""

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
    """Waypoints to the right, round three quarters of a circle, and down across the way there at (100, 0)."""
    straight = [(x, 0.0, 0.0) for x in (-250.0, -100.0, 100.0, 250.0)]
    turns = np.arange(30.0, 271.0, 30.0)
    angle = np.radians(turns)
    circle = zip(250 + RADIUS_MM * np.sin(angle), RADIUS_MM * (1 - np.cos(angle)), turns, strict=True)
    down = [(250 - RADIUS_MM, y, 270.0) for y in (0.0, -120.0, -200.0)]
    places = [*straight, *circle, *down]
    return ", ".join(f"{{position_mm = [{x}, {y}, 0.0], rotation_deg = [0.0, 0.0, {turn}]}}" for x, y, turn in places)


@pytest.mark.slow
def test_a_rendered_crossing_is_aligned(tmp_path):
    described = {"speed": SPEED_MM_S, "bias": BIAS_MM_S, "gyro": GYRO_DEG_S, "seed": SEED}
    scene, capture = tmp_path / "loop.toml", tmp_path / "loop.h5"
    scene.write_text(SCENE.format(waypoints=loop(), **described))
    twin.simulate(scene, sensor="thesis-small", spp=8, seed=SEED, out=capture)
    clock = {"clock_offset_s": 0.012}
    reported = uwlts.read_trajectory(tmp_path / "loop.trajectory.csv", pose_format="quaternion-xyzw")
    cloud = uwlts.reconstruct(capture, uwlts.nominal("thesis-small", medium="water"), trajectory=reported, **clock)
    found = uwlts.align_trajectory(cloud, reported, **clock)

    motion = load_scene(scene).motion
    truth = read_truth(tmp_path / "loop.truth.h5")[1]
    with uwlts.open_capture(capture) as images:
        times = images.time_s[:]
    true = truth.pose @ np.linalg.inv(motion.mount.matrix())
    before, after = (
        np.linalg.norm((path.poses_at(times + 0.012) - true)[:, :3, 3], axis=1) for path in (reported, found.trajectory)
    )
    print(np.sqrt(np.mean(before**2)), np.sqrt(np.mean(after**2)), found.lines())
    place = truth.point_mm[cloud.frame, cloud.line]
    near = np.linalg.norm(place[:, :2] - (100.0, 0.0), axis=1) < 60
    first, second = (np.flatnonzero(near & late) for late in (cloud.time_s < 5, cloud.time_s >= 5))
    rng = np.random.default_rng(SEED)
    ends = rng.choice(first, 5000), rng.choice(second, 5000)

    def wrong(points: np.ndarray) -> float:
        lengths = (np.linalg.norm(at[ends[0]] - at[ends[1]], axis=1) for at in (points, place))
        return float(np.sqrt(np.nanmean(np.subtract(*lengths) ** 2)))

    print(wrong(cloud.points_mm), wrong(found.cloud.points_mm), len(first), len(second))
