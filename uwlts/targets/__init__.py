"""Calibration targets: their descriptions, and finding them in images."""

from uwlts.targets.circles import find_circles
from uwlts.targets.description import CharucoTarget, ChessboardTarget, CircleTarget, Target, parse_target
from uwlts.targets.detect import detect_target
from uwlts.targets.ellipse_bias import circle_centre_bias
from uwlts.targets.ellipses import Ellipses
from uwlts.targets.lattice import Lattice, detect_lattice, label_lattice
from uwlts.targets.view import TargetView

__all__ = [
    "CharucoTarget",
    "ChessboardTarget",
    "CircleTarget",
    "Ellipses",
    "Lattice",
    "Target",
    "TargetView",
    "circle_centre_bias",
    "detect_lattice",
    "detect_target",
    "find_circles",
    "label_lattice",
    "parse_target",
]
