"""Light that the water scatters once out of the sheet, against quadrature along camera rays in float64."""

import math
from dataclasses import replace

import numpy as np
import pytest

from tests.oracles import fermat
from tests.virtual_sensors import (
    altered,
    block,
    camera_axes,
    clear,
    cropped,
    extinction,
    gauss_legendre,
    laser_origin,
    lens_factor,
    oracle_fan,
    oracle_paths,
    oracle_window,
    plate,
    scene_of,
    sensor_at,
)
from twin.backend.arrays import to_jit
from twin.light.image_sampling import NODE_SPACING_PX
from twin.light.renderer import Renderer
from twin.light.water import Scattering
from twin.rendering_options import NONE
from uwlts.model.sensor import Medium, Sensor

TURBID = {
    "molecular": clear(0.3, 1.0),
    "forward": clear(0.5, 2.0, phase="henyey-greenstein", asymmetry=0.9),
    "backward": clear(0.0, 0.7, phase="henyey-greenstein", asymmetry=-0.4),
}
ONCE = replace(NONE, haze=True)
FAR_AWAY = plate(5000.0)


def scattered_per_sr(medium: Medium, cosine: np.ndarray) -> np.ndarray:
    """Phase function in 1/sr, from its definition as a shape that is then normalised numerically.

    Molecules scatter as 1 + (1 - d) / (1 + d) cos^2 with the depolarisation ratio d = 0.039. Henyey and Greenstein's
    is the Poisson kernel's generating function, the sum of (2 l + 1) g^l P_l(cos) over 4 pi.
    """
    if medium.phase == "henyey-greenstein":
        orders = np.arange(400)
        series = (2 * orders + 1) * medium.asymmetry**orders
        return np.polynomial.legendre.legval(cosine, series) / (4 * math.pi)
    nodes, weights = gauss_legendre(-1, 1, 8)

    def shape(x: np.ndarray) -> np.ndarray:
        return 1 + (1 - 0.039) / (1 + 0.039) * x**2

    return shape(cosine) / (2 * math.pi * (weights @ shape(nodes)))


@pytest.mark.parametrize("name", TURBID)
def test_phase_functions_scatter_everything_once(name):
    medium = TURBID[name]
    nodes, weights = gauss_legendre(-1, 1, 100)
    value = Scattering(medium, 635.0).phase(to_jit(1 - nodes)).numpy().astype(float)
    # The table's logarithm is linear over steps of 0.0088 of a function whose second derivative is below 0.5: 5e-6.
    # 32 bits leave 1e-6 of the logarithm and, at g = -0.4 backwards, 1e-5 of 1 + cos.
    assert 2 * math.pi * weights @ value == pytest.approx(1.0, abs=2e-5)
    np.testing.assert_allclose(value, scattered_per_sr(medium, nodes), rtol=4e-5)
    mean_cosine = 2 * math.pi * weights @ (nodes * value)
    assert mean_cosine == pytest.approx(medium.asymmetry if medium.phase else 0.0, abs=2e-5)


def camera_rays(sensor: Sensor, medium: Medium, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Directions at the pupil (N, 3), where rays leave the window (N, 3) and where they run (N, 3) in the OCS.

    They are found by least time to the points of the sheet's middle plane that the image points (N, 2) show.
    """
    axes, standoff = camera_axes(sensor)
    focal, centre = sensor.camera.focal_length_px(), sensor.camera.principal_point()
    rays = np.concatenate([(pixels - centre) / focal, np.ones((len(pixels), 1))], axis=1)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    middle = fermat.Face(standoff, axes[:, 0])
    guess = rays * ((standoff @ middle.normal) / (rays @ middle.normal))[:, None]
    seen = fermat.points_seen_on_plane(rays, middle, guess, *oracle_window(sensor.camera.window, medium))
    points = (seen - standoff) @ axes
    directions, origins, way = oracle_paths(sensor, medium, points)
    return directions, origins, (points - origins) / way[:, None]


def scattered_once(
    sensor: Sensor, medium: Medium, origins: np.ndarray, directions: np.ndarray, end: np.ndarray | float
) -> np.ndarray:
    """Radiance (N,) scattered once into rays up to the length ``end``: the integral of b p E exp(-c s) over s."""
    fan, source = oracle_fan(sensor, medium), laser_origin(sensor)
    crossing = -origins[:, 0] / directions[:, 0]
    reach = 8 * 0.2 / np.abs(directions[:, 0])  # the sheet's standard deviation stays below 0.2 mm
    last = np.minimum(crossing + reach, end)
    nodes, weights = gauss_legendre(0, 1, 60)
    span = np.maximum(last - (crossing - reach), 0.0)
    s = (crossing - reach)[:, None] + span[:, None] * nodes
    p = origins[:, None] + s[..., None] * directions[:, None] - source
    irradiance = fan.irradiance(p[..., 0], p[..., 1], p[..., 2])
    slope = fan.slopes(fan.angle_through(p[..., 1], p[..., 2]))[2]
    light = np.stack([0 * slope, slope, np.ones_like(slope)], axis=-1) / np.hypot(1, slope)[..., None]
    cosine = -np.einsum("nsi,ni->ns", light, directions)
    integrand = scattered_per_sr(medium, cosine) * irradiance * np.exp(-extinction(medium) * s)
    return medium.scattering_per_mm(635.0) * span * (integrand @ weights)


def nodes_about(cells: np.ndarray) -> np.ndarray:
    """Image points (4 N, 2) of the corners of the renderer's grid cells (N, 2)."""
    corners = np.array([(0, 0), (0, 1), (1, 0), (1, 1)])
    return (NODE_SPACING_PX * (cells[:, None] + corners) - 0.5).reshape(-1, 2).astype(float)


def expected_haze(sensor: Sensor, medium: Medium, cells: np.ndarray, *, plate_z: float | None = None) -> np.ndarray:
    """Irradiance (N,) of the haze in grid cells (N, 2), the mean of their corners as the renderer takes it."""
    rays, origins, directions = camera_rays(sensor, medium, nodes_about(cells))
    end = math.inf if plate_z is None else (plate_z - origins[:, 2]) / directions[:, 2]
    radiance = scattered_once(sensor, medium, origins, directions, end)
    return (radiance * lens_factor(sensor, medium, rays)).reshape(-1, 4).mean(axis=1)


def coarse(thesis: Sensor) -> Sensor:
    """The thesis's view in 320 x 256 pixels."""
    return altered(thesis, {"camera": {"width_px": 320, "height_px": 256, "pixel_size_um": 21.2}})


@pytest.mark.parametrize("name", TURBID)
def test_haze_is_the_scattering_integral_along_camera_rays(thesis, name):
    sensor, medium = coarse(thesis), TURBID[name]
    image = Renderer(sensor, medium, scene_of(FAR_AWAY), effects=ONCE).laser_frame(sensor_at(), spp=1).irradiance()
    columns, rows = (g.ravel() for g in np.meshgrid(np.arange(25, 140, 19), np.arange(2, 126, 17)))
    cells = np.stack([columns, rows], axis=1)
    found = image[NODE_SPACING_PX * rows, NODE_SPACING_PX * columns]
    expected = expected_haze(sensor, medium, cells)
    assert (expected > 0).sum() > 40
    # The closed form takes light and distance where the ray crosses the sheet's middle; over the sheet's 0.15 mm they
    # change by 1e-3 evenly, which leaves 1e-6, and 32 bits leave 1e-5 of the phase function.
    np.testing.assert_allclose(found, expected, rtol=2e-4, atol=1e-6 * expected.max())
    assert expected.max() / expected[expected > 0].min() > 1.2, "an even haze would be noticed"


def test_haze_ends_at_a_surface(thesis):
    sensor, medium = cropped(thesis, 32, 64), TURBID["molecular"]
    free = Renderer(sensor, medium, scene_of(FAR_AWAY), effects=ONCE).laser_frame(sensor_at(), spp=1).irradiance()
    cut = (
        Renderer(sensor, medium, scene_of(plate(reflectance=0.0)), effects=ONCE)
        .laser_frame(sensor_at(), spp=1)
        .irradiance()
    )
    rows = np.arange(64 // NODE_SPACING_PX)
    cells = np.stack([np.full_like(rows, 8), rows], axis=1)
    expected = expected_haze(sensor, medium, cells, plate_z=0.0)
    whole = expected_haze(sensor, medium, cells)
    share = expected / whole
    assert ((share > 0.05) & (share < 0.95)).sum() >= 2, "some cells see a part of the sheet's width"
    assert share.min() < 1e-6
    assert share.max() > 1 - 1e-6
    # The corner of a cell is known to 1e-4 mm, 1e-3 of the sheet's standard deviation.
    np.testing.assert_allclose(cut[::NODE_SPACING_PX, 16] / free[::NODE_SPACING_PX, 16], share, rtol=0, atol=1e-3)


@pytest.mark.parametrize("pose", [sensor_at(), sensor_at(-35.0, x=60.0)], ids=["at home", "moved"])
def test_there_is_no_haze_in_an_objects_shadow(thesis, pose):
    sensor, medium = coarse(thesis), TURBID["molecular"]
    position = pose[:3, 3] + [0.0, 10.0, -30.0]
    free, shadowed = (
        Renderer(sensor, medium, scene_of(thing), effects=ONCE).laser_frame(pose, spp=1).irradiance()
        for thing in (FAR_AWAY, block((6.0, 40.0, 10.0), tuple(position)))
    )
    _, origins, directions = camera_rays(sensor, medium, nodes_about(np.array([(80, row) for row in range(128)])))
    z = (origins - (origins[:, :1] / directions[:, :1]) * directions)[:, 2].reshape(-1, 4)
    # In the image's middle column the fan's rays run along Z. The camera sees them before the block's upper face at
    # Z = -35 mm, then the block, then, past its lower edge, the shadow behind it.
    before, behind = z.max(axis=1) < -36.0, z.min(axis=1) > 0.0
    assert before.sum() > 20
    assert behind.sum() > 20
    np.testing.assert_allclose(shadowed[::2, 160][before], free[::2, 160][before], rtol=1e-5)
    assert (shadowed[::2, 160][behind] == 0).all()
    assert (free[::2, 160][behind] > 0).all()
    np.testing.assert_allclose(shadowed[::2, 290], free[::2, 290], rtol=1e-5)
