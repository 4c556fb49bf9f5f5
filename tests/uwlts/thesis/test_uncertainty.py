"""Budget and Monte-Carlo propagation of the sphere spacing, on views whose truth is known (NumPy, Fermat)."""

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from scipy import stats

from tests.oracles.fermat import directions_seen, plate
from tests.uwlts.calibration_views import (
    STEP_MM,
    built_sensor,
    lattice,
    lens_of,
    stage_images,
    step_profile,
    stripes_on_target,
    through_window,
)
from uwlts.calibration.capture_evidence import AirEvidence, StepEvidence
from uwlts.calibration.sequential.sequential_calibration import CalibrationOptions, Evidence, solve
from uwlts.errors import CalibrationError
from uwlts.model.artefacts import StepStandard
from uwlts.model.placement import camera_from_object
from uwlts.model.sensor import Medium
from uwlts.targets import CircleTarget
from uwlts.targets.detection.ellipse_bias import circle_centre_bias
from uwlts.thesis import monte_carlo
from uwlts.thesis.monte_carlo import Propagated, propagate
from uwlts.thesis.sphere_spacing import SphereScan, mm_per_px, spacing_budget, spacing_error

pytestmark = pytest.mark.slow

SENSOR = built_sensor()
LENS = lens_of(SENSOR)
WATER = Medium(kind="fresh", temperature_c=25.0)
INDEX = WATER.refractive_index(SENSOR.laser.wavelength_nm)
PLAIN = CalibrationOptions(refractions=2, correct_circles=False)
POINTS = lattice()[::6]
TARGET = CircleTarget(
    spacing_x_mm=9.375,
    spacing_y_mm=9.372,
    diameter_mm=6.0,
    marker_diameter_mm=2.5,
    columns=25,
    rows=25,
    origin=(12, 12),
)
RADIUS_MM, SPACING_MM = 25.06, 99.18
BEND_MM = 0.02
"""Height of the target's corners for a bowed target."""


def warmer(kelvin):
    """Index of the water at another temperature."""
    warm = WATER.model_copy(update={"temperature_c": WATER.temperature_c + kelvin})
    return warm.refractive_index(SENSOR.laser.wavelength_nm)


def bowed_images(images, poses):
    """The same target points where they stand out from the plate by the square of their distance from its middle."""
    farthest = max(np.linalg.norm(image.points_mm, axis=1).max() for image in images)
    out = []
    for image, pose in zip(images, poses, strict=True):
        height = BEND_MM * (np.linalg.norm(image.points_mm, axis=1) / farthest) ** 2
        points = image.points_mm + height[:, None] * (0.0, 0.0, 1.0)
        out.append(replace(image, pixels=LENS.pixels(points @ pose[:3, :3].T + pose[:3, 3])))
    return out


def seen(
    *,
    stage_tilt=(0.0, 0.0),
    lead=0.0,
    higher=0.0,
    window_tilt=0.0,
    index=INDEX,
    bowed=False,
    biased=False,
    noise=0.0,
    stripe_points=120,
):
    """Evidence of a sensor whose target, stage, step, window and water differ from their descriptions."""
    rng = np.random.default_rng(0)
    images, poses, _ = stage_images(
        SENSOR, positions=np.arange(5) * 40.0, points=POINTS, stage_tilt=stage_tilt, noise_px=noise, rng=rng
    )
    images = bowed_images(images, poses) if bowed else images
    images = biased_images(images, poses) if biased else images
    images = [replace(image, stage_mm=image.stage_mm * (1 + lead)) for image in images]
    profile = step_profile(15.0, tilt=-0.02, height_mm=STEP_MM + higher, count=240)
    pixels = through_window(SENSOR, profile, index=index, noise_px=noise, rng=rng)
    window = SENSOR.camera.window
    taken_for = {"tilt_x_deg": window.tilt_x_deg + window_tilt, "tilt_y_deg": window.tilt_y_deg + window_tilt}
    stripes = stripes_on_target(SENSOR, poses, count=stripe_points, noise_px=noise, rng=rng)
    return Evidence(
        sensor=SENSOR,
        medium_kind="air",
        stage_direction=np.array([0.0, 0.0, 1.0]),
        approaching=True,
        air=AirEvidence(TARGET, images, [(0, number) for number in range(len(images))], stripes, []),
        window=window.model_copy(update=taken_for),
        steps=[StepEvidence(pixels, StepStandard(height_mm=STEP_MM), INDEX, "step")],
        sources={},
        warnings=[],
    )


def biased_images(images, poses):
    """The same images with the centres of the circles' images for the images of their centres."""
    axes = np.eye(3)
    return [
        replace(
            image,
            pixels=image.pixels
            + circle_centre_bias(
                lambda points, pose=pose: LENS.pixels(points @ pose[:3, :3].T + pose[:3, 3]),
                image.points_mm,
                diameter_mm=TARGET.diameter_mm,
                axis_u=axes[0],
                axis_v=axes[1],
            ),
        )
        for image, pose in zip(images, poses, strict=True)
    ]


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
        f"{depth_mm:g}",
        pixels,
        np.concatenate(stage),
        np.concatenate(sphere),
        np.array([1.0, 0.0, 0.0]),
        INDEX,
        SPACING_MM,
    )


@cache
def clean():
    """The evidence of a sensor that is as described, and its calibration."""
    evidence = seen()
    return evidence, solve(evidence, options=PLAIN)


def error_by(evidence, scan=None):
    """Sphere spacing error with the calibration that follows from some evidence."""
    found = solve(evidence, options=PLAIN, start=clean()[1].camera)
    return spacing_error(found.calibration, spheres() if scan is None else scan)


class Fixed:
    """Stands for a generator: every normal number is 1, every evenly spread one at the end of its range."""

    def standard_normal(self, size=None):
        return 1.0 if size is None else np.ones(size)

    def uniform(self, low, high):
        return float(high)


def draw(knowledge, evidence=None, start=None):
    if evidence is None:
        evidence, start = clean()
    return monte_carlo._Draw(evidence, start, WATER, knowledge)


def test_exact_views_without_uncertainty_do_not_scatter():
    evidence, start = clean()
    reported = []
    scans = [spheres(), spheres(depth_mm=60.0)]
    results = propagate(
        evidence,
        scans,
        WATER,
        {},
        options=PLAIN,
        trials=20,
        workers=1,
        progress=lambda done, total: reported.append((done, total)),
    )
    assert reported == [(n, 20) for n in range(1, 21)]
    assert [result.placement for result in results] == ["15", "60"]
    for result in results:
        # Views are rounded at 1e-13 px, a pixel is 0.3 mm, and height errors count a hundredfold.
        assert abs(result.observed_mm) < 1e-9
        assert result.trials_mm.shape == (20,)
        np.testing.assert_allclose(result.trials_mm, 0.0, atol=1e-9)
    assert start.calibration.window.distance_mm == pytest.approx(SENSOR.camera.window.distance_mm, abs=1e-6)


def test_offsets_of_circles_are_taken_out_once():
    (result,) = propagate(
        seen(biased=True), [spheres()], WATER, {}, options=replace(PLAIN, correct_circles=True), trials=20, workers=1
    )
    # The offsets settle to 1e-4 px; left in, they would make the spheres stand wrong by some micrometres.
    assert abs(error_by(seen(biased=True))) > 1e-3
    assert abs(result.observed_mm) < 1e-5
    np.testing.assert_allclose(result.trials_mm, result.observed_mm, atol=1e-5)


KNOWN = {
    "target_tilt_std_deg": (0.1, {"stage_tilt": (math.radians(0.1), math.radians(0.1))}),
    "target_bow_std_mm": (BEND_MM, {"bowed": True}),
    "stage_lead_std": (1e-4, {"lead": 1e-4}),
    "window_tilt_std_deg": (0.1, {"window_tilt": 0.1}),
    "step_height_half_width_mm": (0.02, {"higher": 0.02}),
    "temperature_half_width_c": (5.0, {"index": warmer(5.0)}),
}


@pytest.mark.parametrize("name", KNOWN)
def test_drawn_deviations_act_like_a_deviating_sensor(name):
    """One standard deviation (half width) drawn shifts the spheres as views of a sensor that is wrong by it."""
    size, wrong = KNOWN[name]
    truly = abs(error_by(seen(**wrong)))
    drawn = abs(error_by(draw({name: size}).evidence(Fixed())))
    print(f"{name} {size:g}: spheres wrong by {truly:.4f} mm, drawn {drawn:.4f} mm")
    # A draw changes the known values, the wrong sensor the observed ones: opposite signs, equal except for the square
    # of the change, 1 % for a stage tilted about both axes.
    assert truly > 1e-3
    assert drawn == pytest.approx(truly, rel=0.02)


def test_the_water_of_the_scan_is_drawn_by_itself():
    drawn = draw({"temperature_half_width_c": 5.0})
    assert drawn.index(Fixed()) == pytest.approx(warmer(5.0), abs=1e-12)
    rng = np.random.default_rng(0)
    indices = np.array([drawn.index(rng) for _ in range(200)])
    assert warmer(5.0) <= indices.min() < indices.max() <= warmer(-5.0)
    # Evenly spread over 10 K, but for the curve of the index: a standard deviation of 200 is good to 3 %; 4 of it.
    assert indices.std() == pytest.approx(np.std([warmer(k) for k in np.linspace(-5, 5, 101)]), rel=0.13)
    assert drawn.evidence(rng).steps[0].medium_index != drawn.evidence(rng).steps[0].medium_index


def test_circles_are_misprinted_once_and_stage_positions_err_each_time():
    drawn = draw({"circle_centre_std_mm": 0.002, "stage_position_std_mm": 0.003})
    before, rng = clean()[0].air, np.random.default_rng(1)
    shifts, positions = {}, []
    for _ in range(20):
        after = drawn.evidence(rng).air
        shifts = {}
        for old, new in zip(before.images, after.images, strict=True):
            for point, shift in zip(old.points_mm.tolist(), new.points_mm - old.points_mm, strict=True):
                shifts.setdefault(tuple(point), []).append(shift)
            positions.append(new.stage_mm - old.stage_mm)
    often = [np.array(same) for same in shifts.values() if len(same) > 1]
    assert len(often) > 30
    for same in often:
        np.testing.assert_allclose(same, same[:1] * np.ones((len(same), 1)), atol=1e-12)
    once = np.array([same[0] for same in shifts.values()])
    # Standard deviations of N numbers are good to 1 / sqrt(2 N); 4 of it.
    assert np.std(once[:, :2]) == pytest.approx(0.002, rel=4 / math.sqrt(4 * len(once)))
    np.testing.assert_array_equal(once[:, 2], 0.0)
    assert np.std(positions) == pytest.approx(0.003, rel=4 / math.sqrt(2 * len(positions)))


@pytest.mark.parametrize("along", ["x", "oblique"])
def test_the_travel_is_turned_by_the_angles_drawn(along):
    direction = np.array({"x": [1.0, 0.0, 0.0], "oblique": [0.6, 0.48, 0.64]}[along])
    lead, angles = draw({"stage_lead_std": 1e-4, "stage_misalignment_std_deg": 0.1}).scan(Fixed())
    assert lead == 1e-4
    turned = monte_carlo._rotate_direction(direction, angles)
    assert np.linalg.norm(turned) == pytest.approx(1.0, abs=1e-12)
    # Two angles at right angles make their root sum of squares, up to their cube.
    assert math.acos(turned @ direction) == pytest.approx(math.radians(0.1) * math.sqrt(2), rel=1e-5)
    first = monte_carlo._rotate_direction(direction, angles * (1, 0)) - direction
    assert first @ (monte_carlo._rotate_direction(direction, angles * (0, 1)) - direction) == pytest.approx(
        0, abs=1e-10
    )


def test_noise_is_drawn_as_large_as_it_is():
    evidence = seen(noise=0.1, stripe_points=1280)
    start = solve(evidence, options=PLAIN)
    drawn = draw({}, evidence, start)
    rng = np.random.default_rng(2)
    after = drawn.evidence(rng)
    noise = np.concatenate([new - old for old, new in zip(evidence.air.stripes, after.air.stripes, strict=True)])
    circles = np.concatenate(
        [new.pixels - old.pixels for old, new in zip(evidence.air.images, after.air.images, strict=True)]
    )
    assert len(noise) > 3000 and len(circles) > 300
    # The noise found is the standard deviation of N numbers, good to 1 / sqrt(2 N), and what is drawn one of as many: 4
    # of both together. All is across the stripe, that is along v here.
    np.testing.assert_array_equal(noise[:, 0], 0.0)
    assert np.std(noise[:, 1]) == pytest.approx(0.1, rel=4 / math.sqrt(len(noise)))
    assert np.std(circles) == pytest.approx(0.1, rel=4 / math.sqrt(2 * len(circles)))
    assert np.std(after.steps[0].pixels[:, 1] - evidence.steps[0].pixels[:, 1]) == pytest.approx(
        0.1, rel=4 / math.sqrt(2 * len(after.steps[0].pixels))
    )


def test_temperature_alone_spreads_by_its_sensitivities():
    """Water of one temperature for the step, another for the spheres: both sensitivities times the index's spread."""
    evidence, start = clean()
    (result,) = propagate(
        evidence, [spheres()], WATER, {"temperature_half_width_c": 5.0}, options=PLAIN, trials=40, seed=1, workers=1
    )
    half = (warmer(-5.0) - warmer(5.0)) / 2
    measuring = [spacing_error(start.calibration, spheres(), medium_index=warmer(k)) for k in (-5.0, 5.0)]
    calibrating = [error_by(with_step_index(evidence, warmer(k))) for k in (-5.0, 5.0)]
    per_index = [np.ptp(ends) / (2 * half) for ends in (measuring, calibrating)]
    index_std = np.std([warmer(k) for k in np.linspace(-5, 5, 1001)])
    assert index_std == pytest.approx(half / math.sqrt(3), rel=0.02)
    expected = math.hypot(*per_index) * index_std
    print(f"5 K: measured {result.std_mm():.4f} mm, expected {expected:.4f} mm")
    # The kurtosis of the sum of two evenly spread numbers is at most 2.4: a standard deviation of 40 is good to
    # sqrt(1.4 / 160), 9 %; 3.5 of it.
    assert result.std_mm() == pytest.approx(expected, rel=0.33)
    # No trial exceeds both ends together; the index is curved by 10 % over the range.
    limit = max(map(abs, measuring)) + max(map(abs, calibrating))
    assert 0.5 * limit < np.abs(result.trials_mm).max() < limit
    assert result.contains_truth()


def with_step_index(evidence, index):
    return replace(evidence, steps=[replace(step, medium_index=index) for step in evidence.steps])


def propagated(trials):
    return Propagated("here", 0.0, np.asarray(trials, float))


def test_the_shortest_interval_of_a_known_sample():
    # Squares are densest at 0: the first 95 of 100.
    squares = np.random.default_rng(3).permutation(np.arange(100.0)) ** 2
    assert propagated(squares).interval_mm() == (0.0, 94.0**2)
    # Twenty: 19 of them; the outlier is left out, whichever side it is on.
    even = np.append(np.arange(19.0), 100.0)
    assert propagated(even).interval_mm() == (0.0, 18.0)
    assert propagated(-even).interval_mm() == (-18.0, 0.0)
    assert propagated(even).std_mm() == pytest.approx(np.sqrt(np.sum((even - even.mean()) ** 2) / 19))


@given(st.lists(st.floats(-10, 10), min_size=20, max_size=45))
@settings(deadline=None, max_examples=30)
def test_no_interval_that_holds_as_many_is_shorter(values):
    low, high = propagated(values).interval_mm()
    ordered = np.sort(values)
    assert np.count_nonzero((ordered >= low) & (ordered <= high)) >= 0.95 * len(values)
    widths = [b - a for a in ordered for b in ordered if np.mean((ordered >= a) & (ordered <= b)) >= 0.95]
    assert high - low == pytest.approx(min(widths), abs=1e-12)


@pytest.mark.parametrize(("shift", "held"), [(0.0, True), (-1.0, True), (1.0, False), (-18.5, False)])
def test_whether_the_truth_is_held(shift, held):
    trials = np.append(np.arange(19.0), 100.0) + shift
    assert propagated(trials).contains_truth() is held


def failing(monkeypatch, share):
    """Make every n-th calibration of the trials fail, with n = 1 / share."""
    calls = []

    def solved(evidence, **how):
        calls.append(how)
        if len(calls) > 1 and len(calls) % round(1 / share) == 0:
            raise CalibrationError("no calibration")
        return clean()[1]

    monkeypatch.setattr(monte_carlo, "solve", solved)


def test_few_trials_may_fail(monkeypatch):
    failing(monkeypatch, 0.1)
    (result,) = propagate(clean()[0], [spheres()], WATER, {}, options=PLAIN, trials=30, workers=1)
    # The first call is that of the unperturbed evidence: the 10th, 20th and 30th of 31 fail.
    assert len(result.trials_mm) == 27


def test_many_failing_trials_are_no_result(monkeypatch):
    failing(monkeypatch, 0.25)
    with pytest.raises(CalibrationError, match="no calibration"):
        propagate(clean()[0], [spheres()], WATER, {}, options=PLAIN, trials=30, workers=1)


def test_a_scan_without_its_spheres_gives_no_result():
    lost = replace(spheres(), sphere=np.zeros_like(spheres().sphere))
    with pytest.raises(CalibrationError, match="20 of 20"):
        propagate(clean()[0], [lost], WATER, {}, options=PLAIN, trials=20, workers=1)


def test_the_budget_has_the_thesiss_sources():
    calibration = clean()[1].calibration
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
    assert spacing_budget(clean()[1].calibration, scans, fixed, deviation_mm=0.1)["index"] == 0.0


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
    assert mm_per_px(clean()[1].calibration, INDEX) == pytest.approx(abs(per_px), rel=1e-4)
