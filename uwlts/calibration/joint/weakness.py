"""What the evidence cannot tell: directions in the parameters that it leaves open and that change measured lengths.

The covariance of all lengths over the covered volume is split into independent parts, each along one direction of the
parameters: J R = U S V^T with J the derivatives of the lengths and R R^T the parameters' covariance (GUM, JCGM
102:2011, section 6.2). A direction counts by what it does to lengths and not by how large it is, as parameters may
trade places without any length changing.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from uwlts.calibration.joint.volume import Lengths
from uwlts.calibration.parameter_keys import ParameterKey

_MOST = 3
_LEAST_SHARE = 0.1
"""Of the variance of all lengths; a direction that adds less is not worth a word."""
_NAMED_SHARE = 0.4
_CAUSE_SHARE = 0.3
_CONFUSED = 0.3
"""Smallest eigenvalue of the correlation of two parameters or more that can no longer be told apart: 0.7 for two."""
_NEGLIGIBLE_MM = 1e-3
_AXIS_COSINE = 0.9


@dataclass(frozen=True)
class Weakness:
    """A direction that the evidence leaves open.

    Attributes
    ----------
    parameters : tuple of ParameterKey
        Those that make it up, the most important first.
    confused : bool
        Whether the evidence cannot tell them apart, rather than knows each too little.
    cost_mm : float
        Standard uncertainty that it adds to the length that it changes most.
    length_mm : float
        That length.
    along : str
        Which way it runs: "Y", "Z" or "Y and Z".
    depth_mm : float
        Largest depth Z of its ends, OCS.
    """

    parameters: tuple[ParameterKey, ...]
    confused: bool
    cost_mm: float
    length_mm: float
    along: str
    depth_mm: float

    def words(self) -> str:
        """The weakness as a sentence without its full stop."""
        names = [key.quantity.words for key in self.parameters]
        listed = names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"
        what = f"{self.cost_mm:.3f} mm in a length of {self.length_mm:.0f} mm along {self.along}"
        if len(names) == 1:
            return f"{listed} is known too little; it costs {what}"
        if self.confused:
            return f"{listed} cannot be told apart by these images; together they cost {what}"
        return f"{listed} are known too little; together they cost {what}"


def weaknesses(lengths: Lengths, keys: Sequence[ParameterKey], covariance: np.ndarray) -> list[Weakness]:
    """The directions that cost most, at most three; none where no length becomes uncertain by a micrometre.

    Parameters
    ----------
    lengths : Lengths
        Over the volume.
    keys : sequence of ParameterKey
    covariance : (P, P)
    """
    std = np.sqrt(np.diag(covariance))
    scale = np.where(std > 0, std, 1.0)
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    root = scale[:, None] * vectors * np.sqrt(np.maximum(values, 0.0))
    _, sizes, parts = np.linalg.svd(lengths.by_parameters @ root, full_matrices=False)
    total = float(np.sum(sizes**2))
    found = []
    for size, part in zip(sizes[:_MOST], parts, strict=False):
        direction = root @ part
        changes = lengths.by_parameters @ direction
        worst = int(np.argmax(np.abs(changes)))
        if size**2 < _LEAST_SHARE * total or abs(changes[worst]) < _NEGLIGIBLE_MM:
            break
        named = _named(lengths, direction, std)
        start, end = lengths.ends_mm[worst]
        found.append(
            Weakness(
                parameters=tuple(keys[place] for place in named),
                confused=len(named) > 1 and _confused(covariance, named),
                cost_mm=float(abs(changes[worst])),
                length_mm=float(lengths.length_mm[worst]),
                along=_way(end - start),
                depth_mm=float(max(start[1], end[1])),
            )
        )
    return found


def format_weaknesses(found: Sequence[Weakness]) -> list[str]:
    """Weaknesses as sentences; that there are none is one."""
    if not found:
        return ["nothing that these images leave open changes a length over the volume by more than 0.001 mm"]
    return [weakness.words() for weakness in found]


def _named(lengths: Lengths, direction: np.ndarray, std: np.ndarray) -> list[int]:
    """Numbers of the parameters that make up a direction (P,), at most three, the most important first.

    Those count whose knowledge would close the direction: the share of it that goes with a parameter is the square of
    their correlation. A parameter that moves no point, such as the height of a step, may be the cause as well. Where
    knowing one would not help, many trade places, and those count that change lengths most.
    """
    share = np.divide(direction**2, std**2, out=np.zeros_like(std), where=std > 0)
    if share.max() < _CAUSE_SHARE:
        share = np.linalg.norm(lengths.by_parameters, axis=0) * np.abs(direction)
    return [int(place) for place in np.argsort(-share) if share[place] >= _NAMED_SHARE * share.max()][:_MOST]


def _confused(covariance: np.ndarray, named: Sequence[int]) -> bool:
    part = covariance[np.ix_(named, named)]
    std = np.sqrt(np.diag(part))
    return bool(np.linalg.eigvalsh(part / np.outer(std, std))[0] < _CONFUSED)


def _way(apart: np.ndarray) -> str:
    across, along = np.abs(apart) / np.linalg.norm(apart)
    return "Z" if along > _AXIS_COSINE else "Y" if across > _AXIS_COSINE else "Y and Z"
