"""Calibrations from noisy images in water alone: stated uncertainties contain what the images do not determine."""

from dataclasses import replace

import numpy as np
import pytest

from tests.uwlts.calibration_views import built_sensor
from tests.uwlts.joint_views import Noise, gathered, target_series
from tests.virtual_sensors import altered
from uwlts.calibration.calibrate import solve_jointly
from uwlts.calibration.camera.camera_parameters import CameraOptions
from uwlts.calibration.camera.lens import LensChoice
from uwlts.calibration.joint.policy import solve_and_check
from uwlts.calibration.joint.problem import joint_problem
from uwlts.calibration.sequential.sequential_calibration import CalibrationOptions
from uwlts.model.parameter_keys import LensParameter, ParameterKey, WindowParameter

BUILT = built_sensor()
OPTIONS = CalibrationOptions(poses="stage", correct_circles=False, lens=LensChoice())


def drawn_lens_and_window(seed, described_mm=62.8, std_mm=60.0):
    """A lens with k1 up to 0.15, a window known to 60 mm, and images of the target in water."""
    rng = np.random.default_rng(seed)
    k1, distance = rng.uniform(-0.15, 0.15), np.clip(described_mm + rng.normal(0, std_mm), 15.0, 200.0)
    tilt_x, tilt_y = rng.normal(0, 0.2, 2)
    window = {"distance_mm": float(distance), "tilt_x_deg": tilt_x, "tilt_y_deg": tilt_y}
    real = altered(BUILT, {"camera": {"distortion": {"k1": k1}, "window": window}})
    noise = Noise(circles_px=0.3, stripe_px=0.4, stage_mm=0.003, rng=rng)
    series = target_series(real, medium=0, positions=np.linspace(-120, 60, 6), noise=noise, columns=7)
    stripes = [pixels[::4] for pixels in series.found.stripes]
    return real, replace(series, found=replace(series.found, stripes=stripes))


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
    """20 lenses and windows, on other seeds: 60 correlated errors; a mean square of one is exceeded by 2 by chance."""
    square = np.mean([pulls(thesis, seed) ** 2 for seed in range(20, 40)])
    assert 0.4 < square < 2.0


@pytest.fixture(scope="module")
def in_air():
    noise = Noise(circles_px=0.03, stripe_px=0.1, stage_mm=0.003, rng=np.random.default_rng(3))
    return target_series(BUILT, window=False, positions=np.linspace(-200, 60, 9), noise=noise, columns=7)


def test_larger_uncertainties_are_nowhere_smaller(thesis, in_air):
    """Pixels moved as by no lens, which also bends the board, what is not believed: neither is forgotten."""

    def twisted(image):
        x, y = ((image.pixels - [640.0, 512.0]) / 640.0).T
        return replace(image, pixels=image.pixels + np.column_stack([5.0 * x**3, 2.0 * y**3]))

    series = replace(in_air, found=replace(in_air.found, images=[twisted(image) for image in in_air.found.images]))
    names = ("k1", "k2", "p1", "p2")
    options = replace(OPTIONS, camera=CameraOptions(names), lens=LensChoice(names))
    evidence = gathered(thesis, [series])
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
    images = [replace(image, points_mm=pitch * image.points_mm) for image in series.found.images]
    known = {
        "camera": {"focal_length_mm": 1.0005 * BUILT.camera.focal_length_mm},
        "uncertainty": {"focal_length": 1e-3},
    }
    evidence = gathered(altered(thesis, known), [replace(series, found=replace(series.found, images=images))])
    result, against = solve_and_check(joint_problem(evidence, options=OPTIONS))
    assert any("focal length found" in words for words in against.contradictions) == noticed
    assert result.std()[LensParameter.F] < 1.1e-3 * BUILT.camera.focal_length_px()
    assert noticed or not against.all_against()
