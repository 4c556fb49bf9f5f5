"""The polynomial reference method, on views made by Fermat's principle and on drawn images."""

import json
from dataclasses import replace

import numpy as np
import pytest
from numpy.polynomial import legendre
from scipy.interpolate import CubicSpline

from tests.oracles.fermat import directions_seen, plate
from tests.uwlts.calibration_views import WATER, built_sensor, inside, lattice, lens_of, turn
from uwlts.calibration.camera.camera_parameters import TargetImage
from uwlts.calibration.capture_evidence import AirEvidence
from uwlts.calibration.polynomial.polynomial_calibration import (
    MOST_SMOOTH,
    calibrate_polynomials,
    fit_line_polynomials,
    fit_plate_map,
    fit_polynomials,
    line_domains,
)
from uwlts.cli.command_options import app
from uwlts.errors import CalibrationError, CaptureError, RangeError
from uwlts.model.placement import camera_from_object
from uwlts.model.sensor import Distortion, Medium
from uwlts.optics.nominal import nominal_calibration
from uwlts.optics.triangulation import reconstruct_by_polynomials
from uwlts.optics.window import RayStatus
from uwlts.reconstruction.reconstruct import reconstruct
from uwlts.report.file_description import describe
from uwlts.runtime.console import run
from uwlts.storage.calibration_file import load_calibration
from uwlts.storage.capture import Capture, CaptureHeader, Frame
from uwlts.storage.capture_writer import CaptureWriter
from uwlts.storage.cloud_files import read_cloud
from uwlts.targets import CircleTarget

DEPTHS = np.arange(-60.0, 101.0, 10.0)
FAR_OFF = 7.0
"""Stage position of the plate at Z = 0."""

# Smoothness in the thesis's volume. Z(position) is nearly A / (pole - position) with a pole five
# half ranges from the middle: the sixth degree leaves 2 A / rho**7 with A = 3 m and rho = 10, 0.5 um. Lens and window
# leave 16 mm times (view angle 0.27)**n of the plate's coordinates at degree n: 5 um at the sixth; a fit over
# the view leaves a quarter.
CLOSE_MM = 2e-3


def sensor_along(along):
    """The sensor without the laser's window, which would turn the sheet away from X = 0."""
    sensor = built_sensor()
    camera = sensor.camera.model_copy(update={"stripe_along": along})
    window = sensor.laser.window.model_copy(update={"mounted": False})
    return sensor.model_copy(update={"camera": camera, "laser": sensor.laser.model_copy(update={"window": window})})


def header_of(sensor, *, direction=(0.0, 0.0, 1.0), medium=None, **more):
    medium = Medium(kind="custom", index=WATER) if medium is None else medium
    return CaptureHeader(
        name="target",
        sensor=sensor,
        medium_name="water",
        medium=medium,
        stage_direction=direction,
        saturation_dn=255,
        **more,
    )


def pixels_of(sensor, points):
    """Images (N, 2) of points (N, 3) of the OCS, by least time through the window and Brown's lens."""
    frame, window = camera_from_object(sensor), sensor.camera.window
    faces = plate(distance=window.distance_mm, thickness=window.thickness_mm, normal=window.normal())
    rays = directions_seen(points @ frame[:3, :3].T + frame[:3, 3], faces, [1.0, window.index(635.0), WATER])
    return lens_of(sensor).pixels(rays)


def stripe_at(sensor, depth, *, tilt=0.0):
    """Lines (N,), centres (N,) and true points (N, 3) of the stripe on a plane at a depth, tilted about X."""
    y = np.linspace(-130, 130, 241)
    points = np.column_stack([np.zeros_like(y), y, depth + tilt * y])
    pixels = pixels_of(sensor, points)
    side = 0 if sensor.camera.stripe_along == "width" else 1
    size = (sensor.camera.width_px, sensor.camera.height_px)
    lines = np.arange(size[side])
    # The line of a point grows with Y, whichever way the stripe runs.
    assert (np.diff(pixels[:, side]) > 0).all()
    lines = lines[(lines > pixels[0, side]) & (lines < pixels[-1, side])]
    across, at = (CubicSpline(pixels[:, side], values)(lines) for values in (pixels[:, 1 - side], y))
    seen = (across >= 0) & (across <= size[1 - side] - 1)
    true = np.column_stack([np.zeros_like(at), at, depth + tilt * at])
    return lines[seen], across[seen], true[seen]


TARGET = CircleTarget(
    diameter_mm=0.02, marker_diameter_mm=0.01, columns=25, rows=25, origin=(12, 12), marker_x=(1, 0), marker_y=(0, 1)
)
"""Circles so small that the centres of their images are the images of their centres."""


def evidence_of(sensor, *, towards=1.0, spin=0.02, noise_px=0.0, seed=0, without=()):
    """Evidence from captures of the plate, turned by ``spin`` in its plane, with the stripe on every fourth line.

    Lines in ``without`` lack a stripe; lines between the fourth ones are interpolated, as dark lines are.
    """
    rng = np.random.default_rng(seed)
    images, stripes = [], []
    for depth in DEPTHS:
        points = lattice()[::2]
        in_object = points @ turn(z=spin).T + [1.3, -2.1, depth]
        pixels = pixels_of(sensor, in_object)
        here = inside(pixels, sensor)
        images.append(TargetImage(points[here], pixels[here], float(towards * (FAR_OFF - depth))))
        lines, centres, _ = stripe_at(sensor, depth)
        centres = centres + rng.normal(0, noise_px, len(centres)) if noise_px else centres
        kept = (lines % 4 == 0) & ~np.isin(lines, without)
        pair = (lines, centres) if sensor.camera.stripe_along == "width" else (centres, lines)
        stripes.append(np.column_stack(pair).astype(float)[kept])
    return AirEvidence(TARGET, images, [(0, k) for k in range(len(images))], stripes, [])


def measured(calibration, lines, centres):
    return reconstruct_by_polynomials(calibration, lines, centres, stage_mm=0.0, stage_direction=np.array([0, 0, 1.0]))


def errors_between(calibration, sensor, *, depths=(-55.0, -23.0, 8.7, 41.0, 93.0), tilt=0.03):
    """Errors (N, 2) of Y and Z at depths that were not calibrated at, with the rigid shift of the origin taken out."""
    errors = []
    for depth in depths:
        lines, centres, true = stripe_at(sensor, depth, tilt=tilt)
        found = measured(calibration, lines, centres)
        ok = found.status == RayStatus.OK
        assert np.isfinite(found.points_mm).all(axis=1).tolist() == ok.tolist()
        errors.append((found.points_mm - true)[ok])
    errors = np.vstack(errors)
    assert len(errors) > 0.75 * 5 * len(calibration.domains_px)
    assert (errors[:, 0] == 0).all()
    return errors[:, 1:] - np.median(errors[:, 1:], axis=0)


@pytest.fixture(scope="module")
def sensor():
    return sensor_along("width")


@pytest.fixture(scope="module")
def evidence(sensor):
    return evidence_of(sensor)


@pytest.fixture(scope="module")
def result(sensor, evidence):
    return fit_polynomials(evidence, header_of(sensor), degree=6)


# --- the method


def test_unseen_depths(sensor, result):
    errors = errors_between(result.calibration, sensor)
    assert np.abs(errors).max() < CLOSE_MM
    assert result.warnings == []
    assert result.depth.rms() < CLOSE_MM / 2
    assert result.along.rms() < CLOSE_MM / 2


def test_origin_is_where_the_described_sensor_has_it(sensor, result):
    """The sensor is as described, so its origin is the true one; spline, map and fit leave micrometres."""
    lines, centres, true = stripe_at(sensor, 8.7)
    found = measured(result.calibration, lines, centres).points_mm
    assert np.abs(np.nanmedian(found - true, axis=0)).max() < CLOSE_MM


@pytest.mark.parametrize(
    ("along", "towards", "spin"), [("width", -1.0, 1.6), ("height", 1.0, -1.5), ("height", -1.0, 3.1)]
)
def test_signs(along, towards, spin):
    """The directions of Y and Z do not depend on those of stage, stripe and plate."""
    sensor = sensor_along(along)
    header = header_of(sensor, direction=(0.0, 0.0, towards))
    found = fit_polynomials(evidence_of(sensor, towards=towards, spin=spin), header, degree=6)
    assert np.abs(errors_between(found.calibration, sensor)).max() < CLOSE_MM


def test_stage_against_the_header(sensor, evidence):
    with pytest.raises(CalibrationError, match="opposite to the stage positions"):
        fit_polynomials(evidence, header_of(sensor, direction=(0.0, 0.0, -1.0)), degree=6)


def test_missing_lines_take_values_of_neighbours(sensor):
    """Lines hidden at all depths are interpolated; a gap wider than a tenth of the lines remains."""
    hidden, hole = np.arange(300, 360), np.arange(700, 900)
    found = fit_polynomials(evidence_of(sensor, without=np.r_[hidden, hole]), header_of(sensor), degree=6).calibration
    lines, centres, true = stripe_at(sensor, 12.0)
    measurement = measured(found, lines, centres)
    error = measurement.points_mm - true
    borrowed = np.isin(lines, hidden)
    # The last line with a stripe is 1276; on either side of the hole they are 696 and 900.
    lost = ((lines > 696) & (lines < 900)) | (lines > 1276)
    assert (np.count_nonzero(borrowed), np.count_nonzero(lost)) == (60, 206)
    assert (measurement.status[lost] == RayStatus.OUTSIDE_CALIBRATION).all()
    assert (measurement.status[~lost] == RayStatus.OK).all()
    offset = np.median(error[~lost], axis=0)
    assert np.abs(error[borrowed] - offset).max() < CLOSE_MM


def test_noise_is_averaged_over_the_lines(sensor):
    """Fitting P coefficients to N points of noise s leaves s sqrt(P / N), several times that at the range's ends."""
    noisy = fit_polynomials(evidence_of(sensor, noise_px=0.2, seed=4), header_of(sensor), degree=6)
    rms, count = noisy.depth.rms(), np.count_nonzero(noisy.depth.used)
    assert 0.2 * 0.15 < rms < 0.2 * 0.35, "0.2 px are 0.03 mm near and 0.07 mm far"
    expected = rms * np.sqrt(7 * (MOST_SMOOTH + 1) / count)
    errors = errors_between(noisy.calibration, sensor)[:, 1]
    assert 0.3 * expected < np.std(errors) < 3 * expected
    # 0.99 on average over forty draws, with a standard deviation of 0.043.
    assert noisy.calibration.residuals["depth"]["line_excess"] == pytest.approx(0.99, abs=0.22)
    assert noisy.warnings == []


def test_kinked_laser_line_is_reported(sensor, evidence):
    """A laser line with ripples of 20 lines is no polynomial over the lines."""
    rippled = [s + np.column_stack([np.zeros(len(s)), 0.5 * np.sin(s[:, 0] / 3)]) for s in evidence.stripes]
    found = fit_polynomials(replace(evidence, stripes=rippled), header_of(sensor), degree=6)
    assert found.calibration.residuals["depth"]["line_excess"] > 3
    assert any("too fine for polynomials" in warning for warning in found.warnings)


# --- nothing is extrapolated


def test_no_value_is_outside_the_range(sensor, result):
    calibration = result.calibration
    low, high = calibration.domains()[500]
    lines = np.array([500 + calibration.first_line] * 4 + [calibration.first_line - 1, 5000, -3])
    centres = np.array([low, high, low - 0.01, high + 0.01, low + 5, low + 5, low + 5])
    found = measured(calibration, lines, centres)
    ok, out = RayStatus.OK, RayStatus.OUTSIDE_CALIBRATION
    assert found.status.tolist() == [ok, ok, out, out, out, out, out]
    assert np.isnan(found.points_mm[2:]).all()
    depths = found.points_mm[:2, 2]
    assert sorted(depths) == pytest.approx([DEPTHS[0], DEPTHS[-1]], abs=2 * CLOSE_MM)
    with pytest.raises(RangeError, match="not finite"):
        measured(calibration, lines[:1], np.array([np.nan]))


def test_stage_is_added(result):
    lines, centres = np.array([400, 400]), np.full(2, np.mean(result.calibration.domains()[400]))
    direction = np.array([0.6, 0.0, 0.8])
    found = reconstruct_by_polynomials(
        result.calibration, lines, centres, stage_mm=np.array([0.0, 5.0]), stage_direction=direction
    )
    assert found.points_mm[1] - found.points_mm[0] == pytest.approx(5.0 * direction, abs=1e-12)
    with pytest.raises(RangeError, match="not a unit vector"):
        reconstruct_by_polynomials(
            result.calibration, lines, centres, stage_mm=0.0, stage_direction=np.array([0.0, 0.0, 2.0])
        )


def test_domains_bridge_short_gaps_only():
    """Two poses; the second one lacks lines 3 and 4, and one line at each end; line 9 and what follows saw nothing."""
    first, second = np.array([0, 1, 2, 3, 4, 5, 6, 20]), np.array([1, 2, 5, 6])
    lines = np.r_[first, second]
    centres = np.r_[np.full(8, 10.0), 20.0 + second]
    pose = np.r_[np.zeros(8, int), np.ones(4, int)]
    domains = line_domains(lines, pose, centres, largest_gap=2)
    assert domains[:, 0].tolist() == pytest.approx([10.0] * 7 + [np.nan] * 13 + [10.0], nan_ok=True)
    assert domains[:7, 1].tolist() == pytest.approx([10, 21, 22, 23, 24, 25, 26])
    strict = line_domains(lines, pose, centres, largest_gap=1)
    assert strict[3:5, 1].tolist() == [10, 10]


# --- the fit


def test_offset_of_the_position_changes_nothing(evidence):
    """A shift by 1000 px changes x by rounding of 1e-13; a Vandermonde matrix in px would lose all digits."""
    lines = np.concatenate([s[:, 0] for s in evidence.stripes]).astype(int)
    centres = np.concatenate([s[:, 1] for s in evidence.stripes])
    depths = np.repeat(DEPTHS, [len(s) for s in evidence.stripes])
    here = fit_line_polynomials(lines, centres, depths, degree=6)
    there = fit_line_polynomials(lines + 1000, centres + 1e3, depths, degree=6)
    assert there.first_line == here.first_line + 1000
    assert np.abs(there.coefficients - here.coefficients).max() < 1e-9


def test_coefficients_of_each_line_leave_the_residuals(evidence):
    flat, depths = np.concatenate(evidence.stripes), np.repeat(DEPTHS, [len(each) for each in evidence.stripes])
    lines = flat[:, 0].astype(int)
    fit = fit_line_polynomials(lines, flat[:, 1], depths, degree=6)
    x = np.interp(flat[:, 1], fit.range, (-1.0, 1.0))
    values = legendre.legval(x, fit.coefficients[lines - fit.first_line].T, tensor=False)
    np.testing.assert_allclose(values[fit.used], (depths - fit.residuals)[fit.used], atol=1e-9)


@pytest.mark.parametrize(("lines", "degree"), [(10, 0), (21, 2), (200, 8)])
def test_as_many_points_as_coefficients_are_too_few(lines, degree):
    """One more is fitted: a degree for each 10 lines, up to the eighth, times three coefficients of a parabola."""
    terms = 3 * (degree + 1)
    at, x = (each.ravel() for each in np.meshgrid(np.linspace(0, lines - 1, degree + 2).round(), [-1.0, 0.2, 1.0]))
    with pytest.raises(CalibrationError, match=f"{terms} stripe points .* {terms} coefficients"):
        fit_line_polynomials(at[-terms:], x[-terms:], x[-terms:] ** 2, degree=2)
    np.testing.assert_allclose(fit_line_polynomials(at, x, x**2, degree=2).residuals, 0, atol=1e-9)


def test_outliers_are_left_out(sensor, evidence, result):
    rng = np.random.default_rng(5)
    stripes, count = [], 0
    for stripe in evidence.stripes:
        stray = rng.random(len(stripe)) < 0.03
        stripes.append(stripe + np.column_stack([np.zeros(len(stripe)), 40.0 * stray]))
        count += np.count_nonzero(stray)
    found = fit_polynomials(replace(evidence, stripes=stripes), header_of(sensor), degree=6)
    assert np.count_nonzero(~found.depth.used) >= count > 100
    assert np.abs(errors_between(found.calibration, sensor)).max() < CLOSE_MM


def test_stripes_that_contradict_each_other(sensor, evidence):
    """Beside the stripe a second one that does not move: a third of all points."""
    still = [
        np.where((s[:, :1] % 3 == 0), np.column_stack([s[:, 0], np.full(len(s), 500.0)]), s) for s in evidence.stripes
    ]
    with pytest.raises(CalibrationError, match="are not on the polynomials of the others"):
        fit_polynomials(replace(evidence, stripes=still), header_of(sensor), degree=6)


@pytest.mark.parametrize(("degree", "poses"), [(6, 6), (3, 3)])
def test_too_few_poses(sensor, evidence, degree, poses):
    few = replace(evidence, images=evidence.images[:poses], stripes=evidence.stripes[:poses])
    with pytest.raises(
        CalibrationError, match=f"at {poses} stage positions; .* degree {degree} need at least {degree + 1}"
    ):
        fit_polynomials(few, header_of(sensor), degree=degree)


def test_stripe_beside_the_plate(sensor, evidence):
    """A plate seen in one corner only, the stripe elsewhere."""
    corner = [replace(i, points_mm=i.points_mm[:35], pixels=i.pixels[:35]) for i in evidence.images]
    away = [s[s[:, 0] > 1100] for s in evidence.stripes]
    with pytest.raises(CalibrationError, match="together at 0 stage positions.*is not on the target"):
        fit_polynomials(replace(evidence, images=corner, stripes=away), header_of(sensor), degree=6)


# --- the map from pixels to the plate


def test_plate_map_takes_out_the_offsets_of_circles(sensor):
    """Centroids of 5 mm circles through lens and water are those of rims by Fermat's principle (shoelace formula).

    The offsets reach 0.1 px, 0.015 mm; the map's own degree leaves 1 to 2 um.
    """
    points = lattice()[::2]
    in_object = points @ turn(z=0.3).T + [0.0, 0.0, 20.0]
    angle = np.arange(48) * 2 * np.pi / 48
    rim = 2.5 * np.column_stack([np.cos(angle), np.sin(angle), np.zeros(48)])
    images = pixels_of(sensor, (in_object[:, None] + rim).reshape(-1, 3)).reshape(len(points), 48, 2)
    here = inside(images.reshape(-1, 2), sensor).reshape(len(points), 48).all(axis=1)
    points, images = points[here], images[here]
    middle = images.mean(axis=1, keepdims=True)
    (x, y), (x1, y1) = np.moveaxis(images - middle, 2, 0), np.moveaxis(np.roll(images - middle, -1, axis=1), 2, 0)
    cross = x * y1 - x1 * y
    area = cross.sum(axis=1) / 2
    centroid = np.column_stack([((x + x1) * cross).sum(axis=1), ((y + y1) * cross).sum(axis=1)]) / (6 * area[:, None])
    seen = TargetImage(points, middle[:, 0] + centroid)
    assert len(points) > 100
    test = np.random.default_rng(6).uniform(-1, 1, (400, 2)) * [70, 60]
    pixels = pixels_of(sensor, np.column_stack([test, np.zeros(400)]) @ turn(z=0.3).T + [0.0, 0.0, 20.0])
    near = inside(pixels, sensor)
    assert np.count_nonzero(near) > 200
    corrected, plain = fit_plate_map(seen, circle_diameter_mm=5.0), fit_plate_map(seen)
    good, bad = (np.abs(found(pixels[near]) - test[near]).max() for found in (corrected, plain))
    assert good < 4e-3
    assert bad > 2 * good
    assert np.sqrt(np.mean(np.sum(corrected.residuals**2, axis=1))) < CLOSE_MM


def test_plate_map_needs_points(sensor, evidence):
    few = replace(
        evidence.images[0], points_mm=evidence.images[0].points_mm[:20], pixels=evidence.images[0].pixels[:20]
    )
    with pytest.raises(CalibrationError, match="20 points .* at least 30"):
        fit_plate_map(few)


# --- the file


@pytest.fixture
def file(tmp_path, result):
    path = tmp_path / "polynomials.json"
    result.calibration.save(path)
    return path


def test_file_gives_back_the_same(file, result):
    assert load_calibration(file) == result.calibration
    assert result.calibration.residuals["depth"]["points"] > 4000
    text = describe(str(file))
    assert "degree 6" in text
    assert "Z(position): residual 0.000" in text


def test_the_other_kind_is_recognised_by_its_format(tmp_path, sensor):
    rays = nominal_calibration(sensor)
    rays.save(tmp_path / "rays.json")
    assert load_calibration(tmp_path / "rays.json") == rays


@pytest.mark.parametrize(
    ("damage", "says"),
    [
        (lambda content: {"version": 2}, "version 2"),
        (lambda content: {"depth_coefficients": content["depth_coefficients"][:-1]}, "depth_coefficients must have"),
        (
            lambda content: {"along_coefficients": with_row(content["along_coefficients"], [0.1])},
            "along_coefficients must have",
        ),
        (
            lambda content: {"depth_coefficients": with_row(content["depth_coefficients"], [None])},
            "depth_coefficients.3.0",
        ),
        (lambda content: {"depth_coefficients": with_row(content["depth_coefficients"], [float("inf")])}, "finite"),
        (lambda content: {"domains_px": with_row(content["domains_px"], [2.0, 1.0])}, "domains_px"),
        (lambda content: {"depth_range_mm": [5.0, 5.0]}, "depth_range_mm"),
        (lambda content: {"first_line": 20}, "do not fit an image"),
        (lambda content: {"surprise": 1}, "surprise"),
        (lambda content: {"format": "something"}, 'expected "format"'),
    ],
)
def test_damaged_files(file, damage, says):
    content = json.loads(file.read_text())
    del content["sha256"]
    file.write_text(json.dumps(content | damage(content)))
    with pytest.raises(CaptureError, match=says):
        load_calibration(file)


def with_row(rows, row):
    """Return the rows with another fourth one."""
    return [*rows[:3], row, *rows[4:]]


def test_files_that_are_none(file, tmp_path):
    file.write_text(file.read_text()[:5000])
    with pytest.raises(CaptureError, match="truncated"):
        load_calibration(file)
    file.write_text("[1, 2]")
    with pytest.raises(CaptureError, match="not a calibration"):
        load_calibration(file)
    with pytest.raises(CaptureError, match="no calibration at"):
        load_calibration(tmp_path / "missing.json")


# --- from captures to a cloud

SMALL = {"width_px": 640, "height_px": 512, "pixel_size_um": 10.6, "principal_point_px": (322.0, 254.0)}
BIG_CIRCLES = CircleTarget(
    diameter_mm=6.0, marker_diameter_mm=2.5, columns=21, rows=21, origin=(10, 10), marker_x=(1, 0), marker_y=(0, 1)
)


def small_sensor():
    sensor = built_sensor()
    window = sensor.camera.window.model_copy(update={"mounted": False})
    camera = sensor.camera.model_copy(update=SMALL | {"distortion": Distortion(), "window": window})
    return sensor.model_copy(update={"camera": camera})


def on_plane(sensor, depth):
    """Plate coordinates (H, W, 2) of all pixels' rays in air, in the OCS's X and Y."""
    lens, frame = lens_of(sensor), camera_from_object(sensor)
    v, u = np.mgrid[: sensor.camera.height_px, : sensor.camera.width_px]
    rays = np.stack([(u - lens.cx) / lens.fx, (v - lens.cy) / lens.fy, np.ones(u.shape)], axis=-1) @ frame[:3, :3]
    origin = -frame[:3, :3].T @ frame[:3, 3]
    return origin[:2] + rays[..., :2] * ((depth - origin[2]) / rays[..., 2])[..., None]


def lamp_image(sensor, depth):
    """Return bright circles on a dark plate, blurred by a pixel; the plate's x and y are Y and -X of the OCS."""
    x, y = np.moveaxis(on_plane(sensor, depth) @ turn(z=np.pi / 2)[:2, :2], -1, 0)
    i, j = np.rint(x / 9.375), np.rint(y / 9.372)
    radius = np.hypot(x - 9.375 * i, y - 9.372 * j)
    (x_v, x_u), (y_v, y_u) = np.gradient(x), np.gradient(y)
    size_mm = np.sqrt(np.abs(x_u * y_v - x_v * y_u))
    covered = np.clip((3.0 - radius) / size_mm + 0.5, 0, 1) * (np.maximum(abs(i), abs(j)) <= 10)
    dot = np.clip((1.25 - radius) / size_mm + 0.5, 0, 1) * np.isin(i + 100 * j, (0, 1, 100))
    return np.rint(25 + 180 * covered * (1 - dot)).astype(np.uint8)


def laser_image(sensor, depth):
    """A Gaussian line where the plane's X is 0."""
    x = on_plane(sensor, depth)[..., 0]
    across = x / np.gradient(x, axis=0)
    return np.rint(8 + 180 * np.exp(-((across / 1.4) ** 2) / 2)).astype(np.uint8)


def write(path, sensor, frames, **header):
    header = header_of(sensor, medium=Medium(kind="air")).model_copy(update=header)
    with CaptureWriter(path, header, dtype=np.uint8) as writer:
        for image, stage, laser in frames:
            writer.append(Frame(image, float(stage), laser, 1.0, 0.0))
    return path


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder, sensor = tmp_path_factory.mktemp("captures"), small_sensor()
    frames = []
    for depth in np.arange(-45.0, 50.0, 15.0):
        frames += [(lamp_image(sensor, depth), -depth, False), (laser_image(sensor, depth), -depth, True)]
    scan = [(laser_image(sensor, depth), 0.0, True) for depth in (-22.0, 5.0, 70.0)]
    along_x = {"stage_direction": (1.0, 0.0, 0.0)}
    return {
        "target": write(folder / "target.h5", sensor, frames, target=BIG_CIRCLES.model_dump()),
        "scan": write(folder / "scan.h5", sensor, scan, **along_x),
        "water": write(folder / "water.h5", sensor, scan, **along_x, medium=Medium(kind="fresh"), medium_name="pool"),
        "folder": folder,
    }


@pytest.fixture(scope="module")
def small(files):
    with Capture(files["target"]) as capture:
        return calibrate_polynomials([capture], degree=4)


def test_captures_to_cloud(files, small):
    """Centres of drawn circles and lines are good to 0.02 px of 0.17 mm in Y; in Z a pixel is 0.4 mm."""
    with Capture(files["scan"]) as capture:
        scan = reconstruct(capture, small.calibration)
        kept = scan.metadata
    assert scan.rays_by_status["outside_calibration"] > 600, "the plane at 70 mm lies outside"
    assert set(scan.rays_by_status) == {status.name.lower() for status in RayStatus}
    assert sorted(np.unique(scan.frame)) == [0, 1]
    points, frame = scan.points_mm, scan.frame
    sensor = small_sensor()
    for number, depth in ((0, -22.0), (1, 5.0)):
        own = frame == number
        assert np.count_nonzero(own) > 600
        assert np.abs(points[own, 2] - depth).max() < 0.02
        plane = on_plane(sensor, depth)
        line = scan.line[own]
        row = np.argmin(np.abs(plane[..., 0]), axis=0)[line]
        # The nearest row's Y is off by half a row's; the plane's Y changes along a column by 3 % of a pixel at most.
        assert np.abs(points[own, 1] - plane[row, line, 1]).max() < 0.02 + 0.5 * 0.17 * 0.3
    assert kept["medium_index"] == 1.0
    assert (points[:, 0] == 0).all()


def test_commands(files, tmp_path, monkeypatch, capsys):
    """The file that one command writes is input of the next; losses are reported."""
    out, cloud = tmp_path / "polynomials.json", tmp_path / "scan.ply"
    for line in (
        ["polynomials", "--captures", files["target"], "--degree", "4", "--out", out],
        ["reconstruct", files["scan"], "--calibration", out, "--out", cloud],
        ["info", out],
    ):
        monkeypatch.setattr("sys.argv", ["uwlts", *map(str, line)])
        assert run(app) == 0
    said = capsys.readouterr().out
    assert said.count("degree 4") == 2
    assert "outside calibration" in said
    assert len(read_cloud(cloud)) > 1200


def test_captures_that_do_not_fit(files, small):
    calibration = small.calibration
    with (
        Capture(files["water"]) as capture,
        pytest.raises(CalibrationError, match="made in pool .*polynomials in water"),
    ):
        reconstruct(capture, calibration)
    with Capture(files["scan"]) as capture:
        for changed, says in (
            ({"stripe_along": "height", "domains_px": calibration.domains_px[:500]}, "the stripe runs along"),
            ({"width_px": 700}, "640 x 512 pixels, the calibration is for 700 x 512"),
            ({"window_mounted": True}, "without the camera's window, the polynomials with"),
        ):
            with pytest.raises(CalibrationError, match=says):
                reconstruct(capture, calibration.model_copy(update=changed))
        with pytest.raises(CalibrationError, match="a refractive index cannot be given"):
            reconstruct(capture, calibration, index=1.33)


def test_water_of_another_index(files, small):
    """The captures' water has 20 degC; at 30 degC the index is lower by 0.0011, at 22 degC by 0.0002."""
    warm = small.calibration.model_copy(update={"medium": Medium(kind="fresh", temperature_c=30.0)})
    with Capture(files["water"]) as capture:
        with pytest.raises(CalibrationError, match="valid only in the medium of their calibration"):
            reconstruct(capture, warm)
        near = small.calibration.model_copy(update={"medium": Medium(kind="fresh", temperature_c=22.0)})
        assert len(reconstruct(capture, near)) > 1200


def test_captures_that_are_refused(files, tmp_path):
    sensor = small_sensor()
    target = BIG_CIRCLES.model_dump()
    blank = [(np.full((512, 640), 20, np.uint8), 0.0, False)]
    sideways = write(tmp_path / "sideways.h5", sensor, blank, target=target, stage_direction=(1.0, 0.0, 0.0))
    wet = write(tmp_path / "wet.h5", sensor, blank, target=target, medium=Medium(kind="fresh"))
    empty = write(tmp_path / "empty.h5", sensor, blank, target=target)
    with Capture(sideways) as a, pytest.raises(CalibrationError, match="along the laser's axis"):
        calibrate_polynomials([a])
    with Capture(files["scan"]) as a, pytest.raises(CalibrationError, match="does not describe its target"):
        calibrate_polynomials([a])
    with (
        Capture(files["target"]) as a,
        Capture(wet) as b,
        pytest.raises(CalibrationError, match="medium is .* instead of"),
    ):
        calibrate_polynomials([a, b])
    with (
        Capture(files["target"]) as a,
        pytest.raises(CalibrationError, match="at 7 stage positions; .* degree 7 need at"),
    ):
        calibrate_polynomials([a], degree=7)
    with Capture(empty) as a, pytest.raises(CalibrationError, match="found in no image of empty.h5: too dark"):
        calibrate_polynomials([a])
    with Capture(empty) as a, pytest.raises(RangeError, match="degree is 0"):
        calibrate_polynomials([a], degree=0)
    with pytest.raises(CalibrationError, match="no capture"):
        calibrate_polynomials([])
