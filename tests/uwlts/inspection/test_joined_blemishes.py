"""Blemishes that touch are noted as neighbours; lengths are known no better than the spacing of the points.

Pipes are those of `tests.oracles.pipes`.
"""

import numpy as np
import pytest

import uwlts
from tests.oracles.pipes import Bump, ScannedPipe, scan_pipe
from uwlts.inspection.features import FeatureKind, Inspection
from uwlts.storage.cloud import PointCloud

RADIUS_MM, SPACING_MM = 80.0, 1.0
SEEDS = [41, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (42, 43))]


def inspect(seed: int, *pits: Bump, spacing_mm: float = SPACING_MM) -> tuple[ScannedPipe, Inspection]:
    pipe = scan_pipe(
        np.random.default_rng([seed, 9]), axis=(1, 0.1, 0.2), radius_mm=RADIUS_MM, length_mm=110.0,
        spacing_mm=spacing_mm, bumps=list(pits),
    )  # fmt: skip
    return pipe, uwlts.inspect_pipe(PointCloud(pipe.points_mm, np.ones(len(pipe.points_mm)), pipe.frame, pipe.line))


def places_of(found: Inspection) -> list[np.ndarray]:
    """Return the place of each hollow: those of a joined finding, or the finding's own."""
    blemishes = found.select(FeatureKind.PIT, FeatureKind.DENT)
    return [place for each in blemishes for place in (each.hollows_mm if len(each.hollows_mm) else [each.place_mm])]


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("apart", [0.8, 1.05])
def test_each_of_two_pits_that_touch_has_a_place(seed: int, apart: float) -> None:
    """They overlap, or their rims touch; both have 12 mm, and depths of 1.5 and 1.0 mm."""
    pits = [Bump(along_mm=at, angle=0.4, diameter_mm=12.0, height_mm=h) for at, h in ((0.0, -1.5), (12 * apart, -1.0))]
    pipe, found = inspect(seed, *pits)
    places = places_of(found)
    assert len(places) == 2
    assert all(min(pipe.distance_mm(pit, place) for place in places) < 2.5 for pit in pits)


@pytest.mark.parametrize("seed", SEEDS)
def test_a_single_pit_has_no_neighbours_and_a_length_as_known(seed: int) -> None:
    """Its standard uncertainty is at least that of two rectangular distributions, one spacing wide each."""
    pit = Bump(along_mm=5.0, angle=-1.0, diameter_mm=14.0, height_mm=-1.2)
    _, found = inspect(seed, pit)
    (own,) = found.select(FeatureKind.PIT, FeatureKind.DENT)
    assert not len(own.hollows_mm)
    assert own["length"].uncertainty >= SPACING_MM / np.sqrt(6)
