"""Finite pupil: blur by depth agrees with geometric optics, and no light is lost or gained."""

import math
from dataclasses import replace

import numpy as np
import pytest

from tests.virtual_sensors import altered, camera_axes, clear, cropped, plate, scene_of, sensor_at
from twin.light.renderer import Renderer
from twin.recording.frame_truth import find_true_stripe
from twin.rendering_options import NONE
from uwlts.model.sensor import Medium, Sensor

SPP = 1024
BLURRED = replace(NONE, defocus=True)
BARE = {"camera": {"window": {"mounted": False}}, "laser": {"window": {"mounted": False}}}
AIR = Medium(kind="air")


def columns(sensor: Sensor, medium: Medium, z: float, effects=BLURRED) -> np.ndarray:
    """Column profiles (H, W) of the stripe on a plate at ``z``."""
    image = (
        Renderer(sensor, medium, scene_of(plate()), effects=effects).laser_frame(sensor_at(-z), spp=SPP).irradiance()
    )
    return image.astype(float)


def variance(image: np.ndarray) -> np.ndarray:
    """Second central moments (W,) of the columns, px2."""
    row = np.arange(len(image))[:, None]
    total = image.sum(axis=0)
    mean = (row * image).sum(axis=0) / total
    return ((row - mean) ** 2 * image).sum(axis=0) / total


def blur_diameter_px(sensor: Sensor, distance_mm: float) -> float:
    """Return the diameter of the blur disc of a thin lens for a point at a distance in air.

    By similar triangles behind the lens: D c |1 / z - 1 / F| with the image distance c and the focused distance F. The
    diameter D follows from the working f-number c / D = N (1 + m), with N = f / D and m = f / (F - f).
    """
    camera = sensor.camera
    magnification = camera.focal_length_mm / (camera.focus_distance_mm - camera.focal_length_mm)
    pupil = camera.focal_length_mm / (camera.f_number * (1 + magnification))
    image = camera.focal_length_mm / (1e-3 * camera.pixel_size_um)
    return pupil * image * abs(1 / distance_mm - 1 / camera.focus_distance_mm)


def depth(sensor: Sensor, z: float) -> float:
    """Depth in the camera frame of the stripe's middle on a plate at ``z``."""
    axes, standoff = camera_axes(sensor)
    return float((axes @ np.array([0.0, 0.0, z]) + standoff)[2])


@pytest.mark.parametrize(("z", "f_number"), [(-80.0, 4.0), (-40.0, 4.0), (60.0, 2.8), (150.0, 4.0), (-80.0, 8.0)])
def test_blur_against_depth_is_that_of_a_thin_lens(thesis, z, f_number):
    sensor = altered(cropped(thesis, 48, 1024), BARE | {"camera": BARE["camera"] | {"f_number": f_number}})
    sharp, blurred = columns(sensor, AIR, z, NONE), columns(sensor, AIR, z)
    added = (variance(blurred) - variance(sharp)).mean()
    # An even disc of diameter d, summed along its chords, has the variance d^2 / 16. The depth changes across the
    # stripe's 0.5 mm by 1e-3 of itself, the disc's size on a side 40 px off the middle by as much; 1024 samples
    # leave some 0.005 px2 of a stripe that has 1.5 px2 itself.
    disc = blur_diameter_px(sensor, depth(sensor, z))
    assert disc > 1.5
    assert added == pytest.approx(disc**2 / 16, rel=0.02, abs=0.01)


def test_the_focused_plane_is_sharp(thesis):
    sensor = altered(cropped(thesis, 48, 256), BARE)
    assert depth(sensor, 0.0) == pytest.approx(sensor.camera.focus_distance_mm, abs=0.1)
    sharp, blurred = variance(columns(sensor, AIR, 0.0, NONE)), variance(columns(sensor, AIR, 0.0))
    np.testing.assert_allclose(blurred, sharp, rtol=2e-2)


def test_in_water_the_sharp_depth_is_where_it_appears_at_the_focused_distance(thesis):
    # Paraxially a depth s in a medium of index n appears at s / n; the middle column looks along the axis.
    sensor, medium = cropped(thesis, 48, 1024), clear()
    window = sensor.camera.window
    index = medium.refractive_index(635.0)
    extra = []
    depths = np.linspace(-60.0, 120.0, 7)
    for z in depths:
        added = (variance(columns(sensor, medium, z)) - variance(columns(sensor, medium, z, NONE))).mean()
        in_water = depth(sensor, z) - window.distance_mm - window.thickness_mm
        appears = window.distance_mm + window.thickness_mm / window.index(635.0) + in_water / index
        extra.append((added, blur_diameter_px(sensor, appears) ** 2 / 16))
    found, expected = np.array(extra).T
    # Rays to the stripe leave the axis by up to 18 deg where the plate is nearest and farthest: there the apparent
    # depth differs from the paraxial one by about tan^2 / 2 (1 - 1 / n^2), 2 %, of the water's share.
    np.testing.assert_allclose(np.sqrt(found.clip(0)), np.sqrt(expected), rtol=0.08, atol=0.12)
    assert expected.max() > 4 > 50 * expected.min(), "sharp and blurred depths are among them"
    in_air = [blur_diameter_px(sensor, depth(sensor, z)) for z in depths]
    assert np.argmin(expected) > np.argmin(in_air), "water moves the sharp depth away"


@pytest.mark.parametrize("z", [-60.0, 80.0])
def test_defocus_keeps_the_light(thesis, z):
    sensor = cropped(thesis, 64, 1024)
    sharp, blurred = (columns(sensor, clear(0.3), z, effects).sum() for effects in (NONE, BLURRED))
    # Light that leaves the 64 columns on one side enters on the other; both have the cos^4 weight of the chief ray.
    assert blurred == pytest.approx(sharp, rel=2e-3)


def test_the_rendered_pixels_hold_the_whole_blur(thesis):
    renderer = Renderer(thesis, clear(), scene_of(plate()), effects=BLURRED)
    depths = np.array([260.0, 300.0, 378.0, 460.0])
    marked = renderer.view.blur_radius_px(depths)
    window = thesis.camera.window
    appears = window.distance_mm + window.thickness_mm / 1.52 + (depths - 68.73) / 1.3312
    paraxial = np.array([blur_diameter_px(thesis, s) / 2 for s in appears])
    # The largest blur in the image is that of its corners, 25 deg off the axis.
    assert (marked > 0.9 * paraxial).all()
    assert (marked < 1.6 * paraxial + 2).all()


def test_a_tilted_window_shifts_the_blurred_stripe_from_its_chief_rays(thesis):
    window = {"tilt_x_deg": 20.0, "thickness_mm": 12.0, "aperture_diameter_mm": 120.0}
    sensor = altered(cropped(thesis, 48, 512), {"camera": {"f_number": 1.4, "window": window}})
    medium, row = clear(), np.arange(512)[:, None]
    offsets = []
    for effects in (NONE, BLURRED):
        renderer = Renderer(sensor, medium, scene_of(plate()), effects=effects)
        image = renderer.laser_frame(sensor_at(), spp=SPP).irradiance().astype(float)
        truth = find_true_stripe(renderer, sensor_at())
        offsets.append(np.mean((row * image).sum(axis=0) / image.sum(axis=0) - truth.centre_px))
    assert abs(offsets[0]) < 3e-3
    assert 0.01 < abs(offsets[1] - offsets[0]) < 1.0, "the window's coma is in the picture"
    assert math.isfinite(offsets[1])
