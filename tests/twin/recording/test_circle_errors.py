"""Errors of a real target and its stage: print errors of circles, detection errors, a bowed plate, position errors."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.virtual_sensors import altered, camera_axes, scene_of, sensor_at
from twin.light.renderer import Renderer
from twin.recording.frame_truth import find_visible_surfaces
from twin.recording.record_scene import record_scene
from twin.recording.sensor_simulator import SensorSimulator, with_window
from twin.rendering_options import NONE, Options
from twin.scene.description import CirclePlate, Scene
from twin.scene.finish import draw_print_errors
from twin.scene.platforms import Motion, Shot
from uwlts.model.sensor import Sensor
from uwlts.storage.capture import Capture
from uwlts.storage.truth import TruthStatus, read_truth, truth_path
from uwlts.targets.detection import find_circles

pytestmark = pytest.mark.slow

COLUMNS, ROWS, ORIGIN = 7, 5, (2, 3)
PLATE = {
    "kind": "circle_plate",
    "width_mm": 110.0,
    "height_mm": 90.0,
    "columns": COLUMNS,
    "rows": ROWS,
    "origin": ORIGIN,
    "marker_x": (1, 0),
    "marker_y": (0, 1),
    "spacing_x_mm": 9.375,
    "spacing_y_mm": 9.372,
    "diameter_mm": 5.0,
    "marker_diameter_mm": 0.0001,
    "position_mm": (-9.375, 9.372, 0.0),
    "reflectance": 0.1,
    "circle_reflectance": 0.8,
}
IMAGES = 24
LAMP = Shot(stage_mm=0.0, travelled_mm=0.0, light="lamp")


@pytest.fixture(scope="module")
def small(thesis) -> Sensor:
    """The middle of the thesis's view in pixels twice as large, which shows the whole lattice."""
    return altered(thesis, {"camera": {"width_px": 240, "height_px": 260, "pixel_size_um": 10.6}})


@pytest.fixture(scope="module")
def bare(small) -> Sensor:
    return with_window(small, mounted=False)


def lamp_scene(medium: str = "air", **changes: Any) -> Scene:
    motion = {"direction": (0.0, 0.0, 1.0), "lights": ("lamp",)}
    mounted = medium == "water"
    return scene_of(PLATE | changes, medium=medium, motion=motion, window_mounted=mounted)


def lattice_mm(scene: Scene) -> np.ndarray:
    """Return the nominal positions (rows, columns, 3) of the circles in a scene."""
    plate = scene.objects[0]
    column, row = np.meshgrid(np.arange(COLUMNS) - ORIGIN[0], np.arange(ROWS) - ORIGIN[1])
    flat = np.stack([column * plate.spacing_x_mm, row * plate.spacing_y_mm, np.zeros(column.shape)], axis=-1)
    return flat + plate.position_mm


def found_px(image: np.ndarray, expected: np.ndarray) -> np.ndarray:
    """Return the circles (rows, columns, 2) of an image nearest to their expected positions."""
    circles = next(find_circles(image)).centres
    assert len(circles) == ROWS * COLUMNS
    distance = np.linalg.norm(expected[:, :, None] - circles, axis=-1)
    # A spacing is 20 px at least.
    assert distance.min(axis=-1).max() < 5.0
    return circles[distance.argmin(axis=-1)]


def sixteen_bit(irradiance: np.ndarray) -> np.ndarray:
    return np.rint(irradiance * (60000 / irradiance.max())).astype(np.uint16)


def expected_px(sensor: Sensor, points: np.ndarray) -> np.ndarray:
    """Images (rows, columns, 2) of points (rows, columns, 3) seen straight through a pinhole."""
    axes, standoff = camera_axes(sensor)
    seen = points @ axes.T + standoff
    return seen[..., :2] / seen[..., 2:] * sensor.camera.focal_length_px() + sensor.camera.principal_point()


# --- circles off their lattice


def rendered_px(sensor: Sensor, scene: Scene) -> np.ndarray:
    image = Renderer(sensor, sensor.media["air"], scene, effects=NONE).irradiance("lamp", sensor_at(), spp=256)
    return found_px(sixteen_bit(image), expected_px(sensor, lattice_mm(scene)))


@pytest.mark.parametrize("bow_mm", [0.0, 1e-4], ids=["flat", "mesh"])
def test_printed_shifts_move_the_circles(bare, bow_mm):
    """On a flat plate and on the mesh that a bowed one is, which have uv of their own."""
    perfect, printed = (lamp_scene(centre_std_mm=std, bow_mm=bow_mm, errors_seed=5) for std in (0.0, 0.3))
    shifts = draw_print_errors(printed.objects[0])
    moved = rendered_px(bare, printed) - rendered_px(bare, perfect)
    points = lattice_mm(perfect)
    expected = expected_px(bare, points + np.concatenate([shifts, np.zeros((ROWS, COLUMNS, 1))], axis=-1))
    expected -= expected_px(bare, points)
    assert np.abs(expected).max() > 1.5, "circles move by pixels, each another way"
    # Centroids of 256 samples a pixel are good to some 0.01 px.
    np.testing.assert_allclose(moved, expected, atol=0.03)


def test_printed_shifts_have_their_size():
    plate = CirclePlate.model_validate(PLATE | {"columns": 40, "rows": 60, "centre_std_mm": 0.002, "errors_seed": 1})
    shifts = draw_print_errors(plate)
    assert shifts.shape == (60, 40, 2)
    # The standard deviation of 2400 draws is uncertain by 1 / sqrt(4800).
    np.testing.assert_allclose(shifts.std(axis=(0, 1)), 0.002, rtol=4.5 / math.sqrt(4800))
    assert abs(np.corrcoef(shifts[..., 0].ravel(), shifts[..., 1].ravel())[0, 1]) < 4.5 / math.sqrt(2400)
    np.testing.assert_array_equal(shifts, draw_print_errors(plate))
    other = plate.model_copy(update={"errors_seed": 2})
    assert abs(np.corrcoef(shifts.ravel(), draw_print_errors(other).ravel())[0, 1]) < 4.5 / math.sqrt(4800)
    assert not draw_print_errors(plate.model_copy(update={"centre_std_mm": 0.0})).any()


# --- circles found off their places


def studio_of(sensor: Sensor, scene: Scene) -> SensorSimulator:
    return SensorSimulator(sensor, scene, Options(spp=64, effects=NONE))


@pytest.mark.parametrize("medium", ["air", "water"])
def test_detection_errors_have_their_size_in_the_image(small, medium):
    """Through the window in water, too, where everything seems nearer."""
    scene = lamp_scene(medium, detection_std_px=0.6, errors_seed=3)
    studio, perfect = studio_of(small, scene), studio_of(small, lamp_scene(medium))
    still = next(find_circles(perfect.frame(LAMP, 0).image)).centres
    assert len(still) == ROWS * COLUMNS
    offsets = []
    for index in range(IMAGES):
        circles = next(find_circles(studio.frame(LAMP, index).image)).centres
        distance = np.linalg.norm(still[:, None] - circles, axis=-1)
        offsets.append(circles[distance.argmin(axis=1)] - still)
    offsets = np.array(offsets)
    # The plate leans by 35 deg against the camera, about the image's u axis; near the axis, refraction does not matter.
    # The scale is that of the plate's origin, at most 3 % from that of the lattice.
    u, v = offsets.reshape(-1, 2).std(axis=0)
    tolerance = 4.5 / math.sqrt(2 * IMAGES * len(still)) + 0.03
    assert u == pytest.approx(0.6, rel=tolerance)
    assert v == pytest.approx(0.6 * math.cos(math.radians(35)), rel=tolerance)
    # Every image has errors of its own.
    flat = offsets.reshape(IMAGES, -1)
    correlation = np.corrcoef(flat) - np.eye(IMAGES)
    assert np.abs(correlation).max() < 5 / math.sqrt(flat.shape[1])


def test_detection_errors_come_again_with_the_image(small):
    scene = lamp_scene(detection_std_px=0.6, errors_seed=3)
    studio = studio_of(small, scene)
    images = [studio.frame(LAMP, index).image for index in (0, 1, 0)]
    assert (images[0] != images[1]).any()
    np.testing.assert_array_equal(images[0], images[2])
    np.testing.assert_array_equal(studio_of(small, scene).frame(LAMP, 1).image, images[1])
    other = studio_of(small, lamp_scene(detection_std_px=0.6, errors_seed=4)).frame(LAMP, 1).image
    assert (other != images[1]).any()


def test_detection_errors_come_on_top_of_printed_ones(small):
    positions = []
    for printed in (0.0, 0.3):
        scene = lamp_scene(detection_std_px=0.6, errors_seed=5, centre_std_mm=printed)
        expected = expected_px(with_window(small, mounted=False), lattice_mm(scene))
        positions.append(found_px(studio_of(small, scene).frame(LAMP, 2).image, expected))
    shifts = draw_print_errors(scene.objects[0])
    moved = positions[1] - positions[0]
    points = lattice_mm(scene)
    bare = with_window(small, mounted=False)
    expected = expected_px(bare, points + np.concatenate([shifts, np.zeros((ROWS, COLUMNS, 1))], axis=-1))
    # Grey values of 8 bits and 64 samples a pixel leave some 0.03 px.
    np.testing.assert_allclose(moved, expected - expected_px(bare, points), atol=0.1)


def test_detection_errors_are_for_one_plate():
    plates = [CirclePlate.model_validate(PLATE | {"detection_std_px": std}) for std in (0.1, 0.0)]
    with pytest.raises(ValueError, match="detection_std_px is for scenes with one target"):
        Scene(title="two", objects=tuple(plates))
    assert Scene(title="one", objects=plates[:1])
    assert Scene(title="two", objects=plates[1:] * 2)


# --- bowed plates


@pytest.mark.parametrize("bow_mm", [0.02, 0.5, 3.0, -2.0])
def test_a_bowed_plate_is_a_piece_of_a_sphere(thesis, bow_mm):
    width, height = 120.0, 90.0
    sensor = altered(thesis, {"camera": {"width_px": 160, "height_px": 128, "pixel_size_um": 42.4}})
    sensor = with_window(sensor, mounted=False)
    size = {"width_mm": width, "height_mm": height}
    scene = scene_of(PLATE | size | {"position_mm": (2.0, -3.0, 5.0), "bow_mm": bow_mm})
    renderer = Renderer(sensor, sensor.media["air"], scene, effects=NONE)
    depth = find_visible_surfaces(renderer, sensor_at())[0].astype(float)
    v, u = np.nonzero(np.isfinite(depth))
    pinhole = (np.stack([u, v], axis=1) - sensor.camera.principal_point()) / sensor.camera.focal_length_px()
    seen = depth[v, u][:, None] * np.column_stack([pinhole, np.ones(len(u))])
    axes, standoff = camera_axes(sensor)
    x, y, z = ((seen - standoff) @ axes - (2.0, -3.0, 5.0)).T
    assert len(x) > 4000
    assert min(np.ptp(x) - width, np.ptp(y) - height) > -2.0, "seen from end to end"
    assert max(np.ptp(x) - width, np.ptp(y) - height) < 0.01
    corner = math.hypot(width, height) / 2
    radius = (corner**2 + bow_mm**2) / (2 * bow_mm)
    sphere = radius - math.copysign(1, bow_mm) * np.sqrt(radius**2 - x**2 - y**2)
    assert sphere[np.hypot(x, y).argmax()] == pytest.approx(bow_mm, rel=0.1), "the corners are behind the centre"
    # Facets of 1.9 mm x 1.4 mm cut 0.0007 mm off a radius of 940 mm; the paraboloid that stands for the sphere leaves
    # it by corner^4 / 32 radius^3 = 0.0012 mm; depths in 32 bits add 1e-4 mm.
    np.testing.assert_allclose(z, sphere, atol=0.005 if abs(bow_mm) > 0.5 else 5e-4)


# --- positions that the stage misses


def scan(sensor: Sensor, path: Path, **motion: Any):
    """Capture's facts and truth of three profiles of a plate turned by 30 deg."""
    board = {"kind": "plate", "width_mm": 200.0, "height_mm": 120.0, "rotation_deg": (0.0, 30.0, 0.0)}
    known = {"start_mm": -4.0, "step_mm": 4.0, "count": 3}
    record_scene(scene_of(board, motion=known | motion), sensor, path, options=Options(spp=4, effects=NONE))
    with Capture(path) as capture:
        return capture.stage_mm.tolist(), capture.header.stage_direction, read_truth(truth_path(path))[1]


def test_position_errors_move_the_stripe_and_not_what_is_recorded(small, tmp_path):
    stage, _, truth = scan(small, tmp_path / "true.h5")
    stage_off, _, truth_off = scan(small, tmp_path / "off.h5", position_errors_mm=(0.5, 0.0, -0.25))
    assert stage == stage_off == [-4.0, 0.0, 4.0]
    both = (truth.status == TruthStatus.VISIBLE) & (truth_off.status == TruthStatus.VISIBLE)
    assert (both.sum(axis=1) > 100).all()
    lines = both.all(axis=0)
    np.testing.assert_array_equal(truth_off.centre_px[1, lines], truth.centre_px[1, lines])
    # The sensor stands farther along X by the error, and so does the sheet.
    for known, where in ((truth, [-4.0, 0.0, 4.0]), (truth_off, [-3.5, 0.0, 3.75])):
        x = known.point_mm[:, lines, 0]
        np.testing.assert_allclose(x, np.broadcast_to(np.array(where)[:, None], x.shape), atol=2e-3)
    # On the turned plate the stripe's depth changes with it, by 0.3 px a mm at least.
    shift = np.mean(truth_off.centre_px[:, lines] - truth.centre_px[:, lines], axis=1)
    assert abs(shift[0]) > 0.15
    assert shift[2] == pytest.approx(-shift[0] / 2, rel=0.05)
    # The image is that of a stage with a commanded position.
    _, _, sent = scan(small, tmp_path / "sent.h5", start_mm=-3.5, count=1)
    np.testing.assert_array_equal(sent.centre_px[0], truth_off.centre_px[0])


def test_the_capture_states_the_nominal_direction(small, tmp_path):
    askew = {"direction": (1.0, 0.0, 0.01), "nominal_direction": (2.0, 0.0, 0.0)}
    _, direction, truth = scan(small, tmp_path / "askew.h5", **askew)
    _, straight, plain = scan(small, tmp_path / "straight.h5")
    assert direction == straight == (1.0, 0.0, 0.0)
    lines = np.isfinite(truth.centre_px + plain.centre_px).all(axis=0)
    shift = np.mean(truth.centre_px[:, lines] - plain.centre_px[:, lines], axis=1)
    assert shift[1] == 0
    assert shift[0] * shift[2] < 0, "from one side to the other of the middle"


def test_every_position_has_an_error_or_none():
    assert [shot.travelled_mm for shot in Motion(count=2, position_errors_mm=(0.5, -0.5)).shots()] == [0.5, 0.5]
    assert [shot.travelled_mm for shot in Motion(count=2).shots()] == [0.0, 1.0]
    with pytest.raises(ValueError, match="position_errors_mm has 2 values for 3 positions"):
        Motion(count=3, position_errors_mm=(0.5, -0.5))
