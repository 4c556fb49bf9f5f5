"""The ChArUco board in an image."""

import cv2
import numpy as np

from uwlts.errors import TargetError
from uwlts.targets.corners import corner_quality, eight_bit
from uwlts.targets.description import CharucoTarget
from uwlts.targets.view import TargetView

MIN_CORNERS = 4


def charuco_board(target: CharucoTarget):
    """OpenCV's board object of a description, lengths in mm."""
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, target.dictionary))
    board = cv2.aruco.CharucoBoard((target.columns, target.rows), target.square_mm, target.marker_mm, dictionary)
    board.setLegacyPattern(target.legacy)
    return board


def detect_charuco(image, target: CharucoTarget) -> TargetView:
    """Find the inner corners of a ChArUco board that are in view.

    Raises
    ------
    ImageError
        The image is no grey image of 8 or 16 bit.
    TargetError
        Fewer than four inner corners are found.
    """
    board = charuco_board(target)
    corners, numbers, _, markers = cv2.aruco.CharucoDetector(board).detectBoard(eight_bit(image))
    count = 0 if numbers is None else len(numbers)
    if count < MIN_CORNERS:
        seen = 0 if markers is None else len(markers)
        raise TargetError(
            f"found {seen} markers of {target.dictionary} and {count} inner corners of the {target.columns} x "
            f"{target.rows} board; expected at least {MIN_CORNERS} corners: check that the board is in view and sharp, "
            "and its dictionary and legacy setting"
        )
    # OpenCV 4 and 5 differ in the singleton dimensions of these arrays.
    numbers = np.asarray(numbers).reshape(-1)
    pixels = np.asarray(corners, np.float64).reshape(-1, 2)
    points = np.asarray(board.getChessboardCorners(), np.float64).reshape(-1, 3)[numbers]
    indices = np.column_stack(np.divmod(numbers, target.columns - 1)[::-1]).astype(np.int64)
    return TargetView(pixels, points, indices, corner_quality(image, pixels))
