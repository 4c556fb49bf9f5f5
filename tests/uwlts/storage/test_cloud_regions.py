"""Regions, even samples and parts of files of clouds."""

import numpy as np
import pytest

import uwlts
from uwlts.cli import app
from uwlts.errors import CaptureError, OutputError
from uwlts.storage.cloud import PointCloud
from uwlts.storage.cloud_files import read_parts, read_region, read_thinned_cloud


@pytest.fixture
def cloud():
    """The upper side of a pipe along x, more points than a few nodes hold."""
    rng = np.random.default_rng(3)
    count = 120_000
    x, angle = rng.uniform(0, 400, count), rng.uniform(-1.2, 1.2, count)
    points = np.column_stack([x, 60 * np.sin(angle), 500 - 60 * np.cos(angle)])
    deviation = rng.normal(size=count)
    return PointCloud(points, rng.uniform(0, 255, count), np.arange(count) // 500, np.arange(count) % 500, deviation)


def test_a_region_and_a_sample_are_read_alone(cloud, tmp_path):
    cloud.save(tmp_path / "pipe.ply")
    cloud.save(tmp_path / "pipe.laz")
    low, high = np.array([100.0, -20.0, 430.0]), np.array([150.0, 30.0, 520.0])
    inside = ((cloud.points_mm >= low) & (cloud.points_mm <= high)).all(axis=1)
    for name in ("pipe.laz", "pipe.ply"):
        # A point within a step of the box's face may be on its other side.
        assert abs(len(read_region(tmp_path / name, low, high)) - np.count_nonzero(inside)) <= 2
        few = read_region(tmp_path / name, low, high, 1000)
        assert 300 < len(few) <= 1000 and few.points_mm[:, 0].min() > 99.9
    thinned, total = read_thinned_cloud(tmp_path / "pipe.laz", 10_000)
    assert total == len(cloud) and 3000 < len(thinned) <= 10_000
    # An even sample: each tenth of the pipe has a tenth of the points within five standard deviations.
    share = np.histogram(thinned.points_mm[:, 0], bins=10, range=(0, 400))[0]
    assert np.abs(share - len(thinned) / 10).max() < 5 * np.sqrt(len(thinned) / 10)
    with pytest.raises(CaptureError, match="to larger x, y, z"):
        read_region(tmp_path / "pipe.ply", high, low)


def test_the_command_cuts_out_a_region(cloud, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    cloud.save("pipe.h5")
    words = ["export", "pipe.h5", "--out", "pipe.laz"]
    app(words, result_action="return_value")
    with pytest.raises(OutputError, match="exists already"):
        uwlts.export("pipe.h5", "pipe.laz")
    box = ["--region-mm", "0", "-100", "0", "40", "100", "1000"]
    app(["export", "pipe.laz", "--out", "end.ply", *box, "--at-most", "500"], result_action="return_value")
    assert 100 < len(uwlts.read("end.ply")) <= 500
    with pytest.raises(CaptureError, match="is not a cloud"):
        uwlts.export(tmp_path / "scan.h5", tmp_path / "part.ply", at_most=5)


def test_parts_are_the_whole(cloud, tmp_path):
    for name in ("pipe.ply", "pipe.h5"):
        cloud.save(tmp_path / name)
        parts = list(read_parts(tmp_path / name, 50_000))
        assert [len(part) for part in parts] == [50_000, 50_000, 20_000]
        np.testing.assert_array_equal(np.concatenate([part.points_mm for part in parts]), cloud.points_mm)
