"""Indirect light: integrating sphere, corner and thin water against closed forms and quadrature, and its noise."""

import math
from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest
import trimesh

from tests.virtual_sensors import (
    altered,
    clear,
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
)
from twin.backend.arrays import to_jit
from twin.light.illumination import make_lights
from twin.light.pose import SensorPose
from twin.light.renderer import Renderer
from twin.light.walk import Walker
from twin.rendering_options import NONE
from twin.scene.description import Scene
from uwlts.model.sensor import Medium, Sensor

BOUNCED = replace(NONE, secondary_light=True)
SCATTERED = replace(NONE, multiple_scattering=True)
BATCHES = 32
"""Number of batches of a point's walks; their scatter gives the standard error of the mean."""
SURE = 4.5
"""Standard errors: one in 10^5 is larger, taking into account that 32 batches estimate it to 13 %."""


@pytest.fixture(scope="module")
def coarse(thesis) -> Sensor:
    """The thesis's view in 320 x 256 pixels."""
    return altered(thesis, {"camera": {"width_px": 320, "height_px": 256, "pixel_size_um": 21.2}})


def walked(renderer: Renderer, pixels: np.ndarray, walks: int, *, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Return the irradiance (N,) of indirect light at image points (N, 2), and its standard error."""
    pose = SensorPose(np.eye(4))
    direct, _ = make_lights([renderer._sheets[0]], pose)
    walker = Walker(renderer.objects, renderer.scattering, renderer.effects, pose, direct, 2000.0)
    each = walks // BATCHES
    cell = np.repeat(np.arange(len(pixels) * BATCHES), each)
    x, y = pixels[cell // BATCHES].T
    bundle = renderer.view.trace_bundle(to_jit(x), to_jit(y))
    sums = np.zeros(len(pixels) * BATCHES)
    for where, *parts in walker.trace(bundle, mi.UInt32(cell), seed=seed):
        for light in parts:
            sums += np.bincount(where, light, len(sums))
    batches = sums.reshape(len(pixels), BATCHES) / each
    return batches.mean(axis=1), batches.std(axis=1, ddof=1) / math.sqrt(BATCHES)


def seen(sensor: Sensor, medium: Medium, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Image points (N, 2) of points (N, 3), and irradiance (N,) there per radiance that leaves the points."""
    rays, _, way = oracle_paths(sensor, medium, points)
    return image_of(sensor, medium, points), lens_factor(sensor, medium, rays) * np.exp(-extinction(medium) * way)


def assert_agrees(found: np.ndarray, error: np.ndarray, expected: np.ndarray, *, within: float, noise: float) -> None:
    """Check that means agree within their standard errors and the accuracy ``within``, and are conclusive."""
    print("relative deviation", np.round(found / expected - 1, 4), "standard error", np.round(error / expected, 4))
    assert (error < noise * expected).all(), "the test could not fail"
    np.testing.assert_array_less(np.abs(found - expected), SURE * error + within * expected)
    overall = (found / expected).mean()
    assert abs(overall - 1) < SURE * np.sqrt(((error / expected) ** 2).sum()) / len(found) + within


# --- between surfaces -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("reflectance", [0.3, 0.8])
def test_an_integrating_sphere_is_filled_with_the_geometric_series(coarse, tmp_path, reflectance):
    # Inside a diffuse sphere of reflectance r, every point illuminates all points evenly. The power P r after the first
    # reflection gives the irradiance P r (1 + r + ...) / area everywhere. The sensor is inside the sphere.
    radius = 900.0
    trimesh.creation.icosphere(subdivisions=6, radius=radius).export(tmp_path / "sphere.ply")
    surface = {"kind": "mesh", "path": str(tmp_path / "sphere.ply"), "reflectance": reflectance}
    medium = clear()
    renderer = Renderer(coarse, medium, scene_of(surface), effects=BOUNCED)
    fan = oracle_fan(coarse, medium)
    angle, weights = gauss_legendre(-fan.full_angle / 2, fan.full_angle / 2, 40)
    power = weights @ fan.power_per_angle(angle)
    bounced = power * reflectance / (1 - reflectance) / (4 * math.pi * radius**2)
    # Points seen by the camera, away from the stripe.
    x, y = (g.ravel() for g in np.meshgrid([420.0, 480.0, 540.0], [-150.0, 0.0, 190.0]))
    points = np.stack([x, y, np.sqrt(radius**2 - x**2 - y**2)], axis=1)
    pixels, factor = seen(coarse, medium, points)
    inside = (pixels > 0).all(axis=1) & (pixels[:, 0] < 319) & (pixels[:, 1] < 255)
    assert inside.sum() >= 4
    found, error = walked(renderer, pixels[inside], 16384)
    expected = (reflectance / math.pi * bounced * factor)[inside]
    # A facet of 16 mm is turned by up to 0.5 deg against the sphere, which changes what it gets of a stripe that is
    # seen under 76 deg from its normal by up to 3.5 %, one way or the other.
    assert_agrees(found, error, expected, within=0.035, noise=0.01)
    assert (found / expected).mean() == pytest.approx(1.0, abs=0.01)


def wall(turn: float, centre: tuple[float, float], reflectance: float) -> dict[str, object]:
    """A plate 240 mm along X and 120 mm across, turned by ``turn`` deg about X; ``centre`` is its middle's Y and Z."""
    return {
        "kind": "plate",
        "width_mm": 240.0,
        "height_mm": 120.0,
        "reflectance": reflectance,
        "position_mm": (0.0, *centre),
        "rotation_deg": (turn, 0.0, 0.0),
    }


def line_on_wall(sensor: Sensor, medium: Medium, s: np.ndarray, along: np.ndarray) -> np.ndarray:
    """Return the power per length (N,) of the sheet along the line Y, Z = s * ``along`` from the origin of the OCS."""
    fan, origin = oracle_fan(sensor, medium), laser_origin(sensor)
    step = 1e-3

    def angle_at(s: np.ndarray) -> np.ndarray:
        return fan.angle_through(s * along[0] - origin[1], s * along[1] - origin[2])

    angle = angle_at(s)
    per_length = np.abs(angle_at(s + step) - angle_at(s - step)) / (2 * step)
    way = fan.way_in_medium(angle, s * along[1] - origin[2])
    return fan.power_per_angle(angle) * per_length * np.exp(-fan.extinction * way)


def from_line(
    points: np.ndarray, normal: np.ndarray, line: np.ndarray, line_normal: np.ndarray, c: float
) -> np.ndarray:
    """Return the irradiance (N, M) at points (N, 3) per power (M,) emitted by diffuse spots (M, 3), in 1/mm2."""
    apart = line[None] - points[:, None]
    r = np.linalg.norm(apart, axis=-1)
    there, here = -(apart @ line_normal) / r, (apart @ normal) / r
    return np.clip(there, 0, None) * np.clip(here, 0, None) / (math.pi * r**2) * np.exp(-c * r)


@pytest.mark.parametrize("absorption", [0.0, 3.0])
def test_a_corner_lights_itself_as_one_bounce_by_quadrature(coarse, absorption):
    # Two walls at right angles along X, lit along X = 0. With 2 % reflectance the second bounce, of one part in 100
    # of the first at most, is left out of the reference.
    medium, reflectance, turn = clear(absorption), 0.02, math.radians(45)
    arms = {side: np.array([side * math.cos(turn), -math.sin(turn)]) for side in (-1, 1)}
    walls = [wall(side * -45.0, tuple(60.0 * arms[side]), reflectance) for side in (-1, 1)]
    renderer = Renderer(coarse, medium, scene_of(*walls), effects=BOUNCED)
    s, weights = gauss_legendre(0.0, 120.0, 400)
    for side in (-1, 1):
        along, other = arms[side], arms[-side]
        normal, other_normal = np.array([0.0, *other]), np.array([0.0, *along])
        x, t = (g.ravel() for g in np.meshgrid([-15.0, 12.0, 35.0], [15.0, 40.0, 70.0]))
        points = np.stack([x, t * along[0], t * along[1]], axis=1)
        lit = np.stack([0 * s, s * other[0], s * other[1]], axis=1)
        power = weights * line_on_wall(coarse, medium, s, other) * reflectance
        irradiance = from_line(points, normal, lit, other_normal, extinction(medium)) @ power
        pixels, factor = seen(coarse, medium, points)
        inside = (pixels > 1).all(axis=1) & (pixels[:, 0] < 318) & (pixels[:, 1] < 254)
        assert inside.sum() >= 5
        found, error = walked(renderer, pixels[inside], 32768, seed=side + 1)
        assert_agrees(found, error, (reflectance / math.pi * irradiance * factor)[inside], within=0.01, noise=0.03)


# --- in the water -----------------------------------------------------------------------------------------------------


def sheet_upon(
    sensor: Sensor, medium: Medium, points: np.ndarray, normal: np.ndarray, phase, low: float, high: float
) -> np.ndarray:
    """Return the irradiance (N,) at points (N, 3) by light scattered once from the sheet between ``low`` and ``high``.

    The sheet is a plane: its width of 0.15 mm is far below the distance to the points.
    """
    fan, origin = oracle_fan(sensor, medium), laser_origin(sensor)
    c, b = extinction(medium), medium.scattering_per_mm(635.0)
    z, weight_z = gauss_legendre(low, high, 240)
    edge = fan.full_angle / 2
    angle, weight_angle = gauss_legendre(-edge, edge, 160)
    a, zz = np.meshgrid(angle, z)
    depth = zz - origin[2]
    slope = fan.slopes(a)[2]
    p = np.stack([0 * a, fan.y(a, depth) + origin[1], zz], axis=-1)
    light = np.stack([0 * a, slope, np.ones_like(a)], axis=-1) / np.hypot(1, slope)[..., None]
    # Of the power P'(angle) dangle the water scatters b dl on the way dl = dz hypot(1, slope).
    power = fan.power_per_angle(a) * np.exp(-c * fan.way_in_medium(a, depth)) * b * np.hypot(1, slope)
    power *= weight_z[:, None] * weight_angle
    total = []
    for point in points:
        apart = point - p
        r = np.linalg.norm(apart, axis=-1)
        cosine = np.clip(-(apart @ normal) / r, 0, None)
        total.append((power * phase((light * apart).sum(axis=-1) / r) * cosine * np.exp(-c * r) / r**2).sum())
    return np.array(total)


def henyey_greenstein(g: float):
    return lambda cosine: (1 - g * g) / (4 * math.pi * (1 + g * g - 2 * g * cosine) ** 1.5)


@pytest.mark.parametrize(("asymmetry", "absorption"), [(0.0, 0.0), (0.7, 0.0), (0.0, 2.0)])
def test_thin_water_lights_a_surface_beside_the_stripe_as_the_sheets_quadrature(coarse, asymmetry, absorption):
    # A diffuse plate beside the sheet, which ends on a black one 60 mm behind: what the plate shows is scattered once
    # out of the sheet. At b = 0.005 / m twice scattered light is b times half a metre of it, 0.3 %.
    phase = {"phase": "henyey-greenstein", "asymmetry": asymmetry}
    medium = clear(absorption, 0.005, **phase)
    beside = {
        "kind": "plate",
        "width_mm": 50.0,
        "height_mm": 150.0,
        "reflectance": 0.8,
        "position_mm": (35.0, 0.0, 0.0),
    }
    renderer = Renderer(coarse, medium, scene_of(beside, plate(60.0, reflectance=0.0)), effects=SCATTERED)
    x, y = (g.ravel() for g in np.meshgrid([14.0, 25.0, 45.0], [-50.0, 0.0, 40.0]))
    points = np.stack([x, y, 0 * x], axis=1)
    outer = laser_origin(coarse)[2] + oracle_fan(coarse, medium).outer_face
    irradiance = sheet_upon(
        coarse, medium, points, np.array([0.0, 0.0, -1.0]), henyey_greenstein(asymmetry), outer, 0.0
    )
    pixels, factor = seen(coarse, medium, points)
    found, error = walked(renderer, pixels, 65536)
    assert_agrees(found, error, 0.8 / math.pi * irradiance * factor, within=0.01, noise=0.04)


def test_thin_water_spreads_the_stripe_along_camera_rays_as_quadrature(coarse):
    # A narrow white strip in the sheet upon black: between it and the window the water scatters its light into rays
    # that end on the black beside it. At b = 0.02 / m twice scattered light is b times half a metre of it, 1 %.
    medium, reflectance = clear(0.5, 0.02, phase="henyey-greenstein", asymmetry=0.6), 0.8
    strip = {"kind": "plate", "width_mm": 10.0, "height_mm": 300.0, "reflectance": reflectance}
    renderer = Renderer(coarse, medium, scene_of(strip, plate(1.0, reflectance=0.0)), effects=SCATTERED)
    fan, origin, c = oracle_fan(coarse, medium), laser_origin(coarse), extinction(medium)
    points = np.array([(x, y, 1.0) for x, y in ((-20.0, -40.0), (20.0, 10.0), (45.0, -20.0))])
    pixels, _ = seen(coarse, medium, points)
    rays, origins, lengths = oracle_paths(coarse, medium, points)
    edge = fan.y(np.array(fan.full_angle / 2), -origin[2])
    y, weight_y = gauss_legendre(-min(edge, 150.0), min(edge, 150.0), 300)
    power = weight_y * line_on_plane(coarse, medium, y, 0.0) * reflectance / math.pi
    lit = np.stack([0 * y, y, 0 * y], axis=1)
    phase, expected = henyey_greenstein(0.6), []
    for start, end, length in zip(origins, points, lengths, strict=True):
        t, weight_t = gauss_legendre(0.0, length, 400)
        along = (end - start) / length
        apart = (start + t[:, None] * along)[:, None] - lit
        r = np.linalg.norm(apart, axis=-1)
        scattered = phase(-(apart @ along) / r) * np.clip(-apart[..., 2] / r, 0, None) * np.exp(-c * r) / r**2
        expected.append(weight_t * np.exp(-c * t) @ (scattered @ power) * medium.scattering_per_mm(635.0))
    found, error = walked(renderer, pixels, 262144, seed=4)
    assert_agrees(found, error, np.array(expected) * lens_factor(coarse, medium, rays), within=0.015, noise=0.05)


def line_on_plane(sensor: Sensor, medium: Medium, y: np.ndarray, z: float) -> np.ndarray:
    """Return the power per length (N,) of the sheet along Y on the plane Z = ``z``."""
    fan, depth = oracle_fan(sensor, medium), z - laser_origin(sensor)[2]
    angle = fan.angle_through(y, np.full_like(y, depth))
    way = fan.way_in_medium(angle, depth)
    return fan.power_per_angle(angle) / fan.y_per_angle(angle, depth) * np.exp(-fan.extinction * way)


# --- noise, seeds and images ------------------------------------------------------------------------------------------


def corner_scene(reflectance: float = 0.8) -> Scene:
    """Two walls at right angles, open towards the sensor."""
    shift = 60.0 * math.sqrt(0.5)
    return scene_of(*(wall(side * -45.0, (side * shift, -shift), reflectance) for side in (-1, 1)))


@pytest.fixture(scope="module")
def tiny(thesis) -> Sensor:
    """The thesis's view in 160 x 128 pixels."""
    return altered(thesis, {"camera": {"width_px": 160, "height_px": 128, "pixel_size_um": 42.4}})


NOISY = {
    "coastal": (Medium(kind="fresh", water="coastal"), scene_of(plate(20.0))),
    "corner": (clear(0.3), corner_scene()),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", NOISY)
def test_no_walk_outshines_the_stripe(tiny, name):
    medium, scene = NOISY[name]
    renderer = Renderer(tiny, medium, scene, effects=replace(BOUNCED, multiple_scattering=True))
    frames = [renderer.laser_frame(sensor_at(), spp=16, seed=seed) for seed in range(20)]
    images = np.array([frame.scattered for frame in frames], float)
    assert np.isfinite(images).all()
    assert images.min() >= 0
    peak, mean = frames[0].stripe.max(), images.mean(axis=0)
    assert mean.max() < 0.2 * peak
    # Weighted by the balance heuristic, a walk that finds a lit surface adds at most its radiance divided by 0.7, the
    # fraction of directions drawn from the vertex's own scattering. A cell takes the mean of at least 4 walks; at most
    # two of them may find a lit surface.
    assert images.max() < 0.2 * peak + 2 / 0.7 / 4 * peak
    # Both halves of the seeds agree in total light: a sum dominated by rare bright samples would not.
    totals = images.sum(axis=(1, 2))
    spread = totals.std(ddof=1)
    assert spread < 0.5 * totals.mean()
    assert abs(totals[:10].mean() - totals[10:].mean()) < 4 * spread * math.sqrt(2 / 10)


def test_seeds_choose_the_walks_and_nothing_else(tiny):
    renderer = Renderer(tiny, NOISY["coastal"][0], corner_scene(), effects=replace(BOUNCED, multiple_scattering=True))
    first, again, other = (renderer.laser_frame(sensor_at(), spp=4, seed=seed) for seed in (3, 3, 4))
    np.testing.assert_array_equal(first.scattered, again.scattered)
    np.testing.assert_array_equal(first.stripe, again.stripe)
    np.testing.assert_array_equal(first.stripe, other.stripe)
    assert (first.scattered != other.scattered).mean() > 0.9


@pytest.mark.slow
def test_the_mean_does_not_depend_on_the_number_of_walks(coarse):
    renderer = Renderer(
        coarse,
        clear(0.3, 2.0, phase="henyey-greenstein", asymmetry=0.8),
        corner_scene(),
        effects=replace(BOUNCED, multiple_scattering=True),
    )
    pixels = np.array([(100.0, 100.0), (160.0, 40.0), (220.0, 110.0), (160.0, 60.0)])
    found = [[], []]
    for k, (walks, repeats) in enumerate(((32, 24), (4096, 2))):
        for seed in range(repeats):
            found[k].append(walked(renderer, pixels, walks, seed=1000 * k + seed)[0])
    few, many = (np.array(values) for values in found)
    error = few.std(axis=0, ddof=1) / math.sqrt(len(few)) * math.sqrt(1 + 24 * 32 / (2 * 4096))
    assert (error < 0.4 * few.mean(axis=0)).all()
    assert (np.abs(few.mean(axis=0) - many.mean(axis=0)) < SURE * error).all()


def test_images_hold_what_the_walks_find(tiny):
    # Cells of pixels and their interpolation must keep the light: over a region it is that of walks pixel by pixel.
    renderer = Renderer(tiny, clear(0.3), corner_scene(), effects=BOUNCED)
    frames = [renderer.laser_frame(sensor_at(), spp=64, seed=seed).scattered for seed in range(12)]
    rows, columns = np.arange(16, 112), np.arange(40, 120)
    sums = [frame[16:112, 40:120].sum(dtype=float) for frame in frames]
    y, x = (g.ravel() for g in np.meshgrid(rows, columns, indexing="ij"))
    found, error = walked(renderer, np.stack([x, y], axis=1).astype(float), 128, seed=9)
    scatter = math.hypot(np.std(sums, ddof=1) / math.sqrt(12), math.sqrt((error**2).sum()))
    assert scatter < 0.08 * np.mean(sums)
    assert np.mean(sums) == pytest.approx(found.sum(), abs=5 * scatter)


@pytest.mark.slow
def test_light_on_longer_ways_moves_with_the_sensor(coarse):
    """Sensor and scene moved together give the same image: no result depends on the scene's origin."""
    shift = np.array([7.0, -5.0, 60.0])
    groove = [wall(-45.0, (60.0, 0.0), 0.8), wall(45.0, (-60.0, 0.0), 0.8)]
    images = []
    for offset in (np.zeros(3), shift):
        moved = [side | {"position_mm": tuple((np.array(side["position_mm"]) + offset).tolist())} for side in groove]
        pose = np.eye(4)
        pose[:3, 3] = offset
        renderer = Renderer(coarse, coarse.media["water"], scene_of(*moved), effects=replace(BOUNCED, haze=True))
        images.append(renderer.laser_frame(pose, spp=16, seed=3).scattered.astype(float))
    lit = images[0] > 0.05 * images[0].max()
    assert lit.sum() > 500
    assert images[0][lit].mean() > 1e-11, "haze alone is a thousand times weaker"
    # Walks are equal except for rounding, which changes the path of one in some thousands.
    assert images[1][lit].mean() == pytest.approx(images[0][lit].mean(), rel=0.01)
    assert np.median(np.abs(images[1][lit] / images[0][lit] - 1)) < 0.01
