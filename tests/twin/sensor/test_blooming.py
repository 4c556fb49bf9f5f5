"""Blooming: excess charge flows along its column, and none is lost unless drained; charge up to the full well stays."""

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from twin.sensor.detector import grey_values, spread_blooming
from uwlts.model.sensor import Detector

FULL = 1000.0


def point(charge: float, *, rows: int = 21, row: int = 10) -> np.ndarray:
    image = np.zeros((rows, 3), np.float32)
    image[row, 1] = charge
    return image


def test_the_charge_fills_pixels_above_and_below():
    # 6.5 full wells: one stays, 2.75 go each way, filling two pixels and three quarters of a third.
    after = spread_blooming(point(6.5 * FULL), full_well_e=FULL, share=1.0)
    expected = np.zeros(21)
    expected[7:14] = [0.75, 1, 1, 1, 1, 1, 0.75]
    np.testing.assert_allclose(after[:, 1], FULL * expected, rtol=1e-6)
    assert not after[:, [0, 2]].any(), "columns are apart"


def test_a_share_is_drained_at_every_step():
    # 9 full wells, half drained: a quarter of the excess of 8 arrives on each side: 2. One stays, half of the other
    # moves on.
    after = spread_blooming(point(9 * FULL), full_well_e=FULL, share=0.5)
    expected = np.zeros(21)
    expected[8:13] = [0.5, 1, 1, 1, 0.5]
    np.testing.assert_allclose(after[:, 1], FULL * expected, rtol=1e-6)


def test_charge_leaves_the_image_at_its_edges():
    # 9 full wells in row 1 of 21: 4 to each side; row 0 keeps one, and 3 leave.
    after = spread_blooming(point(9 * FULL, row=1), full_well_e=FULL, share=1.0)
    expected = np.zeros(21)
    expected[:6] = 1.0
    np.testing.assert_allclose(after[:, 1], FULL * expected, rtol=1e-6)


def test_what_fits_is_not_touched():
    image = np.random.default_rng(0).uniform(0, FULL, (50, 40)).astype(np.float32)
    assert spread_blooming(image, full_well_e=FULL, share=1.0) is image
    untouched = image.copy()
    image[20, 7] = 3 * FULL
    after = spread_blooming(image, full_well_e=FULL, share=1.0)
    assert image[20, 7] == 3 * FULL, "the argument is left alone"
    others = np.arange(40) != 7
    np.testing.assert_array_equal(after[:, others], untouched[:, others])


@settings(deadline=None, max_examples=60)
@given(seed=st.integers(0, 2**32 - 1), sources=st.integers(1, 40), share=st.sampled_from([0.3, 0.9, 1.0]))
def test_charge_is_conserved_or_drained_never_made(seed, sources, share):
    rng = np.random.default_rng(seed)
    # Each column gets at most 40 sources of 9 full wells above: 360 rows' worth at the very most. 400 empty rows on
    # either side hold all of it, so nothing leaves the image.
    image = np.zeros((900, 12), np.float32)
    image[400:500] = rng.uniform(0, 0.9 * FULL, (100, 12))
    image[rng.integers(400, 500, sources), rng.integers(0, 6, sources)] = rng.uniform(1, 10, sources) * FULL
    after = spread_blooming(image, full_well_e=FULL, share=share)
    before_sum, after_sum = image.sum(axis=0, dtype=float), after.sum(axis=0, dtype=float)
    over = np.maximum(image.astype(float) - FULL, 0).sum(axis=0)
    assert (over > 0).any()
    if share == 1.0:
        # Every 32-bit charge is rounded by up to 6e-8 of itself.
        np.testing.assert_allclose(after_sum, before_sum, rtol=2e-7)
    else:
        # Each excess electron is drained at least once by 1 - share.
        assert (after_sum <= before_sum - (1 - share) * over + 2e-7 * before_sum).all()
        assert (after_sum >= np.minimum(image, FULL).sum(axis=0, dtype=float) * (1 - 2e-7)).all()
    assert after.max() <= FULL * (1 + 1e-6)
    assert (after >= np.minimum(image, FULL) - 1e-3).all(), "no pixel falls below its own charge up to the full well"
    mirrored = spread_blooming(image[::-1], full_well_e=FULL, share=share)[::-1]
    np.testing.assert_allclose(mirrored, after, rtol=1e-6, atol=1e-3)


@pytest.mark.parametrize(("share", "neighbours"), [(0.0, 0), (1.0, 200)])
def test_a_detector_blooms_only_when_described_so(share, neighbours):
    # Twenty rows of three full wells are 40 too many: 20 rows above and 20 below them fill up in each of 5 columns.
    chip = Detector(bits=8, quantum_efficiency=0.5, full_well_e=FULL, read_noise_e=0.0, blooming=share)
    assert Detector(bits=8, quantum_efficiency=0.5, full_well_e=FULL, read_noise_e=0.0).blooming == 0
    light = np.zeros((120, 30), np.float32)
    light[50:70, 10:15] = 3 * FULL
    image = grey_values(light, chip, exposure_ms=1.0, rng=None)
    assert np.count_nonzero(image == 255) == 100 + neighbours
    assert np.count_nonzero(image) == 100 + neighbours
    assert not image[:, :10].any()
    assert not image[:, 15:].any()
    noisy = grey_values(light, chip, exposure_ms=1.0, rng=np.random.default_rng(0))
    # With shot noise the number of electrons too many is known to sqrt(20 * 3000) = 245 a column, a quarter of a row.
    assert np.count_nonzero(noisy == 255) == pytest.approx(100 + neighbours, abs=10 if share else 0)
