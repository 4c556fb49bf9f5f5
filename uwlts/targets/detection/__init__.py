"""Detection of circles, lattices of circles, and corners in images."""

from uwlts.targets.detection.chessboard_grid import (
    convert_to_eight_bit,
    count_corners,
    find_chessboard_fault,
    measure_corners,
    refine_corners,
)
from uwlts.targets.detection.chessboard_lattice import find_board, find_largest_piece
from uwlts.targets.detection.ellipses import Ellipses, find_circles, measure_marks
from uwlts.targets.detection.lattice import Lattice, detect_lattice, label_lattice

__all__ = [
    "Ellipses",
    "Lattice",
    "convert_to_eight_bit",
    "count_corners",
    "detect_lattice",
    "find_board",
    "find_chessboard_fault",
    "find_circles",
    "find_largest_piece",
    "label_lattice",
    "measure_corners",
    "measure_marks",
    "refine_corners",
]
