"""A camera that was calibrated before is held: sheet and window are estimated with it, and it contradicts images."""

from dataclasses import replace

import numpy as np
import pytest

from tests.uwlts.calibration_views import built_sensor
from tests.uwlts.joint_views import Noise, edited, gathered, target_series
from tests.virtual_sensors import altered
from uwlts.calibration.calibrate import solve_jointly
from uwlts.calibration.camera.lens import LensChoice
from uwlts.calibration.joint.gathering import HELD
from uwlts.calibration.sequential.sequential_calibration import CalibrationOptions
from uwlts.errors import CalibrationError, DescriptionError
from uwlts.model.parameter_keys import LensParameter, WindowParameter

BUILT = built_sensor()
TILTS = np.array([(0.0, 0.0), (0.3, 0.1), (-0.3, 0.05), (0.05, 0.3), (-0.1, -0.3), (0.2, -0.2)])


def drawn(seed, kind):
    """A camera with drawn lens, centre and pixels, its description with another window, and images of the target."""
    rng = np.random.default_rng(seed)
    lens = {"k1": rng.uniform(-0.25, 0.15), "k2": rng.uniform(-0.1, 0.1), "p1": rng.normal(0, 1e-3)}
    lens |= {"k4": rng.uniform(-0.1, 0.1)} if seed % 2 else {}
    camera = {
        "distortion": lens,
        "principal_point_px": (639.5 + rng.normal(0, 15), 511.5 + rng.normal(0, 15)),
        "pixel_aspect": float(rng.uniform(0.97, 1.03)),
        "focal_length_mm": float(rng.uniform(10.5, 14.0)),
    }
    distance = BUILT.camera.window.distance_mm + rng.normal(0, 5.0)
    real = altered(BUILT, {"camera": camera | {"window": {"distance_mm": float(distance)}}})
    described = altered(BUILT, {"camera": camera, "uncertainty": {"focal_length": 0.0}})
    noise = Noise(circles_px=0.1, stripe_px=0.2, stage_mm=0.003, rng=rng)
    wet = {"medium": 0, "window": True} if kind == "water" else {"window": False}
    tilts = TILTS if kind == "by hand" else None
    positions = np.linspace(-120, 60, len(TILTS))
    series = target_series(real, positions=positions, noise=noise, columns=7, tilts=tilts, **wet)
    poses = "free" if kind == "by hand" else "stage"
    options = CalibrationOptions(poses=poses, correct_circles=False, lens=LensChoice())
    return real, described, edited(series, every=4), options


@pytest.mark.parametrize(("kind", "draws"), [("water", 6), ("air", 2), ("by hand", 2)])
def test_a_held_camera_stays_and_the_rest_is_found(kind, draws):
    pulls = []
    for seed in range(draws):
        real, described, series, options = drawn(seed, kind)
        result = solve_jointly(gathered(described, [series]), options=options)
        camera, std = result.calibration.camera, result.estimate.std()
        truth = real.camera.distortion.model_dump()
        # No image moves a camera by more than its uncertainty.
        assert camera.fx_px == pytest.approx(real.camera.focal_length_px(), rel=2 * HELD)
        assert camera.fy_px / camera.fx_px == pytest.approx(real.camera.pixel_aspect, rel=1e-9)
        assert camera.distortion.model_dump() == pytest.approx(truth, abs=2 * HELD)
        assert std[LensParameter.F] <= 1.01 * HELD * camera.fx_px
        if kind == "water":
            found = dict(zip(result.estimate.parameters.keys, result.estimate.values, strict=True))
            key = WindowParameter.DISTANCE
            pulls.append((found[key] - real.camera.window.distance_mm) / std[key])
    # Six independent errors: the mean square exceeds 3 with a probability of 0.5 %.
    assert not pulls or np.mean(np.square(pulls)) < 3.0


@pytest.mark.parametrize("seed", range(2))
def test_another_camera_than_the_held_one_is_noticed(seed):
    """Off by 2 % in focal length, or by 40 px in its centre, as if it was focused or cropped afterwards."""
    _, described, series, options = drawn(seed, "by hand")
    x, y = described.camera.principal_point()
    for wrong, named in (
        ({"focal_length_mm": 1.02 * described.camera.focal_length_mm}, "focal length found"),
        ({"principal_point_px": (x + 40.0, y)}, "principal point found"),
    ):
        with pytest.raises(CalibrationError, match=named):
            solve_jointly(gathered(altered(described, {"camera": wrong}), [series]), options=options)


def test_a_held_camera_has_no_parameters_to_choose():
    _, described, series, options = drawn(0, "water")
    seen = gathered(described, [series])
    with pytest.raises(DescriptionError, match="leave out `distortion`"):
        solve_jointly(seen, options=replace(options, lens=LensChoice(("k1",))))
    bare = altered(described, {"camera": {"window": {"mounted": False}}})
    with pytest.raises(CalibrationError, match="only behind a window"):
        solve_jointly(replace(seen, sensor=bare), options=options)
