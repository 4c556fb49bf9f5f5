"""The chessboard target, found as a whole."""

from typing import Annotated, Literal

import cv2
import numpy as np
from pydantic import Field

from uwlts.model.errors import TargetError
from uwlts.model.sensor import Positive
from uwlts.targets.target import Patch, Target, TargetView, lattice_indices

_SECTOR_FLAGS = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_ACCURACY
_QUAD_FLAGS = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
_REFINEMENT = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 100, 1e-4)


class ChessboardTarget(Target):
    """A chessboard, known by its inner corners.

    The origin is the top left inner corner. If one of `columns` and `rows` is odd and the other even, the board differs
    from itself turned by half a turn: the square above and to the left of the origin is dark. Otherwise the turn with X
    pointing most to the right in the image is taken.

    Attributes
    ----------
    columns, rows : number of inner corners along X and along Y
    square_mm : side of a square
    """

    kind: Literal["chessboard"] = "chessboard"
    columns: Annotated[int, Field(ge=3)]
    rows: Annotated[int, Field(ge=3)]
    square_mm: Positive

    @property
    def indices(self) -> np.ndarray:
        return lattice_indices(self.columns, self.rows)

    def points_at(self, indices: np.ndarray) -> np.ndarray:
        return np.column_stack([indices * self.square_mm, np.zeros(len(indices))])

    @property
    def spacing_mm(self) -> float:
        return self.square_mm

    def findable(self, in_view: np.ndarray) -> bool:
        return bool(in_view.all())

    def patches(self) -> list[Patch]:
        squares = lattice_indices(self.columns + 1, self.rows + 1)
        dark = squares[squares.sum(axis=1) % 2 == 0]
        return [Patch(*corners) for corners in (np.hstack([dark - 1, dark]) * self.square_mm).tolist()]

    def detect(self, image: np.ndarray) -> TargetView:
        # Imported late: a description alone does not need the detector.
        from uwlts.targets.detection import corner_quality, eight_bit

        grey = eight_bit(image)
        size = (self.columns, self.rows)
        found, corners = cv2.findChessboardCornersSB(grey, size, flags=_SECTOR_FLAGS)
        if not found:
            found, corners = cv2.findChessboardCorners(grey, size, flags=_QUAD_FLAGS)
        if not found:
            raise TargetError(
                f"found no chessboard of {size[0]} x {size[1]} inner corners; the whole board must be in view with a "
                "bright rim, and columns and rows count inner corners, not squares"
            )
        # Corners are moved to the saddle of the grey levels, in a window that stays within the squares around them.
        grid = corners.reshape(self.rows, self.columns, 2)
        sides = [np.linalg.norm(np.diff(grid, axis=axis), axis=2).min() for axis in (0, 1)]
        half = int(np.clip(min(sides) * 0.4, 2, 11))
        start = grid.astype(np.float32).reshape(-1, 1, 2)
        moved = cv2.cornerSubPix(image.astype(np.float32), start, (half, half), (-1, -1), _REFINEMENT)
        grid = moved.reshape(self.rows, self.columns, 2).astype(np.float64)
        pixels = _from_top_left(grey, grid).reshape(-1, 2)
        return TargetView(pixels, self.points_mm, self.indices, corner_quality(image, pixels))


def _from_top_left(grey: np.ndarray, grid: np.ndarray) -> np.ndarray:
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
    turned = [np.rot90(grid, turn) for turn in (range(4) if rows == columns else (0, 2))]
    return max(turned, key=lambda each: np.diff(each, axis=1)[..., 0].mean())
