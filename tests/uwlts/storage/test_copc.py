"""COPC files: all points, regions and levels, other readers, and bounded memory."""

import itertools
import subprocess
import sys

import laspy
import numpy as np
import pytest

import uwlts
from uwlts.cli import app
from uwlts.errors import CaptureError, OutputError
from uwlts.storage import copc_file
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


@pytest.fixture
def small_nodes(monkeypatch):
    monkeypatch.setattr(copc_file, "_POINTS_OF_NODE", 3000)


def sorted_rows(cloud):
    columns = np.column_stack([cloud.frame, cloud.line, cloud.points_mm, cloud.intensity, cloud.deviation_mm])
    return columns[np.lexsort((cloud.line, cloud.frame))]


def test_all_points_come_back(cloud, small_nodes, tmp_path):
    cloud.save(tmp_path / "pipe.ply")
    assert uwlts.export(tmp_path / "pipe.ply", tmp_path / "pipe.copc.laz") == len(cloud)
    back = uwlts.read(tmp_path / "pipe.copc.laz")
    # Steps of 1e-4 mm; amplitude and deviation are stored exactly.
    np.testing.assert_allclose(sorted_rows(back), sorted_rows(cloud), atol=0.51e-4)
    with laspy.CopcReader.open(tmp_path / "pipe.copc.laz") as reader:
        np.testing.assert_allclose(1e3 * reader.header.mins, cloud.points_mm.min(axis=0), atol=1e-3)
        levels = [len(reader.query(level=level)) for level in range(4)]
        assert sum(levels) == len(cloud)
        # A factor of four from level to level, within five standard deviations.
        for upper, lower in itertools.pairwise(levels):
            assert abs(lower / upper - 4) < 5 * 4 * np.sqrt(1 / upper + 1 / lower)
        root = reader.query(level=0)
        assert np.ptp(1e3 * np.asarray(root.x)) > 390


def test_a_region_and_a_level_are_read_alone(cloud, small_nodes, tmp_path):
    cloud.save(tmp_path / "pipe.ply")
    uwlts.export(tmp_path / "pipe.ply", tmp_path / "pipe.copc.laz")
    low, high = np.array([100.0, -20.0, 430.0]), np.array([150.0, 30.0, 520.0])
    inside = ((cloud.points_mm >= low) & (cloud.points_mm <= high)).all(axis=1)
    for name in ("pipe.copc.laz", "pipe.ply"):
        # A point within a step of the box's face may be on its other side.
        assert abs(len(read_region(tmp_path / name, low, high)) - np.count_nonzero(inside)) <= 2
        few = read_region(tmp_path / name, low, high, 1000)
        assert 300 < len(few) <= 1000 and few.points_mm[:, 0].min() > 99.9
    thinned, total = read_thinned_cloud(tmp_path / "pipe.copc.laz", 10_000)
    assert total == len(cloud) and 3000 < len(thinned) <= 10_000
    # An even sample: each tenth of the pipe has a tenth of the points within five standard deviations.
    share = np.histogram(thinned.points_mm[:, 0], bins=10, range=(0, 400))[0]
    assert np.abs(share - len(thinned) / 10).max() < 5 * np.sqrt(len(thinned) / 10)
    with pytest.raises(CaptureError, match="to larger x, y, z"):
        read_region(tmp_path / "pipe.ply", high, low)


def test_the_command_cuts_out_a_region(cloud, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    cloud.save("pipe.h5")
    words = ["export", "pipe.h5", "--out", "pipe.copc.laz"]
    app(words, result_action="return_value")
    with pytest.raises(OutputError, match="exists already"):
        uwlts.export("pipe.h5", "pipe.copc.laz")
    box = ["--region-mm", "0", "-100", "0", "40", "100", "1000"]
    app(["export", "pipe.copc.laz", "--out", "end.ply", *box, "--at-most", "500"], result_action="return_value")
    assert 100 < len(uwlts.read("end.ply")) <= 500
    with pytest.raises(CaptureError, match="is not a cloud"):
        uwlts.export(tmp_path / "scan.h5", tmp_path / "part.ply", at_most=5)


def test_parts_are_the_whole(cloud, tmp_path):
    for name in ("pipe.ply", "pipe.h5"):
        cloud.save(tmp_path / name)
        parts = list(read_parts(tmp_path / name, 50_000))
        assert [len(part) for part in parts] == [50_000, 50_000, 20_000]
        np.testing.assert_array_equal(np.concatenate([part.points_mm for part in parts]), cloud.points_mm)


def test_damaged_and_empty_clouds_are_refused(cloud, tmp_path):
    (tmp_path / "text.copc.laz").write_text("no cloud")
    with pytest.raises(CaptureError, match=r"text.copc.laz is not a complete COPC file"):
        uwlts.read(tmp_path / "text.copc.laz")
    cloud.select(slice(0, 0)).save(tmp_path / "empty.ply")
    with pytest.raises(OutputError, match="no points"):
        uwlts.export(tmp_path / "empty.ply", tmp_path / "empty.copc.laz")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["empty.ply", "text.copc.laz"]


def test_memory_is_that_of_a_part(tmp_path):
    """Eight parts take almost no more memory than two; all points and their sorted copies would take 600 MB more."""
    script = (
        "import resource, sys\nimport numpy as np\nfrom uwlts.storage.cloud import PointCloud\n"
        "from uwlts.storage.copc_file import write_copc\n"
        "def part(seed):\n"
        "    rng = np.random.default_rng(seed)\n"
        "    p = rng.uniform(0, 1000, (200_000, 3)) * [1, 1, 0.01]\n"
        "    return PointCloud(p, p[:, 0], np.full(len(p), seed), np.arange(len(p)))\n"
        "write_copc(sys.argv[1], lambda: map(part, range(int(sys.argv[2]))))\n"
        "print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)\n"
    )
    peaks = []
    for parts in (2, 8):
        words = [sys.executable, "-c", script, str(tmp_path / f"{parts}.copc.laz"), str(parts)]
        peaks.append(int(subprocess.run(words, capture_output=True, text=True, check=True).stdout))
    # The records of six further parts of 200,000 points take 55 MB.
    assert peaks[1] - peaks[0] < 30_000
