"""Stripe centre of the thesis: LabVIEW's low-pass filter, and the vertex of a parabola through the peak."""

import numpy as np
import pytest

from uwlts.errors import RangeError
from uwlts.model.stripe import Stripe
from uwlts.stripe import StripeOptions, extract_stripe
from uwlts.stripe.extract import apply_low_pass, fit_low_passed

LINES, LENGTH = 40, 64


def by_definition(image, *, tolerance):
    """Return IMAQ LowPass by its manual, pixel by pixel, except at the border, and the relative deviations."""
    grey = image.astype(float)
    out, deviation = grey.copy(), np.full(image.shape, np.nan)
    for row in range(2, len(grey) - 2):
        for column in range(2, grey.shape[1] - 2):
            block = grey[row - 2 : row + 3, column - 2 : column + 3]
            mean = (block.sum() - grey[row, column]) / 24
            deviation[row, column] = abs(grey[row, column] - mean) / mean
            if abs(grey[row, column] - mean) > tolerance * mean:
                out[row, column] = mean
    return out, deviation


@pytest.mark.parametrize(("value", "kept"), [(139, True), (141, False), (61, True), (59, False)])
def test_a_pixel_within_forty_percent_of_its_neighbours_stays(value, kept):
    image = np.full((15, 15), 100, np.uint8)
    image[7, 7] = value
    smooth = apply_low_pass(image, tolerance=0.4)
    assert smooth[7, 7] == pytest.approx(value if kept else 100.0, abs=1e-4)
    # The odd pixel is one of 24 neighbours of those around it, which are within 2 % of their mean.
    image[7, 7] = 100
    around = np.ones(image.shape, bool)
    around[7, 7] = False
    np.testing.assert_array_equal(smooth[around], image[around])


@pytest.mark.parametrize(("dtype", "top"), [(np.uint8, 255), (np.uint16, 65535)])
@pytest.mark.parametrize("tolerance", [0.0, 0.4])
def test_the_filter_is_that_of_the_manual(dtype, top, tolerance):
    image = np.random.default_rng(0).integers(1, top, (24, 30), endpoint=True).astype(dtype)
    expected, deviation = by_definition(image, tolerance=tolerance)
    smooth = apply_low_pass(image, tolerance=tolerance)
    assert smooth.dtype == np.float32
    # Sums of 25 pixels rounded to float32: 6e-8 of 25 times full scale, a few times, over 24.
    inside = np.abs(deviation - tolerance) > 1e-5
    np.testing.assert_allclose(smooth[inside], expected[inside], atol=5e-7 * top)
    changed = expected[inside] != image[inside]
    assert np.count_nonzero(inside) >= 19 * 26
    assert changed.mean() > (0.99 if tolerance == 0 else 0.3)
    assert tolerance == 0 or changed.mean() < 0.9


def test_black_stays_black():
    np.testing.assert_array_equal(apply_low_pass(np.zeros((9, 9), np.uint8), tolerance=0.4), np.zeros((9, 9)))


def fit(image, centres, *, tolerance=0.4, fitted_px=5):
    """Fit the stripe of an image with known centres (LINES,), position first."""
    known = Stripe(
        centres,
        np.ones(LINES, np.float32),
        np.full(LINES, 4.0, np.float32),
        np.zeros(LINES, np.uint8),
        stripe_along="width",
    )
    found = fit_low_passed(image, known, tolerance=tolerance, fitted_px=fitted_px)
    for name in ("amplitude", "width_px", "status"):
        np.testing.assert_array_equal(getattr(found, name), getattr(known, name))
    return found.centre_px


def parabolas(vertices, *, height=60000, curvature=640):
    """An image (LENGTH, LINES) of 16 bit with a parabola on each column; exact for vertices in eighths of a pixel."""
    values = height - curvature * (np.arange(LENGTH)[:, None] - vertices) ** 2
    image = np.clip(values, 0, None).astype(np.uint16)
    assert (image == np.clip(values, 0, None)).all()
    return image


@pytest.mark.parametrize("fitted_px", [3, 5, 7])
@pytest.mark.parametrize("vertices", [30.0 + np.arange(LINES) / 8, 41.5 - np.arange(LINES) / 8])
def test_the_vertex_of_a_sampled_parabola_is_exact(vertices, fitted_px):
    # The approximate position decides where to search, not the result.
    known = vertices + np.random.default_rng(1).uniform(-5, 5, LINES)
    # Differences of whole numbers below 2^24 are exact in float32; the fit's weights are rounded at 1e-16.
    np.testing.assert_allclose(fit(parabolas(vertices), known, fitted_px=fitted_px), vertices, atol=1e-10)


def test_the_mean_of_the_neighbours_keeps_a_parabolas_vertex():
    vertices = np.full(LINES, 30.375)
    # The mean of a parabola's samples is the parabola, lower. Float32 rounds 6e4 by 0.002; the slope of the fit is a
    # mean of five with weights of 0.2, the vertex the slope over twice the curvature: 4 * 0.002 * 0.45 / 1280.
    np.testing.assert_allclose(fit(parabolas(vertices), vertices, tolerance=0.0), vertices, atol=1e-5)


def test_noise_within_the_tolerance_is_not_smoothed():
    """Noise that the plain mean removes reaches the fit through LabVIEW's filter: 25 pixels against a few."""
    rng, vertices = np.random.default_rng(2), np.full(LINES, 30.0)
    images = [
        (parabolas(vertices, height=40000, curvature=320) + rng.normal(0, 100, (LENGTH, LINES))).astype(np.uint16)
        for _ in range(4)
    ]
    spreads = [
        np.std([fit(image, vertices, tolerance=tolerance) - vertices for image in images]) for tolerance in (0.4, 0.0)
    ]
    # Slope of a line through five pixels: 100 / sqrt(10); over 640 per px. A standard deviation of 160 is good to
    # 5.6 %; 3.5 of it. Of the mean of 24 less than half is left.
    assert spreads[0] == pytest.approx(100 / np.sqrt(10) / 640, rel=0.2)
    assert spreads[1] < 0.5 * spreads[0]


def test_the_tolerance_decides_what_is_smoothed():
    """Limit of 40 %: a pixel 30 % above its neighbours remains, and shifts the vertex towards it."""
    image = parabolas(np.full(LINES, 30.0))
    image[31] = (1.3 * image[31]).astype(np.uint16) // 2
    default, lower = (fit(image, np.full(LINES, 30.0), tolerance=tolerance) for tolerance in (0.4, 0.2))
    assert (np.abs(default - lower)[2:-2] > 0.01).all()


def test_a_plateau_is_placed_at_the_stripe_known_or_in_its_own_middle():
    image = np.full((LENGTH, LINES), 10, np.uint8)
    image[26:35, :20] = 255
    image[28:33, 20:] = [[180], [225], [255], [225], [180]]
    image[29:32, 30:] = 255
    centre = fit(image, np.full(LINES, 30.3))
    # Nine pixels wide: no vertex within the fit. Three pixels or one: the same on both sides, so exactly the middle;
    # columns 17 to 32 are left out, where the filter sees different stripes side by side.
    np.testing.assert_allclose(centre[:17], 30.0, atol=1e-10)
    np.testing.assert_allclose(centre[23:27], 30.0, atol=1e-10)
    np.testing.assert_allclose(centre[33:], 30.0, atol=1e-10)


def test_the_vertex_stays_within_the_fit():
    """A peak at the rim of the searched range, on a slope, without a vertex there."""
    image = np.repeat((np.arange(LENGTH, dtype=np.uint16) ** 2 * 10)[:, None], LINES, axis=1)
    assert (np.abs(fit(image, np.full(LINES, 30.0)) - 30.0) <= 8 + 2).all()


def test_stripes_at_the_border_of_the_image_have_a_finite_centre():
    vertices = np.concatenate([np.full(LINES // 2, 0.25), np.full(LINES // 2, LENGTH - 1.25)])
    # Pixels beyond the border are repeated, which shifts the vertex towards it by less than the fit's half width.
    assert (np.abs(fit(parabolas(vertices), vertices) - vertices) < 2).all()


@pytest.mark.parametrize("stripe_along", ["width", "height"])
def test_the_option_replaces_the_centres_of_the_other_methods(stripe_along):
    """The lines, heights and widths stay; images rotated by a quarter turn give the same centres."""
    rows = np.arange(200.0)[:, None]
    image = 20 + 200 * np.exp(-0.5 * ((rows - 80.3 - 0.01 * np.arange(LINES)) / 2.5) ** 2)
    image = np.random.default_rng(3).poisson(image).astype(np.uint8)
    turned = image if stripe_along == "width" else np.ascontiguousarray(image.T)
    plain, fitted = (
        extract_stripe(turned, stripe_along=stripe_along, options=StripeOptions(low_pass=low_pass))
        for low_pass in (None, 0.4)
    )
    np.testing.assert_array_equal(plain.amplitude, fitted.amplitude)
    lines = plain.lines
    assert len(lines) > 30
    expected = fit_low_passed(image, plain, tolerance=0.4, fitted_px=5).centre_px
    np.testing.assert_array_equal(fitted.centre_px, expected)
    assert 0 < np.abs(fitted.centre_px - plain.centre_px)[lines].max() < 2


@pytest.mark.parametrize("wrong", [{"low_pass": -0.1}, {"low_pass_fit_px": 4}, {"low_pass_fit_px": 1}])
def test_settings_out_of_range_are_refused(wrong):
    with pytest.raises(RangeError, match=next(iter(wrong))):
        StripeOptions(**wrong)
