"""The chessboard target, seen completely or in part."""

from collections.abc import Callable
from functools import partial
from typing import Annotated, Literal

import cv2
import numpy as np
from pydantic import Field

from uwlts.errors import TargetError
from uwlts.model.sensor import Positive
from uwlts.targets.target import Patch, Target, TargetView, lattice_indices

_SECTOR_FLAGS = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_ACCURACY
_QUAD_FLAGS = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE


class ChessboardTarget(Target):
    """A chessboard, described by its inner corners.

    The origin is the top left inner corner. If one of `columns` and `rows` is odd and the other even, the board differs
    from itself rotated by half a turn: the square above and to the left of the origin is dark. Otherwise the
    orientation with X pointing most to the right in the image is used.

    Attributes
    ----------
    columns, rows : number of inner corners along X and along Y
    square_mm : side of a square, or its sides [along X, along Y] if it is not square
    """

    kind: Literal["chessboard"] = "chessboard"
    columns: Annotated[int, Field(ge=3)]
    rows: Annotated[int, Field(ge=3)]
    square_mm: Positive | tuple[Positive, Positive]

    @property
    def sides_mm(self) -> np.ndarray:
        """Sides (2,) of a square along X and Y."""
        return np.full(2, self.square_mm)

    @property
    def indices(self) -> np.ndarray:
        return lattice_indices(self.columns, self.rows)

    def points_at(self, indices: np.ndarray) -> np.ndarray:
        return np.column_stack([indices * self.sides_mm, np.zeros(len(indices))])

    @property
    def spacing_mm(self) -> float:
        return float(self.sides_mm.min())

    def patches(self) -> list[Patch]:
        squares = lattice_indices(self.columns + 1, self.rows + 1)
        dark = squares[squares.sum(axis=1) % 2 == 0]
        return [Patch(*corners) for corners in (np.hstack([dark - 1, dark]) * np.tile(self.sides_mm, 2)).tolist()]

    def detect(self, image: np.ndarray) -> TargetView:
        # Imported late: a description does not need the detector.
        from uwlts.targets.detection import (
            convert_to_eight_bit,
            count_corners,
            find_chessboard_fault,
            measure_corners,
            refine_corners,
        )

        grey = convert_to_eight_bit(image)
        part, reasons = None, []
        for name, find in _DETECTORS.items():
            grid = find(grey, self.columns, self.rows)
            if grid is None:
                continue
            grid = refine_corners(image, grid)
            reason = find_chessboard_fault(grey, grid)
            if reason is not None:
                reasons.append(f"{reason} (as found by {name})")
            elif self.is_findable(np.isfinite(grid[..., 0]).ravel()) and (
                part is None or count_corners(grid) > count_corners(part)
            ):
                part = grid
            if part is not None and count_corners(part) > _NEARLY_WHOLE * self.columns * self.rows:
                break
        if part is None:
            raise TargetError(
                f"found no chessboard of {self.columns} x {self.rows} inner corners"
                + "".join(f"; {reason}" for reason in reasons)
                + "; columns and rows count inner corners, not squares; of a board partly in view, two adjacent sides "
                "must be in view, and a board with cut outer squares can be placed in more than one way"
            )
        pixels = _from_top_left(grey, part).reshape(-1, 2)
        seen = np.isfinite(pixels[:, 0])
        pixels, indices = pixels[seen], self.indices[seen]
        return TargetView(pixels, self.points_at(indices), indices, measure_corners(image, pixels))


def _by_lattice(grey: np.ndarray, columns: int, rows: int) -> np.ndarray | None:
    from uwlts.targets.detection import find_board

    return find_board(grey, columns, rows)


def _by_opencv(
    find: Callable[..., tuple[bool, np.ndarray]], flags: int, grey: np.ndarray, columns: int, rows: int
) -> np.ndarray | None:
    # The same random numbers for every image.
    cv2.setRNGSeed(0)
    found, corners = find(grey, (columns, rows), flags=flags)
    return corners.reshape(rows, columns, 2).astype(np.float64) if found else None


_DETECTORS = {
    "its saddle points": _by_lattice,
    "OpenCV's sectors": partial(_by_opencv, cv2.findChessboardCornersSB, _SECTOR_FLAGS),
    "OpenCV's squares": partial(_by_opencv, cv2.findChessboardCorners, _QUAD_FLAGS),
}
"""Detectors of corners (rows, columns, 2) with NaN for missing corners; they return None if they find no board."""
_NEARLY_WHOLE = 0.8
"""Fraction of found corners above which no further detector is tried."""


def _from_top_left(grey: np.ndarray, grid: np.ndarray) -> np.ndarray:
    """Return the grid (rows, columns, 2) rotated to the frame of `ChessboardTarget`."""
    along, across = (np.nanmean(np.diff(grid, axis=axis), axis=(0, 1)) for axis in (1, 0))
    if along[0] * across[1] < along[1] * across[0]:
        grid = grid[:, ::-1]
    rows, columns = grid.shape[:2]
    if (rows + columns) % 2:
        centres = (grid[:-1, :-1] + grid[1:, 1:] + grid[:-1, 1:] + grid[1:, :-1]) / 4
        known = np.isfinite(centres[..., 0])
        u, v = np.rint(centres[known]).astype(int).T
        even = (np.add.outer(np.arange(rows - 1), np.arange(columns - 1)) % 2 == 0)[known]
        levels = grey[v, u]
        return grid if levels[even].mean() < levels[~even].mean() else grid[::-1, ::-1]
    # A square board has four equal orientations, other boards have two.
    turned = [np.rot90(grid, turn) for turn in (range(4) if rows == columns else (0, 2))]
    return max(turned, key=lambda each: np.nanmean(np.diff(each, axis=1)[..., 0]))
