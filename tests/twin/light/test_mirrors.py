"""Mirrors: position and brightness of the stripe's second image follow from geometry and the mirror's reflectance."""

import math
from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest

from tests.virtual_sensors import block, clear, cropped, image_of, plate, scene_of, sensor_at
from twin.backend.arrays import to_numpy
from twin.light.pose import SensorPose, Travel
from twin.light.renderer import Renderer
from twin.recording.frame_truth import find_true_stripe
from twin.rendering_options import NONE
from twin.scene.description import Scene
from uwlts.model.sensor import Sensor
from uwlts.storage.truth import TruthStatus

SHARE, MIRROR_Z, TILT = 0.8, 40.0, math.radians(10.0)
PLATE_Z = 10.0
EFFECTS = replace(NONE, secondary_light=True, gloss=True)
BLOCK = block((30.0, 60.0, 20.0), (0.0, 0.0, 10.0), reflectance=0.6)
"""Its upper face is at Z = 0, its lower one 20 mm above the mirror."""


def mirror(share: float, **rest: object) -> dict[str, object]:
    return plate(MIRROR_Z, side=300.0, reflectance=0.0) | {"mirror": share} | rest


def test_a_perfect_mirror_shows_no_stripe_of_its_own(thesis):
    renderer = Renderer(thesis, clear(), scene_of(mirror(1.0)), effects=EFFECTS)
    assert renderer.laser_frame(sensor_at(), spp=16).irradiance().max() == 0
    assert (find_true_stripe(renderer, sensor_at()).status != TruthStatus.VISIBLE).all()


def hidden(share: float) -> Scene:
    """A small plate that turns its back to the sensor, before a mirror turned by TILT about Y.

    The sheet X = 0 comes back from the mirror at twice the tilt and meets the plate's face there.
    """
    x = -(MIRROR_Z - PLATE_Z) * math.tan(2 * TILT)
    facing_away = plate(PLATE_Z, side=12.0, x=x, reflectance=0.6) | {"rotation_deg": (180.0, 0.0, 0.0)}
    return scene_of(facing_away, mirror(share) | {"rotation_deg": (0.0, math.degrees(TILT), 0.0)})


def brightness(thesis: Sensor, share: float) -> np.ndarray:
    return Renderer(thesis, clear(), hidden(share), effects=EFFECTS).laser_frame(sensor_at(), spp=64).irradiance()


def test_a_stripe_lit_and_seen_by_way_of_a_mirror_shows_at_its_mirrored_points(thesis):
    assert brightness(thesis, 0.0).max() == 0, "nothing of it is lit or seen straight"
    image = brightness(thesis, SHARE)
    y = np.linspace(-3.0, 3.0, 7)
    lit = np.stack([np.full_like(y, -(MIRROR_Z - PLATE_Z) * math.tan(2 * TILT)), y, np.full_like(y, PLATE_Z)], axis=1)
    normal = np.array([-math.sin(TILT), 0.0, -math.cos(TILT)])
    mirrored = lit - 2 * ((lit - (0.0, 0.0, MIRROR_Z)) @ normal)[:, None] * normal
    column, row = np.rint(image_of(thesis, clear(), mirrored)).astype(int).T
    strip = np.stack([image[row + k, column] for k in range(-30, 31)])
    assert (strip.max(axis=0) > 0).all()
    assert (np.abs(strip.argmax(axis=0) - 30) <= 1).all()


def test_lengths_with_a_mirror_lead_to_the_mirrored_points(thesis):
    renderer = Renderer(thesis, clear(), hidden(SHARE), effects=EFFECTS)
    bundle, _ = renderer.view.trace_grid(8)
    _, segment, *_ = renderer._surfaces.segments(SensorPose(sensor_at()), bundle, None)
    straight = to_numpy(mi.Point3f(bundle.origin + bundle.direction * (segment.length_before + segment.si.t)))
    end, seen = to_numpy(segment.end()), segment.valid.numpy() & (bundle.weight.numpy() > 0)
    # Of all that is seen in the mirror only the small plate's hidden face is lower.
    seen &= np.abs(end[:, 2] - PLATE_Z) < 1e-3
    assert seen.sum() > 50
    normal = np.array([-math.sin(TILT), 0.0, -math.cos(TILT)])
    expected = end - 2 * ((end - (0.0, 0.0, MIRROR_Z)) @ normal)[:, None] * normal
    # Reflected rays start 0.01 mm before the mirror; single precision adds some tenths of that at 0.5 m.
    np.testing.assert_allclose(straight[seen], expected[seen], atol=0.015)


def test_light_by_way_of_a_mirror_twice_goes_with_its_share_squared(thesis):
    half, whole = (brightness(thesis, share).sum() for share in (SHARE / 2, SHARE))
    assert whole / half == pytest.approx(4.0, rel=1e-4)


@pytest.mark.slow
def test_while_the_sensor_travels_the_light_by_way_of_a_mirror_travels_as_well(thesis):
    """The exposure is the mean of still images at positions along the path, the outermost with half the weight."""
    middle = cropped(thesis, 512, 1024)  # all that is lit
    renderer = Renderer(middle, clear(), hidden(SHARE), effects=replace(EFFECTS, motion=True))
    way = Travel(velocity_mm_s=np.array([100.0, 0.0, 0.0]), exposure_s=0.04)
    moving = renderer.laser_frame(sensor_at(), spp=64, travel=way).irradiance().astype(float)
    still = [renderer.laser_frame(sensor_at(x=x), spp=64).irradiance().astype(float) for x in np.linspace(-2.0, 2.0, 9)]
    mean = np.average(still, axis=0, weights=[0.5, *[1.0] * 7, 0.5])
    assert moving.sum() == pytest.approx(mean.sum(), rel=2e-3)
    rows = np.arange(len(mean))
    centre, expected = ((rows @ image).sum() / image.sum() for image in (moving, mean))
    assert centre == pytest.approx(expected, abs=0.05)
    first, last = ((rows @ image).sum() / image.sum() for image in (still[0], still[-1]))
    assert abs(first - last) > 3.0


@pytest.mark.slow
def test_the_straight_stripe_is_the_same_with_a_mirror(thesis):
    scenes = [scene_of(BLOCK, mirror(share)) for share in (SHARE, 0.0)]
    renderers = [Renderer(thesis, clear(), scene, effects=EFFECTS) for scene in scenes]
    with_mirror, without = (renderer.laser_frame(sensor_at(), spp=64).irradiance() for renderer in renderers)
    truth = find_true_stripe(renderers[1], sensor_at())
    line = np.flatnonzero(truth.status == TruthStatus.VISIBLE)[20:-20]
    row = np.rint(truth.centre_px[line]).astype(int)
    assert len(line) > 200
    np.testing.assert_allclose(with_mirror[row, line], without[row, line], rtol=1e-3)
