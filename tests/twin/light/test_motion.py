"""Sensor that moves during exposure: blur, rolling shutter, and their ground truth."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.virtual_sensors import altered, clear, cropped, plate, scene_of, sensor_at
from twin.light.pose import Travel
from twin.light.renderer import Renderer
from twin.recording.frame_truth import find_true_stripe, measure_line_light
from twin.recording.sensor_simulator import SensorSimulator
from twin.rendering_options import NONE, Options
from uwlts.errors import DesignError

ALONG_X = np.array([1.0, 0.0, 0.0])
SPEED = 50.0
TILTED = plate(side=200.0) | {"rotation_deg": (0.0, 30.0, 0.0)}


def moments(image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Means and variances (W,) of the columns, px and px2."""
    row, total = np.arange(len(image))[:, None], image.sum(axis=0)
    mean = (row * image).sum(axis=0) / total
    return mean, ((row - mean) ** 2 * image).sum(axis=0) / total


@pytest.fixture(scope="module")
def renderer(thesis) -> Renderer:
    return Renderer(cropped(thesis, 48, 256), clear(), scene_of(TILTED), effects=replace(NONE, motion=True))


def travel(exposure_mm: float = 0.0, row_mm: float = 0.0) -> Travel:
    return Travel(velocity_mm_s=SPEED * ALONG_X, exposure_s=exposure_mm / SPEED, row_s=row_mm / SPEED)


@pytest.mark.parametrize("exposure_mm", [3.0, 12.0])
def test_travel_during_the_exposure_blurs_the_stripe_evenly(renderer, exposure_mm):
    centres = [find_true_stripe(renderer, sensor_at(x=x)).centre_px for x in (-1.0, 1.0)]
    px_per_mm = (centres[1] - centres[0]) / 2
    assert (np.abs(px_per_mm) > 1).all()
    still = renderer.laser_frame(sensor_at(), spp=512).irradiance().astype(float)
    blurred = renderer.laser_frame(sensor_at(), spp=512, travel=travel(exposure_mm)).irradiance().astype(float)
    (to_rest_frame, narrow), (moving, wide) = moments(still), moments(blurred)
    # An even motion over L px has the variance L^2 / 12; the plate runs away from the camera by 0.3 % per mm.
    np.testing.assert_allclose(wide - narrow, (exposure_mm * px_per_mm) ** 2 / 12, rtol=0.01 * exposure_mm)
    np.testing.assert_allclose(moving, to_rest_frame, atol=0.005 * exposure_mm**2)
    assert blurred.sum() == pytest.approx(still.sum(), rel=0.01)


def test_frames_do_not_depend_on_earlier_ones(thesis):
    """Frames contain no numbers of earlier ones: pose, motion, times, lines."""
    scene = scene_of(TILTED, {"kind": "sphere", "diameter_mm": 30.0, "position_mm": (0.0, 5.0, 0.0)})
    effects = replace(NONE, motion=True, defocus=True, haze=True, multiple_scattering=True, secondary_light=True)

    def start() -> Renderer:
        return Renderer(cropped(thesis, 48, 160), clear(0.1, 0.3), scene, effects=effects)

    turns = [
        replace(travel(way_mm, row_mm=row_mm), turn_rad_s=np.array(turn))
        for way_mm, row_mm, turn in ((1.0, 0.002, (0.1, -0.4, 0.3)), (0.4, 0.01, (-0.2, 0.8, -0.6)))
    ]
    # Each kind of motion twice.
    frames = [(0.0, None, 4), (3.0, None, 5), (3.0, travel(2.0), 4), (-2.0, travel(0.5), 6)]
    frames += [(1.0, turns[0], 4), (5.0, turns[1], 5), (400.0, None, 4)]
    used, visible = start(), []
    for seed, (x, way, spp) in enumerate(frames):
        found = []
        for renderer in (used, start()):
            truth = find_true_stripe(renderer, sensor_at(x=x), travel=way)
            frame = renderer.laser_frame(
                sensor_at(x=x), spp=spp, seed=seed, travel=way, lines=truth.surface_lines()
            ).irradiance()
            lamp = renderer.irradiance("lamp", sensor_at(x=x), spp=spp, travel=way)
            truth = measure_line_light(renderer, sensor_at(x=x), truth, spp=spp, travel=way)
            found.append([frame, lamp, *vars(truth).values()])
        for mine, fresh in zip(*found, strict=True):
            np.testing.assert_array_equal(mine, fresh)
        visible.append(np.isfinite(truth.centroid_px).sum())
    assert min(visible[:-1]) > 20
    assert visible[-1] == 0, "nothing but water is in view of the last frame"


def test_a_rolling_shutter_shifts_each_row_by_its_delay(renderer):
    pose, delay = sensor_at(), 0.005
    centre = find_true_stripe(renderer, pose).centre_px
    rolled = find_true_stripe(renderer, pose, travel=travel(row_mm=delay))
    # Every line shows the stripe at its own exposure time, like the still frame at the travel of that row.
    for line in (4, 24, 43):
        at = rolled.centre_px[line] * delay
        assert find_true_stripe(renderer, sensor_at(x=at)).centre_px[line] == pytest.approx(
            rolled.centre_px[line], abs=2e-3
        )
    assert np.abs(rolled.centre_px - centre).max() > 1
    image = renderer.laser_frame(pose, spp=256, travel=travel(row_mm=delay)).irradiance().astype(float)
    np.testing.assert_allclose(moments(image)[0], rolled.centre_px, atol=0.05)


def test_an_exposure_under_any_twist_is_the_mean_of_still_frames_along_it(renderer):
    """The sensor turns about all axes and goes to all sides at once.

    The mean of 17 still frames, the outermost with half the weight, is the trapezoid rule: the stripe moves by some 15
    px, less than one of its widths from frame to frame, so that columns' means agree to hundredths of a pixel.
    """
    turn, velocity, exposure_s = np.array([0.6, -0.4, 0.8]), np.array([30.0, 20.0, -40.0]), 0.05
    way = Travel(velocity_mm_s=velocity, turn_rad_s=turn, exposure_s=exposure_s)
    moving = renderer.laser_frame(sensor_at(), spp=512, travel=way).irradiance().astype(float)
    still = []
    for at_s in np.linspace(-0.5, 0.5, 17) * exposure_s:
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_rotvec(turn * at_s).as_matrix()
        pose[:3, 3] = velocity * at_s
        still.append(renderer.laser_frame(pose, spp=64).irradiance().astype(float))
    weights = np.r_[0.5, np.ones(15), 0.5]
    (mean, spread), (expected, wide) = moments(moving), moments(np.average(still, axis=0, weights=weights))
    np.testing.assert_allclose(mean, expected, atol=0.05)
    np.testing.assert_allclose(spread, wide, rtol=0.02)
    ends = [moments(image)[0] for image in (still[0], still[-1])]
    assert np.abs(ends[1] - ends[0]).min() > 3


def test_a_turn_moves_each_row_of_a_rolling_shutter(renderer):
    """The truth of a row is that of a still frame at the pose of that row's moment."""
    turn, row_s, begun = np.array([0.0, 30.0, 3.0]), 1e-4, sensor_at(x=15.0)
    rolled = find_true_stripe(renderer, begun, travel=Travel(np.zeros(3), 0.0, turn, row_s=row_s))
    for line in (4, 43):
        pose = begun.copy()
        pose[:3, :3] = Rotation.from_rotvec(turn * rolled.centre_px[line] * row_s).as_matrix()
        assert find_true_stripe(renderer, pose).centre_px[line] == pytest.approx(rolled.centre_px[line], abs=2e-3)
    assert np.abs(rolled.centre_px - find_true_stripe(renderer, begun).centre_px).max() > 1


def test_too_fast_a_travel_is_refused_with_numbers(thesis):
    sensor = altered(thesis, {"exposure": {"laser_ms": 5.0}})
    fast = {"count": 5, "step_mm": 1.0, "speed_mm_per_s": 100.0}
    with pytest.raises(DesignError, match=r"at 100 mm/s .* after 10 ms, but the camera needs 16.7 ms"):
        SensorSimulator(sensor, scene_of(TILTED, motion=fast), Options(effects=NONE))
    studio = SensorSimulator(sensor, scene_of(TILTED, motion=fast | {"speed_mm_per_s": 50.0}), Options(effects=NONE))
    assert studio.period_s == pytest.approx(0.02)
    shot = next(studio.scene.motion.shots())
    assert studio.travel(shot) is None, "the motion is left out"
    moving = SensorSimulator(sensor, studio.scene, Options(effects=replace(NONE, motion=True)))
    way = moving.travel(shot)
    assert way.velocity_mm_s * way.exposure_s == pytest.approx([0.25, 0.0, 0.0])
