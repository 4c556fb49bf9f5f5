"""Inspection of a weld bead between two plates, by the quantities of ISO 5817.

Heights are measured from the line between both plates. Each section across the weld is smoothed by local quadratics.
The heights lost by this smoothing and by the footprints of the points are restored by twicing, and point errors are
propagated, as in `blemishes`.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from scipy import ndimage, sparse

from uwlts.errors import EvaluationError
from uwlts.evaluation.figures import TOWARDS_SENSOR
from uwlts.fitting.least_squares import MAD_TO_STD, fit_biweight, fit_robustly, principal_axes, robust_std, thin_evenly
from uwlts.fitting.local_surface import project_footprint
from uwlts.fitting.propagation import PointErrors
from uwlts.inspection.bead_profiles import (
    NO_WEIGHT,
    NODES,
    BeadProfiles,
    Largest,
    interpolation_rows,
    largest_mean,
    profile_rows,
)
from uwlts.inspection.features import (
    BIAS_STD,
    COVERAGE_FACTOR,
    DEFINITIONS,
    WITHOUT_UNCERTAINTY,
    Feature,
    FeatureKind,
    FeatureValue,
    Inspection,
    plain_value,
)
from uwlts.shapes.flat import Plane
from uwlts.storage.cloud import PointCloud
from uwlts.storage.cloud_files import load_cloud


class _Rule:
    """Numbers of the weld inspection; lengths "in bead widths" are divided by the toe-to-toe width."""

    fewest_points: int = 500  # fewest points of a cloud that is inspected
    start_points: int = 20_000  # points for the first plane through the plates; more points would not change this start
    draws: int = 32  # noise draws; 32 give a standard deviation to 13 %
    sections_of_largest_height: int = 3
    """Neighbouring sections averaged for the largest height; the maximum of single sections would follow the noise."""
    sections_of_largest_undercut: int = 5
    """Neighbouring sections averaged for the largest undercut, which is noisier than the height."""
    most_sections: int = 100  # largest number of sections along the weld
    points_in_section: int = 80  # points of a section on average, at least
    bandwidth: float = 0.04  # half window of a local quadratic, in bead widths: narrower than an undercut
    spacings_in_bandwidth: float = 3.0  # least half window of a local quadratic, in point spacings
    gap_spacings: float = 0.6
    """Least point spacing, divided by the typical gap between points across the bead. Both are equal for evenly
    distributed points; if images run along the bead, the gap is larger."""
    flank_low: float = 0.1
    """Lower end of the flank, as a fraction of the bead's height. A line through the flank gives toe and toe angle."""
    flank_high: float = 0.5  # upper end of the flank, as a fraction of the bead's height
    width_from_crown: float = 1.9
    """Width of the bead divided by its width at half height: 1.85 for a bell (1 - t^2)^2, 1.4 for a parabola."""
    plate_from: float = 1.3  # distance of the fitted plates from the middle, in half bead widths: beyond the undercuts
    plate_width: float = 2.0  # width of the fitted plate on either side of the bead, in bead widths
    fewest_beside: int = 50  # fewest points of each plate, and of an estimate of the local scatter
    groove_outside: float = 0.35  # width of the search for an undercut outside the toe, in bead widths
    groove_inside: float = 0.05  # width of this search inside the toe, in bead widths
    form_fits: int = 2  # fits of a simulated bead to the seen sizes: the second one starts near them
    form_places: int = 4  # places of simulated beads between two points across the weld
    exponents: tuple[int, ...] = (1, 2)
    """Exponents p of simulated beads (1 - t^2)^p, from a parabola with sharp toes to a bell with flat ones."""
    whole_height: float = 0.7
    """Fraction of the median height below which a section belongs to the bead's ends and is left out."""
    significant: float = 4.0  # least height of a bead, in standard deviations of the plates' points
    bead_gap: float = 0.1
    """Least gap between beads side by side at half their height, as a fraction of their total width."""


def inspect_weld(cloud: PointCloud | str | os.PathLike[str]) -> Inspection:
    """Measure the highest weld bead of a cloud: height, width, undercut, toe angles and misalignment.

    The plates on both sides are fitted robustly. The bead runs along the longest extent of the points above the plates.
    A toe is the intersection of a plate with the line through a flank, from 10 to 50 % of the height.

    Parameters
    ----------
    cloud
        See `inspect_pipe`.

    Returns
    -------
    Inspection
        Sizes and angles of the bead with their uncertainties, mm and deg.

    Raises
    ------
    CaptureError
        The file cannot be read.
    EvaluationError
        The cloud shows no bead.
    """
    cloud = load_cloud(cloud)
    if len(cloud) < _Rule.fewest_points:
        raise EvaluationError(
            f"the cloud has {len(cloud)} points; at least {_Rule.fewest_points} are needed for a weld"
        )
    axes, middle, half, ends, others = _locate_bead(cloud.points_mm)
    local = (cloud.points_mm - middle) @ axes.T
    local[(local[:, 0] < ends[0]) | (local[:, 0] > ends[1])] = np.inf
    tangents = np.broadcast_to(axes[:2], (len(cloud), 2, 3))
    bead = build_bead(cloud, local, tangents, half_mm=half)
    errors = PointErrors.along_normals(cloud, bead.chosen, np.broadcast_to(axes[2], (len(bead.chosen), 3)))
    values, extent, left_out = measure_bead(bead, errors)
    feature = Feature(FeatureKind.WELD, "weld", values, middle, axes, extent, bead.chosen[bead.on_bead])
    deviation = np.full(len(cloud), np.nan)
    deviation[bead.chosen] = bead.heights_mm
    count = bead.profiles.sections
    notes = [f"{count} sections of {bead.length_mm / count:.2g} mm; the second axis points from left to right"]
    if others:
        notes.append(f"{others} other beads beside the highest one are not measured: crop the cloud to measure them")
    notes += left_out
    if cloud.uncertainty is None:
        notes.append(WITHOUT_UNCERTAINTY)
    return Inspection("weld", (feature,), deviation, tuple(notes)).consider_cloud(cloud)


@dataclass(frozen=True, eq=False)
class Bead:
    """Bead with its plates."""

    chosen: np.ndarray  # (n,) int; points on the bead and on the plates
    raw_mm: np.ndarray  # (n,); heights of these points above the middle
    heights_mm: np.ndarray  # (n,); heights of these points above the plates
    on_bead: np.ndarray  # (n,) bool; points on the bead
    half_mm: float  # approximate half width of the bead
    length_mm: float  # length of the bead
    spacing_mm: float  # gap between points across the weld in a section
    noise_mm: np.ndarray  # (n,); standard deviation of independent point noise that explains the scatter of local means
    profiles: BeadProfiles
    footprint_std: float  # relative standard uncertainty of the squared footprints


def build_bead(cloud: PointCloud, local: np.ndarray, tangents: np.ndarray, *, half_mm: float) -> Bead:
    """Return a bead with its plates and profiles.

    ``local`` (N, 3) are places along the bead, across it and heights, mm; not finite for points that do not count.
    ``tangents`` (N, 2, 3) are unit vectors along and across it at the points. ``half_mm`` is the approximate half
    width.

    Raises EvaluationError if the points do not show the plates on both sides of the bead.
    """
    half, reach = half_mm, half_mm * (1 + 2 * _Rule.plate_width)
    chosen = np.flatnonzero(np.isfinite(local).all(axis=1) & (np.abs(local[:, 1]) < reach))
    along, across, raw = local[chosen].T
    sides = [across < -_Rule.plate_from * half, across > _Rule.plate_from * half]
    if min(map(np.count_nonzero, sides)) < _Rule.fewest_beside:
        raise EvaluationError("the cloud does not show the plates on both sides of the bead")
    design = np.column_stack([np.ones(len(along)), along, across])
    rows = [fit_biweight(design, raw, side)[0] for side in sides]
    # Between the toes the reference is interpolated from one plate to the other.
    share = np.clip((across + half) / (2 * half), 0, 1)
    heights = raw - (1 - share) * (design @ (rows[0] @ raw)) - share * (design @ (rows[1] @ raw))
    length, images = float(np.ptp(along)), len(np.unique(cloud.frame[chosen]))
    count = max(1, len(along) // _Rule.points_in_section)
    # With several sections per image it would be random which section has points.
    count = min(count, _Rule.most_sections, images if images > 1 else count)
    section = np.clip(((along - along.min()) / length * count).astype(int), 0, count - 1)
    # The gap between points of a section that contains the median place across.
    order = np.lexsort((across, section))
    gaps = np.sort(np.diff(across[order])[np.diff(section[order]) == 0])
    gap = float(gaps[np.searchsorted(np.cumsum(gaps), 0.5 * gaps.sum())])
    spacing = max(2 * reach * count / len(along), _Rule.gap_spacings * gap)
    bandwidth = max(_Rule.bandwidth * 2 * half, _Rule.spacings_in_bandwidth * spacing)
    edge = half * (1 + 2 * _Rule.groove_outside) + bandwidth
    grid = np.linspace(-edge, edge, int(np.ceil(6 * edge / bandwidth)) + 1)
    smooth = profile_rows(across, section, count, grid, bandwidth)
    part = share[:, None]
    plates = (design * (1 - part), rows[0]), (design * part, rows[1])
    size, footprint_std = project_footprint(cloud, chosen, tangents[chosen])
    sharp = interpolation_rows(across, section, count, grid)
    parts = [weight * interpolation_rows(across + node * size[:, 1], section, count, grid) for node, weight in NODES]
    seen_rows = sparse.csr_array(sum(parts[1:], parts[0]))
    profiles = BeadProfiles(grid, across, size[:, 1], count, smooth, plates, seen_rows, sharp)
    beside = np.abs(np.tile(grid, count)) > half * (1 + _Rule.groove_outside)
    means = profiles.evaluate(raw, steps=0).ravel()[beside]
    expected = np.sqrt(np.asarray(smooth.power(2).sum(axis=1)).ravel()[beside])
    if not np.isfinite(means).any():
        raise EvaluationError(f"none of the {count} sections across the bead has enough points for a profile")
    seen = MAD_TO_STD * float(np.nanmedian(np.abs(means) / expected))
    scatter = _estimate_scatter(profiles, raw, across, bandwidth)
    seen = seen * np.maximum(scatter / float(np.median(scatter[np.abs(across) > half * (1 + _Rule.groove_outside)])), 1)
    on_bead = np.abs(across) < half
    return Bead(chosen, raw, heights, on_bead, half, length, gap, seen, profiles, footprint_std)


def _estimate_scatter(profiles: BeadProfiles, raw: np.ndarray, across: np.ndarray, bandwidth: float) -> np.ndarray:
    """Estimate the scatter (n,) of the points about the profiles, by their place across the weld."""
    depths = profiles.evaluate(raw).ravel()
    whole = abs(profiles.sharp) @ ~np.isfinite(depths) < NO_WEIGHT
    off = np.abs(profiles.subtract_plates(raw) - profiles.sharp @ np.nan_to_num(depths))
    cell = ((across - across.min()) / (2 * bandwidth)).astype(int)
    spread = np.full(cell.max() + 1, np.nan)
    for k in range(len(spread)):
        deviations = off[(cell == k) & whole]
        if len(deviations) >= _Rule.fewest_beside:
            spread[k] = MAD_TO_STD * float(np.median(deviations))
    if not np.isfinite(spread).any():
        raise EvaluationError(
            f"no strip of {2 * bandwidth:.2g} mm along the weld has {_Rule.fewest_beside} points of complete sections, "
            "which give the scatter of the points; scan with profiles closer together"
        )
    spread = np.where(np.isfinite(spread), spread, np.nanmedian(spread))
    return np.maximum(spread[cell], 1e-12)


def _locate_bead(points: np.ndarray) -> tuple[np.ndarray, np.ndarray, float, np.ndarray, int]:
    """Locate the highest bead above a plane through all points.

    Returns its axes (3, 3), middle (3,), approximate half width and ends (2,) along it, in mm, and the number of other
    beads.
    """
    start = fit_robustly(Plane.fit, thin_evenly(points, _Rule.start_points), towards=TOWARDS_SENSOR)
    up, heights = start.fit.normal, start.fit.distances_mm(points)
    noise = robust_std(heights - np.median(heights))
    top = float(np.quantile(heights, 0.995))
    if top < _Rule.significant * noise:
        raise EvaluationError(
            f"no bead found: 99.5 % of the points are lower than {top:.3g} mm, with a scatter of {noise:.3g} mm"
        )
    crown = points[heights > 0.5 * top]
    flat = (crown - crown.mean(axis=0)) @ (np.eye(3) - np.outer(up, up))
    along = principal_axes(flat)[1][0]
    along = along * np.sign(along[np.argmax(np.abs(along))])
    axes = np.array([along, np.cross(up, along), up])
    # Of several beads side by side take the one with most points above half the height.
    across = crown @ axes[1]
    count, edges = np.histogram(across, bins=max(10, int(np.sqrt(len(crown)))))
    filled = np.flatnonzero(count > 0.05 * count.max())
    # Bins between the profile lines may be empty.
    beads = np.split(filled, np.flatnonzero(np.diff(filled) > 1 + _Rule.bead_gap * len(count)) + 1)
    best = max(beads, key=lambda own: count[own].sum())
    low, high = edges[best[0]], edges[best[-1] + 1]
    crown = crown[(across >= low) & (across <= high)]
    middle = np.median(crown, axis=0)
    half = _Rule.width_from_crown * 0.5 * float(high - low)
    ends = np.quantile((crown - middle) @ along, [0.005, 0.995])
    return axes, middle, half, ends, len(beads) - 1


_NAMES = (
    "height", "largest height", "width", "undercut left", "undercut right", "largest undercut", "toe angle left",
    "toe angle right", "misalignment",
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class _Figures:
    """Values and section profiles of one set of point heights."""

    values: np.ndarray  # (9,); values in the order of `_NAMES`; the largest ones are NaN, as they are determined later
    crest: np.ndarray
    """(W,); height of each section. Sections use the smooth profiles, which are less noisy, plus the mean correction
    of the smoothing."""
    grooves: tuple[np.ndarray, np.ndarray]
    """Pair of (W,); undercut depths at the left and right toe of each section; NaN if lines are missing there."""


def measure_bead(bead: Bead, errors: PointErrors) -> tuple[tuple[FeatureValue, ...], np.ndarray, list[str]]:
    """Return the values, the extent (3,) in mm, and notes on omitted sections and values."""
    profiles = bead.profiles.evaluate(bead.raw_mm)
    tops = _find_tops(bead, profiles)
    high = tops > _Rule.whole_height * float(np.median(tops[np.isfinite(tops)]))
    whole = np.flatnonzero(high & np.isfinite(tops))
    unseen, low = np.count_nonzero(~np.isfinite(tops)), np.count_nonzero(np.isfinite(tops) & ~high)
    notes = []
    if unseen + low:
        notes.append(
            f"{unseen + low} of {len(tops)} sections are omitted: {unseen} without points on the bead, {low} lower "
            f"than {100 * _Rule.whole_height:.0f} % of the median height"
        )
    # Single toes are noisy, and unknown next to missing lines: take the median of neighbouring sections.
    toes = _find_toes(bead, profiles, whole)[:, :2]
    if not np.isfinite(toes).any(axis=0).all():
        raise EvaluationError("no section of the bead has points on both flanks without a gap; scan it more densely")
    toes = np.where(np.isfinite(toes), toes, np.nanmedian(toes, axis=0))
    toes = ndimage.median_filter(toes, (_Rule.sections_of_largest_undercut, 1), mode="reflect")
    first = _evaluate_figures(bead, bead.raw_mm, whole, toes)
    for side, groove in zip(("left", "right"), first.grooves, strict=True):
        if lost := np.count_nonzero(~np.isfinite(groove)):
            notes.append(
                f"the undercut {side} is unknown in {lost} of {len(whole)} sections: profile lines are missing there"
            )
    scattered = replace(errors, single_mm=np.maximum(bead.noise_mm, errors.single_mm))
    noisy = [_evaluate_figures(bead, bead.raw_mm + moves, whole, toes) for moves in scattered.draw(_Rule.draws)]
    # Ripples of the crest are no noise: its noise is taken from the draws. Grooves have no ripples.
    of_crest = float(np.median(np.std([each.crest for each in noisy], axis=0)))
    largest = {
        "largest height": largest_mean([first.crest], _Rule.sections_of_largest_height, noise=of_crest),
        "largest undercut": largest_mean(first.grooves, _Rule.sections_of_largest_undercut),
    }

    def values_of(found: _Figures) -> np.ndarray:
        """Return all values; the largest ones follow the sections that they were found in."""
        moved = {"largest height": [found.crest - first.crest]}
        moved["largest undercut"] = [now - then for now, then in zip(found.grooves, first.grooves, strict=True)]
        values = found.values.copy()
        for name, top in largest.items():
            shift = sum(float(np.nansum(w * by)) for w, by in zip(top.weights, moved[name], strict=True))
            values[_NAMES.index(name)] = top.value + shift
        return values

    seen = values_of(first)
    # An unknown value stays unknown.
    drawn = np.array([values_of(each) - seen for each in noisy])
    drawn[:, np.isnan(seen)] = 0
    random, bias = np.nanstd(drawn, axis=0), np.zeros(len(seen))
    # Noise biases the extremes of a profile outwards. Doubling the noise shows the size of this bias.
    extremes = ["undercut" in name or "height" in name for name in _NAMES]
    bias[extremes] = np.maximum(np.nanmean(drawn, axis=0)[extremes], 0)
    # Remaining effect of smoothing: the change by a second correction, and by the uncertainty of the footprints.
    resolution = [
        values_of(_evaluate_figures(bead, bead.raw_mm, whole, toes, steps=2)),
        values_of(_evaluate_figures(bead, bead.raw_mm, whole, toes, share=1 - bead.footprint_std)),
    ]
    resolved = np.nan_to_num(np.array(resolution) - seen)
    # Where points are far apart, smoothing widens the bead: the middle of the errors on beads of known forms is
    # subtracted, and their largest distance from it belongs to the uncertainty, as the form is unknown. The groove that
    # smoothing gives a sound toe is not subtracted from an undercut, which need not have it.
    of_forms = _simulate_forms(bead, seen, whole, toes)
    form, spread = 0.5 * (of_forms.max(axis=0) + of_forms.min(axis=0)), 0.5 * np.ptp(of_forms, axis=0)
    grooves = np.array(["undercut" in name for name in _NAMES])
    form[grooves], spread[grooves] = 0.0, of_forms.max(axis=0)[grooves]
    fixed = np.sqrt((BIAS_STD * bias) ** 2 + (BIAS_STD * form) ** 2 + spread**2 + np.sum(resolved**2, axis=0))
    plain = np.where(extremes, np.maximum(seen - bias - form, 0), seen - form)
    common = errors.by_patterns(
        lambda pattern: values_of(_evaluate_figures(bead, bead.raw_mm + pattern, whole, toes)) - seen
    )
    values = []
    for k, (name, value) in enumerate(zip(_NAMES, plain, strict=True)):
        if not np.isfinite(value):
            notes.append(f"no {name}: it is unknown in all sections")
            continue
        shared, top = None if common is None else float(common[k]), largest.get(name)
        if top is None:
            by_noise = float(np.hypot(random[k], fixed[k]))
            values.append(plain_value(FeatureKind.WELD, name, float(value), by_noise, shared, least=0))
        else:
            values.append(_widen_interval(name, float(value), top, float(fixed[k]), shared))
    return tuple(values), np.array([bead.length_mm, float(plain[2]), float(plain[1])]), notes


def _widen_interval(name: str, value: float, top: Largest, fixed: float, shared: float | None) -> FeatureValue:
    """Return a largest value; the interval of `top` is widened on both sides by the other uncertainties."""
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


def _mask_beside_bead(bead: Bead, profiles: np.ndarray) -> np.ndarray:
    """Return the profiles (S, G) with -inf outside the toes."""
    inside = np.isfinite(profiles) & (np.abs(bead.profiles.across_mm) < bead.half_mm)
    return np.where(inside, profiles, -np.inf)


def _find_tops(bead: Bead, profiles: np.ndarray) -> np.ndarray:
    """Return the largest height (S,) of each profile between the toes; -inf if it is unknown.

    A parabola through the highest place and its neighbours gives the height between places.
    """
    inside = _mask_beside_bead(bead, profiles)
    peak = np.clip(np.argmax(inside, axis=1), 1, inside.shape[1] - 2)
    before, top, after = (inside[np.arange(len(inside)), peak + step] for step in (-1, 0, 1))
    with np.errstate(invalid="ignore", divide="ignore"):
        bend, tilt = before + after - 2 * top, after - before
        more = np.where(np.isfinite(bend) & (bend < 0) & (np.abs(tilt) <= -bend), -np.square(tilt) / (8 * bend), 0.0)
    return np.max(inside, axis=1) + more


def _find_toes(bead: Bead, profiles: np.ndarray, whole: np.ndarray) -> np.ndarray:
    """Return places of the left and right toe and slopes of both flanks (W, 4), for sections ``whole`` (W,)."""
    peaks = np.argmax(_mask_beside_bead(bead, profiles), axis=1)
    return np.array([_fit_flanks(bead.profiles.across_mm, profiles[k], int(peaks[k])) for k in whole])


def _evaluate_figures(
    bead: Bead, raw: np.ndarray, whole: np.ndarray, toes: np.ndarray, *, steps: int = 1, share: float = 1.0
) -> _Figures:
    """Evaluate the profiles for point heights (n,) in the sections ``whole`` (W,).

    Undercuts are searched for beyond the ``toes`` (W, 2).
    """
    profiles, smooth = bead.profiles.evaluate(raw, steps=steps, share=share), bead.profiles.evaluate(raw, steps=0)
    tops, flanks = _find_tops(bead, profiles)[whole], _find_toes(bead, profiles, whole)
    width = float(np.nanmedian(flanks[:, 1] - flanks[:, 0]))
    angles = 180 - np.degrees(np.arctan(np.nanmedian(flanks[:, 2:], axis=0)))
    means, grooves = [], []
    for side in (0, 1):
        depths, flat = (_find_undercuts(bead, each[whole], toes[:, side], side) for each in (profiles, smooth))
        known = np.isfinite(depths) & np.isfinite(flat)
        means.append(float(np.mean(depths[known])) if known.any() else np.nan)
        grooves.append(np.where(known, flat + np.mean((depths - flat)[known]), np.nan) if known.any() else depths)
    smooth_tops = _find_tops(bead, smooth)[whole]
    crest = smooth_tops + float(np.mean(tops - smooth_tops))
    middle = [float((rows @ raw)[0]) for _, rows in bead.profiles.plates]
    offset = abs(middle[1] - middle[0])
    values = np.array([float(np.mean(tops)), np.nan, width, *means, np.nan, *angles, offset])
    return _Figures(values, crest, (grooves[0], grooves[1]))


def _simulate_forms(bead: Bead, seen: np.ndarray, whole: np.ndarray, toes: np.ndarray) -> np.ndarray:
    """Return the errors (E, 9) of values at straight beads H (1 - t^2)^p without undercut of the seen height and width.

    They are simulated for several p and places: between points at the same places in all sections, a toe is unknown.
    """
    height, width = seen[_NAMES.index("height")], seen[_NAMES.index("width")]
    places = float(np.mean(toes)) + bead.spacing_mm * np.arange(_Rule.form_places) / _Rule.form_places
    errors = np.zeros((len(_Rule.exponents) * len(places), len(_NAMES)))
    if not (height > 0 and width > 0):
        return errors
    for error, (exponent, middle) in zip(errors, product(_Rule.exponents, places), strict=True):
        low, high = (np.sqrt(1 - share ** (1 / exponent)) for share in (_Rule.flank_low, _Rule.flank_high))
        steep = (_Rule.flank_high - _Rule.flank_low) / (low - high)
        sizes = np.array([height, width])
        for _ in range(_Rule.form_fits):
            half = 0.5 * sizes[1] / (low + _Rule.flank_low / steep)
            raw = bead.profiles.observe(middle, sizes[0], half, exponent)
            found = _evaluate_figures(bead, raw, whole, toes).values
            error[:6] = *(found[[0, 0, 2]] - sizes[[0, 0, 1]]), *found[3:5], found[3:5].max()
            error[6:8] = found[6:8] - 180 + float(np.degrees(np.arctan(steep * sizes[0] / half)))
            sizes = np.maximum(sizes + seen[[0, 2]] - found[[0, 2]], 0.5 * sizes)
    return np.nan_to_num(errors)


def _find_undercuts(bead: Bead, profiles: np.ndarray, toes: np.ndarray, side: int) -> np.ndarray:
    """Return undercut depths (W,) of profiles (W, G) near the toes (W,) of a side; NaN if lines are missing."""
    beyond = (-1.0, 1.0)[side] * (bead.profiles.across_mm - toes[:, None]) / (2 * bead.half_mm)
    groove = (beyond > -_Rule.groove_inside) & (beyond < _Rule.groove_outside)
    seen = np.all(np.isfinite(profiles) | ~groove, axis=1) & groove.any(axis=1)
    return np.where(seen, -np.min(np.where(groove, profiles, np.inf), axis=1), np.nan)


def _fit_flanks(grid: np.ndarray, profile: np.ndarray, peak: int) -> tuple[float, float, float, float]:
    """Return places of the left and right toe and slopes there, from lines through the lower half of each flank."""
    low, high = (share * profile[peak] for share in (_Rule.flank_low, _Rule.flank_high))
    result = []
    for step in (-1, 1):
        k = peak
        while 0 < k < len(grid) - 1 and not profile[k] < high:
            k += step
        first = k
        while 0 < k < len(grid) - 1 and not profile[k] < low:
            k += step
        # Crossings are interpolated, so that they change continuously with the heights.
        places = [_interpolate_crossing(grid, profile, j, step, level) for j, level in ((first, high), (k, low))]
        slope = (high - low) / abs(places[1] - places[0]) if places[0] != places[1] else np.nan
        result.append((places[1] + step * low / slope, slope))
    (left, slope_left), (right, slope_right) = result
    return float(left), float(right), float(slope_left), float(slope_right)


def _interpolate_crossing(grid: np.ndarray, profile: np.ndarray, at: int, step: int, level: float) -> float:
    """Return the place where a profile crosses a level between a grid point and its predecessor; NaN in a gap."""
    inner, outer = profile[at - step], profile[at]
    if inner == outer:
        return float(grid[at])
    share = np.clip((inner - level) / (inner - outer), 0, 1)
    return float(grid[at - step] + share * (grid[at] - grid[at - step]))
