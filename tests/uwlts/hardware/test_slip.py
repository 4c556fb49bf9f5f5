"""Detection of a stage whose position differs from its count, from the stripe's motion in the image."""

import numpy as np
import pytest

from uwlts.hardware.scan_watch import Place, SlipWatch

LINES = 400
NOISE_PX = 0.1


def centres(position_mm: float, slope_px_per_mm: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    return 300 + slope_px_per_mm * position_mm + rng.normal(0, NOISE_PX, LINES)


def watched(slope: np.ndarray, rng: np.random.Generator, count: int = 6) -> SlipWatch:
    watch = SlipWatch()
    for k in range(count):
        watch.add(Place(2.0 * k, 1.0, centres(2.0 * k, slope, rng)))
    return watch


@pytest.mark.parametrize("slip_mm", [0.0, 0.1, -0.1, 0.7])
def test_the_slip_is_found_to_its_standard_error(slip_mm):
    rng = np.random.default_rng(1)
    slope = np.linspace(-3, 3, LINES)
    watch = watched(slope, rng)
    assert watch.place.position_mm == 2.0
    found = [watch.measure_slip(centres(2.0 + slip_mm, slope, rng)) for _ in range(30)]
    slips, errors = np.array(found).T
    # Noise of two centres divided by a root mean square motion of 1.7 px/mm on 400 lines is 0.004 mm; twice that is
    # reported, for lines that share speckle. All draws share the place's own noise.
    assert 0.006 < errors.mean() < 0.012
    assert abs(slips.mean() - slip_mm) < 0.02 and slips.std() < errors.mean()
    assert all(watch.is_significant(*each) == (abs(slip_mm) > 0.05) for each in found)


def test_where_the_picture_stays_the_same_nothing_is_reported():
    rng = np.random.default_rng(2)
    assert watched(np.zeros(LINES), rng).place is None
    assert watched(np.full(LINES, 0.1), rng).place is None
    assert watched(np.linspace(-3, 3, LINES), rng, count=2).place is None


def test_the_earliest_place_with_relief_counts():
    rng, watch = np.random.default_rng(3), SlipWatch()
    for k in range(10):
        empty = np.full(LINES, np.nan)
        watch.add(Place(float(k), 1.0, empty if k < 4 else centres(float(k), np.full(LINES, 2.0), rng)))
    assert watch.place.position_mm == 5.0


def test_an_object_that_is_gone_is_no_slip():
    rng = np.random.default_rng(4)
    watch = watched(np.full(LINES, 2.0), rng)
    assert not watch.is_significant(*watch.measure_slip(np.full(LINES, np.nan)))
    # A third of the lines now shows another surface.
    again = centres(2.0, np.full(LINES, 2.0), rng)
    again[: LINES // 3] += 40
    assert not watch.is_significant(*watch.measure_slip(again))
