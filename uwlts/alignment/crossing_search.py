"""Search for the crossings of a path: hypotheses, their scores, and the acceptance of consistent ones.

A hypothesis is a pose in which a piece of the path coincides with an earlier one. It is found by correlation of height
maps. Two tests follow: the chi-square of its shift and rotation under the possible drift, given all accepted crossings,
and an estimate of the path with it. Among neighbouring pieces, the hypothesis with the most agreeing patches is tested
first. It is rejected as ambiguous if another position fits nearly as well.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.fft import irfft2, rfft2
from scipy.fft import next_fast_len
from scipy.ndimage import gaussian_filter, maximum_filter
from scipy.spatial.transform import Rotation

from uwlts.alignment.path_solution import (
    Hypothesis,
    Pair,
    PathEstimate,
    bring_together,
    refine_nodes,
    refit,
    select_drift,
    solve,
    with_drift,
)
from uwlts.alignment.pieces import AlignmentOptions
from uwlts.fitting.least_squares import rms_distance
from uwlts.model.calibration import rigid_transform
from uwlts.registration.joint_registration import fit_pair
from uwlts.runtime.progress import ProgressListener, ignore_progress
from uwlts.shapes.flat import perpendicular_to


@dataclass(frozen=True)
class Search:
    """Estimate with its crossings, ambiguous pairs, and numbers of tested pairs and hypotheses."""

    estimate: PathEstimate
    doubtful: tuple[Pair, ...]
    within_reach: int
    hypotheses: int


def accept_crossings(estimate: PathEstimate, progress: ProgressListener = ignore_progress) -> Search:
    """Find and accept the crossings of a path, in chronological order."""
    waiting: list[Hypothesis] = []
    doubtful: list[Pair] = []
    count, ahead = len(estimate.pieces), estimate.options.decided_after
    within_reach = hypotheses = 0
    for number in range(count):
        for pair in ((earlier, number) for earlier in range(number - 2)):
            if pair in estimate.pairs or (reach := _search_range(estimate, pair)) is None:
                continue
            found = _find_hypotheses(estimate, pair, reach)
            within_reach, hypotheses = within_reach + 1, hypotheses + len(found)
            waiting += [] if _is_beside(pair, doubtful, ahead) else found
        while waiting and (number - min(each.pair[1] for each in waiting) >= ahead or number == count - 1):
            best = max(waiting, key=lambda each: each.patches)
            waiting.remove(best)
            closed = accept_hypothesis(estimate, best)
            if closed is None:
                continue
            closed = _select_walk(closed)
            if _has_rival(
                estimate, closed, best, [each for each in waiting if _is_beside(each.pair, [best.pair], ahead)]
            ):
                doubtful.append(best.pair)
                waiting = [each for each in waiting if not _is_beside(each.pair, doubtful, ahead)]
                continue
            estimate = _select_walk(add_overlaps(closed, number + 1))
            waiting = [each for each in waiting if each.pair not in estimate.pairs and _is_likely(estimate, each)]
        progress(number + 1, count)
    estimate = add_overlaps(estimate, count)
    left_out = tuple(pair for pair in doubtful if pair not in estimate.pairs)
    return Search(estimate, left_out, within_reach, hypotheses)


def _is_beside(pair: Pair, others: list[Pair], within: int) -> bool:
    """Check whether both pieces of a pair are within a number of pieces of those of another."""
    return any(max(abs(pair[0] - first), abs(pair[1] - second)) <= within for first, second in others)


def accept_hypothesis(estimate: PathEstimate, hypothesis: Hypothesis) -> PathEstimate | None:
    """Estimate the path with a hypothesis; return None if the surfaces then disagree."""
    closed = solve(refine_nodes(solve(bring_together(estimate, hypothesis))))
    closed = solve(refit(closed, hypothesis.pair))
    return closed if closed.agrees(hypothesis.pair) else None


def add_overlaps(estimate: PathEstimate, count: int) -> PathEstimate:
    """Add all pairs of the first pieces that overlap along the current path and whose surfaces agree."""
    closed = estimate.pairs
    places = [estimate.surface(number).places_mm for number in range(count)]
    low, high = (np.array([of(each, axis=0) for each in places]) for of in (np.min, np.max))
    new = []
    for later in range(count):
        near = np.all((low[later] < high + estimate.reach_mm) & (low < high[later] + estimate.reach_mm), axis=1)
        for earlier in np.flatnonzero(near[: max(later - 2, 0)]).tolist():
            pair = earlier, later
            reach = None if pair in closed else _search_range(estimate, pair)
            if reach is not None and reach.max() < estimate.reach_mm:
                found, _ = estimate.measure_distances(pair)
                new += [pair] if len(found.source) >= estimate.options.fewest_patches else []
    if not new:
        return estimate
    estimate = solve(refine_nodes(replace(estimate, pairs=(*closed, *new))))
    estimate = solve(refit(estimate, {number for pair in estimate.pairs for number in pair}))
    agreeing = tuple(pair for pair in estimate.pairs if pair in closed or estimate.agrees(pair))
    return estimate if len(agreeing) == len(estimate.pairs) else solve(replace(estimate, pairs=agreeing))


def _select_walk(estimate: PathEstimate) -> PathEstimate:
    """Select the most likely random walk; few nodes follow a small one."""
    selected = select_drift(estimate, walk_only=True)
    return estimate if selected is estimate else solve(selected)


def _search_range(estimate: PathEstimate, pair: Pair) -> np.ndarray | None:
    """Return the search range (3,) of the later piece; None if it cannot reach the earlier one."""
    other, surface = (estimate.surface(number).places_mm for number in pair)
    low, high = surface.min(axis=0), surface.max(axis=0)
    std = np.sqrt(np.diag(estimate.relative_covariance(pair, (low + high) / 2)))
    turned = float(np.linalg.norm(high - low)) / 2 * std[3:].max()
    reach = estimate.options.search_sigmas * (std[:3] + turned)
    separation = np.maximum(low - reach - other.max(axis=0), other.min(axis=0) - high - reach)
    return None if (separation > 0).any() else reach


def _find_hypotheses(estimate: PathEstimate, pair: Pair, reach: np.ndarray) -> list[Hypothesis]:
    """Find poses that make the later piece coincide with the earlier one, within the search range (3,).

    The height maps of both, including their neighbours on the path, are correlated for all shifts.
    """
    other, surface = (estimate.surface(number) for number in pair)
    normal = np.linalg.eigh(other.normals.T @ other.normals)[1][:, 2]
    frame = np.stack([*perpendicular_to(normal), normal])
    near = [range(max(0, k - 1), min(len(estimate.pieces), k + 2)) for k in pair[::-1]]
    clouds = [np.vstack([estimate.points(k) for k in numbers]) @ frame.T for numbers in near]
    options, drift, part = estimate.options, estimate.prior.drift, 1 / len(estimate.pieces)
    # Deformation of a piece by the unknown drift, through its constant rate and its random walk.
    bent = float(np.max(drift.std[:3] * np.sqrt(part**2 + drift.walk[:3] * part)))
    middle = surface.places_mm.mean(axis=0)
    # The accuracy of a pose is limited by the deformation of both pieces and by the patch radius.
    std = max(bent, surface.radius_mm) * np.repeat([1.0, 1 / rms_distance(surface.places_mm, middle)], 3)
    found = []
    for shift in correlate_heights(
        clouds[0], clouds[1], options, pixel_mm=options.pixel * surface.radius_mm, reach_mm=np.abs(frame) @ reach
    ):
        if (refined := fit_pair(surface, other, rigid_transform(np.eye(3), shift @ frame))) is None:
            continue
        pose, separation = refined
        fits = np.abs(separation.distance_mm) < np.maximum(options.agreeing_sigmas * separation.std_mm, bent)
        if np.count_nonzero(fits) >= options.fewest_patches and np.mean(fits) >= options.least_lying:
            turn = Rotation.from_matrix(pose[:3, :3])
            moved = np.append(turn.apply(middle) + pose[:3, 3] - middle, turn.as_rotvec())
            relative = moved + estimate.relative_movement(pair, middle) @ estimate.values
            found.append(Hypothesis(pair, middle, relative, std, int(np.count_nonzero(fits))))
    return [each for each in found if _is_likely(estimate, each)]


def _is_likely(estimate: PathEstimate, seen: Hypothesis) -> bool:
    """Check whether a hypothesis is consistent with the drift, given the accepted crossings."""
    off = seen.relative - estimate.relative_movement(seen.pair, seen.at_mm) @ estimate.values
    covariance = estimate.relative_covariance(seen.pair, seen.at_mm) + np.diag(seen.std**2)
    return float(off @ np.linalg.solve(covariance, off)) < estimate.options.gate


def _has_rival(before: PathEstimate, closed: PathEstimate, best: Hypothesis, beside: list[Hypothesis]) -> bool:
    """Check whether another hypothesis contradicts the accepted one and fits the previous estimate as well.

    Both have the drift that was selected with the accepted one.
    """
    before = with_drift(before, closed.prior.drift)
    for rival in beside:
        if rival.patches < before.options.rival_share * best.patches or _is_likely(closed, rival):
            continue
        other = accept_hypothesis(before, rival)
        if other is not None:
            # An inaccurate rival pose may converge to the same position.
            difference = (each.relative_movement(best.pair, best.at_mm) @ each.values for each in (other, closed))
            if np.linalg.norm(np.subtract(*difference)[:3]) > before.reach_mm:
                return True
    return False


def correlate_heights(
    source_mm: np.ndarray, target_mm: np.ndarray, options: AlignmentOptions, *, pixel_mm: float, reach_mm: np.ndarray
) -> list[np.ndarray]:
    """Return the most likely shifts (3,) of points (N, 3) onto others (M, 3) with heights along z, the best first.

    Shifts are within ``reach_mm`` (3,). The correlation is normalised in the overlap (Padfield, IEEE Transactions on
    Image Processing 21, 2012) and weighted by the square root of its area.
    """
    low = np.minimum(source_mm[:, :2].min(axis=0), target_mm[:, :2].min(axis=0))
    maps = [_make_height_map(points, low, pixel_mm) for points in (source_mm, target_mm)]
    sizes: list[Any] = [
        next_fast_len(a + b - 1, real=True) for a, b in zip(maps[0][0].shape, maps[1][0].shape, strict=True)
    ]
    details = [_extract_detail(*each, options) for each in maps]
    masks = [mask for _, mask in maps]
    of_mask, of_height, of_detail, of_square = (
        [rfft2(values * mask, sizes) for values, mask in zip(each, masks, strict=True)]
        for each in (masks, [height for height, _ in maps], details, [detail**2 for detail in details])
    )

    def correlated(target: np.ndarray, source: np.ndarray) -> np.ndarray:
        return irfft2(target * np.conj(source), sizes)

    count = np.maximum(np.rint(correlated(of_mask[1], of_mask[0])), 1e-9)
    of_target, of_source = correlated(of_detail[1], of_mask[0]), correlated(of_mask[1], of_detail[0])
    both = correlated(of_detail[1], of_detail[0]) - of_target * of_source / count
    spread = correlated(of_square[1], of_mask[0]) - of_target**2 / count
    spread *= correlated(of_mask[1], of_square[0]) - of_source**2 / count
    # Area of the fewest patches in pixels, with one patch in each square of one radius.
    enough = count > options.fewest_patches / options.pixel**2
    usual = max(float(np.median(spread[enough])), 0.0) if enough.any() else 0.0
    with np.errstate(invalid="ignore", divide="ignore"):
        similarity = np.where(enough & (spread > options.least_spread * usual), both / np.sqrt(spread), 0.0)
    score = np.where(similarity > options.least_correlation, similarity * np.sqrt(count), -np.inf)
    # The largest shift is that of the target's last row onto the source's first one; later rows are negative shifts.
    steps = [
        np.where(np.arange(n) < rows, np.arange(n), np.arange(n) - n)
        for n, rows in zip(sizes, maps[1][0].shape, strict=True)
    ]
    outside = [np.abs(each * pixel_mm) > reach + pixel_mm for each, reach in zip(steps, reach_mm[:2], strict=True)]
    score[outside[0][:, None] | outside[1]] = -np.inf
    # The width of a peak is that of the compared structures.
    spacing = 1 + 2 * int(options.coarsest_px / 4)
    peaks = np.argwhere((score == maximum_filter(score, spacing, mode="wrap")) & np.isfinite(score))
    order = np.argsort(-score[tuple(peaks.T)])[: options.proposals]
    along = (correlated(of_height[1], of_mask[0]) - correlated(of_mask[1], of_height[0])) / count
    found = [np.array([steps[0][i] * pixel_mm, steps[1][j] * pixel_mm, along[i, j]]) for i, j in peaks[order]]
    return [shift for shift in found if abs(shift[2]) <= reach_mm[2] + pixel_mm]


def _make_height_map(points: np.ndarray, low: np.ndarray, pixel: float) -> tuple[np.ndarray, np.ndarray]:
    """Return mean heights (H, W), and a mask (H, W) of pixels with points."""
    cells = np.floor((points[:, :2] - low) / pixel).astype(np.int64)
    shape = tuple(cells.max(axis=0) + 1)
    flat = np.ravel_multi_index(tuple(cells.T), shape)
    count = np.bincount(flat, minlength=shape[0] * shape[1]).reshape(shape)
    total = np.bincount(flat, points[:, 2], shape[0] * shape[1]).reshape(shape)
    return total / np.maximum(count, 1), (count > 0).astype(float)


def _extract_detail(height: np.ndarray, mask: np.ndarray, options: AlignmentOptions) -> np.ndarray:
    """Return the structures (H, W) of the compared sizes (difference of Gaussians)."""
    smooth, coarse = (
        gaussian_filter(height * mask, size) / np.maximum(gaussian_filter(mask, size), 1e-3)
        for size in (options.finest_px, options.coarsest_px)
    )
    return smooth - coarse
