"""Targets drawn by the twin from the descriptions used for detection: every kind, with exact edges."""

import subprocess
import sys

import cv2
import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.virtual_sensors import altered, camera_axes, scene_of, sensor_at
from twin.light.renderer import Renderer
from twin.recording.sensor_simulator import with_window
from twin.rendering_options import NONE
from twin.scene.description import TargetPlate
from twin.scene.finish import draw_print_errors, pattern_texture, register_textures
from uwlts.model.sensor import Sensor
from uwlts.targets import CharucoTarget, ChessboardTarget, CircleGridTarget, CircleTarget, Target

BOARD = ChessboardTarget(columns=7, rows=6, square_mm=10.0)
CHARUCO = CharucoTarget(columns=7, rows=6, square_mm=10.0, marker_mm=7.5)
CIRCLES = CircleTarget(diameter_mm=5.0, marker_diameter_mm=2.0, columns=9, rows=8, origin=(3, 4))
GRID = CircleGridTarget(columns=4, rows=7, pitch_mm=8.0, diameter_mm=6.0, asymmetric=True)
TARGETS = [BOARD, CHARUCO, CIRCLES, GRID]
GROUND, INK = 0.8, 0.1


@pytest.fixture(scope="module")
def bare(thesis) -> Sensor:
    """The middle of the thesis's view, without its window."""
    return with_window(altered(thesis, {"camera": {"width_px": 480, "height_px": 520}}), mounted=False)


def covered(target: Target, points: np.ndarray) -> np.ndarray:
    """Return whether points (N, 2) in mm are on ink, by testing every patch for every point."""
    ink = np.zeros(len(points), bool)
    for patch in target.patches():
        low, high = np.array([patch.x_min_mm, patch.y_min_mm]), np.array([patch.x_max_mm, patch.y_max_mm])
        inside = ((points >= low) & (points <= high)).all(axis=1)
        if patch.round:
            inside &= np.linalg.norm((points - (low + high) / 2) / ((high - low) / 2), axis=1) < 1
        ink[inside] = patch.ink
    return ink


@pytest.mark.parametrize(("columns", "rows"), [(7, 6), (6, 5), (5, 5)])
@pytest.mark.parametrize("legacy", [False, True])
def test_the_print_of_a_charuco_board_is_opencvs(columns, rows, legacy):
    target = CharucoTarget(columns=columns, rows=rows, square_mm=12.0, marker_mm=9.0, legacy=legacy)
    # Two pixels per mm: borders of squares (24), margins (3) and cells (3) are between pixels.
    picture = target.board().generateImage((24 * columns, 24 * rows))
    u, v = np.meshgrid(np.arange(24 * columns), np.arange(24 * rows))
    ink = covered(target, np.column_stack([u.ravel(), v.ravel()]) / 2 + 0.25)
    np.testing.assert_array_equal(ink.reshape(picture.shape), picture == 0)


def test_the_first_square_of_a_chessboard_is_dark():
    middles = np.array([(-5.0, -5.0), (5.0, -5.0), (5.0, 5.0), (55.0, 55.0), (65.0, 55.0)])
    assert covered(BOARD, middles).tolist() == [True, False, True, True, False]


@pytest.mark.parametrize("target", TARGETS, ids=lambda target: target.kind)
def test_the_texture_is_the_print(target):
    register_textures()
    scene = scene_of(
        {"kind": "target_plate", "reflectance": GROUND, "ink_reflectance": INK}, target=target.model_dump()
    )
    thing = scene.objects[0]
    assert isinstance(thing, TargetPlate)
    assert thing.target == target
    uv = np.random.default_rng(0).random((20000, 2)).astype(np.float32)
    si = dr.zeros(mi.SurfaceInteraction3f, len(uv))
    si.uv = mi.Point2f(mi.Float(uv[:, 0].copy()), mi.Float(uv[:, 1].copy()))
    seen = pattern_texture(thing).eval_1(si).numpy()
    first, last = thing.bounds_mm()
    points = first + np.column_stack([uv[:, 0], 1 - uv[:, 1]]).astype(float) * (last - first)
    expected = np.where(covered(target, points), INK, GROUND)
    assert {INK, GROUND} == set(expected)
    # 32 bits round a place by 1e-5 mm, and the edges are 5 m long at most: 20000 x 5000 x 2e-5 / 9000 are 0.2 places.
    assert np.count_nonzero(np.abs(seen - expected) > 1e-6) <= 1


@pytest.mark.parametrize("target", [BOARD, CHARUCO], ids=lambda target: target.kind)
def test_rendered_boards_are_found_where_a_pinhole_sees_them(bare, target):
    middle, angles = target.points_mm.mean(axis=0), (-32.0, 8.0, 4.0)
    turn = Rotation.from_euler("xyz", angles, degrees=True)
    position = -turn.apply(middle)
    thing = {"kind": "target_plate", "position_mm": tuple(position), "rotation_deg": angles, "reflectance": GROUND}
    scene = scene_of(thing, medium="air", window_mounted=False, target=target.model_dump())
    image = Renderer(bare, bare.media["air"], scene, effects=NONE).irradiance("lamp", sensor_at(), spp=64)
    grey = cv2.GaussianBlur(np.rint(image * (50000 / image.max())).astype(np.uint16), (0, 0), 0.7)
    view = target.detect(grey)
    assert len(view.pixels) == len(target.points_mm)
    axes, standoff = camera_axes(bare)
    seen = (turn.apply(view.points_mm) + position) @ axes.T + standoff
    expected = seen[:, :2] / seen[:, 2:] * bare.camera.focal_length_px() + bare.camera.principal_point()
    assert np.ptp(expected, axis=0).min() > 150
    # Measured 0.02 px (chessboard) and 0.05 px (ChArUco), which OpenCV's own refinement in 8 bit leaves.
    assert np.sqrt(((view.pixels - expected) ** 2).mean()) < 0.06
    # With equal refinement and 16 bits, both agree to 0.03 px, the noise of 64 samples per pixel.
    start, stop = view.pixels.astype(np.float32).reshape(-1, 1, 2), (cv2.TERM_CRITERIA_COUNT, 100, 0.0)
    refined = cv2.cornerSubPix(grey.astype(np.float32), start, (5, 5), (-1, -1), stop).reshape(-1, 2)
    errors = refined - expected
    assert np.sqrt((errors**2).mean()) < 0.05
    assert np.abs(errors.mean(axis=0)).max() < 4 * 0.03 / np.sqrt(len(errors))


@pytest.mark.parametrize("target", TARGETS, ids=lambda target: target.kind)
def test_the_print_about_each_point_is_off_by_its_error(target):
    register_textures()
    thing = TargetPlate(
        kind="target_plate", target=target, reflectance=GROUND, ink_reflectance=INK, centre_std_mm=0.3, errors_seed=2
    )
    rng = np.random.default_rng(1)
    columns, rows = target.indices.T
    shifts = draw_print_errors(thing)[rows, columns]
    assert len(shifts) == len(target.points_mm)
    # Within a third of the spacing no other point is nearer, and with the shift the print is that about the same point.
    beside = target.spacing_mm / 3 * (2 * rng.random((200, len(shifts), 2)) - 1)
    points = (target.points_mm[:, :2] + beside).reshape(-1, 2)
    first, last = thing.bounds_mm()
    uv = ((points - first) / (last - first)).astype(np.float32)
    si = dr.zeros(mi.SurfaceInteraction3f, len(uv))
    si.uv = mi.Point2f(mi.Float(uv[:, 0].copy()), mi.Float(1 - uv[:, 1]))
    seen = pattern_texture(thing).eval_1(si).numpy()
    expected = np.where(covered(target, points - np.tile(shifts, (200, 1))), INK, GROUND)
    # Without the shifts some percent would differ; rounding to 32 bits (1e-5 mm) moves a place or two over an edge.
    assert np.count_nonzero(np.abs(seen - expected) > 1e-6) <= 2
    assert np.count_nonzero(expected != np.where(covered(target, points), INK, GROUND)) > 0.01 * len(points)


@pytest.mark.parametrize("target", TARGETS, ids=lambda target: target.kind)
def test_a_stretched_print_moves_each_point_by_its_place(target):
    thing = TargetPlate(kind="target_plate", target=target, stretch=(1e-3, -2e-3))
    columns, rows = target.indices.T
    np.testing.assert_allclose(draw_print_errors(thing)[rows, columns], target.points_mm[:, :2] * [1e-3, -2e-3])


def test_descriptions_need_no_detector():
    loaded = "any(name.startswith('uwlts.targets.detection') for name in sys.modules)"
    code = f"import sys, twin.scene.description; sys.exit({loaded})"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
