"""Inspection of a pipe: its form, section by section, and pits, dents and protrusions on it."""

from __future__ import annotations

import os
from dataclasses import replace

import numpy as np

from uwlts.errors import EvaluationError
from uwlts.fitting.least_squares import robust_std
from uwlts.fitting.point_spacing import footprint_on
from uwlts.fitting.propagation import PointErrors
from uwlts.inspection.blemish_search import BlemishSearch, Indication, UnrolledSurface, search_blemishes
from uwlts.inspection.blemishes import Blemish, measure_blemish
from uwlts.inspection.features import Feature, FeatureKind, Inspection
from uwlts.inspection.pipe_form import LARGEST_OVALITY, MOST_OFF_SHARE, PipeForm, fit_pipe, pipe_features, refit_pipe
from uwlts.storage.cloud import PointCloud
from uwlts.storage.cloud_files import loaded_cloud

_OVERLAP = 0.6
"""Angle, rad, by which both sides of a pipe that is cut open overlap, unless as much without a point parts them."""
_SEARCHED = 0.1
"""Angle, rad, by which findings count beyond the cut. Farther beyond it points are surroundings alone: findings there
have less of these than on the other side, where they are found, too."""
_FEWEST = 500
"""Points from which a pipe's surface can be searched."""


def inspect_pipe(
    cloud: PointCloud | str | os.PathLike[str],
    *,
    section_mm: float | None = None,
    wall_mm: float | None = None,
    false_alarm: float = 0.05,
    largest_ovality: float = LARGEST_OVALITY,
) -> Inspection:
    """Measure a pipe's form and find the blemishes of its outside.

    The form is a cylinder with out of roundness, bow and taper (`uwlts.inspection.pipe_form`). What departs from it
    locally is searched for at all sizes (`uwlts.inspection.blemish_search`) and measured against the surface around it
    (`uwlts.inspection.blemishes`). Uncertainties propagate the points' covariance, including what the points share by
    calibration, and are never below what the points' own scatter shows. For a cloud without covariance they come from
    the scatter alone, and a note says so.

    Parameters
    ----------
    cloud
        Cloud of the object, or its file (.ply, .h5, .copc.laz; of other programs .las, .e57, and text in mm).
    section_mm
        Length of a section along the pipe (or a weld); up to twelve sections unless given.
    wall_mm
        Thickness of the pipe's undamaged wall, for the wall that remains.
    false_alarm
        Probability that anything is found on the whole of a pipe's surface where nothing is.
    largest_ovality
        Ovality over the diameter that the pipe may have where less than half of its circumference was seen: the
        tolerance of its specification, where it still holds.

    Raises
    ------
    CaptureError
        The file cannot be read.
    EvaluationError
        The points do not determine a pipe, or a parameter is out of its range.

    Examples
    --------
    >>> found = uwlts.inspect_pipe("pipe.ply", wall_mm=9.5)
    >>> print("\\n".join(found.lines()))
    """
    cloud = loaded_cloud(cloud)
    if wall_mm is not None and not 0 < wall_mm < np.inf:
        raise EvaluationError(f"wall_mm is {wall_mm:g}; expected a positive thickness in mm")
    if not 0 < false_alarm < 1:
        raise EvaluationError(f"false_alarm is {false_alarm:g}; expected a probability between 0 and 1")
    if not 0 <= largest_ovality <= 0.2:
        raise EvaluationError(
            f"largest_ovality is {largest_ovality:g}; expected a share of the diameter from 0 to 0.2, such as 0.02"
        )
    if len(cloud) < _FEWEST:
        raise EvaluationError(f"the cloud has {len(cloud)} points; at least {_FEWEST} are needed for a pipe")
    form = fit_pipe(cloud, largest_ovality=largest_ovality)
    chosen = np.flatnonzero(np.abs(form.distance_mm) < MOST_OFF_SHARE * form.radius_mm)
    off = _off_notes(form, chosen)
    search = _searched(cloud, form, chosen, false_alarm)
    if search.indications:
        # Once more without what was found, which pulls the form towards it.
        damaged = np.ones(len(cloud), bool)
        damaged[chosen[search.plain]] = False
        form = refit_pipe(cloud, form, left_out=damaged)
    features, of_sections = pipe_features(cloud, form, section_mm=section_mm)
    blemishes, of_blemishes = _blemish_features(cloud, form, chosen, search, wall_mm)
    deviation, level = np.full(len(cloud), np.nan), np.full(len(cloud), np.nan)
    deviation[chosen[~search.outliers]] = form.distance_mm[chosen[~search.outliers]]
    level[chosen] = search.level_mm
    notes = *_notes(cloud, form, search), *off, *of_sections, *of_blemishes
    return Inspection("pipe", (*features, *blemishes), deviation, level, notes)


def _searched(cloud: PointCloud, form: PipeForm, chosen: np.ndarray, false_alarm: float) -> BlemishSearch:
    """Search the pipe, cut open where it was not seen or, if it was seen all around, with both sides overlapping."""
    angle = form.angle[chosen]
    inside = np.sort(np.unique(np.round(angle, 3)))
    gaps = np.diff(np.append(inside, inside[0] + 2 * np.pi))
    widest = int(np.argmax(gaps))
    angle = np.mod(angle - inside[widest] - 0.5 * gaps[widest], 2 * np.pi)
    copied = np.arange(len(chosen))
    if gaps[widest] < _OVERLAP:
        first, last = np.flatnonzero(angle < _OVERLAP), np.flatnonzero(angle > 2 * np.pi - _OVERLAP)
        copied = np.concatenate([copied, first, last])
        angle = np.concatenate([angle, angle[first] + 2 * np.pi, angle[last] - 2 * np.pi])
    errors = PointErrors.along(cloud, chosen, form.outwards[chosen])[copied]
    surface = _unrolled(cloud, form, chosen[copied], angle, errors)
    search = search_blemishes(surface, false_alarm=false_alarm)
    beyond = np.abs(surface.places[:, 1] / form.radius_mm - np.pi) - np.pi
    found = [each for each in search.indications if np.median(beyond[each.points]) <= _SEARCHED]
    unresolved = tuple(
        replace(each, point=int(copied[each.point])) for each in search.unresolved if beyond[each.point] <= _SEARCHED
    )
    return _joined(replace(search, indications=tuple(found), unresolved=unresolved), copied, len(chosen))


def _joined(search: BlemishSearch, copied: np.ndarray, count: int) -> BlemishSearch:
    """A search of copies of points, those ``copied`` (N,) of (M,), the first of them in order, as one of the points.

    What was found on both sides of the cut is one indication: of the same sign, with half of its points in common.
    """
    joined: list[Indication] = []
    for indication in sorted(search.indications, key=lambda each: len(each.points), reverse=True):
        own = replace(indication, points=np.unique(copied[indication.points]))
        for number, other in enumerate(joined):
            shared = np.count_nonzero(np.isin(own.points, other.points, assume_unique=True))
            if own.height_mm * other.height_mm > 0 and shared > 0.5 * len(own.points):
                joined[number] = replace(other, points=np.union1d(own.points, other.points))
                break
        else:
            joined.append(own)
    plain = search.plain[:count].copy()
    for indication in joined:
        plain[indication.points] = False
    return replace(
        search,
        indications=tuple(joined),
        outliers=search.outliers[:count],
        plain=plain,
        level_mm=search.level_mm[:count],
        noise_mm=search.noise_mm[:count],
    )


def _unrolled(
    cloud: PointCloud, form: PipeForm, chosen: np.ndarray, angle: np.ndarray, errors: PointErrors
) -> UnrolledSurface:
    """The surface of the chosen points (M,), unrolled by angles (M,), which may count from anywhere."""
    heights = form.distance_mm[chosen]
    spread = max(robust_std(heights - np.median(heights)), 1e-9)
    std = errors.single_mm if np.all(errors.single_mm > 0) else np.full(len(heights), spread)
    axis = np.broadcast_to(form.frame.axes[2], (len(chosen), 3))
    tangents = np.stack([axis, np.cross(axis, form.outwards[chosen])], axis=1)
    places = np.column_stack([form.along_mm[chosen], form.radius_mm * angle])
    return UnrolledSurface(places, heights, std, *footprint_on(cloud, chosen, tangents))


def _blemish_features(
    cloud: PointCloud, form: PipeForm, chosen: np.ndarray, search: BlemishSearch, wall_mm: float | None
) -> tuple[list[Feature], list[str]]:
    """What was found, as features, and a note for each that became none."""
    errors = PointErrors.along(cloud, chosen, form.outwards[chosen])
    flat = _unrolled(cloud, form, chosen, form.angle[chosen], errors)
    measured: list[tuple[Blemish, float, float]] = []
    notes = [_left_out(cloud, chosen[[each.point]], each.height_mm, each.reason) for each in search.unresolved]
    for indication in search.indications:
        # Unrolled about itself, so that it is never cut.
        middle = float(np.angle(np.mean(np.exp(1j * form.angle[chosen[indication.points]]))))
        angle = np.mod(form.angle[chosen] - middle + np.pi, 2 * np.pi) - np.pi
        surface = replace(flat, places=np.column_stack([flat.places[:, 0], form.radius_mm * angle]))
        try:
            blemish = measure_blemish(
                surface, search, indication, errors, diameter_mm=2 * form.radius_mm, wall_mm=wall_mm
            )
            if (size := blemish.values[0]).low <= 0:
                raise EvaluationError(f"over its surroundings it is not significant: {size.text()}")
        except EvaluationError as error:
            notes.append(_left_out(cloud, chosen[indication.points], indication.height_mm, str(error)))
        else:
            measured.append((blemish, middle, indication.false_alarm))
    measured.sort(key=lambda each: each[0].extent_mm[2], reverse=True)
    features, numbers = [], dict.fromkeys(FeatureKind, 0)
    for blemish, middle, chance in measured:
        numbers[blemish.kind] += 1
        angle = np.array([blemish.place[1] / form.radius_mm + middle])
        place, out = form.at(blemish.place[:1], angle)[0], form.frame.outwards(angle)[0]
        axes = np.array([form.frame.axes[2], np.cross(out, form.frame.axes[2]), out])
        name, points = f"{blemish.kind} {numbers[blemish.kind]}", chosen[blemish.points]
        features.append(Feature(blemish.kind, name, blemish.values, place, axes, blemish.extent_mm, points, chance))
    return features, notes


def _left_out(cloud: PointCloud, points: np.ndarray, height_mm: float, reason: str) -> str:
    """Note on an indication at some points that is no feature."""
    x, y, z = cloud.points_mm[points].mean(axis=0)
    return f"an indication of {height_mm:.2g} mm at ({x:.1f}, {y:.1f}, {z:.1f}) mm is not listed: {reason}"


def _notes(cloud: PointCloud, form: PipeForm, search: BlemishSearch) -> list[str]:
    notes = []
    if cloud.uncertainty is None:
        notes.append("the cloud states no uncertainty: intervals are of the scatter of its points alone")
    if not form.is_seen_round:
        seen = np.degrees(form.arc)
        notes.append(
            f"{seen:.0f} deg of the circumference were seen: the ovality is not determined, and what one of up to "
            f"{100 * form.largest_ovality:g} % may do to the diameter is in its interval"
        )
    level = float(np.nanmedian(search.level_mm)) if np.isfinite(search.level_mm).any() else np.nan
    notes.append(
        f"blemishes of {2 * search.smallest_mm:.2g} mm diameter count from {level:.2g} mm depth (median), larger ones "
        f"from less; the probability of any false one is {search.false_alarm:g}"
    )
    return notes


def _off_notes(form: PipeForm, chosen: np.ndarray) -> list[str]:
    """Note on the points that are not chosen (M,), if there are any."""
    count, limit = len(form.distance_mm), MOST_OFF_SHARE * form.radius_mm
    if len(chosen) == count:
        return []
    inside = int(np.count_nonzero(form.distance_mm <= -limit))
    return [
        f"{count - len(chosen)} of {count} points are {limit:.2g} mm or more off the pipe ({inside} inside) and "
        "are left out: what is deeper or higher is not found, or is cut off there"
    ]
