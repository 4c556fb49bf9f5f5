"""Absolute irradiance of the twin: windows, sheet, water, camera and lamp against closed forms."""

import math
from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from tests.oracles.optics import fresnel_transmittance
from tests.virtual_sensors import (
    altered,
    clear,
    cropped,
    extinction,
    gauss_legendre,
    image_of,
    laser_origin,
    lens_factor,
    oracle_fan,
    oracle_paths,
    plate,
    scene_of,
    sensor_at,
    window_transmittance,
)
from twin.backend.arrays import to_jit
from twin.light.camera import WindowFaces
from twin.light.renderer import Renderer
from twin.light.sheet import Sheet
from twin.rendering_options import NONE
from uwlts.model.sensor import Medium, Sensor, Window

ROUNDING = 2e-6
"""Some twenty operations in 32 bits, each wrong by up to 6e-8 of its value."""


# --- windows ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("mode", ["camera", "laser"])
@pytest.mark.parametrize(
    ("glass", "absorption_per_m", "index"), [(1.52, None, 1.3312), (1.9, 40.0, 1.34), ("soda-lime", None, 1.0)]
)
def test_a_window_passes_what_the_fields_continuity_allows(mode, glass, absorption_per_m, index):
    window = Window(
        distance_mm=20.0, thickness_mm=6.0, glass=glass, aperture_diameter_mm=200.0, absorption_per_m=absorption_per_m
    )
    faces = WindowFaces(
        window,
        Medium(kind="custom", index=index) if index > 1 else Medium(kind="air"),
        wavelength_nm=635.0,
        origin_mm=np.zeros(3),
        rotation=np.eye(3),
    )
    angle = np.radians(np.linspace(0, 75, 151))
    direction = mi.Vector3f(to_jit(np.sin(angle)), 0.0, to_jit(np.cos(angle)))
    transport = {"camera": mi.TransportMode.Radiance, "laser": mi.TransportMode.Importance}[mode]
    path = faces.trace(mi.Point3f(0.0, 0.0, 0.0), direction, mode=transport)
    assert (path.weight.numpy() > 0).all()
    # The twin's own coefficient: given, 14.5 / m for Rubin's clear soda lime at 635 nm, or zero.
    absorption = 1e-3 * {1.52: 0.0, 1.9: 40.0, "soda-lime": 14.5}[glass]
    expected = window_transmittance(np.cos(angle), window, index, absorption_per_mm=absorption)
    if mode == "camera":
        expected = expected / index**2  # radiance over index squared is what stays along a ray
    # Towards 75 deg transmittance falls steeply with the angle: a rounding of 6e-8 there weighs ten times as much.
    np.testing.assert_allclose(path.weight.numpy(), expected, rtol=5 * ROUNDING)
    backwards = fresnel_transmittance(np.cos(angle), n1=1.0, n2=window.index(635.0)) / (
        index**2 if mode == "camera" else 1
    )
    assert np.abs(path.weight.numpy() / backwards - 1).min() > 1e-3, "one face alone would be noticed"


# --- sheet -----------------------------------------------------------------------------------------------------------


def profile(
    sheet: Sheet, sensor: Sensor, medium: Medium, z: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Power per area of the plane Z = ``z`` (A, B) at nodes x (A,) across and y (B,) along, and the weights of y."""
    fan = oracle_fan(sensor, medium)
    edge = fan.y(np.array(fan.full_angle / 2), z - laser_origin(sensor)[2])
    y, weights = gauss_legendre(-edge * (1 - 1e-6), edge * (1 - 1e-6), 80)
    x = np.linspace(-3.0, 3.0, 301)
    grid_x, grid_y = np.meshgrid(x, y, indexing="ij")
    p = mi.Point3f(to_jit(grid_x), to_jit(grid_y), mi.Float(z))
    light = sheet.evaluate(p)
    power = light.irradiance * light.direction.z
    dr.eval(power)
    return power.numpy().astype(float).reshape(grid_x.shape), x, y, weights


SHEETS = {
    "thesis": ({}, "water"),
    "absorbing glass": ({"laser": {"window": {"absorption_per_m": 30.0}, "fan_angle_deg": 70.0}}, "water"),
    "air": ({}, "air"),
}


@pytest.mark.parametrize("name", SHEETS)
def test_the_sheet_carries_the_lasers_power(thesis, name):
    changes, medium_name = SHEETS[name]
    sensor = altered(thesis, changes)
    medium = sensor.media[medium_name]
    sheet, fan = Sheet(sensor, medium), oracle_fan(sensor, medium)
    angle, weights = gauss_legendre(-fan.full_angle / 2, fan.full_angle / 2, 40)
    for z in (-100.0, 0.0, 150.0):
        way = fan.way_in_medium(angle, z - laser_origin(sensor)[2])
        expected = weights @ (fan.power_per_angle(angle) * np.exp(-fan.extinction * way))
        power, x, _, along = profile(sheet, sensor, medium, z)
        total = power.sum(axis=0) @ along * (x[1] - x[0])
        # The trapezoidal rule is exact for a Gaussian sampled by seven or more nodes, Gauss's rule for the smooth
        # profile along the fan. The remaining error is that of the twin's polynomial along the fan.
        assert total == pytest.approx(expected, rel=1e-4)
    assert 0.5 < expected / fan.power_w < 0.98


def test_the_profile_along_the_sheet_is_that_of_an_even_fan(thesis):
    medium = thesis.media["water"]
    fan, z = oracle_fan(thesis, medium), 40.0
    power, x, y, _ = profile(Sheet(thesis, medium), thesis, medium, z)
    depth = z - laser_origin(thesis)[2]
    angle = fan.angle_through(y, depth)
    expected = (
        fan.power_per_angle(angle)
        / fan.y_per_angle(angle, depth)
        * np.exp(-fan.extinction * fan.way_in_medium(angle, depth))
    )
    np.testing.assert_allclose(power.sum(axis=0) * (x[1] - x[0]), expected, rtol=2e-4)
    assert expected.max() / expected.min() > 1.05, "a flat profile would be noticed"


def test_the_sheet_is_a_gaussian_of_the_width_of_a_real_beam(thesis):
    medium = thesis.media["water"]
    sensor = altered(thesis, {"laser": {"waist_radius_mm": 0.08, "waist_distance_mm": 400.0, "beam_quality_m2": 1.8}})
    sheet, fan = Sheet(sensor, medium), oracle_fan(sensor, medium)
    for z in (-150.0, -62.0, 0.0, 150.0):
        power, x, y, _ = profile(sheet, sensor, medium, z)
        share = power / power.sum(axis=0)
        np.testing.assert_allclose(x @ share, 0.0, atol=1e-4)
        sigma = np.sqrt(x**2 @ share)
        np.testing.assert_allclose(sigma, fan.sigma(y, z - laser_origin(sensor)[2]), rtol=1e-4)
        kurtosis = (x**4 @ share) / sigma**4
        np.testing.assert_allclose(kurtosis, 3.0, rtol=1e-3)  # a Gaussian's; a uniform profile has 1.8


# --- water and camera ------------------------------------------------------------------------------------------------


def camera_factor(sensor: Sensor, medium: Medium, points: np.ndarray) -> np.ndarray:
    """Irradiance on the image sensor per radiance that leaves points (N, 3) of the OCS towards the camera."""
    rays, _, way = oracle_paths(sensor, medium, points)
    return lens_factor(sensor, medium, rays) * np.exp(-extinction(medium) * way)


def pixels_per_mm(sensor: Sensor, medium: Medium, points: np.ndarray) -> np.ndarray:
    """Return the image area in px2 per mm2 of a stripe of unit width along X in an image column, per px/mm along Y."""
    step = 0.01
    x, y = (
        (image_of(sensor, medium, points + step * axis) - image_of(sensor, medium, points - step * axis)) / (2 * step)
        for axis in np.eye(3)[:2]
    )
    return np.abs((x[:, 0] * y[:, 1] - x[:, 1] * y[:, 0]) / y[:, 0])


def stripe_sum(sensor: Sensor, medium: Medium, y: np.ndarray, z: float, *, reflectance: float) -> np.ndarray:
    """Irradiance summed along image columns that show the stripe at (0, y, z) on a plate square to the laser."""
    points = np.stack([0 * y, y, np.full_like(y, z)], axis=1)
    fan, depth = oracle_fan(sensor, medium), z - laser_origin(sensor)[2]
    angle = fan.angle_through(y, depth)
    power_per_mm = fan.power_per_angle(angle) / fan.y_per_angle(angle, depth)
    arriving = power_per_mm * np.exp(-fan.extinction * fan.way_in_medium(angle, depth))
    return (
        reflectance / math.pi * arriving * camera_factor(sensor, medium, points) * pixels_per_mm(sensor, medium, points)
    )


def test_the_stripes_irradiance_is_what_power_reflectance_and_lens_make_of_it(thesis):
    sensor, medium, reflectance = cropped(thesis, 1280, 160), clear(0.3), 0.37
    renderer = Renderer(sensor, medium, scene_of(plate(reflectance=reflectance)), effects=NONE)
    column_sums = renderer.laser_frame(sensor_at(), spp=64).irradiance().astype(float).sum(axis=0)
    y = np.linspace(-60.0, 60.0, 13)
    centre = image_of(sensor, medium, np.stack([0 * y, y, 0 * y], axis=1))[:, 0]
    columns = np.rint(centre).astype(int)[:, None] + np.arange(-20, 21)
    assert columns.min() > 0
    assert columns.max() < 1280
    # The factors change by less than 1 % over 41 columns, so evenly that their mean is the middle's within 1e-5; the
    # half pixel of rounding shifts them by 1e-4. A sum over the 12 lit pixels of a column at 64 samples scatters by
    # 0.5 %, the mean of 41 columns by 0.08 %: five times that for the largest of 13, and 0.03 % for their mean.
    expected = stripe_sum(sensor, medium, y, 0.0, reflectance=reflectance)
    ratio = column_sums[columns].mean(axis=1) / expected
    assert ratio.mean() == pytest.approx(1.0, abs=1e-3)
    np.testing.assert_allclose(ratio, 1.0, rtol=0, atol=5e-3)
    assert expected.max() / expected.min() > 1.05, "lens and fan, which dim towards the edges, are in the comparison"


@pytest.mark.parametrize(("absorption", "scattering"), [(2.0, 0.0), (5.0, 1.5)])
def test_water_dims_the_stripe_over_the_laser_s_and_the_cameras_way(thesis, absorption, scattering):
    sensor = cropped(thesis, 33, 512)
    # With the forward-scattering phase function, haze in the stripe is below 1e-5 of it.
    media = clear(), clear(absorption, scattering, phase="henyey-greenstein", asymmetry=0.95)
    renderers = [Renderer(sensor, medium, scene_of(plate()), effects=NONE) for medium in media]
    for z in (-40.0, 0.0, 50.0):
        bright, dim = (r.laser_frame(sensor_at(-z), spp=64).irradiance().astype(float) for r in renderers)
        lit = bright.sum(axis=1) > 0.01 * bright.sum(axis=1).max()
        found = dim[lit].sum() / bright[lit].sum()
        laser_way = oracle_fan(sensor, media[0]).way_in_medium(0.0, z - laser_origin(sensor)[2])
        camera_way = oracle_paths(sensor, media[0], np.array([[0.0, 0.0, z]]))[2][0]
        expected = math.exp(-extinction(media[1]) * (laser_way + camera_way))
        # Same samples in both images: the spread of path lengths across the stripe, 0.2 mm * 6.5 / m, enters squared.
        assert found == pytest.approx(expected, rel=2e-4)
        assert 0.003 < expected < 0.4


def test_a_plate_under_the_lamp_shows_reflectance_times_irradiance_over_pi(thesis):
    sensor = altered(thesis, {"lamp": {"irradiance_w_per_m2": 3.0}})
    medium, z = clear(0.8), 30.0
    renderer = Renderer(sensor, medium, scene_of(plate(z, reflectance=0.45)), effects=NONE)
    image = renderer.irradiance("lamp", sensor_at(), spp=4)
    x, y = (g.ravel() for g in np.meshgrid(np.linspace(-60, 40, 11), np.linspace(-70, 70, 11)))
    points = np.stack([x, y, np.full_like(x, z)], axis=1)
    uv = np.rint(image_of(sensor, medium, points)).astype(int)
    inside = (uv >= 0).all(axis=1) & (uv[:, 0] < 1280) & (uv[:, 1] < 1024)
    assert inside.sum() > 80
    expected = 0.45 * 3e-6 / math.pi * camera_factor(sensor, medium, points)[inside]
    # Rounding by half a pixel is 0.1 mm or 2e-4 rad; cos^4 then changes by less than 4 * 2e-4 * tan 18 deg.
    np.testing.assert_allclose(image[uv[inside, 1], uv[inside, 0]], expected, rtol=3e-4)


def test_a_retroreflecting_mark_returns_lamp_light_only(thesis):
    sensor = altered(thesis, {"lamp": {"irradiance_w_per_m2": 3.0, "ambient_w_per_m2": 2.0}})
    sensor = altered(sensor, {"camera": {"width_px": 64, "height_px": 48}})
    plain, tape = plate(reflectance=0.2), plate(reflectance=0.2) | {"retroreflection": 1.5}
    effects = replace(NONE, ambient=True)
    marks = [Renderer(sensor, clear(), scene_of(thing), effects=effects) for thing in (plain, tape)]
    (lamp, with_lamp), (day, with_day) = (
        [mark.irradiance(light, sensor_at(), spp=4) for mark in marks] for light in ("lamp", "day")
    )
    # The radiance of a diffuse surface is reflectance E / pi, that of the tape 1.5 E more.
    np.testing.assert_allclose(with_lamp / lamp, 1 + 1.5 * math.pi / 0.2, rtol=1e-4)
    np.testing.assert_array_equal(with_day, day)
    laser, with_laser = (mark.laser_frame(sensor_at(), spp=4).irradiance() for mark in marks)
    np.testing.assert_array_equal(with_laser, laser)


def test_daylight_from_one_half_space_shades_a_tilted_surface(thesis):
    sensor = altered(thesis, {"lamp": {"ambient_w_per_m2": 2.0}, "camera": {"width_px": 64, "height_px": 48}})
    tilted = plate() | {"rotation_deg": (60.0, 0.0, 0.0)}
    level, turned = (
        Renderer(sensor, clear(), scene_of(thing), effects=replace(NONE, ambient=True)).irradiance(
            "day", sensor_at(), spp=4
        )
        for thing in (plate(), tilted)
    )
    # Directions of the half-space about -Z, evenly on a lattice of both angles; those behind the surface give nothing.
    height, turn = np.meshgrid((np.arange(200) + 0.5) / 200, 2 * math.pi * (np.arange(400) + 0.5) / 400)
    towards = np.sqrt(1 - height**2) * np.sin(turn) * math.sin(math.radians(60)) + height * math.cos(math.radians(60))
    share = np.maximum(towards, 0).mean() / height.mean()
    np.testing.assert_allclose((turned / level)[20:28, 28:36], share, rtol=2e-3)


@pytest.mark.parametrize("light", ["day", "lamp"])
def test_turbid_water_veils_what_day_and_lamp_light(thesis, light):
    """Duntley's equation, with the backscattered fraction of the lamp's light by Henyey and Greenstein."""
    lamps = {"irradiance_w_per_m2": 3.0, "ambient_w_per_m2": 2.0}
    sensor = altered(thesis, {"lamp": lamps, "camera": {"width_px": 320, "height_px": 256, "pixel_size_um": 21.2}})
    g, z, reflectance = 0.7, 30.0, 0.45
    medium = clear(0.5, 2.0, phase="henyey-greenstein", asymmetry=g)
    renderer = Renderer(
        sensor, medium, scene_of(plate(z, reflectance=reflectance)), effects=replace(NONE, ambient=True, haze=True)
    )
    image = renderer.irradiance(light, sensor_at(), spp=4)
    x, y = (axis.ravel() for axis in np.meshgrid(np.linspace(-60, 40, 11), np.linspace(-70, 70, 11)))
    points = np.stack([x, y, np.full_like(x, z)], axis=1)
    uv = np.rint(image_of(sensor, medium, points)).astype(int)
    inside = (uv >= 0).all(axis=1) & (uv[:, 0] < 320) & (uv[:, 1] < 256)
    assert inside.sum() > 80
    rays, _, way = oracle_paths(sensor, medium, points)
    left = np.exp(-extinction(medium) * way)
    returns = {"day": 1.0, "lamp": (1 - g) / (2 * g) * ((1 + g) / math.hypot(1, g) - 1)}[light]
    veil = returns * medium.scattering_per_mm(635.0) / extinction(medium) * (1 - left)
    irradiance = {"day": 2e-6, "lamp": 3e-6}[light]
    expected = irradiance / math.pi * (reflectance * left + veil) * lens_factor(sensor, medium, rays)
    # Half a pixel is 0.4 mm or 1e-3 rad: cos^4 changes by up to 1.3e-3, the way's 1.3 extinctions by up to 0.5e-3.
    np.testing.assert_allclose(image[uv[inside, 1], uv[inside, 0]], expected[inside], rtol=2e-3)
    assert 0.03 < np.median(veil / (reflectance * left)) < 10
