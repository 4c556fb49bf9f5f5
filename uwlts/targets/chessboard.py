"""The chessboard in an image."""

import cv2
import numpy as np

from uwlts.errors import TargetError
from uwlts.targets.corners import corner_quality, eight_bit
from uwlts.targets.description import ChessboardTarget
from uwlts.targets.view import TargetView

SECTOR_FLAGS = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_ACCURACY
QUAD_FLAGS = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
REFINEMENT = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 100, 1e-4)


def detect_chessboard(image, target: ChessboardTarget) -> TargetView:
    """Find all inner corners of a chessboard.

    Raises
    ------
    ImageError
        The image is no grey image of 8 or 16 bit.
    TargetError
        Not all inner corners are found.
    """
    grey = eight_bit(image)
    size = (target.columns, target.rows)
    found, corners = cv2.findChessboardCornersSB(grey, size, flags=SECTOR_FLAGS)
    if not found:
        found, corners = cv2.findChessboardCorners(grey, size, flags=QUAD_FLAGS)
        if not found:
            raise TargetError(
                f"found no chessboard of {size[0]} x {size[1]} inner corners; the whole board must be in view with a "
                "bright rim, and columns and rows count inner corners, not squares"
            )
    grid = _refined(image, corners.reshape(-1, 2), size).reshape(target.rows, target.columns, 2).astype(np.float64)
    pixels = _from_top_left(grey, grid).reshape(-1, 2)
    indices = np.stack(np.meshgrid(np.arange(target.columns), np.arange(target.rows)), 2).reshape(-1, 2)
    points = np.column_stack([indices * target.square_mm, np.zeros(len(indices))])
    return TargetView(pixels, points, indices, corner_quality(image, pixels))


def _refined(image, corners, size):
    """Corners moved to the saddle of the grey levels, in a window that stays within the squares around them."""
    grid = corners.reshape(size[1], size[0], 2)
    sides = [np.linalg.norm(np.diff(grid, axis=axis), axis=2).min() for axis in (0, 1)]
    half = int(np.clip(min(sides) * 0.4, 2, 11))
    grey = image.astype(np.float32)
    return cv2.cornerSubPix(grey, corners.astype(np.float32).reshape(-1, 1, 2), (half, half), (-1, -1), REFINEMENT)


def _from_top_left(grey, grid):
    """The grid (rows, columns, 2) turned so that it follows the frame of `ChessboardTarget`."""
    along, across = np.diff(grid, axis=1).mean((0, 1)), np.diff(grid, axis=0).mean((0, 1))
    if along[0] * across[1] < along[1] * across[0]:
        grid = grid[:, ::-1]
    rows, columns = grid.shape[:2]
    if (rows + columns) % 2:
        centres = (grid[:-1, :-1] + grid[1:, 1:] + grid[:-1, 1:] + grid[1:, :-1]) / 4
        u, v = np.rint(centres).astype(int).transpose(2, 0, 1)
        even = np.add.outer(np.arange(rows - 1), np.arange(columns - 1)) % 2 == 0
        levels = grey[v, u]
        return grid if levels[even].mean() < levels[~even].mean() else grid[::-1, ::-1]
    # A square board has four turns that look alike, another board two.
    turns = range(4) if rows == columns else (0, 2)
    candidates = [np.rot90(grid, turn) for turn in turns]
    return max(candidates, key=lambda turned: np.diff(turned, axis=1)[..., 0].mean())
