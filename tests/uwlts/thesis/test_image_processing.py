"""Stripe centre of the thesis: LabVIEW's low-pass filter, and the vertex of a parabola through the peak."""

import numpy as np
import pytest

from uwlts.model.library import load_sensor
from uwlts.model.sensor import Medium
from uwlts.storage.capture import Capture, CaptureHeader, Frame
from uwlts.storage.capture_writer import CaptureWriter
from uwlts.stripe import CaptureStripes
from uwlts.thesis.measurements import apply_low_pass, thesis_stripes

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


def capture(path, images, *, stripe_along):
    """Write a capture of images with a stripe along the width, rotated for a stripe along the height."""
    images = images if stripe_along == "width" else [np.ascontiguousarray(image.T) for image in images]
    sensor = load_sensor("thesis")
    size = {"height_px": images[0].shape[0], "width_px": images[0].shape[1], "stripe_along": stripe_along}
    sensor = sensor.model_copy(update={"camera": sensor.camera.model_copy(update=size)})
    header = CaptureHeader(
        name="stripe",
        sensor=sensor,
        medium_name="air",
        medium=Medium(kind="air"),
        saturation_dn=65535,
        stage_direction=(1.0, 0.0, 0.0),
    )
    with CaptureWriter(path, header, dtype=images[0].dtype) as writer:
        for number, image in enumerate(images):
            writer.append(Frame(image, float(number), True, 1.0, 0.0))
    return Capture(path)


def found(centres):
    """Stripes of images at centres (F, LINES), on every line."""
    frames, lines = np.indices(centres.shape)
    return CaptureStripes(
        frames.ravel(),
        lines.ravel(),
        centres.ravel(),
        np.ones(centres.size),
        np.full(centres.size, 4.0),
        {"ok": centres.size},
    )


def parabolas(vertices, *, height=60000, curvature=640):
    """An image (LENGTH, LINES) of 16 bit with a parabola on each column; exact for vertices in eighths of a pixel."""
    values = height - curvature * (np.arange(LENGTH)[:, None] - vertices) ** 2
    image = np.clip(values, 0, None).astype(np.uint16)
    assert (image == np.clip(values, 0, None)).all()
    return image


VERTICES = np.array([30.0 + np.arange(LINES) / 8, 41.5 - np.arange(LINES) / 8])


@pytest.mark.parametrize("stripe_along", ["width", "height"])
@pytest.mark.parametrize("fitted_px", [3, 5, 7])
def test_the_vertex_of_a_sampled_parabola_is_exact(tmp_path, stripe_along, fitted_px):
    images = [parabolas(vertices) for vertices in VERTICES]
    # The approximate position decides where to search, not the result.
    known = found(VERTICES + np.random.default_rng(1).uniform(-5, 5, VERTICES.shape))
    with capture(tmp_path / "stripe.h5", images, stripe_along=stripe_along) as opened:
        measured = thesis_stripes(opened, known, fitted_px=fitted_px)
    # Differences of whole numbers below 2^24 are exact in float32; the fit's weights are rounded at 1e-16.
    np.testing.assert_allclose(measured.centre_px, VERTICES.ravel(), atol=1e-10)
    for name in ("frame", "line", "amplitude"):
        np.testing.assert_array_equal(getattr(measured, name), getattr(known, name))
    assert measured.lines_by_status == known.lines_by_status


def test_the_mean_of_the_neighbours_keeps_a_parabolas_vertex(tmp_path):
    vertices = np.full((1, LINES), 30.375)
    with capture(tmp_path / "stripe.h5", [parabolas(vertices[0])], stripe_along="width") as opened:
        measured = thesis_stripes(opened, found(vertices), tolerance=0.0)
    # The mean of a parabola's samples is the parabola, lower. Float32 rounds 6e4 by 0.002; the slope of the fit is a
    # mean of five with weights of 0.2, the vertex the slope over twice the curvature: 4 * 0.002 * 0.45 / 1280.
    np.testing.assert_allclose(measured.centre_px, vertices.ravel(), atol=1e-5)


def test_noise_within_the_tolerance_is_not_smoothed(tmp_path):
    """Noise that the plain mean removes reaches the fit through LabVIEW's filter: 25 pixels against a few."""
    rng, vertices = np.random.default_rng(2), np.full((4, LINES), 30.0)
    images = [
        (parabolas(row, height=40000, curvature=320) + rng.normal(0, 100, (LENGTH, LINES))).astype(np.uint16)
        for row in vertices
    ]
    spreads = []
    with capture(tmp_path / "stripe.h5", images, stripe_along="width") as opened:
        for tolerance in (0.4, 0.0):
            measured = thesis_stripes(opened, found(vertices), tolerance=tolerance)
            spreads.append(np.std(measured.centre_px - vertices.ravel()))
    # Slope of a line through five pixels: 100 / sqrt(10); over 640 per px. A standard deviation of 160 is good to
    # 5.6 %; 3.5 of it. Of the mean of 24 less than half is left.
    assert spreads[0] == pytest.approx(100 / np.sqrt(10) / 640, rel=0.2)
    assert spreads[1] < 0.5 * spreads[0]


def test_unless_set_the_tolerance_is_labviews(tmp_path):
    """Limit of 40 %: a pixel 30 % above its neighbours remains, and shifts the vertex towards it."""
    image = parabolas(np.full(LINES, 30.0))
    image[31] = (1.3 * image[31]).astype(np.uint16) // 2
    known = found(np.full((1, LINES), 30.0))
    with capture(tmp_path / "stripe.h5", [image], stripe_along="width") as opened:
        default, manual, lower = (
            thesis_stripes(opened, known, **how).centre_px for how in ({}, {"tolerance": 0.4}, {"tolerance": 0.2})
        )
    np.testing.assert_array_equal(default, manual)
    assert (np.abs(default - lower)[2:-2] > 0.01).all()


def test_a_plateau_is_placed_at_the_stripe_known_or_in_its_own_middle(tmp_path):
    image = np.full((LENGTH, LINES), 10, np.uint8)
    image[26:35, :20] = 255
    image[28:33, 20:] = [[180], [225], [255], [225], [180]]
    image[29:32, 30:] = 255
    known = np.full((1, LINES), 30.3)
    with capture(tmp_path / "stripe.h5", [image], stripe_along="width") as opened:
        centre = thesis_stripes(opened, found(known)).centre_px
    # Nine pixels wide: no vertex within the fit. Three pixels or one: the same on both sides, so exactly the middle;
    # columns 17 to 32 are left out, where the filter sees different stripes side by side.
    np.testing.assert_allclose(centre[:17], 30.0, atol=1e-10)
    np.testing.assert_allclose(centre[23:27], 30.0, atol=1e-10)
    np.testing.assert_allclose(centre[33:], 30.0, atol=1e-10)


def test_the_vertex_stays_within_the_fit(tmp_path):
    """A peak at the rim of the searched range, on a slope, without a vertex there."""
    image = np.repeat((np.arange(LENGTH, dtype=np.uint16) ** 2 * 10)[:, None], LINES, axis=1)
    known = np.full((1, LINES), 30.0)
    with capture(tmp_path / "stripe.h5", [image], stripe_along="width") as opened:
        centre = thesis_stripes(opened, found(known)).centre_px
    assert (np.abs(centre - known) <= 8 + 2).all()


def test_stripes_at_the_border_of_the_image_have_a_finite_centre(tmp_path):
    vertices = np.concatenate([np.full(LINES // 2, 0.25), np.full(LINES // 2, LENGTH - 1.25)])
    with capture(tmp_path / "stripe.h5", [parabolas(vertices)], stripe_along="width") as opened:
        centre = thesis_stripes(opened, found(vertices[None])).centre_px
    # Pixels beyond the border are repeated, which shifts the vertex towards it by less than the fit's half width.
    assert (np.abs(centre - vertices) < 2).all()
