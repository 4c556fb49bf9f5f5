"""Shift and magnification of a colour against another, put into points with noise."""

import numpy as np
import pytest

from uwlts.optics.lateral_colour import colour_shift, laser_colour

SIZE = np.array([1280.0, 1024.0])
NOISE_PX, POINTS = 0.02, 60


@pytest.mark.parametrize(("magnified", "moved_px"), [(1.001, 0.0), (0.9992, 0.3), (1.0, 0.5)])
def test_what_was_put_in_is_found(magnified, moved_px):
    rng = np.random.default_rng(1)
    places = rng.uniform(0, SIZE, (POINTS, 2))
    others = SIZE / 2 + magnified * (places - SIZE / 2) + [moved_px, 0.0] + rng.normal(0, NOISE_PX, (POINTS, 2))
    found = colour_shift(places, others, SIZE)
    # Standard errors: noise over the root of the number of points, and that over their distance from the middle, whose
    # root mean square is 473 px. Six of them.
    assert found.shift_px == pytest.approx(moved_px, abs=6 * 1.5 * NOISE_PX / POINTS**0.5)
    assert found.magnification == pytest.approx(magnified, abs=6 * NOISE_PX / (POINTS**0.5 * 473))
    assert found.significant


def test_noise_alone_is_not_significant():
    rng = np.random.default_rng(2)
    places = rng.uniform(0, SIZE, (POINTS, 2))
    assert not colour_shift(places, places + rng.normal(0, NOISE_PX, (POINTS, 2)), SIZE).significant


def test_colours_of_lasers():
    assert [laser_colour(nm) for nm in (405.0, 450.0, 520.0, 532.0, 635.0, 660.0)] == [
        *["blue"] * 2,
        *["green"] * 2,
        *["red"] * 2,
    ]
