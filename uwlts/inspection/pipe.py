"""Inspection of a pipe: its form, section by section, and pits, dents and protrusions on it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from uwlts.errors import EvaluationError
from uwlts.fitting.least_squares import MAD_TO_STD
from uwlts.fitting.point_spacing import footprint_on
from uwlts.inspection.blemish_search import BlemishSearch, UnrolledSurface, search_blemishes
from uwlts.inspection.blemishes import Blemish, measure_blemish
from uwlts.inspection.features import Feature, FeatureKind, Inspection
from uwlts.inspection.pipe_form import LARGEST_OVALITY, MOST_OFF_SHARE, PipeForm, fit_pipe, pipe_features
from uwlts.inspection.propagation import normal_errors
from uwlts.storage.cloud import PointCloud

_OPEN, _OVERLAP = 0.05, 0.3
"""Radians without a point that part the two sides of a pipe, and by which they overlap where nothing parts them."""
_FEWEST = 500
"""Points from which a pipe's surface can be searched."""


def inspect_pipe(
    cloud: PointCloud,
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
        Cloud of the pipe's outside.
    section_mm
        Length of a section; up to twelve sections unless given.
    wall_mm
        Thickness of the undamaged wall, for the wall that remains.
    false_alarm
        Probability that anything is found on the whole pipe where nothing is.
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
    # Farther off lies what is not the pipe.
    seam = _cut_open(form, np.flatnonzero(np.abs(form.distance_mm) < MOST_OFF_SHARE * form.radius_mm))
    chosen, surface = seam.points, _unrolled(cloud, form, seam)
    search = search_blemishes(surface, false_alarm=false_alarm)
    if search.indications:
        # Once more without what was found, which pulls the form towards it.
        damaged = np.ones(len(cloud), bool)
        damaged[chosen[search.plain]] = False
        form = fit_pipe(cloud, left_out=damaged, largest_ovality=largest_ovality)
        surface = _unrolled(cloud, form, seam)
    features = pipe_features(cloud, form, section_mm=section_mm)
    features += _blemish_features(cloud, form, surface, search, seam, wall_mm)
    deviation, level = np.full(len(cloud), np.nan), np.full(len(cloud), np.nan)
    deviation[chosen[~search.outliers]] = form.distance_mm[chosen[~search.outliers]]
    level[chosen] = search.level_mm
    return Inspection("pipe", tuple(features), deviation, level, _notes(cloud, form, search, false_alarm))


@dataclass(frozen=True, eq=False)
class _Seam:
    """Where the pipe is cut open: an angle, and the points (M,) with their angles from there.

    Of a pipe that was seen all around, those near the cut appear on both sides; ``end`` is the angle from which they
    are the second ones.
    """

    cut: float
    points: np.ndarray
    angle: np.ndarray
    end: float


def _cut_open(form: PipeForm, chosen: np.ndarray) -> _Seam:
    """Cut in the middle of the widest range of angles without a point, or anywhere with both sides overlapping."""
    inside = np.sort(np.unique(np.round(form.angle[chosen], 3)))
    gaps = np.diff(np.append(inside, inside[0] + 2 * np.pi))
    widest = int(np.argmax(gaps))
    cut = float(inside[widest] + 0.5 * gaps[widest])
    angle = np.mod(form.angle[chosen] - cut, 2 * np.pi)
    if gaps[widest] > _OPEN:
        return _Seam(cut, chosen, angle, 2 * np.pi)
    first, last = angle < _OVERLAP, angle > 2 * np.pi - _OVERLAP
    points = np.concatenate([chosen, chosen[first], chosen[last]])
    angle = np.concatenate([angle, angle[first] + 2 * np.pi, angle[last] - 2 * np.pi])
    return _Seam(cut, points, angle, 2 * np.pi)


def _unrolled(cloud: PointCloud, form: PipeForm, seam: _Seam) -> UnrolledSurface:
    """The surface of the points of a seam."""
    angle = form.angle[seam.points] - seam.cut
    # The form may have moved a little since it was cut open.
    angle = angle + 2 * np.pi * np.round((seam.angle - angle) / (2 * np.pi))
    errors = normal_errors(cloud, seam.points, form.outwards[seam.points])
    heights = form.distance_mm[seam.points]
    spread = max(MAD_TO_STD * float(np.median(np.abs(heights - np.median(heights)))), 1e-9)
    std = errors.single_mm if np.all(errors.single_mm > 0) else np.full(len(heights), spread)
    axis = np.broadcast_to(form.axes[2], (len(seam.points), 3))
    tangents = np.stack([axis, np.cross(axis, form.outwards[seam.points])], axis=1)
    places = np.column_stack([form.along_mm[seam.points], form.radius_mm * angle])
    return UnrolledSurface(places, heights, std, *footprint_on(cloud, seam.points, tangents))


def _blemish_features(
    cloud: PointCloud,
    form: PipeForm,
    surface: UnrolledSurface,
    search: BlemishSearch,
    seam: _Seam,
    wall_mm: float | None,
) -> list[Feature]:
    chosen = seam.points
    errors = normal_errors(cloud, chosen, form.outwards[chosen])
    measured: list[tuple[Blemish, float]] = []
    for indication in search.indications:
        blemish = measure_blemish(surface, search, indication, errors, diameter_mm=2 * form.radius_mm, wall_mm=wall_mm)
        if blemish is not None and 0 <= blemish.place[1] / form.radius_mm < seam.end:
            measured.append((blemish, indication.false_alarm))
    measured.sort(key=lambda each: each[0].extent_mm[2], reverse=True)
    features, numbers = [], dict.fromkeys(FeatureKind, 0)
    for blemish, chance in measured:
        numbers[blemish.kind] += 1
        angle = np.array([blemish.place[1] / form.radius_mm + seam.cut])
        place = form.at(blemish.place[:1], angle)[0]
        out = np.cos(angle) * form.axes[0] + np.sin(angle) * form.axes[1]
        axes = np.array([form.axes[2], np.cross(out, form.axes[2]), out])
        name = f"{blemish.kind} {numbers[blemish.kind]}"
        points = np.unique(chosen[blemish.points])
        features.append(Feature(blemish.kind, name, blemish.values, place, axes, blemish.extent_mm, points, chance))
    return features


def _notes(cloud: PointCloud, form: PipeForm, search: BlemishSearch, false_alarm: float) -> tuple[str, ...]:
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
        f"from less; the probability of any false one is {false_alarm:g}"
    )
    return tuple(notes)
