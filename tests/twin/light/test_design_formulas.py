"""Design formulas compared with the rendered sensor: position, motion and length of the stripe on a plate.

The twin refracts rays at the faces of both windows; the closed formulas include the camera's window only.
"""

import math
from dataclasses import replace

import numpy as np
import pytest

from tests.virtual_sensors import altered, plate, scene_of, sensor_at
from twin.light.renderer import Renderer
from twin.recording.frame_truth import find_true_stripe
from uwlts.optics.design import (
    depth_mm,
    depth_per_pixel_mm,
    line_length_mm,
    nominal_setup,
    pixel_of_depth,
    position_along_mm,
)
from uwlts.storage.truth import TruthStatus

PIXEL = 1e-3
"""Tolerance in px of a line: a coordinate of 1000 px is rounded to 6e-5 px, and 1e-4 mm of a 32-bit ray are 5e-4 px."""
MEAN_PIXEL = 2.5e-4
"""Tolerance in px of the mean over all lines: half of the systematic error that the lines have in common."""
COSINE = math.cos(math.radians(35))
STANDOFF = 265 / math.tan(math.radians(35))


@pytest.mark.parametrize("along", ["width", "height"])
@pytest.mark.parametrize("medium_name", ["air", "water"])
def test_the_stripe_on_a_plate_is_where_the_formulas_say(thesis, medium_name, along):
    sensor = altered(thesis, {"camera": {"stripe_along": along}})
    medium, camera = sensor.media[medium_name], sensor.camera
    setup, leaning = nominal_setup(sensor, medium)
    assert leaning == pytest.approx(1 / COSINE)
    renderer = Renderer(sensor, medium, scene_of(plate()))
    # The laser stands towards smaller rows, or towards larger columns.
    centre, middle, away = (639.5, 511.5, 1) if along == "width" else (511.5, 639.5, -1)
    v = np.arange(camera.lines()) - centre

    def stripe(z: float) -> tuple[np.ndarray, np.ndarray]:
        """Return u and the position Y along the stripe of every line, on a plate at Z in the object's frame."""
        truth = find_true_stripe(renderer, sensor_at(-z))
        assert (truth.status == TruthStatus.VISIBLE).all()
        return away * (truth.centre_px - middle), truth.point_mm[:, 1]

    for z in (-50.0, 50.0):
        u, y = stripe(z)
        depth, per_pixel = STANDOFF + z * COSINE, depth_per_pixel_mm(setup, u, v)

        def miss_px(changed, u=u, depth=depth, per_pixel=per_pixel):
            return (depth_mm(changed, u, v) - depth) / per_pixel

        assert np.abs(miss_px(setup)).max() < PIXEL
        assert abs(miss_px(setup).mean()) < MEAN_PIXEL
        assert np.abs(pixel_of_depth(setup, depth, v) - u).max() < PIXEL
        # A baseline 1 um longer would be noticed, and in water a window 0.05 mm farther away.
        assert abs(miss_px(replace(setup, baseline_mm=265.001)).mean()) > 10 * MEAN_PIXEL
        if medium_name == "water":
            moved = replace(setup, window=replace(setup.window, distance_mm=62.85))
            assert np.abs(miss_px(moved)).max() > 3 * PIXEL

        # A stripe's end is a point on a line: it is known to a pixel's error along the line and one across it.
        end_mm = 2 * PIXEL * line_length_mm(setup, depth, side_px=1.0)
        assert np.abs(np.abs(position_along_mm(setup, u, v)) - np.abs(y)).max() < end_mm
        # The distance between the centres of the outermost lines is one line less than the side.
        assert abs(np.ptp(y) - line_length_mm(setup, depth, side_px=camera.lines() - 1)) < 2 * end_mm

        # Two plates at a distance of 2 mm. The quotient differs from the slope by h^2 / Z^2 (relative), with h = 1 mm
        # and Z at least 337 mm: 1e-5. Errors of two centres at least 5.8 px from each other give 4e-4, those of their
        # means 1e-4.
        ahead, behind = stripe(z + 1.0)[0], stripe(z - 1.0)[0]
        assert np.abs(ahead - behind).min() > 5.8
        excess = 2 * COSINE / (ahead - behind) / per_pixel - 1
        assert np.abs(excess).max() < 4e-4
        assert abs(excess.mean()) < 1e-4
