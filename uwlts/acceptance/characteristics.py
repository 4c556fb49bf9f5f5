"""Characteristics of an acceptance test: measured values, their test value uncertainty, and the decision.

The symbols PF, PS, SD and F are those of VDI/VDE 2634 part 2; names of ISO 10360-13 stand beside them. The test value
uncertainty (ISO 14253-5, ISO/TS 23165) is by the artefact: calibration, form, alignment and temperature. The error of
the sensor is what is tested, and does not contribute.
"""

from collections.abc import Iterator
from typing import Annotated, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from uwlts.acceptance.acceptance_plan import REFERENCE_C, CertifiedArtefact, Length, Size, Spread, Symbol, Temperature
from uwlts.errors import EvaluationError
from uwlts.evaluation.artefact_figures import PlaneEvaluation, StepEvaluation, evaluate_cloud
from uwlts.evaluation.decision import Verdict, judge_interval
from uwlts.evaluation.spheres import SphereEvaluation
from uwlts.model.artefacts import PlaneStandard, SphereStandard, StepStandard
from uwlts.model.sensor import UnitVector, Vector
from uwlts.storage.cloud import PointCloud

Decision = Literal[
    "nonconformity proven", "not proven", "no test value uncertainty", "no MPE", "not measured", "conformity proven"
]

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

WANTED: dict[Symbol, int] = {"PF": 10, "PF95": 10, "PS": 10, "SD": 7, "F": 6, "F95": 6, "E": 1}
"""Least number of measured spheres, spacings and planes (VDI/VDE 2634 part 2); a step has no guideline."""

COVERAGE_FACTOR = 2.0  # k = 2, about 95 % (ISO 14253-1)

_DECISIONS: dict[Verdict, Decision] = {
    "within the limit": "conformity proven",
    "exceeds the limit": "nonconformity proven",
    "undecided": "not proven",
}


class StoredPart(BaseModel):
    """Part of a stored result; fields of newer versions are kept."""

    model_config = ConfigDict(frozen=True, extra="allow", allow_inf_nan=False)


class CharacteristicValue(StoredPart):
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
        Direction of that length.
    calibration_std_mm : float or None
        Standard uncertainty of that length by the artefact, common to all positions of the artefact.
    """

    symbol: Symbol
    position: str
    label: str
    value_mm: Length
    expanded_mm: Spread | None
    place_mm: tuple[Length, Length, Length]
    length_mm: Size | None = None
    direction: UnitVector | None = None
    calibration_std_mm: Spread | None = None


class Characteristic(StoredPart):
    """Characteristic with its worst value, the maximum permissible error, and the decision (ISO 14253-1).

    Attributes
    ----------
    symbol : str
    worst : CharacteristicValue or None
        Value that is nearest to, or farthest beyond, the limit, including its uncertainty; None if nothing was
        measured.
    count, wanted : int
        Number of measured values, and the least number of the guideline.
    mpe_mm : float or None
        Maximum permissible error, for lengths without ``mpe_mm_per_m``.
    mpe_mm_per_m : float
        Growth of the maximum permissible error with the length.
    decision : str
        "conformity proven" if the interval of every value is within the limits, "nonconformity proven" if the
        interval of a value is outside, else "not proven"; or the reason why there is no decision.
    """

    symbol: Symbol
    worst: CharacteristicValue | None
    count: Annotated[int, Field(ge=0)]
    wanted: Annotated[int, Field(ge=0)]
    mpe_mm: Size | None
    decision: Decision
    mpe_mm_per_m: Spread = 0.0

    def limit_mm(self, value: CharacteristicValue) -> float | None:
        """Return the maximum permissible error of a value, mm; None if it is not stated."""
        return _limit_mm(value, self.mpe_mm, self.mpe_mm_per_m)

    def limit_text(self) -> str:
        """Return the maximum permissible error as text without its unit mm; empty if it is not stated."""
        growth = f" + {self.mpe_mm_per_m:g} L / m" if self.mpe_mm_per_m else ""
        return "" if self.mpe_mm is None else f"{self.mpe_mm:g}{growth}"


def measure_position(
    cloud: PointCloud, artefact: CertifiedArtefact, position: str, temperature: Temperature | None
) -> list[CharacteristicValue]:
    """Return all values of the characteristics at one position.

    EvaluationError if the cloud does not show the artefact.
    """
    standard = artefact.at_temperature(None if temperature is None else temperature.value_c)
    found = evaluate_cloud(cloud, standard)
    match found:
        case SphereEvaluation():
            return list(_sphere_values(found, artefact, position, temperature))
        case PlaneEvaluation():
            by_form = _form_expanded_mm(artefact)
            place = _mean_place(cloud, found.deviation_mm)
            values: tuple[tuple[Symbol, float], ...] = ("F", found.form.range_mm), ("F95", found.form.range_95_mm)
            return [
                CharacteristicValue(
                    symbol=symbol, position=position, label="plane", value_mm=value, expanded_mm=by_form, place_mm=place
                )
                for symbol, value in values
            ]
        case StepEvaluation():
            assert isinstance(artefact.standard, StepStandard)
            calibrated = found.height_mm - found.height_error_mm
            std = _size_std_mm(artefact, artefact.standard.height_uncertainty_mm, calibrated, temperature)
            return [
                CharacteristicValue(
                    symbol="E",
                    position=position,
                    label="height",
                    value_mm=found.height_error_mm,
                    expanded_mm=_expanded(std),
                    place_mm=found.point_mm,
                    length_mm=calibrated,
                    direction=found.normal,
                    calibration_std_mm=std,
                )
            ]
        case _:
            raise EvaluationError(f"a {found.kind} has no characteristic of an acceptance test")


def judge_characteristic(
    symbol: Symbol, values: list[CharacteristicValue], mpe_mm: float | None, *, mpe_mm_per_m: float = 0.0
) -> Characteristic:
    """Return a characteristic with its worst value and the decision; for the limits see `Characteristic`."""
    own = [each for each in values if each.symbol == symbol]
    limits = {id(each): _limit_mm(each, mpe_mm, mpe_mm_per_m) for each in own}

    def beyond(each: CharacteristicValue) -> float:
        return abs(each.value_mm) + (each.expanded_mm or 0.0) - (limits[id(each)] or 0.0)

    worst = max(own, key=beyond, default=None)
    decisions = {_decide(each, limits[id(each)]) for each in own} or {"no MPE" if mpe_mm is None else "not measured"}
    order: tuple[Decision, ...] = (
        "nonconformity proven",
        "not proven",
        "no test value uncertainty",
        "no MPE",
        "not measured",
        "conformity proven",
    )
    return Characteristic(
        symbol=symbol,
        worst=worst,
        count=len(own),
        wanted=WANTED[symbol],
        mpe_mm=mpe_mm,
        decision=next(each for each in order if each in decisions),
        mpe_mm_per_m=mpe_mm_per_m,
    )


def _limit_mm(value: CharacteristicValue, mpe_mm: float | None, mpe_mm_per_m: float) -> float | None:
    return None if mpe_mm is None else mpe_mm + 1e-3 * mpe_mm_per_m * (value.length_mm or 0.0)


def _decide(value: CharacteristicValue, mpe_mm: float | None) -> Decision:
    """Return the decision on one value by its coverage interval."""
    if mpe_mm is None:
        return "no MPE"
    if value.expanded_mm is None:
        return "no test value uncertainty"
    size = abs(value.value_mm)
    return _DECISIONS[judge_interval(size - value.expanded_mm, size + value.expanded_mm, upper=mpe_mm)]


def _sphere_values(
    found: SphereEvaluation, artefact: CertifiedArtefact, position: str, temperature: Temperature | None
) -> Iterator[CharacteristicValue]:
    standard = artefact.standard
    assert isinstance(standard, SphereStandard)
    for number, sphere in enumerate(found.spheres, start=1):
        calibrated = sphere.diameter_mm - sphere.diameter_error_mm
        by_size = _expanded(_size_std_mm(artefact, standard.diameter_uncertainty_mm, calibrated, temperature))
        by_form = _form_expanded_mm(artefact)
        measured: tuple[tuple[Symbol, float, float | None], ...] = (
            ("PF", sphere.form.range_mm, by_form),
            ("PF95", sphere.form.range_95_mm, by_form),
            ("PS", sphere.diameter_error_mm, by_size),
        )
        for symbol, value, expanded in measured:
            yield CharacteristicValue(
                symbol=symbol,
                position=position,
                label=f"sphere {number}",
                value_mm=value,
                expanded_mm=expanded,
                place_mm=sphere.centre_mm,
            )
    centres = np.array([sphere.centre_mm for sphere in found.spheres])
    for number, spacing in enumerate(found.spacings, start=1):
        between = centres[number] - centres[number - 1]
        calibrated = spacing.spacing_mm - spacing.sse_mm
        std = _size_std_mm(artefact, standard.spacing_uncertainty_mm, calibrated, temperature)
        yield CharacteristicValue(
            symbol="SD",
            position=position,
            label="spacing" if len(found.spacings) == 1 else f"spacing {number}-{number + 1}",
            value_mm=spacing.sse_mm,
            expanded_mm=_expanded(std),
            place_mm=tuple((centres[number] + centres[number - 1]) / 2),
            length_mm=calibrated,
            direction=tuple(between / np.linalg.norm(between)),
            calibration_std_mm=std,
        )


def _form_expanded_mm(artefact: CertifiedArtefact) -> float | None:
    """Return the test value uncertainty (k = 2) of a form error: half the artefact's form, and its uncertainty.

    The standard uncertainty is sqrt((F / 2)² + u(F)²) (ISO/TS 23165, probing error).
    """
    form = artefact.stated_form_mm()
    return None if form is None else _expanded(float(np.hypot(form / 2, artefact.form_uncertainty_mm / 2)))


def _size_std_mm(
    artefact: CertifiedArtefact, calibrated_expanded_mm: float | None, length_mm: float, temperature: Temperature | None
) -> float | None:
    """Return the standard uncertainty of a calibrated size in the test (ISO/TS 23165); None if not certified.

    Contributions are calibration, alignment, the temperature's uncertainty, and that of the expansion coefficient.
    """
    if calibrated_expanded_mm is None:
        return None
    parts = [calibrated_expanded_mm / 2, artefact.alignment_uncertainty_mm / 2]
    if temperature is not None and artefact.expansion_per_k is not None:
        parts.append(length_mm * artefact.expansion_per_k * temperature.uncertainty_k / 2)
        warmer = temperature.value_c - REFERENCE_C
        parts.append(length_mm * warmer * artefact.expansion_uncertainty_per_k / 2)
    return float(np.sqrt(np.sum(np.square(parts))))


def _expanded(std_mm: float | None) -> float | None:
    return None if std_mm is None else COVERAGE_FACTOR * std_mm


def _mean_place(cloud: PointCloud, deviation_mm: np.ndarray) -> Vector:
    x, y, z = cloud.points_mm[np.isfinite(deviation_mm)].mean(axis=0).tolist()
    return x, y, z


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
