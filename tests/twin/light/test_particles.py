"""Grains and bubbles in the sheet: their scattered light, image positions and sizes."""

import math
from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.special import erf

from tests.virtual_sensors import altered, clear, cropped, plate, scene_of, seen_at, sensor_at
from twin.light.particles import Spots, _draw_out, bubble, diffuse_sphere
from twin.light.pose import Travel
from twin.light.renderer import Renderer
from twin.recording.sensor_simulator import SensorSimulator
from twin.rendering_options import NONE, Flaws, Options
from uwlts.model.placement import camera_from_object
from uwlts.model.sensor import Sensor

FAR_AWAY = plate(5000.0)
SHARES = {"particles": diffuse_sphere, "bubbles": bubble}


@pytest.fixture(scope="module")
def small(thesis: Sensor) -> Sensor:
    return altered(thesis, {"camera": {"width_px": 160, "height_px": 128, "pixel_size_um": 42.4}})


def test_a_diffuse_sphere_and_a_mirror_send_all_that_they_reflect():
    cosine, weight = np.polynomial.legendre.leggauss(400)
    # The power that a sphere of radius 1 meets in an irradiance of 1 is pi; the grain reflects 30 % of it.
    assert 2 * math.pi * weight @ diffuse_sphere(cosine) == pytest.approx(0.3 * math.pi, rel=1e-6)
    # Total reflection up to twice the angle that the critical one of asin(1 / 1.33) leaves to 90 deg.
    critical = math.pi - 2 * math.asin(1 / 1.33)
    np.testing.assert_allclose(bubble(np.cos(critical * np.linspace(0.01, 0.999, 9))), 0.25)
    # Straight back it is Fresnel's ((n - 1) / (n + 1))^2.
    assert bubble(np.array([-1.0]))[0] == pytest.approx((0.33 / 2.33) ** 2 / 4)
    assert (2 * math.pi * weight @ bubble(cosine)) < math.pi


@pytest.mark.parametrize(("body", "way_mm"), [("particles", 0.0), ("bubbles", 0.0), ("particles", 0.4)])
def test_many_bodies_scatter_as_a_haze_of_the_same_cross_section(small, body, way_mm):
    medium = clear(0.3, 1.0, phase="henyey-greenstein", asymmetry=0.0)
    hazy = Renderer(small, medium, scene_of(FAR_AWAY), effects=replace(NONE, haze=True))
    haze = hazy.laser_frame(sensor_at(), spp=1).haze
    count = 20_000.0
    drifting = Renderer(small, medium, scene_of(FAR_AWAY), effects=NONE, flaws=Flaws(**{body: count}))
    # Moving through the water lights more bodies for a shorter time each.
    moved = Travel(np.array([way_mm, way_mm, 0.0]), 1.0) if way_mm else None
    frames = [drifting.laser_frame(sensor_at(), spp=1, seed=seed, through_water=moved).particles for seed in range(40)]
    middle = np.s_[44:84, 60:100]
    # N(> d) as d^-3 between 0.1 and 5 mm: the mean of d^2 is 3 d0^2 (1 - d0 / d1) / (1 - (d0 / d1)^3).
    mean_square_radius = 3 * 0.05**2 * (1 - 0.02) / (1 - 0.02**3)
    # In the middle the camera looks along its axis at light that runs along Z; in 20 deg of field it changes little.
    cosine = -camera_from_object(small)[2, 2]
    per_sr = 1e-6 * count * mean_square_radius * SHARES[body](np.array([cosine]))[0]
    # Isotropic haze of 1 per m scatters 1e-3 / 4 pi per mm and sr. Spots cross the border of the centre inwards and
    # outwards.
    expected = haze[middle].mean() * per_sr / (1e-3 / (4 * math.pi))
    values = np.array([frame[middle].mean() for frame in frames])
    assert np.count_nonzero(values) > 20
    # The frames are independent: 4.5 standard deviations of their mean are exceeded once in 150,000 runs; the angle of
    # scattering changes over the middle by some 5 deg, which changes both shares by less than 10 %.
    assert abs(values.mean() - expected) < 4.5 * values.std(ddof=1) / math.sqrt(len(values)) + 0.1 * expected


def test_nothing_is_seen_behind_a_plate_or_without_light(small):
    medium = clear()
    dark = Renderer(small, medium, scene_of(FAR_AWAY), effects=NONE, flaws=Flaws(particles=0.0))
    assert not dark.laser_frame(sensor_at(), spp=1).particles.any()
    near = scene_of(plate(-60.0, side=600.0))
    free, hidden = (
        Renderer(small, medium, scene, effects=NONE, flaws=Flaws(particles=20_000.0))
        .laser_frame(sensor_at(), spp=1)
        .particles
        for scene in (scene_of(FAR_AWAY), near)
    )
    lit = free.sum(axis=1) > 0
    assert lit.mean() > 0.8
    # A plate 60 mm before the stand-off ends the sheet within the image.
    assert 0 < np.count_nonzero(hidden.sum(axis=1) > 0) < 0.8 * np.count_nonzero(lit)


def test_equal_seeds_give_equal_bodies_and_a_flat_disc_keeps_its_light(small):
    renderer = Renderer(small, clear(), scene_of(FAR_AWAY), effects=NONE, flaws=Flaws(particles=5000.0))
    first, again, other = (renderer.laser_frame(sensor_at(), spp=1, seed=seed).particles for seed in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, other)
    for radius in (0.0, 0.7, 4.0, 11.3):
        one = Spots(*(np.array([each]) for each in (40.3, 30.8, 2.0, radius)))
        image = one.draw(64, 80)
        assert image.sum() == pytest.approx(2.0, rel=0.01)
        y, x = np.nonzero(image)
        assert np.hypot(y - 30.8, x - 40.3).max() <= radius + 0.5
    cut = Spots(*(np.array([each]) for each in (40.0, 0.0, 2.0, 9.0))).draw(64, 80)
    # Half of it and the row through its middle.
    assert cut.sum() == pytest.approx(1.0 + 18 / (math.pi * 81), rel=0.03)


def test_a_track_has_the_light_of_a_gaussian_crossed_at_a_constant_speed():
    sigma, aside, reach = 0.075, np.array([0.0, 1.3, -2.9, 0.4]), np.array([0.4, 0.3, 0.2, 0.075])
    through = 6 * (reach - sigma)
    found = {"sigma": np.full(4, sigma), "through": through, "reach": reach, "start_x": aside, "start_y": 0 * aside}
    found |= {"moved_x": np.full(4, 40.0), "moved_y": np.full(4, -30.0)}
    spots = Spots(np.full(4, 100.0), np.full(4, 80.0), np.full(4, 2.0), np.full(4, 1.0))
    tracks = _draw_out(spots, aside, found)
    # The mean of exp(-d^2 / 2 s^2) over d from a - b / 2 to a + b / 2 within 3 s.
    low, high = aside * reach - through / 2, aside * reach + through / 2
    ends = np.clip([low, high], -3 * sigma, 3 * sigma) / (math.sqrt(2) * sigma)
    with np.errstate(invalid="ignore"):
        mean = sigma * math.sqrt(math.pi / 2) * (erf(ends[1]) - erf(ends[0])) / through
    mean[through == 0] = math.exp(-0.5 * 0.4**2)
    assert tracks.light.sum() == pytest.approx(2.0 * mean.sum(), rel=2e-3)
    # The fourth stays at its distance from the sheet during the whole exposure, and is drawn over 50 px.
    fourth = np.isclose(tracks.light, tracks.light[-1])
    assert np.ptp(tracks.x[fourth]) == pytest.approx(40.0, abs=0.5) and np.ptp(tracks.y[fourth]) == pytest.approx(
        30.0, abs=0.5
    )
    assert len(tracks.x) > 100


def test_tracks_are_as_long_as_the_image_moves(thesis):
    sensor, medium = cropped(thesis, 500, 300), clear()
    renderer = Renderer(sensor, medium, scene_of(FAR_AWAY), effects=NONE, flaws=Flaws(particles=4000.0))
    # 4 mm along the stripe, in the sheet; seen about the middle of the volume.
    seen = seen_at(sensor, medium, np.array([[0.0, -2.0, 0.0], [0.0, 2.0, 0.0]]))
    expected = np.linalg.norm(seen[1] - seen[0])
    lengths = []
    for seed in range(3):
        image = renderer.laser_frame(
            sensor_at(), spp=1, seed=seed, through_water=Travel(np.array([0.0, 400.0, 0.0]), 0.01)
        ).particles
        count, _, boxes, _ = cv2.connectedComponentsWithStats((image > 0).astype(np.uint8))
        whole = (boxes[1:, 0] > 0) & (boxes[1:, 0] + boxes[1:, 2] < 500) & (boxes[1:, 3] <= 4)
        lengths += boxes[1:][whole, 2].tolist()
        assert count < 100
    assert len(lengths) > 20
    # A disc adds a pixel at each end; the scale changes by a tenth over the depth of the image.
    assert np.median(lengths) == pytest.approx(expected + 1, rel=0.1)


def test_the_sensor_moves_through_the_water_by_its_own_motion_less_the_current(small):
    timed = altered(small, {"exposure": {"laser_ms": 8.0}})
    motion = {"speed_mm_per_s": 40.0, "direction": (1.0, 0.0, 0.0)}
    for current, moves, expected in (
        ((0.0, 0.0, 0.0), motion, (40.0, 0.0, 0.0)),
        ((5.0, 0.0, -2.0), motion, (35.0, 0.0, 2.0)),
        ((5.0, 0.0, -2.0), {}, (-5.0, 0.0, 2.0)),
    ):
        scene = scene_of(plate(), motion=moves, current_mm_per_s=current)
        simulator = SensorSimulator(timed, scene, Options(effects=replace(NONE, motion=True)))
        travel = simulator.travel(next(scene.motion.shots()), in_water=True)
        assert travel is not None and travel.exposure_s == pytest.approx(8e-3)
        np.testing.assert_allclose(travel.velocity_mm_s, expected)
        still = SensorSimulator(timed, scene, Options(effects=NONE))
        assert still.travel(next(scene.motion.shots()), in_water=True) is None
