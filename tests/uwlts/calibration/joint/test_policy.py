"""Changes of a calibration because of its residuals: lens coefficients, pixels, weights, and rejected images."""

from dataclasses import replace

import numpy as np
import pytest

from tests.uwlts.calibration_views import built_sensor
from tests.uwlts.joint_views import Noise, edited, gathered, target_series
from tests.virtual_sensors import altered
from uwlts.calibration.calibrate import solve_jointly
from uwlts.calibration.camera.camera_parameters import CameraOptions
from uwlts.calibration.camera.lens import LensChoice
from uwlts.calibration.joint import estimate
from uwlts.calibration.joint.policy import solve_and_check
from uwlts.calibration.joint.problem import joint_problem
from uwlts.calibration.sequential.sequential_calibration import CalibrationOptions
from uwlts.errors import CalibrationError
from uwlts.model.parameter_keys import LensParameter, ParameterKey, WindowParameter

BUILT = built_sensor()
OPTIONS = CalibrationOptions(poses="stage", correct_circles=False, lens=LensChoice())
FOCAL_PX = BUILT.camera.focal_length_px()


def few_views(sensor, *, stripe_px):
    """Four images of 49 points in air, and of each stripe every fourth point."""
    noise = Noise(circles_px=0.03, stripe_px=stripe_px, stage_mm=0.003, rng=np.random.default_rng(8))
    positions = np.linspace(-200.0, 60.0, 4)
    series = target_series(sensor, window=False, positions=positions, noise=noise, columns=7)
    return edited(series, every=4)


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
    wide = edited(few_views(BUILT, stripe_px=1.8), lambda _, image: stretched(image, 1.003))
    result = solve_jointly(gathered(thesis, [wide]), options=OPTIONS)
    assert any("images show systematic deviations from the model" in said for said in result.warnings)
    assert any("both are estimated" in said for said in result.warnings)
    camera, std = result.calibration.camera, result.estimate.std()
    assert abs(camera.fx_px - FOCAL_PX) < 4.5 * std[LensParameter.FX]
    assert abs(camera.fy_px - FOCAL_PX) < 4.5 * std[LensParameter.FY]


def stretched(image, columns):
    return replace(image, points_mm=image.points_mm * [columns, 1.0, 1.0])


def target_in_air_and_water(sensor, *, columns_wider=1.0):
    """Four images each of a target whose described column spacing is too large by a factor."""
    noise = Noise(circles_px=0.03, stripe_px=0.1, stage_mm=0.003, rng=np.random.default_rng(8))
    air = target_series(sensor, window=False, positions=np.linspace(-200.0, 60.0, 4), noise=noise, columns=9)
    water = target_series(sensor, medium=0, positions=np.linspace(-120.0, 60.0, 4), noise=noise, columns=9)
    return [edited(each, lambda _, image: stretched(image, columns_wider), every=4) for each in (air, water)]


@pytest.mark.slow
def test_pixels_of_another_shape_look_like_a_stretched_target(thesis):
    """If the stage cannot separate them, both are estimated: the focal lengths are within the stated uncertainties."""
    aspect = 1.003
    built = altered(BUILT, {"camera": {"pixel_aspect": aspect}})
    known = altered(thesis, {"uncertainty": {"stage_alignment_deg": 0.4}})
    result = solve_jointly(gathered(known, target_in_air_and_water(built)), options=OPTIONS)
    assert any("or the pixels' shape is not as described: both are estimated" in said for said in result.warnings)
    camera, std = result.calibration.camera, result.estimate.std()
    assert abs(camera.fx_px - FOCAL_PX) < 4.5 * std[LensParameter.FX]
    assert abs(camera.fy_px - aspect * FOCAL_PX) < 4.5 * std[LensParameter.FY]


@pytest.mark.slow
def test_with_pixels_said_to_be_square_a_wrong_spacing_is_to_be_stated(thesis):
    """0.3 %, thirty times the default: refused or not believed, as no prior knowledge is worth so little."""
    evidence, square = target_in_air_and_water(BUILT, columns_wider=1.003), LensChoice(pixels="square")
    try:
        said = solve_jointly(gathered(thesis, evidence), options=replace(OPTIONS, lens=square)).warnings
    except CalibrationError as refusal:
        said = [str(refusal)]
    assert any("stretch of the target along its rows" in each and "times what is stated" in each for each in said)
    stated = altered(thesis, {"uncertainty": {"target_stretch": [3e-3, 1e-4]}})
    result = solve_jointly(gathered(stated, evidence), options=replace(OPTIONS, lens=square))
    assert result.calibration.camera.fx_px == result.calibration.camera.fy_px


def drawn_lens_and_window(seed, described_mm=62.8, std_mm=60.0):
    """A lens with k1 up to 0.15, a window known to 60 mm, and images of the target in water."""
    rng = np.random.default_rng(seed)
    k1, distance = rng.uniform(-0.15, 0.15), np.clip(described_mm + rng.normal(0, std_mm), 15.0, 200.0)
    tilt_x, tilt_y = rng.normal(0, 0.2, 2)
    window = {"distance_mm": float(distance), "tilt_x_deg": tilt_x, "tilt_y_deg": tilt_y}
    real = altered(BUILT, {"camera": {"distortion": {"k1": k1}, "window": window}})
    noise = Noise(circles_px=0.3, stripe_px=0.4, stage_mm=0.003, rng=rng)
    series = target_series(real, medium=0, positions=np.linspace(-120, 60, 6), noise=noise, columns=7)
    return real, edited(series, every=4)


def pulls(thesis, seed):
    """Return errors of f, k1 and window distance, relative to their stated uncertainties."""
    real, series = drawn_lens_and_window(seed)
    known = {"uncertainty": {"window_distance_mm": 60.0}, "camera": {"window": {"distance_mm": 62.8}}}
    result = solve_jointly(gathered(altered(thesis, known), [series]), options=OPTIONS)
    camera = real.camera
    truth: dict[ParameterKey, float] = {
        LensParameter.F: camera.focal_length_px(),
        LensParameter.K1: camera.distortion.k1,
    }
    truth[WindowParameter.DISTANCE] = camera.window.distance_mm
    found, std = dict(zip(result.estimate.parameters.keys, result.estimate.values, strict=True)), result.estimate.std()
    return np.array([(found[key] - value) / std[key] for key, value in truth.items()])


@pytest.mark.parametrize("seed", [6, 8, 16])
def test_no_window_distance_takes_the_place_of_a_coefficient(thesis, seed):
    """Images of these are predicted as well without k1; left out, the window is 4 to 13 standard uncertainties off."""
    assert np.abs(pulls(thesis, seed)).max() < 4.0


@pytest.mark.slow
def test_uncertainties_from_water_alone_contain_the_errors(thesis):
    """Ten lenses and windows, on other seeds: 30 correlated errors; a mean square of one is exceeded by 2 by chance."""
    square = np.mean([pulls(thesis, seed) ** 2 for seed in range(20, 30)])
    assert 0.4 < square < 2.0


@pytest.fixture(scope="module")
def in_air():
    noise = Noise(circles_px=0.03, stripe_px=0.1, stage_mm=0.003, rng=np.random.default_rng(3))
    return target_series(BUILT, window=False, positions=np.linspace(-200, 60, 9), noise=noise, columns=7)


def test_larger_uncertainties_are_nowhere_smaller(thesis, in_air):
    """Pixels moved as by no lens, which also bends the board, what is not believed: neither is forgotten."""

    def twisted(_, image):
        x, y = ((image.pixels - [640.0, 512.0]) / 640.0).T
        return replace(image, pixels=image.pixels + np.column_stack([5.0 * x**3, 2.0 * y**3]))

    names = ("k1", "k2", "p1", "p2")
    options = replace(OPTIONS, camera=CameraOptions(names), lens=LensChoice(names))
    evidence = gathered(thesis, [edited(in_air, twisted)])
    before = solve_and_check(joint_problem(evidence, options=options))[0].std()
    result = solve_jointly(evidence, options=options)
    after = result.estimate.std()
    assert any("all points of an image count as one" in words for words in result.warnings)
    assert after.keys() == before.keys()
    assert all(std >= (1 - 1e-9) * before[key] for key, std in after.items())


@pytest.mark.parametrize(("pitch", "noticed"), [(1.0, False), (1.01, True), (0.99, True)])
def test_a_wrong_pitch_in_water_contradicts_a_known_focal_length(thesis, pitch, noticed):
    """1 % are ten standard uncertainties of a focal length that is known to 0.1 %."""
    noise = Noise(circles_px=0.05, stripe_px=0.15, stage_mm=0.003, rng=np.random.default_rng(70))
    series = target_series(BUILT, medium=0, positions=np.linspace(-120, 60, 6), noise=noise, columns=7)
    series = edited(series, lambda _, image: replace(image, points_mm=pitch * image.points_mm))
    known = {
        "camera": {"focal_length_mm": 1.0005 * BUILT.camera.focal_length_mm},
        "uncertainty": {"focal_length": 1e-3},
    }
    evidence = gathered(altered(thesis, known), [series])
    result, against = solve_and_check(joint_problem(evidence, options=OPTIONS))
    assert any("focal length found" in words for words in against.contradictions) == noticed
    assert result.std()[LensParameter.F] < 1.1e-3 * FOCAL_PX
    assert noticed or not against.all_against()


def turned(image):
    return replace(image, points_mm=image.points_mm * [-1, -1, 1])


def misread(image):
    further = np.where(image.points_mm[:, :1] > 0, [9.375, 0, 0], 0.0)
    return replace(image, points_mm=image.points_mm + further)


def elsewhere(image):
    return replace(image, stage_mm=image.stage_mm + 20.0)


def with_fifth(series, edit):
    """Return the series with the fifth image edited."""
    series = edited(series, lambda number, image: edit(image) if number == 4 else image)
    return replace(series, found=replace(series.found, captures=["air.h5"]))


@pytest.mark.parametrize("edit", [turned, misread, elsewhere])
def test_an_image_that_prevents_any_solution_is_left_out_by_name(thesis, in_air, edit):
    result = solve_jointly(gathered(thesis, [with_fifth(in_air, edit)]), options=OPTIONS)
    assert [said.split(":")[0] for said in result.warnings if said.endswith("left out")] == ["air.h5, frame 4"]
    # 4.5 standard uncertainties: exceeded by chance once in 150,000
    assert abs(result.calibration.camera.fx_px - FOCAL_PX) < 4.5 * result.estimate.std()[LensParameter.F]


def test_a_refusal_names_the_image_and_lists_all(thesis, in_air):
    with pytest.raises(CalibrationError, match="air.h5, frame 4: the target is ") as refused:
        solve_jointly(gathered(thesis, [with_fifth(in_air, turned)]), options=replace(OPTIONS, strict=True))
    table = str(refused.value).splitlines()[1:]
    assert table[0].split()[:4] == ["image", "stage,", "mm", "points"]
    assert {row[:15] for row in table[1:]} == {f"air.h5, frame {number}" for number in range(9)}


def test_what_does_not_fit_is_named_if_nothing_converges(thesis, in_air, monkeypatch):
    monkeypatch.setattr(estimate, "_ROUNDS", 1)  # the result of the first round is never taken
    off = with_fifth(in_air, lambda image: replace(image, pixels=image.pixels + [5.0, 0.0]))
    with pytest.raises(CalibrationError, match=r"did not converge.* air.h5, frame 4, where the target"):
        solve_jointly(gathered(thesis, [off]), options=replace(OPTIONS, strict=True))
