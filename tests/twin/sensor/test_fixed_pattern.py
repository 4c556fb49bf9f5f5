"""Fixed pattern: EMVA 1288's spatial analysis recovers the simulated non-uniformity and hot pixels."""

import numpy as np
import pytest
from scipy import stats

from twin.sensor.detector import FixedPattern, fixed_pattern, grey_values
from uwlts.model.sensor import Detector

SIDE = 300
PIXELS = SIDE * SIDE
IMAGES = 16


def detector(**changes: object) -> Detector:
    plain = {
        "bits": 12,
        "quantum_efficiency": 0.5,
        "full_well_e": 10000.0,
        "read_noise_e": 22.0,
        "black_level_dn": 200.0,
    }
    return Detector.model_validate(plain | changes)


def pattern_of(chip: Detector, *, height: int = SIDE, width: int = SIDE) -> FixedPattern:
    found = fixed_pattern(chip, height=height, width=width)
    assert found is not None
    return found


def stack(electrons: float, chip: Detector, *, exposure_ms: float = 1.0) -> np.ndarray:
    """Images (IMAGES, SIDE, SIDE) of an even irradiance with the camera's pattern."""
    light, pattern = np.full((SIDE, SIDE), electrons, np.float32), pattern_of(chip)
    rng = np.random.default_rng(int(electrons + exposure_ms))
    shots = [grey_values(light, chip, exposure_ms=exposure_ms, rng=rng, pattern=pattern) for _ in range(IMAGES)]
    return np.array(shots, float)


def spatial_variance(images: np.ndarray) -> float:
    """Return EMVA 1288's spatial variance of the mean image, corrected for temporal noise, in squared grey values."""
    return images.mean(axis=0).var(ddof=1) - images.var(axis=0, ddof=1).mean() / len(images)


@pytest.mark.parametrize("prnu", [0.01, 0.03])
@pytest.mark.parametrize("dsnu", [5.0, 20.0])
def test_spatial_analysis_finds_prnu_and_dsnu(prnu, dsnu):
    chip = detector(prnu=prnu, dsnu_e=dsnu)
    dark, bright = stack(0.0, chip), stack(5000.0, chip)
    signal = bright.mean() - dark.mean()
    found_prnu = np.sqrt(spatial_variance(bright) - spatial_variance(dark)) / signal
    found_dsnu = np.sqrt(spatial_variance(dark)) / chip.gain_dn_per_e()
    # Sampling spread of an rms from N pixels, when noise of variance n comes on top of the pattern's s^2:
    # (1 + n / s^2) / sqrt(2 N). In the mean of 16 images n is (22^2 + signal) / 16; the bright one holds the dark
    # pattern, too. The worst cases are 0.3 % (PRNU 0.01, DSNU 20) and 0.5 % (DSNU 5); five of these are allowed.
    n_dark, n_bright, s_bright = 22.0**2 / IMAGES, (22.0**2 + 5000.0) / IMAGES + dsnu**2, 5000.0 * prnu
    assert found_prnu == pytest.approx(prnu, rel=5 * (1 + n_bright / s_bright**2) / np.sqrt(2 * PIXELS))
    assert found_dsnu == pytest.approx(dsnu, rel=5 * (1 + n_dark / dsnu**2) / np.sqrt(2 * PIXELS))
    assert 5 * (1 + n_bright / s_bright**2) / np.sqrt(2 * PIXELS) < 0.02
    assert 5 * (1 + n_dark / dsnu**2) / np.sqrt(2 * PIXELS) < 0.03


def test_without_a_pattern_the_spatial_variance_is_none():
    light = np.full((SIDE, SIDE), 5000.0, np.float32)
    rng = np.random.default_rng(3)
    chip = detector(prnu=0.01, dsnu_e=5.0)
    images = np.array([grey_values(light, chip, exposure_ms=1.0, rng=rng) for _ in range(IMAGES)], float)
    temporal = (22.0**2 + 5000.0) * chip.gain_dn_per_e() ** 2 / IMAGES
    assert abs(spatial_variance(images)) < 5 * temporal * np.sqrt(2 / PIXELS)
    assert fixed_pattern(detector(), height=SIDE, width=SIDE) is None


def test_the_offset_pattern_knows_neither_exposure_nor_temperature():
    # Noise-free at one electron per grey value, 100 and 400 electrons of dark current; the black level of 200 keeps
    # negative offsets. Values next to a half may be rounded either way: 32 bits resolve 6e-5 of a grey value here.
    plain = {"full_well_e": 4095.0, "dsnu_e": 30.0, "dark_current_e_per_s": 100.0}
    chips = [detector(**plain, temperature_c=t) for t in (25.0, 41.0)]
    dark = np.zeros((SIDE, SIDE), np.float32)
    images = [
        grey_values(dark, chip, exposure_ms=1000.0, rng=None, pattern=pattern_of(chip)).astype(int) for chip in chips
    ]
    difference = images[1] - images[0] - 300
    assert np.abs(difference).max() <= 1
    assert np.mean(difference != 0) < 1e-3
    assert images[0].std() == pytest.approx(30.0, rel=5 / np.sqrt(2 * PIXELS) + 1e-4)


def test_row_and_column_offsets_are_shared():
    rows = pattern_of(detector(dsnu_row_e=8.0), height=40000, width=3).offset_e
    columns = pattern_of(detector(dsnu_column_e=8.0), height=3, width=40000).offset_e
    for shared in (rows, columns.T):
        np.testing.assert_array_equal(shared, np.repeat(shared[:, :1], 3, axis=1))
        assert shared[:, 0].std() == pytest.approx(8.0, rel=5 / np.sqrt(2 * 40000))
    # Different components add up in their variances: 3^2 + 4^2 + 12^2 = 13^2; the 900 rows alone scatter by
    # 16 / 169 * sqrt(2 / 900) of the whole variance, the columns by 9 times that: 4 % of it, 2 % of the rms.
    both = pattern_of(detector(dsnu_e=3.0, dsnu_row_e=4.0, dsnu_column_e=12.0), height=900, width=900).offset_e
    assert both.std() == pytest.approx(13.0, rel=0.1)


def test_the_pattern_belongs_to_the_camera():
    chip = detector(prnu=0.01, dsnu_e=5.0, hot_pixels_per_million=1000.0, hot_pixel_dark_current_e_per_s=500.0)
    first, again, other = (pattern_of(chip.model_copy(update={"pattern_seed": seed})) for seed in (0, 0, 1))
    for name in ("gain", "offset_e", "hot_e_per_s"):
        np.testing.assert_array_equal(getattr(first, name), getattr(again, name))
        correlation = np.corrcoef(getattr(first, name).ravel(), getattr(other, name).ravel())[0, 1]
        assert abs(correlation) < 5 / SIDE
        assert getattr(first, name).dtype == np.float32
    assert abs(np.corrcoef(first.gain.ravel(), first.offset_e.ravel())[0, 1]) < 5 / SIDE
    # Changing one value leaves the rest of the pattern alone.
    noisier = pattern_of(chip.model_copy(update={"dsnu_e": 10.0, "prnu": 0.0}))
    np.testing.assert_array_equal(noisier.hot_e_per_s, first.hot_e_per_s)
    np.testing.assert_allclose(noisier.offset_e, 2 * first.offset_e, rtol=1e-6)
    np.testing.assert_array_equal(noisier.gain, 1.0)


def test_hot_pixels_by_number_and_rate():
    chip = detector(hot_pixels_per_million=2000.0, hot_pixel_dark_current_e_per_s=700.0)
    hot = pattern_of(chip, height=1024, width=1280).hot_e_per_s
    rates = hot[hot > 0]
    # 2621 expected; a binomial number scatters by its root, the mean of as many exponentials by 1 / root: 2 %.
    assert rates.size == pytest.approx(2621, abs=5 * np.sqrt(2621))
    assert rates.mean() == pytest.approx(700.0, rel=5 / np.sqrt(2621))
    assert stats.kstest(rates, stats.expon(scale=700.0).cdf).pvalue > 1e-3
    assert stats.kstest(rates, stats.norm(700.0, 350.0).cdf).pvalue < 1e-6, "another distribution would be noticed"
    rows, columns = np.nonzero(hot)
    assert stats.kstest(rows, stats.randint(0, 1024).cdf, method="asymp").pvalue > 1e-3
    assert stats.kstest(columns, stats.randint(0, 1280).cdf, method="asymp").pvalue > 1e-3


def test_hot_pixels_grow_with_exposure_and_temperature_and_are_noisy():
    plain = {"full_well_e": 4095.0, "hot_pixels_per_million": 2e4, "hot_pixel_dark_current_e_per_s": 300.0}
    chip, warm = detector(**plain), detector(**plain, temperature_c=33.0)
    rates = pattern_of(chip).hot_e_per_s
    np.testing.assert_allclose(pattern_of(warm).hot_e_per_s, 2 * rates, rtol=1e-6)
    dark = np.zeros((SIDE, SIDE), np.float32)
    for camera, factor in ((chip, 0.5), (warm, 1.0)):
        image = grey_values(dark, camera, exposure_ms=500.0, rng=None, pattern=pattern_of(camera)).astype(float)
        expected = np.minimum(factor * rates, 3895.0)
        assert np.abs(image - 200.0 - expected).max() <= 0.5 + 1e-3
    # About 1800 hot pixels in 16 images: their counts have Poisson and read noise. The sum of the variances over the
    # pixels has a relative error of sqrt(2 / (1800 * 15)), or at most twice that with unequal rates.
    images = stack(0.0, chip, exposure_ms=500.0)
    hot = rates > 0
    shot = images.var(axis=0, ddof=1)[hot].mean() - 1 / 12 - 22.0**2
    assert hot.sum() > 1600
    assert shot == pytest.approx(0.5 * rates[hot].mean(), rel=0.15)


def test_the_pattern_scales_light_only():
    # A gain of 1 + p multiplies photo-electrons, not dark current: noise-free, one electron per grey value.
    chip = detector(full_well_e=4095.0, prnu=0.05, dark_current_e_per_s=1000.0)
    pattern = pattern_of(chip)
    for light in (0.0, 1000.0):
        electrons = np.full((SIDE, SIDE), light, np.float32)
        image = grey_values(electrons, chip, exposure_ms=300.0, rng=None, pattern=pattern)
        assert np.abs(image - (500.0 + light * pattern.gain.astype(float))).max() <= 0.5 + 1e-3
