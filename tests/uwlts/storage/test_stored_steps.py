"""The step of stored coordinates is noticed, and counted in uncertainties."""

from pathlib import Path

import numpy as np
import pytest

import uwlts
from uwlts.storage.cloud import STEP, make_foreign_cloud
from uwlts.storage.cloud_files import read_cloud, write_cloud, write_ply_points

OFFSET_MM = np.array([4e6, 5.4e6, 0.0])
"""Metres of a map taken as mm: a step of 0.5 mm in 32 bits."""


def plate(rng: np.random.Generator, *, missing_mm: float = 0.0) -> np.ndarray:
    """A plate of 60 x 60 mm with noise; a corner of 17.5 x 17.5 mm (8.5 %) is lower."""
    x, y = (each.ravel() for each in np.meshgrid(*[np.arange(0, 60, 0.5)] * 2))
    x, y = x + rng.uniform(-0.2, 0.2, x.size), y + rng.uniform(-0.2, 0.2, x.size)
    z = 400 + rng.normal(0, 0.01, x.size) + missing_mm * ((x < 17.5) & (y < 17.5))
    return np.column_stack([x, y, z])


def save(path: Path, points: np.ndarray, kind: type) -> Path:
    write_ply_points(path, dict(zip("xyz", points.astype(kind).T, strict=True)), overwrite=False)
    return path


def test_a_large_offset_in_32_bits_is_warned_of_and_counted(tmp_path):
    rng = np.random.default_rng(2)
    before, after = plate(rng), plate(rng, missing_mm=0.5)
    levels, warnings = {}, {}
    for kind in (np.float64, np.float32):
        files = [
            save(tmp_path / f"{name}-{kind.__name__}.ply", points + OFFSET_MM, kind)
            for name, points in (("after", after), ("before", before))
        ]
        warnings[kind] = read_cloud(files[0]).warnings
        change = uwlts.compare_clouds(*files, disc_mm=3.0)
        levels[kind] = float(np.nanmedian(change.level_mm))
    assert warnings[np.float64] == []
    assert any("stored in steps of 0.5 mm" in each and "apart" in each for each in warnings[np.float32])
    # Both clouds have a rectangular error of one step: 1.96 x 0.5 mm / sqrt(12) x sqrt(2) = 0.40 mm.
    assert levels[np.float64] < 0.05 and levels[np.float32] == pytest.approx(0.40, abs=0.05)


def test_the_step_survives_conversion_to_64_bits(tmp_path):
    points = plate(np.random.default_rng(3)) + OFFSET_MM
    cloud = read_cloud(save(tmp_path / "a.ply", points.astype(np.float32), np.float64))
    assert cloud.metadata[STEP] == 0.5
    write_cloud(tmp_path / "b.ply", cloud)
    assert read_cloud(tmp_path / "b.ply").metadata[STEP] == 0.5


@pytest.mark.parametrize(
    ("decimals", "unit", "step"), [(2, "mm", 0.01), (3, "m", 1.0), (6, "m", 1e-3), (4, "mm", None)]
)
def test_decimals_of_text_are_steps(tmp_path, decimals, unit, step):
    points = plate(np.random.default_rng(4)) / (1000 if unit == "m" else 1)
    np.savetxt(tmp_path / "a.txt", points, fmt=f"%.{decimals}f")
    found = read_cloud(tmp_path / "a.txt", unit=unit)
    assert found.metadata.get(STEP) == (None if step is None else pytest.approx(step))
    # Points are 0.5 mm apart.
    assert any("steps of" in each for each in found.warnings) == (step == 1.0)


def test_near_the_origin_32_bits_suffice(tmp_path):
    cloud = read_cloud(save(tmp_path / "a.ply", plate(np.random.default_rng(5)), np.float32))
    assert STEP not in cloud.metadata and cloud.warnings == []
    write_cloud(tmp_path / "a.las", cloud)
    write_cloud(tmp_path / "a.e57", cloud)
    assert not any(STEP in read_cloud(tmp_path / name).metadata for name in ("a.las", "a.e57"))


def test_a_pipe_measured_in_coarse_steps_has_a_wider_interval():
    rng = np.random.default_rng(6)
    x, angle = (each.ravel() for each in np.meshgrid(np.arange(0, 30, 0.5), np.arange(-1.2, 1.2, 0.02)))
    radius = 30.0 + rng.normal(0, 0.01, x.size)
    points = np.column_stack([x, radius * np.sin(angle), 400 - radius * np.cos(angle)])
    fine, coarse = (
        uwlts.inspect_pipe(make_foreign_cloud(points, frame=np.zeros(len(points)), line=None, step_mm=step))
        for step in (0.0, 0.2)
    )
    diameter, wide = fine.features[0]["diameter"], coarse.features[0]["diameter"]
    assert wide.value == diameter.value
    assert wide.uncertainty == pytest.approx(np.hypot(diameter.uncertainty, 0.2 / np.sqrt(12)), rel=1e-6)
    assert wide.low < diameter.low - 0.005 and wide.high > diameter.high + 0.005
    assert any("steps of the cloud's stored coordinates" in note for note in coarse.notes)
