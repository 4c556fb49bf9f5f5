"""Chessboards and ChArUco boards in photographs of drawn boards, compared with the true corners."""

from functools import cache

import cv2
import numpy as np
import pytest

from uwlts.errors import TargetError
from uwlts.targets import CharucoTarget, ChessboardTarget, parse_target
from uwlts.targets.detection import find_chessboard_fault, refine_corners

BOARD = ChessboardTarget(columns=8, rows=5, square_mm=12.0)
CHARUCO = CharucoTarget(columns=8, rows=6, square_mm=12.0, marker_mm=9.0)


def chess_texture(pixels_per_square, margin=1):
    """Return a board of BOARD's squares, first square dark, and the texture position (px) of its first inner corner."""
    squares = np.add.outer(np.arange(BOARD.rows + 1), np.arange(BOARD.columns + 1)) % 2 * 255
    board = np.kron(np.pad(squares, margin, constant_values=255), np.ones((pixels_per_square,) * 2)).astype(np.uint8)
    # The corner is on the border between two pixels, half a pixel before the centre of the next.
    return board, (margin + 1) * pixels_per_square - 0.5


def photograph_texture(texture, homography, *, size=(640, 512), noise=1.5):
    """Map the texture by a homography from its pixels to those of the image, with 4 x 4 samples per pixel."""
    fine = np.diag([4.0, 4.0, 1.0])
    # Pixel centre x of the image is position 4 x + 1.5 among the finer ones.
    fine[:2, 2] = 1.5
    large = cv2.warpPerspective(texture, fine @ homography, (4 * size[0], 4 * size[1]), borderValue=255)
    levels = 40 + 0.6 * cv2.resize(large.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    levels = cv2.GaussianBlur(levels, (0, 0), 0.7) + noise * np.random.default_rng(0).normal(size=levels.shape)
    return np.clip(np.rint(levels), 0, 255).astype(np.uint8)


def rms(errors):
    return float(np.sqrt((errors**2).mean()))


def texture_pose(texture, quad):
    height, width = texture.shape
    corners = np.array([[0, 0], [width, 0], [width, height], [0, height]], np.float32)
    return cv2.getPerspectiveTransform(corners, np.array(quad, np.float32))


QUADS = {
    "upright": [(60, 70), (580, 50), (600, 440), (40, 460)],
    "quarter turn": [(490, 30), (460, 490), (120, 470), (150, 20)],
    "half turn": [(590, 450), (60, 470), (40, 60), (600, 90)],
    "oblique": [(150, 60), (480, 140), (500, 400), (130, 470)],
}


def mapped(homography, points):
    return cv2.perspectiveTransform(np.asarray(points, float).reshape(-1, 1, 2), homography).reshape(-1, 2)


@pytest.mark.parametrize("quad", QUADS)
def test_chessboard_corners_and_their_order(quad):
    image, corners = board_in(quad)
    view = BOARD.detect(image)
    assert len(view.pixels) == BOARD.columns * BOARD.rows
    # The board has an odd and an even side, so the dark first square fixes the order in every turn.
    np.testing.assert_allclose(view.points_mm[:, :2], view.indices * BOARD.square_mm)
    errors = view.pixels - corners[numbers(view)]
    # 0.02 to 0.03 px measured, with 1.5 grey of noise on 130; the bound excludes half-pixel conventions (0.5 px).
    assert rms(errors) < 0.06
    assert np.abs(errors.mean(0)).max() < 0.03
    assert view.quality["contrast"].min() > 80
    assert view.quality["sharpness"].min() > 0.15


@cache
def board_in(name):
    """Return a photograph of BOARD, and the pixels (N, 2) of its inner corners in the order of its indices."""
    texture, first = chess_texture(40)
    homography = texture_pose(texture, QUADS[name])
    return photograph_texture(texture, homography), mapped(homography, first + BOARD.indices * 40.0)


def numbers(view):
    """Return numbers (N,) of the found corners in the order of BOARD's indices."""
    return view.indices[:, 1] * BOARD.columns + view.indices[:, 0]


def true_places(view, corners):
    """Return distances (N,) of found corners from the true ones (columns * rows, 2) with the same indices."""
    return np.linalg.norm(view.pixels - corners[numbers(view)], axis=1)


@pytest.mark.parametrize("quad", QUADS)
@pytest.mark.parametrize("side", ["left", "right", "top", "bottom"])
def test_a_board_partly_outside_the_image_gives_the_corners_in_view(quad, side):
    image, corners = board_in(quad)
    low, high = corners.min(axis=0), corners.max(axis=0)
    # A quarter of the board is cut off. The rest has one complete side, which distinguishes rows and columns, unless
    # the cut is oblique to the board. Then the board may be refused, but never numbered wrongly.
    near, far = np.rint(0.75 * low + 0.25 * high).astype(int), np.rint(0.25 * low + 0.75 * high).astype(int)
    cut = {
        "left": np.s_[:, near[0] :],
        "right": np.s_[:, : far[0]],
        "top": np.s_[near[1] :],
        "bottom": np.s_[: far[1]],
    }[side]
    offset = {"left": (near[0], 0), "top": (0, near[1])}.get(side, (0, 0))
    try:
        view = BOARD.detect(np.ascontiguousarray(image[cut]))
    except TargetError:
        assert quad == "oblique"
        return
    assert 15 <= len(view.pixels) < len(corners)
    assert true_places(view, corners - offset).max() < 0.3


def test_a_stripe_across_a_board_costs_the_corners_beneath_it_only():
    image, corners = board_in("upright")
    across = np.abs(np.arange(640) - 300 - 0.1 * np.arange(512)[:, None])
    lit = np.clip(image + 400 * np.exp(-((across / 5) ** 2) / 2), 0, 255).astype(np.uint8)
    view = BOARD.detect(lit)
    clear = np.abs(corners[:, 0] - 300 - 0.1 * corners[:, 1]) > 30
    assert len(view.pixels) >= clear.sum()
    assert true_places(view, corners).max() < 0.5


@pytest.mark.parametrize(("columns", "rows"), [(7, 5), (6, 4), (8, 6)])
def test_a_board_of_other_size_is_refused(columns, rows):
    image, _ = board_in("upright")
    with pytest.raises(TargetError, match=f"no chessboard of {columns} x {rows} inner corners"):
        ChessboardTarget(columns=columns, rows=rows, square_mm=12.0).detect(image)


def test_an_image_gives_the_same_corners_whatever_came_before():
    images = [board_in(quad)[0] for quad in QUADS]
    images.append(cv2.GaussianBlur(images[0], (0, 0), 4))
    first = [BOARD.detect(image).pixels for image in images]
    cv2.setRNGSeed(7)
    again = [BOARD.detect(image).pixels for image in reversed(images)]
    for one, other in zip(first, reversed(again), strict=True):
        np.testing.assert_array_equal(one, other)


def test_a_grid_without_neighbours_is_none():
    grid = np.full((BOARD.rows, BOARD.columns, 2), np.nan)
    grid[np.arange(5), np.arange(5)] = 40.0 * np.arange(5)[:, None] + 60.0
    image = np.full((300, 400), 90, np.uint8)
    assert not np.isfinite(refine_corners(image, grid)).any()
    assert find_chessboard_fault(image, grid) == "too few corners are in view"


def test_squares_that_are_not_square_have_two_sides():
    board = parse_target({"kind": "chessboard", "columns": 8, "rows": 5, "square_mm": [12.0, 11.5]})
    view = board.detect(board_in("upright")[0])
    np.testing.assert_allclose(view.points_mm[:, :2], view.indices * [12.0, 11.5])
    assert board.spacing_mm == 11.5
    assert np.ptp(board.extent_mm, axis=0).tolist() == [84.0, 46.0]


@pytest.mark.parametrize(
    ("margin", "corners"),
    [(None, [(-6, -6), (90, 54)]), (20.0, [(-20, -20), (104, 68)]), ([1.0, 2.0, 3.0, 4.0], [(-1, -2), (87, 52)])],
)
def test_the_plate_reaches_beyond_its_pattern(margin, corners):
    plate = parse_target(BOARD.model_dump() | {"margin_mm": margin}).plate_mm
    np.testing.assert_allclose(plate[[0, 2]], corners)


def test_sixteen_bit_chessboard():
    image, corners = board_in("upright")
    view = BOARD.detect(image.astype(np.uint16) * 16)
    assert rms(view.pixels - corners[numbers(view)]) < 0.06


def test_a_square_symmetric_board_is_turned_so_that_x_points_right():
    target = ChessboardTarget(columns=5, rows=5, square_mm=10.0)
    squares = np.add.outer(np.arange(6), np.arange(6)) % 2 * 255
    texture = np.kron(np.pad(squares, 1, constant_values=255), np.ones((40, 40))).astype(np.uint8)
    for quad in QUADS.values():
        view = target.detect(photograph_texture(texture, texture_pose(texture, quad)))
        grid = view.pixels.reshape(5, 5, 2)
        along, down = np.diff(grid, axis=1).mean((0, 1)), np.diff(grid, axis=0).mean((0, 1))
        assert along[0] > abs(down[0])
        assert down[1] > 0


@pytest.mark.parametrize("quad", QUADS.values(), ids=QUADS)
@pytest.mark.parametrize("hidden", [False, True])
def test_charuco_corners_and_their_numbers(quad, hidden):
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_100)
    board = cv2.aruco.CharucoBoard((CHARUCO.columns, CHARUCO.rows), 12.0, 9.0, dictionary)
    texture = np.pad(board.generateImage((8 * 48, 6 * 48)), 24, constant_values=255)
    homography = texture_pose(texture, quad)
    image = photograph_texture(texture, homography)
    if hidden:
        image[:, :300] = 120
    view = CHARUCO.detect(image)
    total = (CHARUCO.columns - 1) * (CHARUCO.rows - 1)
    assert (8 <= len(view.pixels) < total) if hidden else len(view.pixels) == total
    np.testing.assert_allclose(view.points_mm[:, :2], (view.indices + 1) * CHARUCO.square_mm)
    errors = view.pixels - mapped(homography, 24 - 0.5 + (view.indices + 1) * 48.0)
    # 0.04 to 0.05 px measured for OpenCV's own refinement, which works in 8 bit and windows of a few pixels.
    assert rms(errors) < 0.12
    assert np.abs(errors.mean(0)).max() < 0.06
