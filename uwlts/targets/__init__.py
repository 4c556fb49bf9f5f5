"""Calibration targets: their descriptions and their detection in images.

All modules of this package are imported with it, so that the target types in them are known by their kind. The
detectors are in the subpackage ``detection``, which is imported when a target is detected.
"""

from importlib import import_module
from pkgutil import iter_modules

from uwlts.targets.chessboard import CharucoTarget, ChessboardTarget
from uwlts.targets.circles import CircleGridTarget, CircleTarget
from uwlts.targets.target import Patch, Target, TargetView, parse_target

__all__ = [
    "CharucoTarget",
    "ChessboardTarget",
    "CircleGridTarget",
    "CircleTarget",
    "Patch",
    "Target",
    "TargetView",
    "parse_target",
]

for _module in iter_modules(__path__):
    if not _module.ispkg:
        import_module(f"{__name__}.{_module.name}")
