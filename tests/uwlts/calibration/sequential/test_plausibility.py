"""Wrong sizes of target and step in a sequential calibration, from views without drawn pixels."""

from dataclasses import replace

import numpy as np
import pytest

from tests.uwlts.calibration_views import (
    STEP_MM,
    WATER,
    built_sensor,
    lattice,
    nine_steps,
    stage_images,
    step_profile,
    stripes_on_target,
    through_window,
)
from tests.uwlts.joint_views import TARGET
from tests.virtual_sensors import altered
from uwlts.calibration.capture_evidence import AirEvidence, StepEvidence
from uwlts.calibration.sequential.sequential_calibration import CalibrationOptions, Evidence, solve
from uwlts.model.artefacts import StepStandard

SENSOR = built_sensor()
BARE = altered(SENSOR, {"camera": {"window": {"mounted": False}}})
AT_ONE_DEPTH = [
    step_profile(15.0, shift_mm=shift, tilt=tilt) for shift, tilt in ((-15, 0.01), (0, -0.02), (12, 0.03), (5, 0.0))
]


def calibrated(*, spacing=1.0, step_mm=0.0, profiles=None, positions=6, poses="stage-normal", seed=0):
    """Return warnings, if the target's spacing and the step's height are stated wrong."""
    rng = np.random.default_rng([40, seed])
    images, true, _ = stage_images(
        BARE, positions=np.arange(positions) * 40.0, noise_px=0.05, rng=rng, points=lattice(17, 17)
    )
    images = [replace(image, points_mm=spacing * image.points_mm) for image in images]
    stripes, frames = stripes_on_target(BARE, true, noise_px=0.1, rng=rng), [(0, number) for number in range(positions)]
    air = AirEvidence(TARGET, images, frames, stripes, [], outliers=[0] * positions, captures=["air.h5"])
    standard = StepStandard(height_mm=STEP_MM + step_mm)
    steps = [
        StepEvidence(through_window(SENSOR, profile, noise_px=0.2, rng=rng), standard, WATER, f"s, frame {number}")
        for number, profile in enumerate(nine_steps() if profiles is None else profiles)
    ]
    along = np.array([0.0, 0.0, 1.0])
    evidence = Evidence(BARE, "air", along, True, air, SENSOR.camera.window, steps, {}, [])
    return solve(evidence, options=CalibrationOptions(correct_circles=False, poses=poses)).warnings


@pytest.mark.parametrize("poses", ["stage-normal", "stage"])
def test_right_sizes_are_not_doubted(poses):
    assert calibrated(poses=poses) == []


@pytest.mark.parametrize(("spacing", "poses"), [(0.99, "stage"), (1.005, "stage-normal")])
def test_a_target_of_wrong_size_is_noticed_by_the_stage_s_travel(spacing, poses):
    said = next(each for each in calibrated(spacing=spacing, poses=poses, seed=1) if "the target's poses" in each)
    found, std = (float(said.split("differ by ")[1].split()[place]) for place in (0, 2))
    # Four standard uncertainties, and half a unit of the last digit: one draw in 16,000 is farther away.
    assert found == pytest.approx(100 * (spacing - 1), abs=4 * std + 0.005) and std < 0.1


def test_a_step_of_wrong_height_is_noticed_at_several_distances():
    step_mm = -0.2
    (said,) = calibrated(step_mm=step_mm, seed=2)
    found, std = (float(said.split("a height ")[1].split()[place]) for place in (0, 2))
    assert found == pytest.approx(-100 * step_mm / (STEP_MM + step_mm), abs=4 * std + 0.005) and std < 0.2
    distance = float(said.split("a window ")[1].split()[0])
    # A relative height error of 1 % has the effect of 10 mm.
    assert distance == pytest.approx(SENSOR.camera.window.distance_mm, abs=4 * std * 12)


def test_a_step_at_one_distance_hides_its_height():
    """Its effect is that of the window's distance, as docs/reference/what-is-noticed.md says."""
    assert calibrated(step_mm=0.2, profiles=AT_ONE_DEPTH) == []
    assert calibrated(step_mm=0.2, profiles=nine_steps()[::4]) == []


def test_free_poses_hide_the_target_s_size():
    assert not any("the target's poses" in each for each in calibrated(spacing=1.01, poses="free"))
