"""Design formulas: the thesis's published numbers, derivatives by differences, and windows by Fermat's principle."""

import math
import sys

import cv2
import numpy as np
import pytest

from tests.oracles import fermat
from tests.virtual_sensors import altered
from uwlts import cli
from uwlts.errors import DesignError
from uwlts.model.placement import camera_from_object, laser_pose, view_of_sheet
from uwlts.model.sensor import Sensor
from uwlts.optics import design as g
from uwlts.optics.nominal import design, format_table

ANGLE = math.radians(35)
STANDOFF = 265 / math.tan(ANGLE)
TILTED = {"camera": {"window": {"tilt_x_deg": 8.0, "tilt_y_deg": -5.0}}}
HEIGHT = {"camera": {"stripe_along": "height"}}
ROLLED = {"laser": {"roll_deg": 12.0}}
OBLONG = {"camera": {"pixel_aspect": 1.05}}
RATIONAL = {"camera": {"distortion": {"p1": 0.004, "k3": 0.05, "k4": 0.6, "k5": -0.2, "k6": 0.3}}}
THICK = {"camera": {"window": {"distance_mm": 20.0, "thickness_mm": 25.0}}}


def geometry_of(sensor: Sensor, medium: str = "water") -> g.SheetGeometry:
    return g.SheetGeometry.from_description(sensor, sensor.media[medium])


def column(points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return tuple(points[:, k] for k in range(3))


def rows(point: tuple) -> np.ndarray:
    return np.stack(np.broadcast_arrays(*point), axis=-1).reshape(-1, 3)


def seen_at(sensor: Sensor, medium: str, points: np.ndarray) -> np.ndarray:
    """Pixels (N, 2) of points (N, 3) in the camera frame, by least time and OpenCV's lens."""
    window, camera = sensor.camera.window, sensor.camera
    faces = fermat.plate(distance=window.distance_mm, thickness=window.thickness_mm, normal=window.normal())
    index = sensor.media[medium].refractive_index(635.0)
    rays = fermat.directions_seen(points, faces, [1.0, window.index(635.0), index])
    (fx, fy), (cx, cy) = camera.focal_lengths_px(), camera.principal_point()
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    coefficients = np.array(list(camera.distortion.model_dump().values()))
    return cv2.projectPoints(rays, np.zeros(3), np.zeros(3), matrix, coefficients)[0][:, 0]


def points_of_sheet(sensor: Sensor, count: int = 200) -> np.ndarray:
    """Random points of the sheet in the camera frame, beyond the window."""
    rng = np.random.default_rng(3)
    own = np.stack([np.zeros(count), rng.uniform(-80, 80, count), rng.uniform(-60, 90, count)], axis=1)
    transform = camera_from_object(sensor)
    return own @ transform[:3, :3].T + transform[:3, 3]


@pytest.mark.parametrize("changes", [{}, TILTED, HEIGHT, ROLLED])
def test_points_of_the_sheet_lie_in_it(thesis, changes):
    sensor = altered(thesis, changes)
    geometry, pose, transform = geometry_of(sensor), laser_pose(sensor), camera_from_object(sensor)
    assert float(g.standoff_mm(geometry.laser)) == pytest.approx(transform[2, 3], rel=1e-12)
    y, z = np.array([-30.0, 0.0, 50.0]), np.array([-20.0, 10.0, 60.0])
    expected = np.stack([0 * y, y, z], axis=1) @ transform[:3, :3].T + transform[:3, 3]
    np.testing.assert_allclose(rows(geometry.point(z, y)), expected, atol=1e-10)
    np.testing.assert_allclose((expected - pose.origin_mm) @ pose.normal, 0.0, atol=1e-10)


@pytest.mark.parametrize("changes", [{}, TILTED, HEIGHT, OBLONG, RATIONAL, THICK])
def test_points_appear_where_light_of_least_time_comes_from(thesis_as_built, changes):
    sensor = altered(thesis_as_built, changes)
    points = points_of_sheet(sensor)
    image = geometry_of(sensor).project(np, column(points))
    # The oracle ends its search at 1e-10 mm or so of path: 1e-8 of a slope, some 1e-5 px.
    np.testing.assert_allclose(np.stack([image.x, image.y], axis=1), seen_at(sensor, "water", points), atol=5e-5)


def test_the_lens_is_opencvs_and_undistorted(thesis_as_built):
    camera = altered(thesis_as_built, {"camera": OBLONG["camera"] | RATIONAL["camera"]}).camera
    (fx, fy), (cx, cy), lens = camera.focal_lengths_px(), camera.principal_point(), g.Lens.from_description(camera)
    points, coefficients = points_of_sheet(thesis_as_built), np.array(list(camera.distortion.model_dump().values()))
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    expected = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, coefficients)[0][:, 0]
    none = g.WindowGeometry((0.0, 0.0, 1.0), 0.0, 0.0, 1.0, 1.0)
    seen = g.project_points(np, lens, none, column(points))
    np.testing.assert_allclose(np.stack([seen.x, seen.y], axis=1), expected, atol=1e-9)
    rays = g.trace_pixels(camera, expected)
    np.testing.assert_allclose(rays / rays[:, 2:], points / points[:, 2:], atol=1e-6)


@pytest.mark.parametrize("changes", [{}, TILTED, OBLONG, RATIONAL])
def test_pixels_per_mm_are_the_differences_of_pixels(thesis_as_built, changes):
    sensor, step = altered(thesis_as_built, changes), 1e-3
    points, geometry = points_of_sheet(sensor), geometry_of(sensor)
    image = geometry.project(np, column(points))
    rng = np.random.default_rng(5)
    for direction in rng.normal(size=(4, 3)):
        direction /= np.linalg.norm(direction)
        ahead, behind = (geometry.project(np, column(points + s * step * direction)) for s in (1, -1))
        dx, dy = g.pixels_per_mm(image, geometry.window, tuple(direction))
        # Central differences leave f''' step^2 / 6, below 1e-9 px/mm here, and 1e-13 * 1000 px / step of rounding.
        np.testing.assert_allclose(dx, (ahead.x - behind.x) / (2 * step), atol=1e-6)
        np.testing.assert_allclose(dy, (ahead.y - behind.y) / (2 * step), atol=1e-6)
        assert np.abs(dx).max() > 0.1


@pytest.mark.parametrize("changes", [{}, TILTED, HEIGHT, ROLLED])
def test_a_pixel_across_the_stripe_moves_the_point_in_the_sheet(thesis_as_built, changes):
    geometry, step = geometry_of(altered(thesis_as_built, changes)), 1e-3
    y, z = np.meshgrid(np.linspace(-50, 50, 7), np.linspace(-40, 60, 7))
    image = geometry.project(np, geometry.point(z, y))
    y_per_px, z_per_px = geometry.mm_per_pixel(image)
    ahead, behind = (
        geometry.project(np, geometry.point(z + s * step * z_per_px, y + s * step * y_per_px)) for s in (1, -1)
    )
    moved = ahead.x - behind.x, ahead.y - behind.y
    # Rounding of 1e-13 * 1000 px, and the third derivative's 1e-6 of the step.
    np.testing.assert_allclose(geometry.across(moved), 2 * step, atol=1e-8)
    np.testing.assert_allclose(geometry.along(moved), 0.0, atol=1e-8)


@pytest.mark.parametrize("medium", ["air", "water"])
@pytest.mark.parametrize("changes", [{}, TILTED, HEIGHT, ROLLED])
def test_line_and_view_end_at_the_edges_of_the_image(thesis_as_built, changes, medium):
    sensor = altered(thesis_as_built, changes)
    geometry, camera = geometry_of(sensor, medium), sensor.camera
    z = np.array([-40.0, 0.0, 60.0])
    ends = [seen_at(sensor, medium, rows(geometry.point(z, y))) for y in geometry.line_ends(np, z)]
    sides = np.array([camera.width_px, camera.height_px])
    along = 0 if camera.stripe_along == "width" else 1
    found = np.sort(np.stack([end[:, along] for end in ends]), axis=0)
    # Five Newton steps from the middle; the oracle contributes 1e-5 px.
    np.testing.assert_allclose(found, np.array([[-0.5], [sides[along] - 0.5]]) * np.ones(3), atol=1e-4)
    outer = camera.window.distance_mm + camera.window.thickness_mm
    depths = np.array(geometry.depths_in_view(np, outer))
    assert outer < depths[0] < depths[1]
    middle = (depths - g.standoff_mm(geometry.laser)) / geometry.laser.axis[2]
    edges = np.sort(seen_at(sensor, medium, rows(geometry.point(middle)))[:, 1 - along])
    np.testing.assert_allclose(edges, [-0.5, sides[1 - along] - 0.5], atol=1e-4)


def test_in_air_the_equations_are_the_thesis(thesis):
    sensor = altered(thesis, {"camera": {"window": {"mounted": False}}})
    geometry, camera = geometry_of(sensor, "air"), sensor.camera
    points = points_of_sheet(sensor)
    image = geometry.project(np, column(points))
    cx, cy = camera.principal_point()
    u, v, f, s = image.y - cy, image.x - cx, camera.focal_length_mm, 1e-3 * camera.pixel_size_um
    bracket = f * math.tan(ANGLE) - s * u
    np.testing.assert_allclose(points[:, 2], 265 * f / bracket, rtol=1e-11)  # Eq. 2.8
    np.testing.assert_allclose(points[:, 0], 265 * s * v / bracket, atol=1e-9)  # Eq. 2.10, corrected
    y, z = geometry.mm_per_pixel(image)
    depth = y * geometry.laser.fan[2] + z * geometry.laser.axis[2]
    np.testing.assert_allclose(np.abs(depth), 265 * f * s / bracket**2, rtol=1e-9)  # Eq. 2.9


def test_the_thesis_resolution_is_that_along_the_laser_in_water(thesis):
    # Printed to 0.01, "in the Z direction at the stand-off", in the budget for water.
    table = {row.name: row.value for row in design(thesis, medium="water")}
    in_water = table["depth per pixel at the stand-off"]
    assert in_water / math.cos(ANGLE) == pytest.approx(0.22, abs=0.005)
    assert in_water / math.cos(ANGLE) == pytest.approx(0.2213, abs=5e-5)
    # By hand: a pixel spans 0.0053 / 12.5 of the apparent distance 62.8 + 5.93 / 1.52 + 309.73 / 1.3312 = 299.37 mm,
    # 0.12693 mm, and the sheet leaves the axis by tan 35 deg.
    assert in_water == pytest.approx(0.12693 / 0.70021, abs=2e-5)
    # Air and glass before the water do not magnify: the factor makes the pixel 5 % too fine.
    assert table["depth per pixel by the thesis's factor n"] / in_water == pytest.approx(0.95, abs=0.002)


def test_the_thesis_line_and_volume(thesis):
    water = {row.name: row.value for row in design(thesis, medium="water")}
    # By hand, in test_design_checks.py: 80.226 mm to each side, 234.92 to 429.39 mm. The thesis prints 200 to 420 mm.
    assert water["line length at the stand-off"] == pytest.approx(160.45, abs=0.01)
    names = ("sheet in view, nearest to the window", "sheet in view, farthest from the window")
    assert [water[name] for name in names] == pytest.approx([234.92, 429.39], abs=0.15)
    # The published 184 mm are between the values for water and air at the stand-off. In water, they occur 60 mm behind.
    low, high = geometry_of(thesis).line_ends(np, 59.9 / math.cos(ANGLE))
    assert high - low == pytest.approx(184.0, abs=0.05)
    bare = altered(thesis, {"camera": {"window": {"mounted": False}}})
    air = {row.name: row.value for row in design(bare, medium="air")}
    assert air["line length at the stand-off"] == pytest.approx(STANDOFF * 6.784 / 12.5)
    # Its 330 mm of depth in air are along the laser; the drawings give 4 % less.
    assert air["depth in view along the laser's axis"] == pytest.approx(330, rel=0.045)
    # The thesis's own recipe has cos 35 deg too much: 168 mm in air.
    assert 1280 * 0.0053 * 265 * math.cos(ANGLE) / (12.5 * math.tan(ANGLE)) == pytest.approx(168.25, abs=0.005)


def test_a_view_without_an_end(thesis):
    # The edge of a large image looks along the sheet where its slope is tan 35 deg: 1651 px from the middle.
    for height, far in ((3306, math.inf), (3298, 1e5)):
        camera = {"height_px": height, "window": {"mounted": False}}
        row = {r.name: r.value for r in design(altered(thesis, {"camera": camera}), medium="air")}
        assert row["sheet in view, farthest from the window"] >= far


def test_the_thesis_scheimpflug_angle():
    def degrees(angle_deg: float, magnification: float) -> float:
        return math.degrees(
            g.scheimpflug_angle_rad(triangulation_angle_rad=math.radians(angle_deg), magnification=magnification)
        )

    # Printed to 0.1: from 250 mm with the complement of the angle, or from the stand-off with the factor 1.33.
    built = 12.5 / (STANDOFF - 12.5)
    assert degrees(90 - 35, 12.5 / 237.5) == pytest.approx(87.9, abs=0.05)
    assert degrees(35, built / 1.33) == pytest.approx(87.9, abs=0.05)
    assert degrees(35, 12.5 / 237.5) == pytest.approx(85.7, abs=0.05)
    assert degrees(35, built) == pytest.approx(87.2, abs=0.05)


def test_object_plane_lens_plane_and_image_plane_meet_in_one_line():
    # Scheimpflug's condition. Points of the sheet through a thin lens at the origin: z is the distance before it, x the
    # coordinate across. Their images are at -x m, and z m behind it, with m = f / (z - f).
    f, z = 12.5, np.array([300.0, STANDOFF, 500.0])
    x = z * math.tan(ANGLE) - 265
    m = f / (z - f)
    slopes = np.diff(-x * m) / np.diff(z * m)
    assert slopes[0] == pytest.approx(slopes[1])
    angle = g.scheimpflug_angle_rad(triangulation_angle_rad=ANGLE, magnification=m[1])
    # The image plane leaves the axis by tan beta.
    assert abs(slopes[0]) == pytest.approx(math.tan(angle), rel=1e-9)


def test_the_thesis_speckle_limit():
    thesis = {"wavelength_nm": 635, "focal_length_mm": 12.5, "f_number": 4, "distance_mm": 250}
    across = g.speckle_limit_um(**thesis) / g.DEPOLARISED_CONTRAST
    assert across == pytest.approx(16, abs=0.5)
    # sin u = 12.5 / 8 / 250 = 1 / 160 but for 2e-5: 160 * 0.635 / (2 pi).
    assert across == pytest.approx(16.170, abs=0.001)
    assert across / math.sin(ANGLE) == pytest.approx(28.2, abs=0.05)
    # Of two independent patterns of equal mean the variances add: 2 (1/2)^2.
    assert pytest.approx(math.sqrt(2 * 0.5**2)) == g.DEPOLARISED_CONTRAST


def test_the_thesis_window_thickness_needs_a_smaller_opening_than_the_bore():
    def thickness(diameter: float, strength: float = 60.0) -> float:
        return g.window_thickness_mm(pressure_mpa=1.0, unsupported_diameter_mm=diameter, strength_mpa=strength)

    # Printed to 0.01 mm; a diameter given to 0.1 mm changes the thickness by that much.
    assert thickness(49.5) == pytest.approx(5.53, abs=0.01)
    assert thickness(63.0) == pytest.approx(7.04, abs=0.005)
    # Over the whole bore it would take stronger glass than there is.
    assert thickness(63.0, 97.3) == pytest.approx(5.53, abs=0.01)
    # The usual rule of makers of windows for a safety factor of 4: 0.866 D sqrt(P / S).
    assert thickness(1.0, 1.0) == pytest.approx(0.866, abs=5e-4)


def test_a_fifth_of_the_pipe_needs_176_mm():
    assert g.line_needed_mm(pipe_diameter_mm=300, passes=5) == pytest.approx(176.3, abs=0.05)
    assert g.line_needed_mm(pipe_diameter_mm=300, passes=6) == pytest.approx(150.0)
    assert g.line_needed_mm(pipe_diameter_mm=300, passes=2) == pytest.approx(300.0)


@pytest.mark.parametrize("along", ["width", "height"])
@pytest.mark.parametrize("medium", ["air", "water"])
def test_the_table_agrees_with_the_view_of_the_sensor(thesis, medium, along):
    sensor = altered(thesis, {"camera": {"stripe_along": along}})
    table = {row.name: row for row in design(sensor, medium=medium)}
    view = view_of_sheet(sensor, sensor.media[medium])
    assert table["stand-off from the window"].value == pytest.approx(view.standoff_mm)
    assert table["line length at the stand-off"].value == pytest.approx(view.line_length_mm)
    # The view is sought in steps of a 2000th of the stand-off.
    assert table["sheet in view, nearest to the window"].value == pytest.approx(view.nearest_mm, abs=0.16)
    assert table["sheet in view, farthest from the window"].value == pytest.approx(view.farthest_mm, abs=0.16)
    lengths = [
        table[f"line length at the {end}"].value for end in ("volume's near end", "stand-off", "volume's far end")
    ]
    assert lengths == sorted(lengths)


def test_the_table_of_the_thesis_sensor(thesis):
    table = {row.name: row for row in design(thesis, medium="water")}
    expected = {
        "depth per pixel along the laser's axis": (0.2213, "mm/px"),
        "depth per pixel by the thesis's factor n": (0.1722, "mm/px"),
        "depth in view along the laser's axis": (237.4, "mm"),
        "line needed for a 300 mm pipe in 5 passes": (176.3, "mm"),
        # 63 sqrt(3 / S) / 2 with the strengths of 60, 275, 45 and 41.4 MPa.
        "fused-silica window for 1 MPa, clamped": (7.044, "mm"),
        "sapphire window for 1 MPa, clamped": (3.290, "mm"),
        "soda-lime window for 1 MPa, clamped": (8.133, "mm"),
        "soda-lime-low-iron window for 1 MPa, clamped": (8.133, "mm"),
        "PMMA window for 1 MPa, clamped": (8.480, "mm"),
        # tan 35 deg * 1.3312 over 12.5 / 299.37.
        "image plane to lens axis, sheet in focus": (87.44, "deg"),
        # 0.635 / (2 pi) over 12.5 / 8 / 299.37, times sqrt(1/2), and over sin 35 deg.
        "speckle limit across the camera's axis": (13.69, "um"),
        "speckle limit along the laser's axis": (23.87, "um"),
    }
    for name, (value, unit) in expected.items():
        assert table[name].value == pytest.approx(value, rel=5e-4), name
        assert table[name].unit == unit
    assert all(row.source for row in table.values())
    # A material of unknown strength has no row, and is named.
    assert not any("N-BK7" in name for name in table)
    assert "without a thickness: N-BK7" in format_table([*table.values()])[-1]


PLACED = {"baseline_mm": None, "triangulation_angle_deg": None}


def test_a_laser_placed_by_its_axis_has_the_same_design(thesis):
    axis = (0.0, math.sin(ANGLE), math.cos(ANGLE))
    # Anywhere on its axis, it makes the same sheet.
    origin = tuple(np.array([0.0, -265.0, 0.0]) + 40 * np.array(axis))
    placed = altered(thesis, {"laser": PLACED | {"origin_mm": origin, "axis": axis}})
    for mine, theirs in zip(design(placed, medium="water"), design(thesis, medium="water"), strict=True):
        assert mine.value == pytest.approx(theirs.value), mine.name


def test_z_of_a_laser_beside_the_camera_runs_along_its_own_axis(thesis):
    # The sheet contains the laser's axis, which also leans sideways. On the image's middle line, where x = 0 crosses
    # the sheet, Z grows with the distance along the laser's axis.
    laser = PLACED | {"origin_mm": (-150.0, -265.0, 0.0), "axis": (150.0, 265.0, 378.5)}
    sensor = altered(thesis, {"laser": laser})
    motion = geometry_of(sensor, "air").crossing_motion()
    axis = np.array(laser["axis"]) / np.linalg.norm(laser["axis"])
    normal = np.array([0.0, -1.0, 0.0]) + axis[1] * axis
    crossing = np.cross([1.0, 0.0, 0.0], normal)
    crossing /= crossing[2]
    assert motion / motion[2] == pytest.approx(crossing, abs=1e-9)


def test_sensors_without_a_design_are_refused(thesis):
    bare = altered(thesis, {"camera": {"window": {"mounted": False}}})
    with pytest.raises(DesignError, match=r"index is 1\.3312: mount it"):
        design(bare, medium="water")
    # A sheet turned by 90 deg about a laser's axis that leans sideways too.
    laser = PLACED | {"origin_mm": (-150.0, 0.0, 0.0), "axis": (150.0, 0.0, 378.5), "roll_deg": 90.0}
    with pytest.raises(DesignError, match="runs across the image's width"):
        design(altered(thesis, {"laser": laser}), medium="water")


def test_the_command_prints_the_table(thesis, monkeypatch, capsys):
    def printed(*arguments: str) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["uwlts", "design", *arguments])
        with pytest.raises(SystemExit) as ended:
            cli.main()
        return ended.value.code, *capsys.readouterr()

    code, out, _ = printed("thesis", "--medium", "water")
    assert code == 0
    assert out.splitlines() == format_table(design(thesis, medium="water"))
    assert "0.2213 mm/px" in out
    code, _, error = printed("thesis", "--medium", "oil")
    assert code == 2
    assert "knows the media air, water, not 'oil'" in error
