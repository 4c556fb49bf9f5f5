"""The rendered stripe on translucent bodies: its light, width and place against the diffusion kernel."""

import math
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from tests.virtual_sensors import altered, clear, plate, scene_of, sensor_at
from twin.light.renderer import Renderer
from twin.recording.frame_truth import find_true_stripe
from twin.rendering_options import NONE
from twin.scene.scene_object import Pose
from twin.scene.surfaces import lateral_spread
from uwlts.model.sensor import Sensor

PATH = 0.4
COLUMN = 60


def render_column(sensor: Sensor, thing: dict[str, Any]) -> tuple[np.ndarray, Renderer]:
    renderer = Renderer(sensor, clear(), scene_of(thing), effects=NONE)
    return renderer.laser_frame(sensor_at(), spp=64).irradiance()[:, COLUMN].astype(float), renderer


def positions_across(sensor: Sensor, renderer: Renderer, rotation: tuple[float, float, float]) -> np.ndarray:
    """Positions (H,) in mm on a plate through the origin, across the sheet, of a column's pixels; 0 is in the sheet."""
    rows = np.arange(sensor.camera.height_px, dtype=np.float32)
    bundle = renderer.view.trace_bundle(mi.Float(np.full_like(rows, COLUMN)), mi.Float(rows))
    dr.eval(bundle.origin, bundle.direction)
    origin, along = (np.stack([c.numpy() for c in v], axis=1).astype(float) for v in (bundle.origin, bundle.direction))
    turned = Pose(rotation_deg=rotation).matrix()[:3, :3]
    points = origin - along * (origin @ turned[:, 2] / (along @ turned[:, 2]))[:, None]
    # The plate turns about y, so its x axis is across the stripe.
    return points @ turned[:, 0]


@pytest.mark.parametrize("finish", ["diffuse", "pvc"])
@pytest.mark.parametrize("angle", [0.0, 40.0, -30.0])
def test_the_stripe_is_widened_and_shifted_ahead_as_the_diffusion_kernel(thesis, angle, finish):
    sensor = altered(thesis, {"camera": {"width_px": 120, "height_px": 160}})
    rotation = (0.0, angle, 0.0)
    opaque = plate(reflectance=0.6) | {"rotation_deg": rotation, "finish": finish, "alpha": None}
    sharp, renderer = render_column(sensor, opaque)
    soft, _ = render_column(sensor, opaque | {"mean_free_path_mm": PATH})
    x = positions_across(sensor, renderer, rotation)
    # Per pixel, light and position: the density over the surface is per mm of x.
    step = np.abs(np.gradient(x))
    light = [(image * step).sum() for image in (sharp, soft)]
    # Gaussians that are cut off at 4.5 of their standard deviations, or at half of that for the widest.
    assert light[1] / light[0] == pytest.approx(1, abs=0.01)
    index = 1.0 if finish == "diffuse" else 1.54 / 1.3312
    spread = lateral_spread(mean_free_path_mm=PATH, reflectance=0.6, index=index)
    inside = math.sin(math.radians(angle)) / index
    ahead = PATH * inside / (1 + spread.decay * math.sqrt(1 - inside**2))
    # The plate's x axis points away from the sensor for a negative angle.
    means = [np.average(x, weights=image * step) for image in (sharp, soft)]
    assert means[1] - means[0] == pytest.approx(-ahead, rel=0.02, abs=5e-4)
    widths = [
        np.average((x - mean) ** 2, weights=image * step) for image, mean in zip((sharp, soft), means, strict=True)
    ]
    assert widths[1] - widths[0] == pytest.approx(spread.weights @ spread.variances_mm2, rel=0.05)
    assert widths[1] > 10 * widths[0]


def test_truth_and_light_of_opaque_objects_are_unchanged_beside_translucent_ones(thesis):
    sensor = altered(thesis, {"camera": {"width_px": 200, "height_px": 120}})
    opaque = plate(side=40.0, y=-20.0, reflectance=0.6)
    beside = plate(side=40.0, y=20.0, reflectance=0.6)
    images, truths = [], []
    for path in (0.0, PATH):
        renderer = Renderer(sensor, clear(), scene_of(opaque, beside | {"mean_free_path_mm": path}), effects=NONE)
        images.append(renderer.laser_frame(sensor_at(), spp=16).irradiance())
        truths.append(find_true_stripe(renderer, sensor_at()))
    columns = np.flatnonzero(np.isfinite(truths[0].centre_px))
    left = columns[truths[0].point_mm[columns, 1] < -0.5]
    assert len(left) > 50
    np.testing.assert_allclose(images[1][:, left], images[0][:, left], rtol=1e-5, atol=1e-6 * images[0].max())
    # The geometric centre is that of the sheet on either body.
    np.testing.assert_allclose(truths[1].centre_px[columns], truths[0].centre_px[columns], atol=1e-4)
    assert np.abs(images[1] - images[0]).max() > 0.1 * images[0].max()
