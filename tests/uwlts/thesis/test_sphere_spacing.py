"""Spacing of spheres and its budget, on views whose truth is known (NumPy, Fermat) and on drawn stripes."""

import contextlib
import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy import stats

import uwlts
from tests.oracles.fermat import directions_seen, plate
from tests.uwlts.calibration_views import STEP_MM, WATER as DRAWN_INDEX, lens_of, square_sensor, through_window
from tests.uwlts.drawn_stripes import (
    SENSOR as SMALL,
    SPHERES,
    STAGE_MM,
    sphere_profiles,
    step_image,
    stripe_image,
    write,
)
from uwlts.errors import CalibrationError, CaptureError, EvaluationError
from uwlts.model.placement import camera_from_object
from uwlts.model.sensor import Medium
from uwlts.optics.nominal import nominal_calibration
from uwlts.storage.capture import Capture
from uwlts.thesis import evaluate_thesis
from uwlts.thesis.thesis_figures import (
    SphereScan,
    mean_spacing_error,
    mm_per_px,
    spacing_budget,
    spacing_error,
    sphere_scan,
    window_choices,
)

SENSOR = square_sensor()
LENS = lens_of(SENSOR)
WATER = Medium(kind="fresh", temperature_c=25.0)
INDEX = WATER.refractive_index(SENSOR.laser.wavelength_nm)
RADIUS_MM, SPACING_MM = 25.06, 99.18
CALIBRATION = nominal_calibration(SENSOR)
EXACT = nominal_calibration(SMALL)
DISTANCE_MM = SMALL.camera.window.distance_mm
PLACES = {"near": -40.0, "standoff": 10.0, "far": 60.0}


def warmer(kelvin):
    """Index of the water at another temperature."""
    warm = WATER.model_copy(update={"temperature_c": WATER.temperature_c + kelvin})
    return warm.refractive_index(SENSOR.laser.wavelength_nm)


@cache
def spheres(*, depth_mm=15.0, index=INDEX):
    """A scan of two spheres side by side along the stripe, exact."""
    points, stage, sphere = [], [], []
    around = np.linspace(-1.0, 1.0, 25)
    for number, y in enumerate((-SPACING_MM / 2, SPACING_MM / 2)):
        for x in np.arange(-20.0, 21.0, 4.0):
            circle = math.sqrt(RADIUS_MM**2 - x**2)
            points.append(
                np.column_stack([0 * around, y + circle * np.sin(around), depth_mm - circle * np.cos(around)])
            )
            stage.append(np.full(len(around), x))
            sphere.append(np.full(len(around), number))
    points = np.concatenate(points)
    pixels = through_window(SENSOR, points, index=index)
    assert len(pixels) == len(points)
    return SphereScan(
        pixels, np.concatenate(stage), np.concatenate(sphere), np.array([1.0, 0.0, 0.0]), INDEX, SPACING_MM
    )


@pytest.fixture(scope="module")
def scanned(tmp_path_factory):
    """A scan of two spheres at the stand-off in water."""
    images = [
        stripe_image(profile, np.random.default_rng(number)) for number, profile in enumerate(sphere_profiles(15.0))
    ]
    path = tmp_path_factory.mktemp("scan") / "spheres-standoff-water.h5"
    return write(path, images, stage_mm=STAGE_MM, artefact=SPHERES)


def test_stripes_are_sorted_by_sphere(scanned):
    with Capture(scanned) as capture:
        scan = sphere_scan(capture, EXACT)
    assert scan.spacing_mm == SPACING_MM
    np.testing.assert_array_equal(np.unique(scan.stage_mm), STAGE_MM)
    checked = 0
    for x, profile in zip(STAGE_MM, sphere_profiles(15.0), strict=True):
        for number, pixels in enumerate(profile):
            own = scan.pixels[(scan.stage_mm == x) & (scan.sphere == number)]
            order = np.argsort(pixels[:, 0])
            apart = own[:, 1] - np.interp(own[:, 0], pixels[order, 0], pixels[order, 1])
            # Noise of 1 of 180 grey levels moves a centre by some 0.01 px; a stripe on the other sphere is far away.
            assert len(own) > 50 and np.abs(apart).max() < 0.1
            assert pixels[:, 0].min() <= own[:, 0].min() and own[:, 0].max() <= pixels[:, 0].max()
            checked += len(own)
    assert checked == len(scan.pixels) == len(scan.sphere) == len(scan.stage_mm)
    points = np.concatenate([[RADIUS_MM * np.array([math.cos(a), math.sin(a), b])] for a in range(6) for b in (0, 0.3)])
    apart = np.concatenate([points, points + [0.0, SPACING_MM + 0.25, 0.0]])
    labels = replace(scan, sphere=np.repeat([0, 1], len(points)))
    assert labels.spacing_error(apart) == pytest.approx(0.25, abs=1e-8)


def test_a_scan_without_its_spheres_is_refused(tmp_path):
    plane = np.column_stack([np.arange(20, 600), np.full(580, 250.0)])
    path = write(
        tmp_path / "plane.h5",
        [stripe_image([plane], np.random.default_rng(0))] * 3,
        stage_mm=[0.0, 1.0, 2.0],
        artefact=SPHERES,
    )
    with Capture(path) as capture, pytest.raises(EvaluationError):
        sphere_scan(capture, EXACT)


def described(distance_mm):
    """Return the sensor described by its captures, with the window at another distance."""
    window = SMALL.camera.window.model_copy(update={"distance_mm": distance_mm})
    return SMALL.model_copy(update={"camera": SMALL.camera.model_copy(update={"window": window})})


def campaign(folder, poses, *, odd_mm=None):
    """Write a campaign folder with step images in some poses at every position; the far step has another height."""
    for place, depth in PLACES.items():
        height = odd_mm if odd_mm is not None and place == "far" else STEP_MM
        images = [step_image(depth, tilt=tilt, shift_mm=shift, height_mm=height) for tilt, shift in poses]
        artefact = {"kind": "step", "height_mm": STEP_MM}
        write(folder / f"step-{place}-water.h5", images, sensor=described(55.0), artefact=artefact)
    return [folder / f"step-{place}-water.h5" for place in PLACES]


@pytest.fixture(scope="module")
def scans():
    """Exact stripes on two spheres at two depths."""
    found = []
    for depth in (0.0, 50.0):
        profiles = sphere_profiles(depth)
        pieces = [
            (x, n, pixels) for x, profile in zip(STAGE_MM, profiles, strict=True) for n, pixels in enumerate(profile)
        ]
        found.append(
            SphereScan(
                pixels=np.concatenate([pixels for _, _, pixels in pieces]),
                stage_mm=np.concatenate([np.full(len(pixels), x) for x, _, pixels in pieces]),
                sphere=np.concatenate([np.full(len(pixels), n) for _, n, pixels in pieces]),
                stage_direction=np.array([1.0, 0.0, 0.0]),
                medium_index=DRAWN_INDEX,
                spacing_mm=SPACING_MM,
            )
        )
    return found


def moved(distance_mm):
    return EXACT.model_copy(update={"window": EXACT.window.model_copy(update={"distance_mm": distance_mm})})


def test_exact_spheres_have_no_error_and_their_mean_is_without_sign(scans):
    # Rays are rounded at 1e-13 and fitted by iteration.
    assert mean_spacing_error(EXACT, scans) < 1e-6
    errors = [spacing_error(moved(DISTANCE_MM + 5), scan) for scan in scans]
    assert all(abs(error) > 0.01 for error in errors)
    assert mean_spacing_error(moved(DISTANCE_MM + 5), scans) == pytest.approx(np.mean(np.abs(errors)))
    opposite = [
        spacing_error(EXACT, scan, medium_index=DRAWN_INDEX + sign * 1e-3)
        for scan, sign in zip(scans, (1, -1), strict=True)
    ]
    assert opposite[0] * opposite[1] < 0


def choose(paths, scans):
    """Return window distance and mean spacing error by the names of the images."""
    with contextlib.ExitStack() as stack:
        steps = [stack.enter_context(Capture(path)) for path in paths]
        return {name: values for name, *values in window_choices(steps, EXACT, scans)}


@pytest.fixture(scope="module")
def study(tmp_path_factory, scans):
    return choose(campaign(tmp_path_factory.mktemp("study"), [(0.01, -8.0), (-0.02, 0.0), (0.03, 6.0)]), scans)


def test_every_choice_of_images_finds_the_window(study, scans):
    singles = [f"step-{place}-water {number}" for place in PLACES for number in (1, 2, 3)]
    assert list(study) == [*singles, *(f"step-{place}-water" for place in PLACES), "all step images"]
    per_mm = mean_spacing_error(moved(DISTANCE_MM + 1), scans)
    for name, (distance_mm, error_mm) in study.items():
        # Drawn stripes are good to 0.01 px, which the mean over some hundred lines brings to 1 um of the step's height;
        # 1 mm of distance changes that by 0.015 mm or more.
        assert distance_mm == pytest.approx(DISTANCE_MM, abs=0.25), name
        # The spheres feel what is left in proportion, but for the square of the change: 1 % per mm.
        assert error_mm == pytest.approx(abs(distance_mm - DISTANCE_MM) * per_mm, rel=0.05, abs=1e-6), name
    together = study["all step images"][0]
    assert abs(together - DISTANCE_MM) < 0.1
    assert together == pytest.approx(np.mean([study[name][0] for name in singles]), abs=0.1)


def test_images_that_determine_no_distance_give_no_result(tmp_path, scans):
    found = choose(campaign(tmp_path, [(0.0, 0.0)], odd_mm=STEP_MM + 4), scans)
    assert not {"step-far-water 1", "step-far-water"} & set(found)
    assert found["step-near-water 1"][0] == pytest.approx(DISTANCE_MM, abs=0.3)


def test_figures_of_captures_are_in_one_table(tmp_path, scanned):
    steps = campaign(tmp_path, [(0.0, 0.0)])
    found = evaluate_thesis(EXACT, step=steps, spheres=[scanned, scanned], line=[scanned])
    assert {(row.campaign, row.method) for row in found.rows} == {(tmp_path.name, "two refractions")}
    values = {(row.scan, row.figure): row.measured_mm for row in found.rows}
    distances = {scan for scan, figure in values if figure == "window distance"}
    assert distances == {"all step images", *(f"step-{place}-water{n}" for place in PLACES for n in ("", " 1"))}
    assert values["all step images", "window distance"] == pytest.approx(DISTANCE_MM, abs=0.2)
    assert values["budget of the sphere spacing", "SSE"] == 0.0
    # The low-pass filter takes the flanks of a stripe this narrow for noise, pixel by pixel.
    assert values["budget of the sphere spacing", "PE"] > 0.005
    # The stripe spans both spheres' visible caps: the spacing and twice the radius times the sine of 1.1 rad, less at
    # the outer profiles; the ends of the stripe are left out.
    length = values[scanned.stem, "line length"]
    assert SPACING_MM < length < SPACING_MM + 2 * RADIUS_MM * math.sin(1.1)
    found.save(tmp_path / "figures.json")
    assert uwlts.read(tmp_path / "figures.json") == found


def test_a_calibration_without_a_window_is_refused(tmp_path):
    for wrong in (EXACT.model_copy(update={"window": None}), tmp_path / "missing.json"):
        with pytest.raises((CalibrationError, CaptureError)):
            evaluate_thesis(wrong)


def test_the_budget_has_the_thesiss_sources():
    calibration = CALIBRATION
    scans = [spheres(depth_mm=depth) for depth in (0.0, 30.0, 60.0)]
    scans = [replace(scan, spacing_mm=SPACING_MM + error) for scan, error in zip(scans, (-0.1, 0.05, 0.2), strict=True)]
    budget = spacing_budget(calibration, scans, WATER, deviation_mm=0.14)
    # Views in water that is really warmer or colder, measured as if it were not: what the index does, seen from the
    # other side; the same but for the square of the change.
    ends = [
        [spacing_error(calibration, spheres(depth_mm=depth, index=warmer(k))) for k in (-5.0, 5.0)]
        for depth in (0.0, 30.0, 60.0)
    ]
    assert budget["index"] == pytest.approx(np.mean(np.ptp(ends, axis=1)) / 2 / math.sqrt(3), rel=0.01)
    assert 0.005 < budget["index"] < 0.05
    # The thesis's 0.006 mm each: 0.011 mm over the square root of 3, and half a tenth of 0.22 mm.
    assert budget["expansion"] == pytest.approx(0.011 / math.sqrt(3), rel=0.01)
    assert budget["resolution"] == pytest.approx(0.05 * 0.22 / math.sqrt(3), rel=0.1)
    assert (budget["standard"], budget["PE"]) == (0.002, 0.14)
    errors = np.array([0.1, -0.05, -0.2])
    assert budget["SSE"] == pytest.approx(np.std(errors, ddof=1), abs=1e-8)
    assert budget["correction"] == pytest.approx(np.mean(np.abs(errors)), abs=1e-8)
    parts = [budget[name] for name in ("index", "expansion", "resolution", "standard", "SSE", "PE")]
    freedom = 2 * (math.hypot(*parts) / budget["SSE"]) ** 4
    assert budget["degrees_of_freedom"] == pytest.approx(freedom)
    factor = stats.t.ppf(0.975, math.floor(freedom))
    assert budget["expanded"] == pytest.approx(factor * math.hypot(*parts))
    assert budget["largest_error"] == pytest.approx(budget["correction"] + budget["expanded"])


def test_a_medium_whose_index_does_not_follow_the_temperature_has_no_share():
    scans = [spheres(), replace(spheres(depth_mm=60.0), spacing_mm=SPACING_MM + 0.1)]
    fixed = Medium(kind="custom", index=INDEX)
    assert spacing_budget(CALIBRATION, scans, fixed, deviation_mm=0.1)["index"] == 0.0


def test_a_pixel_is_as_many_mm_as_a_point_moves():
    window, frame = SENSOR.camera.window, camera_from_object(SENSOR)
    faces = plate(distance=window.distance_mm, thickness=window.thickness_mm, normal=window.normal())
    indices = [1.0, window.index(SENSOR.laser.wavelength_nm), INDEX]
    # Rows that see points along the laser's axis, which pass 0.6 px beside the principal point.
    depth = np.linspace(-60, 60, 4001)
    points = np.column_stack([0 * depth, 0 * depth, depth]) @ frame[:3, :3].T + frame[:3, 3]
    row = LENS.pixels(directions_seen(points, faces, indices))[:, 1]
    per_px = np.interp(LENS.cy + 0.5, row, depth) - np.interp(LENS.cy - 0.5, row, depth)
    # Along the stripe the scale changes by its own size over the stand-off's 1600 px, and as the square by symmetry.
    assert mm_per_px(CALIBRATION, INDEX) == pytest.approx(abs(per_px), rel=1e-4)
