"""Evidence that contradicts itself or its description is rejected with the names of the images and figures."""

from dataclasses import replace

import numpy as np
import pytest

from tests.uwlts.calibration_views import built_sensor
from tests.uwlts.joint_views import Noise, edited, gathered, target_series
from tests.virtual_sensors import altered
from uwlts.calibration.calibrate import solve_jointly
from uwlts.calibration.camera.lens import LensChoice
from uwlts.calibration.joint.diagnose import format_deviation
from uwlts.calibration.joint.parameters import ViewMedium
from uwlts.calibration.sequential.sequential_calibration import CalibrationOptions
from uwlts.errors import CalibrationError
from uwlts.model.calibration import CameraModel
from uwlts.model.parameter_keys import LensParameter, WindowParameter, parse_parameter
from uwlts.model.sensor import Medium, Uncertainty

pytestmark = pytest.mark.slow

BUILT = built_sensor()
OPTIONS = CalibrationOptions(poses="stage", correct_circles=False)
ANY_LENS = LensChoice()


@pytest.fixture(scope="module")
def thesis(thesis):
    """Return the sensor of the drawings with typical uncertainties."""
    return thesis.model_copy(update={"uncertainty": Uncertainty()})


@pytest.fixture(scope="module")
def views():
    noise = Noise(circles_px=0.03, stripe_px=0.1, stage_mm=0.003, rng=np.random.default_rng(8))
    air = target_series(BUILT, window=False, positions=np.arange(8) * 35.0 - 200.0, noise=noise, columns=17)
    water = target_series(BUILT, medium=0, positions=np.arange(8) * 25.0 - 120.0, noise=noise, columns=17)
    return named(edited(air, every=2), "air.h5"), named(edited(water, every=2), "water.h5")


def named(series, name):
    return replace(series, found=replace(series.found, captures=[name]))


def stripes_edited(series, edit):
    """Return the series with each stripe replaced by ``edit(number, pixels)``."""
    stripes = [edit(number, pixels.copy()) for number, pixels in enumerate(series.found.stripes)]
    return replace(series, found=replace(series.found, stripes=stripes))


def refusal(evidence, *, strict=False, lens=ANY_LENS):
    """Return the reason for rejected evidence, with rejection of images and, by default, all lens models allowed."""
    with pytest.raises(CalibrationError) as error:
        solve_jointly(evidence, options=replace(OPTIONS, lens=lens, strict=strict))
    return str(error.value).splitlines()[0]


def lens_pulls(result, sensor):
    """Return the errors of the lens parameters divided by their stated uncertainties."""
    known = CameraModel.from_description(sensor.camera).parameters()
    found = zip(result.estimate.parameters.keys, result.estimate.values, result.estimate.std().values(), strict=True)
    return np.array([abs(value - known[k.text]) / std for k, value, std in found if isinstance(k, LensParameter)])


def pulls(result):
    """Return the errors of lens and window distance divided by their stated uncertainties."""
    lens = CameraModel.from_description(BUILT.camera).parameters()
    names = (LensParameter.F, LensParameter.CX, LensParameter.CY, LensParameter.K1, LensParameter.K2)
    true = {name: lens[name.text] for name in names} | {WindowParameter.DISTANCE: BUILT.camera.window.distance_mm}
    found = dict(zip(result.estimate.parameters.keys, result.estimate.values.tolist(), strict=True))
    return np.array([(found[key] - value) / result.estimate.std()[key] for key, value in true.items()])


def test_good_evidence_raises_no_doubt(views, thesis):
    assert not solve_jointly(gathered(thesis, views), options=OPTIONS).warnings


def test_a_wrong_spacing_shows_against_the_stage(views, thesis):
    wide = [edited(part, lambda _, image: replace(image, points_mm=1.02 * image.points_mm)) for part in views]
    assert "check the target's spacing and the stage's scale" in refusal(gathered(thesis, wide))


def test_a_slip_of_the_stage_is_named(views, thesis):
    air, water = views
    slipped = edited(air, lambda n, image: replace(image, stage_mm=image.stage_mm + (n == 3)))
    said = refusal(gathered(thesis, [slipped, water]))
    assert "air.h5, frame 3: the stage was -0.9" in said
    assert all(f"frame {other}: the stage" not in said for other in (0, 1, 2, 4, 5, 6, 7))


def touched(number, image):
    """Moved by 1.5 px and sheared by up to a pixel, as a window that was touched; one of 16 images."""
    shear = 1e-3 * (image.pixels - image.pixels.mean(axis=0))[:, ::-1]
    return replace(image, pixels=image.pixels + (1.5, 0.0) + shear) if number == 5 else image


def test_the_image_that_does_not_fit_is_named(views, thesis):
    said = refusal(gathered(thesis, [views[0], edited(views[1], touched)]), strict=True)
    assert "water.h5, frame 5: the target is" in said
    assert "air.h5" not in said


def test_the_image_that_does_not_fit_is_left_out(views, thesis):
    result = solve_jointly(gathered(thesis, [views[0], edited(views[1], touched)]), options=OPTIONS)
    (said,) = result.warnings
    assert said.startswith("water.h5, frame 5: the target is") and said.endswith("left out")
    assert [len({part.image for part in parts}) for parts in result.estimate.residuals] == [8, 7]
    assert np.abs(pulls(result)).max() < 4.5


def test_images_are_left_out_as_long_as_enough_agree(views, thesis):
    evidence = gathered(thesis, views)
    assert evidence.remove_images({"air.h5, frame 0", "air.h5, frame 7"}).series[0].found.frames == [
        (0, n) for n in range(1, 7)
    ]
    assert evidence.remove_images({f"air.h5, frame {n}" for n in range(3)}) is None


def curled(strength_px):
    """Add a distortion outside the lens model: a cubic across the image, ``strength_px`` at its sides."""

    def edit(_, image):
        x = (image.pixels[:, 0] - 640.0) / 640.0
        return replace(image, pixels=image.pixels + np.column_stack([0 * x, strength_px * x**3]))

    return edit


def test_what_the_model_lacks_makes_uncertainties_larger(views, thesis):
    """The errors of some parameters are many times the uncertainty due to scatter."""
    wrong = gathered(thesis, [edited(part, curled(6.0)) for part in views])
    assert "the target has systematic deviations across the image" in refusal(wrong, strict=True)
    result = solve_jointly(wrong, options=OPTIONS)
    assert any("systematic deviations from the model" in said for said in result.warnings)
    assert np.abs(pulls(result)).max() < 4.5


def test_distortion_that_a_lens_has_besides_is_found(thesis):
    """A wide lens with more than a pixel of residual distortion in the corners after k1 and k2."""
    lens = altered(BUILT, {"camera": {"focal_length_mm": 8.0, "distortion": {"k3": 1.5}}})
    described = altered(thesis, {"camera": {"focal_length_mm": 8.0}})
    noise = Noise(circles_px=0.03, stripe_px=0.1, stage_mm=0.003, rng=np.random.default_rng(8))
    air = target_series(lens, window=False, positions=np.arange(8) * 35.0 - 200.0, noise=noise, columns=17)
    result = solve_jointly(gathered(described, [edited(air, every=4)]), options=replace(OPTIONS, lens=LensChoice()))
    assert any("k3 were added to the lens:" in said for said in result.warnings)
    assert lens_pulls(result, lens).max() < 4.5


def test_a_lens_other_than_in_water_is_refused(views, thesis):
    camera = BUILT.camera.model_copy(update={"focal_length_mm": 12.5})
    noise = Noise(circles_px=0.03, stripe_px=0.1, rng=np.random.default_rng(1))
    other = target_series(
        BUILT.model_copy(update={"camera": camera}),
        window=False,
        positions=np.arange(8) * 35.0 - 200.0,
        noise=noise,
        columns=17,
    )
    usual = LensChoice(("k1", "k2"), "square")
    assert "contradicts itself" in refusal(gathered(thesis, [edited(other, every=2), views[1]]), lens=usual)


def test_a_water_image_said_to_be_in_air_shows_in_the_focal_length(views, thesis):
    said = refusal(gathered(thesis, [replace(views[1], view=ViewMedium(True, None))]))
    assert "the focal length is 32" in said
    assert "the medium in the captures" in said


def test_without_a_target_there_is_no_joint_calibration(thesis):
    assert "no capture shows a target" in refusal(gathered(thesis, []))


def test_a_wrong_index_is_refused(views, thesis):
    evidence = gathered(thesis, views)
    evidence.media["water"] = Medium(kind="custom", index=1.345)
    said = refusal(evidence)
    assert "index of water found 1.33" in said
    assert "described as 1.34500 +- 0.0001" in said


def test_reflections_on_a_third_of_the_lines_are_left_out_with_a_word(views, thesis):
    """All on one side, 15 to 60 px away; the parameters stay within their uncertainties."""
    rng = np.random.default_rng(0)

    def spoilt(_, pixels):
        stray = rng.random(len(pixels)) < 0.3
        pixels[stray, 1] += rng.uniform(15, 60, stray.sum())
        return pixels

    clean = solve_jointly(gathered(thesis, views), options=OPTIONS).estimate
    result = solve_jointly(gathered(thesis, [stripes_edited(part, spoilt) for part in views]), options=OPTIONS)
    assert [doubt for doubt in result.warnings if "% of the stripe on the target was left out as outliers" in doubt]
    moved = np.abs(result.estimate.values - clean.values) / np.sqrt(np.diag(result.estimate.covariance))
    assert moved.max() < 2.0


def test_a_lens_in_the_water_is_not_mixed_with_one_behind_a_window(views, thesis):
    bare = replace(views[1], view=ViewMedium(False, 0))
    assert "taken without a window, others were not" in refusal(gathered(thesis, [bare, views[1]]))


def test_a_lens_that_looks_straight_into_water_is_calibrated_for_it(thesis):
    noise = Noise(circles_px=0.03, stripe_px=0.1, rng=np.random.default_rng(1))
    series = target_series(BUILT, window=False, positions=np.arange(8) * 35.0 - 200.0, noise=noise, columns=11)
    result = solve_jointly(gathered(thesis, [replace(series, view=ViewMedium(False, 0))]), options=OPTIONS)
    assert result.calibration.window is None
    assert result.calibration.medium_kind == "custom"
    focal = result.estimate.values[0] - BUILT.camera.focal_length_px()
    assert abs(focal) < 4.5 * result.estimate.std()[LensParameter.F]


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("window_slope_x", np.tan(np.radians(3.0)), "window tilt to the right found 3.00, described as 0.00 +- 0.5 °"),
        ("sheet_bow", np.radians(-4.0), "bow of the sheet found -4.00, described as 0.00 +- 0.5 °"),
    ],
)
def test_angles_are_reported_in_degrees(name, value, words):
    std = np.tan(np.radians(0.5)) if "slope" in name else np.radians(0.5)
    assert format_deviation(parse_parameter(name), value, 0.0, std, sigmas=6.0).startswith(words)
