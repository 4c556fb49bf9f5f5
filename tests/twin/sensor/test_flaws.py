"""Flaws of real recordings as functions of arrays: glare, vignetting, colour filters, compression, true sensors."""

import io

import cv2
import numpy as np
import pytest
from PIL import Image

from tests.virtual_sensors import altered
from twin.rendering_options import Flaws
from twin.sensor.detector import (
    GHOST_BLUR,
    GLARE_REACH,
    add_ghost,
    add_glare,
    as_built,
    deliver_image,
    laser_shares,
    vignette,
)
from uwlts.errors import DescriptionError


def test_glare_is_the_sum_over_all_pixels_of_light_that_falls_off_exponentially():
    rng = np.random.default_rng(1)
    light = rng.exponential(size=(150, 203)).astype(np.float32)
    light[70:74] += 40.0  # a stripe
    light[20, 160] = 3000.0  # a reflection
    seen, reach = add_glare(light, 0.1), GLARE_REACH * 203
    rows, columns = np.mgrid[:150, :203]
    places = rng.integers((0, 0), (150, 203), (200, 2))
    veil = np.array(
        [
            (light * np.exp(-np.hypot(rows - row, columns - column) / reach)).sum() / (2 * np.pi * reach**2)
            for row, column in places
        ]
    )
    found = (seen - 0.9 * light)[tuple(places.T)] / 0.1
    # Cells of a sixteenth of the reach move light by up to half of themselves: 3 % of what falls off over one reach.
    np.testing.assert_allclose(found, veil, rtol=0.03)
    assert abs((found / veil).mean() - 1) < 0.005
    assert veil.max() > 2 * veil.min(), "the veil is uneven"


def test_glare_keeps_light_that_does_not_leave_the_image():
    light = np.zeros((640, 320), np.float32)
    light[320, 160] = 1.0
    seen = add_glare(light, 0.2).astype(float)
    rows, columns = np.mgrid[-320:320, -160:160]
    reach = GLARE_REACH * 320
    within = np.exp(-np.hypot(rows, columns) / reach).sum() / (2 * np.pi * reach**2)
    assert 1 - (1 + 3.33) * np.exp(-3.33) < within < 1, "more than a disc of the image's width holds"
    # The kernel is summed in cells of a sixteenth of its reach: some 1e-3 of the share.
    assert seen.sum() == pytest.approx(1 - 0.2 * (1 - within), abs=1e-3)
    assert seen[320, 160] == pytest.approx(0.8, abs=1e-3)


def test_a_ghost_is_mirrored_at_the_principal_point(thesis):
    camera = altered(thesis, {"camera": {"principal_point_px": (600.0, 500.0)}}).camera
    light = np.zeros((1024, 1280), np.float32)
    light[400, 900] = 1.0
    seen = add_ghost(light, camera, 0.01).astype(float)
    assert seen.sum() == pytest.approx(1.0, abs=1e-4)
    assert seen[400, 900] == pytest.approx(0.99)
    seen[400, 900] = 0.0
    rows, columns = np.indices(seen.shape)
    row, column = ((seen * each).sum() / seen.sum() for each in (rows, columns))
    assert (row, column) == pytest.approx((600.0, 300.0), abs=0.05)
    # OpenCV cuts the Gaussian off at four standard deviations.
    spread = np.sqrt((seen * (rows - row) ** 2).sum() / seen.sum())
    assert spread == pytest.approx(GHOST_BLUR * 1280, rel=0.02)


def test_vignetting_is_the_stated_loss_at_the_farthest_corner(thesis):
    camera = altered(thesis, {"camera": {"principal_point_px": (630.0, 520.0)}}).camera
    share = vignette(camera, 0.4)
    assert share.shape == (1024, 1280)
    assert share[520, 630] == 1.0
    assert share[0, -1] == share.min() == pytest.approx(0.6, abs=1e-6)
    assert share[260, 630 + 649 // 2] == pytest.approx(1 - 0.4 / 4, abs=1e-3), "half way there"


def test_light_of_the_lamp_passes_the_colour_filters_unchanged():
    image = np.full((48, 64), 137, np.uint8)
    np.testing.assert_array_equal(deliver_image(image, Flaws(colour_filter=True)), image)
    wide = np.full((48, 64), 3000, np.uint16)
    np.testing.assert_array_equal(deliver_image(wide, Flaws(colour_filter=True)), wide)


def test_light_of_the_laser_is_seen_by_one_pixel_in_four():
    shares = laser_shares(47, 65)
    assert shares.shape == (47, 65)
    assert (shares[::2, ::2] == 1).all()
    assert (shares[1::2] < 0.1).all() and (shares[:, 1::2] < 0.1).all()
    raw = np.rint(200 * shares).astype(np.uint8)
    np.testing.assert_array_equal(deliver_image(raw, Flaws(colour_filter=True)), 200)
    # The mean of two red rows of 200 and 100 is between them: green and blue do not contribute.
    raw[0::4] //= 2
    red = deliver_image(raw, Flaws(colour_filter=True))
    np.testing.assert_array_equal(red[3:-4:4, 2:-2], 150)


@pytest.mark.parametrize("quality", [50, 90])
def test_compression_is_that_of_another_encoder(quality):
    rng = np.random.default_rng(2)
    smooth = cv2.GaussianBlur(rng.normal(size=(96, 128)), (0, 0), 6.0)
    image = np.clip(120 + 600 * smooth + rng.normal(size=smooth.shape), 0, 255).astype(np.uint8)
    seen = deliver_image(image, Flaws(jpeg=quality))
    file = io.BytesIO()
    Image.fromarray(image).save(file, "JPEG", quality=quality)
    other = Image.open(file)
    # Both round the result of the cosine transform differently.
    assert np.abs(seen.astype(int) - np.asarray(other)).max() <= 1
    assert seen.dtype == np.uint8 and (seen != image).any()
    # An even error of a step q of the quantisation has the rms q / sqrt(12); most coefficients are smaller than that.
    steps = np.array(other.quantization[0])
    assert np.sqrt(np.mean((seen.astype(float) - image) ** 2)) < np.sqrt(np.mean(steps**2) / 12)


def test_compression_blurs_light_of_one_colour():
    raw = np.zeros((64, 64), np.uint8)
    raw[32] = 200  # a red row
    shares = laser_shares(64, 64)
    raw = np.rint(raw * shares).astype(np.uint8)
    width = [
        np.count_nonzero(deliver_image(raw, flaws)[:, 32] > 20)
        for flaws in (Flaws(colour_filter=True), Flaws(colour_filter=True, jpeg=95))
    ]
    assert width[0] == 3, "between red rows the mean of both"
    assert width[1] > width[0]


def test_flaws_of_pixels_lens_and_shutter_are_built_into_the_sensor(thesis_as_built):
    flaws = Flaws(pixel_aspect=1.003, tangential=-0.002, rolling_shutter=12.0)
    built = as_built(thesis_as_built, flaws)
    described = thesis_as_built.camera
    assert built.camera.focal_lengths_px() == pytest.approx((described.focal_length_px(),) * 2 * np.array([1, 1.003]))
    assert built.camera.distortion == described.distortion.model_copy(update={"p1": -0.002})
    assert (built.detector.shutter, built.detector.line_time_us) == ("rolling", 12.0)
    assert as_built(thesis_as_built, Flaws()) == thesis_as_built
    with pytest.raises(DescriptionError, match=r"jpeg holds 8-bit images, the sensor 'thesis' gives 12 bits: take"):
        as_built(altered(thesis_as_built, {"name": "thesis", "detector": {"bits": 12}}), Flaws(jpeg=90))
