"""Characteristics of an acceptance test: measured values, their test value uncertainty, and the decision.

The symbols PF, PS, SD and F are those of VDI/VDE 2634 part 2; names of ISO 10360-13 stand beside them. The test value
uncertainty (ISO 14253-5, ISO/TS 23165) is by the artefact: calibration, form, alignment and temperature. The error of
the sensor is what is tested, and does not contribute.

The place of an artefact is found in the cloud, its size is that of the certificate. All points in the region about it
are measurements of the artefact, wherever they lie: only the share that VDI/VDE 2634 permits is left out.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Generic, Literal, get_args

import numpy as np
from pydantic import Field
from scipy.spatial import KDTree
from scipy.special import ndtr

from uwlts.acceptance.acceptance_plan import (
    REFERENCE_C,
    AcceptancePlan,
    CertifiedArtefact,
    DecisionRule,
    Length,
    PlannedPosition,
    Size,
    Spread,
    Symbol,
    Temperature,
)
from uwlts.errors import EvaluationError
from uwlts.evaluation.artefact_figures import (
    StepEvaluation,
    evaluate_plane,
    evaluate_spheres,
    evaluate_step,
    measure_step,
)
from uwlts.evaluation.figures import TOWARDS_SENSOR, StoredResult, Verdict, judge_interval
from uwlts.fitting.least_squares import VDI_OUTLIER_SHARE, FitT, principal_axes
from uwlts.model.artefacts import PipeStandard, PlaneStandard, SphereStandard, StepStandard
from uwlts.model.sensor import UnitVector
from uwlts.shapes.flat import Plane
from uwlts.shapes.sphere import Sphere
from uwlts.shapes.step import StepFace
from uwlts.storage.cloud import PointCloud

_HEMISPHERE_DEG = 90.0
"""Largest angle between a sphere's surface normal and the direction to the sensor: all that light along Z reaches."""
_FACE_BAND = 0.25
"""Half width (unit: step height) of the region of a face: both regions and the riser between them are equally wide."""


@dataclass(frozen=True, eq=False)
class MeasuredSurface(Generic[FitT]):
    """Surface fitted by least squares to the points of its region, without those that the rule leaves out.

    All points are those of the artefact; the ``rejected`` ones are the farthest 0.3 %, rounded down.
    """

    fit: FitT
    range_mm: float  # range of the distances of the kept points from the fit
    range_95_mm: float  # width of the narrowest band about the fit that contains 95 % of all points
    points: int
    rejected: int


def measure_spheres(points: np.ndarray, standard: SphereStandard, *, margin_mm: float) -> list[MeasuredSurface[Sphere]]:
    """Fit the spheres of a standard to points (N, 3), mm, in the order of the description.

    The points of a sphere are those within the margin of its surface, and all points in front of its outline along Z,
    where nothing else is measured. Both are limited to the half space that faces the sensor, or to the standard's cap.

    EvaluationError if a sphere is missing, or more than 0.3 % of its points are farther than the margin from it.
    """
    found = evaluate_spheres(points, standard).spheres
    offsets = points[:, None] - np.array([sphere.centre_mm for sphere in found])
    distance = np.linalg.norm(offsets, axis=2)
    off = distance - np.array([sphere.diameter_mm / 2 for sphere in found])
    nearest = np.argmin(np.abs(off), axis=1)
    cap = np.radians(standard.cap_angle_deg or _HEMISPHERE_DEG)
    toward = offsets @ TOWARDS_SENSOR
    facing = toward >= np.cos(cap) * distance
    aside = np.sqrt(np.maximum(distance**2 - toward**2, 0.0))
    measured = []
    for number, sphere in enumerate(found):
        before = aside[:, number] <= np.sin(cap) * sphere.diameter_mm / 2
        members = (nearest == number) & facing[:, number] & (before | (np.abs(off[:, number]) <= margin_mm))
        name = f"sphere {number + 1}"
        measured.append(_fit_kept(Sphere.fit, points[members], off[members, number], margin_mm=margin_mm, name=name))
    return measured


def measure_plane(points: np.ndarray, standard: PlaneStandard, *, margin_mm: float) -> MeasuredSurface[Plane]:
    """Fit a plane to all points (N, 3), mm.

    EvaluationError if the points show no plane, or more than 0.3 % of them are farther than the margin from it.
    """
    found = evaluate_plane(points, standard)
    off = (points - found.point_mm) @ np.array(found.normal)
    return _fit_kept(partial(Plane.fit, towards=TOWARDS_SENSOR), points, off, margin_mm=margin_mm, name="plane")


def measure_step_height(points: np.ndarray, frame: np.ndarray, standard: StepStandard) -> StepEvaluation:
    """Measure a step by all points (N, 3), mm, within a quarter of its height from a face, apart from the edges.

    EvaluationError if the points show no two faces of this height.
    """
    found = evaluate_step(points, frame, standard)
    normal = np.array(found.normal)
    height = points @ normal
    levels = {face: float(np.median(height[found.labels == face])) for face in (StepFace.LOWER, StepFace.UPPER)}
    along = points @ np.linalg.svd(normal[None])[2][1:].T
    labels = np.zeros(len(points), dtype=np.int8)
    for face, level in levels.items():
        on_it = np.abs(height - level) <= _FACE_BAND * standard.height_mm
        members = np.flatnonzero(on_it)
        # The riser and the other face; single flyers have no edge.
        others = along[np.abs(height - levels[face.other]) <= _FACE_BAND * standard.height_mm]
        if standard.edge_mm > 0:
            near, _ = KDTree(others).query(along[members], distance_upper_bound=standard.edge_mm)
            members = members[near > standard.edge_mm]
        labels[members] = face
    return measure_step(points, frame, labels, standard)


def _fit_kept(
    fit: Callable[[np.ndarray], FitT], points: np.ndarray, off_mm: np.ndarray, *, margin_mm: float, name: str
) -> MeasuredSurface[FitT]:
    """Fit a surface to its points (N, 3), mm, without the 0.3 % with the largest distances ``off_mm`` (N,)."""
    rejected = int(VDI_OUTLIER_SHARE * len(points))
    beyond = int(np.count_nonzero(np.abs(off_mm) > margin_mm))
    if beyond > rejected:
        raise EvaluationError(
            f"{name}: {beyond} of {len(points)} points ({100 * beyond / len(points):.2g} %) are more than "
            f"{margin_mm:g} mm off; VDI/VDE 2634 permits leaving out 0.3 %. Scan again, or exclude other surfaces by "
            "`region_mm` or `cap_angle_deg`"
        )
    kept = np.argsort(np.abs(off_mm), kind="stable")[: len(points) - rejected]
    shape = fit(points[kept])
    distances = np.sort(shape.distances_mm(points))
    inside = int(np.ceil(0.95 * len(points)))
    narrowest = float(np.min(distances[inside - 1 :] - distances[: len(points) - inside + 1]))
    return MeasuredSurface(shape, float(np.ptp(shape.residuals_mm)), narrowest, len(points), rejected)


Decision = Literal["nonconformity proven", "rejected", "undecided", "no MPE", "accepted", "conformity proven"]
"""Decisions in order of severity; those of simple acceptance prove nothing."""

NAMES: dict[Symbol, tuple[str, str]] = {
    "PF": ("probing error of form, all points", "PF (VDI/VDE 2634-2)"),
    "PF95": ("probing error of form, 95 % of the points", "P Form.Sph.D95% (ISO 10360-13)"),
    "PS": ("probing error of size", "PS (VDI/VDE 2634-2), P Size.Sph.All (ISO 10360-13)"),
    "SD": ("sphere-spacing error", "SD (VDI/VDE 2634-2), D CC (ISO 10360-13)"),
    "F": ("flatness measurement error, all points", "F (VDI/VDE 2634-2)"),
    "F95": ("flatness measurement error, 95 % of the points", "D Form.Pla.D95% (ISO 10360-13)"),
    "E": ("length error of a step's height", "by analogy; neither guideline has a step"),
}
"""Name of each characteristic, and its symbols in the guidelines."""

COVERAGE_FACTOR = 2.0  # k = 2, about 95 % (ISO 14253-1)

_GUARDS: dict[DecisionRule, float] = {"U": COVERAGE_FACTOR, "1.65 u": 1.65, "simple": 0.0}
"""Guard band of each rule (unit: standard uncertainty)."""

RULES: dict[DecisionRule, str] = {
    "U": "guard band of the expanded uncertainty U, k = 2 (ISO 14253-1:2013)",
    "1.65 u": "guard band of 1.65 u, at least 95 % probability of conformity (ISO 14253-1:2017)",
    "simple": "simple acceptance: the value alone is compared with the limit, which proves nothing (ILAC-G8:09/2019)",
}
"""Text of each decision rule, with its edition."""

_DECISIONS: dict[Verdict, tuple[Decision, Decision]] = {
    "within the limit": ("conformity proven", "accepted"),
    "exceeds the limit": ("nonconformity proven", "rejected"),
    "undecided": ("undecided", "undecided"),
}
"""Decision with a guard band, and that of simple acceptance."""


class CharacteristicValue(StoredResult):
    """Measured value of a characteristic at one position.

    Attributes
    ----------
    symbol : str
        Characteristic.
    position, label : str
        Position in the plan, and what was measured there, such as "sphere 1".
    value_mm : float
        Form error, or measured minus calibrated size.
    expanded_mm : float or None
        Test value uncertainty (k = 2); None if the certificate does not state what it needs.
    place_mm : (float, float, float)
        Centre of the measured surface in the object coordinate system.
    length_mm : float or None
        Calibrated length at the temperature of the test, for spacings and steps.
    direction : (float, float, float) or None
        Direction of that length, or the normal of a plane.
    extent_mm : (float, float) or None
        Length and width of the measured part of a plane.
    """

    symbol: Symbol
    position: str
    label: str
    value_mm: Length
    expanded_mm: Spread | None
    place_mm: tuple[Length, Length, Length]
    length_mm: Size | None = None
    direction: UnitVector | None = None
    extent_mm: tuple[Spread, Spread] | None = None


class Characteristic(StoredResult):
    """Characteristic with its worst value, the maximum permissible error, and the decision.

    Attributes
    ----------
    symbol : str
    worst : CharacteristicValue or None
        Value that is nearest to, or farthest beyond, the limit, including its guard band; None if nothing was measured.
    count : int
        Number of measured values.
    mpe_mm : float or None
        Maximum permissible error, for lengths without ``mpe_mm_per_m``.
    mpe_mm_per_m : float
        Growth of the maximum permissible error with the length.
    decision : str
        "conformity proven" if every value with its guard band is within the limits, "nonconformity proven" if a value
        without its guard band is outside, else "undecided". Simple acceptance gives "accepted" or "rejected".
    reason : str
        Why the decision is "undecided"; else empty.
    probability : float or None
        Smallest probability of conformity of a value, for a normal distribution about it.
    """

    symbol: Symbol
    worst: CharacteristicValue | None
    count: Annotated[int, Field(ge=0)]
    mpe_mm: Size | None
    decision: Decision
    reason: str = ""
    probability: Annotated[float, Field(ge=0, le=1)] | None = None
    mpe_mm_per_m: Spread = 0.0

    def limit_mm(self, value: CharacteristicValue) -> float | None:
        """Return the maximum permissible error of a value, mm; None if it is not stated."""
        return None if self.mpe_mm is None else self.mpe_mm + 1e-3 * self.mpe_mm_per_m * (value.length_mm or 0.0)

    def limit_text(self) -> str:
        """Return the maximum permissible error as text without its unit mm; empty if it is not stated."""
        growth = f" + {self.mpe_mm_per_m:g} L / m" if self.mpe_mm_per_m else ""
        return "" if self.mpe_mm is None else f"{self.mpe_mm:g}{growth}"

    def decision_text(self) -> str:
        """Return the decision with its reason."""
        return f"{self.decision}: {self.reason}" if self.reason else self.decision

    def probability_text(self) -> str:
        """Return the probability of conformity in per cent, without claiming certainty; empty if it is not known."""
        if self.probability is None:
            return ""
        if not 0.001 <= self.probability <= 0.999:
            return "> 99.9 %" if self.probability > 0.5 else "< 0.1 %"
        return f"{100 * self.probability:.1f} %"


def measure_position(
    cloud: PointCloud, plan: AcceptancePlan, position: PlannedPosition
) -> tuple[list[CharacteristicValue], int, int]:
    """Return all values of the characteristics at one position, and the numbers of points on the artefact and left out.

    EvaluationError if the region does not show the artefact, or too many of its points are off.
    """
    artefact, temperature = plan.artefacts[position.artefact], plan.temperature
    standard = artefact.at_temperature(None if temperature is None else temperature.value_c)
    points, frame = cloud.points_mm, cloud.frame
    if position.region_mm is not None:
        low, high = np.array(position.region_mm).T
        inside = ((points >= low) & (points <= high)).all(axis=1)
        points, frame = points[inside], frame[inside]
    margin, form = plan.margin_mm(artefact), _form_expanded_mm(artefact)
    values: list[CharacteristicValue] = []

    def add(
        symbol: Symbol, label: str, value_mm: float, expanded_mm: float | None, place_mm: np.ndarray, **more: object
    ) -> None:
        stated = {"symbol": symbol, "position": position.name, "label": label, "value_mm": value_mm}
        placed = {"expanded_mm": expanded_mm, "place_mm": tuple(np.asarray(place_mm).tolist())}
        values.append(CharacteristicValue.model_validate(stated | placed | more))

    match standard:
        case SphereStandard():
            spheres = measure_spheres(points, standard, margin_mm=margin)
            for number, (sphere, diameter) in enumerate(zip(spheres, standard.diameters_mm, strict=True), start=1):
                by_size = _expand_size_mm(artefact, standard.diameter_uncertainty_mm, diameter, temperature)
                centre, label = sphere.fit.centre_mm, f"sphere {number}"
                add("PF", label, sphere.range_mm, form, centre)
                add("PF95", label, sphere.range_95_mm, form, centre)
                add("PS", label, 2 * sphere.fit.radius_mm - diameter, by_size, centre)
            centres = np.array([sphere.fit.centre_mm for sphere in spheres])
            for number, calibrated in enumerate(standard.spacings_mm, start=1):
                one, other = centres[number - 1 : number + 1]
                spacing = float(np.linalg.norm(other - one))
                by_size = _expand_size_mm(artefact, standard.spacing_uncertainty_mm, calibrated, temperature)
                label = "spacing" if len(standard.spacings_mm) == 1 else f"spacing {number}-{number + 1}"
                direction = ((other - one) / spacing).tolist()
                known = {"length_mm": calibrated, "direction": direction}
                add("SD", label, spacing - calibrated, by_size, (other + one) / 2, **known)
            return values, sum(each.points for each in spheres), sum(each.rejected for each in spheres)
        case PlaneStandard():
            plane, middle = measure_plane(points, standard, margin_mm=margin), points.mean(axis=0)
            along = (points - middle) @ principal_axes(points - middle)[1][:2].T
            known = {"direction": plane.fit.normal.tolist(), "extent_mm": np.ptp(along, axis=0).tolist()}
            add("F", "plane", plane.range_mm, form, middle, **known)
            add("F95", "plane", plane.range_95_mm, form, middle, **known)
            return values, plane.points, plane.rejected
        case StepStandard():
            step = measure_step_height(points, frame, standard)
            height, known = standard.height_mm, {"length_mm": standard.height_mm, "direction": step.normal}
            by_size = _expand_size_mm(artefact, standard.height_uncertainty_mm, height, temperature)
            add("E", "height", step.height_error_mm, by_size, np.array(step.point_mm), **known)
            return values, step.points_used, 0
        case PipeStandard():
            raise EvaluationError(f"a {standard.kind} has no characteristic of an acceptance test")


def judge_characteristic(
    symbol: Symbol,
    values: list[CharacteristicValue],
    mpe_mm: float | None,
    *,
    mpe_mm_per_m: float = 0.0,
    rule: DecisionRule = "U",
) -> Characteristic:
    """Return a characteristic with its worst value and the decision; for the limits see `Characteristic`."""
    matching = [each for each in values if each.symbol == symbol]
    stated = {"symbol": symbol, "count": len(matching), "mpe_mm": mpe_mm, "mpe_mm_per_m": mpe_mm_per_m}
    limit_of = Characteristic(**stated, worst=None, decision="undecided").limit_mm
    limits = [limit_of(each) for each in matching]
    guard = _GUARDS[rule] / COVERAGE_FACTOR
    beyond = [
        abs(each.value_mm) + guard * (each.expanded_mm or 0.0) - (limit or 0.0)
        for each, limit in zip(matching, limits, strict=True)
    ]
    judged = [_decide(each, limit, rule) for each, limit in zip(matching, limits, strict=True)]
    if not matching:
        judged: list[tuple[Decision, str]] = [("no MPE", "") if mpe_mm is None else ("undecided", "not measured")]
    order = get_args(Decision)
    decision, reason = min(judged, key=lambda each: order.index(each[0]))
    chances = [_compute_probability(each, limit) for each, limit in zip(matching, limits, strict=True)]
    known = [chance for chance in chances if chance is not None]
    return Characteristic(
        **stated,
        worst=matching[int(np.argmax(beyond))] if matching else None,
        decision=decision,
        reason=reason,
        probability=min(known) if known and len(known) == len(chances) else None,
    )


def _decide(value: CharacteristicValue, limit_mm: float | None, rule: DecisionRule) -> tuple[Decision, str]:
    """Return the decision on one value, and the reason of an open one."""
    if limit_mm is None:
        return "no MPE", ""
    size, where = abs(value.value_mm), f"{value.position}, {value.label}"
    if value.expanded_mm is None and rule != "simple":
        return "undecided", f"the certificate states too little for a test value uncertainty ({where})"
    guard = _GUARDS[rule] / COVERAGE_FACTOR * (value.expanded_mm or 0.0)
    decision = _DECISIONS[judge_interval(size - guard, size + guard, upper=limit_mm)][rule == "simple"]
    return decision, f"the limit is within the guard band ({where})" if decision == "undecided" else ""


def _compute_probability(value: CharacteristicValue, limit_mm: float | None) -> float | None:
    """Return the probability that the true value is within the limits; None without limit or uncertainty."""
    if limit_mm is None or not value.expanded_mm:
        return None
    std = value.expanded_mm / COVERAGE_FACTOR
    return float(ndtr((limit_mm - value.value_mm) / std) - ndtr((-limit_mm - value.value_mm) / std))


def _form_expanded_mm(artefact: CertifiedArtefact) -> float | None:
    """Return the test value uncertainty (k = 2) of a form error: half the artefact's form, and its uncertainty.

    The standard uncertainty is sqrt((F / 2)² + u(F)²) (ISO/TS 23165, probing error).
    """
    form = artefact.stated_form_mm()
    return None if form is None else COVERAGE_FACTOR * float(np.hypot(form / 2, artefact.form_uncertainty_mm / 2))


def _expand_size_mm(
    artefact: CertifiedArtefact, calibrated_expanded_mm: float | None, length_mm: float, temperature: Temperature | None
) -> float | None:
    """Return the test value uncertainty (k = 2) of a calibrated size (ISO/TS 23165); None if not certified.

    Contributions are calibration, alignment, the temperature's uncertainty, and that of the expansion coefficient.
    """
    if calibrated_expanded_mm is None:
        return None
    parts = [calibrated_expanded_mm / 2, artefact.alignment_uncertainty_mm / 2]
    if temperature is not None and artefact.expansion_per_k is not None:
        parts.append(length_mm * artefact.expansion_per_k * temperature.uncertainty_k / 2)
        warmer = temperature.value_c - REFERENCE_C
        parts.append(length_mm * warmer * artefact.expansion_uncertainty_per_k / 2)
    return COVERAGE_FACTOR * float(np.sqrt(np.sum(np.square(parts))))


def describe_missing(artefact: CertifiedArtefact) -> list[str]:
    """Return what a certificate does not state, but the test value uncertainty needs."""
    standard, needed = artefact.standard, dict[str, float | None]()
    if isinstance(standard, SphereStandard):
        needed["diameter_uncertainty_mm"] = standard.diameter_uncertainty_mm
        if standard.spacings_mm:
            needed["spacing_uncertainty_mm"] = standard.spacing_uncertainty_mm
    if isinstance(standard, SphereStandard | PlaneStandard):
        needed["form_mm"] = artefact.stated_form_mm()
    if isinstance(standard, StepStandard):
        needed["height_uncertainty_mm"] = standard.height_uncertainty_mm
    return [name for name, value in needed.items() if value is None]
