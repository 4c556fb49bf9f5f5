"""Chessboards drawn ray by ray: cut at their rim, with more corners than described, and through wide-angle lenses."""

import numpy as np
import pytest

from tests.oracles.drawings import chessboard, draw, equidistant, pinhole, pose, project_points
from uwlts.errors import TargetError
from uwlts.targets import ChessboardTarget

SIZE, CENTRE = (560, 448), (281.3, 222.2)
RAYS = pinhole(630.0, CENTRE)
BOARD = ChessboardTarget(columns=9, rows=6, square_mm=20.0)
POSES = {
    "upright": pose((20.0, -15.0, 4.0), (-75.0, -55.0, 290.0)),
    "turned": pose((-15.0, 25.0, 130.0), (90.0, -30.0, 340.0)),
}


def away(view, target_pose, rays, *, first=(0.0, 0.0)):
    """Return distances (N,) in px of corners from the rays of their true places; the board begins at ``first``."""
    return np.linalg.norm(
        view.pixels - project_points(view.points_mm[:, :2] + first, rays, target_pose, start=view.pixels), axis=1
    )


@pytest.mark.parametrize(
    ("place", "rims"), [("upright", (0.25, 0.6, 0.9, 0.35)), ("turned", (0.5, 0.2, 0.5, 0.2))], ids=str
)
def test_outer_squares_cut_by_the_rim_cost_no_corner(place, rims):
    levels = chessboard(9, 6, 20.0, rims=rims, white_mm=0.0)
    view = BOARD.detect(draw(levels, RAYS, POSES[place], size=SIZE, rng=np.random.default_rng(7), samples=2))
    assert len(view.pixels) == 54
    # 0.1 px at most were measured; a window that reaches beyond the cut squares moves corners by 1 to 3 px.
    assert away(view, POSES[place], RAYS).max() < 0.4


@pytest.mark.parametrize(
    ("more", "rims"),
    [((1, 0, 0, 0), (0.5, 1, 1, 1)), ((1, 0, 1, 0), (0.4, 1, 0.6, 1)), ((0, 1, 1, 1), (1, 0.5, 0.5, 0.5))],
    ids=str,
)
def test_corners_of_cut_squares_may_be_left_out_of_the_description(more, rims):
    columns, rows = 9 + more[0] + more[2], 6 + more[1] + more[3]
    levels = chessboard(columns, rows, 20.0, rims=rims)
    first = (20.0 * more[0], 20.0 * more[1])
    place = POSES["upright"]
    view = BOARD.detect(draw(levels, RAYS, place, size=SIZE, rng=np.random.default_rng(7), samples=2))
    assert len(view.pixels) == 54
    # The first square of the described part is bright if one line before it is not described: half a turn then.
    if sum(more[:2]) % 2:
        turned = np.array([8, 5]) * 20.0 - view.points_mm[:, :2]
        true = project_points(turned + first, RAYS, place, start=view.pixels)
        assert np.linalg.norm(view.pixels - true, axis=1).max() < 0.4
    else:
        assert away(view, place, RAYS, first=first).max() < 0.4


def test_further_corners_of_whole_squares_are_another_board():
    image = draw(chessboard(10, 6, 20.0), RAYS, POSES["upright"], size=SIZE, rng=np.random.default_rng(7), samples=2)
    with pytest.raises(TargetError, match="the board has more corners than 9 x 6"):
        BOARD.detect(image)


@pytest.mark.parametrize("coefficients", [(), (-0.02, 0.004)], ids=str)
def test_boards_are_found_through_a_wide_lens(coefficients):
    """Its 60 deg to either side bend lines of the board by more than a square."""
    rays, place = equidistant(250.0, CENTRE, *coefficients), pose((10.0, -20.0, 8.0), (-150.0, -95.0, 130.0))
    board = ChessboardTarget(columns=15, rows=9, square_mm=20.0)
    image = draw(chessboard(15, 9, 20.0), rays, place, size=SIZE, rng=np.random.default_rng(7), samples=2)
    view = board.detect(image)
    assert len(view.pixels) == 135
    assert away(view, place, rays).max() < 0.4


@pytest.mark.parametrize(
    ("described", "more", "rim", "turns", "at"),
    [
        ((6, 8), (1, 1, 1, 1), 0.246, (5.4, -29.0, 163.9), (22.9, -40.5, 272.7)),
        ((5, 6), (0, 1, 0, 1), 0.292, (14.2, -12.7, 162.0), (48.8, -35.4, 203.3)),
    ],
    ids=str,
)
def test_a_cut_board_partly_in_view_is_right_or_ambiguous(described, more, rim, turns, at):
    """Corners of its cut squares are not described; a board a quarter turn off, or shifted by a square, would fit."""
    columns, rows = described[0] + more[0] + more[2], described[1] + more[1] + more[3]
    left, top, right, bottom = (rim if each else 1.0 for each in more)
    levels = chessboard(columns, rows, 20.0, rims=(left, top, right, bottom))
    place = pose(turns, at)
    place[:3, 3] -= place[:3, :3] @ [10.0 * (columns - 1), 10.0 * (rows - 1), 0.0]
    image = draw(levels, RAYS, place, size=SIZE, rng=np.random.default_rng(7), samples=2)
    board = ChessboardTarget(columns=described[0], rows=described[1], square_mm=20.0)
    try:
        view = board.detect(image)
    except TargetError as error:
        assert "more than one way" in str(error)
        return
    first, last = 20.0 * np.array(more[:2]), 20.0 * (np.array(described) - 1)
    errors = []
    for points in (view.points_mm[:, :2], last - view.points_mm[:, :2]):
        true = project_points(points + first, RAYS, place, start=view.pixels)
        errors.append(np.linalg.norm(view.pixels - true, axis=1).max())
    assert min(errors) < 0.4


def test_a_cut_board_whose_next_corners_would_be_in_the_image_is_not_read_a_quarter_turn_off():
    """Its 6 x 4 whole corners fit 8 x 6 turned by 90 deg; half of the row beyond them would then be in the image."""
    place = pose((4.1, -6.9, -18.4), (-29.0, -38.4, 300.0))
    place[:3, 3] -= place[:3, :3] @ [70.0, 50.0, 0.0]
    levels = chessboard(8, 6, 20.0, rims=(0.08, 0.08, 0.08, 0.08))
    image = draw(levels, RAYS, place, size=SIZE, rng=np.random.default_rng(7), samples=2)
    with pytest.raises(TargetError, match="more than one way"):
        ChessboardTarget(columns=8, rows=6, square_mm=20.0).detect(image)
