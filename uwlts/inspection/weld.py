"""Inspection of a weld bead between two plates, by the quantities of ISO 5817.

Heights are over the line between both plates. In each section across the weld they are local quadratics over the width;
what these and the footprint of each point smooth is put back (twicing, as of blemishes). All are sums over the points,
so that the points' errors run through to every value: by each pattern that all points share, and by noise drawn anew
(GUM Supplement 1, JCGM 101:2008).
"""

from __future__ import annotations

import os
from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage, sparse

from uwlts.errors import EvaluationError
from uwlts.evaluation.figures import TOWARDS_SENSOR
from uwlts.fitting.least_squares import (
    MAD_TO_STD,
    evenly_thinned,
    fit_biweight,
    fit_robustly,
    principal_axes,
    robust_std,
)
from uwlts.fitting.point_spacing import footprint_on
from uwlts.fitting.propagation import PointErrors
from uwlts.fitting.shapes import fit_plane
from uwlts.inspection.features import (
    COVERAGE_FACTOR,
    DEFINITIONS,
    Feature,
    FeatureKind,
    FeatureValue,
    Inspection,
    plain_value,
)
from uwlts.inspection.noisy_extremes import Largest, largest_mean
from uwlts.storage.cloud import PointCloud
from uwlts.storage.cloud_files import loaded_cloud

_FEWEST = 500
_TO_START = 20_000
_DRAWS = 32
"""The standard deviation of so many is right to 13 %."""
_TOGETHER_HIGH = 3
"""Neighbouring sections of which the largest height is the mean: that of a single one would be the noise's."""
_TOGETHER_DEEP = 5
"""Neighbouring sections of which the largest undercut is the mean."""
_MOST_SECTIONS = 100
_POINTS_IN_SECTION = 80
_BANDWIDTH_SHARE = 0.04
"""Of the bead's width, half the window of a local quadratic: narrower than an undercut."""
_POINTS_IN_BANDWIDTH = 3.0
"""Spacings of points in half a window, at least."""
_FLANK = 0.1, 0.5
"""Of the bead's height: the points of a flank whose line gives toe and toe angle."""
_HALF_FROM_CROWN = 1.9
"""Half of a bead's width in half of its width at half the height: 1.85 of a bell (1 - t^2)^2, 1.4 of a parabola."""
_CLEAR = 1.3
"""Of half the width: beyond it the plates are fitted, clear of undercuts of a good part of the bead's width."""
_FEWEST_BESIDE = 50
_BEYOND_SHARE = 0.35
"""Of the bead's width: how far beyond its toe an undercut is looked for."""
_INSIDE_SHARE = 0.05
"""Of the bead's width: how far within the toe, where the groove begins."""
_PLATE_SHARE = 2.0
"""Of the bead's width: how far beside the bead the plates are fitted."""
_WHOLE_SHARE = 0.7
"""Of the usual height: lower sections are the bead's ends."""
_SIGNIFICANT = 4.0
"""Standard deviations of the plates' points that a bead must stand out."""
_APART = 0.1
"""Of the width over all beads side by side: how far apart these are at half their height, at least."""
_NOTHING = 1e-9


def inspect_weld(cloud: PointCloud | str | os.PathLike[str], *, section_mm: float | None = None) -> Inspection:
    """Measure the highest weld bead of a cloud: height, width, undercut, toe angles and misalignment.

    The plates on both sides are fitted robustly; the bead runs along the longest extent of what stands out of them.
    Toes are where the lines through the flanks, from 10 to 50 % of the height, meet the plates.

    Parameters
    ----------
    cloud
        As for `inspect_pipe`.
    section_mm
        Length of a section along the weld; as short as its points allow unless given.

    Raises
    ------
    CaptureError
        The file cannot be read.
    EvaluationError
        No bead stands out, or the length is not positive.
    """
    cloud = loaded_cloud(cloud)
    if section_mm is not None and not 0 < section_mm < np.inf:
        raise EvaluationError(f"section_mm is {section_mm:g}; expected a positive length in mm")
    if len(cloud) < _FEWEST:
        raise EvaluationError(f"the cloud has {len(cloud)} points; at least {_FEWEST} are needed for a weld")
    bead, notes = _bead_of(cloud, section_mm)
    errors = PointErrors.along(cloud, bead.chosen, np.broadcast_to(bead.axes[2], (len(bead.chosen), 3)))
    values, extent, left_out = _values(bead, errors)
    feature = Feature(FeatureKind.WELD, "weld", values, bead.middle_mm, bead.axes, extent, bead.chosen[bead.on_bead])
    deviation = np.full(len(cloud), np.nan)
    deviation[bead.chosen] = bead.heights_mm
    count = bead.profiles.sections
    notes = [
        f"{count} sections of {bead.length_mm / count:.2g} mm; left is where the second axis points away from",
        *notes,
        *left_out,
    ]
    if cloud.uncertainty is None:
        notes.append("the cloud states no uncertainty: intervals are of the scatter of its points alone")
    return Inspection("weld", (feature,), deviation, np.full(len(cloud), np.nan), tuple(notes))


@dataclass(frozen=True, eq=False)
class _Profiles:
    """Heights over the plates on a grid across each section, as sums over the points.

    ``smooth`` (S G, n) are local quadratics of the points, ``plates`` two pairs: what a plate's level, slope along and
    slope across (3,) add to the reference at each point (n, 3), and their own sums over the points (3, n). ``seen``
    (n, S G) is what points of their footprint see of profiles, ``sharp`` (n, S G) what points without one would.
    """

    across_mm: np.ndarray
    sections: int
    smooth: sparse.csr_array
    plates: tuple[tuple[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]
    seen: sparse.csr_array
    sharp: sparse.csr_array

    def levelled(self, heights: np.ndarray) -> np.ndarray:
        """Heights (n,) of the points over the plates."""
        return heights - sum(base @ (rows @ heights) for base, rows in self.plates)

    def of(self, heights: np.ndarray, *, steps: int = 1, share: float = 1.0) -> np.ndarray:
        """Profiles (S, G) for heights (n,) of the points.

        What smoothing hides is put back in so many ``steps``, with a ``share`` of what the footprint makes of that.
        """
        left = self.levelled(heights)
        profiles = self.smooth @ left
        known = np.isfinite(profiles)
        # Beside lost lines nothing can be put back.
        whole = abs(self.seen) @ ~known < _NOTHING
        for _ in range(steps):
            filled = np.where(known, profiles, 0.0)
            there = share * (self.seen @ filled) + (1 - share) * (self.sharp @ filled)
            profiles = profiles + self.smooth @ np.where(whole, left - there, 0.0)
        return profiles.reshape(self.sections, len(self.across_mm))


@dataclass(frozen=True, eq=False)
class _Bead:
    """A bead and its plates.

    ``axes`` (3, 3) are along, across and outwards, ``chosen`` (n,) the points on and beside the bead, ``raw_mm`` (n,)
    their heights over the middle, ``heights_mm`` (n,) those over the plates, ``half_mm`` about half of its width and
    ``noise_mm`` (n,) the standard deviation of points that gives local means their scatter; ``footprint_std`` is the
    relative standard uncertainty of the points' squared footprint.
    """

    axes: np.ndarray
    middle_mm: np.ndarray
    chosen: np.ndarray
    raw_mm: np.ndarray
    heights_mm: np.ndarray
    on_bead: np.ndarray
    half_mm: float
    length_mm: float
    noise_mm: np.ndarray
    profiles: _Profiles
    footprint_std: float


def _bead_of(cloud: PointCloud, section_mm: float | None) -> tuple[_Bead, list[str]]:
    """The bead, and a note on others that are not measured."""
    axes, middle, half, ends, others = _found(cloud.points_mm)
    notes = [f"{others} more of what stands out beside the bead is not measured: cut the cloud to it"] * (others > 0)
    local = (cloud.points_mm - middle) @ axes.T
    reach = half * (1 + 2 * _PLATE_SHARE)
    chosen = np.flatnonzero((np.abs(local[:, 1]) < reach) & (local[:, 0] >= ends[0]) & (local[:, 0] <= ends[1]))
    along, across, raw = local[chosen].T
    sides = [across < -_CLEAR * half, across > _CLEAR * half]
    if min(map(np.count_nonzero, sides)) < _FEWEST_BESIDE:
        raise EvaluationError("the plate was not seen on both sides of the bead")
    design = np.column_stack([np.ones(len(along)), along, across])
    rows = [fit_biweight(design, raw, side)[0] for side in sides]
    # Between the toes the reference runs from one plate to the other.
    share = np.clip((across + half) / (2 * half), 0, 1)
    heights = raw - (1 - share) * (design @ (rows[0] @ raw)) - share * (design @ (rows[1] @ raw))
    length, images = float(np.ptp(along)), len(np.unique(cloud.frame[chosen]))
    count = max(1, len(along) // _POINTS_IN_SECTION)
    # Several sections to an image would hold its points by chance.
    count = min(count, _MOST_SECTIONS, images if images > 1 else count)
    if section_mm is not None:
        count = max(1, int(length / section_mm))
    section = np.clip(((along - along.min()) / length * count).astype(int), 0, count - 1)
    spacing = 2 * reach * count / len(along)
    bandwidth = max(_BANDWIDTH_SHARE * 2 * half, _POINTS_IN_BANDWIDTH * spacing)
    edge = half * (1 + 2 * _BEYOND_SHARE) + bandwidth
    grid = np.linspace(-edge, edge, int(np.ceil(6 * edge / bandwidth)) + 1)
    smooth = _profile_rows(across, section, count, grid, bandwidth)
    part = share[:, None]
    plates = (design * (1 - part), rows[0]), (design * part, rows[1])
    size, footprint_std = footprint_on(cloud, chosen, np.broadcast_to(axes[:2], (len(chosen), 2, 3)))
    sharp = _interpolation(across, section, count, grid)
    parts = [
        weight * _interpolation(across + node * size[:, 1], section, count, grid)
        for node, weight in ((-np.sqrt(3.0), 1 / 6), (0.0, 2 / 3), (np.sqrt(3.0), 1 / 6))
    ]
    profiles = _Profiles(grid, count, smooth, plates, sparse.csr_array(sum(parts[1:], parts[0])), sharp)
    beside = np.abs(np.tile(grid, count)) > half * (1 + _BEYOND_SHARE)
    means = profiles.of(raw, steps=0).ravel()[beside]
    expected = np.sqrt(np.asarray(smooth.power(2).sum(axis=1)).ravel()[beside])
    seen = MAD_TO_STD * float(np.nanmedian(np.abs(means) / expected))
    scatter = _local_scatter(profiles, raw, across, bandwidth)
    seen = seen * np.maximum(scatter / float(np.median(scatter[np.abs(across) > half * (1 + _BEYOND_SHARE)])), 1)
    on_bead = np.abs(across) < half
    return _Bead(axes, middle, chosen, raw, heights, on_bead, half, length, seen, profiles, footprint_std), notes


def _local_scatter(profiles: _Profiles, raw: np.ndarray, across: np.ndarray, bandwidth: float) -> np.ndarray:
    """Scatter (n,) of the points about their section's profile at their place across the weld, of all sections."""
    depths = profiles.of(raw).ravel()
    whole = abs(profiles.sharp) @ ~np.isfinite(depths) < _NOTHING
    off = np.abs(profiles.levelled(raw) - profiles.sharp @ np.nan_to_num(depths))
    cell = ((across - across.min()) / (2 * bandwidth)).astype(int)
    spread = np.full(cell.max() + 1, np.nan)
    for k in range(len(spread)):
        own = off[(cell == k) & whole]
        if len(own) >= _FEWEST_BESIDE:
            spread[k] = MAD_TO_STD * float(np.median(own))
    spread = np.where(np.isfinite(spread), spread, np.nanmedian(spread))
    return np.maximum(spread[cell], 1e-12)


def _found(points: np.ndarray) -> tuple[np.ndarray, np.ndarray, float, np.ndarray, int]:
    """Axes (3, 3), middle (3,), about half of the width and ends (2,) of the bead, and the number of others beside it.

    The bead is what stands out highest of a plane.
    """
    start = fit_robustly(lambda p: fit_plane(p, towards=TOWARDS_SENSOR), evenly_thinned(points, _TO_START))
    up, heights = start.fit.normal, start.fit.distances_mm(points)
    noise = robust_std(heights - np.median(heights))
    top = float(np.quantile(heights, 0.995))
    if top < _SIGNIFICANT * noise:
        raise EvaluationError(
            f"no bead stands out: 99.5 % of the points are lower than {top:.3g} mm, and all scatter by {noise:.3g} mm"
        )
    crown = points[heights > 0.5 * top]
    flat = (crown - crown.mean(axis=0)) @ (np.eye(3) - np.outer(up, up))
    along = principal_axes(flat)[1][0]
    along = along * np.sign(along[np.argmax(np.abs(along))])
    axes = np.array([along, np.cross(up, along), up])
    # Of several beads side by side the one with most points at half the height.
    across = crown @ axes[1]
    count, edges = np.histogram(across, bins=max(10, int(np.sqrt(len(crown)))))
    filled = np.flatnonzero(count > 0.05 * count.max())
    # Between the lines of the profiles there may be no points.
    beads = np.split(filled, np.flatnonzero(np.diff(filled) > 1 + _APART * len(count)) + 1)
    best = max(beads, key=lambda own: count[own].sum())
    low, high = edges[best[0]], edges[best[-1] + 1]
    crown = crown[(across >= low) & (across <= high)]
    middle = np.median(crown, axis=0)
    half = _HALF_FROM_CROWN * 0.5 * float(high - low)
    ends = np.quantile((crown - middle) @ along, [0.005, 0.995])
    return axes, middle, half, ends, len(beads) - 1


def _profile_rows(
    across: np.ndarray, section: np.ndarray, count: int, grid: np.ndarray, bandwidth: float
) -> sparse.csr_array:
    """Rows (S G, n) whose products with heights are local quadratics across each section; empty ones are NaN."""
    order = np.lexsort((across, section))
    starts = np.searchsorted(section[order], np.arange(count + 1))
    columns, values, lengths = [], [], [0]
    for k in range(count):
        own = order[starts[k] : starts[k + 1]]
        place = across[own]
        nothing = own[:1] if len(own) else order[:1]
        first, last = np.searchsorted(place, grid - bandwidth), np.searchsorted(place, grid + bandwidth)
        for middle, a, b in zip(grid, first, last, strict=True):
            u = (place[a:b] - middle) / bandwidth
            row = _quadratic_row(u)
            columns.append(own[a:b] if row is not None else nothing)
            values.append(row if row is not None else np.array([np.nan]))
            lengths.append(lengths[-1] + len(values[-1]))
    parts = np.concatenate(values), np.concatenate(columns), np.array(lengths)
    return sparse.csr_array(parts, shape=(count * len(grid), len(across)))


def _interpolation(across: np.ndarray, section: np.ndarray, count: int, grid: np.ndarray) -> sparse.csr_array:
    """Rows (n, S G) of values on the grid at places (n,) in sections, exact for quadratics (Keys 1981, Eq. 15)."""
    cell = (across - grid[0]) / (grid[1] - grid[0])
    at = np.floor(cell).astype(int)[:, None] + np.arange(-1, 3)
    away = np.abs(cell[:, None] - at)
    weight = np.where(away <= 1, (1.5 * away - 2.5) * away**2 + 1, ((-0.5 * away + 2.5) * away - 4) * away + 2)
    weight = np.where((at >= 0) & (at < len(grid)), weight, 0.0)
    columns = section[:, None] * len(grid) + np.clip(at, 0, len(grid) - 1)
    rows = np.repeat(np.arange(len(across)), 4)
    return sparse.csr_array((weight.ravel(), (rows, columns.ravel())), shape=(len(across), count * len(grid)))


def _quadratic_row(u: np.ndarray) -> np.ndarray | None:
    if len(u) < 5 or u.min() > -0.2 or u.max() < 0.2:
        return None
    weight = np.maximum(1 - u * u, 0)
    design = np.stack([np.ones(len(u)), u, u * u], axis=1)
    normal = (design * weight[:, None]).T @ design
    if np.linalg.cond(normal) > 1e6:
        return None
    return np.linalg.solve(normal, np.eye(3)[0]) @ (design * weight[:, None]).T


_NAMES = (
    "height", "largest height", "width", "undercut left", "undercut right", "largest undercut", "toe angle left",
    "toe angle right", "misalignment",
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class _Figures:
    """Values by the names `_NAMES`, the largest ones not yet known (NaN), and those of each section.

    These are heights of the crest (W,), and depths of the grooves at both toes (W,), NaN where lines were lost in one.

    Those of sections are of the smooth profiles, whose noise is less, with what putting back smoothing changes on
    average.
    """

    values: np.ndarray
    crest: np.ndarray
    grooves: tuple[np.ndarray, np.ndarray]


def _values(bead: _Bead, errors: PointErrors) -> tuple[tuple[FeatureValue, ...], np.ndarray, list[str]]:
    """Values, extent (3,), and notes on sections and values that are left out."""
    profiles = bead.profiles.of(bead.raw_mm)
    tops = _tops(bead, profiles)
    high = tops > _WHOLE_SHARE * float(np.median(tops[np.isfinite(tops)]))
    whole = np.flatnonzero(high & np.isfinite(tops))
    unseen, low = np.count_nonzero(~np.isfinite(tops)), np.count_nonzero(np.isfinite(tops) & ~high)
    notes = []
    if unseen + low:
        notes.append(
            f"{unseen + low} of {len(tops)} sections are left out: {unseen} without points on the bead, {low} lower "
            f"than {100 * _WHOLE_SHARE:.0f} % of the usual height"
        )
    # A toe beside lost lines may be far off: the middle one of neighbours.
    toes = ndimage.generic_filter(_toes_and_slopes(bead, profiles, whole)[:, :2], np.nanmedian, (_TOGETHER_DEEP, 1))
    first = _figures(bead, bead.raw_mm, whole, toes)
    for side, groove in zip(("left", "right"), first.grooves, strict=True):
        if lost := np.count_nonzero(~np.isfinite(groove)):
            notes.append(
                f"the undercut {side} is not known in {lost} of {len(whole)} sections: too few lines were seen there"
            )
    scattered = replace(errors, single_mm=np.maximum(bead.noise_mm, errors.single_mm))
    noisy = [_figures(bead, bead.raw_mm + moves, whole, toes) for moves in scattered.drawn(_DRAWS)]
    # Ripples make neighbouring crests differ, which is no noise; grooves have none.
    of_crest = float(np.median(np.std([each.crest for each in noisy], axis=0)))
    largest = {
        "largest height": largest_mean([first.crest], _TOGETHER_HIGH, noise=of_crest),
        "largest undercut": largest_mean(first.grooves, _TOGETHER_DEEP),
    }

    def values_of(found: _Figures) -> np.ndarray:
        """All values; the largest move with those of the sections where they are."""
        moved = {"largest height": [found.crest - first.crest]}
        moved["largest undercut"] = [now - then for now, then in zip(found.grooves, first.grooves, strict=True)]
        values = found.values.copy()
        for name, top in largest.items():
            shift = sum(float(np.nansum(w * by)) for w, by in zip(top.weights, moved[name], strict=True))
            values[_NAMES.index(name)] = top.value + shift
        return values

    seen = values_of(first)
    drawn = [values_of(each) - seen for each in noisy]
    random, bias = np.nanstd(drawn, axis=0), np.zeros(len(seen))
    # The extreme of a noisy profile is too far out, by about as much as with as much noise again.
    extremes = ["undercut" in name or "height" in name for name in _NAMES]
    bias[extremes] = np.maximum(np.nanmean(drawn, axis=0)[extremes], 0)
    # What smoothing may still hide: as much as once more would put back, and what hangs on the footprint's size.
    resolution = [
        values_of(_figures(bead, bead.raw_mm, whole, toes, steps=2)),
        values_of(_figures(bead, bead.raw_mm, whole, toes, share=1 - bead.footprint_std)),
    ]
    resolved = np.nan_to_num(np.array(resolution) - seen)
    fixed = np.sqrt(bias**2 + np.sum(resolved**2, axis=0))
    plain = np.where(extremes, np.maximum(seen - bias, 0), seen)
    common = errors.by_patterns(lambda pattern: values_of(_figures(bead, bead.raw_mm + pattern, whole, toes)) - seen)
    values = []
    for k, (name, value) in enumerate(zip(_NAMES, plain, strict=True)):
        if not np.isfinite(value):
            notes.append(f"no {name}: no section shows it")
            continue
        shared, top = None if common is None else float(common[k]), largest.get(name)
        if top is None:
            by_noise = float(np.hypot(random[k], fixed[k]))
            values.append(plain_value(FeatureKind.WELD, name, float(value), by_noise, shared, least=0))
        else:
            values.append(_widened(name, float(value), top, float(fixed[k]), shared))
    return tuple(values), np.array([bead.length_mm, float(plain[2]), float(plain[1])]), notes


def _widened(name: str, value: float, top: Largest, fixed: float, shared: float | None) -> FeatureValue:
    """A largest value with its interval, which holds the noise and is widened on both sides by what remains."""
    other = np.hypot(fixed, shared or 0.0)
    ends = [
        np.hypot(top.value - top.low, COVERAGE_FACTOR * other),
        np.hypot(top.high - top.value, COVERAGE_FACTOR * other),
    ]
    random = np.hypot((top.high - top.low) / (2 * COVERAGE_FACTOR), fixed)
    unit = DEFINITIONS[FeatureKind.WELD][name].unit
    return FeatureValue(
        name, value, unit, float(random), shared, max(value - float(ends[0]), 0.0), value + float(ends[1])
    )


def _on_bead(bead: _Bead, profiles: np.ndarray) -> np.ndarray:
    """Heights (S, G) of the profiles between the toes; -inf elsewhere."""
    inside = np.isfinite(profiles) & (np.abs(bead.profiles.across_mm) < bead.half_mm)
    return np.where(inside, profiles, -np.inf)


def _tops(bead: _Bead, profiles: np.ndarray) -> np.ndarray:
    """Greatest height (S,) of each profile between the toes; -inf where there is none."""
    return np.max(_on_bead(bead, profiles), axis=1)


def _toes_and_slopes(bead: _Bead, profiles: np.ndarray, whole: np.ndarray) -> np.ndarray:
    """Toes left and right, and the flanks' slopes there (W, 4), of some sections."""
    peaks = np.argmax(_on_bead(bead, profiles), axis=1)
    return np.array([_flanks(bead.profiles.across_mm, profiles[k], int(peaks[k])) for k in whole])


def _figures(
    bead: _Bead, raw: np.ndarray, whole: np.ndarray, toes: np.ndarray, *, steps: int = 1, share: float = 1.0
) -> _Figures:
    """Figures for heights (n,) of the points, of the sections ``whole`` (W,).

    Undercuts are looked for beyond the ``toes`` (W, 2).
    """
    profiles, smooth = bead.profiles.of(raw, steps=steps, share=share), bead.profiles.of(raw, steps=0)
    tops, flanks = _tops(bead, profiles)[whole], _toes_and_slopes(bead, profiles, whole)
    width = float(np.nanmedian(flanks[:, 1] - flanks[:, 0]))
    angles = 180 - np.degrees(np.arctan(np.nanmedian(flanks[:, 2:], axis=0)))
    means, grooves = [], []
    for side in (0, 1):
        depths, flat = (_undercuts(bead, each[whole], toes[:, side], side) for each in (profiles, smooth))
        known = np.isfinite(depths) & np.isfinite(flat)
        means.append(float(np.mean(depths[known])) if known.any() else np.nan)
        grooves.append(np.where(known, flat + np.mean((depths - flat)[known]), np.nan) if known.any() else depths)
    smooth_tops = _tops(bead, smooth)[whole]
    crest = smooth_tops + float(np.mean(tops - smooth_tops))
    middle = [float((rows @ raw)[0]) for _, rows in bead.profiles.plates]
    offset = abs(middle[1] - middle[0])
    values = np.array([float(np.mean(tops)), np.nan, width, *means, np.nan, *angles, offset])
    return _Figures(values, crest, (grooves[0], grooves[1]))


def _undercuts(bead: _Bead, profiles: np.ndarray, toes: np.ndarray, side: int) -> np.ndarray:
    """Depths (W,) of the grooves of profiles (W, G) beyond the toes (W,) of a side; NaN where lines were lost there."""
    beyond = (-1.0, 1.0)[side] * (bead.profiles.across_mm - toes[:, None]) / (2 * bead.half_mm)
    groove = (beyond > -_INSIDE_SHARE) & (beyond < _BEYOND_SHARE)
    seen = np.all(np.isfinite(profiles) | ~groove, axis=1) & groove.any(axis=1)
    return np.where(seen, -np.min(np.where(groove, profiles, np.inf), axis=1), np.nan)


def _flanks(grid: np.ndarray, profile: np.ndarray, peak: int) -> tuple[float, float, float, float]:
    """Toes left and right, and slopes of the flanks there, from the lines through their lower halves."""
    low, high = (share * profile[peak] for share in _FLANK)
    result = []
    for step in (-1, 1):
        k = peak
        while 0 < k < len(grid) - 1 and not profile[k] < high:
            k += step
        first = k
        while 0 < k < len(grid) - 1 and not profile[k] < low:
            k += step
        # From the crossing of one level to that of the other, interpolated, so that nothing jumps with the noise.
        places = [_level_between(grid, profile, j, step, level) for j, level in ((first, high), (k, low))]
        slope = (high - low) / abs(places[1] - places[0]) if places[0] != places[1] else np.nan
        result.append((places[1] + step * low / slope, slope))
    (left, slope_left), (right, slope_right) = result
    return float(left), float(right), float(slope_left), float(slope_right)


def _level_between(grid: np.ndarray, profile: np.ndarray, at: int, step: int, level: float) -> float:
    inner, outer = profile[at - step], profile[at]
    if not (np.isfinite(inner) and np.isfinite(outer)) or inner == outer:
        return float(grid[at])
    share = np.clip((inner - level) / (inner - outer), 0, 1)
    return float(grid[at - step] + share * (grid[at] - grid[at - step]))
