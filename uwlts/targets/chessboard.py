"""The chessboard and the ChArUco target, seen completely or in part."""

from collections.abc import Callable
from functools import partial
from typing import Annotated, Literal, Self

import cv2
import numpy as np
from pydantic import Field, model_validator

from uwlts.errors import TargetError
from uwlts.model.sensor import Positive
from uwlts.targets.target import Patch, Target, TargetView, lattice_indices, rectangle_corners

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
        pixels = _rotate_to_top_left(grey, part).reshape(-1, 2)
        seen = np.isfinite(pixels[:, 0])
        pixels, indices = pixels[seen], self.indices[seen]
        return TargetView(pixels, self.points_at(indices), indices, measure_corners(image, pixels))


def _find_by_lattice(grey: np.ndarray, columns: int, rows: int) -> np.ndarray | None:
    from uwlts.targets.detection import find_board

    return find_board(grey, columns, rows)


def _find_by_opencv(
    find: Callable[..., tuple[bool, np.ndarray]], flags: int, grey: np.ndarray, columns: int, rows: int
) -> np.ndarray | None:
    # The same random numbers for every image.
    cv2.setRNGSeed(0)
    found, corners = find(grey, (columns, rows), flags=flags)
    return corners.reshape(rows, columns, 2).astype(np.float64) if found else None


_DETECTORS = {
    "its saddle points": _find_by_lattice,
    "OpenCV's sectors": partial(_find_by_opencv, cv2.findChessboardCornersSB, _SECTOR_FLAGS),
    "OpenCV's squares": partial(_find_by_opencv, cv2.findChessboardCorners, _QUAD_FLAGS),
}
"""Detectors of corners (rows, columns, 2) with NaN for missing corners; they return None if they find no board."""
_NEARLY_WHOLE = 0.8  # fraction of found corners above which no further detector is tried


def _rotate_to_top_left(grey: np.ndarray, grid: np.ndarray) -> np.ndarray:
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


_MIN_CORNERS = 4  # fewest corners of a view: they determine a homography


class CharucoTarget(Target):
    """A chessboard with ArUco markers in its white squares.

    The origin is the top left corner of the board (OpenCV's frame), so the first inner corner is at (square_mm,
    square_mm).

    Attributes
    ----------
    columns, rows : number of squares along X and along Y
    square_mm, marker_mm : sides of a square and of a marker
    dictionary : name of the predefined marker dictionary, such as DICT_4X4_100
    legacy : True for the pattern of OpenCV before 4.6, which differs for even `rows`
    """

    kind: Literal["charuco"] = "charuco"
    columns: Annotated[int, Field(ge=3)]
    rows: Annotated[int, Field(ge=3)]
    square_mm: Positive
    marker_mm: Positive
    dictionary: str = "DICT_4X4_100"
    legacy: bool = False

    @model_validator(mode="after")
    def _check_consistent(self) -> Self:
        if self.marker_mm >= self.square_mm:
            raise ValueError(f"marker_mm is {self.marker_mm}; expected less than square_mm, {self.square_mm}")
        known = [name for name in dir(cv2.aruco) if name.startswith("DICT_")]
        if self.dictionary not in known:
            raise ValueError(f"dictionary is {self.dictionary!r}; expected one of {', '.join(known)}")
        available = len(cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, self.dictionary)).bytesList)
        needed = self.columns * self.rows // 2
        if needed > available:
            raise ValueError(f"the board needs {needed} markers; {self.dictionary} has only {available}")
        return self

    def board(self) -> cv2.aruco.CharucoBoard:
        """Return OpenCV's board object, lengths in mm."""
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, self.dictionary))
        board = cv2.aruco.CharucoBoard((self.columns, self.rows), self.square_mm, self.marker_mm, dictionary)
        board.setLegacyPattern(self.legacy)
        return board

    @property
    def indices(self) -> np.ndarray:
        return lattice_indices(self.columns - 1, self.rows - 1)

    def points_at(self, indices: np.ndarray) -> np.ndarray:
        return np.column_stack([(indices + 1) * self.square_mm, np.zeros(len(indices))])

    @property
    def spacing_mm(self) -> float:
        return self.square_mm

    @property
    def extent_mm(self) -> np.ndarray:
        """Corners (4, 2), target frame, of the board, which is printed to its edge."""
        return rectangle_corners(np.zeros(2), self.square_mm * np.array([self.columns, self.rows]))

    def patches(self) -> list[Patch]:
        board = self.board()
        dictionary, first_corners = board.getDictionary(), np.array(board.getObjPoints(), float)[:, 0, :2]
        white = {tuple(place) for place in np.floor(first_corners / self.square_mm).astype(int).tolist()}
        squares = [place for place in lattice_indices(self.columns, self.rows).tolist() if tuple(place) not in white]
        patches = [Patch(*(np.array([i, j, i + 1, j + 1]) * self.square_mm).tolist()) for i, j in squares]
        # Cells of a marker across, with its border of one cell.
        across = dictionary.markerSize + 2
        cell = self.marker_mm / across
        for number, first in zip(np.ravel(board.getIds()).tolist(), first_corners, strict=True):
            x, y = (first[:, None] + cell * np.arange(across + 1)).tolist()
            dark = cv2.aruco.generateImageMarker(dictionary, number, across) == 0
            patches += [Patch(x[i], y[j], x[i + 1], y[j + 1]) for j, i in np.argwhere(dark).tolist()]
        return patches

    def detect(self, image: np.ndarray) -> TargetView:
        # Imported late: a description does not need the detector.
        from uwlts.targets.detection import convert_to_eight_bit, measure_corners

        corners, numbers, _, markers = cv2.aruco.CharucoDetector(self.board()).detectBoard(convert_to_eight_bit(image))
        count = 0 if numbers is None else len(numbers)
        if count < _MIN_CORNERS:
            seen = 0 if markers is None else len(markers)
            raise TargetError(
                f"found {seen} markers of {self.dictionary} and {count} inner corners of the {self.columns} x "
                f"{self.rows} board; expected at least {_MIN_CORNERS} corners: check that the board is in view and "
                "sharp, and its dictionary and legacy setting"
            )
        # OpenCV 4 and 5 differ in the singleton dimensions of these arrays.
        pixels = np.asarray(corners, np.float64).reshape(-1, 2)
        indices = self.indices[np.asarray(numbers, np.int64).reshape(-1)]
        return TargetView(pixels, self.points_at(indices), indices, measure_corners(image, pixels))
