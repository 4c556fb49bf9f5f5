"""Detection of circles, lattices of circles, and corners in images."""

from uwlts.targets.detection.chessboard_grid import count_seen, refined, why_no_chessboard
from uwlts.targets.detection.chessboard_lattice import find_board
from uwlts.targets.detection.corners import corner_quality, eight_bit
from uwlts.targets.detection.ellipses import Ellipses, find_circles, mark_strength
from uwlts.targets.detection.lattice import Lattice, detect_lattice, label_lattice

__all__ = [
    "Ellipses",
    "Lattice",
    "corner_quality",
    "count_seen",
    "detect_lattice",
    "eight_bit",
    "find_board",
    "find_circles",
    "label_lattice",
    "mark_strength",
    "refined",
    "why_no_chessboard",
]
