"""Step standards that do not face the laser: images along the stage show their rotation, a single profile does not."""

from dataclasses import replace

import numpy as np
import pytest

from tests.uwlts.calibration_views import STEP_MM, WATER, square_sensor, step_profile, through_window
from tests.uwlts.joint_views import gathered
from uwlts.calibration.capture_evidence import StepEvidence
from uwlts.calibration.joint.initial import build_step_evidence
from uwlts.calibration.joint.parameters import Prior, ViewMedium
from uwlts.calibration.sequential.step_images import StandardTurn, label_steps, solve_window
from uwlts.model.artefacts import StepStandard
from uwlts.model.calibration import WindowModel
from uwlts.model.parameter_keys import StepHeight
from uwlts.model.sensor import Uncertainty
from uwlts.optics.nominal import nominal_calibration

SENSOR = square_sensor()
AIR = nominal_calibration(SENSOR).model_copy(update={"window": None})
TRUE = WindowModel.from_description(SENSOR.camera.window, SENSOR.laser.wavelength_nm)
DESCRIBED = TRUE.model_copy(update={"distance_mm": TRUE.distance_mm + 5.0})
STANDARD = StepStandard(height_mm=STEP_MM, height_uncertainty_mm=0.002)
TURN = np.radians(6.0)


def turned_step(capture, *, about_stripe=0.0, aside=0.0, travel_mm=(-10.0, 0.0, 10.0), depth_mm=15.0, moved_mm=None):
    """Images of a standard at rest, rotated about both axes, while the stage moves the sensor along X.

    ``moved_mm`` are additional shifts of the standard in depth between the images.
    """
    images, rng = [], np.random.default_rng(3)
    for number, travel in enumerate(travel_mm):
        depth = depth_mm + np.tan(about_stripe) * travel + (moved_mm[number] if moved_mm else 0.0)
        profile = step_profile(depth, tilt=aside, height_mm=STEP_MM / np.cos(about_stripe), count=400)
        pixels = through_window(SENSOR, profile, noise_px=0.1, rng=rng)
        images.append(StepEvidence(pixels, STANDARD, WATER, f"{capture}, frame {number}", (travel, 0.0, 0.0)))
    return images


def labelled(steps):
    images, warnings = label_steps(AIR, DESCRIBED, steps, uncertainty=Uncertainty())
    assert None not in images
    return images, warnings


@pytest.mark.parametrize("sign", [1, -1])
def test_a_turn_about_the_stripe_shows_along_the_stage_and_is_taken_into_account(sign):
    """By a window 5 mm off, which stretches depths by some percent, and so the turn; lines have noise of 0.1 px.

    The relative error of 0.55 % in the height is known to a sixth: 0.5° of the stage's direction and 5 % of the scale.
    """
    images, (said,) = labelled(turned_step("step.h5", about_stripe=sign * TURN))
    for image in images:
        assert image.lengthened == pytest.approx(1 / np.cos(TURN), abs=2 * image.lengthened_std)
        assert image.lengthened_std == pytest.approx(np.tan(TURN) * np.radians(0.58), rel=0.1)
    assert said.startswith("step.h5: the standard does not face the laser: it is rotated by ")
    assert float(said.split("rotated by ")[1].split(" ")[0]) == pytest.approx(6.0, abs=0.5)
    assert "about the stripe, so that it appears higher by 0.5" in said
    assert said.count("taken into account") == 1


def test_the_windows_distance_is_that_of_the_turned_step():
    """A step seen 0.128 mm too high puts the window 5 mm wrong; with its turn known, 1 mm or less is left of that."""
    steps = turned_step("near.h5", about_stripe=TURN, depth_mm=-45.0) + turned_step(
        "far.h5", about_stripe=TURN, depth_mm=85.0
    )
    images, _ = labelled(steps)
    off = [
        abs(solve_window(AIR, DESCRIBED, each).model.distance_mm - TRUE.distance_mm)
        for each in (images, [replace(image, lengthened=1.0) for image in images])
    ]
    assert off[0] < 1.0
    assert off[1] > 4.0


def test_a_standard_that_faces_the_laser_is_not_doubted():
    """The stage's direction limits the rotation to 0.5° or 7e-5 of the height."""
    images, warnings = labelled(turned_step("step.h5"))
    assert warnings == []
    assert images[0].lengthened == pytest.approx(1.0, abs=1e-5)
    assert 5e-5 < images[0].lengthened_std < 1e-4


@pytest.mark.parametrize(("stated_mm", "doubted"), [(0.3, False), (0.2, True)])
def test_a_turn_that_matters_less_than_the_certificate_is_not_doubted(stated_mm, doubted):
    """At 6°, a step of 23 mm is 0.13 mm too high; a certificate states twice the standard uncertainty."""
    standard = StepStandard(height_mm=STEP_MM, height_uncertainty_mm=stated_mm)
    steps = [replace(step, standard=standard) for step in turned_step("step.h5", about_stripe=TURN)]
    _, warnings = labelled(steps)
    assert bool(warnings) == doubted


@pytest.mark.parametrize(
    "steps",
    [
        {"travel_mm": (0.0, 0.0, 0.0)},
        {"travel_mm": (-10.0, 10.0)},
        {"travel_mm": (-10.0, 0.0, 10.0), "moved_mm": (0.0, 3.0, -5.0)},
    ],
    ids=["the stage stood", "two images", "the standard was moved"],
)
def test_one_profile_shows_the_other_turn_only(steps):
    """The slope of the faces shows the rotation; the one about the stripe is assumed to be as large."""
    images, (said,) = labelled(turned_step("step.h5", aside=-0.05, **steps))
    assert "rotated by 2.9° about the sheet's normal" in said
    assert "appears higher by 0.13 % or 0.029 mm" in said
    assert "let the stage move the sensor across the stripe" in said
    for image in images:
        assert image.lengthened == 1.0
        # sqrt(3) / 2 of the square; depths by the window as described are off by some percent.
        assert image.lengthened_std == pytest.approx(0.866 * 0.05**2, rel=0.15)


def test_the_joint_estimate_knows_a_height_as_well_as_its_turn():
    """The certificate's 1 µm, and what the turn of the worse of two captures leaves: 1.1e-3 of the height."""
    steps = [*turned_step("one.h5", about_stripe=TURN), *turned_step("two.h5")]
    described = SENSOR.model_copy(update={"uncertainty": Uncertainty()})
    seen = gathered(described, [], [(step, ViewMedium(True, 0)) for step in steps])
    evidence, heights, warnings = build_step_evidence(seen, AIR, DESCRIBED)
    images, said = labelled(steps)
    assert warnings == said
    assert [piece.lengthened for piece in evidence] == [image.lengthened for image in images]
    assert heights == {StepHeight(STEP_MM): Prior(STEP_MM, np.hypot(0.001, STEP_MM * images[0].lengthened_std))}


def test_each_capture_has_a_turn_of_its_own_and_images_keep_their_places():
    flat = replace(turned_step("bad.h5")[0], pixels=turned_step("bad.h5")[0].pixels[:30])
    steps = [*turned_step("one.h5", about_stripe=TURN), flat, *turned_step("two.h5")]
    images, warnings = label_steps(AIR, DESCRIBED, steps, uncertainty=Uncertainty())
    assert [image is None for image in images] == [False] * 3 + [True] + [False] * 3
    assert [images[number].lengthened > 1.001 for number in (0, 6)] == [True, False]
    assert [words.split(":")[0] for words in warnings] == ["one.h5", "bad.h5, frame 0"]


def test_a_turn_is_worth_a_warning_where_it_exceeds_the_heights_uncertainty():
    """1° makes 23 mm higher by 3.5 µm."""
    turn = StandardTurn(np.radians(1.0), None, np.radians(1.0))
    assert turn.doubt(height_mm=23.0, std_mm=0.0036) == ""
    assert "higher by 0.02 % or 0.004 mm" in turn.doubt(height_mm=23.0, std_mm=0.0034)


@pytest.mark.parametrize(("expanded_mm", "count"), [(0.0115, 0), (0.007, 1), (None, 0)])
def test_half_of_the_certificates_expanded_uncertainty_decides(expanded_mm, count):
    """0.02 rad make 23 mm higher by 4.6 um; without a statement, the usual uncertainty is 10 um."""
    standard = STANDARD.model_copy(update={"height_uncertainty_mm": expanded_mm})
    steps = [replace(step, standard=standard) for step in turned_step("step.h5", aside=0.02, travel_mm=(0.0,))]
    _, warnings = label_steps(AIR, DESCRIBED, steps, uncertainty=Uncertainty(step_height_mm=0.01))
    assert len(warnings) == count
