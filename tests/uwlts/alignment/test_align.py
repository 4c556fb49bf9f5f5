"""Alignment of a trajectory by its crossings: against the true path of a simulated vehicle over a sea bed."""

import json
from pathlib import Path

import numpy as np
import pytest

import uwlts
from tests.uwlts.path_views import ride
from uwlts.alignment.align import AlignedTrajectory, Crossing
from uwlts.alignment.crossing_search import correlate_heights
from uwlts.alignment.pieces import AlignmentOptions
from uwlts.cli import app
from uwlts.model.trajectory import Trajectory
from uwlts.storage.cloud import PointCloud

SEED = 5
LOOP_MM = np.array([[0, 0], [1100, 0], [1100, 700], [450, 700], [450, -500]], float)
"""Path of 4 m, with one crossing at (450, 0)."""

RACE_MM = np.array([[-200, 0], [700, 0], [700, 600], [-200, 600], [-200, 0], [500, 0]], float)
"""Path that ends at its start, in the same direction."""


def position_errors(found: Trajectory, true: Trajectory) -> float:
    """Root mean square distance of the positions from the true ones."""
    return float(np.sqrt(np.mean(np.sum((found.poses[:, :3, 3] - true.poses[:, :3, 3]) ** 2, axis=1))))


def true_points(cloud: PointCloud, reported: Trajectory, true: Trajectory) -> np.ndarray:
    """Return the true positions (N, 3) of the points of a cloud along the reported path."""
    assert cloud.time_s is not None
    moved = true.poses_at(cloud.time_s) @ np.linalg.inv(reported.poses_at(cloud.time_s))
    return np.einsum("nij,nj->ni", moved, np.c_[cloud.points_mm, np.ones(len(cloud))])[:, :3]


def apart(cloud: PointCloud, true_points: np.ndarray, crossed: tuple[float, float]) -> np.ndarray:
    """Return the displacements (K, 3) in mm between two passes on squares of 30 mm around a crossing."""
    assert cloud.time_s is not None
    inside = np.all(np.abs(true_points[:, :2] - crossed) < 90, axis=1)
    errors, late = (cloud.points_mm - true_points)[inside], cloud.time_s[inside] > np.median(cloud.time_s)
    square = np.floor(true_points[inside, :2] / 30).astype(int) @ [1, 1000]
    return np.array(
        [
            errors[late & (square == each)].mean(axis=0) - errors[~late & (square == each)].mean(axis=0)
            for each in np.unique(square)
        ]
    )


@pytest.fixture(scope="module")
def loop():
    return ride(np.random.default_rng(SEED), LOOP_MM, drift_mm=60.0, drift_deg=0.3)


class Written:
    """Trajectory, cloud and crossings that the command writes for a cloud and its reported path."""

    def __init__(self, folder: Path, cloud: PointCloud, reported: Trajectory):
        cloud.save(folder / "pass.h5")
        reported.save(folder / "pass.csv")
        words = ["align", folder / "pass.h5", "--trajectory", folder / "pass.csv", "--drift-mm", 60, "--drift-deg", 0.3]
        words += ["--out", folder / "corrected.csv", "--aligned", folder / "aligned.h5"]
        app([str(word) for word in words], result_action="return_value")
        self.trajectory: Trajectory = uwlts.read(folder / "corrected.csv", pose_format="quaternion-xyzw")
        self.cloud: PointCloud = uwlts.read(folder / "aligned.h5")
        self.record = json.loads((folder / "corrected.json").read_text())
        self.crossings = [Crossing(**each) for each in self.record["crossings"]]


@pytest.fixture(scope="module")
def closed(loop, tmp_path_factory):
    cloud, reported, _ = loop
    return Written(tmp_path_factory.mktemp("closed"), cloud, reported)


def test_shifts_are_found_in_heights_with_gaps():
    rng = np.random.default_rng(SEED)
    x, y = rng.uniform(0, 300, (2, 40_000))
    z = sum(6 * np.exp(-((x - u) ** 2 + (y - v) ** 2) / 200) for u, v in rng.uniform(0, 300, (40, 2)))
    surface = np.column_stack([x, y, z])
    first, second = surface[x < 220], surface[(x > 90) & (np.hypot(x - 180, y - 100) > 25)]
    found = correlate_heights(
        first - [37.0, -52.0, 11.0], second, AlignmentOptions(), pixel_mm=4.0, reach_mm=np.full(3, 100.0)
    )
    np.testing.assert_allclose(found[0], [37.0, -52.0, 11.0], atol=4.0)


@pytest.mark.slow
def test_a_loop_is_closed(loop, closed):
    (cloud, reported, true), found = loop, closed
    assert found.crossings
    for each in found.crossings:
        assert each.held_out_after_mm < 0.02 * each.held_out_before_mm
        assert abs(each.times_s[0] - each.times_s[1]) > 5
    best = max(found.crossings, key=lambda each: each.patches)
    points = true_points(cloud, reported, true)
    before, after = (apart(each, points, (450, 0)) for each in (cloud, found.cloud))
    assert len(after) >= 30 and np.linalg.norm(before, axis=1).min() > 10
    # The goal for lengths within a crossing; the surface determines shifts along its normal best.
    assert (np.sqrt(np.mean(after**2, axis=0)) < [1.0, 1.0, 0.2]).all()
    assert position_errors(found.trajectory, true) < position_errors(reported, true) / 3
    for time in best.times_s:
        # Five standard deviations: a component of a pass fails once in two million rides.
        k = int(np.argmin(np.abs(true.times_s - time)))
        error = (found.trajectory.poses - true.poses)[k, :3, 3]
        assert (np.abs(error) < 5 * np.sqrt(np.diag(found.trajectory.covariance[k])[:3])).all()
    # The start defines the frame, and a crossing reduces the uncertainty of earlier positions.
    std = np.sqrt(np.einsum("nii->ni", found.trajectory.covariance))
    assert std[0, :3].max() < 0.1 and (std[:, :3] < 60).all()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("ground", "drift_mm", "drift_deg", "message"),
    [
        # Equal stones each 60 mm; the navigation is off by about 40 mm where the path crosses itself.
        (
            lambda x, y: 8 * np.cos(2 * np.pi * x / 60) * np.cos(2 * np.pi * y / 60),
            60.0,
            0.3,
            "fits in several positions",
        ),
        (lambda x, y: 0.02 * x - 0.01 * y, 60.0, 0.3, "no surfaces coincide within 3 standard deviations"),
        (None, 1e-3, 1e-6, "do not determine a correction"),
    ],
    ids=["equal stones", "plane", "better navigation"],
)
def test_a_path_without_a_correction_is_refused(ground, drift_mm, drift_deg, message):
    drift = {"drift_mm": drift_mm, "drift_deg": drift_deg}
    cloud, reported, _ = ride(np.random.default_rng(SEED), LOOP_MM, ground=ground, **drift)
    with pytest.raises(uwlts.Error, match=message):
        uwlts.align_trajectory(cloud, reported, **drift)


@pytest.mark.slow
def test_a_random_walk_is_followed_within_a_crossing():
    rng, sizes = np.random.default_rng(SEED), np.array([60.0] * 3 + [np.radians(0.3)] * 3)

    def navigation(true: Trajectory) -> tuple[np.ndarray, np.ndarray]:
        """Errors by a steady rate and a walk of a tenth of it, with their covariance."""
        t = (true.times_s / true.times_s[-1])[:, None]
        walk = 0.1 * np.cumsum(rng.standard_normal((len(t), 6)), axis=0) / np.sqrt(len(t))
        drift = t * rng.choice([-1, 1], 6) + walk - walk[0]
        return drift * sizes, ((t**2 + 0.1**2 * t) * sizes**2)[:, :, None] * np.eye(6)

    cloud, reported, true = ride(rng, LOOP_MM, drift_mm=60.0, drift_deg=0.3, navigation=navigation)
    points = true_points(cloud, reported, true)
    found = uwlts.align_trajectory(cloud, reported)
    before, after = (apart(each, points, (450, 0)) for each in (cloud, found.cloud))
    # The random walk reaches 60 mm x 0.1 x sqrt(1.5 s / 20 s) = 1.6 mm while a pass is over the crossing. Its standard
    # deviation about its mean is 1.6 mm / sqrt(6), or 0.9 mm for two passes.
    assert len(after) >= 30 and (before.std(axis=0) > 0.5).all()
    # The goal for lengths within a crossing; the surface determines shifts along its normal best.
    assert (np.sqrt(np.mean(after**2, axis=0)) < [1.0, 1.0, 0.2]).all()
    stated = [np.sqrt(np.einsum("nii->ni", each.covariance)[1:, :3]) for each in (reported, found.trajectory)]
    assert np.sqrt(np.mean(stated[1] ** 2)) < np.sqrt(np.mean(stated[0] ** 2)) / 3
    # Errors along the path are correlated: few independent numbers of standard deviation one exceed 3 once in 300.
    off = (found.trajectory.poses - true.poses)[1:, :3, 3] / stated[1]
    assert np.sqrt(np.mean(off**2)) < 3


@pytest.mark.slow
def test_along_a_ridge_the_navigation_is_all_that_is_known():
    def ground(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return 60 * np.exp(-(y**2) / (2 * 60**2)) + 0 * x

    drift = {"drift_mm": 4.0, "drift_deg": 0.05}
    cloud, reported, true = ride(np.random.default_rng(SEED), RACE_MM, ground=ground, **drift)
    found = uwlts.align_trajectory(cloud, reported, **drift).trajectory
    std = np.sqrt(np.einsum("ii->i", found.covariance[-1]))
    # Over the start again: along the ridge the navigation's 4 mm remain, slightly reduced by the drift model.
    assert std[0] > 3.0 and (std[1:3] < 0.5).all()
    error = (found.poses - true.poses)[-1, :3, 3]
    assert (np.abs(error) < 5 * std[:3]).all()
    assert np.abs((reported.poses - true.poses)[-1, :3, 3]).min() > 1.0


def test_the_corrected_cloud_is_that_of_the_corrected_trajectory(loop, closed):
    (cloud, reported, _), found = loop, closed
    local = np.einsum(
        "nij,nj->ni", np.linalg.inv(reported.poses_at(cloud.time_s)), np.c_[cloud.points_mm, np.ones(len(cloud))]
    )
    again = np.einsum("nij,nj->ni", found.trajectory.poses_at(cloud.time_s), local)[:, :3]
    np.testing.assert_allclose(found.cloud.points_mm, again, atol=1e-3)


def test_a_stored_trajectory_is_not_overwritten(closed, tmp_path):
    correction = np.zeros((len(closed.trajectory.times_s), 6))
    aligned = AlignedTrajectory(closed.trajectory, correction, tuple(closed.crossings), (), (0.0, 0.0), closed.cloud)
    aligned.save(tmp_path / "corrected.csv")
    with pytest.raises(uwlts.Error, match="exists"):
        aligned.save(tmp_path / "corrected.csv")
    aligned.save(tmp_path / "corrected.csv", overwrite=True)


def test_wrong_input_is_refused(loop):
    cloud, reported, _ = loop
    with pytest.raises(uwlts.Error, match="states no covariance: give drift_mm"):
        uwlts.align_trajectory(cloud, reported)
    with pytest.raises(uwlts.Error, match="give both"):
        uwlts.align_trajectory(cloud, reported, drift_mm=1.0)
    with pytest.raises(uwlts.Error, match="expected positive"):
        uwlts.align_trajectory(cloud, reported, drift_mm=-1.0, drift_deg=1.0)
    without = PointCloud(cloud.points_mm, cloud.intensity, cloud.frame, cloud.line)
    with pytest.raises(uwlts.Error, match="no times of its points"):
        uwlts.align_trajectory(without, reported, drift_mm=1.0, drift_deg=0.1)
    early = cloud.time_s < 5.0
    straight = PointCloud(
        *(each[early] for each in (cloud.points_mm, cloud.intensity, cloud.frame, cloud.line)),
        time_s=cloud.time_s[early],
    )
    with pytest.raises(uwlts.Error, match="no part of it is within 3 standard dev"):
        uwlts.align_trajectory(straight, reported, drift_mm=60.0, drift_deg=0.3)


def test_the_command_writes_a_trajectory_with_covariance(loop, closed):
    cloud, reported, _ = loop
    assert closed.trajectory.covariance is not None and len(closed.trajectory.times_s) == len(reported.times_s)
    assert closed.record["crossings"] and closed.record["largest_shift_mm"] > 10
    assert len(closed.cloud) == len(cloud)
