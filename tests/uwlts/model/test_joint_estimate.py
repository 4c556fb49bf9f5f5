"""Calibrations with a damaged joint estimate are rejected with one line when they are read."""

import json

import numpy as np
import pytest

from tests.uwlts.calibration_views import built_sensor
from tests.uwlts.joint_views import Noise, gathered, target_series
from uwlts.calibration.calibrate import solve_jointly
from uwlts.calibration.joint.next_shot import rank_next_shots
from uwlts.calibration.joint.stored_estimate import read_original_estimate
from uwlts.calibration.sequential.sequential_calibration import CalibrationOptions
from uwlts.errors import CalibrationError, CaptureError
from uwlts.model.parameter_keys import StageParameter
from uwlts.model.sensor import Medium
from uwlts.storage.calibration_file import load_calibration

WATER = Medium(kind="fresh", temperature_c=25.0)


def calibrated(described):
    rng = np.random.default_rng(4)
    noise = Noise(circles_px=0.03, stripe_px=0.1, stage_mm=0.003, rng=rng)
    positions = np.arange(6) * 36.0 - 130.0
    series = target_series(built_sensor(), medium=0, positions=positions, noise=noise, columns=11)
    evidence = gathered(described, [series])
    evidence.media["water"] = WATER
    return solve_jointly(evidence, options=CalibrationOptions(poses="stage", correct_circles=False)).calibration


@pytest.fixture(scope="module")
def written(thesis, tmp_path_factory):
    path = tmp_path_factory.mktemp("joint") / "calibration.json"
    calibrated(thesis).save(path)
    return path


def damage(**changes):
    """Replace entries of the joint estimate by the given values, or remove them by None."""

    def damaged(joint):
        joint.update(changes)
        for key in [key for key, value in changes.items() if value is None]:
            del joint[key]

    return damaged


def negative_variance(joint):
    joint["covariance"][0][0] = -1.0


def edited(row, column, factor):
    def damaged(joint):
        joint["covariance"][row][column] *= factor

    return damaged


def impossible_correlation(joint):
    std = joint["std"]
    joint["covariance"][0][1] = joint["covariance"][1][0] = 1.5 * std[0] * std[1]


@pytest.mark.parametrize(
    ("damaged", "said"),
    [
        (damage(parameters=None), "parameters: Field required"),
        (damage(scatter_px=None), "scatter_px: Field required"),
        (damage(values=[1.0]), "must have the size of the"),
        (damage(covariance=[[1.0]]), "must have the size of the"),
        (edited(0, 1, 1.5), "the covariance is not symmetric"),
        (edited(2, 2, 4.0), "the variances are not the squares of std"),
        (impossible_correlation, "the covariance has a negative eigenvalue"),
        (damage(strays="many"), "strays: "),
        (damage(covered=[{}]), "covered.0.medium: Field required"),
        (negative_variance, "a variance is negative"),
    ],
)
def test_a_damaged_estimate_is_noticed_when_it_is_read(written, tmp_path, damaged, said):
    content = json.loads(written.read_text(encoding="utf-8"))
    del content["sha256"]
    damaged(content["residuals"]["joint"])
    path = tmp_path / "damaged.json"
    path.write_text(json.dumps(content), encoding="utf-8")
    with pytest.raises(CaptureError, match="is not a valid calibration: joint") as refused:
        load_calibration(path)
    assert said in str(refused.value)


@pytest.mark.parametrize(
    ("key", "value", "said"),
    [
        ("known_before", {"bow_deg": "x"}, "known_before.bow_deg: "),
        ("known_before", {"curl_deg": 1.0}, "known_before.curl_deg: Extra inputs"),
        ("step_captures", 3, "step_captures: "),
        ("scan_captures", [{"file": "scan.h5"}], "scan_captures.0.sha256: Field required"),
    ],
)
def test_a_damaged_origin_is_noticed_when_it_is_read(written, tmp_path, key, value, said):
    content = json.loads(written.read_text(encoding="utf-8"))
    del content["sha256"]
    content["provenance"][key] = value
    path = tmp_path / "damaged.json"
    path.write_text(json.dumps(content), encoding="utf-8")
    with pytest.raises(CaptureError, match="is not a valid calibration: provenance") as refused:
        load_calibration(path)
    assert said in str(refused.value)


def test_indices_without_their_media_are_noticed(written):
    calibration = load_calibration(written)
    assert read_original_estimate(calibration, WATER).parameters.media == ("water",)
    with pytest.raises(CalibrationError, match="1 indices for 0 media"):
        read_original_estimate(calibration.model_copy(update={"media": ()}), WATER)


def test_advice_is_given_for_an_exactly_known_stage(thesis):
    exact = thesis.uncertainty.model_copy(update={"stage_scale": 0.0})
    calibration = calibrated(thesis.model_copy(update={"uncertainty": exact}))
    assert StageParameter.SCALE not in calibration.joint.parameters
    best = rank_next_shots(calibration)[0]
    assert best.after < best.before
