"""Models of the sensor to choose from, and a joint problem put in their terms."""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from uwlts.calibration.intrinsics import Intrinsics
from uwlts.calibration.joint.parameters import Parameters
from uwlts.calibration.joint.procedure import JointProblem
from uwlts.calibration.model import WindowModel

_HELD = {
    "window_tilt": ("window_slope_x", "window_slope_y"), "bow": ("sheet_bow",), "window_turn": ("laser_window_turn",),
}  # fmt: skip
_GLASS = ("glass_thickness", "glass_index")


@dataclass(frozen=True)
class Candidate:
    """A model of the sensor; what is not free is held as described.

    Attributes
    ----------
    refractions : {1, 2}
        By the camera's window: one interface, or a glass plate.
    window_tilt : bool
        Whether the tilt of the camera's window is free.
    bow : bool
        Whether the sheet's bow is free.
    window_turn : bool
        Whether the turn of the laser's window is free.
    distortion : tuple of str
        Coefficients that are free; the others are zero.
    """

    refractions: Literal[1, 2] = 2
    window_tilt: bool = True
    bow: bool = True
    window_turn: bool = True
    distortion: tuple[str, ...] = ("k1", "k2")

    def words(self) -> str:
        """The model by what sets it apart from the usual one."""
        usual, parts = Candidate(), []
        if self.refractions != usual.refractions:
            parts.append("one refraction")
        if not self.window_tilt:
            parts.append("window not tilted")
        if not self.bow:
            parts.append("sheet without bow")
        if not self.window_turn:
            parts.append("laser window not turned")
        if self.distortion != usual.distortion:
            parts.append(distortion_words(self.distortion))
        return ", ".join(parts) or "usual (glass plate, tilts, bow, k1 k2)"


def distortion_words(distortion: tuple[str, ...]) -> str:
    """Distortion coefficients by name."""
    return "distortion " + " ".join(distortion) if distortion else "no distortion"


DIMENSIONS: dict[str, tuple[object, ...]] = {
    "refractions": (1,),
    "window_tilt": (False,),
    "bow": (False,),
    "window_turn": (False,),
    "distortion": ((), ("k1",), ("k1", "k2", "k3"), ("k1", "k2", "p1", "p2")),
}
"""What may be otherwise than usual, one at a time."""


def dimensions_of(parameters: Parameters) -> dict[str, tuple[object, ...]]:
    """Those that the evidence has to do with."""
    return {
        name: others
        for name, others in DIMENSIONS.items()
        if name == "distortion"
        or (name == "refractions" and parameters.window is not None)
        or any(held in parameters.names for held in _HELD.get(name, ()))
    }


def recast(problem: JointProblem, candidate: Candidate) -> JointProblem:
    """The problem with the candidate's parameters, starting where it started.

    The distance of a single interface is only known to lie near the described one, as it stands for a glass plate.
    """
    known = problem.parameters
    options = replace(known.intrinsics.options, distortion=candidate.distortion)
    intrinsics = Intrinsics(options, width_px=known.intrinsics.width_px, height_px=known.intrinsics.height_px)
    held = {name for field, names in _HELD.items() if not getattr(candidate, field) for name in names}
    window, priors = known.window, dict(known.priors)
    if candidate.refractions == 1 and window is not None:
        window = WindowModel(refractions=1, distance_mm=window.distance_mm, normal=window.normal)
        held |= set(_GLASS)
        priors |= {
            "window_distance": replace(priors["window_distance"], std=np.inf),
            "glass_thickness": replace(priors["glass_thickness"], mean=0.0),
            "glass_index": replace(priors["glass_index"], mean=1.0),
        }
    priors = {name: replace(prior, std=0.0) if name in held else prior for name, prior in priors.items()}
    parameters = replace(known, intrinsics=intrinsics, window=window, priors=priors)
    start = dict(zip(known.names, problem.shared, strict=True))
    shared = np.array([start.get(name, 0.0) for name in parameters.names])
    return replace(problem, parameters=parameters, shared=shared)
