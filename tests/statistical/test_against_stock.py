"""The twin against Mitsuba's own integrators, in absolute units: the same scenes, rendered here and now by both.

Every image is rendered in several independent runs, so that blocks of pixels have a mean and a standard error; their
differences are tested one by one and together. Where the twin takes no random numbers its runs are all the same.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from scipy import stats

from tests.stock_mitsuba import blocks, fog, opened_from_its_origin, per_radiance, stock_irradiance
from tests.virtual_sensors import altered, camera_axes, laser_origin, plate, scene_of, sensor_at
from twin.effects import ALL
from twin.renderer import WALK_CELL_PX, Renderer
from twin.scene import Scene
from uwlts.sensor import Medium, Sensor

BLOCK_PX = WALK_CELL_PX
"""The twin's own cells of smooth light away from the stripe: blocks of this size are what it computes there."""
SIGMA_DEG, FAN_DEG = 0.5, 35.0
CLEAR = fog(absorption_per_m=0.0, scattering_per_m=0.0)
SINGLY = ("multiple-scattering", "secondary-light")
SMALLEST_P = 1e-4
"""Agreement is refused where chance alone would part two equal images further only once in 10^4 times."""
LARGEST_Z = -stats.norm.ppf(SMALLEST_P / 2)


@pytest.fixture(scope="module")
def broad(thesis) -> Sensor:
    """A view of 100 mm in 128 x 128 pixels, and a sheet that is 4 mm (five pixels) wide in standard deviations."""
    camera = {"width_px": 128, "height_px": 128, "pixel_size_um": 25.6}
    return opened_from_its_origin(altered(thesis, {"camera": camera}), sigma_deg=SIGMA_DEG, fan_angle_deg=FAN_DEG)


def turbid(asymmetry: float) -> Medium:
    """Fog through which the light's way from laser to camera is 1.7 optical depths long."""
    return fog(absorption_per_m=0.5, scattering_per_m=1.5, phase="henyey-greenstein", asymmetry=asymmetry)


def twin_irradiance(
    sensor: Sensor, medium: Medium, scene: Scene, *without: str, spp: int, runs: int, pixel_px: int = BLOCK_PX
) -> np.ndarray:
    """Block means (runs, H, W) of the twin's image without defocus, which stock's pinhole has not, in W/mm2."""
    renderer = Renderer(sensor, medium, scene, effects=ALL.without("defocus", *without))
    images = (renderer.irradiance("laser", sensor_at(), spp=spp, seed=run) for run in range(runs))
    return np.stack([blocks(image, pixel_px) for image in images])


@dataclass(frozen=True)
class Comparison:
    """Twin against stock over a part of the image.

    ``z`` (N,) holds the blocks' differences in standard errors, ``total_z`` that of their sum, ``ratio`` the twin's sum
    over stock's with its standard error ``resolved``.
    """

    z: np.ndarray
    total_z: float
    ratio: float
    resolved: float

    def p_of_blocks(self) -> float:
        """How often blocks of equal images would differ by more."""
        return float(stats.chi2.sf(np.sum(self.z**2), len(self.z)))

    def agrees(self) -> bool:
        """Whether chance explains the differences of the blocks, and that of their sum."""
        return self.p_of_blocks() > SMALLEST_P and abs(self.total_z) < LARGEST_Z


def compared(twin: np.ndarray, stock: np.ndarray, part: np.ndarray) -> Comparison:
    """Compare runs (T, H, W) and (S, H, W) over a ``part`` (H, W) of the image."""
    a, b = twin[:, part], stock[:, part]
    total_a, total_b = a.sum(axis=1), b.sum(axis=1)
    error = math.hypot(*(math.sqrt(total.var(ddof=1) / len(total)) for total in (total_a, total_b)))
    total_z = float(welch(total_a[:, None], total_b[:, None])[0])
    return Comparison(welch(a, b), total_z, total_a.mean() / total_b.mean(), error / total_b.mean())


def welch(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Differences (N,) of the means of runs (K, N) and (L, N) as standard normal numbers (Welch 1947)."""
    parts = [runs.var(axis=0, ddof=1) / len(runs) for runs in (a, b)]
    variance = parts[0] + parts[1]
    freedom = variance**2 / sum(part**2 / (len(runs) - 1) for part, runs in zip(parts, (a, b), strict=True))
    t = (a.mean(axis=0) - b.mean(axis=0)) / np.sqrt(variance)
    return np.sign(t) * stats.norm.isf(stats.t.sf(np.abs(t), freedom))


def in_stripe(direct: np.ndarray) -> np.ndarray:
    """Blocks (H, W) with more than a hundredth of the brightest's light, well within the 4.5 sigma of the twin's."""
    return direct > 0.01 * direct.max()


def off_stripe(direct: np.ndarray) -> np.ndarray:
    """Blocks (H, W) that no light of the stripe comes to, and their neighbours neither.

    The twin renders the stripe to 4.5 standard deviations; stock goes on, with 4e-5 of the peak.
    """
    lit = direct > 1e-9 * direct.max()
    lit[1:] |= lit[:-1].copy()
    lit[:-1] |= lit[1:].copy()
    return ~lit


# --- stock's own scene -----------------------------------------------------------------------------------------------


def test_stock_shows_a_plate_as_its_closed_form_does(broad):
    sensor, reflectance, fine = broad, 0.6, 8
    axes, standoff = camera_axes(sensor)
    camera, (cx, cy) = sensor.camera, sensor.camera.principal_point()
    places = (np.arange(fine * 128) + 0.5) / fine - 0.5
    x, y = np.meshgrid((places - cx) / camera.focal_length_px(), (places - cy) / camera.focal_length_px())
    rays = np.stack([x, y, np.ones_like(x)], axis=-1) @ axes
    pupil = -axes.T @ standoff
    p = pupil - rays * (pupil[2] / rays[..., 2:]) - laser_origin(sensor)
    r, in_sheet, sigma = np.linalg.norm(p, axis=-1), np.hypot(p[..., 1], p[..., 2]), math.radians(SIGMA_DEG)
    # Power per angle along the fan and per angle across, over the area that the angles span on the plane Z = const.
    across = np.exp(-0.5 * (p[..., 0] / (sigma * r)) ** 2) / (math.sqrt(2 * math.pi) * sigma * r)
    arriving = 1e-3 * sensor.laser.power_mw / math.radians(FAN_DEG) * across * p[..., 2] / in_sheet**2
    expected = blocks(blocks(reflectance / math.pi * arriving, fine) * per_radiance(sensor), 4)
    scene = scene_of(plate(side=800.0, reflectance=reflectance))
    found = stock_irradiance(sensor, CLEAR, scene, integrator="path", max_depth=2, spp=512, runs=16, pixel_px=4)
    stripe = in_stripe(expected)
    part = compared(np.stack([expected, expected]), found, stripe)
    assert stripe.sum() > 200
    assert part.agrees(), part
    assert part.resolved < 3e-4


# --- direct light ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("rotation", [(0.0, 0.0, 0.0), (20.0, -15.0, 5.0)], ids=["square", "tilted"])
def test_direct_light_on_a_plate_is_stocks_pixel_by_pixel(broad, rotation):
    scene = scene_of(plate(side=800.0) | {"rotation_deg": rotation})
    stock = stock_irradiance(broad, CLEAR, scene, integrator="path", max_depth=2, spp=256, runs=16)
    twin = twin_irradiance(broad, CLEAR, scene, *SINGLY, spp=64, runs=2, pixel_px=1)
    stripe = in_stripe(twin[0])
    assert stripe.sum() > 3000
    part = compared(twin, stock, stripe)
    assert part.agrees(), part
    assert part.resolved < 3e-4


# --- scattered light ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "medium",
    [turbid(0.0), turbid(0.9), fog(absorption_per_m=0.5, scattering_per_m=1.5, phase="molecular")],
    ids=["even", "forward", "molecular"],
)
def test_light_scattered_once_is_stocks(broad, medium):
    scene = scene_of(plate(side=800.0))
    stock = stock_irradiance(
        broad, medium, scene, integrator="volpath", max_depth=2, spp=1024, runs=16, pixel_px=BLOCK_PX
    )
    twin = twin_irradiance(broad, medium, scene, *SINGLY, spp=64, runs=2)
    direct = twin_irradiance(broad, medium, scene, *SINGLY, "haze", spp=64, runs=2)[0]
    stripe, haze = in_stripe(direct), off_stripe(direct) & (twin[0] > 0)
    assert stripe.sum() >= 60
    assert haze.sum() >= 70
    for part in (compared(twin, stock, stripe), compared(twin, stock, haze)):
        assert part.agrees(), part
        assert part.resolved < 0.02
    assert (stock[:, off_stripe(direct) & (twin[0] == 0)] == 0).all(), "there is no haze behind the plate"


@pytest.mark.parametrize(("asymmetry", "spp"), [(0.0, 512), (0.5, 512)])
def test_light_scattered_any_number_of_times_is_stocks(broad, asymmetry, spp):
    scene, medium = scene_of(plate(side=800.0)), turbid(asymmetry)
    stock = stock_irradiance(
        broad, medium, scene, integrator="volpath", max_depth=-1, spp=spp, runs=32, pixel_px=BLOCK_PX
    )
    twin = twin_irradiance(broad, medium, scene, spp=32, runs=6)
    once = twin_irradiance(broad, medium, scene, *SINGLY, spp=32, runs=2)
    direct = twin_irradiance(broad, medium, scene, *SINGLY, "haze", spp=32, runs=2)[0]
    away = off_stripe(direct)
    before, behind = away & (once[0] > 0), away & (once[0] == 0)
    for part in (in_stripe(direct), before, behind):
        assert part.sum() >= 60
        found = compared(twin, stock, part)
        assert found.agrees(), found
        assert found.resolved < 0.02
        assert abs(compared(once, stock, part).total_z) > 10, "light scattered once alone would be noticed"


# --- light between surfaces --------------------------------------------------------------------------------------------


def groove(**finish: Any) -> Scene:
    """Two plates at right angles with their edge along X, 20 mm behind the stand-off."""
    half, length = math.sqrt(0.5), 100.0
    side = {"kind": "plate", "width_mm": 300.0, "height_mm": length} | finish
    return scene_of(*(
        side | {"position_mm": (0.0, sign * half * length / 2, 20.0 - half * length / 2), "rotation_deg": (-sign * 45, 0, 0)}
        for sign in (1, -1)
    ))  # fmt: skip


@pytest.mark.parametrize(
    "finish",
    [
        {"reflectance": 0.8},
        {"reflectance": 0.6, "finish": "painted"},
        {"reflectance": 0.9, "finish": "metal", "alpha": 0.4},
    ],
    ids=["diffuse", "painted", "metal"],
)
@pytest.mark.parametrize("integrator", ["path", "ptracer"])
def test_light_between_the_sides_of_a_groove_is_stocks(broad, finish, integrator):
    scene = groove(**finish)
    stock = stock_irradiance(
        broad, CLEAR, scene, integrator=integrator, max_depth=-1, spp=512, runs=32, pixel_px=BLOCK_PX
    )
    twin = twin_irradiance(broad, CLEAR, scene, spp=64, runs=6)
    direct = twin_irradiance(broad, CLEAR, scene, *SINGLY, spp=64, runs=2)
    for part in (in_stripe(direct[0]), off_stripe(direct[0])):
        assert part.sum() >= 60
        found = compared(twin, stock, part)
        assert found.agrees(), found
        assert found.resolved < 0.02
        assert abs(compared(direct, stock, part).total_z) > 10, "direct light alone would be noticed"
