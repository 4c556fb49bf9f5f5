"""Detection of circles, lattices of circles, and corners in images."""

from uwlts.targets.detection.corners import corner_quality, eight_bit
from uwlts.targets.detection.ellipses import Ellipses, find_circles, mark_strength
from uwlts.targets.detection.lattice import Lattice, detect_lattice, label_lattice

__all__ = [
    "Ellipses",
    "Lattice",
    "corner_quality",
    "detect_lattice",
    "eight_bit",
    "find_circles",
    "label_lattice",
    "mark_strength",
]
