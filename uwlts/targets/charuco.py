"""The ChArUco target, a chessboard that may be seen in part."""

from typing import Annotated, Literal, Self

import cv2
import numpy as np
from pydantic import Field, model_validator

from uwlts.errors import TargetError
from uwlts.model.sensor import Positive
from uwlts.targets.target import Patch, Target, TargetView, lattice_indices, rectangle_corners

_MIN_CORNERS = 4
"""Fewest corners of a view: they determine a homography."""


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
    def _consistent(self) -> Self:
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
