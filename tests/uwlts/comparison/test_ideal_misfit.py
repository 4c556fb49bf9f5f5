"""Surfaces that are no plane, sphere or cylinder are named; local changes of such shapes are not.

Cylinders, and bells whose radius grows by 10 to 30 % along them, of 50 mm radius, with 0.03 mm of noise.
"""

import numpy as np
import pytest

import uwlts
from uwlts.storage.cloud import PointCloud


def tube(seed: int, *, flare: float, dent_mm: float) -> PointCloud:
    rng = np.random.default_rng(seed)
    angle, along = rng.uniform(-1.2, 1.2, 12_000), rng.uniform(0, 150, 12_000)
    away = np.hypot(50 * angle, along - 70) / 15
    radius = 50 * (1 + flare * (along / 150) ** 3) - dent_mm * np.exp(-(away**2)) + 0.03 * rng.standard_normal(12_000)
    points = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), along])
    return PointCloud(points, np.ones(12_000), np.full(12_000, -1), np.full(12_000, -1))


@pytest.mark.parametrize("seed", range(300, 302))
def test_a_surface_of_another_shape_is_named(seed: int) -> None:
    rng = np.random.default_rng(seed)
    bell = uwlts.compare_clouds(tube(seed, flare=float(rng.uniform(0.1, 0.3)), dent_mm=0.0), "cylinder")
    assert "it is no cylinder" in bell.lines()[0] and "it is no cylinder" in str(bell.record()["reference"])
    hurt = uwlts.compare_clouds(tube(seed, flare=0.0, dent_mm=float(rng.uniform(0.0, 3.0))), "cylinder")
    assert "it is no" not in hurt.reference
    for kind in ("plane", "sphere"):
        assert f"it is no {kind}" in uwlts.compare_clouds(tube(seed, flare=0.0, dent_mm=0.0), kind).reference
