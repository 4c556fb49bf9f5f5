"""Repeated points are found in clouds of any density; real points of dense, slow or rounded scans are kept."""

import re

import numpy as np
import pytest

import uwlts
from tests.uwlts.pipe_views import plain, scan_from, side_pose
from uwlts.errors import EvaluationError
from uwlts.storage.cloud import concatenate_clouds, make_foreign_cloud
from uwlts.storage.cloud_files import load_cloud
from uwlts.storage.repeated_points import find_repeated


def sheet(rng: np.random.Generator, across: float, along: float, shape: tuple[int, int], noise: float) -> np.ndarray:
    """Draw points (N, 3) of a curved sheet, with a spacing across and along the profiles, and noise along Z and Y."""
    x, y = (each.ravel() for each in np.meshgrid(np.arange(shape[0]) * across, np.arange(shape[1]) * along))
    z = 400 + 5 * np.sin(x / 20) + rng.normal(0, noise, x.size)
    return np.column_stack([x, y + 0.1 * rng.normal(0, noise, x.size), z])


def strewn(rng: np.random.Generator) -> np.ndarray:
    """Draw points (N, 3) at random places of a plate."""
    return np.column_stack([rng.uniform(0, 60, (12_000, 2)), 400 + rng.normal(0, 0.02, 12_000)])


SCANS = {
    "dense": lambda rng: sheet(rng, 0.05, 0.05, (100, 100), 0.01),
    "slow stage": lambda rng: sheet(rng, 0.01, 0.2, (300, 30), 0.02),
    "slow and quiet": lambda rng: sheet(rng, 0.01, 0.2, (300, 30), 0.002),
    "micrometre steps": lambda rng: sheet(rng, 0.001, 0.2, (1000, 10), 0.01),
    "vehicle": lambda rng: sheet(rng, 5.0, 0.1, (10, 800), 0.1),
    "strewn": strewn,
    "lattice": lambda rng: sheet(rng, 31.25, 31.25, (30, 30), 0.0),
}


@pytest.mark.parametrize("decimals", [None, 3, 2, 1])
@pytest.mark.parametrize("scan", SCANS)
def test_real_points_are_kept_and_copies_of_the_cloud_are_found(scan, decimals):
    points = SCANS[scan](np.random.default_rng(4))
    points = points if decimals is None else np.round(points, decimals)
    assert not find_repeated(points).any()
    for copies in (np.vstack([points, points]), np.repeat(points, 3, axis=0)):
        kept = copies[~find_repeated(copies)]
        assert np.array_equal(kept[np.lexsort(kept.T)], points[np.lexsort(points.T)])


@pytest.mark.parametrize("scan", ["dense", "slow stage", "vehicle", "strewn", "lattice"])
def test_a_tenth_that_is_repeated_is_found(scan):
    points = SCANS[scan](np.random.default_rng(1))
    repeated = find_repeated(np.vstack([points, points[: len(points) // 10]]))
    assert repeated[len(points) :].all()
    # Strewn points are within 8 micrometres of another one by chance: 4 of 12,000 are expected.
    assert np.count_nonzero(repeated[: len(points)]) <= 15


@pytest.mark.parametrize("scan", ["vehicle", "strewn", "lattice"])
def test_copies_with_other_rounding_are_found(scan):
    rng = np.random.default_rng(2)
    points = SCANS[scan](rng)
    for copies in (
        np.repeat(points, 5, axis=0) + rng.normal(0, 0.001, (5 * len(points), 3)),
        np.vstack([points, np.round(points, 2), np.round(points, 3)]),
    ):
        # A rounded copy is up to 8.7 micrometres away; strewn points may be nearer by chance.
        assert abs(np.count_nonzero(~find_repeated(copies)) - len(points)) < 0.01 * len(points)


def test_few_points_are_kept():
    for count in (0, 1, 2):
        assert not find_repeated(0.1 * np.arange(3 * count).reshape(count, 3)).any()
    assert np.count_nonzero(find_repeated(np.ones((40, 3)))) == 39


def test_lines_of_a_sensor_at_rest_are_measurements_of_their_own():
    """The stage stands still for 40 images: equal places with their own image and line are kept."""
    points = np.repeat([[1.0, 0.2 * row, 400.0] for row in range(50)], 40, axis=0)
    own = {"frame": np.tile(np.arange(40), 50), "line": np.repeat(np.arange(50), 40)}
    assert len(load_cloud(make_foreign_cloud(points, **own))) == 2000
    assert len(load_cloud(make_foreign_cloud(points))) == 50


@pytest.mark.parametrize("jitter_mm", [0.0, 0.001])
def test_repeated_points_change_neither_values_nor_intervals(tmp_path, caplog, jitter_mm):
    rng = np.random.default_rng(7)
    once = scan_from(side_pose(0.0), rng, radius=plain).points_mm[::16]
    twenty = np.repeat(once, 20, axis=0) + jitter_mm * rng.normal(size=(20 * len(once), 3))
    # The first copy is kept: it is the point itself.
    twenty[::20] = once
    files = [tmp_path / "once.xyz", tmp_path / "twenty.xyz"]
    for path, points in zip(files, (once, twenty), strict=True):
        np.savetxt(path, points, fmt="%.4f")
    change = [uwlts.compare_clouds(path, "cylinder") for path in files]
    assert np.array_equal(change[0].distance_mm, change[1].distance_mm, equal_nan=True)
    assert np.array_equal(change[0].level_mm, change[1].level_mm, equal_nan=True)
    found = [uwlts.inspect_pipe(path) for path in files]
    assert [each.values for each in found[0].features] == [each.values for each in found[1].features]
    assert any("repeat others" in note for note in found[1].notes) and "repeat others" in caplog.text


def test_a_scan_and_its_copy_are_not_registered(caplog):
    rng = np.random.default_rng(5)
    scans = [scan_from(side_pose(angle), rng, radius=plain) for angle in (0.0, 0.5)]
    with pytest.raises(EvaluationError, match="all points of scan 2 are those of another scan"):
        uwlts.register([scans[0], scans[0]])
    both = concatenate_clouds([scans[1], scans[0].select(slice(0, 5000))])
    found = uwlts.register([scans[0], both])
    # Both views draw the same rays, so that 0.5 % of the others coincide within half a micrometre by chance.
    assert len(found.cloud) == pytest.approx(len(scans[0]) + len(scans[1]), rel=0.01)
    assert re.search(r"scan 2: 5\d\d\d of 24154 points are those of another", caplog.text)
