"""Pits in dents and beside them: total and local depth, each blemish once, and no others.

Pipes are those of `tests.oracles.pipes`. Gates on depths are 4.5 standard uncertainties, exceeded by a normal error 7
times in a million.
"""

from typing import Literal

import numpy as np
import pytest

import uwlts
from tests.oracles.pipes import Bump, scan_pipe
from uwlts.inspection.features import FeatureKind
from uwlts.storage.cloud import PointCloud

GATE = 4.5
CASES = [
    pytest.param(profile, seed, marks=[pytest.mark.slow] if seed > 21 else [])
    for profile in ("cosine", "bell")
    for seed in range(21, 23)
]


@pytest.mark.parametrize(("profile", "seed"), CASES)
def test_a_pit_in_a_dent_has_its_own_and_its_total_depth(profile: Literal["cosine", "bell"], seed: int) -> None:
    """A dent of 3 to 5.5 % of the radius, at any angle, with a pit in it and one beside it."""
    rng = np.random.default_rng([seed, 6])
    radius, angle = float(rng.uniform(90, 160)), float(rng.uniform(-np.pi, np.pi))
    size, depth = radius * float(rng.uniform(0.5, 0.8)), radius * float(rng.uniform(0.03, 0.05))
    dent = Bump(along_mm=0.0, angle=angle, diameter_mm=size, height_mm=-depth, profile=profile)
    inner, beside = (
        Bump(along_mm=at, angle=angle, diameter_mm=0.08 * radius, height_mm=-float(rng.uniform(0.6, 1.5)))
        for at in (float(rng.uniform(-5, 5)), 0.5 * size + 0.08 * radius)
    )
    pipe = scan_pipe(
        rng, axis=(1, 0.2, 0.1), radius_mm=radius, length_mm=2.2 * radius, spacing_mm=0.014 * radius,
        bumps=[dent, inner, beside],
    )  # fmt: skip
    found = uwlts.inspect_pipe(PointCloud(pipe.points_mm, np.ones(len(pipe.points_mm)), pipe.frame, pipe.line))
    blemishes = found.select(FeatureKind.PIT, FeatureKind.DENT, FeatureKind.PROTRUSION)
    assert len(blemishes) == 3 and not found.select(FeatureKind.WELD), [each.name for each in blemishes]
    own, *_ = found.select(FeatureKind.DENT)
    pits = {pipe.distance_mm(beside, pit.place_mm) < 0.03 * radius: pit for pit in found.select(FeatureKind.PIT)}
    along, around = np.meshgrid(np.linspace(-5, 5, 201) + inner.along_mm, angle + np.linspace(-5, 5, 201) / radius)
    deepest = -(dent.heights(along, around, radius) + inner.heights(along, around, radius)).min()
    # The depth in a dent also contains the uncertainty of the dent's own surface.
    for value, truth, largest in (
        (own["depth"], depth, 0.03),
        (pits[False]["depth"], -inner.height_mm, 0.25),
        (pits[False]["total depth"], deepest, 0.03),
        (pits[True]["depth"], -beside.height_mm, 0.1),
    ):
        assert value.value == pytest.approx(truth, abs=GATE * value.uncertainty), value
        assert value.uncertainty < largest * truth
    assert "total depth" not in pits[True]
