"""Form of a pipe: axis, diameter, ovality and bow by robust least squares of the radial distances of its points."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from uwlts.errors import EvaluationError
from uwlts.fitting.least_squares import fit_biweight, fit_robustly, thin_evenly
from uwlts.fitting.propagation import PointErrors, group_neighbours
from uwlts.inspection.features import Feature, FeatureKind, FeatureValue, amplitude_value, linear_value
from uwlts.shapes.cylinder import Cylinder
from uwlts.storage.cloud import PointCloud

LARGEST_OVALITY = 0.02
"""Largest ovality of a pipe without a specification, as a fraction of its diameter, if the cloud does not show it.

A choice: pipes bent in the yard or dented by handling are less round than new line pipe.
"""


@dataclass(frozen=True, kw_only=True)
class PipeFormRule:
    """Numbers of the fit of a pipe's form."""

    start_points: int = 6000  # points for the first cylinder; more points would not change this start
    most_points: int = 150_000  # most points of the fit; with more points the errors common to all of them dominate
    rounds: int = 12  # most rounds of the fit; each divides the error of the axis by about ten
    still_mm: float = 1e-6  # change of the axis, mm, that ends the rounds
    largest_step: float = 1.0  # change of the axis's slope in a round that shows that the fit diverges
    sectors: int = 72
    """Sectors around the pipe: 5 deg each, as for a pipe standard (`uwlts.evaluation.artefact_figures`)."""
    lengths: int = 12  # parts of the length within which errors of neighbouring points are correlated
    oval_arc: float = np.pi
    """Least arc, rad, that determines the ovality; on a smaller arc it is not separable from a shift of the axis."""
    whole_arc: float = np.radians(300.0)
    """Least arc, rad, for a fit of the third and fourth harmonics, which would bias the others."""
    section_points: int = 60  # fewest points of a section
    section_arc: float = 0.8
    """Least arc of a section, as a fraction of the whole pipe's arc (at most half of the circumference)."""
    sections: int = 12  # of the whole pipe
    off_pipe: float = 0.06
    """Distance from the pipe, as a fraction of its radius, of the deepest blemish or largest ovality that still
    counts as its surface."""


FORM_RULE = PipeFormRule()

_ROUND_TERMS = "1", "cos", "sin", "cos 2", "sin 2"  # terms of the radial distance in a section
_AT_A_TIME = 250_000  # points whose terms are evaluated together, limited by memory


@dataclass(frozen=True, eq=False)
class PipeFrame:
    """Cylindrical frame of a pipe.

    Places along count from `point_mm`, angles from the first direction across towards the second. `shift_and_tilt`
    keeps the directions across, so that places and angles of successive fits are comparable.
    """

    point_mm: np.ndarray  # (3,); point on the axis
    axes: np.ndarray  # (3, 3); unit vectors in rows: two directions across, and the axis

    def shift_and_tilt(self, shift: np.ndarray, slopes: np.ndarray) -> PipeFrame:
        """Return the frame shifted by (2,) mm, with its axis tilted by slopes (2,), along the directions across."""
        across = self.axes[:2]
        third = self.axes[2] + slopes @ across
        third = third / np.linalg.norm(third)
        first = across[0] - (across[0] @ third) * third
        first = first / np.linalg.norm(first)
        return PipeFrame(self.point_mm + shift @ across, np.array([first, np.cross(third, first), third]))

    def cylindrical(self, points_mm: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return places (N,) along and angles around the axis, and distances from it, of points (N, 3)."""
        x, y, along = ((points_mm - self.point_mm) @ self.axes.T).T
        return along, np.arctan2(y, x), np.hypot(x, y)

    def normals_at(self, angle: np.ndarray) -> np.ndarray:
        """Return unit normals (N, 3) of a round pipe at angles (N,)."""
        return np.cos(angle)[:, None] * self.axes[0] + np.sin(angle)[:, None] * self.axes[1]


@dataclass(frozen=True, eq=False)
class PipeForm:
    """Undamaged form of a pipe in a cloud of N points."""

    frame: PipeFrame
    radius_mm: float  # mean radius
    # (N,); place along the axis and angle, rad, of all points.
    along_mm: np.ndarray
    angle: np.ndarray
    distance_mm: np.ndarray  # (N,); distance of all points from the form, positive outwards
    used: np.ndarray  # (U,) int; points that determine the form
    arc: float  # part of the circumference, rad, that these points cover
    terms: tuple[str, ...]  # names of the K terms of the radial distance
    coefficients: np.ndarray  # (K,); coefficients of the terms, mm
    weights: np.ndarray  # (K, U); derivatives of the coefficients by the radial distances of the points
    scale_mm: float  # unit of places along the axis in the terms
    largest_ovality: float
    """Assumed largest ovality divided by the diameter, if the points do not determine the ovality."""

    @property
    def outwards(self) -> np.ndarray:
        """Unit normals (N, 3) of the round pipe at the points."""
        return self.frame.normals_at(self.angle)

    def points_at(self, along_mm: np.ndarray, angle: np.ndarray) -> np.ndarray:
        """Return points (M, 3) of the form at places and angles (M,)."""
        radius = self.radius_mm + _evaluate_terms(along_mm, angle, self.scale_mm, self.terms, self.coefficients)
        along = np.asarray(along_mm)[:, None] * self.frame.axes[2]
        return self.frame.point_mm + along + radius[:, None] * self.frame.normals_at(angle)

    @property
    def is_seen_round(self) -> bool:
        """True if the points determine the ovality."""
        return self.arc >= FORM_RULE.oval_arc


def fit_pipe(cloud: PointCloud, *, largest_ovality: float = LARGEST_OVALITY, start: Cylinder | None = None) -> PipeForm:
    """Fit the form of the pipe that contains most points of a cloud.

    A cylinder is fitted by orthogonal distances, unless a ``start`` is given. Then harmonics of the radial distance
    around the pipe (out of roundness) and along it (bow, taper) are fitted together with Tukey's biweight.
    EvaluationError if the points determine no pipe.
    """
    fitted = thin_evenly(np.arange(len(cloud)), FORM_RULE.most_points)
    points = cloud.points_mm[fitted]
    start = start or fit_robustly(Cylinder.fit, thin_evenly(points, FORM_RULE.start_points)).fit
    point, axis = start.point_mm, start.axis
    # The frame's point is in the middle of the points.
    frame = PipeFrame(point + axis * np.median((points - point) @ axis), np.array([*start.across, axis]))
    return _fit_from(cloud, fitted, frame, start.radius_mm, largest_ovality)


def refit_pipe(cloud: PointCloud, form: PipeForm, *, left_out: np.ndarray) -> PipeForm:
    """Fit the form again without the damaged points ``left_out`` (N,) bool.

    The frame is only shifted and tilted. EvaluationError if the other points determine no pipe.
    """
    fitted = thin_evenly(np.flatnonzero(~left_out), FORM_RULE.most_points)
    return _fit_from(cloud, fitted, form.frame, form.radius_mm, form.largest_ovality)


def _fit_from(
    cloud: PointCloud, fitted: np.ndarray, frame: PipeFrame, radius: float, largest_ovality: float
) -> PipeForm:
    """Fit the form to the ``fitted`` (M,) points, starting from an approximate frame and radius."""
    if len(fitted) < FORM_RULE.section_points:
        raise EvaluationError(
            f"only {len(fitted)} of {len(cloud)} points are undamaged; {FORM_RULE.section_points} are needed for a pipe"
        )
    points = cloud.points_mm[fitted]
    scale = max(0.5 * float(np.ptp(frame.cylindrical(points)[0])), 1e-9)
    arc, moved, off, terms = 0.0, np.inf, np.zeros(0), ()
    coefficients, weight, design, rows = np.zeros(0), np.zeros(0), np.zeros((0, 0)), np.zeros((0, 0))
    for number in range(FORM_RULE.rounds):
        along, angle, height = frame.cylindrical(points)
        off = height - radius
        near = np.abs(off - np.median(off)) < FORM_RULE.off_pipe * radius
        arc = _measure_arc(angle[near])
        terms = _list_terms(arc)
        design = _make_design(along, angle, scale, terms)
        rows, weight = fit_biweight(design, off, near)
        coefficients = rows @ off
        known = dict(zip(terms, coefficients, strict=True))
        # Shift and tilt update the frame, so that the distances remain linear in them.
        shift = np.array([known["cos"], known["sin"]])
        slopes = np.array([known["along cos"], known["along sin"]]) / scale
        frame, radius = frame.shift_and_tilt(shift, slopes), radius + known["1"]
        moved = float(np.linalg.norm(shift) + abs(known["1"]) + scale * np.linalg.norm(slopes))
        if not (radius > 0 and np.linalg.norm(slopes) < FORM_RULE.largest_step):
            raise EvaluationError(
                "the points do not agree with one straight pipe: the fit of its axis diverges. Inspect a straight, "
                "bare part of a pipe, with points closer together than a tenth of its radius"
            )
        if number and moved < FORM_RULE.still_mm:
            break
    counted = weight > 0
    if np.count_nonzero(counted) < 3 * len(terms):
        raise EvaluationError(
            f"only {np.count_nonzero(counted)} of {len(cloud)} points agree with one pipe; {3 * len(terms)} are needed"
        )
    scatter = float(np.std((off - design @ coefficients)[counted]))
    if moved > scatter / np.sqrt(np.count_nonzero(counted)):
        raise EvaluationError(
            f"the fit of the pipe's axis does not converge: after {FORM_RULE.rounds} rounds it still changes by "
            f"{moved:.2g} mm, more than its standard deviation. Remove points that belong to no straight pipe, "
            "such as a bend or a branch"
        )
    # These terms are now part of the frame and the radius.
    inside = np.array([term in ("1", "cos", "sin", "along cos", "along sin") for term in terms])
    coefficients = np.where(inside, 0.0, coefficients)
    along, angle, height = frame.cylindrical(cloud.points_mm)
    distance = height - radius - _evaluate_terms(along, angle, scale, terms, coefficients)
    used = fitted[counted]
    known = frame, radius, along, angle, distance, used, arc, terms, coefficients, rows[:, counted], scale
    return PipeForm(*known, largest_ovality)


def pipe_features(cloud: PointCloud, form: PipeForm) -> tuple[list[Feature], list[str]]:
    """Return the pipe and its twelve sections with uncertainty, and notes on those with fewer than 60 points."""
    used = form.used
    errors = PointErrors.along_normals(cloud, used, form.frame.normals_at(form.angle[used]))
    whole = _make_whole_values(form, errors)
    extent = np.array([2 * form.radius_mm, 2 * form.radius_mm, np.ptp(form.along_mm[used])])
    features = [Feature(FeatureKind.PIPE, "pipe", whole, form.frame.point_mm, form.frame.axes, extent, used)]
    along = form.along_mm[used]
    low, length = float(along.min()), float(np.ptp(along))
    edges = low + length * np.arange(FORM_RULE.sections + 1) / FORM_RULE.sections
    terms = _ROUND_TERMS if form.is_seen_round else ("1",)
    raw = form.distance_mm + _evaluate_terms(form.along_mm, form.angle, form.scale_mm, form.terms, form.coefficients)
    notes: list[str] = []
    for start, end in pairwise(edges):
        inside = (along >= start) & ((along < end) | (end == edges[-1]))
        members = used[inside]
        arc, least = _measure_arc(form.angle[members]), FORM_RULE.section_arc * min(form.arc, FORM_RULE.oval_arc)
        if len(members) < FORM_RULE.section_points or arc < least:
            notes.append(
                f"no section from {start:.4g} to {end:.4g} mm along the axis: {len(members)} points over "
                f"{np.degrees(arc):.0f} deg; {FORM_RULE.section_points} over {np.degrees(least):.0f} deg are needed"
            )
            continue
        design = _make_design(np.zeros(len(members)), form.angle[members], 1.0, terms)
        weights = np.linalg.pinv(design, rcond=1e-6)
        coefficients = weights @ raw[members]
        middle = form.frame.point_mm + 0.5 * (start + end) * form.frame.axes[2]
        if form.is_seen_round:
            middle = middle + coefficients[1] * form.frame.axes[0] + coefficients[2] * form.frame.axes[1]
            left = raw[members] - design @ coefficients
            values = _make_section_values(form, errors[inside], weights, coefficients, left)
        else:
            values = (_measure_arc_diameter(form, errors, inside, weights[0], float(coefficients[0])),)
        size = np.array([extent[0], extent[1], end - start])
        name = f"section {len(features)}"
        features.append(Feature(FeatureKind.SECTION, name, values, middle, form.frame.axes, size, members))
    return features, notes


def _make_whole_values(form: PipeForm, errors: PointErrors) -> tuple[FeatureValue, ...]:
    kind, used, coefficients, diameter = FeatureKind.PIPE, form.used, form.coefficients, 2 * form.radius_mm
    random, common = errors.covariances(form.weights, form.distance_mm[used], _number_sectors(form, used))
    if not form.is_seen_round:
        by_ovality = form.weights @ _bound_unseen_ovality(form, used)
        common = by_ovality @ by_ovality.T + (0.0 if common is None else common)

    def plain(name: str, value: float, term: str, scale: float) -> FeatureValue:
        return linear_value(kind, name, value, (random, common), scale * (np.array(form.terms) == term))

    def amplitude(name: str, terms: str, scale: float) -> FeatureValue:
        at = [form.terms.index(terms.format(each)) for each in ("cos", "sin")]
        return amplitude_value(kind, name, coefficients[at], *_select_covariance(at, random, common), scale=scale)

    values = [plain("diameter", diameter, "1", 2.0)]
    if form.is_seen_round:
        # The diameter varies by four amplitudes of the second harmonic of the radius.
        values.append(amplitude("ovality", "{} 2", 4.0))
        values.append(amplitude("ovality share", "{} 2", 400.0 / diameter))
    length, scale = float(np.ptp(form.along_mm[used])), form.scale_mm
    # A parabola a (x / scale)^2 over a length has the sagitta a (length / 2 / scale)^2.
    values.append(amplitude("straightness", "along2 {}", (0.5 * length / scale) ** 2))
    stated = int(np.argmax(np.abs(form.frame.axes[2])))
    for number, term in ((1, "cos"), (2, "sin")):
        across = form.frame.axes[number - 1]
        values.append(plain(f"axis place {number}", float(across @ form.frame.point_mm), term, 1.0))
        # Direction perpendicular to the stated coordinate axis.
        level = np.where(np.arange(3) == stated, 0.0, across)
        level /= max(float(np.linalg.norm(level)), 1e-12)
        slope = float(np.degrees(np.arctan2(form.frame.axes[2] @ level, form.frame.axes[2, stated])))
        values.append(plain(f"axis slope {number}", slope, f"along {term}", float(np.degrees(1 / scale))))
    return tuple(values)


def _select_covariance(
    at: list[int], random: np.ndarray, common: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray | None]:
    """Return the covariances of some parameters."""
    return random[np.ix_(at, at)], None if common is None else common[np.ix_(at, at)]


def _make_section_values(
    form: PipeForm, errors: PointErrors, weights: np.ndarray, coefficients: np.ndarray, left: np.ndarray
) -> tuple[FeatureValue, ...]:
    """Return the values of a section from the coefficients (5,) of `_ROUND_TERMS`, with residuals ``left`` (K,)."""
    kind, at = FeatureKind.SECTION, [3, 4]
    known = errors.covariances(weights, left, group_neighbours(len(left)))
    diameter = float(2 * (form.radius_mm + coefficients[0]))
    vector, two = coefficients[at], _select_covariance(at, *known)
    side = np.degrees(np.array([-vector[1], vector[0]]) / max(float(np.linalg.norm(vector)), 1e-12) ** 2 / 2)
    angle = 0.5 * float(np.degrees(np.arctan2(vector[1], vector[0])))
    return (
        linear_value(kind, "diameter", diameter, known, 2 * np.eye(5)[0]),
        amplitude_value(kind, "ovality", vector, *two, scale=4.0),
        linear_value(kind, "ovality angle", angle, known, np.append(np.zeros(3), side)),
    )


def _measure_arc_diameter(
    form: PipeForm, errors: PointErrors, inside: np.ndarray, weights: np.ndarray, off: float
) -> FeatureValue:
    """Return the diameter of a section whose points do not determine its centre.

    The centre is taken from the axis of the whole pipe. Of the used points (U,), those ``inside`` (U,) bool belong to
    the section. Their ``weights`` (K,) give its mean distance ``off`` from the pipe.
    """
    moved = [form.terms.index(term) for term in ("cos", "sin", "along cos", "along sin")]
    members = form.used[inside]
    by_axis = weights @ _make_design(form.along_mm[members], form.angle[members], form.scale_mm, form.terms)[:, moved]
    whole = -by_axis @ form.weights[moved]
    whole[inside] += weights
    random, common = errors.covariances(whole[None], form.distance_mm[form.used], _number_sectors(form, form.used))
    by_ovality = whole @ _bound_unseen_ovality(form, form.used)
    common = np.array([[by_ovality @ by_ovality]]) + (0.0 if common is None else common)
    diameter = 2 * (form.radius_mm + off)
    return linear_value(FeatureKind.SECTION, "diameter", diameter, (random, common), np.array([2.0]))


def _bound_unseen_ovality(form: PipeForm, points: np.ndarray) -> np.ndarray:
    """Return the change of the radii of points (N, 2) by one standard deviation of an unknown ovality.

    The ovality is uniform up to the largest one, in any direction (JCGM 100:2008, 4.3.7).
    """
    # The amplitude is a quarter of the ovality. Its mean square is a third of the largest one's, half in each part.
    std = 2 * form.radius_mm * form.largest_ovality / 4 / np.sqrt(6.0)
    return std * np.column_stack([np.cos(2 * form.angle[points]), np.sin(2 * form.angle[points])])


def _number_sectors(form: PipeForm, used: np.ndarray) -> np.ndarray:
    """Return the neighbourhood (K,) of each point: sectors of 5 deg by twelfths of the length."""
    along = form.along_mm[used]
    row = np.floor((along - along.min()) / max(float(np.ptp(along)), 1e-9) * (FORM_RULE.lengths - 1e-3)).astype(
        np.int64
    )
    sector = np.floor((form.angle[used] + np.pi) / (2 * np.pi) * (FORM_RULE.sectors - 1e-6)).astype(np.int64)
    return row * FORM_RULE.sectors + sector


def _list_terms(arc: float) -> tuple[str, ...]:
    terms = ["1", "cos", "sin", "along", "along cos", "along sin", "along2 cos", "along2 sin"]
    if arc >= FORM_RULE.oval_arc:
        terms += ["cos 2", "sin 2"]
    if arc >= FORM_RULE.whole_arc:
        terms += ["cos 3", "sin 3", "cos 4", "sin 4"]
    return tuple(terms)


def _make_design(along_mm: np.ndarray, angle: np.ndarray, scale: float, terms: tuple[str, ...]) -> np.ndarray:
    """Return the derivatives (N, K) of the radial distance by the coefficients of the terms."""
    t = np.asarray(along_mm) / scale
    columns = []
    for term in terms:
        factors = term.split(" ")
        power = {"along": t, "along2": t * t}.get(factors[0], 1.0)
        factors = [word for word in factors if not word.startswith("along")]
        order = int(factors[1]) if len(factors) > 1 else 1
        match factors[:1]:
            case ["cos"]:
                columns.append(power * np.cos(order * angle))
            case ["sin"]:
                columns.append(power * np.sin(order * angle))
            case _:
                columns.append(np.broadcast_to(power, np.shape(angle)))
    return np.stack(columns, axis=1)


def _evaluate_terms(
    along_mm: np.ndarray, angle: np.ndarray, scale: float, terms: tuple[str, ...], coefficients: np.ndarray
) -> np.ndarray:
    """Return the sum (N,) of the terms of the radial distance; derivatives would need 112 bytes a point."""
    parts = [slice(start, start + _AT_A_TIME) for start in range(0, len(along_mm), _AT_A_TIME)]
    sums = [_make_design(along_mm[part], angle[part], scale, terms) @ coefficients for part in parts]
    return np.concatenate([np.zeros(0), *sums])


def _measure_arc(angle: np.ndarray) -> float:
    """Return the part of the circumference, rad, with points, in sectors of 5 deg."""
    sector = np.floor((angle + np.pi) / (2 * np.pi) * (FORM_RULE.sectors - 1e-6)).astype(int)
    return float(np.count_nonzero(np.bincount(sector, minlength=FORM_RULE.sectors)) * 2 * np.pi / FORM_RULE.sectors)
