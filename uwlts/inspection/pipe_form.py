"""Form of a pipe: axis, diameter, ovality and bow by robust least squares of the radial distances of its points."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from uwlts.errors import EvaluationError
from uwlts.fitting.least_squares import evenly_thinned, fit_biweight, fit_robustly
from uwlts.fitting.propagation import PointErrors, neighbours_in_order
from uwlts.fitting.shapes import CylinderFit, fit_cylinder
from uwlts.inspection.features import Feature, FeatureKind, FeatureValue, amplitude_value, plain_value
from uwlts.storage.cloud import PointCloud

_TO_START = 6000
"""Points for the first cylinder; more add nothing to a start."""
_MOST_POINTS = 150_000
"""Points for the form; with more what remains is common to all of them."""
_ROUNDS = 12
"""Rounds of the axis at most; each divides its error by some ten."""
_STILL_MM = 1e-6
"""Move of the axis that ends the rounds."""
_SECTORS = 72
"""Sectors of 5 deg, as of a pipe standard (`uwlts.evaluation.artefact_figures`)."""
_LEAST_ARC = np.pi
"""Arc from which the ovality is known: of less a shift of the axis passes for it."""
LARGEST_OVALITY = 0.02
"""Of the diameter: the largest out of roundness that a pipe may have where it cannot be seen, unless the pipe's own
specification is given. A choice: pipes bent in the yard or dented by handling are less round than new line pipe."""
_WHOLE_ARC = np.radians(300.0)
"""Arc from which the third and fourth harmonics are fitted too, so that they do not pass for others."""
_FEWEST_OF_SECTION = 60
"""Points of a section."""
_LEAST_SHARE = 0.8
"""Part of the whole pipe's arc (up to half of its circumference) that a section shows."""
_MOST_SECTIONS = 12
MOST_OFF_SHARE = 0.06
"""Of the radius: the deepest blemish or ovality that still counts as the pipe's surface."""


@dataclass(frozen=True, eq=False)
class PipeFrame:
    """Cylindrical frame of a pipe: a point (3,) of the axis, and two directions across and the axis as rows (3, 3).

    Places along count from the point, angles from the first direction towards the second. Only `PipeFrame.about` and
    `PipeFrame.moved` make one; the second keeps the directions across, so that places and angles stay comparable.
    """

    point_mm: np.ndarray
    axes: np.ndarray

    @classmethod
    def about(cls, cylinder: CylinderFit, points_mm: np.ndarray) -> PipeFrame:
        """Frame of a cylinder, with its point in the middle of points (N, 3)."""
        point, axis = cylinder.point_mm, cylinder.axis
        return cls(point + axis * np.median((points_mm - point) @ axis), np.array([*cylinder.across, axis]))

    def moved(self, shift: np.ndarray, slopes: np.ndarray) -> PipeFrame:
        """The frame shifted (2,), mm, and its axis turned by slopes (2,), both along the directions across."""
        across = self.axes[:2]
        third = self.axes[2] + slopes @ across
        third = third / np.linalg.norm(third)
        first = across[0] - (across[0] @ third) * third
        first = first / np.linalg.norm(first)
        return PipeFrame(self.point_mm + shift @ across, np.array([first, np.cross(third, first), third]))

    def places(self, points_mm: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Places (N,) along and angles around the axis of points (N, 3), and their distances from it."""
        x, y, along = ((points_mm - self.point_mm) @ self.axes.T).T
        return along, np.arctan2(y, x), np.hypot(x, y)

    def outwards(self, angle: np.ndarray) -> np.ndarray:
        """Unit normals (N, 3) of a round pipe at angles (N,)."""
        return np.cos(angle)[:, None] * self.axes[0] + np.sin(angle)[:, None] * self.axes[1]


@dataclass(frozen=True, eq=False)
class PipeForm:
    """The undamaged pipe.

    ``along_mm``, ``angle``, ``distance_mm`` (N,) are places of all points in its ``frame``, and their distances from
    the form, positive outwards. ``used`` (U,) are the points
    that determine it, ``weights`` (K, U) those of the points in its ``coefficients`` (K,)
    called ``terms``; places along the axis count in units of ``scale_mm``. ``largest_ovality`` is that, over the
    diameter, which it may have where it was not seen.
    """

    frame: PipeFrame
    radius_mm: float
    along_mm: np.ndarray
    angle: np.ndarray
    distance_mm: np.ndarray
    used: np.ndarray
    arc: float
    terms: tuple[str, ...]
    coefficients: np.ndarray
    weights: np.ndarray
    scale_mm: float
    largest_ovality: float

    @property
    def outwards(self) -> np.ndarray:
        """Unit normals (N, 3) of the round pipe at the points."""
        return self.frame.outwards(self.angle)

    def at(self, along_mm: np.ndarray, angle: np.ndarray) -> np.ndarray:
        """Points (M, 3) of the form."""
        radius = self.radius_mm + _design(along_mm, angle, self.scale_mm, self.terms) @ self.coefficients
        along = np.asarray(along_mm)[:, None] * self.frame.axes[2]
        return self.frame.point_mm + along + radius[:, None] * self.frame.outwards(angle)

    @property
    def is_seen_round(self) -> bool:
        """Whether enough of the circumference was seen for the ovality."""
        return self.arc >= _LEAST_ARC


def fit_pipe(cloud: PointCloud, *, largest_ovality: float = LARGEST_OVALITY) -> PipeForm:
    """Form of the pipe that most points of a cloud lie on.

    A cylinder by orthogonal distances, then harmonics of the radial distance around (out of roundness) and along (bow,
    taper), all at once by iterated weights (Tukey's biweight). EvaluationError where the points determine no pipe.
    """
    fitted = evenly_thinned(np.arange(len(cloud)), _MOST_POINTS)
    points = cloud.points_mm[fitted]
    start = fit_robustly(fit_cylinder, evenly_thinned(points, _TO_START)).fit
    return _fitted(cloud, fitted, PipeFrame.about(start, points), start.radius_mm, largest_ovality)


def refit_pipe(cloud: PointCloud, form: PipeForm, *, left_out: np.ndarray) -> PipeForm:
    """The form fitted again without damaged points ``left_out`` (N,) bool, in the frame that it has, moved a little.

    EvaluationError where the points that are left determine no pipe.
    """
    fitted = evenly_thinned(np.flatnonzero(~left_out), _MOST_POINTS)
    return _fitted(cloud, fitted, form.frame, form.radius_mm, form.largest_ovality)


def _fitted(cloud: PointCloud, fitted: np.ndarray, frame: PipeFrame, radius: float, largest_ovality: float) -> PipeForm:
    """Form of the ``fitted`` (M,) points, from a frame and a radius that are nearly right."""
    if len(fitted) < _FEWEST_OF_SECTION:
        raise EvaluationError(f"only {len(fitted)} of {len(cloud)} points are left for a pipe")
    points = cloud.points_mm[fitted]
    scale = max(0.5 * float(np.ptp(frame.places(points)[0])), 1e-9)
    arc, moved, off, terms = 0.0, np.inf, np.zeros(0), ()
    coefficients, weight, design, rows = np.zeros(0), np.zeros(0), np.zeros((0, 0)), np.zeros((0, 0))
    for number in range(_ROUNDS):
        along, angle, away = frame.places(points)
        off = away - radius
        near = np.abs(off - np.median(off)) < MOST_OFF_SHARE * radius
        arc = _arc(angle[near])
        terms = _terms(arc)
        design = _design(along, angle, scale, terms)
        rows, weight = fit_biweight(design, off, near)
        coefficients = rows @ off
        known = dict(zip(terms, coefficients, strict=True))
        # Offset and tilt go into the axis, so that the distances stay linear in them.
        shift = np.array([known["cos"], known["sin"]])
        slopes = np.array([known["along cos"], known["along sin"]]) / scale
        frame, radius = frame.moved(shift, slopes), radius + known["1"]
        moved = float(np.linalg.norm(shift) + abs(known["1"]) + scale * np.linalg.norm(slopes))
        if number and moved < _STILL_MM:
            break
    counted = weight > 0
    if np.count_nonzero(counted) < 3 * len(terms):
        raise EvaluationError(f"only {np.count_nonzero(counted)} of {len(cloud)} points lie on one pipe")
    scatter = float(np.std((off - design @ coefficients)[counted]))
    if moved > scatter / np.sqrt(np.count_nonzero(counted)):
        raise EvaluationError(
            f"the pipe's axis does not settle: after {_ROUNDS} rounds it still moves by {moved:.2g} mm, more than a "
            "mean of all points scatters. Leave out points beside the pipe"
        )
    # What moved into the axis is no part of the form any more.
    inside = np.array([term in ("1", "cos", "sin", "along cos", "along sin") for term in terms])
    coefficients = np.where(inside, 0.0, coefficients)
    along, angle, away = frame.places(cloud.points_mm)
    distance = away - radius - _design(along, angle, scale, terms) @ coefficients
    used = fitted[counted]
    known = frame, radius, along, angle, distance, used, arc, terms, coefficients, rows[:, counted], scale
    return PipeForm(*known, largest_ovality)


def pipe_features(
    cloud: PointCloud, form: PipeForm, *, section_mm: float | None = None
) -> tuple[list[Feature], list[str]]:
    """The pipe and its sections, each ``section_mm`` long, with uncertainty; and notes on sections that are left out.

    Without a ``section_mm`` the length is divided into up to twelve sections of at least 60 points.
    """
    used = form.used
    errors = PointErrors.along(cloud, used, form.outwards[used])
    whole = _values(form, errors)
    extent = np.array([2 * form.radius_mm, 2 * form.radius_mm, np.ptp(form.along_mm[used])])
    features = [Feature(FeatureKind.PIPE, "pipe", whole, form.frame.point_mm, form.frame.axes, extent, used)]
    along = form.along_mm[used]
    low, length = float(along.min()), float(np.ptp(along))
    if section_mm is not None and not 0 < section_mm < np.inf:
        raise EvaluationError(f"section_mm is {section_mm:g}; expected a positive length in mm")
    count = max(1, int(length / section_mm)) if section_mm else _MOST_SECTIONS
    edges = low + length * np.arange(count + 1) / count
    terms = _section_terms(form)
    raw = form.distance_mm + _design(form.along_mm, form.angle, form.scale_mm, form.terms) @ form.coefficients
    notes: list[str] = []
    for start, end in pairwise(edges):
        inside = (along >= start) & ((along < end) | (end == edges[-1]))
        own = used[inside]
        arc, least = _arc(form.angle[own]), _LEAST_SHARE * min(form.arc, _LEAST_ARC)
        if len(own) < _FEWEST_OF_SECTION or arc < least:
            notes.append(
                f"no section from {start:.4g} to {end:.4g} mm along the axis: {len(own)} points over "
                f"{np.degrees(arc):.0f} deg; {_FEWEST_OF_SECTION} over {np.degrees(least):.0f} deg are needed"
            )
            continue
        design = _design(np.zeros(len(own)), form.angle[own], 1.0, terms)
        weights = np.linalg.pinv(design, rcond=1e-6)
        coefficients = weights @ raw[own]
        middle = form.frame.point_mm + 0.5 * (start + end) * form.frame.axes[2]
        if "sin" in terms:
            middle = middle + coefficients[1] * form.frame.axes[0] + coefficients[2] * form.frame.axes[1]
        if "sin" in terms:
            left = raw[own] - design @ coefficients
            values = _section_values(form, errors[inside], weights, coefficients, terms, left)
        else:
            values = (_diameter_of_arc(form, errors, inside, weights[0], float(coefficients[0])),)
        size = np.array([extent[0], extent[1], end - start])
        name = f"section {len(features)}"
        features.append(Feature(FeatureKind.SECTION, name, values, middle, form.frame.axes, size, own))
    return features, notes


def _values(form: PipeForm, errors: PointErrors) -> tuple[FeatureValue, ...]:
    kind, used, coefficients, diameter = FeatureKind.PIPE, form.used, form.coefficients, 2 * form.radius_mm
    random, common = errors.covariances(form.weights, form.distance_mm[used], _groups(form, used))
    if not form.is_seen_round:
        by_ovality = form.weights @ _unseen_ovality(form, used)
        common = by_ovality @ by_ovality.T + (0.0 if common is None else common)
    place = {term: k for k, term in enumerate(form.terms)}

    def covariances(*terms: str, scale: float = 1.0) -> tuple[np.ndarray, np.ndarray | None]:
        at = [place[term] for term in terms]
        part = scale**2 * random[np.ix_(at, at)]
        return part, None if common is None else scale**2 * common[np.ix_(at, at)]

    def plain(name: str, value: float, term: str, scale: float) -> FeatureValue:
        by_noise, by_common = covariances(term, scale=scale)
        shared = None if by_common is None else float(np.sqrt(by_common[0, 0]))
        return plain_value(kind, name, value, float(np.sqrt(by_noise[0, 0])), shared)

    values = [plain("diameter", diameter, "1", 2.0)]
    if "cos 2" in place:
        vector = coefficients[[place["cos 2"], place["sin 2"]]]
        two = covariances("cos 2", "sin 2")
        # The diameter varies by four amplitudes of the second harmonic of the radius.
        values.append(amplitude_value(kind, "ovality", vector, *two, scale=4.0))
        values.append(amplitude_value(kind, "ovality share", vector, *two, scale=400.0 / diameter))
    length, scale = float(np.ptp(form.along_mm[used])), form.scale_mm
    vector = coefficients[[place["along2 cos"], place["along2 sin"]]]
    # A parabola a (x / scale)^2 over a length has the sagitta a (length / 2 / scale)^2.
    values.append(
        amplitude_value(
            kind, "straightness", vector, *covariances("along2 cos", "along2 sin"), scale=(0.5 * length / scale) ** 2
        )
    )
    stated = int(np.argmax(np.abs(form.frame.axes[2])))
    for number, term in ((1, "cos"), (2, "sin")):
        across = form.frame.axes[number - 1]
        values.append(plain(f"axis place {number}", float(across @ form.frame.point_mm), term, 1.0))
        slope = float(np.degrees(np.arctan2(form.frame.axes[2] @ _level(across, stated), form.frame.axes[2, stated])))
        values.append(plain(f"axis slope {number}", slope, f"along {term}", float(np.degrees(1 / scale))))
    return tuple(values)


def _level(across: np.ndarray, stated: int) -> np.ndarray:
    """The part of a direction square to a coordinate axis, of unit length."""
    level = across.copy()
    level[stated] = 0.0
    return level / max(float(np.linalg.norm(level)), 1e-12)


def _section_values(
    form: PipeForm,
    errors: PointErrors,
    weights: np.ndarray,
    coefficients: np.ndarray,
    terms: tuple[str, ...],
    left: np.ndarray,
) -> tuple[FeatureValue, ...]:
    kind = FeatureKind.SECTION
    random, common = errors.covariances(weights, left, neighbours_in_order(len(left)))
    shared = None if common is None else 2 * float(np.sqrt(common[0, 0]))
    diameter = 2 * (form.radius_mm + coefficients[0])
    values = [plain_value(kind, "diameter", float(diameter), 2 * float(np.sqrt(random[0, 0])), shared)]
    if "cos 2" in terms:
        at = [terms.index("cos 2"), terms.index("sin 2")]
        two = random[np.ix_(at, at)], None if common is None else common[np.ix_(at, at)]
        vector = coefficients[at]
        values.append(amplitude_value(kind, "ovality", vector, *two, scale=4.0))
        size = max(float(np.linalg.norm(vector)), 1e-12)
        side = np.array([-vector[1], vector[0]]) / size**2 / 2
        stds = [None if each is None else float(np.degrees(np.sqrt(side @ each @ side))) for each in two]
        angle = 0.5 * float(np.degrees(np.arctan2(vector[1], vector[0])))
        values.append(plain_value(kind, "ovality angle", angle, stds[0] or 0.0, stds[1]))
    return tuple(values)


def _diameter_of_arc(
    form: PipeForm, errors: PointErrors, inside: np.ndarray, weights: np.ndarray, off: float
) -> FeatureValue:
    """Diameter of a section of which an arc was seen, whose middle is where the whole pipe's axis puts it.

    Of the points used (U,) those ``inside`` (U,) bool are the section's, with ``weights`` (K,) in its distance ``off``
    from the pipe.
    """
    moved = [form.terms.index(term) for term in ("cos", "sin", "along cos", "along sin")]
    own = form.used[inside]
    by_axis = weights @ _design(form.along_mm[own], form.angle[own], form.scale_mm, form.terms)[:, moved]
    whole = -by_axis @ form.weights[moved]
    whole[inside] += weights
    random, common = errors.covariances(whole[None], form.distance_mm[form.used], _groups(form, form.used))
    by_ovality = whole @ _unseen_ovality(form, form.used)
    variance = float(by_ovality @ by_ovality) + (0.0 if common is None else float(common[0, 0]))
    std = 2 * float(np.sqrt(random[0, 0])), 2 * float(np.sqrt(variance))
    return plain_value(FeatureKind.SECTION, "diameter", 2 * (form.radius_mm + off), *std)


def _unseen_ovality(form: PipeForm, points: np.ndarray) -> np.ndarray:
    """How the radii of points (N, 2) move by one standard deviation of each part of an ovality that was not seen.

    Up to the largest one all are as likely, and all directions (JCGM 100:2008, 4.3.7).
    """
    # A fourth of the ovality is the amplitude; its square has a third of the largest one's, in each part half of it.
    std = 2 * form.radius_mm * form.largest_ovality / 4 / np.sqrt(6.0)
    return std * np.column_stack([np.cos(2 * form.angle[points]), np.sin(2 * form.angle[points])])


def _groups(form: PipeForm, used: np.ndarray) -> np.ndarray:
    """Neighbourhoods (K,): sectors of 5 deg by twelfths of the length."""
    along = form.along_mm[used]
    row = np.floor((along - along.min()) / max(float(np.ptp(along)), 1e-9) * 11.999).astype(np.int64)
    sector = np.floor((form.angle[used] + np.pi) / (2 * np.pi) * (_SECTORS - 1e-6)).astype(np.int64)
    return row * _SECTORS + sector


def _terms(arc: float) -> tuple[str, ...]:
    terms = ["1", "cos", "sin", "along", "along cos", "along sin", "along2 cos", "along2 sin"]
    if arc >= _LEAST_ARC:
        terms += ["cos 2", "sin 2"]
    if arc >= _WHOLE_ARC:
        terms += ["cos 3", "sin 3", "cos 4", "sin 4"]
    return tuple(terms)


def _section_terms(form: PipeForm) -> tuple[str, ...]:
    return ("1", "cos", "sin", "cos 2", "sin 2") if form.is_seen_round else ("1",)


def _design(along_mm: np.ndarray, angle: np.ndarray, scale: float, terms: tuple[str, ...]) -> np.ndarray:
    """Derivatives (N, K) of the radial distance by the terms' coefficients, with places along in units of a scale."""
    t = np.asarray(along_mm) / scale
    columns = []
    for term in terms:
        words = term.split(" ")
        power = {"along": t, "along2": t * t}.get(words[0], 1.0)
        words = [word for word in words if not word.startswith("along")]
        order = int(words[1]) if len(words) > 1 else 1
        match words[:1]:
            case ["cos"]:
                columns.append(power * np.cos(order * angle))
            case ["sin"]:
                columns.append(power * np.sin(order * angle))
            case _:
                columns.append(np.broadcast_to(power, np.shape(angle)))
    return np.stack(columns, axis=1)


def _arc(angle: np.ndarray) -> float:
    """Seen part of the circumference in rad, by sectors of 5 deg."""
    sector = np.floor((angle + np.pi) / (2 * np.pi) * (_SECTORS - 1e-6)).astype(int)
    return float(np.count_nonzero(np.bincount(sector, minlength=_SECTORS)) * 2 * np.pi / _SECTORS)
