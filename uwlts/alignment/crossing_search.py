"""Search of the crossings of a path: hypotheses with their scores, of which those that hold are closed.

A hypothesis is a pose in which a piece of the path lies well on an earlier one, found by correlation of the maps of
heights. It is tested by the drift that the navigation may have gathered, given all crossings that were closed before
(chi-square of shift and turn), and by an estimate of the path with it. Of the hypotheses within a few pieces the one
with the most agreeing patches is tested first, and none is closed where another place fits nearly as well.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from uwlts.alignment.height_correlation import shifts_of_heights
from uwlts.alignment.path_estimate import FEWEST, Pair, PathEstimate
from uwlts.fitting.patches import Patches, distances_between
from uwlts.registration.joint_registration import JointRegistration
from uwlts.runtime.progress import ProgressListener, unheard

SIGMAS = 3.0
"""Search range of crossings, in standard deviations of the drift."""
_GATE = float(chi2.ppf(0.9973, 6))
"""Of the squared Mahalanobis distance of a shift and a turn: as likely as three standard deviations of one number."""
_REFINED = 12
"""Rounds of a pair's own estimate."""
_LYING = 0.6
"""Share of the patches that lie on each other in a pose that is tested: pieces are bent as long as the drift is."""
_AHEAD = 4
"""Pieces after which a hypothesis is decided: a crossing and its doubles are seen within as many."""
_RIVAL = 0.5
"""Of the patches of the best hypothesis: another place with as many, that holds too, makes the crossing doubtful."""


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """A pose (4, 4) in which the later piece of a pair lies on the earlier, and the number of patches that agree."""

    pair: Pair
    pose: np.ndarray
    patches: int


def close_crossings(estimate: PathEstimate, progress: ProgressListener = unheard) -> list[Pair]:
    """Find and close the crossings of a path, in the order of time; returns pairs that were left out as doubtful."""
    waiting: list[Hypothesis] = []
    doubtful: list[Pair] = []
    count = len(estimate.pieces)
    for number in range(count):
        waiting += [each for each in _hypotheses(estimate, number) if not _beside(each.pair, doubtful)]
        while waiting and (number - min(each.pair[1] for each in waiting) >= _AHEAD or number == count - 1):
            best = max(waiting, key=lambda each: each.patches)
            waiting.remove(best)
            before = estimate.state()
            if not _closed(estimate, best):
                continue
            closed = estimate.state()
            if _has_rival(estimate, best, waiting, before):
                doubtful.append(best.pair)
                waiting = [each for each in waiting if not _beside(each.pair, doubtful)]
                estimate.restore(before)
                continue
            estimate.restore(closed)
            complete(estimate, number + 1)
            waiting = [each for each in waiting if each.pair not in estimate.pairs and _likely(estimate, each)]
        progress(number + 1, count)
    complete(estimate, count)
    return [pair for pair in doubtful if pair not in estimate.pairs]


def complete(estimate: PathEstimate, count: int) -> None:
    """Add all pairs of the first pieces that must lie on each other, by the path as it is known now."""
    closed = list(estimate.pairs)
    places = [estimate.moved(number).places_mm for number in range(count)]
    low, high = (np.array([of(each, axis=0) for each in places]) for of in (np.min, np.max))
    for later in range(count):
        near = np.all((low[later] < high + estimate.reach_mm) & (low < high[later] + estimate.reach_mm), axis=1)
        for earlier in np.flatnonzero(near[: max(later - 2, 0)]).tolist():
            pair = earlier, later
            reach = None if pair in closed else _reach(estimate, pair)
            if reach is not None and reach.max() < estimate.reach_mm:
                found, _ = estimate.matched(pair)
                if len(found.source) >= FEWEST:
                    estimate.pairs.append(pair)
    if len(estimate.pairs) > len(closed):
        estimate.resolve({})
        estimate.estimate({})
        estimate.lay_anew({number for pair in estimate.pairs for number in pair})
        estimate.estimate({})
        agreeing = [pair for pair in estimate.pairs if pair in closed or estimate.agrees(pair)]
        if len(agreeing) < len(estimate.pairs):
            estimate.pairs = agreeing
            estimate.estimate({})


def _hypotheses(estimate: PathEstimate, number: int) -> list[Hypothesis]:
    """Where a piece may lie on earlier ones, as the drift allows."""
    found = []
    for earlier in range(number - 2):
        pair = earlier, number
        if pair in estimate.pairs or (reach := _reach(estimate, pair)) is None:
            continue
        found += [each for each in _poses(estimate, pair, reach) if _likely(estimate, each)]
    return found


def _reach(estimate: PathEstimate, pair: Pair) -> np.ndarray | None:
    """How far (3,) the later piece may lie from where it is now; None where it reaches the earlier nowhere."""
    other, own = (estimate.moved(number).places_mm for number in pair)
    low, high = own.min(axis=0), own.max(axis=0)
    std = np.sqrt(np.diag(_relative_covariance(estimate, pair, (low + high) / 2)))
    reach = SIGMAS * (std[:3] + float(np.linalg.norm(high - low)) / 2 * std[3:].max())
    apart = np.maximum(low - reach - other.max(axis=0), other.min(axis=0) - high - reach)
    return None if (apart > 0).any() else reach


def _relative_covariance(estimate: PathEstimate, pair: Pair, at_mm: np.ndarray) -> np.ndarray:
    """Covariance (6, 6) of shift and turn of the later piece against the earlier, at a place (3,)."""
    times, twists = estimate.relative_movement(pair, at_mm)
    by = np.einsum("mc,mij->icj", estimate.path.basis(times), twists).reshape(6, -1)
    used = np.flatnonzero(by.any(axis=0))
    return by[:, used] @ estimate.covariance[np.ix_(used, used)] @ by[:, used].T


def _poses(estimate: PathEstimate, pair: Pair, reach: np.ndarray) -> list[Hypothesis]:
    """Poses in which the later piece lies well on the earlier, within reach (3,).

    Maps of the heights of both, with what lies beside them on the path, are correlated for all shifts.
    """
    earlier, number = pair
    other, own = estimate.moved(earlier), estimate.moved(number)
    normal = np.linalg.eigh(other.normals.T @ other.normals)[1][:, 2]
    first = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
    first /= np.linalg.norm(first)
    frame = np.stack([first, np.cross(normal, first), normal])
    beside = [range(max(0, k - 1), min(len(estimate.pieces), k + 2)) for k in (number, earlier)]
    clouds = [np.vstack([estimate.moved_points(k) for k in near]) @ frame.T for near in beside]
    found = []
    for shift in shifts_of_heights(*clouds, pixel_mm=0.5 * own.radius_mm, reach_mm=np.abs(frame) @ reach):
        pose = np.eye(4)
        pose[:3, 3] = shift @ frame
        refined = _refined(own, other, pose, bent_mm=_bent(estimate))
        if refined is not None:
            found.append(Hypothesis(pair, refined[1], refined[0]))
    return found


def _bent(estimate: PathEstimate) -> float:
    """By how much a piece is bent as long as the drift is unknown, mm: by its steady rate and by its random walk."""
    part = 1 / len(estimate.pieces)
    return estimate.path.drift[:3].max() * float(np.sqrt(part**2 + estimate.prior.kind.walk * part))


def _refined(own: Patches, other: Patches, pose: np.ndarray, *, bent_mm: float) -> tuple[int, np.ndarray] | None:
    """Number of patches that agree, and pose (4, 4), after a pair's own estimate from a pose."""
    joint = JointRegistration([other, own], [[], []], np.array([np.eye(4), pose]), start_std=None, sphere_mm=None)
    reach = 4 * own.radius_mm
    for _ in range(_REFINED):
        if not (pairs := joint.evidence(reach)):
            return None
        step = joint.solved(list(pairs.values())).step
        joint.move(step)
        reach = max(0.8 * reach, own.radius_mm)
    if not (pairs := joint.evidence(reach)) or len(joint.solved(list(pairs.values())).open_directions):
        return None
    found = distances_between(own, joint.poses[1], other, np.eye(4), reach_mm=reach)
    fits = np.abs(found.distance_mm) < np.maximum(5 * found.std_mm, bent_mm)
    if np.count_nonzero(fits) < FEWEST or np.mean(fits) < _LYING:
        return None
    return int(np.count_nonzero(fits)), joint.poses[1]


def _likely(estimate: PathEstimate, hypothesis: Hypothesis) -> bool:
    """Whether the navigation may have drifted by what a hypothesis says, given the crossings that are closed."""
    places = estimate.moved(hypothesis.pair[1]).places_mm
    middle = places.mean(axis=0)
    size = float(np.sqrt(np.mean(np.sum((places - middle) ** 2, axis=1))))
    covariance = _relative_covariance(estimate, hypothesis.pair, middle)
    # The pose is as good as two bent pieces tell, and a search within a patch's radius.
    bent = max(_bent(estimate), estimate.reach_mm / 2)
    covariance += bent**2 * np.diag(np.repeat([1.0, 1 / size**2], 3))
    rotation, shift = hypothesis.pose[:3, :3], hypothesis.pose[:3, 3]
    off = np.append(rotation @ middle + shift - middle, Rotation.from_matrix(rotation).as_rotvec())
    return float(off @ np.linalg.solve(covariance, off)) < _GATE


def _closed(estimate: PathEstimate, hypothesis: Hypothesis) -> bool:
    """Estimate the path with a hypothesis; whether it agrees then. Else the estimate stays as it was."""
    before = estimate.state()
    estimate.pairs.append(hypothesis.pair)
    estimate.resolve({hypothesis.pair: hypothesis.pose})
    estimate.estimate({hypothesis.pair: hypothesis.pose})
    estimate.lay_anew(hypothesis.pair)
    estimate.estimate({})
    if estimate.agrees(hypothesis.pair) and estimate.is_overdetermined(hypothesis.pair):
        return True
    estimate.restore(before)
    return False


def _has_rival(estimate: PathEstimate, best: Hypothesis, waiting: list[Hypothesis], before: tuple[Any, ...]) -> bool:
    """Whether another hypothesis contradicts the closed one, and holds as well from the estimate before."""
    middle = estimate.moved(best.pair[1]).places_mm.mean(axis=0)
    times, twists = estimate.relative_movement(best.pair, middle)
    closed = estimate.corrections(times)
    rivals = [
        each
        for each in waiting
        if _beside(each.pair, [best.pair]) and each.patches >= _RIVAL * best.patches and not _likely(estimate, each)
    ]
    for rival in rivals:
        estimate.restore(before)
        if _closed(estimate, rival):
            # A pose that was found badly may lead to the same place.
            apart = np.einsum("mij,mj->i", twists, estimate.corrections(times) - closed)
            if np.linalg.norm(apart[:3]) > estimate.reach_mm:
                return True
    return False


def _beside(pair: Pair, others: list[Pair]) -> bool:
    """Whether a pair belongs to the crossing of one of the others."""
    return any(max(abs(pair[0] - earlier), abs(pair[1] - later)) <= _AHEAD for earlier, later in others)
