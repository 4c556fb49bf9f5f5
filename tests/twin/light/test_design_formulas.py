"""Design formulas compared with the rendered sensor: position and motion of the stripe on a plate.

The twin refracts rays at the faces of both windows; the formulas refract camera rays at the camera's window.
"""

from dataclasses import replace

import numpy as np
import pytest

from tests.virtual_sensors import altered, plate, scene_of, sensor_at
from twin.light.renderer import Renderer
from twin.recording.frame_truth import find_true_stripe
from uwlts.model.placement import camera_from_object
from uwlts.optics.design import SheetGeometry
from uwlts.storage.truth import TruthStatus

PIXEL = 1e-3
"""Tolerance in px of a line: a coordinate of 1000 px is rounded to 6e-5 px, and 1e-4 mm of a 32-bit ray are 5e-4 px."""
MEAN_PIXEL = 2.5e-4
"""Tolerance in px of the mean over all lines: half of the systematic error that the lines have in common."""


@pytest.mark.parametrize("along", ["width", "height"])
@pytest.mark.parametrize("medium_name", ["air", "water"])
def test_the_stripe_on_a_plate_is_where_the_formulas_say(thesis, medium_name, along):
    sensor = altered(thesis, {"camera": {"stripe_along": along}})
    medium, camera = sensor.media[medium_name], sensor.camera
    geometry, transform = SheetGeometry.from_description(sensor, medium), camera_from_object(sensor)
    renderer = Renderer(sensor, medium, scene_of(plate()))

    def stripe(z: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the centre and Y of the stripe on every profile line, on a plate at Z in the object's frame."""
        truth = find_true_stripe(renderer, sensor_at(-z))
        assert (truth.status == TruthStatus.VISIBLE).all()
        return truth.centre_px, truth.point_mm[:, 1]

    def expected(view: SheetGeometry, z: float, y: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the pixels across and along the stripe of points (0, y, z), and mm in Z per px across."""
        points = np.stack([0 * y, y, z + 0 * y], axis=1) @ transform[:3, :3].T + transform[:3, 3]
        image = view.project(np, tuple(points.T))
        pixels = image.x, image.y
        return view.across(pixels), view.along(pixels), view.mm_per_pixel(image)[1]

    for z in (-50.0, 50.0):
        centre, y = stripe(z)
        across, on_line, per_pixel = expected(geometry, z, y)
        assert np.abs(across - centre).max() < PIXEL
        assert abs((across - centre).mean()) < MEAN_PIXEL
        assert np.abs(on_line - np.arange(camera.lines())).max() < PIXEL
        # A sheet 1 um farther away would be noticed, and in water a window 0.05 mm farther away.
        nearer = expected(geometry, z + 1e-3, y)[0]
        assert abs((nearer - centre).mean()) > 10 * MEAN_PIXEL
        if medium_name == "water":
            window = replace(geometry.window, distance_mm=geometry.window.distance_mm + 0.05)
            assert np.abs(expected(replace(geometry, window=window), z, y)[0] - centre).max() > 3 * PIXEL

        # Two plates at a distance of 2 mm. The quotient differs from the slope by h^2 / Z^2 (relative), with h = 1 mm
        # and Z at least 337 mm: 1e-5. Errors of two centres at least 5.8 px from each other give 4e-4, those of their
        # means 1e-4.
        ahead, behind = stripe(z + 1.0)[0], stripe(z - 1.0)[0]
        assert np.abs(ahead - behind).min() > 5.8
        excess = 2 / (ahead - behind) / per_pixel - 1
        assert np.abs(excess).max() < 4e-4
        assert abs(excess.mean()) < 1e-4
