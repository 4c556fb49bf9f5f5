"""Window distance from step images: exact by Fermat's principle, correct scatter, refusals."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from tests.uwlts.calibration_views import STEP_MM, WATER, nine_steps, square_sensor, step_profile, through_window
from uwlts.calibration.capture_evidence import StepEvidence
from uwlts.calibration.sequential.step_images import label_step, solve_window, step_profile as reconstructed
from uwlts.errors import CalibrationError, EvaluationError, RangeError
from uwlts.model.artefacts import StepStandard
from uwlts.model.calibration import WindowModel
from uwlts.model.sensor import Uncertainty
from uwlts.optics.nominal import nominal_calibration
from uwlts.shapes.step import StepFace

SENSOR = square_sensor()
AIR = nominal_calibration(SENSOR).model_copy(update={"window": None})
DISTANCE = SENSOR.camera.window.distance_mm
NORMAL = tuple(SENSOR.camera.window.normal())
PLATE = WindowModel(refractions=2, distance_mm=62.8, normal=NORMAL, thickness_mm=5.93, glass_index=1.52)
INTERFACE = WindowModel(refractions=1, distance_mm=62.8, normal=NORMAL)


@cache
def clean_steps(window):
    return steps(window)


@cache
def clean_solution(window):
    return solve_window(AIR, window, clean_steps(window))


def steps(window, profiles=None, *, noise_px=0.0, rng=None, index=WATER, height_mm=STEP_MM):
    profiles = nine_steps() if profiles is None else profiles
    views = (
        through_window(SENSOR, p, refractions=window.refractions, index=index, noise_px=noise_px, rng=rng)
        for p in profiles
    )
    return [labelled(window, pixels, height_mm, index) for pixels in views]


def labelled(window, pixels, height_mm=STEP_MM, index=WATER):
    return label_step(AIR, window, StepEvidence(pixels, StepStandard(height_mm=height_mm), index, "a step"))


def with_height(step, height_mm):
    return replace(step, standard=step.standard.model_copy(update={"height_mm": height_mm}))


@pytest.mark.parametrize("window", [PLATE, INTERFACE])
def test_exact_steps_give_the_exact_distance(window):
    solution = clean_solution(window)
    # Rays are rounded at 1e-13, heights at 1e-12 mm, and 1 mm of distance changes a height by 0.02 mm.
    assert solution.model.distance_mm == pytest.approx(DISTANCE, abs=1e-6)
    assert solution.model == window.model_copy(update={"distance_mm": solution.model.distance_mm})
    np.testing.assert_allclose(solution.errors_mm, 0, atol=1e-8)
    np.testing.assert_allclose(solution.image_distances_mm, DISTANCE, atol=1e-5)
    assert solution.curve_mm.shape[1] == 2
    best = solution.curve_mm[np.nanargmin(solution.curve_mm[:, 1]), 0]
    assert abs(best - DISTANCE) <= np.diff(solution.curve_mm[:2, 0])[0]
    assert 0.01 < solution.slopes.min() <= solution.slopes.max() < 0.04


def test_labels_keep_to_their_treads():
    for step, profile in zip(clean_steps(PLATE), nine_steps(), strict=True):
        assert min(np.count_nonzero(step.labels == tread) for tread in (StepFace.LOWER, StepFace.UPPER)) > 100
        points = reconstructed(
            AIR, PLATE.model_copy(update={"distance_mm": DISTANCE}), step.pixels, medium_index=step.medium_index
        )
        block = points[step.labels == StepFace.UPPER]
        distances = np.linalg.norm(block[:, None] - profile[None, ::4, 1:], axis=2).min(axis=1)
        # The distance between neighbouring points of the profile is 0.12 mm; every fourth is compared.
        assert distances.max() < 0.3


def test_nine_noisy_steps_scatter_as_reported():
    rng, found, reported, scatter = np.random.default_rng(4), [], [], []
    exact = steps(PLATE, nine_steps(count=200))
    for _ in range(10):
        noisy = [replace(s, pixels=s.pixels + rng.normal(0, (0.0, 0.15), s.pixels.shape)) for s in exact]
        solution = solve_window(AIR, PLATE, noisy)
        found.append(solution.model.distance_mm - DISTANCE)
        reported.append(solution.std_mm)
        scatter.append(solution.scatter_std_mm)
    # The standard deviation of 10 draws is good to 22 %, that from 9 residuals and 10 draws to 8 %; 3 std.
    rms, mean_reported = np.sqrt(np.mean(np.square(found))), np.sqrt(np.mean(np.square(reported)))
    assert rms == pytest.approx(np.mean(scatter), rel=0.67)
    assert mean_reported == pytest.approx(np.mean(scatter), rel=0.24)


def test_a_wrong_height_shifts_the_distance_as_stated():
    solution = clean_solution(PLATE)
    wrong = solve_window(AIR, PLATE, [with_height(step, STEP_MM + 0.02) for step in clean_steps(PLATE)])
    # The thesis's height uncertainty of 0.02 mm: nearly 1 mm of window distance, all but linear.
    shift = wrong.model.distance_mm - solution.model.distance_mm
    assert shift == pytest.approx(0.02 * solution.per_height, rel=0.02)
    assert 0.5 < shift < 1.5


def test_a_wrong_index_shifts_the_distance_as_stated():
    denser = [replace(step, medium_index=WATER + 2e-4) for step in clean_steps(PLATE)]
    solution, wrong = clean_solution(PLATE), solve_window(AIR, PLATE, denser)
    shift = wrong.model.distance_mm - solution.model.distance_mm
    # Water 2 K warmer.
    assert shift == pytest.approx(2e-4 * solution.per_index, rel=0.02)
    assert abs(shift) > 0.1


def test_the_uncertainty_holds_what_all_images_share():
    known = Uncertainty(step_height_mm=0.004)
    images = [replace(step, index_std=1e-4) for step in clean_steps(PLATE)]
    certified = [
        replace(step, standard=step.standard.model_copy(update={"height_uncertainty_mm": 0.02})) for step in images
    ]
    for steps_used, height_std_mm in ((images, 0.004), (certified, 0.01)):
        solution = solve_window(AIR, PLATE, steps_used, known=known)
        shared = (height_std_mm * solution.per_height, 1e-4 * solution.per_index)
        assert solution.uncertainty_mm == pytest.approx(np.hypot(*shared), rel=1e-6)


def test_a_single_image_has_no_deviation_of_its_own():
    rng = np.random.default_rng(5)
    solution = solve_window(AIR, PLATE, steps(PLATE, nine_steps()[:1], noise_px=0.15, rng=rng))
    assert solution.std_mm is None
    assert solution.scatter_std_mm > 0
    assert solution.image_distances_mm[0] == pytest.approx(solution.model.distance_mm, abs=1e-6)
    # One step's scatter is about three times that of nine: 0.1 mm; 5 std.
    assert solution.model.distance_mm == pytest.approx(DISTANCE, abs=5 * solution.scatter_std_mm)


def test_media_may_differ_from_image_to_image():
    salt = steps(PLATE, nine_steps()[:2], index=1.339) + steps(PLATE, nine_steps()[4:])
    assert solve_window(AIR, PLATE, salt).model.distance_mm == pytest.approx(DISTANCE, abs=1e-6)


@pytest.mark.parametrize("window", [PLATE, INTERFACE])
def test_air_shows_nothing_of_the_distance(window):
    with pytest.raises(CalibrationError, match="depends too little"):
        solve_window(AIR, window, steps(window, nine_steps()[3:6], index=1.0))


def test_a_step_lost_in_noise_is_refused():
    rng = np.random.default_rng(6)
    low = [step_profile(10.0, height_mm=2.0, count=120)]
    with pytest.raises(
        (CalibrationError, EvaluationError), match="depends too little|no two parallel|no two step faces|treads found"
    ):
        solve_window(AIR, PLATE, steps(PLATE, low, noise_px=1.0, rng=rng, height_mm=2.0))


def test_the_bound_is_no_answer():
    images = clean_steps(PLATE)
    for bounds in ((50.0, 90.0), (20.0, 45.0)):
        with pytest.raises(CalibrationError, match="at the bound"):
            solve_window(AIR, PLATE, images, bounds_mm=bounds)
    for bounds in ((-5.0, 90.0), (90.0, 50.0), (10.0, np.inf)):
        with pytest.raises(CalibrationError, match="0 < low < high"):
            solve_window(AIR, PLATE, images, bounds_mm=bounds)
    with pytest.raises(CalibrationError, match="behind the step"):
        solve_window(AIR, PLATE, images, bounds_mm=(600.0, 900.0))


def test_a_window_behind_the_step_is_not_tried():
    solution = solve_window(AIR, PLATE, clean_steps(PLATE), bounds_mm=(10.0, 600.0))
    assert np.isnan(solution.curve_mm[-1, 1])
    assert solution.bounds_mm[1] < 400
    assert solution.model.distance_mm == pytest.approx(DISTANCE, abs=1e-6)


def test_an_image_that_fits_no_distance_has_none():
    images = clean_steps(PLATE)
    odd = labelled(PLATE, images[4].pixels, STEP_MM + 4)
    solution = solve_window(AIR, PLATE, [*images, *images, odd])
    assert np.isnan(solution.image_distances_mm[-1])
    assert np.isfinite(solution.image_distances_mm[:-1]).all()


def test_unusable_steps_are_refused():
    with pytest.raises(CalibrationError, match="at least one"):
        solve_window(AIR, PLATE, [])
    with pytest.raises(EvaluationError, match="no two parallel step faces"):
        steps(PLATE, [np.column_stack([np.zeros(400), np.linspace(-60, 60, 400), np.full(400, 10.0)])])
    good = steps(PLATE, nine_steps()[3:4])[0]
    with pytest.raises(RangeError, match="finite"):
        labelled(PLATE, good.pixels * np.nan)
    with pytest.raises(CalibrationError, match="positive lengths"):
        solve_window(AIR, PLATE, [with_height(good, np.nan)])
