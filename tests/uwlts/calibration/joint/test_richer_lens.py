"""Further lens coefficients are estimated where they explain the evidence better; on small evidence, fast."""

from dataclasses import replace

import numpy as np
import pytest

from tests.uwlts.calibration_views import built_sensor
from tests.uwlts.joint_views import Noise, gathered, target_series
from tests.virtual_sensors import altered
from uwlts.calibration.calibrate import solve_jointly
from uwlts.calibration.camera.lens import LensChoice
from uwlts.calibration.sequential.sequential_calibration import CalibrationOptions
from uwlts.errors import CalibrationError
from uwlts.model.parameter_keys import LensParameter

BUILT = built_sensor()
OPTIONS = CalibrationOptions(poses="stage", correct_circles=False, lens=LensChoice())


def few_views(sensor, *, stripe_px):
    """Four images of 49 points in air, and of each stripe every fourth point."""
    noise = Noise(circles_px=0.03, stripe_px=stripe_px, stage_mm=0.003, rng=np.random.default_rng(8))
    positions = np.linspace(-200.0, 60.0, 4)
    series = target_series(sensor, window=False, positions=positions, noise=noise, columns=7)
    return replace(series, found=replace(series.found, stripes=[pixels[::4] for pixels in series.found.stripes]))


def test_a_lens_that_is_not_centred_is_found(thesis):
    """Its points are off by pixels without p1; that k3 is given too happens by chance."""
    lens = altered(BUILT, {"camera": {"distortion": {"p1": -0.005}}})
    result = solve_jointly(gathered(thesis, [few_views(lens, stripe_px=0.1)]), options=OPTIONS)
    assert any(said.startswith("p1, p2 were added to the lens") for said in result.warnings)
    found = result.estimate.values[result.estimate.parameters.keys.index(LensParameter.P1)]
    assert abs(found + 0.005) < 4.5 * result.estimate.std()[LensParameter.P1]


def test_a_wrong_spacing_is_not_taken_for_pixels_that_are_not_square(thesis):
    """Rows described 0.3 % too wide, and a stripe that is too noisy for any lens.

    Pixels of another shape explain the spacing as well: both are estimated, and focal lengths are as uncertain.
    """
    series = few_views(BUILT, stripe_px=1.8)
    images = [replace(image, points_mm=image.points_mm * [1.003, 1.0, 1.0]) for image in series.found.images]
    wide = replace(series, found=replace(series.found, images=images))
    result = solve_jointly(gathered(thesis, [wide]), options=OPTIONS)
    assert any("images show systematic deviations from the model" in said for said in result.warnings)
    assert any("both are estimated" in said for said in result.warnings)
    camera, std = result.calibration.camera, result.estimate.std()
    assert abs(camera.fx_px - BUILT.camera.focal_length_px()) < 4.5 * std[LensParameter.FX]
    assert abs(camera.fy_px - BUILT.camera.focal_length_px()) < 4.5 * std[LensParameter.FY]


def target_in_air_and_water(sensor, *, columns_wider=1.0):
    """Four images each of a target whose described column spacing is too large by a factor."""
    noise = Noise(circles_px=0.03, stripe_px=0.1, stage_mm=0.003, rng=np.random.default_rng(8))
    air = target_series(sensor, window=False, positions=np.linspace(-200.0, 60.0, 4), noise=noise, columns=13)
    water = target_series(sensor, medium=0, positions=np.linspace(-120.0, 60.0, 4), noise=noise, columns=13)
    for series in (air, water):
        images = [replace(i, points_mm=i.points_mm * [columns_wider, 1.0, 1.0]) for i in series.found.images]
        stripes = [pixels[::4] for pixels in series.found.stripes]
        yield replace(series, found=replace(series.found, images=images, stripes=stripes))


@pytest.mark.parametrize(
    ("aspect", "columns_wider", "alignment_deg"),
    [
        (1.003, 1.0, 0.4),
        (1.0, 1.003, 0.15),
        pytest.param(1.003, 1.0, 0.15, marks=pytest.mark.slow),
        pytest.param(1.0, 1.003, 0.4, marks=pytest.mark.slow),
    ],
)
def test_pixels_of_another_shape_look_like_a_stretched_target(thesis, aspect, columns_wider, alignment_deg):
    """If the stage cannot separate them, both are estimated: the focal lengths are within the stated uncertainties."""
    built = altered(BUILT, {"camera": {"pixel_aspect": aspect}})
    known = altered(thesis, {"uncertainty": {"stage_alignment_deg": alignment_deg}})
    evidence = gathered(known, list(target_in_air_and_water(built, columns_wider=columns_wider)))
    result = solve_jointly(evidence, options=OPTIONS)
    assert any("or the pixels' shape is not as described: both are estimated" in said for said in result.warnings)
    camera, std = result.calibration.camera, result.estimate.std()
    focal_px = built.camera.focal_length_px()
    assert abs(camera.fx_px - focal_px) < 4.5 * std[LensParameter.FX]
    assert abs(camera.fy_px - aspect * focal_px) < 4.5 * std[LensParameter.FY]


def test_with_pixels_said_to_be_square_a_wrong_spacing_is_to_be_stated(thesis):
    """0.3 %, thirty times the default: refused or not believed, as no prior knowledge is worth so little."""
    evidence, square = list(target_in_air_and_water(BUILT, columns_wider=1.003)), LensChoice(pixels="square")
    try:
        said = solve_jointly(gathered(thesis, evidence), options=replace(OPTIONS, lens=square)).warnings
    except CalibrationError as refusal:
        said = [str(refusal)]
    assert any("stretch of the target along its rows" in each and "times what is stated" in each for each in said)
    stated = altered(thesis, {"uncertainty": {"target_stretch": [3e-3, 1e-4]}})
    result = solve_jointly(gathered(stated, evidence), options=replace(OPTIONS, lens=square))
    assert result.calibration.camera.fx_px == result.calibration.camera.fy_px
