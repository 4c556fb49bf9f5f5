"""How far the plate of a calibration target reaches, as far as its description tells."""

import numpy as np

from uwlts.targets import CharucoTarget, ChessboardTarget, CircleTarget, Target


def plate_extent(target: Target) -> np.ndarray:
    """Corners (4, 2) in mm, target frame, of the rectangle that the pattern is known to cover: outermost point centres.

    A ChArUco board is covered to its rim.
    """
    match target:
        case CircleTarget():
            spacing = np.array([target.spacing_x_mm, target.spacing_y_mm])
            first = -spacing * target.origin
            last = first + spacing * [target.columns - 1, target.rows - 1]
        case ChessboardTarget():
            first, last = np.zeros(2), target.square_mm * np.array([target.columns - 1.0, target.rows - 1.0])
        case CharucoTarget():
            first, last = np.zeros(2), target.square_mm * np.array([target.columns, target.rows])
    return np.array([first, (last[0], first[1]), last, (first[0], last[1])])


def lattice_spacing(target: Target) -> float:
    """Distance in mm between neighbouring points of the target, the smaller one."""
    if isinstance(target, CircleTarget):
        return min(target.spacing_x_mm, target.spacing_y_mm)
    return target.square_mm
