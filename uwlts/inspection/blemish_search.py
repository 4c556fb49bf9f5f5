"""Search for pits and protrusions of all sizes on an unrolled surface, at a given probability of a false alarm.

Bells of all sizes are fitted everywhere (`uwlts.inspection.bell_maps`).

Divided by its local scatter, the depth on an undamaged surface is a random field of unit variance. The probability that
it exceeds a level anywhere is the expected Euler characteristic of the excursion set (Adler and Taylor, Random Fields
and Geometry, 2007; Worsley et al., Human Brain Mapping 4, 1996, Table I). The threshold follows from this probability.
Only indications that are significant for the tail of the noise remain.

An indication grows from its peak to all adjacent cells above a tenth of its height, however far: a gouge or an area of
corrosion is one indication. The shallow rest around it belongs to it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from scipy import ndimage, optimize, sparse, stats
from scipy.sparse import csgraph
from scipy.spatial import KDTree

from uwlts.errors import EvaluationError
from uwlts.fitting.least_squares import fit_biweight
from uwlts.inspection.bell_maps import (
    SEARCH_RULE,
    BellMap,
    Tail,
    UnrolledSurface,
    find_together,
    fit_bells,
    limit_deviations,
)
from uwlts.inspection.features import SEED


@dataclass(frozen=True, eq=False)
class Indication:
    """Significant departure of a surface from its shape."""

    radius_mm: float  # radius of the bell
    height_mm: float  # signed height
    z: float  # height in standard deviations
    false_alarm: float  # probability that noise exceeds ``z`` anywhere
    noise_mm: float
    """Standard deviation of independent point noise that explains the scatter of local means of the heights."""
    points: np.ndarray  # (K,) int; points of the indication


@dataclass(frozen=True, eq=False)
class UnresolvedDeparture:
    """Significant departure without a region: the nearest point, its signed height, least height, and the reason."""

    point: int
    height_mm: float
    bound_mm: float
    reason: str


@dataclass(frozen=True, eq=False)
class BlemishSearch:
    """Result of a search on N points."""

    indications: tuple[Indication, ...]
    unresolved: tuple[UnresolvedDeparture, ...]
    outliers: np.ndarray  # (N,) bool
    undamaged: np.ndarray  # (N,) bool; points that are neither outliers nor in an indication
    level_mm: np.ndarray  # (N,); least significant height of an indication of the smallest size
    smallest_mm: float  # smallest radius of the search
    gap_mm: float  # distance from all points, from which a place is not seen
    threshold: float  # least significant z
    false_alarm: float  # probability of any false indication


def search_blemishes(surface: UnrolledSurface, *, false_alarm: float, largest_mm: float = np.inf) -> BlemishSearch:
    """Find significant departures of a surface from its shape.

    The most significant indications are taken first. Their points are removed before the next round, until no
    indication is left.

    ``false_alarm`` is the probability of any indication, inwards or outwards, on an undamaged surface.

    Raises EvaluationError if the surface has too few points.
    """
    places, tree = surface.places, KDTree(surface.places)
    if len(places) < 20 * SEARCH_RULE.points_in_smallest:
        raise EvaluationError(
            f"{len(places)} points are too few to search for blemishes; "
            f"{20 * SEARCH_RULE.points_in_smallest} are needed"
        )
    some = places[:: max(1, len(places) // 2000)]
    smallest = float(np.median(tree.query(some, k=SEARCH_RULE.points_in_smallest)[0][:, -1]))
    anywhere = some + smallest * np.random.default_rng(SEED).uniform(-1, 1, some.shape)
    gap = min(smallest, SEARCH_RULE.gap * float(np.quantile(tree.query(anywhere)[0], 0.9)))
    seen, together = surface, smallest
    surface, outliers, wider = limit_deviations(seen, tree, together_mm=together, false_alarm=false_alarm)
    extent = surface.corners[1] - surface.corners[0]
    largest = min(SEARCH_RULE.largest_size * float(np.min(extent)), largest_mm)
    largest = max(largest, smallest)
    # The smallest size is larger if its map would not fit into memory.
    smallest = max(smallest, SEARCH_RULE.cells_per_radius * float(np.sqrt(np.prod(extent) / SEARCH_RULE.most_cells)))
    radii = smallest * SEARCH_RULE.size_ratio ** np.arange(
        1 + max(0, int(np.log(largest / smallest) / np.log(SEARCH_RULE.size_ratio)))
    )
    undamaged = ~outliers
    found: list[_Candidate] = []
    maps: list[BellMap] = []
    threshold = np.inf
    for number in range(SEARCH_RULE.rounds + 1):
        maps = [fit_bells(surface, undamaged, radius) for radius in radii]
        maps = [each for each in maps if each.area_mm2 > 0]
        if not maps:
            break
        # Noise exceeds it with the given probability; the sum over sizes is an upper bound.
        threshold: Any = optimize.brentq(lambda z, maps=maps: sum(m.false_alarms(z) for m in maps) - false_alarm, 1, 40)
        peaks = _choose_peaks(maps, threshold)
        if not peaks:
            break
        for peak in peaks:
            core = np.array(tree.query_ball_point(peak.place, SEARCH_RULE.core * peak.radius), int)
            if np.count_nonzero(undamaged[core]) < 0.5 * np.count_nonzero(~outliers[core]):
                continue
            try:
                if number == SEARCH_RULE.rounds:
                    raise EvaluationError(f"{SEARCH_RULE.rounds} rounds of the search found it again each time")
                outcome, points = _delimit(surface, undamaged, outliers, tree, maps, peak, smallest)
            except EvaluationError as error:
                points = core[undamaged[core]]
                level = np.sign(peak.height) * float(np.median(surface.heights[points]))
                bound = max(0.0, level - SEARCH_RULE.edge_std * float(maps[0].noise_at(peak.place[None])[0]))
                outcome = UnresolvedDeparture(int(tree.query(peak.place)[1]), peak.height, bound, str(error))
            found.append(_Candidate(peak, outcome, points))
            undamaged[points] = False
    level = np.full(len(places), np.nan)
    if maps:
        tail, found = _confirm(surface, undamaged, maps[0], threshold, found)
        level = tail.scatter_at(threshold) * maps[0].level_at(places)
    small = _assign_outliers(seen, outliers, found, together, false_alarm)
    kept: list[Indication] = []
    for peak, outcome, points in found:
        if isinstance(outcome, float):
            chance = min(1.0, sum(each.false_alarms(peak.z) for each in maps))
            kept.append(Indication(peak.radius, peak.height, peak.z, chance, wider * outcome, points))
    departures = [each.outcome for each in found if isinstance(each.outcome, UnresolvedDeparture)]
    known = tuple(kept), (*departures, *small), outliers, undamaged, level
    return BlemishSearch(*known, smallest, gap, threshold, false_alarm)


class _Candidate(NamedTuple):
    """Significant peak, and the points (K,) removed with it."""

    peak: _Peak
    outcome: float | UnresolvedDeparture | None  # noise of an indication, mm; None for the rest of another one
    points: np.ndarray


def _confirm(
    surface: UnrolledSurface, undamaged: np.ndarray, smallest: BellMap, threshold: float, found: list[_Candidate]
) -> tuple[Tail, list[_Candidate]]:
    """Return the tail of the noise and the candidates that are significant for it.

    Other candidates are noise: their points become undamaged again, and the tail is determined with them.
    """
    while True:
        tail = Tail.of_map(smallest)
        kept = []
        for peak, outcome, points in found:
            z = min(peak.z, tail.normalise(peak.strength))
            if z > threshold:
                kept.append(_Candidate(replace(peak, z=z), outcome, points))
            else:
                undamaged[points] = True
        if len(kept) == len(found):
            return tail, kept
        found = kept
        smallest = fit_bells(surface, undamaged, smallest.radius)


def _assign_outliers(
    surface: UnrolledSurface, outliers: np.ndarray, found: list[_Candidate], radius: float, false_alarm: float
) -> list[UnresolvedDeparture]:
    """Give outliers to the indications around them, and return groups of others as departures.

    The outliers of an indication have its direction, and are more than their share elsewhere explains.
    """
    heights, left = surface.heights, outliers.copy()
    for number, (peak, outcome, points) in enumerate(found):
        loose = np.flatnonzero(outliers & (heights * peak.height > 0))
        if not len(loose) or not len(points):
            continue
        is_near = KDTree(surface.places[points]).query(surface.places[loose])[0] <= radius
        near, share = loose[is_near], np.count_nonzero(~is_near) / (len(outliers) - len(points))
        left[near] = False
        is_rare = stats.binom.sf(len(near) - 1, len(points) + len(near), share) * len(found) < false_alarm
        if is_rare and isinstance(outcome, float):
            outliers[near] = False
            found[number] = _Candidate(peak, outcome, np.concatenate([points, near]))
    departures = []
    for sign in (-1, 1):
        together = find_together(surface.places, left & (sign * heights > 0), radius, false_alarm)
        if not len(together):
            continue
        pairs: Any = KDTree(surface.places[together]).query_pairs(radius, output_type="ndarray")
        shape = len(together), len(together)
        joined = sparse.coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=shape)
        count, group = csgraph.connected_components(joined, directed=False)
        for points in (together[group == k] for k in range(count)):
            # A group is bounded by the least of its points.
            loose, top = np.abs(heights[points]), int(points[np.argmax(np.abs(heights[points]))])
            reason = f"{len(points)} points show it; {SEARCH_RULE.points_in_smallest} are needed"
            departures.append(UnresolvedDeparture(top, float(heights[top]), float(loose.min()), reason))
    return departures


@dataclass(frozen=True, eq=False)
class _Peak:
    """Peak of a map: place (2,), radius, height, z, and height divided by the noise of independent points."""

    place: np.ndarray
    radius: float
    height: float
    z: float
    strength: float


def _choose_peaks(maps: Sequence[BellMap], threshold: float) -> list[_Peak]:
    """Return the strongest significant peaks that do not touch each other.

    A peak is also taken if it covers a significant peak of a smaller size: large blemishes increase the scatter in the
    maps of their own size. Strength therefore refers to the scatter at the smallest size.
    """
    peaks = []
    for each in maps:
        size = np.nan_to_num(np.abs(each.height) * np.sqrt(np.maximum(each.information, 0)))
        top = (size == ndimage.maximum_filter(size, 2 * SEARCH_RULE.cells_per_radius + 1)) & (size > 0)
        cells = np.argwhere(top)
        places = each.origin + (cells + 0.5) * each.cell
        noise, tops = maps[0].noise_at(places), size[top]
        for k in np.flatnonzero(tops > 0.5 * threshold * noise):
            i, j = cells[k]
            height, z = float(each.height[i, j]), float(np.nan_to_num(np.abs(each.z[i, j])))
            peaks.append(_Peak(places[k], each.radius, height, z, float(tops[k] / noise[k])))
    significant = [peak for peak in peaks if peak.z > threshold]
    if not significant:
        return []
    tree = KDTree([peak.place for peak in significant])
    kept: list[_Peak] = []
    passed: list[_Peak] = []
    for peak in sorted(peaks, key=lambda peak: peak.strength, reverse=True):
        z = peak.z
        if z <= threshold:
            covered = [significant[k] for k in tree.query_ball_point(peak.place, peak.radius)]
            z = max((other.z for other in covered if other.height * peak.height > 0), default=0.0)
        if z <= threshold:
            continue
        if all(np.hypot(*(peak.place - other.place)) > 1.5 * (peak.radius + other.radius) for other in passed):
            kept.append(_Peak(peak.place, peak.radius, peak.height, z, peak.strength))
        passed.append(peak)
    return kept


def _delimit(
    surface: UnrolledSurface,
    undamaged: np.ndarray,
    outliers: np.ndarray,
    tree: KDTree,
    maps: Sequence[BellMap],
    peak: _Peak,
    smallest: float,
) -> tuple[float | None, np.ndarray]:
    """Return the noise at a peak, and the points of its region: adjacent cells that depart in the same direction.

    Without a noise, the region is the rest of another one. EvaluationError if the region or its surroundings have too
    few points.
    """
    noise, reach, step = float(maps[0].noise_at(peak.place[None])[0]), 3.0 * peak.radius, max(smallest, peak.radius / 4)
    first: tuple[np.ndarray, _Region] | None = None
    while True:
        near = np.array(tree.query_ball_point(peak.place, reach), int)
        taken, near = near[~undamaged[near] & ~outliers[near]], near[undamaged[near]]
        places, heights = surface.places[near] - peak.place, surface.heights[near]
        grown = _grow_region(places, heights, surface.places[taken] - peak.place, peak, noise, reach, step)
        first = first or (None if grown.cut else (near, grown))
        if not (grown.cut or (grown.is_within and peak.radius == maps[-1].radius)):
            break
        if len(near) == np.count_nonzero(undamaged):
            near, grown = first or (near, grown)
            break
        reach *= SEARCH_RULE.enlargement
    points = near[grown.inside]
    if grown.is_rest:
        return None, points
    if len(points) < SEARCH_RULE.fewest_points:
        raise EvaluationError(f"it has {len(points)} points; {SEARCH_RULE.fewest_points} are needed")
    return noise, points


class _Region(NamedTuple):
    """Region of a peak in a window of n points."""

    inside: np.ndarray  # (n,) bool; points of the region
    cut: bool  # whether the window's edge cuts it
    is_rest: bool  # whether it is the rest of another one
    is_within: bool  # whether its surroundings depart by more than its edge: a blemish of the largest size is larger


def _grow_region(
    places: np.ndarray, heights: np.ndarray, taken: np.ndarray, peak: _Peak, noise: float, reach: float, step: float
) -> _Region:
    """Return the region of a peak at the origin.

    It is the rest of an indication with points ``taken`` (m, 2) if it touches them, and is not clearly higher
    elsewhere.
    """
    dist = np.hypot(*places.T)
    ring = dist > 0.5 * reach
    if np.count_nonzero(ring) < 2 * SEARCH_RULE.fewest_points:
        raise EvaluationError(
            f"{np.count_nonzero(ring)} undamaged points surround it; {2 * SEARCH_RULE.fewest_points} are needed"
        )
    base = np.column_stack([np.ones(len(places)), places])
    plane = fit_biweight(base, heights, ring)[0] @ heights
    left = heights - base @ plane
    side = int(np.ceil(2 * reach / step)) + 1
    cells, other = (np.floor((each + reach) / step).astype(int) for each in (places, taken))
    flat = cells[:, 0] * side + cells[:, 1]
    # Sums over three by three cells.
    count = 9 * ndimage.uniform_filter(np.bincount(flat, minlength=side**2).reshape(side, side) * 1.0, 3)
    total = 9 * ndimage.uniform_filter(np.bincount(flat, left, side**2).reshape(side, side), 3)
    filled = count > 0.5
    mean: Any = np.where(filled, np.sign(peak.height) * total / np.maximum(count, 0.5), -np.inf)
    middle = int(reach / step)
    core = mean[middle - 1 : middle + 2, middle - 1 : middle + 2]
    level = np.maximum(
        SEARCH_RULE.edge_share * float(core.max()), SEARCH_RULE.edge_std * noise / np.sqrt(np.maximum(count, 1))
    )
    labelled: Any = ndimage.label(mean > level)
    near = labelled[0][middle - 1 : middle + 2, middle - 1 : middle + 2]
    region = np.isin(labelled[0], near[near > 0])
    wide: Any = ndimage.binary_dilation(region)
    cut = bool(region[[0, 1, -2, -1], :].any() or region[:, [0, 1, -2, -1]].any())
    beside: Any = np.zeros((side, side), bool)
    beside[other[:, 0], other[:, 1]] = True
    beside = ndimage.binary_dilation(beside, np.ones((3, 3)))
    touches = bool(beside[wide].any() or beside[middle, middle])
    top = float(np.max(mean, where=region, initial=0.0))
    saddle = float(np.max(mean, where=region & beside, initial=0.0))
    is_rest = touches and saddle >= SEARCH_RULE.saddle * top
    is_within = np.sign(peak.height) * plane[0] > SEARCH_RULE.edge_share * top
    return _Region(wide[cells[:, 0], cells[:, 1]] | (dist < SEARCH_RULE.core * peak.radius), cut, is_rest, is_within)
