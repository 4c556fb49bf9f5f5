"""Pits in dents, beside them and touching each other: total and local depth, each blemish once, and no others.

Pipes are those of `tests.oracles.pipes`.
"""

from typing import Literal

import numpy as np
import pytest

from tests.oracles.pipes import Bump, scan_pipe
from tests.uwlts.inspection.inspected_pipes import BLEMISHES, GATE, HOLLOWS, inspect
from uwlts.inspection.features import FeatureKind


@pytest.mark.parametrize(
    ("profile", "seed"), [("cosine", 21), pytest.param("bell", 22, marks=pytest.mark.slow)], ids=["cosine", "bell"]
)
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
        rng, axis=(1, 0.2, 0.1), radius_mm=radius, length_mm=1.6 * radius, spacing_mm=0.016 * radius,
        bumps=[dent, inner, beside],
    )  # fmt: skip
    found = inspect(pipe)
    blemishes = found.select(*BLEMISHES)
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


RADIUS_MM, SPACING_MM = 80.0, 1.0


@pytest.mark.parametrize("apart", [0.8, 1.05])
def test_each_of_two_pits_that_touch_has_a_place(apart: float) -> None:
    """They overlap, or their rims touch; both have 12 mm, and depths of 1.5 and 1.0 mm.

    A single pit beside them has no neighbours. The standard uncertainty of its length is at least that of two
    rectangular distributions, one spacing wide each.
    """
    pits = [Bump(along_mm=at, angle=0.4, diameter_mm=12.0, height_mm=h) for at, h in ((0.0, -1.5), (12 * apart, -1.0))]
    alone = Bump(along_mm=5.0, angle=-1.0, diameter_mm=14.0, height_mm=-1.2)
    pipe = scan_pipe(
        np.random.default_rng([41, 9]), axis=(1, 0.1, 0.2), radius_mm=RADIUS_MM, length_mm=80.0,
        spacing_mm=SPACING_MM, bumps=[*pits, alone],
    )  # fmt: skip
    found = inspect(pipe).select(*HOLLOWS)
    (single,) = (each for each in found if pipe.distance_mm(alone, each.place_mm) < 2.5)
    assert not len(single.hollows_mm)
    assert single["length"].uncertainty >= SPACING_MM / np.sqrt(6)
    touching = [each for each in found if each is not single]
    places = [place for each in touching for place in (each.hollows_mm if len(each.hollows_mm) else [each.place_mm])]
    assert len(places) == 2
    assert all(min(pipe.distance_mm(pit, place) for place in places) < 2.5 for pit in pits)
