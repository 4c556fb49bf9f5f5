"""Models of the sensor to choose from, and a joint problem put in their terms."""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from uwlts.calibration.intrinsics import Intrinsics
from uwlts.calibration.joint.parameters import Parameters
from uwlts.calibration.joint.procedure import JointProblem
from uwlts.model.calibration import WindowModel
from uwlts.model.parameter_keys import ParameterKey, SheetParameter, WindowParameter

_HELD: dict[str, tuple[ParameterKey, ...]] = {
    "window_tilt": (WindowParameter.SLOPE_X, WindowParameter.SLOPE_Y),
    "bow": (SheetParameter.BOW,),
    "window_turn": (SheetParameter.WINDOW_TURN,),
}
_GLASS = (WindowParameter.THICKNESS, WindowParameter.GLASS_INDEX)


@dataclass(frozen=True)
class Candidate:
    """A model of the sensor; what is not free is held as described.

    Attributes
    ----------
    refractions : by the camera's window: one interface, or a pane of glass
    window_tilt : whether the tilt of the camera's window is free
    bow : whether the sheet's bow is free
    window_turn : whether the turn of the laser's window is free
    distortion : coefficients that are free; the others are zero
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
        or any(held in parameters.keys for held in _HELD.get(name, ()))
    }


def recast(problem: JointProblem, candidate: Candidate) -> JointProblem:
    """The problem with the candidate's parameters, starting where it started.

    The distance of a single interface is only known to lie near the described one, as it stands for a pane of glass.
    """
    known = problem.parameters
    options = replace(known.intrinsics.options, distortion=candidate.distortion)
    intrinsics = Intrinsics(options, width_px=known.intrinsics.width_px, height_px=known.intrinsics.height_px)
    held = {key for field, keys in _HELD.items() if not getattr(candidate, field) for key in keys}
    window, priors = known.window, dict(known.priors)
    if candidate.refractions == 1 and window is not None:
        window = WindowModel(refractions=1, distance_mm=window.distance_mm, normal=window.normal)
        held |= set(_GLASS)
        priors |= {
            WindowParameter.DISTANCE: replace(priors[WindowParameter.DISTANCE], std=np.inf),
            WindowParameter.THICKNESS: replace(priors[WindowParameter.THICKNESS], mean=0.0),
            WindowParameter.GLASS_INDEX: replace(priors[WindowParameter.GLASS_INDEX], mean=1.0),
        }
    priors = {key: replace(prior, std=0.0) if key in held else prior for key, prior in priors.items()}
    parameters = replace(known, intrinsics=intrinsics, window=window, priors=priors)
    start = dict(zip(known.keys, problem.global_values, strict=True))
    global_values = np.array([start.get(key, 0.0) for key in parameters.keys])
    return replace(problem, parameters=parameters, global_values=global_values)
