"""Probability of detection of pits, dents and undercuts in rendered campaigns, after MIL-HDBK-1823A (2009).

A search reports only what it finds: its hits and misses are a logistic function of the logarithm of the depth, and the
bound is that of the likelihood ratio (appendix G.3). Undercuts are measured on every weld: their signals are a linear
function of the depth, left-censored at zero, and the bound is a tolerance limit (Wald's of appendix G.2 is too small).
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from pydantic import BaseModel
from scipy import optimize, special, stats

from twin.scene.campaign import Take
from twin.scene.description import Scene
from twin.scene.forms import PittedPipe, Weld
from twin.scene.forms.parts import pit_depths, pit_places, undercut_depths
from twin.scene.platforms import Motion
from uwlts.errors import CaptureError

Flaw = Literal["pit", "dent", "undercut"]
Method = Literal["hit/miss", "signal response"]

FEWEST = {"hit/miss": 60, "signal response": 40}  # fewest flaws of an experiment (MIL-HDBK-1823A, 4.5.2.2)
_DENT_SHARE = 0.1
"""Width of a dent, as a fraction of the pipe's diameter; narrower hollows are pits, as `uwlts inspect` names them."""
_PLACE_MM = 1.0  # largest distance of a finding from the rim of its pit: errors of calibration and of the deepest place
_NINETY = 0.9
_ONE_SIDED = 0.95
_SLOPES = (-1.0, 5.0)
"""Range of the logarithm of the logistic's slope: from a factor of 400 between 10 and 90 % to one of 1.03."""
_SIGNAL_VALUES = ("undercut left", "undercut right")


class Fitted(BaseModel, frozen=True):
    """Fitted probability of detection.

    The parameters of the curve are, for hits and misses, the logarithm of the depth in mm with 50 % and the inverse
    slope of the logistic; for a signal response, the depth with 50 % and the standard deviation of a normal
    distribution, in mm.
    """

    a90_mm: float | None = None  # depth found with a probability of 90 %; None if the flaws do not determine it
    a90_95_mm: float | None = None  # its upper bound with 95 % confidence; None if the flaws do not bound it
    location: float | None = None
    scale: float | None = None


class ProbabilityOfDetection(Fitted, frozen=True):
    """Probability of detection of one kind of flaw against its depth."""

    flaw: Flaw  # "pit", "dent" or "undercut"
    width_mm: float  # width of the flaws
    method: Method  # "hit/miss" or "signal response"
    checked: str  # where the statement was checked: scene, place, profiles and water
    depths_mm: tuple[float, ...]  # true depths
    found: tuple[bool, ...]  # whether each flaw was found
    signals_mm: tuple[float, ...] | None = None
    """Measured depths of a signal response, 0 where nothing was measured; None for hits and misses."""
    false_calls: int = 0  # findings that are no flaw

    def probability(self, depth_mm: np.ndarray) -> np.ndarray:
        """Return the probability of detection (K,) at depths (K,) in mm; NaN if it is not determined."""
        if self.location is None or self.scale is None:
            return np.full(np.shape(depth_mm), np.nan)
        if self.method == "hit/miss":
            return 1 / (1 + np.exp(-(np.log(depth_mm) - self.location) / self.scale))
        return stats.norm.cdf((depth_mm - self.location) / self.scale)

    def limits(self) -> str:
        """Return limitations as a text; empty if there are none."""
        count = len(self.depths_mm)
        found = [f"{count} flaws, fewer than {FEWEST[self.method]}"] if count < FEWEST[self.method] else []
        if self.a90_mm is None:
            found.append("hits and misses do not determine a90")
        elif self.a90_95_mm is None:
            found.append("a90 is not bounded")
        if self.method == "signal response" and (false := float(self.probability(np.zeros(1))[0])) > 1 - _ONE_SIDED:
            found.append(f"false calls with {100 * false:.0f} % probability")
        return "; ".join(found)


def fit_hit_miss(depth_mm: np.ndarray, found: np.ndarray) -> Fitted:
    """Fit a logistic of the logarithm of the depth to hits and misses.

    The bound of a90 is that of the one-sided profile likelihood (chi-square's 90 % quantile, one degree of freedom),
    times a power of the information's determinant (Firth, Biometrika 80, 1993, 27-38). The plain likelihood's bound
    holds in 70 to 93 % of draws of 40 flaws, with the power 1/3 in 94 to 100 %; Firth's 1/2 has larger bounds.

    Parameters
    ----------
    depth_mm : (N,)
        True depths.
    found : (N,) bool
        Hits.
    """
    if found.all() or not found.any():
        return Fitted()
    x, odds = np.log(depth_mm), math.log(_NINETY / (1 - _NINETY))

    def loss(at_90: float, slope: float) -> float:
        logit = odds + slope * (x - at_90)
        weight = special.expit(logit) * special.expit(-logit) + 1e-300  # the logarithm of no weight is not finite
        about = x - weight @ x / weight.sum()
        information = math.log(weight.sum()) + math.log(weight @ about**2)
        return -float(np.sum(special.log_expit(np.where(found, logit, -logit)))) - information / 3

    def profile(at_90: float) -> tuple[float, float]:
        return _minimise(lambda logarithm: loss(at_90, math.exp(logarithm)), _SLOPES)

    ends = float(x.min()) - 1, float(x.max()) + 1
    at_90, least = _minimise(lambda at: profile(at)[1], ends)
    if min(at_90 - ends[0], ends[1] - at_90) < 1e-3:
        return Fitted()
    limit = least + 0.5 * float(stats.chi2.ppf(2 * _ONE_SIDED - 1, 1))
    bound = None
    if profile(ends[1])[1] > limit:
        crossing = optimize.root_scalar(lambda at: profile(at)[1] - limit, bracket=(at_90, ends[1]), xtol=1e-4)
        bound = math.exp(crossing.root)
    scale = math.exp(-profile(at_90)[0])
    return Fitted(a90_mm=math.exp(at_90), a90_95_mm=bound, location=at_90 - odds * scale, scale=scale)


def _minimise(of: Callable[[float], float], ends: tuple[float, float]) -> tuple[float, float]:
    """Return the place and the value of a function's minimum between two ends."""
    found: Any = optimize.minimize_scalar(of, bounds=ends, method="bounded")
    return float(found.x), float(found.fun)


def fit_signal_response(depth_mm: np.ndarray, signal_mm: np.ndarray, *, threshold_mm: float) -> Fitted:
    """Fit a line to signals against depths, and return the probability that a signal exceeds a threshold.

    Signals of 0 are censored: their value before the correction for noise was 0 or less. The scatter is normal and of
    equal size at all depths. At the bound of a90 the lower tolerance limit of 90 % of signals reaches the threshold, by
    the noncentral t distribution (Owen, Technometrics 10, 1968, 445-478); Wald's held in 91 % of draws of 40 flaws.

    Parameters
    ----------
    depth_mm, signal_mm : (N,)
        True and measured depths.
    threshold_mm
        Signal from which a flaw counts as found.
    """
    seen = signal_mm > 0
    if np.count_nonzero(seen) < 3:
        return Fitted()
    slope, offset = np.polyfit(depth_mm[seen], signal_mm[seen], 1)
    scatter = max(float(np.std(signal_mm[seen] - slope * depth_mm[seen] - offset)), 1e-6)

    def loss(free: np.ndarray) -> float:
        z = (signal_mm - free[0] - free[1] * depth_mm) / math.exp(free[2])
        logs = np.where(seen, -0.5 * z**2 - free[2], special.log_ndtr(z))
        return -float(np.sum(logs))

    best = optimize.minimize(loss, [offset, slope, math.log(scatter)], method="Nelder-Mead", options=_TIGHT).x
    if best[1] <= 0:
        return Fitted()

    offset, slope, scatter = best[0], best[1], math.exp(best[2])
    ninety, steps = float(stats.norm.ppf(_NINETY)) * scatter, np.array([0.1 * scatter, 0.02 * slope, 0.02])
    a90, bound = (threshold_mm - offset + ninety) / slope, None
    covariance = np.linalg.pinv(_differentiate_twice(loss, best, steps)) * np.outer(steps, steps)
    # Uncensored signals give N - 2, as n - 2 values with a known variance of the logarithm of their scatter would.
    freedom = 0.5 / covariance[2, 2] - 2

    def excess(depth_mm: float) -> float:
        place = np.array([1.0, depth_mm])
        leverage = math.sqrt(place @ covariance[:2, :2] @ place)
        factor = stats.nct.ppf(_ONE_SIDED, freedom, ninety / leverage)
        return offset + slope * depth_mm - factor * leverage * math.sqrt(1 + 2 / freedom) - threshold_mm

    last = float(depth_mm.max()) + 10 * float(np.ptp(depth_mm))  # far outside what the line was fitted to
    if freedom > 0 and np.all(np.linalg.eigvalsh(covariance) > 0) and excess(last) > 0:
        bound = float(optimize.root_scalar(excess, bracket=(a90, last)).root)
    return Fitted(a90_mm=a90, a90_95_mm=bound, location=(threshold_mm - offset) / slope, scale=scatter / slope)


_TIGHT = {"xatol": 1e-7, "fatol": 1e-9, "maxiter": 4000}


def _differentiate_twice(of: Callable[[np.ndarray], float], at: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """Return the second derivatives (K, K) of a function, with respect to parameters in units of ``steps`` (K,)."""
    moves = np.diag(steps) / 2
    return np.array([[of(at + a + b) - of(at + a - b) - of(at - a + b) + of(at - a - b) for b in moves] for a in moves])


@dataclass
class FlawFindings:
    """Flaws of one kind, collected over scans and campaigns.

    ``thresholds_mm`` are the least significant signals of undercuts, ``values`` the measured value, its standard
    uncertainty and the true value of each flaw found.
    """

    flaw: Flaw
    width_mm: float
    checked: str
    depths_mm: list[float] = field(default_factory=list)
    found: list[bool] = field(default_factory=list)
    signals_mm: list[float] = field(default_factory=list)
    thresholds_mm: list[float] = field(default_factory=list)
    values: list[tuple[float, float, float]] = field(default_factory=list)
    false_calls: int = 0

    def detection(self) -> ProbabilityOfDetection:
        """Return the probability of detection."""
        depth, found = np.array(self.depths_mm), np.array(self.found)
        if self.flaw == "undercut":
            method: Method = "signal response"
            level = float(np.median(self.thresholds_mm)) if self.thresholds_mm else math.inf
            fitted = fit_signal_response(depth, np.array(self.signals_mm), threshold_mm=level)
        else:
            method, fitted = "hit/miss", fit_hit_miss(depth, found)
        return ProbabilityOfDetection(
            flaw=self.flaw,
            width_mm=self.width_mm,
            method=method,
            checked=self.checked,
            depths_mm=tuple(self.depths_mm),
            found=tuple(self.found),
            signals_mm=tuple(self.signals_mm) if self.flaw == "undercut" else None,
            false_calls=self.false_calls,
            **fitted.model_dump(),
        )


def flaws_of(scene: Scene) -> tuple[Flaw, float] | None:
    """Return the kind and width in mm of a scene's flaws with drawn depths; None without any."""
    for thing in scene.objects:
        match thing:
            case PittedPipe() if thing.draws_depths():
                is_dent = thing.pit_diameter_mm > _DENT_SHARE * thing.diameter_mm
                return "dent" if is_dent else "pit", thing.pit_diameter_mm
            case Weld() if thing.draws_depths():
                return "undercut", thing.undercut_width_mm
    return None


def collect_findings(into: FlawFindings, take: Take, inspection: dict[str, Any]) -> None:
    """Add the flaws of a recording and the findings of its inspection (the content of its file).

    CaptureError if the inspection is incomplete.
    """
    try:
        if into.flaw == "undercut":
            _collect_undercuts(into, take.scene, inspection)
        else:
            _collect_pits(into, take.scene, inspection)
    except (KeyError, TypeError, IndexError) as error:
        raise CaptureError(f"the inspection of {take.name} is incomplete: {error}") from error


def _collect_pits(into: FlawFindings, scene: Scene, inspection: dict[str, Any]) -> None:
    """Add the pits within the scanned part of a pipe, cut by its ends or not.

    A pit cut by an end is found if a finding is there. Its values are bounds and are not compared, as for all findings
    that are not sized.
    """
    number = next(n for n, thing in enumerate(scene.objects) if isinstance(thing, PittedPipe))
    pipe, place = scene.objects[number], scene.object_poses()[number]
    assert isinstance(pipe, PittedPipe)
    scale, into_pipe, depths = np.array([1.0, pipe.diameter_mm / 2]), np.linalg.inv(place), pit_depths(pipe).tolist()
    pits, reach = pit_places(pipe) * scale, pipe.pit_diameter_mm / 2 + _PLACE_MM

    def distances_mm(place_mm: list[float]) -> np.ndarray:
        x, y, z = (into_pipe @ [*place_mm, 1.0])[:3]
        return np.linalg.norm(pits - np.array([x, math.atan2(y, -z)]) * scale, axis=1)

    hollows = [each for each in inspection["features"] if each["kind"] in ("pit", "dent")]
    known: dict[int, dict[str, Any] | None] = {}
    for feature in hollows:
        # Neighbours that the search joined are found, too, but their depths are not measured.
        for whole, at in [(feature, feature["place_mm"]), *((None, at) for at in feature["hollows_mm"])]:
            nearest = int(np.argmin(distances_mm(at)))
            if distances_mm(at)[nearest] < reach and known.get(nearest) is None:
                known[nearest] = whole
    into.false_calls += sum(
        bool(np.all(distances_mm(each["place_mm"]) > reach))
        for each in inspection["features"]
        if each["kind"] in ("pit", "dent", "protrusion")
    )
    first, last = -math.inf, math.inf  # ends of the scan along X; without a stage, everything
    if isinstance(move := scene.motion, Motion):
        first, last = sorted((move.start_mm, move.start_mm + move.step_mm * (move.count - 1)))
    along = pits[:, 0] + place[0, 3]
    for pit in np.flatnonzero((along > first) & (along < last)).tolist():
        into.depths_mm.append(depths[pit])
        into.found.append(pit in known)
        if (feature := known.get(pit)) is not None and feature["reason"] is None:
            into.values.append((*_state_value(feature["values"]["depth"]), depths[pit]))


def _collect_undercuts(into: FlawFindings, scene: Scene, inspection: dict[str, Any]) -> None:
    """Add the undercuts on both sides of a weld."""
    weld = next(thing for thing in scene.objects if isinstance(thing, Weld))
    found = next(each for each in inspection["features"] if each["kind"] == "weld")
    # "left" is the side of smaller values along the feature's second axis.
    across = found["axes"][1][1 if weld.along == "x" else 0]
    depths = undercut_depths(weld)[0] if across > 0 else undercut_depths(weld)[0, ::-1]
    for name, depth in zip(_SIGNAL_VALUES, depths.tolist(), strict=True):
        value = found["values"].get(name)
        into.depths_mm.append(depth)
        into.found.append(value is not None and value["low"] > 0)
        into.signals_mm.append(value["value"] if value is not None else 0.0)
        if value is not None:
            into.thresholds_mm.append(value["high"] - value["value"])
            into.values.append((*_state_value(value), depth))


def _state_value(value: dict[str, Any]) -> tuple[float, float]:
    """Return a value and its standard uncertainty."""
    return value["value"], math.hypot(value["random"], value["systematic"] or 0.0)


def deep_values(found: FlawFindings, detection: ProbabilityOfDetection) -> Iterator[tuple[float, float, float]]:
    """Yield the values of flaws at least as deep as a90/95; shallower ones are found by the noise that deepens them."""
    least = detection.a90_95_mm if detection.a90_95_mm is not None else math.inf
    return (each for each in found.values if found.flaw == "undercut" or each[2] >= least)
