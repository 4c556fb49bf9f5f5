"""A sensor that travels while it exposes: blur, rolling shutter, and what the truth says of them."""

from dataclasses import replace

import numpy as np
import pytest

from tests.virtual_sensors import altered, clear, cropped, plate, scene_of, sensor_at
from twin.light.pose import Travel
from twin.light.renderer import Renderer
from twin.options import NONE, Options
from twin.recording.studio import Studio, true_stripe
from uwlts.model.errors import DesignError

ALONG_X = np.array([1.0, 0.0, 0.0])
TILTED = plate(side=200.0) | {"rotation_deg": (0.0, 30.0, 0.0)}


def moments(image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Means and variances (W,) of the columns, px and px2."""
    row, total = np.arange(len(image))[:, None], image.sum(axis=0)
    mean = (row * image).sum(axis=0) / total
    return mean, ((row - mean) ** 2 * image).sum(axis=0) / total


@pytest.fixture(scope="module")
def renderer(thesis) -> Renderer:
    return Renderer(cropped(thesis, 48, 256), clear(), scene_of(TILTED), effects=replace(NONE, motion=True))


def travel(exposure_mm: float = 0.0, row_mm: float = 0.0) -> Travel:
    return Travel(direction=ALONG_X, exposure_mm=exposure_mm, row_mm=row_mm, middle_row=0.0)


@pytest.mark.parametrize("exposure_mm", [3.0, 12.0])
def test_travel_during_the_exposure_blurs_the_stripe_evenly(renderer, exposure_mm):
    centres = [true_stripe(renderer, sensor_at(x=x)).centre_px for x in (-1.0, 1.0)]
    px_per_mm = (centres[1] - centres[0]) / 2
    assert (np.abs(px_per_mm) > 1).all()
    still = renderer.irradiance("laser", sensor_at(), spp=512).astype(float)
    blurred = renderer.irradiance("laser", sensor_at(), spp=512, travel=travel(exposure_mm)).astype(float)
    (at_rest, narrow), (moving, wide) = moments(still), moments(blurred)
    # An even motion over L px has the variance L^2 / 12; the plate runs away from the camera by 0.3 % per mm.
    np.testing.assert_allclose(wide - narrow, (exposure_mm * px_per_mm) ** 2 / 12, rtol=0.01 * exposure_mm)
    np.testing.assert_allclose(moving, at_rest, atol=0.005 * exposure_mm**2)
    assert blurred.sum() == pytest.approx(still.sum(), rel=0.01)


def test_a_rolling_shutter_shifts_each_row_by_its_delay(renderer):
    pose, delay = sensor_at(), 0.005
    centre = true_stripe(renderer, pose).centre_px
    rolled = true_stripe(renderer, pose, travel=travel(row_mm=delay))
    # Every line is exposed where its stripe then is: the still frame at the travel of that row shows the same.
    for line in (4, 24, 43):
        at = rolled.centre_px[line] * delay
        assert true_stripe(renderer, sensor_at(x=at)).centre_px[line] == pytest.approx(rolled.centre_px[line], abs=2e-3)
    assert np.abs(rolled.centre_px - centre).max() > 1
    image = renderer.irradiance("laser", pose, spp=256, travel=travel(row_mm=delay)).astype(float)
    np.testing.assert_allclose(moments(image)[0], rolled.centre_px, atol=0.05)


def test_too_fast_a_travel_is_refused_with_numbers(thesis):
    sensor = altered(thesis, {"exposure": {"laser_ms": 5.0}})
    fast = {"count": 5, "step_mm": 1.0, "speed_mm_per_s": 100.0}
    with pytest.raises(DesignError, match=r"at 100 mm/s .* after 10 ms, but the camera needs 16.7 ms"):
        Studio(sensor, scene_of(TILTED, motion=fast), Options(effects=NONE))
    studio = Studio(sensor, scene_of(TILTED, motion=fast | {"speed_mm_per_s": 50.0}), Options(effects=NONE))
    assert studio.period_s == pytest.approx(0.02)
    assert studio.travel("laser") is None, "the motion is left out"
    moving = Studio(sensor, studio.scene, Options(effects=replace(NONE, motion=True)))
    assert moving.travel("laser").exposure_mm == pytest.approx(0.25)
