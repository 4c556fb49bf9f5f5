"""Daylight under waves: statistics of the surface, focusing by one wave in closed form, motion, and images."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d

from tests.virtual_sensors import altered, clear, plate, scene_of, sensor_at
from twin.light.illumination import CELLS, PATCH_MM, Caustics, angular_frequency, focus_light, slope_variance_per_octave
from twin.light.renderer import Renderer
from twin.recording.sensor_simulator import SensorSimulator
from twin.rendering_options import NONE, Flaws, Options
from uwlts.model.sensor import Sensor

INDEX = 1.3312


def water_surface(**changes: float) -> Caustics:
    values = {"wind_m_s": 2.0, "depth_mm": 150.0, "index": INDEX, "scattering_per_mm": 0.0, "seed": 0}
    return Caustics(**values | changes)


def test_slopes_are_those_of_a_sea_in_the_wind():
    # All waves of a wind of 2 m/s, from 17 mm to 2 pi U^2 / (0.877^2 g) = 3.33 m, are 7.6 octaves with 0.01324.
    assert slope_variance_per_octave(2.0) == pytest.approx(0.01324 / math.log2(3331 / 17), rel=1e-3)
    found, curvature = [], []
    for seed in range(4):
        along, across = water_surface(depth_mm=100.0, seed=seed).slopes(0.3)
        found.append(along.var() + across.var())
        step = PATCH_MM / CELLS
        bend = (np.roll(along, -1, 1) - np.roll(along, 1, 1) + np.roll(across, -1, 0) - np.roll(across, 1, 0)) / (
            2 * step
        )
        curvature.append(bend.std())
    # A variance v per ln k is v / (2 pi k^2) per area of the plane of wave numbers. Each wave of the patch has a cell
    # of this plane. Few waves are long: four surfaces know the variance to 6 %. The limit is three times that.
    number = np.arange(-31, 32)
    squares = np.add.outer(number**2, number**2)
    per_ln = slope_variance_per_octave(2.0) / math.log(2)
    expected = per_ln / (2 * math.pi) * (1 / squares[(squares > 0) & (squares <= (PATCH_MM / 17.0) ** 2)]).sum()
    assert expected == pytest.approx(per_ln * math.log(PATCH_MM / 17.0), rel=0.2)
    assert np.mean(found) == pytest.approx(expected, rel=0.18)
    # With v per ln k the mean square curvature is v (k1^2 - k0^2) / 2; differences over 1 mm lose 1 % of it.
    largest, smallest = 2 * math.pi / 17.0, 2 * math.pi / PATCH_MM
    square = per_ln * (largest**2 - smallest**2) / 2
    assert np.mean(curvature) == pytest.approx(math.sqrt(square), rel=0.05)


def test_the_slowest_waves_run_at_23_cm_per_s():
    number = 2 * math.pi / np.geomspace(5.0, 500.0, 2001)
    speed = angular_frequency(number) / number
    assert speed.min() == pytest.approx(231.0, abs=2.0)  # Lamb, Hydrodynamics, Sec. 267: 23.1 cm/s at 1.73 cm
    assert 2 * math.pi / number[speed.argmin()] == pytest.approx(17.2, abs=0.4)
    assert speed[-1] == pytest.approx(math.sqrt(9810.0 * 500.0 / (2 * math.pi)), rel=2e-3)


@pytest.mark.parametrize("part", [0.3, 0.7, 0.9])
def test_one_wave_focuses_light_as_a_row_of_lenses(part):
    waves, slope = 4, 0.02
    k = 2 * math.pi * waves / PATCH_MM
    x = np.arange(CELLS) * PATCH_MM / CELLS
    # A crest of the curvature slope k focuses at n / ((n - 1) slope k).
    focus = INDEX / ((INDEX - 1) * slope * k)
    along = np.broadcast_to(slope * np.cos(k * x), (CELLS, CELLS))
    light = focus_light(along, np.zeros((CELLS, CELLS)), depth_mm=part * focus, index=INDEX)
    assert light.mean() == pytest.approx(1.0, abs=1e-12)
    np.testing.assert_allclose(light, light[:1].repeat(CELLS, axis=0), atol=1e-9)
    # Rays that spread leave gaps, which a Gaussian of 2.5 cells fills.
    seen = gaussian_filter1d(light[0], 2.5, mode="wrap")
    # A ray at x meets the plane at x - d cos(k x) / k with d = part: the light is 1 / (1 + d sin(k x)).
    places = x - part * np.cos(k * x) / k
    expected = np.interp(x, np.sort(places), 1 / (1 + part * np.sin(k * x))[np.argsort(places)], period=PATCH_MM)
    # It is a twentieth of the wave's radian, and blunts crests of a few cells.
    away = expected < 1.5
    np.testing.assert_allclose(seen[away], expected[away], rtol=0.03)
    assert seen.max() == pytest.approx(gaussian_filter1d(expected, 2.5, mode="wrap").max(), rel=0.03)


def test_little_depth_shows_the_curvature_and_depth_makes_filaments():
    shallow = water_surface(depth_mm=20.0)
    along, across = shallow.slopes(0.0)
    step = 2 * PATCH_MM / CELLS
    bend = (np.roll(along, -1, 1) - np.roll(along, 1, 1) + np.roll(across, -1, 0) - np.roll(across, 1, 0)) / step
    light = shallow.pattern(0.0)
    assert light.mean() == pytest.approx(1.0, abs=1e-5)
    # To first order the light is 1 + 0.9 d (1 - 1 / n) times the curvature.
    first_order = 0.9 * 20.0 * (1 - 1 / INDEX) * bend
    assert np.corrcoef(light.ravel(), first_order.ravel())[0, 1] > 0.97
    assert light.std() == pytest.approx(first_order.std(), rel=0.1)
    deep = water_surface(depth_mm=150.0).pattern(0.0)
    skewness = ((deep - 1) ** 3).mean() / deep.std() ** 3
    # Filaments: few bright places on a dim ground, unlike the symmetrical curvature.
    assert skewness > 1.0 and deep.max() > 3.0 and (deep > 2).mean() < 0.15
    murky = water_surface(depth_mm=150.0, scattering_per_mm=5e-3).pattern(0.0)
    np.testing.assert_allclose(murky - 1, math.exp(-0.75) * (deep - 1), atol=1e-4)


def test_the_pattern_moves_and_exposures_blur_it():
    surface = water_surface(depth_mm=150.0, seed=3)
    still = surface.pattern(1.0)
    np.testing.assert_array_equal(still, water_surface(depth_mm=150.0, seed=3).pattern(1.0))

    def correlation(other: np.ndarray) -> float:
        return float(np.corrcoef(still.ravel(), other.ravel())[0, 1])

    early, late = correlation(surface.pattern(1.002)), correlation(surface.pattern(1.2))
    assert early > 0.8 and abs(late) < 0.2 < early
    assert surface.pattern(1.0, 0.02).std() < 0.95 * still.std()
    # The wind blows along X: the pattern runs that way by some 2 mm in 8 ms.
    moved = np.fft.rfft2(surface.pattern(1.008)) * np.conj(np.fft.rfft2(still))
    peak = np.unravel_index(np.fft.irfft2(moved, still.shape).argmax(), still.shape)
    assert 1 <= peak[1] <= 10 and (peak[0] < 5 or peak[0] > CELLS - 5)


@pytest.fixture(scope="module")
def sensor(thesis: Sensor) -> Sensor:
    camera = {"width_px": 320, "height_px": 256, "pixel_size_um": 21.2}
    return altered(thesis, {"camera": camera, "lamp": {"ambient_w_per_m2": 20.0}, "exposure": {"laser_ms": 5.0}})


def test_images_show_the_pattern_on_surfaces_by_day_alone(sensor):
    surface, scene = water_surface(depth_mm=300.0), scene_of(plate(side=400.0), depth_m=0.3)
    day = replace(NONE, ambient=True)
    even, focused = (Renderer(sensor, clear(), scene, effects=day, flaws=Flaws(caustics=wind)) for wind in (0.0, 2.0))
    plain, seen = (each.irradiance("day", sensor_at(), spp=4) for each in (even, focused))
    inside = plain > 0.5 * plain.max()
    assert inside.mean() > 0.5
    share, pattern = seen[inside] / plain[inside], surface.pattern(0.0)
    # A pixel of 0.9 mm averages the filaments. The view shows a tenth of the patch.
    assert share.mean() == pytest.approx(1.0, abs=0.1)
    assert 0.7 * pattern.std() < share.std() < 1.2 * pattern.std()
    later = focused.irradiance("day", sensor_at(), spp=4, time_s=0.5)
    assert np.corrcoef(later[inside], seen[inside])[0, 1] < 0.5
    lamps = [each.irradiance("lamp", sensor_at(), spp=4) for each in (even, focused)]
    np.testing.assert_array_equal(*lamps)


def test_a_scan_takes_its_waves_from_wind_depth_and_time(sensor):
    scene = scene_of(plate(side=400.0), depth_m=0.3, motion={"count": 2})
    effects = replace(NONE, ambient=True)
    windy, calm = (
        SensorSimulator(sensor, scene, Options(effects=effects, flaws=Flaws.parse(*names), seed=5))
        for names in (["caustics=2"], [])
    )
    shots = list(scene.motion.shots())
    first, second = (windy.light(shot, index)[0] for index, shot in enumerate(shots))
    plain = calm.light(shots[0], 0)[0]
    water = {"index": windy.medium.refractive_index(635.0)}
    water["scattering_per_mm"] = windy.medium.scattering_per_mm(635.0)
    surface = water_surface(depth_mm=300.0, seed=5, **water)
    lit = plain > 0.5 * plain.max()
    renderer = Renderer(sensor, windy.medium, scene, effects=effects)
    renderer._caustics = surface
    expected = renderer.irradiance("day", windy.pose(shots[0]), spp=16, exposure_s=5e-3)
    np.testing.assert_allclose(first, expected, rtol=1e-5)
    assert first[lit].std() > 0.1 * first[lit].mean() > plain[lit].std()
    assert np.corrcoef(first[lit], second[lit])[0, 1] < 0.5
