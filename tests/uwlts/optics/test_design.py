"""Design formulas: the thesis's published numbers, derivatives by differences, and windows by Fermat's principle."""

import math
import sys
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from tests.oracles import fermat
from tests.virtual_sensors import altered
from uwlts import cli
from uwlts.errors import DesignError, RangeError
from uwlts.model.placement import view_of_sheet
from uwlts.optics.design import (
    CLAMPED,
    UNCLAMPED,
    FlatWindow,
    Triangulation,
    depth_mm,
    depth_per_pixel_mm,
    line_length_mm,
    line_needed_mm,
    measuring_volume,
    nominal_setup,
    pixel_of_depth,
    position_along_mm,
    scheimpflug_angle_rad,
    speckle_limit_um,
    thesis_factor,
    window_thickness_mm,
)
from uwlts.optics.design_table import design, format_table

ANGLE = math.radians(35)
AIR = Triangulation(baseline_mm=265, triangulation_angle_rad=ANGLE, focal_length_mm=12.5, pixel_size_mm=0.0053)
WATER = replace(AIR, window=FlatWindow(distance_mm=62.8, thickness_mm=5.93, glass_index=1.52, medium_index=1.3312))
STANDOFF = 265 / math.tan(ANGLE)
SETUPS = {
    "air": AIR,
    "window in air": replace(WATER, window=replace(WATER.window, medium_index=1.0)),
    "water": WATER,
    "dense and close": replace(
        AIR, window=FlatWindow(distance_mm=20.0, thickness_mm=25.0, glass_index=1.8, medium_index=1.6)
    ),
    "wide": Triangulation(
        baseline_mm=300,
        triangulation_angle_rad=math.radians(60),
        focal_length_mm=4.0,
        pixel_size_mm=0.0055,
        window=FlatWindow(distance_mm=40.0, thickness_mm=8.0, glass_index=1.49, medium_index=1.34),
    ),
}
every_setup = pytest.mark.parametrize("setup", SETUPS.values(), ids=SETUPS.keys())


def in_the_image(setup: Triangulation) -> tuple[np.ndarray, np.ndarray]:
    """Pixels over 1024 x 1280 that see the sheet before the window."""
    volume = measuring_volume(setup, side_px=1024)
    lowest = float(pixel_of_depth(setup, volume.near_mm + 1.0))
    assert -512 <= lowest < 0
    return tuple(g.ravel() for g in np.meshgrid(np.linspace(lowest, 500, 11), np.linspace(-640, 640, 9)))


def faces_of(window: FlatWindow) -> tuple[list[fermat.Face], list[float]]:
    faces = fermat.plate(distance=window.distance_mm, thickness=window.thickness_mm, normal=np.array([0.0, 0.0, 1.0]))
    return faces, [1.0, window.glass_index, window.medium_index]


def seen_at(setup: Triangulation, points: np.ndarray) -> np.ndarray:
    """Pixels u, v (N, 2) of points (N, 3) by least time; x points away from the laser."""
    rays = fermat.directions_seen(points, *faces_of(setup.window))
    return rays[:, :2] / rays[:, 2:] * setup.focal_length_mm / setup.pixel_size_mm


def on_the_sheet(setup: Triangulation, y: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Points (N, 3) of the sheet; the laser stands at -x."""
    y, z = np.broadcast_arrays(y, z)
    return np.stack([z * math.tan(setup.triangulation_angle_rad) - setup.baseline_mm, y, z], axis=1)


@every_setup
def test_pixels_see_the_sheet_where_light_takes_the_least_time(setup):
    u, v = in_the_image(setup)
    z, y = depth_mm(setup, u, v), position_along_mm(setup, u, v)
    assert np.ptp(z) > 100
    if setup is AIR:  # nothing bends the rays, and the formulas are the thesis's own
        bracket = 12.5 * math.tan(ANGLE) - 0.0053 * u
        np.testing.assert_allclose(z, 265 * 12.5 / bracket, rtol=1e-14)
        np.testing.assert_allclose(y, 265 * 0.0053 * v / bracket, rtol=1e-13, atol=1e-13)
        np.testing.assert_allclose(depth_per_pixel_mm(setup, u, v), 265 * 12.5 * 0.0053 / bracket**2, rtol=1e-13)
        return
    # The oracle finds crossings to 1e-11 mm in some 100 mm: 1e-13 of 4000 px and more at grazing angles.
    np.testing.assert_allclose(seen_at(setup, on_the_sheet(setup, y, z)), np.stack([u, v], axis=1), rtol=0, atol=1e-8)


@every_setup
def test_depth_per_pixel_is_the_derivative_of_depth(setup):
    u, v = in_the_image(setup)
    h = 0.01
    difference = (depth_mm(setup, u + h, v) - depth_mm(setup, u - h, v)) / (2 * h)
    # The third derivative gives about (h s / f / 0.1)^2, below 2e-8 for the shortest lens; 1e-13 of a depth over the
    # step gives 1e-9 of a slope above 0.05 mm.
    np.testing.assert_allclose(depth_per_pixel_mm(setup, u, v), difference, rtol=1e-7)


@settings(deadline=None)
@given(
    distance=st.floats(1, 200),
    thickness=st.floats(0, 50),
    glass=st.floats(1, 2),
    index=st.floats(1, 2),
    angle=st.floats(0.1, 1.2),
    beyond=st.floats(1, 2000),
    v=st.floats(-2000, 2000),
)
def test_the_pixel_of_a_depth_sees_that_depth(distance, thickness, glass, index, angle, beyond, v):
    window = FlatWindow(distance_mm=distance, thickness_mm=thickness, glass_index=glass, medium_index=index)
    setup = Triangulation(
        baseline_mm=200, triangulation_angle_rad=angle, focal_length_mm=10.0, pixel_size_mm=0.005, window=window
    )
    z = window.outer_mm + beyond
    u = pixel_of_depth(setup, z, v)
    # Rounding of 1e-16, grown at most by Z / B and by slopes in air that a window close to the pupil makes some 1000.
    assert depth_mm(setup, u, v) == pytest.approx(z, rel=1e-11)


@every_setup
def test_the_ends_of_the_line_appear_at_the_edge_of_the_image(setup):
    if setup is AIR:
        np.testing.assert_allclose(
            line_length_mm(setup, [300.0, 400.0], side_px=1280), 6.784 / 12.5 * np.array([300, 400])
        )
        return
    z = setup.window.outer_mm + np.array([100.0, 200.0, 350.0])
    half = line_length_mm(setup, z, side_px=1280) / 2
    np.testing.assert_allclose(seen_at(setup, on_the_sheet(setup, half, z))[:, 1], 640, rtol=0, atol=1e-8)


@every_setup
def test_the_volume_ends_at_the_edges_of_the_image(setup):
    near, far = measuring_volume(setup, side_px=600)
    assert setup.window.outer_mm < near < far < math.inf
    np.testing.assert_allclose(pixel_of_depth(setup, [near, far]), [-300, 300], rtol=0, atol=1e-9)


def test_a_volume_without_an_end_and_one_that_begins_at_the_window():
    # The edge of a large image looks along the sheet where its slope is tan 35 deg: 1651 px from the middle.
    edge = math.tan(ANGLE) * 12.5 / 0.0053
    assert measuring_volume(AIR, side_px=2 * edge + 1).far_mm == math.inf
    assert 1e5 < measuring_volume(AIR, side_px=2 * edge - 1).far_mm < math.inf
    close = replace(AIR, window=FlatWindow(distance_mm=350.0))
    assert measuring_volume(close, side_px=1024).near_mm == 350.0
    with pytest.raises(RangeError, match=r"leaves the camera's view at 548\.5 mm, before the window"):
        measuring_volume(replace(AIR, window=FlatWindow(distance_mm=549.0)), side_px=1024)


def test_the_thesis_resolution_is_that_along_the_laser_in_water():
    # Printed to 0.01, "in the Z direction at the stand-off", in the budget for water.
    in_water = float(depth_per_pixel_mm(WATER, 0.0))
    assert in_water / math.cos(ANGLE) == pytest.approx(0.22, abs=0.005)
    assert in_water / math.cos(ANGLE) == pytest.approx(0.2213, abs=5e-5)
    # By hand: a pixel spans 0.0053 / 12.5 of the apparent distance 62.8 + 5.93 / 1.52 + 309.73 / 1.3312 = 299.37 mm,
    # 0.12693 mm, and the sheet leaves the axis by tan 35 deg.
    assert in_water == pytest.approx(0.12693 / 0.70021, abs=2e-5)
    # In air it would be 0.28, along the camera's axis 0.18: neither is what the thesis prints.
    assert depth_per_pixel_mm(AIR, 0.0) / math.cos(ANGLE) == pytest.approx(0.2798, abs=1e-4)


def test_the_factor_n_divides_resolution_and_line_length():
    factor = replace(AIR, window=thesis_factor(1.33))
    assert depth_per_pixel_mm(factor, 0.0) == pytest.approx(float(depth_per_pixel_mm(AIR, 0.0)) / 1.33, rel=1e-14)
    assert line_length_mm(factor, STANDOFF, side_px=1280) == pytest.approx(
        float(line_length_mm(AIR, STANDOFF, side_px=1280)) / 1.33, rel=1e-14
    )
    assert pixel_of_depth(factor, depth_mm(factor, 300.0, 200.0), 200.0) == pytest.approx(300.0, rel=1e-12)
    # Air and glass before the water do not magnify: the factor makes the pixel 5 % too fine.
    assert depth_per_pixel_mm(factor, 0.0) / depth_per_pixel_mm(WATER, 0.0) == pytest.approx(0.95, abs=0.002)


def test_the_thesis_line_is_longer_than_its_drawings_give():
    # By hand, in test_design_checks.py: 80.226 mm to each side in water.
    assert line_length_mm(WATER, STANDOFF, side_px=1280) == pytest.approx(160.45, abs=0.01)
    assert line_length_mm(AIR, STANDOFF, side_px=1280) == pytest.approx(STANDOFF * 6.784 / 12.5)
    # The published 184 mm are between the values for water and air at the stand-off. In water, they occur 60 mm behind.
    assert line_length_mm(WATER, STANDOFF + 59.9, side_px=1280) == pytest.approx(184.0, abs=0.05)
    # The thesis's own recipe has cos 35 deg too much: 168 mm in air.
    assert 1280 * 0.0053 * 265 * math.cos(ANGLE) / (12.5 * math.tan(ANGLE)) == pytest.approx(168.25, abs=0.005)


def test_the_thesis_volume():
    near, far = (z - WATER.window.outer_mm for z in measuring_volume(WATER, side_px=1024))
    # By hand, in test_design_checks.py. The thesis prints 200 to 420 mm, of the built sensor.
    assert (near, far) == pytest.approx((234.92, 429.39), abs=0.15)
    # Its 330 mm of depth in air are along the laser; the drawings give 4 % less.
    volume = measuring_volume(AIR, side_px=1024)
    assert (volume.far_mm - volume.near_mm) / math.cos(ANGLE) == pytest.approx(330, rel=0.045)
    assert volume == pytest.approx((265 / (0.70021 + 0.21709), 265 / (0.70021 - 0.21709)), rel=2e-5)


def test_the_thesis_scheimpflug_angle():
    def degrees(angle_deg: float, magnification: float) -> float:
        return math.degrees(
            scheimpflug_angle_rad(triangulation_angle_rad=math.radians(angle_deg), magnification=magnification)
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
    angle = scheimpflug_angle_rad(triangulation_angle_rad=ANGLE, magnification=m[1])
    # The image plane leaves the axis by tan beta.
    assert abs(slopes[0]) == pytest.approx(math.tan(angle), rel=1e-9)


def test_the_thesis_speckle_limit():
    thesis = {"wavelength_nm": 635, "focal_length_mm": 12.5, "f_number": 4, "distance_mm": 250}
    across = speckle_limit_um(**thesis, contrast=1.0)
    assert across == pytest.approx(16, abs=0.5)
    # sin u = 12.5 / 8 / 250 = 1 / 160 but for 2e-5: 160 * 0.635 / (2 pi).
    assert across == pytest.approx(16.170, abs=0.001)
    assert across / math.sin(ANGLE) == pytest.approx(28.2, abs=0.05)
    assert speckle_limit_um(**thesis, contrast=0.5) == pytest.approx(across / 2)
    # Of two independent patterns of equal mean the variances add: 2 (1/2)^2.
    assert speckle_limit_um(**thesis) == pytest.approx(across * math.sqrt(0.5))


def test_the_thesis_window_thickness_needs_a_smaller_opening_than_the_bore():
    def thickness(diameter: float, support: float, strength: float = 60.0) -> float:
        return window_thickness_mm(
            pressure_mpa=1.0, unsupported_diameter_mm=diameter, strength_mpa=strength, support=support
        )

    # Printed to 0.01 mm; a diameter given to 0.1 mm changes the thickness by that much.
    assert thickness(49.5, CLAMPED) == pytest.approx(5.53, abs=0.01)
    assert thickness(40.4, UNCLAMPED) == pytest.approx(5.53, abs=0.01)
    assert thickness(63.0, CLAMPED) == pytest.approx(7.04, abs=0.005)
    # Over the whole bore it would take stronger glass than there is.
    assert thickness(63.0, CLAMPED, 97.3) == pytest.approx(5.53, abs=0.01)
    assert thickness(63.0, UNCLAMPED, 146.0) == pytest.approx(5.53, abs=0.01)
    # The usual rules of makers of windows for a safety factor of 4: 0.866 and 1.06 D sqrt(P / S).
    assert thickness(1.0, CLAMPED, 1.0) == pytest.approx(0.866, abs=5e-4)
    assert thickness(1.0, UNCLAMPED, 1.0) == pytest.approx(1.06, abs=5e-3)


def test_a_fifth_of_the_pipe_needs_176_mm():
    assert line_needed_mm(pipe_diameter_mm=300, passes=5) == pytest.approx(176.3, abs=0.05)
    assert line_needed_mm(pipe_diameter_mm=300, passes=6) == pytest.approx(150.0)
    assert line_needed_mm(pipe_diameter_mm=300, passes=2) == pytest.approx(300.0)


SPECKLE = {"wavelength_nm": 635, "focal_length_mm": 12.5, "f_number": 4, "distance_mm": 250}
GLASS = {"pressure_mpa": 1, "unsupported_diameter_mm": 63, "strength_mpa": 60}


@pytest.mark.parametrize(
    ("refused", "message"),
    [
        (lambda: replace(AIR, baseline_mm=0.0), "baseline_mm is 0"),
        (lambda: replace(AIR, pixel_size_mm=math.nan), "pixel_size_mm is nan"),
        (lambda: replace(AIR, triangulation_angle_rad=35), "angle is 35 rad"),
        (lambda: FlatWindow(distance_mm=-1.0), "must not be negative"),
        (lambda: FlatWindow(distance_mm=1.0, medium_index=0.9), "must be at least 1"),
        (lambda: FlatWindow(medium_index=1.33), "in the pupil;"),
        (lambda: depth_mm(AIR, [0.0, math.nan]), "finite"),
        (lambda: depth_mm(AIR, 1652.0), "does not meet the sheet"),
        (lambda: depth_mm(WATER, -1e6), "does not meet the sheet"),
        (lambda: pixel_of_depth(WATER, 68.72), r"outer face at 68\.73 mm"),
        (lambda: pixel_of_depth(WATER, math.inf), "finite"),
        (lambda: pixel_of_depth(WATER, 300.0, math.nan), "finite"),
        (lambda: line_length_mm(WATER, 300.0, side_px=0), "side_px is 0"),
        (lambda: measuring_volume(WATER, side_px=-5), "side_px is -5"),
        (lambda: scheimpflug_angle_rad(triangulation_angle_rad=ANGLE, magnification=0.0), "magnification is 0"),
        (lambda: scheimpflug_angle_rad(triangulation_angle_rad=math.nan, magnification=0.1), "angle is nan"),
        *((lambda n=n: speckle_limit_um(**SPECKLE | {n: -1}), f"{n} is -1") for n in SPECKLE),
        *((lambda n=n: window_thickness_mm(**GLASS | {n: math.inf}), f"{n} is inf") for n in GLASS),
        (lambda: line_needed_mm(pipe_diameter_mm=300, passes=1), "passes is 1"),
    ],
)
def test_numbers_without_a_meaning_are_refused(refused, message):
    with pytest.raises(RangeError, match=message):
        refused()


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
        # 63 sqrt(3 / S) / 2 with the strengths of 60, 45 and 41.4 MPa.
        "fused-silica window for 1 MPa, clamped": (7.044, "mm"),
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
    setup, leaning = nominal_setup(sensor, sensor.media["air"])
    axis = np.array(laser["axis"]) / np.linalg.norm(laser["axis"])
    normal = np.array([0.0, -1.0, 0.0]) + axis[1] * axis
    crossing = np.cross([1.0, 0.0, 0.0], normal)
    crossing /= crossing[2]
    assert math.tan(setup.triangulation_angle_rad) == pytest.approx(crossing[1])
    assert leaning == pytest.approx(crossing @ axis)


def test_sensors_without_a_design_are_refused(thesis):
    bare = altered(thesis, {"camera": {"window": {"mounted": False}}})
    with pytest.raises(DesignError, match=r"index is 1\.3312: mount it"):
        design(bare, medium="water")
    # In air the unmounted window does nothing.
    air = nominal_setup(bare, bare.media["air"])[0]
    assert depth_mm(air, 100.0, 100.0) == pytest.approx(float(depth_mm(AIR, 100.0, 100.0)))
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
