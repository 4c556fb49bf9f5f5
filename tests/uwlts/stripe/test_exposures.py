"""Exposure brackets: grouping and fusion of images."""

from types import SimpleNamespace

import numpy as np
import pytest

from tests.virtual_sensors import altered, scene_of
from twin import render, simulate
from uwlts.optics.nominal import nominal
from uwlts.storage.capture import Capture
from uwlts.storage.truth import read_truth, truth_path
from uwlts.stripe import StripeStatus, extract_stripe, find_stripes
from uwlts.stripe.exposures import fuse_exposures, group_brackets

LINES, LENGTH = 300, 120
OFFSET, FULL = 16.0, 255
# The camera exposes 20 us longer than it says.
STATED_MS, TRUE_MS = np.array([0.5, 2.5, 12.5]), np.array([0.52, 2.52, 12.52])
RNG = np.random.default_rng(11)


def recording(stage_mm, exposure_ms, laser_on=None, pose=None):
    """Return a recording with the metadata of its images."""
    count = len(stage_mm)
    return SimpleNamespace(
        stage_mm=np.asarray(stage_mm, float),
        exposure_ms=np.asarray(exposure_ms, float),
        laser_on=np.ones(count, bool) if laser_on is None else np.asarray(laser_on, bool),
        pose=np.full((count, 4, 4), np.nan) if pose is None else pose,
    )


def found(*about, **more):
    return [each.tolist() for each in group_brackets(recording(*about, **more))]


def test_images_of_one_place_at_growing_exposures_belong_together():
    assert found([0, 0, 1, 1, 2, 2], [1, 4] * 3) == [[0, 1], [2, 3], [4, 5]]
    # In whatever order they were taken, with lamp images between, and with exposures that were shortened on the way.
    assert found([0, 0, 0, 1, 1, 1], [8, 1, 4, 2, 0.5, 1], laser_on=[1, 0, 1, 1, 1, 0]) == [[2, 0], [4, 3]]
    # A recording in progress.
    assert found([0, 0, 1, 1, 2], [1, 4, 1, 4, 1]) == [[0, 1], [2, 3], [4]]
    poses = np.repeat(np.eye(4)[None], 4, axis=0)
    poses[2:, 0, 3] = 5.0
    assert found([0] * 4, [1, 4] * 2, pose=poses) == [[0, 1], [2, 3]]


@pytest.mark.parametrize(
    ("stage_mm", "exposure_ms"),
    [
        ([0, 1, 2, 3], [1, 2, 1, 2]),  # one image a place
        ([0, 0, 1, 1], [1, 1, 1, 1]),  # repeats
        ([0, 0, 1, 1], [1.0, 1.2, 1.0, 1.2]),  # automatic exposure
        ([0, 0, 0, 0], [1, 4, 16, 64]),  # no place is known: boards held by hand
        ([0, 0, 1, 1, 1], [1, 4, 1, 4, 16]),  # another number
        ([0, 0, 1, 1], [0, 4, 0, 4]),  # exposures are not known
    ],
)
def test_other_images_stay_alone(stage_mm, exposure_ms):
    assert found(stage_mm, exposure_ms) == [[k] for k in range(len(stage_mm))]


@pytest.fixture(scope="module")
def drawn():
    """Draw images of stripes from black to steel; return centres (L,), heights (L,) in the longest exposure, images."""
    lines = np.arange(LINES)
    centre = 60 + 0.05 * lines
    height = np.repeat([20.0, 400.0, 4000.0], LINES // 3)
    x = np.arange(LENGTH)
    light = height[:, None] * np.exp(-0.5 * ((x - centre[:, None]) / 2.0) ** 2) + 5.0
    images = []
    for true_ms in TRUE_MS:
        dn = OFFSET + light * true_ms / TRUE_MS[-1] + RNG.normal(0, 0.7, light.shape)
        images.append(np.clip(np.round(dn), 0, FULL).astype(np.uint8))
    return centre, height, images


def test_the_fused_image_shows_what_no_exposure_shows_alone(drawn):
    centre, height, images = drawn
    image, saturation = fuse_exposures(images, STATED_MS, full_dn=FULL)
    # The shortest exposure's range, in grey levels of the longest.
    assert saturation == pytest.approx(OFFSET + (FULL - OFFSET) * TRUE_MS[-1] / TRUE_MS[0], rel=0.02)
    stripe = extract_stripe(image, stripe_along="height", saturation=saturation)
    assert (stripe.status == StripeStatus.OK).all()
    for wanted in np.unique(height):
        lines = height == wanted
        error = stripe.centre_px[lines] - centre[lines]
        assert abs(error.mean()) < 0.01 and error.std() < 0.1
        # The stated exposures would give 4 % too much: the ratios are the images' own.
        assert np.median(stripe.amplitude[lines]) == pytest.approx(wanted, rel=0.02)
    shortest = extract_stripe(images[0], stripe_along="height")
    assert not (shortest.status[height == 20.0] == StripeStatus.OK).any()
    longest = extract_stripe(images[-1], stripe_along="height")
    # At the longest exposure the brightest shows a plateau: its height is lost.
    assert np.median(longest.amplitude[height == 4000.0]) < 400


def test_ratio_and_offset_where_little_is_well_exposed(drawn):
    _, _, images = drawn
    dark = [np.minimum(image, 40) for image in images]
    image, saturation = fuse_exposures(dark, STATED_MS, full_dn=FULL)
    # No pixel determines the ratio: the stated exposures are used. The offset follows from the background.
    assert saturation == pytest.approx(OFFSET + (FULL - OFFSET) * 25.0, rel=0.01)
    assert np.median(image) == pytest.approx(OFFSET + 5.0, abs=0.3)


@pytest.mark.slow
def test_rubber_beside_steel_is_measured_in_a_bracket(thesis, tmp_path):
    """Rendered: lines on the black plate are found at the true stripe, and those on the bright plate remain."""
    changes = {"camera": {"width_px": 320, "height_px": 256, "pixel_size_um": 21.2}}
    sensor = altered(thesis, changes)
    plates = [
        {"kind": "plate", "width_mm": 80.0, "height_mm": 60.0, "position_mm": (0.0, y, 0.0), "reflectance": reflectance}
        for y, reflectance in ((-32.0, 0.004), (32.0, 0.95))
    ]
    scene = scene_of(*plates, motion={"count": 2, "bracket": [1, 5, 25]})
    (path,) = simulate(scene, out=tmp_path / "bracket.h5", sensor=sensor)
    _, truth = read_truth(truth_path(path))
    black = truth.point_mm[2, :, 1] < -3.0
    bright = truth.point_mm[2, :, 1] > 3.0
    with Capture(path) as capture:
        np.testing.assert_allclose(capture.exposure_ms / capture.exposure_ms[0], [1, 5, 25] * 2)
        stripes = find_stripes(capture)
        alone = extract_stripe(capture.image(0), stripe_along="width", saturation=255)
    assert set(stripes.frame.tolist()) == {2, 5}
    assert (alone.status[black] != StripeStatus.OK).mean() > 0.9
    for lines in (black, bright):
        here = (stripes.frame == 2) & lines[stripes.line]
        assert np.count_nonzero(here) > 0.95 * np.count_nonzero(lines)
        error = stripes.centre_px[here] - truth.centre_px[2, stripes.line[here]]
        assert abs(np.mean(error)) < 0.03 and np.std(error) < 0.25


def test_a_bracket_is_one_profile_of_a_cloud(thesis, tmp_path):
    """Its place is the stage's, and each profile occurs once."""
    from uwlts import reconstruct

    sensor = altered(thesis, {"camera": {"width_px": 160, "height_px": 128, "pixel_size_um": 42.4}})
    plate = {"kind": "plate", "width_mm": 200.0, "height_mm": 200.0}
    scene = scene_of(plate, motion={"count": 3, "step_mm": 2.0, "bracket": [1, 4], "lights": ["lamp", "laser"]})
    recording = render(scene, sensor=sensor, spp=4)
    assert recording.laser_on.tolist() == [False, True, True] * 3
    (path,) = simulate(scene, out=tmp_path / "bracket.h5", sensor=sensor, spp=4)
    with Capture(path) as capture:
        cloud = reconstruct(capture, nominal(sensor, medium="water"))
    assert set(cloud.frame.tolist()) == {2, 5, 8}
    for frame, stage_mm in ((2, 0.0), (5, 2.0), (8, 4.0)):
        assert np.median(cloud.points_mm[cloud.frame == frame, 0]) == pytest.approx(stage_mm, abs=0.3)
