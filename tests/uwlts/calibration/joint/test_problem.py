"""Estimates from some of the images: linearised against new ones, halves, and parameters tied to prior knowledge."""

from dataclasses import replace

import numpy as np
import pytest

from tests.uwlts.calibration_views import built_sensor
from tests.uwlts.joint_views import Noise, edited, gathered, target_series
from uwlts.calibration.calibrate import solve_jointly
from uwlts.calibration.joint.problem import joint_problem
from uwlts.calibration.joint.residuals import TARGET
from uwlts.calibration.sequential.sequential_calibration import CalibrationOptions
from uwlts.model.parameter_keys import LensParameter, TargetParameter

BUILT = built_sensor()
OPTIONS = CalibrationOptions(poses="free", correct_circles=False)
TILTS = np.array([(-0.3, 0.2), (0.3, -0.2), (0.2, 0.3), (-0.2, -0.3), (0.3, 0.3), (-0.3, -0.2), (0.0, 0.3), (0.3, 0.0)])


def series(seed=5, *, wider=0.0):
    """Return eight images of a target held by hand in air; every second one is of a board wider by a fraction."""
    noise = Noise(circles_px=0.03, stripe_px=0.1, rng=np.random.default_rng(seed))
    found = target_series(
        BUILT, window=False, positions=np.linspace(-150.0, 50.0, 8), noise=noise, columns=7, tilts=TILTS
    )

    def widened(number, image):
        return replace(image, points_mm=image.points_mm * [1 - wider * (number % 2), 1.0, 1.0])

    return edited(found, widened, every=12)


@pytest.fixture(scope="module")
def problem(thesis):
    return joint_problem(gathered(thesis, [series()]), options=OPTIONS)


@pytest.fixture(scope="module")
def solved(problem):
    return problem.solve()


def test_an_estimate_without_some_images_is_that_of_a_new_solution(problem, solved):
    """Halves by linearisation against new solutions: a tenth of a standard uncertainty, for weights that change."""
    halves = problem.linearise(solved).compare_halves()
    assert {each.key for each in halves} == set(solved.parameters.keys)
    for first, name in ((0, "one"), (1, "other")):
        evidence, local = problem.evidence[first::2], solved.local[first::2]
        again = replace(problem, evidence=evidence, local=local, global_values=solved.values).solve()
        for each, value, std in zip(halves, again.values, again.std().values(), strict=True):
            assert getattr(each, name) == pytest.approx(value, abs=0.35 * std), each.key


def test_halves_of_good_evidence_agree_and_their_difference_is_as_large_as_stated(problem, solved):
    halves = problem.linearise(solved).compare_halves()
    assert max(each.sigmas() for each in halves) < 4


def test_held_out_images_are_predicted_to_their_noise(problem, solved):
    """Of 800 coordinates, a mean square is right to 5 %; the lens of 8 images adds less than a fifth."""
    held = problem.linearise(solved).predict()
    points = np.concatenate([values[kinds == TARGET] for values, kinds in held])
    assert len(held) == 8 and len(points) > 600
    assert 0.9 < np.sqrt(np.mean(points**2)) / 0.03 < 1.25


def test_a_tied_parameter_stays_and_its_uncertainty_is_passed_on(problem, solved):
    """Against differences: the solution with the bow held one standard uncertainty higher."""
    bow = TargetParameter.BOW
    tied = replace(problem, parameters=replace(problem.parameters, tied=frozenset({bow})), local=solved.local)
    found, prior = tied.solve(), problem.parameters.priors[bow]
    place = found.parameters.keys.index(bow)
    assert found.values[place] == pytest.approx(prior.mean, abs=1e-9)
    assert found.std()[bow] == pytest.approx(prior.std)
    moved = replace(prior, mean=prior.mean + prior.std)
    higher = replace(tied, parameters=replace(tied.parameters, priors=tied.parameters.priors | {bow: moved})).solve()
    for key in (LensParameter.F, LensParameter.K1):
        number = found.parameters.keys.index(key)
        change = higher.values[number] - found.values[number]
        assert found.covariance[number, place] / prior.std == pytest.approx(change, abs=0.1 * found.std()[key])
        assert found.std()[key] > 0.98 * abs(change)


@pytest.mark.slow
def test_a_stretch_that_halves_of_the_images_disagree_on_is_not_believed(thesis):
    """Of 0.5 % in every second image and none in the others: spacings stay as described, and this is said."""
    result = solve_jointly(gathered(thesis, [series(wider=0.005)]), options=OPTIONS)
    said = [each for each in result.warnings if "stretch of the target" in each and "it is not believed" in each]
    assert said and "two halves of the images disagree" in said[0]
    place = result.estimate.parameters.keys.index(TargetParameter.STRETCH_X)
    assert abs(result.estimate.values[place]) < thesis.uncertainty.target_stretch
    assert not any("enlarged accordingly" in each for each in result.warnings)
