"""Lean PLY files: standard deviation along the normal against formulas, and what other programs and commands see."""

import logging
from dataclasses import replace

import numpy as np
import pytest
import trimesh

import uwlts
from uwlts.storage.cloud import PointCloud, PointUncertainty, compute_normal_std
from uwlts.storage.cloud_files import load_cloud, read_cloud, write_cloud

IMAGES, LINES = 12, 200
AXES_MM = np.array([0.01, 0.02, 0.05])
"""Standard deviations of each point along X, Y and Z by noise alone."""


def scan(depth_mm, *, spacing_mm=(2.0, 0.1), patterns=3) -> PointCloud:
    """Return a scan with noise along the axes, whose images are far apart compared with its points."""
    frame, line = (each.ravel() for each in np.meshgrid(np.arange(IMAGES), np.arange(LINES), indexing="ij"))
    x, y = spacing_mm[0] * frame, spacing_mm[1] * line
    exact = np.column_stack([x, y, depth_mm(x, y)])
    rng = np.random.default_rng(7)
    random = np.zeros((len(x), 6), np.float32)
    random[:, [0, 3, 5]] = AXES_MM**2
    moved = rng.normal(scale=0.03, size=(patterns, 1, 3)).repeat(len(x), 1).astype(np.float32)
    known = PointUncertainty(random, np.tile(np.float32([0.005, 0, 0]), (len(x), 1)), moved)
    points = exact + AXES_MM * rng.normal(size=exact.shape)
    return PointCloud(points, np.full(len(x), 90.0), frame, line, uncertainty=known)


def total(cloud: PointCloud) -> np.ndarray:
    """Return the total standard deviation (N,) along the normal, from its two independent parts."""
    return np.hypot(*compute_normal_std(cloud))


def test_the_parts_are_those_of_the_formula():
    """On a plane square to Z: noise and the position of images are random, the patterns of the calibration common."""
    cloud = scan(lambda x, y: 300 + 0 * x)
    random, common = compute_normal_std(cloud)
    known = cloud.uncertainty
    # The normal is known to 0.07 rad, and the variances across it are smaller.
    assert np.median(random) == pytest.approx(np.hypot(AXES_MM[2], known.position_mm[0, 2]), rel=0.02)
    assert np.median(common) == pytest.approx(np.sqrt(np.sum(known.patterns_mm[:, 0, 2] ** 2)), rel=0.05)
    assert np.array_equal(cloud.field_values("random"), random) and np.array_equal(cloud.field_values("common"), common)


def expected(cloud: PointCloud, normals) -> np.ndarray:
    units = np.broadcast_to(normals, (len(cloud), 3)) / np.linalg.norm(normals, axis=-1, keepdims=True)
    return np.sqrt(np.einsum("ni,nij,nj->n", units, cloud.covariance_mm2, units))


@pytest.mark.parametrize("slope", [(0.0, 0.0), (0.8, 0.0), (0.0, -0.8), (1.5, 1.0)])
def test_on_a_plane_it_is_that_of_the_formula(slope):
    cloud = scan(lambda x, y: 300 + slope[0] * x + slope[1] * y)
    found = total(cloud)
    # Directions are noisy by at most 1 in 20 on each side, or 0.07 rad, in which the variance changes in first order
    # on inclined planes: by 2 x 0.07 x (1 - least / largest variance), 0.07 of the standard deviation, as 1 sigma.
    ratio = found / expected(cloud, np.array([-slope[0], -slope[1], 1.0]))
    assert np.abs(ratio.mean() - 1) < 0.02 and np.abs(ratio - 1).max() < 5 * 0.07


def test_beside_a_step_and_at_gaps_it_is_that_of_the_surface():
    cloud = scan(lambda x, y: np.where(y < 10, 300.0, 320.0))
    kept = np.random.default_rng(1).random(len(cloud)) < 0.8
    found, flat = total(cloud.select(kept)), expected(cloud, np.array([0, 0, 1.0]))[kept]
    assert kept.sum() > 1500 and np.median(np.abs(found / flat - 1)) < 0.01
    # A point with neighbours on no side has the largest standard deviation, which is that along Z within 1 %.
    assert (np.abs(found / flat - 1) < 0.2).mean() > 0.98


def test_points_without_image_or_line_have_the_largest(tmp_path):
    cloud = scan(lambda x, y: 300 + 1.5 * x)
    alone = replace(cloud, line=np.full(len(cloud), -1))
    largest = np.sqrt(np.linalg.eigvalsh(cloud.covariance_mm2.astype(float))[:, -1])
    np.testing.assert_allclose(total(alone), largest, rtol=1e-6)
    assert compute_normal_std(replace(cloud, uncertainty=None)) == (None, None)
    write_cloud(tmp_path / "a.ply", cloud.select(slice(0, 0)))
    assert len(read_cloud(tmp_path / "a.ply")) == 0


@pytest.mark.parametrize("coloured", [False, True])
def test_ply_is_lean_and_other_programs_read_it(tmp_path, coloured):
    cloud = scan(lambda x, y: 300 + 0 * x)
    colours = np.random.default_rng(5).integers(0, 256, (len(cloud), 3)).astype(np.uint8) if coloured else None
    for name in ("a.ply", "a.full.ply"):
        write_cloud(tmp_path / name, cloud, colours=colours)
    seen = trimesh.load(tmp_path / "a.ply")
    kinds = seen.metadata["_ply_raw"]["vertex"]["properties"]
    assert list(kinds) == [
        *"xyz",
        *["red", "green", "blue"] * coloured,
        "scalar_" * coloured + "intensity",
        "random_std",
        "common_std",
        "frame",
        "line",
    ]
    assert all(kinds[name] == "<u1" for name in ("red", "green", "blue") if coloured)
    np.testing.assert_array_equal(seen.vertices, cloud.points_mm)
    if coloured:
        np.testing.assert_array_equal(seen.colors[:, :3], colours)
    header = (tmp_path / "a.ply").read_bytes().index(b"end_header\n") + len(b"end_header\n")
    assert (tmp_path / "a.ply").stat().st_size - header == len(cloud) * (24 + 4 + 8 + 8 + 3 * coloured)
    np.testing.assert_array_equal(read_cloud(tmp_path / "a.full.ply").covariance_mm2, cloud.covariance_mm2)


def test_the_column_survives_copies_and_measuring_says_what_is_missing(tmp_path, caplog):
    cloud = scan(lambda x, y: 300 + 0 * x)
    write_cloud(tmp_path / "a.ply", cloud)
    lean = read_cloud(tmp_path / "a.ply")
    assert lean.uncertainty is None and not caplog.records
    for name in ("b.ply", "b.h5", "b.full.ply"):
        write_cloud(tmp_path / name, lean)
    for name in ("b.ply", "b.h5"):
        again = read_cloud(tmp_path / name)
        np.testing.assert_array_equal((again.random_std_mm, again.common_std_mm), compute_normal_std(cloud))
    np.testing.assert_array_equal(lean.select(slice(3, 9)).random_std_mm, lean.random_std_mm[3:9])
    with caplog.at_level(logging.WARNING):
        load_cloud(tmp_path / "a.ply")
        assert "a.ply: it holds the standard deviations" in caplog.text and "NAME.full.ply" in caplog.text
        caplog.clear()
        uwlts.evaluate(lean, {"kind": "plane"})
        assert "results have no uncertainty" in caplog.text
        caplog.clear()
        load_cloud(cloud)
        assert not caplog.records
