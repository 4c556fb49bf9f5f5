"""Sensors and scenes that cannot work are rejected with the numbers that explain it; those that just work pass."""

import math

import numpy as np
import pytest

from tests.oracles import fermat
from tests.virtual_sensors import altered, camera_axes, image_of, oracle_window, plate, scene_of
from twin.light.renderer import Renderer
from twin.light.sheet import Sheet
from twin.recording.sensor_simulator import check_scene
from uwlts.errors import DesignError
from uwlts.model.placement import camera_from_object, check_design, laser_pose, view_of_sheet
from uwlts.model.sensor import Sensor


@pytest.fixture
def water(thesis):
    return thesis.media["water"]


def test_the_thesis_sensor_has_the_thesis_view(thesis, water):
    view = check_design(thesis, water)
    assert view.standoff_mm == pytest.approx(265 / math.tan(math.radians(35)) - 62.8 - 5.93)
    # By hand: the edge is at 0.27136 of the focal length, an angle whose sine is 0.26189 in air, 0.17230 in glass and
    # 0.19673 in water. 62.8 * 0.27136 + 5.93 * 0.17492 + 309.733 * 0.20065 = 80.226 mm to each side.
    assert view.line_length_mm == pytest.approx(2 * 80.226, abs=0.01)
    # Across the stripe the view widens from 14.469 mm by 0.16142 mm per mm of depth; the sheet leaves its middle by
    # tan 35 deg = 0.70021 per mm before and behind the stand-off. They meet at 234.92 and 429.39 mm; the view is sought
    # in steps of 0.16 mm. The thesis states 200 to 420 mm.
    assert view.nearest_mm == pytest.approx(234.92, abs=0.2)
    assert view.farthest_mm == pytest.approx(429.39, abs=0.2)


@pytest.mark.parametrize("along", ["width", "height"])
def test_the_line_length_is_what_the_image_shows_at_the_stand_off(thesis, water, along):
    sensor = altered(thesis, {"camera": {"stripe_along": along}})
    half = view_of_sheet(sensor, water).line_length_mm / 2
    edge = image_of(sensor, water, np.array([[0.0, half, 0.0], [0.0, -half, 0.0]]))
    side = 0 if along == "width" else 1
    extent = (sensor.camera.width_px, sensor.camera.height_px)[side]
    np.testing.assert_allclose(np.sort(edge[:, side]), [-0.5, extent - 0.5], rtol=0, atol=1e-6)


def test_the_depth_range_is_what_the_image_shows_of_the_sheet(thesis, water):
    view = view_of_sheet(thesis, water)
    axes, standoff = camera_axes(thesis)
    outer = thesis.camera.window.distance_mm + thesis.camera.window.thickness_mm
    depths = np.array([view.nearest_mm, view.farthest_mm]) + outer
    along_z = (depths - standoff[2]) / axes[2, 2]
    rows = np.sort(image_of(thesis, water, np.stack([0 * along_z, 0 * along_z, along_z], axis=1))[:, 1])
    # The range is searched in steps of depth; a step of 1 mm is 6 px at the near end.
    np.testing.assert_allclose(rows, [-0.5, 1023.5], rtol=0, atol=10.0)


def test_a_camera_window_smaller_than_the_cone_of_view_is_refused(thesis, water):
    # Exit point of the image's corner ray at the window, by least time, plus half the pupil.
    corner = np.array([640.0, 512.0, thesis.camera.focal_length_px()])
    plane = fermat.Face(np.array([0.0, 0.0, 300.0]), np.array([0.0, 0.0, 1.0]))
    faces, indices = oracle_window(thesis.camera.window, water)
    rays = corner[None] / np.linalg.norm(corner)
    seen = fermat.points_seen_on_plane(rays, plane, 300 * rays / rays[:, 2:], faces, indices)
    leaves = fermat.least_time_crossings(np.zeros(3), seen, faces, indices)[0, 1]
    needed = 2 * np.hypot(leaves[0], leaves[1]) + 12.5 / 4

    def with_aperture(diameter: float) -> Sensor:
        return altered(thesis, {"camera": {"window": {"aperture_diameter_mm": diameter}}})

    check_design(with_aperture(needed + 1e-3), water)
    with pytest.raises(DesignError, match=rf"aperture of {needed - 0.2:.1f} mm, .* {needed:.1f} mm wide"):
        check_design(with_aperture(needed - 0.2), water)


def test_a_laser_window_smaller_than_the_fan_is_refused(thesis, water):
    narrow = altered(thesis, {"laser": {"window": {"aperture_diameter_mm": 20.0}}})
    with pytest.raises(DesignError, match=r"laser's window has an aperture of 20\.0 mm, but the fan is 24\.9 mm"):
        check_design(narrow, water)
    # Wide enough at its inner face, 24.85 mm, but not at the outer one.
    between = altered(thesis, {"laser": {"window": {"aperture_diameter_mm": 25.0}}})
    with pytest.raises(DesignError, match=r"45 deg fan does not pass its window of 25 mm"):
        Sheet(between, water)


@pytest.mark.parametrize(
    ("laser", "message"),
    [
        ({"triangulation_angle_deg": 80.0}, r"crosses the camera's axis 46\.7 mm .* outer face at 68\.7 mm"),
        ({"baseline_mm": 30.0}, r"crosses the camera's axis 42\.8 mm"),
        ({"baseline_mm": 1e6}, r"crosses the camera's axis 1428148\.0 mm"),
    ],
)
def test_a_sheet_that_does_not_cross_before_the_window_is_refused(thesis, water, laser, message):
    with pytest.raises(DesignError, match=message):
        check_design(altered(thesis, {"laser": laser}), water)


PLACED = {"baseline_mm": None, "triangulation_angle_deg": None}


def test_a_sheet_that_never_crosses_the_view_is_refused(thesis, water):
    parallel = altered(thesis, {"laser": PLACED | {"origin_mm": (0.0, -265.0, 0.0), "axis": (0.0, 0.0, 1.0)}})
    with pytest.raises(DesignError, match="crosses the camera's axis inf mm"):
        check_design(parallel, water)
    away = altered(thesis, {"laser": PLACED | {"origin_mm": (0.0, -265.0, 0.0), "axis": (0.0, -0.5, 1.0)}})
    with pytest.raises(DesignError, match=r"crosses the camera's axis -530\.0 mm"):
        check_design(away, water)


def test_a_laser_that_shines_along_the_baseline_is_refused(thesis):
    sensor = altered(thesis, {"laser": PLACED | {"origin_mm": (0.0, -265.0, 300.0), "axis": (0.0, 1.0, 0.0)}})
    with pytest.raises(DesignError, match="along the baseline"):
        laser_pose(sensor)


def test_a_volume_in_which_the_sheet_is_out_of_view_is_refused(thesis, water):
    sensor = altered(thesis, {"volume": {"near_mm": 900.0, "far_mm": 1000.0}})
    with pytest.raises(DesignError, match=r"sees the sheet from \d+ to \d+ mm .* reaches from 900 to 1000 mm"):
        check_design(sensor, water)


def test_a_window_taken_off_in_water_is_refused(thesis, water):
    bare = altered(thesis, {"camera": {"window": {"mounted": False}}})
    with pytest.raises(DesignError, match="in water"):
        Renderer(bare, water, scene_of(plate()))


def test_objects_outside_the_measuring_volume_are_refused(thesis, water):
    # The volume reaches 200 to 420 mm from the window's outer face, along Z / cos 35 deg about 309.7 mm.
    outer = 265 / math.tan(math.radians(35)) - 68.73
    nearest, farthest = ((edge - outer) / math.cos(math.radians(35)) for edge in (200.0, 420.0))
    for z in (nearest - 0.1, farthest + 0.1):
        scene = scene_of(plate(z))
        renderer = Renderer(thesis, water, scene)
        with pytest.raises(DesignError, match=rf"Z = {z:.1f} to {z:.1f} mm .* from {nearest:.1f} to {farthest:.1f} mm"):
            check_scene(renderer, scene)
    for z in (nearest + 0.1, farthest - 0.1):
        scene = scene_of(plate(z))
        check_scene(Renderer(thesis, water, scene), scene)


def test_a_stand_off_of_a_scene_outside_the_measuring_volume_is_refused(thesis, water):
    # The plate is wide enough to reach into the volume although the scene's stand-off, at 145.5 mm, does not.
    near = altered(thesis, {"laser": {"baseline_mm": 150.0}})
    scene = scene_of(plate(200.0), plate(0.0))
    with pytest.raises(
        DesignError, match=r"stand-off .*placement 'standoff'.* is 145\.5 mm .*200 to 420 mm.*volume\.near_mm"
    ):
        check_scene(Renderer(near, water, scene), scene)
    follows = altered(near, {"volume": {"near_mm": 100.0, "far_mm": 400.0}})
    check_scene(Renderer(follows, water, scene), scene)


def test_a_scan_that_never_meets_the_sheet_is_refused(thesis, water):
    ball = {"kind": "sphere", "diameter_mm": 20.0, "position_mm": (50.0, 0.0, 0.0)}
    short = scene_of(ball, motion={"start_mm": 0.0, "step_mm": 1.0, "count": 40})
    renderer = Renderer(thesis, water, short)
    with pytest.raises(DesignError, match=r"between X = 1\.0 and 60\.0 mm, but the sheet is at X = 0"):
        check_scene(renderer, short)
    check_scene(renderer, scene_of(ball, motion={"start_mm": 0.0, "step_mm": 1.0, "count": 42}))


def test_the_object_frame_of_a_laser_placed_by_its_axis_has_its_origin_on_the_sheet(thesis):
    laser = PLACED | {"origin_mm": (40.0, -265.0, 5.0), "axis": (0.0, 0.55, 0.8), "roll_deg": 5.0}
    sensor = altered(thesis, {"laser": laser})
    pose = camera_from_object(sensor)
    np.testing.assert_allclose(pose[:2, 3], 0.0, atol=1e-12)
    to_laser = np.linalg.inv(pose) @ [40.0, -265.0, 5.0, 1.0]
    assert to_laser[0] == pytest.approx(0.0, abs=1e-9)
    np.testing.assert_allclose(pose[:3, 2], np.array([0.0, 0.55, 0.8]) / math.hypot(0.55, 0.8), atol=1e-12)
    np.testing.assert_allclose(pose[:3, :3].T @ pose[:3, :3], np.eye(3), atol=1e-12)
    assert np.linalg.det(pose[:3, :3]) == pytest.approx(1.0)


def test_the_view_in_water_is_narrower_than_in_air(thesis, water):
    wide, narrow = view_of_sheet(thesis, thesis.media["air"]), view_of_sheet(thesis, water)
    assert narrow.line_length_mm < 0.9 * wide.line_length_mm
