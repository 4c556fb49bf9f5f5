"""Centres of stripes on surfaces of uneven brightness, integrated over the sheet's thickness and over the blur."""

import numpy as np
import pytest

from tests.uwlts.calibration_views import WATER
from tests.uwlts.joint_views import MEDIUM, seen
from uwlts.model.joint_estimate import JointEstimate
from uwlts.model.placement import camera_from_object, laser_pose
from uwlts.optics.brightness import IlluminatedPoints, estimate_blur_shift_px, fit_brightness_slopes, sheet_sigma_mm
from uwlts.optics.nominal import nominal_calibration
from uwlts.reconstruction.reconstruct import reconstruct_stripes
from uwlts.storage.capture import Capture, CaptureHeader, Frame
from uwlts.storage.capture_writer import CaptureWriter
from uwlts.stripe import CaptureStripes, extract_stripe

STAGE = 3.0 + np.arange(7.0)
LINES = np.arange(600, 641)
LEAN, FADING = 0.3, 0.4
"""Slope of the surface, mm of Z per mm of X, and relative decrease of its brightness per mm."""


def surface_z(x):
    return 20.0 + LEAN * x


def thick_stripe(sensor, stage):
    """Centres (L,) that the columns show of a sheet of Gaussian profile on the surface, in an image of the stage."""
    frame = camera_from_object(sensor)
    origin = frame[:3, :3].T @ (laser_pose(sensor).origin_mm - frame[:3, 3])
    beside, weights, rows = np.linspace(-0.6, 0.6, 41), [], []
    for t in beside:
        y = np.linspace(-12.0, 12.0, 25)
        points = np.column_stack([np.full(len(y), stage + t), y, surface_z(stage + t) * np.ones(len(y))])
        at_stage = points - [stage, 0.0, 0.0]
        pixels = seen(sensor, at_stage @ frame[:3, :3].T + frame[:3, 3], index=WATER, window=True)
        order = np.argsort(pixels[:, 0])
        rows.append(np.interp(LINES, pixels[order, 0], pixels[order, 1]))
        sigma = sheet_sigma_mm(sensor.laser, np.linalg.norm(at_stage[12] - origin), medium_index=WATER)
        weights.append(np.exp(-0.5 * (t / sigma) ** 2 + FADING * (stage + t)))
    return np.average(rows, axis=0, weights=weights)


def test_the_footprint_is_that_of_sheet_and_blur(thesis):
    """A stripe as wide as the described sheet makes it with a blur of 1.2 px, on a plane at the stand-off.

    The plane is square to the laser; its stripe's shift and the lines' spacing are of points seen through the window.
    """
    blur_px = 1.2
    frame = camera_from_object(thesis)
    points = np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.0, 1.0, 0.0]])
    pixels = seen(thesis, points @ frame[:3, :3].T + frame[:3, 3], index=WATER, window=True)
    origin = frame[:3, :3].T @ (laser_pose(thesis).origin_mm - frame[:3, 3])
    sigma = float(sheet_sigma_mm(thesis.laser, np.linalg.norm(points[0] - origin), medium_index=WATER))
    per_mm, per_line = abs(pixels[1, 1] - pixels[0, 1]) / 0.1, 1.0 / abs(pixels[2, 0] - pixels[0, 0])
    width = 2.3548 * np.hypot(blur_px, sigma * per_mm)
    calibration = nominal_calibration(thesis, medium=MEDIUM)
    line, centre = np.full(50, pixels[0, 0]), np.full(50, pixels[0, 1])
    sheet = IlluminatedPoints.from_calibration(calibration, thesis, line, centre, medium_index=WATER)
    assert sheet.footprint_mm(np.full(50, width)) == pytest.approx((np.sqrt(3) * sigma, blur_px * per_line), rel=0.01)


@pytest.mark.parametrize("blur_px", [0.4, 1.5])
def test_a_point_is_the_mean_of_the_footprint(blur_px):
    """Stripes on paraboloids of both signs, by what each pixel sees: the radiance of the place where its ray ends.

    A bend of 2 b moves the centre by b times the variance of the footprint across the sheet, 3 times the sheet's. The
    limit is twice the uncertainty that is stated for the method's weights; of 2000 lines noise makes 0.1.
    """
    sheet_px, bend = 1.2, 0.01
    fine = np.arange(-60, 60, 0.02)
    u = np.linspace(-8, 8, 4001)
    blur = np.exp(-0.5 * (np.arange(-6, 6.01, 0.02) / blur_px) ** 2)
    centres = []
    for sign in (-1, 1):
        radiance = np.interp(fine, u + sign * bend * u**2, np.exp(-0.5 * (u / sheet_px) ** 2), left=0, right=0)
        image = np.convolve(radiance, blur / blur.sum(), "same").reshape(-1, 50).mean(axis=1)
        # The same speckle of 30 % for both.
        rng = np.random.default_rng(5)
        light = 180 * image[:, None] * rng.gamma(1 / 0.09, 0.09, (len(image), 2000))
        grey = np.clip(light + rng.normal(0, 1, light.shape) + 5, 0, 255).astype(np.uint8)
        found = extract_stripe(grey, stripe_along="width")
        centres.append(float(np.nanmean(found.centre_px)))
    seen = (centres[1] - centres[0]) / (2 * bend * sheet_px**2)
    assert seen == pytest.approx(3, rel=0.33)


def test_points_lie_where_the_light_comes_from(thesis, tmp_path):
    """Uncorrected points have errors of 9 um along the camera's rays; the sheet's curved image causes 0.3 um."""
    header = CaptureHeader(
        name="scan",
        sensor=thesis,
        medium_name="water",
        medium=MEDIUM,
        stage_direction=(1.0, 0.0, 0.0),
        saturation_dn=255,
    )
    image = np.zeros((thesis.camera.height_px, thesis.camera.width_px), np.uint8)
    with CaptureWriter(tmp_path / "scan.h5", header, dtype=np.uint8) as writer:
        for stage in STAGE:
            writer.append(Frame(image, stage, True, 1.0, stage))
    centres = np.concatenate([thick_stripe(thesis, stage) for stage in STAGE])
    frame = np.repeat(np.arange(len(STAGE)), len(LINES))
    bright = 50.0 * np.exp(FADING * (STAGE[frame] - STAGE.mean()))
    stripes = CaptureStripes(frame, np.tile(LINES, len(STAGE)), centres, bright, np.full(len(frame), 4.0), {})
    plain = nominal_calibration(thesis, thesis.media["water"])
    joint = plain.model_copy(update={"joint": JointEstimate.model_construct()})
    with Capture(tmp_path / "scan.h5") as capture:
        off = []
        for calibration in (plain, joint):
            points = reconstruct_stripes(capture, stripes, calibration).points_mm
            off.append((points[:, 2] - surface_z(points[:, 0])) / np.hypot(1.0, LEAN))
    assert len(off[0]) == len(off[1]) == len(frame)
    assert np.abs(off[0]).min() > 0.005
    assert np.abs(off[1]).max() < 0.0008


def test_the_sheet_is_no_thicker_than_the_stripes_are_wide(thesis):
    """A sheet described as ten times as thick counts as one that makes the stripes: 0.16 mm for 2.3548 px here."""
    line, centre = np.repeat(LINES, 2), np.tile([400.0, 600.0], len(LINES))
    slopes, width = np.full(len(line), 0.1), np.full(len(line), 2.3548)
    laser = thesis.laser.model_copy(update={"waist_radius_mm": 3.0})
    calibration = nominal_calibration(thesis, thesis.media["water"])
    thick, thin = (
        IlluminatedPoints.from_calibration(calibration, sensor, line, centre, medium_index=WATER).brightness_shift(
            width, slopes, stage_direction=(1, 0, 0)
        )
        for sensor in (thesis.model_copy(update={"laser": laser}), thesis)
    )
    along_z = thick / thick[:, 2:]
    np.testing.assert_allclose(thin / thin[:, 2:], along_z, rtol=1e-9)
    sigma = np.sqrt(np.abs(thick[:, 0]) / 0.1)
    assert ((sigma > 0.1) & (sigma < 0.25)).all()
    np.testing.assert_allclose(np.sqrt(np.abs(thin[:, 0]) / 0.1), 0.15, rtol=0.1)


def test_many_centres_see_the_sheet_as_few_do(thesis):
    """The table has errors of 1e-7 mm for points and 1e-6 for other values; ten times as much between its nodes."""
    calibration = nominal_calibration(thesis, thesis.media["water"])
    rng = np.random.default_rng(9)
    line, centre = rng.integers(100, 1180, 6000), rng.uniform(300.0, 700.0, 6000)
    many, few = (
        IlluminatedPoints.from_calibration(calibration, thesis, line[:count], centre[:count], medium_index=WATER)
        for count in (6000, 400)
    )
    np.testing.assert_allclose(many.found.points_mm[:400], few.found.points_mm, rtol=0, atol=1e-6)
    for name in ("of_slope", "sigma_mm", "per_sigma_px"):
        found, expected = getattr(many, name)[:400], getattr(few, name)
        assert np.abs(expected).max() > 1e-3
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-5)
    width = np.full(6000, 4.0)
    every = IlluminatedPoints.from_calibration(calibration, thesis, line + 0.0, centre, medium_index=WATER)
    assert many.footprint_mm(width) == pytest.approx(every.footprint_mm(width), rel=1e-5)


def ridge(lean, bend, fading, blur):
    """An image (H, W) of a thin bright curve under blur, and the curve's rows by column."""
    fine = np.arange(-20.0, 180.0, 0.1)

    def height(x):
        return 80.0 + lean * (x - 80) + 0.5 * bend * (x - 80) ** 2

    column = np.arange(160)
    along = np.exp(-0.5 * ((column[:, None] - fine) / blur) ** 2) * np.exp(fading * (fine - 80))
    across = np.exp(-0.5 * ((np.arange(160)[:, None] - height(fine)) / blur) ** 2)
    image = across @ along.T
    return image / image[:, 60:101].max() * 120, height(column)


@pytest.mark.parametrize(
    ("lean", "bend", "fading"),
    [(0.6, 0.0, 0.02), (-0.6, 0.0, 0.02), (0.0, 0.008, 0.0), (0.4, 0.004, -0.02), (0.0, 0.0, 0.02)],
)
def test_blur_moves_centres_of_leaning_and_bent_stripes(lean, bend, fading):
    """To second order; a fifth is allowed for higher orders. With images of 8 bits, centres have errors of 0.005 px."""
    blur = 1.6
    image, rows = ridge(lean, bend, fading, blur)
    stripe = extract_stripe(np.round(image).astype(np.uint8), stripe_along="width", saturation=255)
    lines = stripe.lines
    moved = estimate_blur_shift_px(
        np.zeros(len(lines), int), lines, stripe.centre_px[lines], stripe.amplitude[lines], stripe.width_px[lines]
    )
    middle = (lines >= 70) & (lines <= 90)
    assert middle.sum() > 15
    seen_px = np.mean((stripe.centre_px[lines] - rows[lines])[middle])
    assert np.mean(moved[middle]) == pytest.approx(seen_px, rel=0.2, abs=0.006)
    expected = blur**2 * (lean * fading + 0.5 * bend)
    assert seen_px == pytest.approx(expected, rel=0.3, abs=0.006)


def test_slopes_are_those_of_the_brightness_up_to_the_borders():
    frame, line = (a.ravel() for a in np.meshgrid(np.arange(9), np.arange(100, 160), indexing="ij"))
    stage = np.array([5.0, 0.0, 1.0, 2.0, 3.0, 4.0, 6.0, 7.0, 8.0])
    there = np.abs(line - 130) < 10 + 3 * frame
    amplitude = 40.0 * np.exp(0.3 * stage[frame] - 0.02 * line)
    slopes = fit_brightness_slopes(frame[there], line[there], amplitude[there], stage, np.ones(9))
    np.testing.assert_allclose(slopes, 0.3, atol=1e-9)


@pytest.mark.parametrize(
    "stage",
    [
        np.array([0.0, 1.0]),
        np.arange(0.0, 3.0, 0.05),
        np.repeat(np.arange(8.0), 2),
        np.concatenate([np.arange(8.0), np.arange(8.0)[::-1] + 0.002]),
    ],
    ids=["two images", "fine steps", "two images at each place", "there and back"],
)
def test_slopes_are_found_however_the_stage_goes(stage):
    frame, line = (a.ravel() for a in np.meshgrid(np.arange(len(stage)), np.arange(40), indexing="ij"))
    # Bent, so that neighbours beyond the reach would show.
    amplitude = 40.0 * np.exp(0.3 * stage[frame] + 0.05 * stage[frame] ** 2)
    slopes = fit_brightness_slopes(frame, line, amplitude, stage, np.ones(len(stage)))
    inner = (stage[frame] > 1.9) & (stage[frame] < stage.max() - 1.9)
    np.testing.assert_allclose(slopes[inner], 0.3 + 0.1 * stage[frame][inner], atol=0.02)
    assert np.abs(slopes - 0.3 - 0.1 * stage[frame]).max() < 0.11


def test_exposures_do_not_show_in_the_slopes():
    stage, exposure = np.arange(9.0), np.array([1.0, 1.0, 1.0, 1.0, 3.0, 3.0, 2.0, 2.0, 2.0])
    frame, line = (a.ravel() for a in np.meshgrid(np.arange(9), np.arange(40), indexing="ij"))
    amplitude = exposure[frame] * np.exp(0.3 * stage[frame])
    np.testing.assert_allclose(fit_brightness_slopes(frame, line, amplitude, stage, exposure), 0.3, atol=1e-9)
    alike = fit_brightness_slopes(frame, line, np.exp(0.3 * stage[frame]), stage, np.zeros(9))
    np.testing.assert_allclose(alike, 0.3, atol=1e-9)


@pytest.mark.parametrize(
    "stage",
    [np.zeros(4), 5.0 + 0.001 * np.array([0.3, -1.2, 0.8, 0.1]), np.arange(4) * 5.0, np.array([1.0])],
    ids=["one place", "one place, as read back", "far apart", "one image"],
)
def test_images_at_one_place_or_far_apart_tell_no_slope(stage):
    frame, line = (a.ravel() for a in np.meshgrid(np.arange(len(stage)), np.arange(50), indexing="ij"))
    assert not fit_brightness_slopes(frame, line, 10.0 + frame, stage, np.ones(len(stage))).any()


def test_speckle_hardly_shows_in_the_slopes():
    """20 % in each amplitude: with 125 neighbours over 4 mm 0.0127 per mm, 0.3 um of the sheet."""
    rng = np.random.default_rng(3)
    frame, line = (a.ravel() for a in np.meshgrid(np.arange(40), np.arange(400), indexing="ij"))
    amplitude = 60.0 * np.exp(0.2 * rng.standard_normal(len(frame)))
    slopes = fit_brightness_slopes(frame, line, amplitude, np.arange(40.0), np.ones(40))
    inner = (frame > 1) & (frame < 38) & (line > 12) & (line < 388)
    assert np.std(slopes[inner]) == pytest.approx(0.2 / np.sqrt(125 * 2.0), rel=0.15)


def test_the_sheet_is_thinnest_at_its_waist(thesis):
    laser = thesis.laser
    at = laser.waist_distance_mm + np.array([-200.0, 0.0, 200.0])
    sigma = sheet_sigma_mm(laser, at, medium_index=WATER)
    assert sigma[1] == 0.5 * laser.waist_radius_mm
    assert sigma[0] == sigma[2] > sigma[1]
    # Far away the angle is M2 lambda / (pi w0 n).
    far = sheet_sigma_mm(laser, np.array([1e6]), medium_index=WATER)[0] / 1e6
    angle = laser.beam_quality_m2 * 1e-6 * laser.wavelength_nm / (np.pi * laser.waist_radius_mm * WATER)
    assert 2 * far == pytest.approx(angle, rel=1e-3)
