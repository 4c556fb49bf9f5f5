"""Speckle against the statistics of Gaussian fields: distribution, grain, averaging over pixels, and change in motion.

The number of independent values in a region of many grains is its area divided by the correlation area A_c. This is the
integral of |2 J1(z) / z|^2 over the plane, A_c = (4 / pi) (lambda N (1 + m))^2.
"""

import math
from collections.abc import Callable

import numpy as np
import pytest
from scipy import integrate, interpolate, special, stats

from tests.virtual_sensors import altered
from twin.sensor.speckle import Speckle, _compute_third_cumulant, coherence, pixel_contrast, renewal_correlation
from uwlts.errors import DesignError
from uwlts.model.sensor import Camera, Sensor

WAVELENGTH_NM = 635.0
PIXEL_UM = 5.3
# The thesis's lens: f = 12.5 mm focused at 378.5 mm.
MAGNIFICATION = 12.5 / (378.5 - 12.5)


def grain_px(f_number: float) -> float:
    """lambda N (1 + m) in pixels."""
    return 1e-3 * WAVELENGTH_NM * f_number * (1 + MAGNIFICATION) / PIXEL_UM


def independent(pixels: float, f_number: float) -> float:
    """Return the number of correlation areas in a region of ``pixels`` pixels, at most one per pixel."""
    return pixels * min(1.0, math.pi / 4 / grain_px(f_number) ** 2)


def airy(distance: np.ndarray) -> np.ndarray:
    """Correlation |2 J1(z) / z|^2 of the intensity at a distance in grains."""
    z = np.pi * np.maximum(distance, 1e-9)
    return (2 * special.j1(z) / z) ** 2


def integrated_contrast(grain: float) -> float:
    """Contrast after averaging over a square pixel, from the distribution of the distance d of two of its points.

    Its density is 2 d (pi - 4 d + d^2) up to 1, then 2 d (4 sqrt(d^2 - 1) - d^2 - 2 + pi - 4 atan(sqrt(d^2 - 1))).
    """

    def near(d: float) -> float:
        return 2 * d * (math.pi - 4 * d + d * d) * airy(d / grain)

    def far(d: float) -> float:
        e = math.sqrt(d * d - 1)
        return 2 * d * (4 * e - d * d - 2 + math.pi - 4 * math.atan(e)) * airy(d / grain)

    return math.sqrt(integrate.quad(near, 0, 1, limit=200)[0] + integrate.quad(far, 1, math.sqrt(2), limit=200)[0])


Lens = Callable[..., Camera]
Pattern = Callable[..., np.ndarray]


@pytest.fixture(scope="module")
def lens(thesis: Sensor) -> Lens:
    """Return the thesis's camera with another f-number or other changes."""

    def make(f_number: float, **changes: object) -> Camera:
        return altered(thesis, {"camera": {"f_number": f_number, **changes}}).camera

    return make


def block(
    speckle: Speckle, height: int, width: int, *, step: int = 1, travel_mm: float = 0.0, polarisation=1.0, **kwargs
) -> np.ndarray:
    """Factors (rows, columns), float64, of every ``step``-th pixel of the image's upper left block."""
    rows, columns = np.mgrid[0:height:step, 0:width:step]
    flat = speckle.factors(rows.ravel(), columns.ravel(), travel_mm=travel_mm, polarisation=polarisation, **kwargs)
    return flat.reshape(rows.shape).astype(float)


def coarse_sample(lens: Lens, *, frames: int = 30, **kwargs) -> np.ndarray:
    """Return nearly independent values of a pattern with grains of 12.4 pixels, sampled every 15 pixels.

    This is the first zero of the correlation, 1.22 grains; averaging over the pixel is small. The pattern repeats
    across the stripe after 16 grains at least.
    """
    speckle = Speckle(lens(100.0), wavelength_nm=WAVELENGTH_NM, seed=1)
    frame = 3 * speckle.renewal_mm
    return np.concatenate(
        [block(speckle, 195, 1270, step=15, travel_mm=frame * i, **kwargs).ravel() for i in range(frames)]
    )


@pytest.mark.parametrize(("polarisation", "shape"), [(1.0, 1.0), (0.0, 2.0)])
def test_intensities_are_exponential_or_gamma_distributed(lens, polarisation, shape):
    sample = coarse_sample(lens, polarisation=polarisation)
    assert len(sample) > 30000
    # The pixel takes 0.3 % off the contrast, a tenth of what 30000 values would show.
    assert stats.kstest(sample, stats.gamma(shape, scale=1 / shape).cdf).pvalue > 1e-3
    assert stats.kstest(sample, stats.gamma(3 - shape, scale=1 / (3 - shape)).cdf).pvalue < 1e-12


@pytest.mark.parametrize("polarisation", [0.0, 0.3, 0.7, 1.0])
def test_contrast_of_partly_polarised_light(lens, polarisation):
    sample = coarse_sample(lens, polarisation=polarisation)
    expected = math.sqrt((1 + polarisation**2) / 2) * integrated_contrast(grain_px(100.0))
    # The contrast of n exponential values scatters by 1 / sqrt(n) (moments 1, 1, 2, 9), of sums of them by less.
    assert sample.std() / sample.mean() == pytest.approx(expected, abs=5 / math.sqrt(len(sample)))
    assert abs(math.sqrt(0.5) - math.sqrt((1 + 0.3**2) / 2)) > 5 / math.sqrt(len(sample)), "steps of 0.3 are seen"


@pytest.mark.parametrize("f_number", [4.0, 16.0])
@pytest.mark.parametrize("side", ["width", "height"])
def test_the_mean_is_one(lens, f_number, side):
    speckle = Speckle(lens(f_number, stripe_along=side), wavelength_nm=WAVELENGTH_NM, seed=2)
    shape = (64, 1280) if side == "width" else (1024, 64)
    mean = np.mean([block(speckle, *shape, travel_mm=i) for i in range(10)])
    # The mean over an area of n correlation areas scatters by 1 / sqrt(n), also where a pixel holds several.
    areas = 10 * shape[0] * shape[1] * math.pi / 4 / grain_px(f_number) ** 2
    assert mean == pytest.approx(1.0, abs=5 / math.sqrt(areas))


@pytest.mark.parametrize("side", ["width", "height"])
def test_the_grain_is_an_airy_pattern_in_every_direction(lens, side):
    # Grains of 7.9 pixels, so that averaging over a square pixel changes the half width by 1 % only.
    f_number, frames, reach = 64.0, 16, 14
    speckle = Speckle(lens(f_number, stripe_along=side), wavelength_nm=WAVELENGTH_NM, seed=3)
    shape = (120, 1000) if side == "width" else (1000, 120)
    travel = 3 * speckle.renewal_mm
    images = [block(speckle, *shape, travel_mm=travel * i) - 1 for i in range(frames)]
    lags = np.arange(reach)
    half_width = 0.5145 * grain_px(f_number)
    assert airy(np.array(0.5145)) == pytest.approx(0.5, abs=1e-3)
    scatter = 1 / math.sqrt(independent(frames * shape[0] * shape[1], f_number))
    for down, right in ((0, 1), (1, 0), (1, 1), (1, -1)):
        found = np.zeros(reach)
        for image in images:
            turned = image[:, ::-1] if right < 0 else image
            for lag in lags:
                moved = turned[down * lag :, abs(right) * lag :]
                found[lag] += np.mean(moved * turned[: moved.shape[0], : moved.shape[1]]) / frames
        found /= found[0]
        distance = math.hypot(down, right) * lags / grain_px(f_number)
        # A product of two correlated exponential deviations has the variance 9 at most, near no lag, where numerator
        # and denominator go together; twice the scatter of uncorrelated ones covers what is left, the pixel adds 0.01.
        np.testing.assert_allclose(found, airy(distance), rtol=0, atol=5 * 2 * scatter)
        curve = interpolate.CubicSpline(math.hypot(down, right) * lags, found)
        width = min(root for root in curve.solve(0.5, extrapolate=False) if root > 0)
        assert width == pytest.approx(half_width, rel=0.05), (down, right)
    assert 10 * scatter < 0.12


@pytest.mark.parametrize(("f_number", "frames"), [(2.8, 2), (4.0, 3), (8.0, 6), (16.0, 12)])
@pytest.mark.parametrize("polarisation", [0.0, 1.0])
def test_pixels_average_over_grains(lens, f_number, frames, polarisation):
    speckle = Speckle(lens(f_number), wavelength_nm=WAVELENGTH_NM, seed=4)
    values = np.array([block(speckle, 64, 1280, travel_mm=i, polarisation=polarisation) for i in range(frames)])
    expected = integrated_contrast(grain_px(f_number)) * math.sqrt((1 + polarisation**2) / 2)
    # The scatter is 1 / sqrt(n) at most.
    assert 5 / math.sqrt(independent(values.size, f_number)) < 0.03
    assert values.std() == pytest.approx(expected, rel=0.03)
    assert values.min() >= 0


@pytest.mark.parametrize("f_number", [2.0, 4.0, 8.0, 9.5, 11.0, 16.0, 32.0])
@pytest.mark.parametrize("polarisation", [0.0, 1.0])
def test_neighbours_are_correlated_as_sums_over_pixels(lens, f_number, polarisation):
    speckle = Speckle(lens(f_number), wavelength_nm=WAVELENGTH_NM, seed=12)
    images = [block(speckle, 64, 1280, travel_mm=i, polarisation=polarisation) - 1 for i in range(4)]
    # Pairs of points of both pixels, at the middles of a grid of squares.
    part = (np.arange(24) + 0.5) / 24
    for down, right in ((0, 1), (1, 0), (1, 1), (0, 2)):
        apart = np.hypot((down + part - part[:, None])[:, :, None, None], right + part - part[:, None])
        own = np.hypot((part - part[:, None])[:, :, None, None], part - part[:, None])
        expected = airy(apart / grain_px(f_number)).mean() / airy(own / grain_px(f_number)).mean()
        found = np.mean(
            [np.mean(each[: 64 - down, : 1280 - right] * each[down:, right:]) / each.var() for each in images]
        )
        # Products of correlated exponential deviations scatter by up to 3 / sqrt(n); the model's own errors are 0.025.
        scatter = (1 + 2 * expected) / math.sqrt(independent(4 * 64 * 1280, f_number))
        assert found == pytest.approx(expected, abs=5 * scatter + 0.025), (down, right)


def test_cumulants_of_a_pixel_by_another_quadrature():
    # Triples of points drawn at random: 4e5 of them give the third cumulant to 1 %.
    rng = np.random.default_rng(0)
    points = rng.random((3, 400_000, 2))
    for grain in (0.3, 0.5, 1.0, 3.0):
        distances = [np.hypot(*(points[i] - points[j]).T) / grain for i, j in ((0, 1), (1, 2), (2, 0))]
        product = np.prod([2 * special.j1(np.pi * d) / (np.pi * d) for d in distances], axis=0)
        scatter = product.std() / math.sqrt(len(product))
        assert _compute_third_cumulant(grain) == pytest.approx(product.mean(), abs=5 * scatter)
        assert 10 * scatter < product.mean()


@pytest.mark.parametrize("grain", [0.05, 0.2, 1.0, 5.0])
def test_contrast_of_a_pixel_by_two_quadratures(grain):
    assert pixel_contrast(grain) == pytest.approx(integrated_contrast(grain), rel=1e-6)


def test_grains_finer_than_can_be_computed_keep_their_contrast(lens):
    camera = lens(1.4, pixel_size_um=12.0, width_px=320, height_px=64)
    grain = 1e-3 * WAVELENGTH_NM * 1.4 * (1 + MAGNIFICATION) / 12.0
    assert grain < 1 / 12
    values = block(Speckle(camera, wavelength_nm=WAVELENGTH_NM, seed=5), 64, 320)
    # 20480 independent values, nearly normal: 1 / sqrt(2 n) = 0.5 %.
    assert values.std() == pytest.approx(integrated_contrast(grain), rel=0.025)


@pytest.mark.parametrize("side", ["width", "height"])
def test_nothing_repeats_along_the_stripe_or_within_it(lens, side):
    speckle = Speckle(lens(4.0, stripe_along=side), wavelength_nm=WAVELENGTH_NM, seed=6)
    image = block(speckle, 40, 1280) if side == "width" else block(speckle, 1024, 40)
    spectrum = np.fft.rfft2(image - image.mean(), s=[2 * n for n in image.shape])
    correlation = np.fft.irfft2(np.abs(spectrum) ** 2) / (image.size * image.var())
    # Grains are half a pixel, so that pixels but the nearest are uncorrelated: 1 / sqrt(n) each, 6 for 1e5 of them.
    far = np.ones(correlation.shape, bool)
    far[np.ix_([-2, -1, 0, 1, 2], [-2, -1, 0, 1, 2])] = False
    assert np.abs(correlation[far]).max() < 6 / math.sqrt(image.size)
    assert correlation[0, 0] == pytest.approx(1.0)


def test_the_ends_of_the_stripe_are_not_neighbours(lens):
    speckle = Speckle(lens(64.0), wavelength_nm=WAVELENGTH_NM, seed=11)
    travels = 3 * speckle.renewal_mm * np.arange(40)
    rows, columns = np.repeat(np.arange(0, 120, 10), 2), np.tile([0, 1279], 12)
    found = np.array([speckle.factors(rows, columns, travel_mm=t, polarisation=1.0) for t in travels])
    # 480 nearly independent pairs; neighbours would be correlated by 0.96.
    assert abs(np.corrcoef(found[:, ::2].ravel(), found[:, 1::2].ravel())[0, 1]) < 5 / math.sqrt(480)


def correlation_of_travel(lens: Lens, start: float, lag: float, *, f_number: float = 16.0, seeds: int = 4) -> float:
    """Correlation of the intensities of two positions, in renewal lengths."""
    found = []
    for seed in range(seeds):
        speckle = Speckle(lens(f_number), wavelength_nm=WAVELENGTH_NM, seed=seed)
        first, second = (block(speckle, 64, 1280, travel_mm=s * speckle.renewal_mm) for s in (start, start + lag))
        found.append(np.corrcoef(first.ravel(), second.ravel())[0, 1])
    return float(np.mean(found))


@pytest.mark.parametrize("lag", [0.1, 0.4, 0.79, 1.2, 2.0])
def test_the_pattern_changes_with_the_travel_alike_everywhere(lens, lag):
    starts = (-3.3, 0.0, 0.55, 1000.9)
    found = [correlation_of_travel(lens, start, lag) for start in starts]
    # Frames have 16000 correlation areas each; correlated exponential values scatter by up to 2 / sqrt(n).
    scatter = 2 / math.sqrt(independent(4 * 64 * 1280, 16.0))
    np.testing.assert_allclose(found, renewal_correlation(lag) ** 2, rtol=0, atol=5 * scatter)
    assert 5 * scatter < 0.05


def test_renewal_follows_an_airy_pattern_that_the_surface_carries_along(lens):
    speckle = Speckle(lens(4.0), wavelength_nm=WAVELENGTH_NM, seed=0)
    cell_mm = 1e-3 * PIXEL_UM * grain_px(4.0) / MAGNIFICATION
    assert speckle.renewal_mm == pytest.approx(0.9 * cell_mm)
    moved_mm = np.linspace(1e-3, 5, 500) * cell_mm
    found = renewal_correlation(moved_mm / speckle.renewal_mm)
    np.testing.assert_allclose(found**2, airy(moved_mm / cell_mm), rtol=0, atol=0.03)
    np.testing.assert_allclose(found[moved_mm >= 2 * speckle.renewal_mm], 0, atol=1e-15)
    # The correlation is one half at the same displacement as 2 J1(z) / z, at z = 2.2151. The 0.9 is rounded from
    # 0.896, by 4e-3 of a length over which the correlation falls by 0.7.
    half = 2.2151 / math.pi
    assert renewal_correlation(half * cell_mm / speckle.renewal_mm) == pytest.approx(0.5, abs=4e-3)


def test_frames_a_millimetre_apart_are_independent(lens):
    speckle = Speckle(lens(4.0), wavelength_nm=WAVELENGTH_NM, seed=7)
    frames = [block(speckle, 64, 1280, travel_mm=t).ravel() for t in (-1.0, 0.0, 1.0, 2.0)]
    other = block(Speckle(lens(4.0), wavelength_nm=WAVELENGTH_NM, seed=8), 64, 1280).ravel()
    matrix = np.corrcoef([*frames, other])
    assert np.abs(matrix - np.eye(5)).max() < 5 / math.sqrt(64 * 1280)


def test_a_frame_depends_on_seed_and_travel_only(lens):
    camera = lens(8.0)
    once, again = (Speckle(camera, wavelength_nm=WAVELENGTH_NM, seed=9) for _ in range(2))
    rng = np.random.default_rng(0)
    rows, columns = rng.integers(1024, size=5000), rng.integers(1280, size=5000)
    polarised, coherent = rng.uniform(0, 1, 5000), rng.uniform(0.3, 1, 5000)

    def frame(speckle: Speckle, travel_mm: float, part: np.ndarray) -> np.ndarray:
        return speckle.factors(
            rows[part], columns[part], travel_mm=travel_mm, polarisation=polarised[part], coherence=coherent[part]
        )

    everything = np.arange(5000)
    forward = [frame(once, travel, everything) for travel in (0.0, 0.01, 12.3)]
    for travel, expected in zip((12.3, 0.01, 0.0), forward[::-1], strict=True):
        np.testing.assert_array_equal(frame(again, travel, everything), expected)
    shuffled = rng.permutation(5000)[:700]
    np.testing.assert_array_equal(frame(again, 0.01, shuffled), forward[1][shuffled])
    # Fully coherent and polarised pixels have the same factors alone and together with others.
    pure = np.arange(300)
    polarised[pure], coherent[pure] = 1.0, 1.0
    np.testing.assert_array_equal(frame(once, 5.0, pure), frame(once, 5.0, everything)[pure])
    small = once.factors(rows.astype(np.int16), columns.astype(np.int16), travel_mm=5.0, polarisation=1.0)
    np.testing.assert_array_equal(small, once.factors(rows, columns, travel_mm=5.0, polarisation=1.0))
    assert forward[0].dtype == np.float32
    assert frame(once, 0.0, np.arange(0)).shape == (0,)


def spectral_patterns(spread: float) -> np.ndarray:
    """Weights of the independent patterns of a Gaussian line, the eigenvalues of its colours' correlation.

    ``spread`` is the standard deviation of the phase g k h over the heights, times that of k over the line by its mean.
    """
    q, dq = np.linspace(-7, 7, 201, retstep=True)
    density = np.sqrt(stats.norm.pdf(q) * dq)
    kernel = np.exp(-0.5 * (spread * (q[:, None] - q)) ** 2)
    return np.linalg.eigvalsh(density[:, None] * kernel * density)[::-1]


@pytest.mark.parametrize(("roughness_um", "linewidth_nm"), [(5.0, 0.2), (10.0, 1.0), (60.0, 2.0)])
def test_coherence_of_a_rough_surface(roughness_um, linewidth_nm):
    # The spectrum as wavenumbers in 1/um, its standard deviation from the half maxima of the line.
    k = 2 * math.pi / (1e-3 * (WAVELENGTH_NM + np.array([-0.5, 0.5]) * linewidth_nm))
    spread = abs(k[1] - k[0]) / 2.354820 * roughness_um * 1.33 * 2
    found = coherence(roughness_um, linewidth_nm=linewidth_nm, wavelength_nm=WAVELENGTH_NM, index=1.33)
    # The line's edges give 1e-6 of asymmetry, its cut at seven standard deviations less.
    assert found == pytest.approx(math.sqrt(np.sum(spectral_patterns(spread) ** 2)), rel=1e-4)
    assert 0 < found < 1


def test_a_smooth_surface_or_a_sharp_line_is_coherent():
    assert coherence(0.0, linewidth_nm=5.0, wavelength_nm=WAVELENGTH_NM) == 1
    assert coherence(50.0, linewidth_nm=0.0, wavelength_nm=WAVELENGTH_NM) == 1
    falling = coherence(np.array([1.0, 10.0, 100.0, 1e4]), linewidth_nm=1.0, wavelength_nm=WAVELENGTH_NM)
    assert (np.diff(falling) < 0).all()


@pytest.mark.parametrize("contrast", [0.05, 0.5, 0.97])
def test_finite_coherence_is_a_sum_of_patterns(lens, contrast):
    sample = coarse_sample(lens, polarisation=1.0, coherence=contrast)
    expected = contrast * integrated_contrast(grain_px(100.0))
    assert sample.std() / sample.mean() == pytest.approx(expected, rel=5 / math.sqrt(len(sample)))
    assert sample.mean() == pytest.approx(1.0, abs=5 * contrast / math.sqrt(len(sample)))
    assert sample.min() >= 0
    if contrast == 0.5:
        # The third cumulant of a sum of exponential values is 2 sum w^3; 30000 values give 3 %. A single pattern on an
        # even light would have 2 C^3, half as much again.
        weights = spectral_patterns(math.sqrt((contrast**-4 - 1) / 4))
        assert np.sum(weights**2) == pytest.approx(contrast**2, rel=1e-6)
        assert stats.moment(sample, order=3) == pytest.approx(2 * np.sum(weights**3), rel=0.15)
        assert 2 * contrast**3 > 1.4 * 2 * np.sum(weights**3)


def test_pixels_may_differ_in_polarisation_and_coherence(lens):
    speckle = Speckle(lens(100.0), wavelength_nm=WAVELENGTH_NM, seed=10)
    rows, columns = (g.ravel() for g in np.mgrid[0:195:15, 0:1270:15])
    left = columns < 600
    polarised, coherent = np.where(left, 1.0, 0.0), np.where(left, 1.0, 0.6)
    frames = np.array(
        [
            speckle.factors(
                rows, columns, travel_mm=3 * i * speckle.renewal_mm, polarisation=polarised, coherence=coherent
            )
            for i in range(20)
        ]
    )
    # Ten thousand values each: 1 % of scatter at most.
    assert frames[:, left].size > 10000
    assert frames[:, left].std() == pytest.approx(1.0, abs=0.05)
    assert frames[:, ~left].std() == pytest.approx(0.6 * math.sqrt(0.5), abs=0.025)


def test_lenses_without_image_or_with_wide_grains_are_refused(lens):
    with pytest.raises(DesignError, match="pixels wide"):
        Speckle(lens(1000.0), wavelength_nm=WAVELENGTH_NM, seed=0)
    with pytest.raises(DesignError, match="focus_distance_mm"):
        Speckle(lens(4.0, focus_distance_mm=10.0), wavelength_nm=WAVELENGTH_NM, seed=0)
