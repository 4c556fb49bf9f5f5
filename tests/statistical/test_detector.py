"""Light to grey values: the photon-transfer curve of EMVA 1288 finds the parameters that were put in."""

import numpy as np
import pytest
from scipy import stats

from twin.detector import electrons_per_ms, grey_values
from uwlts.sensor import Detector, Sensor

SIDE = 300
PIXELS = SIDE * SIDE


def detector(**changes: object) -> Detector:
    plain = {
        "bits": 12,
        "quantum_efficiency": 0.5,
        "full_well_e": 10000.0,
        "read_noise_e": 22.0,
        "black_level_dn": 100.0,
    }
    return Detector.model_validate(plain | changes)


def flat(electrons: float, sensor: Detector, *, exposure_ms: float = 1.0, seed: int | None = 0) -> np.ndarray:
    """Image of an even irradiance, ``electrons`` per pixel over the whole exposure; without noise if seed is None."""
    rng = None if seed is None else np.random.default_rng(seed)
    return grey_values(np.full((SIDE, SIDE), electrons, np.float32), sensor, exposure_ms=exposure_ms, rng=rng)


def test_electrons_of_a_watt_per_square_metre(thesis: Sensor):
    # By hand: a photon of 635 nm carries 6.62607015e-34 * 2.99792458e8 / 635e-9 = 3.1282612e-19 J. One W/m2 brings
    # 1e-6 W/mm2 * (5.3e-3 mm)^2 * 1e-3 s = 2.809e-14 J to a pixel in a ms: 89794.3 photons, half of them electrons.
    found = electrons_per_ms(np.float32(1e-6), thesis.camera, thesis.detector, wavelength_nm=635.0)
    assert found == pytest.approx(44897.1, rel=2e-6)
    # EMVA 1288's rule of thumb, its constant given to four digits: 50.36 A[um2] t[ms] lambda[um] E[uW/cm2].
    assert found / 0.5 == pytest.approx(50.36 * 5.3**2 * 0.635 * 100, rel=5e-4)


@pytest.mark.parametrize(("bits", "full_well"), [(12, 10000.0), (12, 4000.0), (10, 10000.0), (8, 2000.0)])
def test_the_photon_transfer_curve_gives_gain_and_read_noise(bits, full_well):
    true_gain = (2**bits - 1) / full_well
    # A black level of six times the read noise, and levels up to 0.7 of the full well, keep all noise within the range.
    chip = detector(bits=bits, full_well_e=full_well, black_level_dn=6 * 40.0 * true_gain, read_noise_e=40.0)
    levels = np.linspace(0.02, 0.7, 14) * full_well
    pairs = [[flat(level, chip, seed=2 * i + half).astype(float) for half in (0, 1)] for i, level in enumerate(levels)]
    dark = [flat(0.0, chip, seed=100 + half).astype(float) for half in (0, 1)]
    # As the standard does: the variance from the difference of two images, the mean less the dark one, rounding's 1/12
    # taken off. The variance of 90000 differences scatters by sqrt(2 / 90000) = 0.5 %; the slope through 14 levels by
    # 0.2 %, the read noise by half of 0.5 % plus what 1/12 leaves.
    dark_mean, dark_variance = np.mean(dark), np.var(dark[0] - dark[1]) / 2
    means = np.array([np.mean(pair) for pair in pairs]) - dark_mean
    variances = np.array([np.var(a - b) / 2 for a, b in pairs]) - dark_variance
    gain = (means @ variances) / (means @ means)
    assert gain == pytest.approx(true_gain, rel=0.01)
    assert np.sqrt(dark_variance - 1 / 12) / gain == pytest.approx(40.0, rel=0.02)
    np.testing.assert_allclose(means, true_gain * levels, rtol=5e-3, atol=5 * np.sqrt(variances.max() / (2 * PIXELS)))
    scatter = np.sqrt(2 / PIXELS) * np.hypot(variances + dark_variance, dark_variance)
    assert (np.abs(variances - true_gain * means) < 5 * scatter).all()
    # A spread that grows with the signal instead of with its root would be noticed.
    assert (np.abs(variances[-1] * (means / means[-1]) ** 2 - true_gain * means) > 5 * scatter).sum() > 8


def test_few_electrons_arrive_as_poisson_says():
    # A grey value per electron and no read noise: the histogram is the distribution itself.
    chip = detector(bits=8, full_well_e=255.0, read_noise_e=0.0, black_level_dn=0.0)
    counts = np.bincount(flat(2.5, chip).ravel(), minlength=12)
    expected = PIXELS * stats.poisson.pmf(np.arange(10), 2.5)
    observed, expected = np.append(counts[:10], counts[10:].sum()), np.append(expected, PIXELS - expected.sum())
    assert stats.chisquare(observed, expected).pvalue > 1e-4
    rounded_normal = stats.norm(2.5, np.sqrt(2.5)).cdf(np.arange(11) + 0.5)
    wrong = PIXELS * np.diff(rounded_normal, prepend=0.0)
    wrong *= PIXELS / wrong.sum()
    assert stats.chisquare(observed, wrong).pvalue < 1e-12, "a normal distribution would be noticed"


def test_the_full_well_clips_before_read_noise_is_added():
    full = flat(50000.0, detector(read_noise_e=30.0, black_level_dn=0.0), seed=1)
    assert full.max() == 4095
    # Clipped electrons have no shot noise: what read noise leaves below is half a normal of 12.3 grey values.
    assert np.mean(full == 4095) == pytest.approx(0.5, abs=0.03)
    spread = 30.0 * 4095 / 10000
    assert 4095 - full.astype(float).mean() == pytest.approx(spread / np.sqrt(2 * np.pi), rel=0.03)


def test_dark_current_adds_electrons_and_their_noise():
    chip = detector(dark_current_e_per_s=5000.0, read_noise_e=10.0)
    exposures = np.array([10.0, 100.0, 500.0, 1500.0])
    images = [flat(0.0, chip, exposure_ms=t, seed=i).astype(float) for i, t in enumerate(exposures)]
    gain = 4095 / 10000
    electrons = (np.array([image.mean() for image in images]) - 100.0) / gain
    np.testing.assert_allclose(electrons, 5.0 * exposures, rtol=5e-3, atol=0.3)
    noise = np.array([image.var() for image in images]) - 1 / 12
    np.testing.assert_allclose(noise / gain**2, 5.0 * exposures + 100.0, rtol=0.025)


@pytest.mark.parametrize(("bits", "kind"), [(8, np.uint8), (10, np.uint16), (12, np.uint16)])
def test_without_noise_grey_values_are_rounded_electrons(bits, kind):
    chip = detector(bits=bits, black_level_dn=3.0, dark_current_e_per_s=1000.0)
    electrons = np.linspace(0, 12000, PIXELS, dtype=np.float32).reshape(SIDE, SIDE)
    image = grey_values(electrons, chip, exposure_ms=100.0, rng=None)
    assert image.dtype == kind
    assert image.shape == electrons.shape
    exact = np.minimum(electrons.astype(float) + 100.0, 10000.0) * (2**bits - 1) / 10000.0 + 3.0
    expected = np.minimum(exact, 2**bits - 1)
    # Rounded to the nearest: half a grey value, and the 32-bit value of 4095 is known to 2e-4.
    assert np.abs(image - expected).max() <= 0.5 + 5e-4
    assert image.min() == round(100.0 * (2**bits - 1) / 10000.0 + 3.0)
    assert image.max() == 2**bits - 1
    np.testing.assert_array_equal(image, grey_values(electrons, chip, exposure_ms=100.0, rng=None))
    assert len(np.unique(image)) == 2**bits - int(image.min()), "every grey value occurs"


def test_black_level_keeps_the_dark_noise_from_being_cut_off():
    dark = flat(0.0, detector(bits=8, black_level_dn=0.0, read_noise_e=100.0))
    lifted = flat(0.0, detector(bits=8, black_level_dn=12.0, read_noise_e=100.0))
    spread = np.hypot(100.0 * 255 / 10000, np.sqrt(1 / 12))
    assert np.mean(dark == 0) > 0.5
    assert lifted.mean() == pytest.approx(12.0, abs=5 * spread / SIDE)
    assert lifted.std() == pytest.approx(spread, rel=0.02)


def test_one_seed_gives_one_image():
    chip = detector()
    first, again, other = (flat(3000.0, chip, seed=seed) for seed in (7, 7, 8))
    np.testing.assert_array_equal(first, again)
    assert np.mean(first != other) > 0.9
    correlation = np.corrcoef(first.ravel(), other.ravel())[0, 1]
    assert abs(correlation) < 5 / SIDE
