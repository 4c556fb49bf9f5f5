"""Inspection of a pipe: its form, section by section, and pits, dents and protrusions on it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from uwlts.metrology.blemish_search import BlemishSearch, Surface, search_blemishes
from uwlts.metrology.blemishes import Blemish, measure_blemish
from uwlts.metrology.features import Feature, FeatureKind, Inspection
from uwlts.metrology.least_squares import MAD_TO_STD
from uwlts.metrology.pipe_form import PipeForm, fit_pipe, pipe_features
from uwlts.metrology.propagation import normal_errors
from uwlts.model.errors import EvaluationError
from uwlts.storage.cloud import PointCloud

_FEWEST = 500
"""Points from which a pipe's surface can be searched."""


def inspect_pipe(
    cloud: PointCloud, *, section_mm: float | None = None, wall_mm: float | None = None, false_alarm: float = 0.05
) -> Inspection:
    """Measure a pipe's form and find the blemishes of its outside.

    The form is a cylinder with out of roundness, bow and taper (`uwlts.metrology.pipe_form`). What departs from it
    locally is searched for at all sizes (`uwlts.metrology.blemish_search`) and measured against the surface around it
    (`uwlts.metrology.blemishes`). Uncertainties are of the points' covariance, what they share by calibration included,
    and at least those that the points' own scatter shows; of a cloud without covariance they are of the scatter alone,
    which a note says.

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
    if len(cloud) < _FEWEST:
        raise EvaluationError(f"the cloud has {len(cloud)} points; at least {_FEWEST} are needed for a pipe")
    form = fit_pipe(cloud)
    surface, chosen = _unrolled(cloud, form)
    search = search_blemishes(surface, false_alarm=false_alarm)
    if search.indications:
        # Once more without what was found, which pulls the form towards it.
        damaged = np.ones(len(cloud), bool)
        damaged[chosen[search.plain]] = False
        form = fit_pipe(cloud, left_out=damaged)
        surface = replace(surface, heights=form.distance_mm[chosen])
    features = pipe_features(cloud, form, section_mm=section_mm)
    features += _blemish_features(cloud, form, surface, search, chosen, wall_mm)
    deviation, level = np.full(len(cloud), np.nan), np.full(len(cloud), np.nan)
    deviation[chosen[~search.outliers]] = form.distance_mm[chosen[~search.outliers]]
    level[chosen] = search.level_mm
    return Inspection("pipe", tuple(features), deviation, level, _notes(cloud, form, search, false_alarm))


def _unrolled(cloud: PointCloud, form: PipeForm) -> tuple[Surface, np.ndarray]:
    """The surface about the middle of what was seen, and the indices of its points."""
    chosen = np.flatnonzero(np.abs(form.distance_mm) < 0.06 * form.radius_mm)
    # Cut where there is nothing, or opposite the middle of what was seen.
    angle = form.angle[chosen]
    cut = _gap(angle)
    around = form.radius_mm * (np.mod(angle - cut, 2 * np.pi))
    errors = normal_errors(cloud, chosen, form.outwards[chosen])
    heights = form.distance_mm[chosen]
    spread = max(MAD_TO_STD * float(np.median(np.abs(heights - np.median(heights)))), 1e-9)
    std = errors.single_mm if np.all(errors.single_mm > 0) else np.full(len(chosen), spread)
    return Surface(np.column_stack([form.along_mm[chosen], around]), heights, std), chosen


def _gap(angle: np.ndarray) -> float:
    """Middle of the widest range of angles without a point."""
    inside = np.sort(np.unique(np.round(angle, 3)))
    gaps = np.diff(np.append(inside, inside[0] + 2 * np.pi))
    widest = int(np.argmax(gaps))
    return float(inside[widest] + 0.5 * gaps[widest])


def _blemish_features(
    cloud: PointCloud,
    form: PipeForm,
    surface: Surface,
    search: BlemishSearch,
    chosen: np.ndarray,
    wall_mm: float | None,
) -> list[Feature]:
    cut = _gap(form.angle[chosen])
    errors = normal_errors(cloud, chosen, form.outwards[chosen])
    measured: list[tuple[Blemish, float]] = []
    for indication in search.indications:
        blemish = measure_blemish(surface, search, indication, errors, diameter_mm=2 * form.radius_mm, wall_mm=wall_mm)
        if blemish is not None:
            measured.append((blemish, indication.false_alarm))
    measured.sort(key=lambda each: each[0].extent_mm[2], reverse=True)
    features, numbers = [], dict.fromkeys(FeatureKind, 0)
    for blemish, chance in measured:
        numbers[blemish.kind] += 1
        angle = np.array([blemish.place[1] / form.radius_mm + cut])
        place = form.at(blemish.place[:1], angle)[0]
        out = np.cos(angle) * form.axes[0] + np.sin(angle) * form.axes[1]
        axes = np.array([form.axes[2], np.cross(out, form.axes[2]), out])
        name = f"{blemish.kind} {numbers[blemish.kind]}"
        points = chosen[blemish.points]
        features.append(Feature(blemish.kind, name, blemish.values, place, axes, blemish.extent_mm, points, chance))
    return features


def _notes(cloud: PointCloud, form: PipeForm, search: BlemishSearch, false_alarm: float) -> tuple[str, ...]:
    notes = []
    if cloud.uncertainty is None:
        notes.append("the cloud states no uncertainty: intervals are of the scatter of its points alone")
    if not form.is_seen_round:
        seen = np.degrees(form.arc)
        notes.append(
            f"{seen:.0f} deg of the circumference were seen: the ovality is not determined, and the diameter is that "
            "of this arc"
        )
    level = float(np.nanmedian(search.level_mm)) if np.isfinite(search.level_mm).any() else np.nan
    notes.append(
        f"blemishes of {2 * search.smallest_mm:.2g} mm diameter count from {level:.2g} mm depth (median), larger ones "
        f"from less; the probability of any false one is {false_alarm:g}"
    )
    return tuple(notes)
