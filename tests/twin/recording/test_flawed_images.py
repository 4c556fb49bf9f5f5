"""Flaws of real recordings in whole images: each alone, in its own light, in the truth and in the capture."""

from dataclasses import fields, replace

import numpy as np
import pytest

from tests.virtual_sensors import altered, camera_axes, clear, cropped, oracle_paths, plate, scene_of, sensor_at
from twin.light.camera import CameraView
from twin.light.illumination import RING_MM, reflect_ring
from twin.light.renderer import Renderer
from twin.recording.record_scene import record_scene
from twin.recording.sensor_simulator import SensorSimulator
from twin.rendering_options import NONE, Flaws, Options
from twin.sensor.detector import dirt
from uwlts.errors import DescriptionError
from uwlts.model.placement import camera_from_object
from uwlts.model.sensor import Sensor
from uwlts.storage.capture import Capture
from uwlts.storage.truth import TruthStatus, read_truth, truth_path

TYPICAL = [
    "glare=0.02",
    "vignetting=0.4",
    "uneven-lamp=0.6",
    "particles=1000",
    "bubbles=200",
    "caustics=2",
    "stray-light=0.02",
    "side-lobes=0.01",
    "lamp-reflection=0.001",
    "dirt=0.1",
    "ghost=0.003",
    "lamp-and-laser",
    "pixel-aspect=1.002",
    "tangential=0.001",
    "rolling-shutter=10",
    "row-noise=5",
    "jpeg=90",
    "colour-filter",
]
NAMES = [text.partition("=")[0] for text in TYPICAL]
UNSEEN = "rolling-shutter", "caustics", "row-noise"  # without motion, daylight and noise


@pytest.fixture(scope="module")
def sensor(thesis: Sensor) -> Sensor:
    """A small sensor that sees a wide field, with exposures of its own."""
    camera = {"width_px": 160, "height_px": 128, "pixel_size_um": 42.4}
    return altered(thesis, {"camera": camera, "exposure": {"laser_ms": 2.0, "lamp_ms": 1.0}})


def studio(sensor: Sensor, *effects: str) -> SensorSimulator:
    """The sensor before a turned plate, without any of the other effects."""
    turned = plate(reflectance=0.6, side=150.0) | {"rotation_deg": (20.0, 10.0, 0.0)}
    scene = scene_of(turned, motion={"lights": ("lamp", "laser")})
    return SensorSimulator(sensor, scene, Options(effects=NONE, flaws=Flaws.parse(*effects)))


@pytest.fixture(scope="module")
def apart(sensor: Sensor) -> SensorSimulator:
    """The sensor without flaws."""
    return studio(sensor)


def images(taken: SensorSimulator) -> list[np.ndarray]:
    return [taken.frame(shot, index).image.astype(float) for index, shot in enumerate(taken.scene.motion.shots())]


@pytest.fixture(scope="module")
def plain(apart: SensorSimulator) -> list[np.ndarray]:
    """Its image under the lamp, and the laser's."""
    return images(apart)


def test_a_name_alone_stands_for_its_typical_strength():
    assert Flaws.parse(*NAMES) == Flaws.parse(*TYPICAL)
    assert Flaws.parse(*TYPICAL).names() == TYPICAL
    assert len(TYPICAL) == len(fields(Flaws))
    assert Flaws.parse() == Flaws() and Flaws().names() == []
    assert Flaws.parse("jpeg=75", "glare=0.1") == Flaws(jpeg=75, glare=0.1)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("glaer", "unknown effect 'glaer' to add; known are glare, vignetting, uneven-lamp"),
        ("speckle", "unknown effect 'speckle' to add"),
        ("jpeg=high", "the strength of jpeg is 'high'; expected a whole number, as in jpeg=90"),
        ("jpeg=90.5", "the strength of jpeg is '90.5'; expected a whole number"),
        ("glare=", "the strength of glare is ''; expected a number, as in glare=0.02"),
        ("glare=nan", "glare is nan; it must be from 0 to 0.5"),
        ("jpeg=101", "jpeg is 101; it must be from 1 to 100"),
        ("vignetting=-0.1", "vignetting is -0.1; it must be from 0 to 0.99"),
        ("colour-filter=1", "colour-filter takes no strength; found 'colour-filter=1'"),
    ],
)
def test_what_is_no_flaw_is_refused(text, message):
    with pytest.raises(DescriptionError, match=message):
        Flaws.parse("glare", text)


@pytest.mark.parametrize("name", [name for name in NAMES if name not in UNSEEN])
def test_each_flaw_alone_changes_an_image(sensor, plain, name):
    changed = images(studio(sensor, name))
    assert max(np.abs(a - b).max() for a, b in zip(plain, changed, strict=True)) >= 1
    of_lamp = name in ("uneven-lamp", "lamp-reflection")
    assert (plain[1] == changed[1]).all() == of_lamp, "the lamp does not change the laser's image"


@pytest.mark.parametrize("tilt", [(0.0, 0.0), (1.0, -0.5)])
def test_a_ring_lamp_is_seen_mirrored_by_the_window(thesis, tilt):
    window = {"tilt_x_deg": tilt[0], "tilt_y_deg": tilt[1]}
    (inner, outer), images = RING_MM, []
    for f_number in (100.0, 4.0):
        changes = {"camera": {"f_number": f_number, "window": window}, "lamp": {"irradiance_w_per_m2": 4.0}}
        sensor = altered(thesis, changes)
        images.append(reflect_ring(CameraView(sensor, clear()), sensor, reflectance=0.02).astype(float))
    camera, image = sensor.camera, images[0]
    y, x = np.indices(image.shape)
    cx, cy = camera.principal_point()
    focal, normal = camera.focal_length_px(), camera.window.normal()
    # The mirrored ring is as far behind the window as the pupil is before it, about the mirror image of the pupil.
    mirrored = 2 * camera.window.distance_mm * normal[2] * normal
    centre = np.array([cx, cy]) + focal * mirrored[:2] / mirrored[2]
    apparent = focal / mirrored[2]
    away = np.hypot(x - centre[0], y - centre[1]) / apparent
    on_ring, inside = (away > inner + 0.6) & (away < outer - 0.6), away < inner - 0.6
    assert on_ring.sum() > 1e4
    # Seen slanted by the tilt, the ring is an ellipse to 0.1 mm; a cell of 4 px is 0.2 mm, the blur of f/100 0.1 mm.
    assert image[inside].max() < 0.02 * image.max() and image[away > outer + 0.6].max() < 0.02 * image.max()
    # The radiance of a ring that illuminates surfaces with 4 W/m2, by a sum over its elements, through the lens.
    radius, depth = np.linspace(inner, outer, 2001), camera_from_object(sensor)[2, 3]
    per_radiance = np.trapezoid(2 * np.pi * radius * depth**2 / (depth**2 + radius**2) ** 2, radius)
    working = 100.0 * (1 + camera.focal_length_mm / (camera.focus_distance_mm - camera.focal_length_mm))
    expected = 0.02 * 4e-6 / per_radiance * np.pi / 4 / working**2
    cosine = 1 / np.sqrt(1 + ((x - cx) ** 2 + (y - cy) ** 2) / focal**2)
    np.testing.assert_allclose((image / cosine**4)[on_ring], expected, rtol=0.02)
    # At f/4 the ring is blurred over a sixth of its width more, and keeps its light: irradiance grows by 25 squared.
    assert (images[1] > 0.02 * images[1].max()).sum() > 1.1 * (image > 0.02 * image.max()).sum()
    assert images[1].max() == pytest.approx(625 * image.max(), rel=0.1)


def test_dirt_takes_its_share_in_patches_as_wide_as_the_pupil(sensor):
    shares = np.array([dirt(sensor.camera, 0.2, seed=seed) for seed in range(12)])
    assert shares.shape[1:] == (128, 160) and shares.min() >= 0 and shares.max() <= 1
    # Each image sees the window through some tens of spots: its mean share is free to 0.05, that of 12 to 0.015.
    assert shares.mean() == pytest.approx(0.8, abs=0.06)
    assert shares.std() > 0.01
    # Blurred over the pupil, it changes little from one pixel to the next.
    assert np.abs(np.diff(shares, axis=2)).max() < 0.25
    np.testing.assert_array_equal(shares[3], dirt(sensor.camera, 0.2, seed=3))


def test_a_rolling_shutter_delays_the_rows_of_a_moving_sensor(sensor):
    scene = scene_of(plate(), motion={"speed_mm_per_s": 40.0})
    studios = [
        SensorSimulator(sensor, scene, Options(effects=replace(NONE, motion=True), flaws=Flaws.parse(*effects)))
        for effects in (["rolling-shutter=25"], [])
    ]
    travels = [each.travel(next(scene.motion.shots())) for each in studios]
    assert [travel.row_s for travel in travels if travel] == pytest.approx([25e-6, 0.0])
    assert [travel.velocity_mm_s[0] for travel in travels if travel] == pytest.approx([40.0, 40.0])


def test_lamp_and_laser_together_are_the_sum_of_both(sensor, apart):
    together = studio(sensor, "lamp-and-laser")
    lamp, laser = apart.scene.motion.shots()
    parts = [apart.electrons_per_ms(shot, spp=16, seed=0) for shot in (lamp, laser)]
    assert min(part.max() for part in parts) > 0
    for shot in (lamp, laser):
        np.testing.assert_allclose(together.electrons_per_ms(shot, spp=16, seed=0), sum(parts), rtol=1e-6)
        np.testing.assert_array_equal(together.truth(shot).centre_px, apart.truth(laser).centre_px)
    assert (together.truth(lamp).status == TruthStatus.VISIBLE).any()
    assert (apart.truth(lamp).status == TruthStatus.NO_STRIPE).all()


def test_exposures_suit_what_is_seen(sensor):
    auto = altered(sensor, {"exposure": {"laser_ms": "auto", "lamp_ms": "auto"}})
    apart, together, dimmed = (
        studio(auto, *effects).exposure_ms for effects in ((), ("lamp-and-laser",), ("glare=0.5",))
    )
    assert together["lamp"] == together["laser"] < min(apart.values())
    assert dimmed["laser"] > 1.5 * apart["laser"], "of the stripe's light half is lost to the veil"


def test_laser_light_passes_red_filters_and_the_lamps_all(sensor, apart):
    colour = studio(sensor, "colour-filter")
    shots = apart.scene.motion.shots()
    seen = [[each.electrons_per_ms(shot, spp=16, seed=0) for each in (apart, colour)] for shot in shots]
    np.testing.assert_array_equal(*seen[0])
    plain, filtered = seen[1]
    np.testing.assert_array_equal(filtered[::2, ::2], plain[::2, ::2])
    assert filtered[1::2].sum() < 0.1 * plain[1::2].sum()


def test_the_uneven_lamp_lights_places_and_not_pixels(sensor):
    medium, loss, z = clear(), 0.6, 30.0
    even, uneven = (
        Renderer(sensor, medium, scene_of(plate(z)), effects=NONE, flaws=Flaws(uneven_lamp=share))
        for share in (0.0, loss)
    )
    ratio = uneven.irradiance("lamp", sensor_at(), spp=16) / even.irradiance("lamp", sensor_at(), spp=16)
    x, y = (g.ravel() for g in np.meshgrid(np.linspace(-50, 50, 11), np.linspace(-45, 45, 11)))
    points = np.stack([x, y, np.full_like(x, z)], axis=1)
    rays = oracle_paths(sensor, medium, points)[0]
    camera = sensor.camera
    pixels = rays[:, :2] / rays[:, 2:] * camera.focal_length_px() + camera.principal_point()
    column, row = np.rint(pixels).astype(int).T
    inside = (column > 0) & (column < 159) & (row > 0) & (row < 127)
    assert inside.sum() > 80
    axes, standoff = camera_axes(sensor)
    slopes = (points @ axes.T + standoff)[:, :2] / (points @ axes.T + standoff)[:, 2:]
    corner = np.hypot(160, 128) / 2 / camera.focal_length_px()
    expected = (1 - loss) ** (((slopes / corner - (0.25, 0.0)) ** 2).sum(axis=1))
    # The nearest pixel is up to half a pixel away, 1/200 of the diagonal, and the spot falls by up to 3 over that.
    np.testing.assert_allclose(ratio[row[inside], column[inside]], expected[inside], rtol=0.02)
    assert np.ptp(expected[inside]) > 0.3
    by_pixel = (1 - loss) ** ((((rays[:, :2] / rays[:, 2:]) / corner - (0.25, 0.0)) ** 2).sum(axis=1))
    assert np.abs(by_pixel / expected - 1).max() > 0.1, "refraction would be noticed"


def test_a_plate_cut_off_by_the_image_is_seen_as_in_a_larger_one(thesis):
    board = {"kind": "target_plate", "target": {"kind": "chessboard", "columns": 6, "rows": 4, "square_mm": 12.0}}
    scene = scene_of(board | {"position_mm": (10.0, 30.0, 0.0), "rotation_deg": (10.0, 15.0, 5.0)})
    whole, cut = cropped(thesis, 640, 480), cropped(thesis, 200, 160)
    large, small = (
        Renderer(each, clear(), scene, effects=NONE).irradiance("lamp", sensor_at(), spp=16) for each in (whole, cut)
    )
    assert small.std() > 0.3 * small.mean(), "part of the board is in view"
    # Coordinates of 32 bits, counted from other corners, may take a sample at an edge to its other side.
    off = np.abs(small - large[160:320, 220:420]) > 0.01 * small.max()
    assert off.mean() < 0.01


def test_the_capture_states_the_drawings_and_lists_the_flaws(sensor, tmp_path):
    path, asked = tmp_path / "scan.h5", ["pixel-aspect=1.01", "tangential", "jpeg=80"]
    scene = scene_of(plate(), motion={"lights": ("lamp",)})
    record_scene(scene, sensor, path, options=Options(flaws=Flaws.parse(*asked)))
    with Capture(path) as capture:
        assert capture.header.sensor == sensor
        assert capture.header.provenance["effects"][-3:] == ["pixel-aspect=1.01", "tangential=0.001", "jpeg=80"]
    built = read_truth(truth_path(path))[0].sensor.camera
    assert (built.pixel_aspect, built.distortion.p1) == (1.01, 0.001)
