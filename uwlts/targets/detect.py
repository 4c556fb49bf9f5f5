"""Find any kind of calibration target in an image."""

from uwlts.targets.charuco import detect_charuco
from uwlts.targets.chessboard import detect_chessboard
from uwlts.targets.circle_plate import detect_circle_plate
from uwlts.targets.description import CharucoTarget, ChessboardTarget, Target
from uwlts.targets.view import TargetView


def detect_target(image, target: Target) -> TargetView:
    """Find the points of a calibration target in an image.

    Parameters
    ----------
    image : (H, W) uint8 or uint16
    target : CircleTarget, ChessboardTarget or CharucoTarget

    Returns
    -------
    TargetView

    Raises
    ------
    ImageError
        The image is no grey image of 8 or 16 bit.
    TargetError
        The target is not found completely enough; the message says what was missing.
    """
    match target:
        case ChessboardTarget():
            return detect_chessboard(image, target)
        case CharucoTarget():
            return detect_charuco(image, target)
        case _:
            return detect_circle_plate(image, target)
