"""Sheet with a profile, a bow and a bent surface: position and power of its light, and sampled rays."""

import math
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy import stats

from tests.oracles import fermat
from tests.virtual_sensors import (
    altered,
    clear,
    cropped,
    laser_origin,
    oracle_fan,
    oracle_window,
    plate,
    scene_of,
    seen_at,
    sensor_at,
    window_transmittance,
)
from twin.backend.arrays import to_jit, to_numpy
from twin.light.renderer import Renderer
from twin.light.sheet import PowerTable, Sheet
from twin.recording.frame_truth import find_true_stripe, measure_line_light
from twin.rendering_options import NONE, Flaws
from twin.sensor.detector import as_built
from uwlts.errors import DescriptionError, DesignError
from uwlts.model.library import validate_description
from uwlts.model.placement import camera_from_object
from uwlts.model.sensor import Laser, Medium, Sensor

CORNERS = ((-18.0, 0.2), (-5.0, 1.0), (-4.5, 0.0), (2.0, 0.0), (10.0, 0.8), (20.0, 0.5))
"""A profile with corners, a dark stretch and jumps at both ends, in deg and relative power."""
TILTED = {"window": {"tilt_y_deg": 5.0, "aperture_diameter_mm": 60.0}, "bow_deg": 0.5}
TWISTED = {
    "window": {"tilt_x_deg": -10.0, "tilt_y_deg": 10.0, "aperture_diameter_mm": 60.0},
    "bow_deg": -3.0,
    "roll_deg": 20.0,
}
LASERS: dict[str, dict[str, Any]] = {
    "flat": {},
    "gaussian": {"fan_profile": "gaussian"},
    "powell": {"fan_profile": "powell"},
    "corners": {"fan_profile": CORNERS},
    "bow": {"bow_deg": 0.5},
    "tilted": TILTED | {"fan_profile": "gaussian"},
    "twisted": TWISTED | {"fan_profile": CORNERS},
    "wide": {"fan_angle_deg": 90.0, "window": {"tilt_y_deg": 5.0, "aperture_diameter_mm": 200.0}, "bow_deg": 1.0},
    "hollow": {"fan_angle_deg": 110.0, "window": {"tilt_y_deg": 5.0, "aperture_diameter_mm": 400.0}, "bow_deg": 9.0},
}
DEPTHS = (-100.0, 0.0, 150.0)
WATER = clear()


def shape_of(laser: Laser, angle: np.ndarray) -> np.ndarray:
    """Return power per angle divided by its mean over the fan, from the description and normalised numerically."""

    def relative(a: np.ndarray) -> np.ndarray:
        if laser.fan_profile == "flat":
            return np.ones_like(a)
        if laser.fan_profile == "gaussian":
            return np.exp(-2 * (a / math.radians(laser.fan_angle_deg / 2)) ** 2)
        nodes, powers = np.array(laser.fan_table()).T
        return np.interp(a, np.radians(nodes), powers, left=0.0, right=0.0)

    half = math.radians(laser.fan_angle_deg / 2)
    # The midpoint rule with 2e5 places misses 1e-5 where the profile jumps and less than 1e-9 elsewhere.
    places = half * ((np.arange(200_000) + 0.5) / 100_000 - 1)
    return relative(angle) / relative(places).mean()


def fan_rays(laser: Laser, angle: np.ndarray) -> np.ndarray:
    """Unit directions (N, 3) of fan rays in air, along X, Y, Z."""
    bow = math.tan(math.radians(laser.bow_deg)) * (1 / np.cos(angle) - 1)
    rays = np.stack([bow, np.tan(angle), np.ones_like(angle)], axis=1)
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)


def light_at(sheet: Sheet, points: np.ndarray) -> dict[str, np.ndarray]:
    """Return the light of the sheet at points (N, 3), in double precision."""
    light = sheet.evaluate(mi.Point3f(*[to_jit(column) for column in points.T]))
    dr.eval(light)
    names = ("distance_mm", "sigma_mm", "irradiance", "exit_mm")
    values = {name: getattr(light, name).numpy().astype(float) for name in names}
    return values | {name: to_numpy(getattr(light, name)).astype(float) for name in ("direction", "normal")}


def middle(sheet: Sheet, y: np.ndarray, z: float) -> np.ndarray:
    """Points (N, 3) in the middle of the sheet."""
    points = np.stack([0 * y, y, np.full_like(y, z)], axis=1)
    light = light_at(sheet, points)
    points[:, 0] -= light["distance_mm"] / light["normal"][:, 0]
    return points


def power_per_mm(sheet: Sheet, y: np.ndarray, z: float) -> np.ndarray:
    """Return the power in W/mm through the plane Z = ``z`` per length along Y, integrated across X."""
    centre = middle(sheet, y, z)
    sigma = light_at(sheet, centre)["sigma_mm"]
    places = np.linspace(-8, 8, 65)  # the trapezoidal rule with four places per sigma is exact to 1e-12
    points = np.repeat(centre[:, None], 65, axis=1)
    points[..., 0] += sigma[:, None] * places
    light = light_at(sheet, points.reshape(-1, 3))
    flow = (light["irradiance"] * light["direction"][:, 2]).reshape(-1, 65)
    return flow.sum(axis=1) * sigma * (places[1] - places[0])


def fan_edges(sheet: Sheet, z: float) -> np.ndarray:
    """Return the two Y that bound the light, searched on successively finer grids."""
    edges = np.array([-600.0, 600.0])
    spacing = np.ptp(edges)
    for _ in range(3):
        grids = edges[:, None] + spacing * np.linspace(-1, 1, 3001)
        lit = light_at(sheet, middle(sheet, grids.ravel(), z))["irradiance"].reshape(grids.shape) > 0
        edges = np.array([grids[0, np.argmax(lit[0])], grids[1, -1 - np.argmax(lit[1, ::-1])]])
        spacing /= 1500
    return edges


# --- description -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"fan_profile": "even"}, "fan_profile.*'flat', 'gaussian' or 'powell'"),
        ({"fan_profile": [[0.0, 1.0]]}, r"has 1 pairs .*: give at least two"),
        ({"fan_profile": [[0.0, 1.0], [0.0, 2.0]]}, r"must increase, found \(0\.0, 0\.0\) deg"),
        ({"fan_profile": [[-1.0, 1.0], [1.0, -0.5]]}, r"must not be negative nor all zero, found \(1\.0, -0\.5\)"),
        ({"fan_profile": [[-1.0, 0.0], [1.0, 0.0]]}, "nor all zero"),
        ({"fan_profile": [[-23.0, 1.0], [22.0, 1.0]]}, r"from -23 to 22 deg, .* only from -22\.5 to 22\.5 deg"),
        ({"fan_profile": [[-1.0, math.nan], [1.0, 1.0]]}, "finite number"),
        ({"fan_profile": [[-1.0, 1.0, 2.0], [1.0, 1.0]]}, "fan_profile"),
        ({"side_lobes": [[0.0, 20.0, 0.6], [3.0, 1.0, 0.4]]}, "add up to 1; the main sheet needs the rest"),
        ({"side_lobes": [[190.0, 20.0, 0.1]]}, "reach farther than 200 radii"),
        ({"side_lobes": [[0.0, 0.0, 0.1]]}, "side_lobes.*greater than 0"),
        ({"bow_deg": 12.0}, "bow_deg.*less than 10"),
        ({"linewidth_nm": -0.1}, "linewidth_nm.*greater than or equal to 0"),
    ],
)
def test_a_laser_that_cannot_be_is_refused(thesis, changes, message):
    with pytest.raises(DescriptionError, match=message):
        validate_description(Laser, thesis.laser.model_dump() | changes, "test")


def test_a_profile_may_reach_the_edges_of_the_fan_and_lasers_may_be_several(thesis):
    laser = thesis.laser.model_dump() | {"fan_profile": [[-22.5, 0.0], [22.5, 1.0]], "linewidth_nm": 0.5}
    sensor = altered(thesis, {"more_lasers": [laser]})
    assert sensor.more_lasers[0].fan_profile == ((-22.5, 0.0), (22.5, 1.0))
    assert thesis.more_lasers == ()


# --- where the light is ----------------------------------------------------------------------------------------------


def surface_points(sensor: Sensor, medium: Medium, angle: np.ndarray, z: float) -> np.ndarray:
    """Points (N, 3) of the OCS at ``z`` that fan rays reach by paths of least time through the laser's window."""
    origin = laser_origin(sensor)
    rays = fan_rays(sensor.laser, angle)
    plane = fermat.Face(np.array([0.0, 0.0, z - origin[2]]), np.array([0.0, 0.0, 1.0]))
    guess = rays / rays[:, 2:] * plane.point[2]
    return fermat.points_seen_on_plane(rays, plane, guess, *oracle_window(sensor.laser.window, medium)) + origin


@pytest.mark.parametrize("name", ["tilted", "twisted", "wide"])
def test_a_bent_sheet_lies_on_paths_of_least_time(thesis, name):
    sensor = altered(thesis, {"laser": LASERS[name] | {"fan_profile": "flat"}})
    sheet = Sheet(sensor, WATER)
    edge = 0.998 * math.radians(sensor.laser.fan_angle_deg / 2)
    angle, bend, shares = np.linspace(-edge, edge, 61), 0.0, []
    for z in DEPTHS:
        points = surface_points(sensor, WATER, angle, z)
        light = light_at(sheet, points)
        # 32 bits know a coordinate of 400 mm to 3e-5 mm; ten such roundings stay below 3e-4 mm.
        np.testing.assert_allclose(light["distance_mm"], 0.0, rtol=0, atol=3e-4)
        farther = surface_points(sensor, WATER, angle, z + 50.0) - points
        ray = farther / np.linalg.norm(farther, axis=1, keepdims=True)
        np.testing.assert_allclose(light["direction"], ray, rtol=0, atol=2e-6)
        along = np.gradient(points, axis=0)
        # Central differences over 2 deg have a relative error of (2 deg)^2 of the change of the tangent, below 1e-4.
        slant = np.einsum("ni,ni->n", light["normal"], along / np.linalg.norm(along, axis=1, keepdims=True))
        assert np.abs(slant[1:-1]).max() < 1e-4
        assert np.abs(np.einsum("ni,ni->n", light["normal"], ray)).max() < 2e-6
        bend = max(bend, np.ptp(points[:, 0] - np.polyval(np.polyfit(points[:, 1], points[:, 0], 1), points[:, 1])))
        # Beside the surface, the distance is measured along its normal.
        beside = light_at(sheet, points + 0.1 * light["normal"])["distance_mm"]
        shares.append(beside / 0.1)
    # The surface's curvature is below 1e-3 / mm: over 0.1 mm the distance is exact to 1e-5 of it; rounding adds 1e-3.
    np.testing.assert_allclose(shares, 1.0, rtol=0, atol=3e-3)
    assert bend > 0.2, "a plane sheet would be noticed"


@pytest.mark.parametrize(("bow", "fan"), [(0.5, 45.0), (-0.5, 45.0), (4.0, 100.0)])
def test_in_air_the_bow_is_a_cone(thesis, bow, fan):
    laser = {"bow_deg": bow, "fan_angle_deg": fan, "window": {"mounted": False}}
    sensor, air = altered(thesis, {"laser": laser}), Medium(kind="air")
    sheet, origin = Sheet(sensor, air), laser_origin(sensor)
    angle = np.radians(np.linspace(-0.499, 0.499, 41) * fan)
    tangent = math.tan(math.radians(bow))
    for z in DEPTHS:
        depth = z - origin[2]
        delta = depth * tangent * (1 / np.cos(angle) - 1)
        points = origin + np.stack([delta, depth * np.tan(angle), np.full_like(angle, depth)], axis=1)
        light = light_at(sheet, points)
        np.testing.assert_allclose(light["distance_mm"], 0.0, rtol=0, atol=3e-4)
        # X = tan(alpha) (sqrt(Z^2 + Y^2) - Z), so X_Y = tan(alpha) sin(angle) and X_Z = tan(alpha) (cos(angle) - 1).
        gradient = np.stack([np.ones_like(angle), -tangent * np.sin(angle), tangent * (1 - np.cos(angle))], axis=1)
        normal = gradient / np.linalg.norm(gradient, axis=1, keepdims=True)
        np.testing.assert_allclose(light["normal"], normal, rtol=0, atol=1e-5)
        np.testing.assert_allclose(light["exit_mm"], np.linalg.norm(points - origin, axis=1), rtol=1e-6)
    assert np.abs(delta).max() > 0.3
    assert np.sign(delta[0]) == np.sign(bow)


def test_a_fan_bent_too_unevenly_is_refused(thesis):
    window = {"tilt_x_deg": 24.0, "tilt_y_deg": 30.0, "aperture_diameter_mm": 2000.0}
    sensor = altered(thesis, {"laser": {"fan_angle_deg": 119.0, "window": window}})
    with pytest.raises(DesignError, match=r"119 deg fan too unevenly: .* error of \d+\.\d+ mm \(limit 0\.001 mm\)"):
        Sheet(sensor, WATER)


# --- how much light --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", LASERS)
def test_power_behind_the_window_is_what_its_faces_pass_and_is_kept(thesis, name):
    sensor = altered(thesis, {"laser": LASERS[name]})
    laser, sheet = sensor.laser, Sheet(sensor, WATER)
    half = math.radians(laser.fan_angle_deg / 2)
    angle = half * ((np.arange(20_000) + 0.5) / 10_000 - 1)
    cosine = fan_rays(laser, angle) @ oracle_window(laser.window, WATER)[0][0].normal
    passed = window_transmittance(cosine, laser.window, 1.3312, absorption_per_mm=laser.window.absorption_per_mm())
    expected = 1e-3 * laser.power_mw * (passed * shape_of(laser, angle)).mean()
    # The midpoint rule has a relative error of up to 1e-4 / 2 at jumps of the profile; single precision adds 1e-6.
    assert sheet.power_w == pytest.approx(expected, rel=5e-5 if name in ("corners", "twisted") else 2e-6)
    assert 0.85 < sheet.power_w / (1e-3 * laser.power_mw) < 0.97
    for z in DEPTHS:
        low, high = fan_edges(sheet, z)
        y = low + (high - low) * (np.arange(4000) + 0.5) / 4000
        # A jump or corner inside one of the 4000 strips is worth up to 1e-4 of the power.
        assert power_per_mm(sheet, y, z).sum() * (high - low) / 4000 == pytest.approx(sheet.power_w, rel=2e-4)


@pytest.mark.parametrize("name", ["flat", "gaussian", "corners"])
def test_the_profile_is_the_one_described(thesis, name):
    sensor, medium = altered(thesis, {"laser": LASERS[name]}), thesis.media["water"]
    sheet, fan, z = Sheet(sensor, medium), oracle_fan(sensor, medium), 40.0
    depth = z - laser_origin(sensor)[2]
    angle = np.radians(np.linspace(-22.49, 22.49, 900))
    kinks = np.radians([a for a, _ in CORNERS])
    # The table has 4096 cells over the lit 38 deg of slopes; a corner or jump is rounded within its own.
    clear_of_kinks = np.abs(angle[:, None] - kinks).min(axis=1) > math.radians(0.02)
    angle = angle[clear_of_kinks]
    assert len(angle) > 850
    expected = fan.power_per_angle(angle) * shape_of(sensor.laser, angle) / fan.y_per_angle(angle, depth)
    expected *= np.exp(-fan.extinction * fan.way_in_medium(angle, depth))
    found = power_per_mm(sheet, fan.y(angle, depth), z)
    # A point's y is known to 1.5e-5 mm of 80; on the flank that falls to zero within 0.5 deg or 4 mm, that is 4e-6 of
    # the peak. Elsewhere 32 bits and the series of angle and transmittance leave 1e-4.
    np.testing.assert_allclose(found, expected, rtol=2e-4, atol=2e-5 * expected.max())
    assert (found[expected == 0] == 0).all()
    if name == "corners":
        assert (expected == 0).sum() > 100
    if name == "gaussian":
        assert expected.max() / expected.min() > 6, "a flat profile would be noticed"


def test_a_powell_lens_spreads_a_gaussian_beam_as_refraction_at_its_surface_does(thesis):
    laser = altered(thesis, {"laser": {"fan_profile": "powell"}}).laser
    angle, power = np.array(laser.fan_table()).T
    # Rays of a Gaussian beam through a glass cylinder with a hyperbolic face, so flat that small angles hold. The
    # conic constant and the curvature only scale the angles; the height is in units of the vertex radius.
    flat, glass = 1e-3, 1.5
    height = math.sqrt(4 / 3 * 1.7) * stats.norm.ppf((np.arange(400_000) + 0.5) / 400_000) / 2
    surface = flat * np.sqrt(1 + height**2)
    incidence = np.arctan(np.gradient(surface, height))
    behind = np.arcsin(glass * np.sin(incidence - np.arcsin(np.sin(incidence) / glass)))
    edge = math.asin(glass * math.sin(math.atan(flat) - math.asin(math.sin(math.atan(flat)) / glass)))
    counts, ends = np.histogram(behind / edge, bins=40, range=(-1, 1))
    below = np.concatenate([[0.0], np.cumsum(0.5 * (power[1:] + power[:-1]) * np.diff(angle))])
    expected = np.diff(np.interp(22.5 * ends, angle, below / below[-1]))
    # Linear interpolation in the table: 1 % of the power in the middle.
    np.testing.assert_allclose(counts / counts.sum(), expected, rtol=0, atol=1e-2 / 40)
    assert power.max() / power[48] == pytest.approx(1.195, abs=2e-3)
    assert abs(angle[power.argmax()]) == pytest.approx(22.5 * math.sqrt(1 - 1 / 1.7), abs=0.5)


LOBES = ((0.0, 20.0, 0.05), (3.0, 1.2, 0.02), (-4.0, 0.8, 0.01))


def test_side_lobes_have_their_power_at_their_places(thesis):
    plain, lobed = (Sheet(altered(thesis, {"laser": {"side_lobes": lobes}}), WATER) for lobes in ((), LOBES))
    for z in DEPTHS:
        sigma = light_at(plain, middle(plain, np.zeros(1), z))["sigma_mm"][0]
        x = sigma * np.linspace(-200, 200, 16001)
        points = np.stack([x, 0 * x, np.full_like(x, z)], axis=1)
        main, seen = (light_at(each, points)["irradiance"] for each in (plain, lobed))
        # The radius is two standard deviations; each lobe is a normal density with its share of the main sheet's sum.
        t = x / sigma
        density = 0.92 * stats.norm.pdf(t) + sum(f * stats.norm.pdf(t, 2 * at, r) for at, r, f in LOBES)
        np.testing.assert_allclose(seen, main.sum() * density / density.sum(), rtol=1e-3, atol=1e-6 * main.max())
        assert seen.sum() == pytest.approx(main.sum(), rel=1e-4)
    assert lobed.power_w == plain.power_w and plain.reach == 1.0 and lobed.reach == 20.0


def test_a_cut_beam_has_its_first_side_lobes_where_diffraction_puts_them(thesis):
    built = as_built(thesis, Flaws.parse("side-lobes=0.01", "stray-light")).laser.side_lobes
    assert built[0] == (0.0, 30.0, 0.02) and [lobe[2] for lobe in built[1:]] == [0.005, 0.005]
    x, k = np.linspace(-1, 1, 4001), np.linspace(0, 9, 1801)
    for cut, each in ((0.8, 0.0079), (1.0, 0.0034)):
        field = np.cos(k[:, None] * x) @ np.exp(-np.square(cut * x))
        radius = k[np.argmax(field**2 < math.exp(-2) * field[0] ** 2)]
        first, second = np.flatnonzero(np.diff(np.sign(field)))[:2]
        light, place = field[first:second] ** 2, k[first:second] / radius
        centre = (light * place).sum() / light.sum()
        assert centre == pytest.approx(built[2][0], abs=0.05)
        spread = 2 * math.sqrt((light * (place - centre) ** 2).sum() / light.sum())
        assert spread == pytest.approx(built[2][1], abs=0.05)
        assert light.sum() / (2 * (field**2).sum()) == pytest.approx(each, rel=0.03)


def test_side_lobes_appear_beside_the_stripe(thesis):
    wide = altered(cropped(thesis, 32, 400), {"laser": {"waist_radius_mm": 0.6, "side_lobes": [[8.0, 1.0, 0.1]]}})
    plain = altered(wide, {"laser": {"side_lobes": []}})
    renderers = [Renderer(each, WATER, scene_of(plate()), effects=NONE) for each in (plain, wide)]
    frames = [each.laser_frame(sensor_at(), spp=16) for each in renderers]
    truths = [measure_line_light(each, sensor_at(), find_true_stripe(each, sensor_at()), spp=16) for each in renderers]
    for name in ("centre_px", "centroid_px", "visible_fraction", "mixed_fraction"):
        np.testing.assert_allclose(*(getattr(truth, name) for truth in truths), atol=1e-5, err_msg=name)
    first, second = (frame.direct().astype(float).sum(axis=1) for frame in frames)
    place = np.arange(400)
    centre = (place * first).sum() / first.sum()
    # Offset by 8 radii of 0.6 mm towards the normal: least time shows where, to a tenth of a pixel.
    points = np.array([[0.0, 0.0, 0.0], [4.8, 0.0, 0.0]])
    v = seen_at(wide, WATER, points)[:, 1]
    beside = np.abs(place - (centre + v[1] - v[0])) < 15
    assert second.sum() == pytest.approx(first.sum(), rel=0.02)
    assert second[beside].sum() == pytest.approx(0.1 * first.sum(), rel=0.03)
    assert (place * second)[beside].sum() / second[beside].sum() == pytest.approx(centre + v[1] - v[0], abs=0.2)
    assert first[beside].sum() == 0


# --- rays drawn from it ----------------------------------------------------------------------------------------------


def test_a_table_is_drawn_from_by_the_inverse_of_its_integral():
    nodes, density = np.linspace(-2.0, 4.0, 7), np.array([0.0, 3.0, 1.0, 0.0, 0.0, 2.0, 5.0])
    table = PowerTable(nodes, density, power_w=0.02)
    u = (np.arange(4001) + 0.5) / 4001
    x = table.draw(to_jit(u)).numpy().astype(float)
    # The integral of each cell's straight line, up to x, by Simpson's rule, which is exact for it.
    cell = np.clip((x + 2).astype(int), 0, 5)
    part = x - nodes[cell]
    here = np.interp(x, nodes, density)
    before = np.concatenate([[0.0], np.cumsum(0.5 * (density[1:] + density[:-1]))])
    below = before[cell] + part * 0.5 * (density[cell] + here)
    # Roundings of 1e-7 in u and of 2e-7 in x, where the density is up to 5 / 8.5 of the total.
    np.testing.assert_allclose(below / before[-1], u, rtol=0, atol=1e-6)
    assert not ((x > 1) & (x < 2)).any(), "nothing where there is no power"
    grid = np.linspace(-3, 5, 801)
    expected = 0.02 * np.interp(grid, nodes, density, left=0.0, right=0.0) / before[-1]
    np.testing.assert_allclose(table.evaluate(to_jit(grid)).numpy(), expected, rtol=0, atol=2e-8)


def drawn(sheet: Sheet, count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Origins and directions (N, 3) of rays drawn from the sheet."""
    u = np.random.default_rng(seed).random((3, count), dtype=np.float32)
    origin, direction = sheet.sample(mi.Point3f(*[to_jit(column) for column in u]))
    dr.eval(origin, direction)
    return to_numpy(origin).astype(float), to_numpy(direction).astype(float)


FOCUSED = {"waist_radius_mm": 0.06, "waist_distance_mm": 430.0}


@pytest.mark.parametrize("name", ["gaussian", "corners", "tilted", "twisted", "hollow"])
def test_rays_are_spread_as_the_irradiance_says(thesis, name):
    """Count a million rays in 60 strips along Y and 12 intervals of equal probability across, in three planes."""
    sensor = altered(thesis, {"laser": LASERS[name] | FOCUSED})
    sheet = Sheet(sensor, WATER)
    origin, direction = drawn(sheet, 1_000_000, 1)
    np.testing.assert_allclose(np.linalg.norm(direction, axis=1), 1.0, rtol=0, atol=1e-6)
    widths = []
    for z in DEPTHS:
        points = origin + direction * ((z - origin[:, 2:]) / direction[:, 2:])
        light = light_at(sheet, points)
        widths.append(np.median(light["sigma_mm"]))
        across = light["distance_mm"] / light["sigma_mm"]
        # The mean of a million unit normal numbers scatters by 1e-3, their variance by 1.4e-3, their fourth moment by
        # 1e-2: five times that. Roundings of 3e-5 mm are 1e-3 of the thinnest sigma.
        assert abs(across.mean()) < 6e-3
        assert (across**2).mean() == pytest.approx(1.0, abs=7e-3)
        assert (across**4).mean() == pytest.approx(3.0, abs=5e-2)
        low, high = fan_edges(sheet, z)
        fine = low + (high - low) * (np.arange(6000) + 0.5) / 6000
        share = power_per_mm(sheet, fine, z).reshape(60, 100).sum(axis=1) * (high - low) / 6000 / sheet.power_w
        strip = np.clip((points[:, 1] - low) / (high - low) * 60, 0, 59).astype(int)
        part = np.minimum(stats.norm.cdf(across) * 12, 11).astype(int)
        counts = np.bincount(strip * 12 + part, minlength=720)
        expected = np.repeat(share / share.sum(), 12) / 12 * len(points)
        assert counts[expected < 1].sum() <= 5, "rays in the dark, apart from strips cut by a corner"
        filled = expected > 20
        assert filled.sum() > 500
        chi2 = ((counts[filled] - expected[filled]) ** 2 / expected[filled]).sum()
        # Fifteen such tests: each may fail by chance once in 1e5.
        assert chi2 < stats.chi2.isf(1e-5, filled.sum() - 1)
        assert abs(light["direction"] - direction).max() < 0.05
    assert max(widths) / min(widths) > 2, "the sheet is focused between the planes"


def test_rays_leave_the_windows_outer_face(thesis):
    sensor = altered(thesis, {"laser": TWISTED | FOCUSED})
    origin, _ = drawn(Sheet(sensor, WATER), 10_000, 2)
    outer = oracle_window(sensor.laser.window, WATER)[0][1]
    height = (origin - laser_origin(sensor) - outer.point) @ outer.normal
    # A ray leaves where its fan ray does, a micrometre behind the face, but beside it along X: on a face tilted by
    # 10 deg six sigmas of 0.67 mm, 370 mm before the waist, are up to 0.7 mm away from it, the mean is not. One of the
    # 10,000 rays is farther off by chance once in 50,000.
    assert np.abs(height).max() < 0.7
    assert abs(np.mean(height)) < 5 * 0.67 * math.sin(math.radians(10)) / math.sqrt(10_000) + 2e-3


def test_the_numbers_0_and_almost_1_give_rays(thesis):
    for name in ("flat", "corners"):
        sheet = Sheet(altered(thesis, {"laser": LASERS[name]}), WATER)
        ends = np.array([0.0, 0.5, 1 - 2**-24])
        u = np.stack(np.meshgrid(ends, ends, ends), axis=-1).reshape(-1, 3)
        origin, direction = map(to_numpy, sheet.sample(mi.Point3f(*[to_jit(column) for column in u.T])))
        assert np.isfinite(origin).all()
        assert np.isfinite(direction).all()
        assert np.ptp(direction[:, 1]) > 0.4, "the fan's two edges"


def test_a_waist_at_the_origin_of_a_bare_fan_gives_rays(thesis):
    # All rays of the fan meet there, and the normal of the surface is undefined.
    sensor = altered(thesis, {"laser": {"waist_distance_mm": 1e-6, "window": {"mounted": False}}})
    u = mi.Point3f(*(to_jit(np.linspace(0.01, 0.99, 50)) for _ in range(3)))
    origin, direction = map(to_numpy, Sheet(sensor, Medium(kind="air")).sample(u))
    assert np.isfinite(origin).all()
    np.testing.assert_allclose(np.linalg.norm(direction, axis=1), 1.0, atol=1e-6)


def test_what_is_not_a_point_gets_no_light(thesis):
    points = np.array([[math.nan] * 3, [0.0, math.inf, 0.0], [0.0, -math.inf, 0.0], [0.0, 0.0, -1e9]])
    irradiance = light_at(Sheet(thesis, WATER), points)["irradiance"]
    assert not (irradiance > 0).any()


def test_frames_after_the_first_compile_nothing(thesis):
    def frame(count: int) -> int:
        dr.kernel_history()
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            origin, direction = drawn(sheet, count, count)
            light_at(sheet, origin + 400.0 * direction)
            launched = dr.kernel_history((dr.KernelType.JIT,))
        assert len(launched) >= 2
        return sum(not kernel["cache_hit"] or bool(kernel["cache_disk"]) for kernel in launched)

    # No other test has left these kernels in memory.
    dr.flush_kernel_cache()
    sheet = Sheet(altered(thesis, {"laser": LASERS["twisted"]}), WATER)
    assert frame(1000) >= 2
    assert [frame(count) for count in (1000, 1500, 40_000)] == [0, 0, 0]


# --- further lasers --------------------------------------------------------------------------------------------------


def in_camera_frame(sensor: Sensor, points: np.ndarray) -> dict[str, np.ndarray]:
    """The light of the sensor's own laser at points (N, 3) of the camera frame."""
    to_object = np.linalg.inv(camera_from_object(sensor))
    return light_at(Sheet(sensor, WATER), points @ to_object[:3, :3].T + to_object[:3, 3])


def placed(sensor: Sensor, origin: tuple[float, ...], axis: tuple[float, ...], **rest: object) -> Sensor:
    """The sensor with its laser elsewhere, exchanged as the renderer does for further lasers."""
    moved = {"baseline_mm": None, "triangulation_angle_deg": None, "origin_mm": origin, "axis": axis}
    laser = Laser.model_validate(sensor.laser.model_dump() | moved | rest)
    return sensor.model_copy(update={"laser": laser})


def points_about(sensor: Sensor) -> np.ndarray:
    """Points (N, 3) of the camera frame in and beside the sheet."""
    pose = camera_from_object(sensor)
    grid = np.meshgrid([-0.1, 0.0, 0.2], np.linspace(-90, 90, 19), np.linspace(-100, 100, 9))
    return np.stack([g.ravel() for g in grid], axis=1) @ pose[:3, :3].T + pose[:3, 3]


def test_a_laser_on_the_other_side_of_the_camera_gives_the_mirror_image(thesis):
    sine, cosine = math.sin(math.radians(35)), math.cos(math.radians(35))
    across = placed(thesis, (0.0, 265.0, 0.0), (0.0, -sine, cosine), fan_profile="gaussian")
    here = altered(thesis, {"laser": {"fan_profile": "gaussian"}})
    points = points_about(here)
    seen, mirrored = in_camera_frame(here, points), in_camera_frame(across, points * [1, -1, 1])
    lit = seen["irradiance"] > 0.01 * seen["irradiance"].max()
    assert lit.sum() > 200
    # 3e-5 mm of rounding are 3e-4 of the thinnest sigma; the flank at two sigmas makes twice that of it.
    np.testing.assert_allclose(mirrored["irradiance"][lit], seen["irradiance"][lit], rtol=2e-3)


@pytest.mark.parametrize("roll", [90.0, -90.0])
def test_a_laser_beside_the_camera_rolled_by_a_right_angle_lights_the_other_image_side(thesis, roll):
    sine, cosine = math.sin(math.radians(35)), math.cos(math.radians(35))
    beside = placed(thesis, (265.0, 0.0, 0.0), (-sine, 0.0, cosine), roll_deg=roll)
    upright = altered(thesis, {"camera": {"stripe_along": "height"}})
    points = points_about(upright)
    seen, rolled = in_camera_frame(upright, points), in_camera_frame(beside, points)
    lit = seen["irradiance"] > 0.01 * seen["irradiance"].max()
    assert lit.sum() > 200
    np.testing.assert_allclose(rolled["irradiance"][lit], seen["irradiance"][lit], rtol=2e-3)
    np.testing.assert_allclose(np.abs(rolled["distance_mm"]), np.abs(seen["distance_mm"]), rtol=0, atol=2e-4)
