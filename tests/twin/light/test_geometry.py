"""Paths of the twin's rays: lens, windows and sheet against OpenCV's lens and Fermat's principle, in double precision.

The twin computes in single precision. A coordinate of 400 mm has an error of 3e-5 mm and a direction of 6e-8, which is
3e-5 mm again over 500 mm. About ten such independent errors on a ray's path through lens, window and frames add up to
1e-4 mm. ``RAY_MM`` allows three times that for the largest error.
"""

import math

import cv2
import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.oracles import fermat
from tests.oracles.drawings import equidistant
from tests.virtual_sensors import (
    altered,
    camera_axes,
    laser_origin,
    oracle_fan,
    oracle_window,
    plate,
    scene_of,
    sensor_at,
)
from twin.backend.arrays import to_jit, to_numpy
from twin.light.camera import LensRays, WindowFaces, build_frame
from twin.light.pose import SensorPose
from twin.light.renderer import Renderer
from twin.light.sheet import Sheet
from uwlts.model.placement import camera_from_object
from uwlts.model.sensor import Camera, Medium, Sensor, Window
from uwlts.storage.import_.camera_files import convert_equidistant

RAY_MM = 3e-4

STRONG = {"k1": -0.25, "k2": 0.12, "k3": 0.05, "p1": 0.004, "p2": -0.006}
SENSORS = {
    "thesis": ("water", {}),
    "as-built": (
        "water",
        {"camera": {"focal_length_mm": 12.93, "principal_point_px": (646.2, 505.9)}, "laser": {"roll_deg": 4.0}},
    ),
    "tilted": ("water", {"camera": {"window": {"tilt_x_deg": 5.0, "tilt_y_deg": -5.0, "aperture_diameter_mm": 80.0}}}),
    "thick": ("water", {"camera": {"window": {"distance_mm": 15.0, "thickness_mm": 25.0, "glass": 1.75}}}),
    "distorted": ("water", {"camera": {"distortion": STRONG}}),
    "oblong": ("water", {"camera": {"pixel_aspect": 1.05, "principal_point_px": (646.2, 505.9)}}),
    "upright": ("water", {"camera": {"stripe_along": "height"}, "laser": {"triangulation_angle_deg": 38.0}}),
    "air": ("air", {"camera": {"window": {"mounted": False}}}),
    "air, window": ("air", {}),
}


def built(thesis: Sensor, name: str) -> Renderer:
    medium, changes = SENSORS[name]
    sensor = altered(thesis, changes)
    return Renderer(sensor, sensor.media[medium], scene_of(plate(side=900.0)))


def image_points(camera: Camera, count: int = 200) -> np.ndarray:
    """Image points (count, 2) all over the image, its outer corners first; exact in 32 bits."""
    outer = np.array([camera.width_px, camera.height_px]) - 0.5
    corners = np.array([(x, y) for x in (-0.5, outer[0]) for y in (-0.5, outer[1])])
    inside = np.random.default_rng(0).uniform(-0.5, outer, (count - 4, 2))
    return np.concatenate([corners, inside]).astype(np.float32).astype(float)


def opencv_matrix(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Camera matrix and coefficients as OpenCV takes them."""
    fx, (cx, cy), d = camera.focal_length_px(), camera.principal_point(), camera.distortion
    matrix = np.array([[fx, 0, cx], [0, camera.pixel_aspect * fx, cy], [0, 0, 1.0]])
    return matrix, np.array(list(d.model_dump().values()))


def opencv_directions(camera: Camera, pixels: np.ndarray) -> np.ndarray:
    """Unit directions (N, 3) of image points by OpenCV's own inversion of its lens model."""
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 1000, 1e-14)
    plane = cv2.undistortPoints(pixels[:, None], *opencv_matrix(camera), None, None, None, criteria)[:, 0]
    rays = np.concatenate([plane, np.ones((len(plane), 1))], axis=1)
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)


def opencv_pixels(camera: Camera, rays: np.ndarray) -> np.ndarray:
    """Image points (N, 2) of directions (N, 3)."""
    return cv2.projectPoints(rays, np.zeros(3), np.zeros(3), *opencv_matrix(camera))[0][:, 0]


def hits(renderer: Renderer, pixels: np.ndarray, z: float) -> np.ndarray:
    """Return the points (N, 3) in the OCS where image points see the plate at ``z``, by Mitsuba."""
    pose = SensorPose(sensor_at(-z))
    bundle = renderer.view.trace_bundle(to_jit(pixels[:, 0]), to_jit(pixels[:, 1]))
    si = renderer.objects.scene.ray_intersect(pose.ray(bundle.origin, bundle.direction))
    seen = si.is_valid() & (bundle.weight > 0)
    dr.eval(si.p, seen)
    assert seen.numpy().all()
    return si.p.numpy().T.astype(float) + [0.0, 0.0, z]


def oracle_hits(sensor: Sensor, medium: Medium, pixels: np.ndarray, z: float, guess: np.ndarray) -> np.ndarray:
    """The same by OpenCV's lens and the path of least time; ``guess`` (N, 3) only starts the search."""
    axes, standoff = camera_axes(sensor)
    rays = opencv_directions(sensor.camera, pixels)
    plane = fermat.Face(axes @ [0.0, 0.0, z] + standoff, axes[:, 2])
    faces, indices = oracle_window(sensor.camera.window, medium)
    if not faces:
        way = (plane.point @ plane.normal) / (rays @ plane.normal)
        return (rays * way[:, None] - standoff) @ axes
    start = (guess + [2.0, -3.0, 0.0]) @ axes.T + standoff
    return (fermat.points_seen_on_plane(rays, plane, start, faces, indices) - standoff) @ axes


@pytest.mark.parametrize("name", SENSORS)
def test_every_pixel_sees_what_light_of_least_time_shows_it(thesis, name):
    renderer = built(thesis, name)
    sensor, medium = renderer.sensor, renderer.medium
    pixels = image_points(sensor.camera)
    for z in (-70.0, 100.0):
        found = hits(renderer, pixels, z)
        expected = oracle_hits(sensor, medium, pixels, z, found)
        assert np.linalg.norm(found - expected, axis=1).max() < RAY_MM
        # The first pixel's centre is (0, 0), not (0.5, 0.5): half a pixel is 0.08 mm.
        shifted = oracle_hits(sensor, medium, pixels[:50] + 0.5, z, found[:50])
        assert np.linalg.norm(found[:50] - shifted, axis=1).min() > 100 * RAY_MM


def test_a_slightly_wrong_window_would_be_noticed(thesis):
    renderer = built(thesis, "tilted")
    sensor = renderer.sensor
    pixels = image_points(sensor.camera, 50)
    found = hits(renderer, pixels, 0.0)
    wrongs = {"distance_mm": 62.83, "thickness_mm": 5.96, "glass": 1.522, "tilt_x_deg": 5.03, "tilt_y_deg": -5.03}
    for key, value in wrongs.items():
        other = altered(sensor, {"camera": {"window": {key: value}}})
        assert (
            np.linalg.norm(found - oracle_hits(other, renderer.medium, pixels, 0.0, found), axis=1).max() > 3 * RAY_MM
        ), key


@pytest.mark.parametrize(
    "distortion",
    [
        {},
        {"k1": -0.085, "k2": 0.09},
        STRONG,
        {"k1": 0.4, "k2": -0.3, "p2": 0.01},
        STRONG | {"k4": 0.6, "k5": -0.2, "k6": 0.3},
    ],
    ids=["none", "mild", "strong", "pincushion", "rational"],
)
def test_the_lens_inverts_opencvs_distortion(thesis, distortion):
    camera = altered(thesis, {"camera": {"distortion": distortion, "principal_point_px": (633.3, 517.7)}}).camera
    pixels = image_points(camera)
    lens = LensRays(camera).directions(to_jit(pixels[:, 0]), to_jit(pixels[:, 1]))
    rays = to_numpy(lens).astype(float)
    # 32 bits: a pixel near 1279 is known to 6e-5 px, and some ten roundings of 6e-8 at the focal length of 2358 px
    # add up to 5e-4 px.
    np.testing.assert_allclose(opencv_pixels(camera, rays), pixels, rtol=0, atol=1e-3)
    np.testing.assert_allclose(rays, opencv_directions(camera, pixels), rtol=0, atol=4e-7)
    np.testing.assert_allclose(np.linalg.norm(rays, axis=1), 1.0, rtol=0, atol=2e-7)


def test_a_wide_equidistant_lens_is_followed_to_its_corners(thesis):
    """Corners are 65 deg from the axis; the rays of the drawing share no formula with the rational model."""
    focal, centre = 720.0, (639.5, 511.5)
    distortion = convert_equidistant(np.zeros(4), corner=819.0 / focal, focal_px=focal, source="test").model_dump()
    size_um = thesis.camera.pixel_size_um
    changes = {"distortion": distortion, "focal_length_mm": 1e-3 * focal * size_um, "principal_point_px": centre}
    camera, pixels = altered(thesis, {"camera": changes}).camera, image_points(thesis.camera)
    rays = to_numpy(LensRays(camera).directions(to_jit(pixels[:, 0]), to_jit(pixels[:, 1])))
    # 0.02 px by the conversion, of 720 px.
    np.testing.assert_allclose(rays, equidistant(focal, centre)(pixels), rtol=0, atol=3e-5)


@pytest.mark.parametrize(
    "changes", [{}, {"roll_deg": 12.0}, {"roll_deg": -30.0}], ids=["straight", "roll 12", "roll -30"]
)
@pytest.mark.parametrize("along", ["width", "height"])
def test_the_object_frame_lies_where_the_description_says(thesis, along, changes):
    sensor = altered(thesis, {"camera": {"stripe_along": along}, "laser": changes})
    axes, origin = camera_axes(sensor)
    pose = camera_from_object(sensor)
    np.testing.assert_allclose(pose[:3, :3], axes, rtol=0, atol=1e-15)
    np.testing.assert_allclose(pose[:3, 3], origin, rtol=0, atol=1e-12)


def window_of(**changes: object) -> Window:
    plain = {"distance_mm": 40.0, "thickness_mm": 8.0, "glass": 1.52, "aperture_diameter_mm": 60.0}
    return Window.model_validate(plain | changes)


def sent_through(window: Window, medium: Medium, angles: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rays at angles to the axis in the x-z plane: origins, directions (N, 3) behind the window, and which passed."""
    faces = WindowFaces(window, medium, wavelength_nm=635.0, origin_mm=np.zeros(3), rotation=np.eye(3))
    x, z = to_jit(np.sin(angles)), to_jit(np.cos(angles))
    path = faces.trace(mi.Point3f(0.0, 0.0, 0.0), mi.Vector3f(x, 0.0, z), mode=mi.TransportMode.Radiance)
    return to_numpy(path.origin), to_numpy(path.direction), path.weight.numpy() > 0


def test_the_aperture_blocks_rays_outside_it():
    window, medium = window_of(), Medium(kind="custom", index=1.33)
    # A ray passes if it meets both faces within 30 mm of their centres; the outer one is the narrower for a cone.
    angle = np.linspace(-1.2, 1.2, 2001)
    at_outer = 40.0 * np.tan(angle) + 8.0 * np.tan(np.arcsin(np.sin(angle) / 1.52))
    passes = np.abs(at_outer) < 30.0
    assert 500 < passes.sum() < 1500
    clear_cut = np.abs(np.abs(at_outer) - 30.0) > 1e-4
    assert clear_cut.sum() > 1990
    np.testing.assert_array_equal(sent_through(window, medium, angle)[2][clear_cut], passes[clear_cut])


def test_rays_leave_the_window_where_and_how_least_time_says():
    window, medium = window_of(tilt_y_deg=10.0), Medium(kind="custom", index=1.33)
    angle = np.linspace(-0.5, 0.5, 101)
    origin, direction, passed = sent_through(window, medium, angle)
    assert passed.all()
    faces, indices = oracle_window(window, medium)
    far = origin.astype(float) + 300.0 * direction
    crossing = fermat.least_time_crossings(np.zeros(3), far, faces, indices)
    np.testing.assert_allclose(crossing[:, 0, 0] / crossing[:, 0, 2], np.tan(angle), rtol=0, atol=RAY_MM / 300)
    # The path starts on the outer face, to some roundings of 32 bits at 60 mm (4e-6 mm).
    np.testing.assert_allclose(origin, crossing[:, 1], rtol=0, atol=2e-5)


def test_frames_are_right_handed_and_follow_their_axis():
    random = np.random.default_rng(0)
    for _ in range(50):
        axis, across = random.normal(size=(2, 3))
        frame = build_frame(axis, across)
        np.testing.assert_allclose(frame.T @ frame, np.eye(3), atol=1e-14)
        assert np.linalg.det(frame) > 0
        assert frame[:, 2] @ axis == pytest.approx(np.linalg.norm(axis))
        assert frame[:, 0] @ across > 0


def sheet_points(sensor: Sensor, medium: Medium, angle: np.ndarray, z: float) -> np.ndarray:
    """Points (N, 3) of the sheet in the OCS where fan rays reach ``z``, by least time through the laser's window."""
    origin = laser_origin(sensor)
    faces, indices = oracle_window(sensor.laser.window, medium)
    rays = np.stack([0 * angle, np.sin(angle), np.cos(angle)], axis=1)
    plane = fermat.Face(np.array([0.0, 0.0, z - origin[2]]), np.array([0.0, 0.0, 1.0]))
    guess = rays / rays[:, 2:] * plane.point[2]
    return fermat.points_seen_on_plane(rays, plane, guess, faces, indices) + origin


def light_at(sheet: Sheet, points: np.ndarray) -> dict[str, np.ndarray]:
    """Return the light of the sheet at points (N, 3) as NumPy arrays."""
    light = sheet.evaluate(mi.Point3f(*[to_jit(column) for column in points.T]))
    dr.eval(light)
    values = {
        name: getattr(light, name).numpy().astype(float)
        for name in ("distance_mm", "sigma_mm", "irradiance", "exit_mm")
    }
    return values | {
        "direction": to_numpy(light.direction).astype(float),
        "normal": to_numpy(light.normal).astype(float),
    }


ANGLES = np.radians(np.linspace(-22.4, 22.4, 57))


def test_behind_an_untilted_window_the_sheet_is_the_plane_x_0(thesis):
    medium = thesis.media["water"]
    sheet, fan, origin = Sheet(thesis, medium), oracle_fan(thesis, medium), laser_origin(thesis)
    for z in (-120.0, 0.0, 130.0):
        along = fan.y(ANGLES, z - origin[2])
        light = light_at(sheet, np.stack([0 * along, along, np.full_like(along, z)], axis=1))
        np.testing.assert_allclose(light["distance_mm"], 0.0, atol=1e-4)
        np.testing.assert_allclose(light["exit_mm"], fan.way_in_medium(ANGLES, z - origin[2]), rtol=0, atol=2e-3)
        slope = fan.slopes(ANGLES)[2]
        straight = np.stack([0 * slope, slope, np.ones_like(slope)], axis=1) / np.hypot(1, slope)[:, None]
        np.testing.assert_allclose(light["direction"], straight, rtol=0, atol=1e-6)
        np.testing.assert_allclose(light["normal"], [[1.0, 0.0, 0.0]] * len(slope), rtol=0, atol=1e-6)


def test_the_fan_ends_at_its_edges(thesis):
    medium = thesis.media["water"]
    sheet, fan, origin = Sheet(thesis, medium), oracle_fan(thesis, medium), laser_origin(thesis)
    edge = fan.y(np.array([math.radians(22.5)]), 30.0 - origin[2])[0]
    for side in (-1, 1):
        points = np.array([[0.0, side * (edge - 1e-3), 30.0], [0.0, side * (edge + 1e-3), 30.0]])
        inside, outside = light_at(sheet, points)["irradiance"]
        assert inside > 0
        assert outside == 0


@pytest.mark.parametrize("roll", [0.0, 7.0])
def test_behind_a_tilted_window_the_sheet_is_bent_as_least_time_says(thesis, roll):
    window = {"tilt_x_deg": 3.0, "tilt_y_deg": 8.0, "aperture_diameter_mm": 60.0}
    sensor = altered(thesis, {"laser": {"window": window, "roll_deg": roll}})
    medium = sensor.media["water"]
    sheet = Sheet(sensor, medium)
    for z in (-120.0, 0.0, 130.0):
        points = sheet_points(sensor, medium, ANGLES, z)
        np.testing.assert_allclose(light_at(sheet, points)["distance_mm"], 0.0, atol=RAY_MM)
        x, y = points[:, 0], points[:, 1]
        assert np.abs(x).min() > 1.0, "the tilt must move the sheet away from the nominal plane"
        assert np.abs(x - np.polyval(np.polyfit(y, x, 1), y)).max() > 0.1, "and bend it"
        near, far = sheet_points(sensor, medium, ANGLES, z), sheet_points(sensor, medium, ANGLES, z + 50.0)
        straight = (far - near) / np.linalg.norm(far - near, axis=1, keepdims=True)
        np.testing.assert_allclose(light_at(sheet, points)["direction"], straight, rtol=0, atol=2e-6)


@pytest.mark.parametrize("along", ["width", "height"])
def test_roll_turns_the_sheet_about_the_lasers_axis(thesis, along):
    straight = altered(thesis, {"camera": {"stripe_along": along}})
    rolled = altered(straight, {"laser": {"roll_deg": 10.0}})
    medium = thesis.media["water"]
    axes, standoff = camera_axes(straight)
    origin = laser_origin(straight) @ axes.T + standoff
    spread = np.linspace(-60, 60, 25)
    flat = spread[:, None] * axes[:, 1] + 450.0 * axes[:, 2]  # points of the straight sheet, seen from the laser
    turned = Rotation.from_rotvec(math.radians(10.0) * axes[:, 2]).apply(flat)
    to_object = np.linalg.inv(camera_from_object(rolled))
    sheet = Sheet(rolled, medium)
    lit, beside = ((p + origin) @ to_object[:3, :3].T + to_object[:3, 3] for p in (turned, flat))
    np.testing.assert_allclose(light_at(sheet, lit)["distance_mm"], 0.0, atol=1e-4)
    # Points of the unrolled sheet are displaced by y sin 10 deg from the rolled one.
    np.testing.assert_allclose(light_at(sheet, beside)["distance_mm"], spread * math.sin(math.radians(10)), atol=1e-4)
