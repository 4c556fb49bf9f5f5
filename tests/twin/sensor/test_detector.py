"""Light to grey values: the photon-transfer curve of EMVA 1288 recovers the simulated parameters."""

from concurrent.futures import ThreadPoolExecutor
from functools import partial

import numpy as np
import pytest
from pydantic import ValidationError
from scipy import stats

from twin.sensor import detector as detector_module
from twin.sensor.detector import electrons_per_ms, fixed_pattern, grey_values
from uwlts.errors import ImageError
from uwlts.model.sensor import Detector, Sensor

SIDE = 320
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
    """Return an image of uniform irradiance, ``electrons`` per pixel and exposure; without noise if seed is None."""
    rng = None if seed is None else np.random.default_rng(seed)
    light, pattern = np.full((SIDE, SIDE), electrons, np.float32), fixed_pattern(sensor, height=SIDE, width=SIDE)
    return grey_values(light, sensor, exposure_ms=exposure_ms, rng=rng, pattern=pattern)


def test_electrons_of_a_watt_per_square_metre(thesis: Sensor):
    # By hand: a photon of 635 nm carries 6.62607015e-34 * 2.99792458e8 / 635e-9 = 3.1282612e-19 J. One W/m2 brings
    # 1e-6 W/mm2 * (5.3e-3 mm)^2 * 1e-3 s = 2.809e-14 J to a pixel in a ms: 89794.3 photons, half of them electrons.
    found = electrons_per_ms(np.float32(1e-6), thesis.camera, thesis.detector, wavelength_nm=635.0)
    assert found == pytest.approx(44897.1, rel=2e-6)
    # EMVA 1288's rule of thumb, its constant given to four digits: 50.36 A[um2] t[ms] lambda[um] E[uW/cm2].
    assert found / 0.5 == pytest.approx(50.36 * 5.3**2 * 0.635 * 100, rel=5e-4)


@pytest.mark.parametrize("pattern", [{}, {"prnu": 0.02, "dsnu_e": 15.0, "dsnu_column_e": 5.0}], ids=["even", "uneven"])
@pytest.mark.parametrize(("bits", "full_well"), [(12, 10000.0), (12, 4000.0), (10, 10000.0), (8, 2000.0)])
def test_the_photon_transfer_curve_gives_gain_and_read_noise(bits, full_well, pattern):
    true_gain = (2**bits - 1) / full_well
    # A black level of ten times the read noise, and levels up to 0.7 of the full well, keep all noise within the range.
    black_level = 10 * 15.0 * true_gain
    chip = detector(bits=bits, full_well_e=full_well, black_level_dn=black_level, read_noise_e=15.0, **pattern)
    levels = np.linspace(0.02, 0.7, 14) * full_well
    pairs = [[flat(level, chip, seed=2 * i + half).astype(float) for half in (0, 1)] for i, level in enumerate(levels)]
    dark = [flat(0.0, chip, seed=100 + half).astype(float) for half in (0, 1)]
    # As the standard does: the variance from the difference of two images, the mean less the dark one, rounding's 1/12
    # taken off. A pattern goes out with the difference. The variance of 102400 differences scatters by
    # sqrt(2 / 102400) = 0.4 %, that of the dark pair shifts all levels; so do both move slope and read noise.
    dark_mean, dark_variance = np.mean(dark), np.var(dark[0] - dark[1]) / 2
    means = np.array([np.mean(pair) for pair in pairs]) - dark_mean
    variances = np.array([np.var(a - b) / 2 for a, b in pairs]) - dark_variance
    gain = (means @ variances) / (means @ means)
    own = np.sqrt(2 / PIXELS) * np.linalg.norm(means * (variances + dark_variance)) / (means @ means)
    shared = np.sqrt(2 / PIXELS) * dark_variance * means.sum() / (means @ means)
    own_of_dark = 0.5 * np.sqrt(2 / PIXELS) * dark_variance / (dark_variance - 1 / 12)
    gain_spread = np.hypot(own, shared) / true_gain
    read_noise_spread = np.hypot(own / true_gain, shared / true_gain + own_of_dark)
    assert 5 * gain_spread < 0.0125
    assert 5 * read_noise_spread < 0.02
    assert gain == pytest.approx(true_gain, rel=5 * gain_spread)
    assert np.sqrt(dark_variance - 1 / 12) / gain == pytest.approx(15.0, rel=5 * read_noise_spread)
    np.testing.assert_allclose(means, true_gain * levels, rtol=5e-3, atol=5 * np.sqrt(variances.max() / (2 * PIXELS)))
    scatter = np.sqrt(2 / PIXELS) * np.hypot(variances + dark_variance, dark_variance)
    assert (np.abs(variances - true_gain * means) < 5 * scatter).all()
    # A spread proportional to the signal instead of its root would be detected.
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
    # Clipped electrons are without shot noise: read noise gives half a normal distribution of 12.3 grey values below.
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


def test_rows_share_an_offset_that_is_new_in_each_image():
    chip, noise_e = detector(read_noise_e=4.0), 20.0
    rng, dark = np.random.default_rng(5), np.zeros((2000, 100), np.float32)
    images = [grey_values(dark, chip, exposure_ms=0.0, rng=rng, row_noise_e=noise_e) for _ in range(2)]
    first, second = (image.mean(axis=1) / chip.gain_dn_per_e() for image in images)
    # Means over 100 pixels also have a tenth of the read noise; 2000 rows give the deviation to 1.6 %: four of these.
    assert first.std() == pytest.approx(np.hypot(noise_e, 0.4), rel=0.065)
    assert abs(np.corrcoef(first, second)[0, 1]) < 4 / np.sqrt(2000)


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


def test_dark_current_doubles_every_eight_degrees_unless_described_otherwise():
    # One electron per grey value, 100 electrons in a second at the reference.
    plain = {"full_well_e": 4095.0, "dark_current_e_per_s": 100.0, "black_level_dn": 0.0}
    at = partial(flat, 0.0, exposure_ms=1000.0, seed=None)
    for degrees, electrons in ((9.0, 25), (25.0, 100), (33.0, 200), (49.0, 800)):
        assert np.unique(at(detector(**plain, temperature_c=degrees))) == electrons
    other = {"reference_temperature_c": 60.0, "dark_current_doubling_k": 5.0}
    for degrees, electrons in ((60.0, 100), (70.0, 400), (45.0, 12)):
        assert np.unique(at(detector(**plain, **other, temperature_c=degrees))) == electrons
    # Twice as many electrons have twice the variance; 102400 pixels know it to 0.4 %.
    warm = flat(0.0, detector(**plain, read_noise_e=0.0, temperature_c=33.0), exposure_ms=1000.0).astype(float)
    assert warm.var() == pytest.approx(200.0, rel=0.025)


def test_with_everything_new_left_out_the_noise_free_image_is_the_plain_formula():
    rng = np.random.default_rng(1)
    electrons = rng.uniform(0, 12000, (SIDE, SIDE)).astype(np.float32)
    chip = detector(dark_current_e_per_s=280.0)
    assert fixed_pattern(chip, height=SIDE, width=SIDE) is None
    signal = np.minimum(electrons + np.float32(280.0 * 20.0 * 1e-3), np.float32(10000.0))
    plain = np.clip(np.rint(signal * np.float32(4095 / 10000) + np.float32(100.0)), 0, 4095).astype(np.uint16)
    np.testing.assert_array_equal(grey_values(electrons, chip, exposure_ms=20.0, rng=None), plain)
    zeros = {"prnu": 0.0, "dsnu_e": 0.0, "hot_pixels_per_million": 0.0, "blooming": 0.0, "temperature_c": 25.0}
    same = [
        grey_values(electrons, c, exposure_ms=20.0, rng=np.random.default_rng(4))
        for c in (chip, chip.model_copy(update=zeros))
    ]
    np.testing.assert_array_equal(*same)


def test_the_image_does_not_depend_on_the_number_of_threads(monkeypatch):
    chip = detector(
        dark_current_e_per_s=500.0,
        prnu=0.01,
        dsnu_e=5.0,
        blooming=1.0,
        hot_pixels_per_million=500.0,
        hot_pixel_dark_current_e_per_s=1e4,
    )
    images = []
    for threads in (1, 2, 7):
        monkeypatch.setattr(detector_module, "ThreadPoolExecutor", partial(ThreadPoolExecutor, threads))
        images.append(flat(9950.0, chip, exposure_ms=10.0))
    assert np.mean(images[0] == 4095) > 0.1, "blooming was at work"
    np.testing.assert_array_equal(images[1], images[0])
    np.testing.assert_array_equal(images[2], images[0])


@pytest.mark.parametrize("shape", [(1, 1), (3, 5), (17, 1), (1, 40)])
def test_an_image_may_have_fewer_rows_than_bands(shape):
    chip = detector(prnu=0.01, blooming=0.5)
    pattern = fixed_pattern(chip, height=shape[0], width=shape[1])
    for rng in (None, np.random.default_rng(0)):
        image = grey_values(np.full(shape, 3e4, np.float32), chip, exposure_ms=1.0, rng=rng, pattern=pattern)
        assert image.shape == shape
        assert image.min() > 4000


@pytest.mark.parametrize(
    ("electrons", "message"),
    [
        (np.array([[1.0, np.nan]]), "from nan to nan; expected finite"),
        (np.array([[1.0, np.inf]]), "to inf; expected finite"),
        (np.array([[-0.5, 3.0]]), "from -0.5 to 3; expected finite numbers from 0"),
    ],
)
def test_what_is_no_image_of_electrons_is_refused(electrons, message):
    for rng in (None, np.random.default_rng(0)):
        with pytest.raises(ImageError, match=message):
            grey_values(electrons, detector(), exposure_ms=1.0, rng=rng)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"shutter": "rolling"}, "rolling shutter needs line_time_us"),
        ({"shutter": "flying"}, "'global' or 'rolling'"),
        ({"hot_pixels_per_million": 5.0}, "hot_pixel_dark_current_e_per_s 0: give both"),
        ({"hot_pixel_dark_current_e_per_s": 5.0}, "hot_pixels_per_million is 0 .*give both"),
        ({"prnu": 1.0}, "less than or equal to 0.1"),
        ({"blooming": 1.5}, "less than or equal to 1"),
        ({"dark_current_doubling_k": 0.0}, "greater than or equal to 1"),
        ({"pattern_seed": -1}, "greater than or equal to 0"),
        ({"temperature_c": 300.0}, "less than or equal to 150"),
        ({"dsnu_e": float("nan")}, "finite"),
    ],
)
def test_a_detector_that_cannot_be_is_refused(changes, message):
    with pytest.raises(ValidationError, match=message) as refusal:
        detector(**changes)
    assert next(iter(changes)) in str(refusal.value)


def test_a_rolling_shutter_is_described_by_its_line_time():
    assert detector().shutter == "global"
    assert detector(shutter="rolling", line_time_us=16.6).line_time_us == 16.6


def test_one_seed_gives_one_image():
    chip = detector()
    first, again, other = (flat(3000.0, chip, seed=seed) for seed in (7, 7, 8))
    np.testing.assert_array_equal(first, again)
    assert np.mean(first != other) > 0.9
    correlation = np.corrcoef(first.ravel(), other.ravel())[0, 1]
    assert abs(correlation) < 5 / SIDE
