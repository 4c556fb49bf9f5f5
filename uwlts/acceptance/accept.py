"""Acceptance test of a sensor by artefacts in stated positions, demands of VDI/VDE 2634 part 2, and its result file."""

import hashlib
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import model_validator

from uwlts._version import __version__
from uwlts.acceptance.acceptance_plan import SYMBOLS, AcceptancePlan, Interval, PlannedPosition, Symbol, load_plan
from uwlts.acceptance.characteristics import (
    NAMES,
    RULES,
    Characteristic,
    CharacteristicValue,
    describe_missing,
    judge_characteristic,
    measure_position,
)
from uwlts.argument_types import check_arguments
from uwlts.errors import DescriptionError, Error
from uwlts.evaluation.figures import StoredResult
from uwlts.files.json_files import EDITED, read_model, to_canonical_json, write_model
from uwlts.files.reading import is_regular_file
from uwlts.files.writing import hash_file
from uwlts.fitting.least_squares import VDI_OUTLIER_SHARE
from uwlts.model.artefacts import PlaneStandard, SphereStandard
from uwlts.model.calibration import AnyCalibration, calibration_digest
from uwlts.model.short_text import Brief
from uwlts.reconstruction.reconstruct import reconstruct
from uwlts.runtime.progress import ProgressListener, ignore_progress
from uwlts.storage.calibration_file import load_calibration
from uwlts.storage.capture import Capture
from uwlts.storage.cloud import PointCloud
from uwlts.storage.cloud_files import is_cloud, load_cloud

_PROBED, _SPACED, _FLAT = 10, 7, 6
"""Least numbers of measured spheres, spacings and planes."""
_DIAMETERS = (0.02, 0.2)  # smallest and largest diameter of a sphere (unit: diagonal of the volume)
_SPACING = 0.3  # least spacing of two spheres (unit: diagonal of the volume)
_PLANE = 0.5  # least length of a plane (unit: diagonal of the volume)
_WIDTH_MM = 50.0  # least width of a plane
_APART = 0.05
"""Distance (unit: diagonal of the volume) from which positions differ: a sixth of the least spacing of two spheres."""
_TURNED_DEG = 10.0
"""Angle from which directions differ; seven directions of a bar are at least 30 deg apart if they are spread evenly."""


class Requirement(StoredResult):
    """Requirement of the guideline: its clause, what is demanded, what was done, and whether that meets it."""

    clause: str
    required: str
    done: str
    met: bool


def check_requirements(
    plan: AcceptancePlan, values: Iterable[CharacteristicValue], rejected_shares: Iterable[float]
) -> tuple[Requirement, ...]:
    """Return all requirements on spheres, spacings, planes and left out points, with what was measured."""
    values, diagonal = list(values), plan.diagonal_mm()
    standards = [each.standard for each in plan.artefacts.values()]
    spheres = [each for each in standards if isinstance(each, SphereStandard)]
    low, high = (share * diagonal for share in _DIAMETERS)
    extents = [each.extent_mm for each in values if each.symbol == "F" and each.extent_mm is not None]
    planned = Counter[Symbol]()
    for position in plan.positions:
        standard = plan.artefacts[position.artefact].standard
        if isinstance(standard, SphereStandard):
            planned.update(PF=len(standard.diameters_mm), SD=len(standard.spacings_mm))
        planned["F"] += isinstance(standard, PlaneStandard)

    def count(clause: str, least: int, symbol: Symbol) -> Requirement:
        those = [each for each in values if each.symbol == symbol]
        different = count_different(those, diagonal)
        done = f"{len(those)} of {planned[symbol]} planned" + (
            f", {different} differ" if different < len(those) else ""
        )
        return Requirement(clause=clause, required=f"at least {least}", done=done, met=different >= least)

    diameters = [size for each in spheres for size in each.diameters_mm]
    spacings = [size for each in spheres for size in each.spacings_mm]
    wanted = f"{_DIAMETERS[0]:g} to {_DIAMETERS[1]:g} L0"
    rows = [
        count("probing error: positions", _PROBED, "PF"),
        *_sizes(f"probing error: diameter of the spheres, {wanted}", diameters, low, high),
        count("sphere spacing: positions", _SPACED, "SD"),
        *_sizes(f"sphere spacing: length, {_SPACING:g} L0", spacings, _SPACING * diagonal, np.inf),
        count("flatness: positions", _FLAT, "F"),
        *_sizes(f"flatness: measured length, {_PLANE:g} L0", [each[0] for each in extents], _PLANE * diagonal, np.inf),
        *_sizes("flatness: measured width", [each[1] for each in extents], _WIDTH_MM, np.inf),
    ]
    if shares := list(rejected_shares):
        largest = max(shares)
        most, met = f"at most {100 * VDI_OUTLIER_SHARE:g} %", largest <= VDI_OUTLIER_SHARE
        rows.append(Requirement(clause="points left out", required=most, done=f"{100 * largest:.2f} %", met=met))
    return tuple(rows)


def count_different(values: list[CharacteristicValue], diagonal_mm: float) -> int:
    """Return the number of values whose place or direction differs from all others that are counted."""
    counted: list[CharacteristicValue] = []
    for each in values:
        if all(_differ(each, other, diagonal_mm) for other in counted):
            counted.append(each)
    return len(counted)


def _differ(one: CharacteristicValue, other: CharacteristicValue, diagonal_mm: float) -> bool:
    if np.linalg.norm(np.subtract(one.place_mm, other.place_mm)) > _APART * diagonal_mm:
        return True
    if one.direction is None or other.direction is None:
        return False
    return abs(float(np.dot(one.direction, other.direction))) < np.cos(np.radians(_TURNED_DEG))


def _sizes(clause: str, sizes: list[float], low: float, high: float) -> Iterator[Requirement]:
    """Compare the smallest and largest of some sizes with their limits; nothing without sizes."""
    if sizes:
        required = f"at least {low:.0f} mm" if np.isinf(high) else f"{low:.1f} to {high:.1f} mm"
        smallest, largest = min(sizes), max(sizes)
        done = f"{smallest:.1f} mm" if np.isinf(high) else f"{smallest:.2f} to {largest:.2f} mm"
        yield Requirement(clause=clause, required=required, done=done, met=low <= smallest and largest <= high)


# --- requirements of VDI/VDE 2634 part 2 ------------------------------------------------------------------------------


FORMAT, VERSION = "uwlts-acceptance", 2

State = Literal["missing", "failed", "judged"]
Verdict = Literal["nonconformity proven", "rejected", "undecided", "accepted", "conformity proven"]


class JudgedPosition(StoredResult):
    """Position of the plan: whether its file is missing, could not be evaluated (with the reason), or is judged.

    ``inputs`` is the digest of file, calibration and artefact; a later run takes the values of an unchanged position
    from the earlier result. Of all ``points``, those ``on_artefact`` are in its region, and the ``rejected`` ones are
    the farthest of these, which the guideline permits leaving out.
    """

    name: str
    artefact: str
    file: str
    state: State
    reason: str = ""
    region_mm: tuple[Interval, Interval, Interval] | None = None
    sha256: str | None = None
    inputs: str | None = None
    points: int = 0
    on_artefact: int = 0
    rejected: int = 0
    warnings: tuple[str, ...] = ()
    values: tuple[CharacteristicValue, ...] = ()


class Acceptance(Brief, StoredResult):
    """Result of `accept`, and the content of its file.

    Attributes
    ----------
    plan : AcceptancePlan
        The plan with certificates and maximum permissible errors.
    positions : tuple of JudgedPosition
        State and measured values of each position.
    characteristics : tuple of Characteristic
        Worst value, limit and decision of each characteristic that is measured or limited.
    requirements : tuple of Requirement
        What VDI/VDE 2634 part 2 demands, and what was done.
    verdict : str
        Verdict on all characteristics: a proven nonconformity counts at once, conformity if everything is measured.
    conclusion : str
        The verdict with its reason as a sentence.
    remarks : tuple of str
        What is not stated or not tested, and warnings.
    calibration : str or None
        Digest of the calibration.
    software, date : str
        Software, and time of the judgement (ISO 8601).
    edited : bool
        True if the file, or the earlier result, was edited by hand.
    """

    plan: AcceptancePlan
    positions: tuple[JudgedPosition, ...]
    characteristics: tuple[Characteristic, ...]
    requirements: tuple[Requirement, ...]
    verdict: Verdict
    conclusion: str
    remarks: tuple[str, ...]
    calibration: str | None
    software: str
    date: str
    edited: bool = False

    @model_validator(mode="after")
    def _check_names(self) -> "Acceptance":
        for each in self.positions:
            if each.artefact not in self.plan.artefacts:
                raise ValueError(
                    f"the position {each.name!r} is of the artefact {each.artefact!r}, which has no certificate"
                )
            if others := {value.position for value in each.values} - {each.name}:
                raise ValueError(f"the position {each.name!r} has values of {sorted(others)[0]!r}")
        return self

    @property
    def outstanding(self) -> tuple[JudgedPosition, ...]:
        """Positions that are still to be measured, or measured again."""
        return tuple(each for each in self.positions if each.state != "judged")

    @property
    def values(self) -> tuple[CharacteristicValue, ...]:
        """All measured values."""
        return tuple(value for each in self.positions for value in each.values)

    def lines(self) -> list[str]:
        """Return states, what is to be measured next, characteristics and the verdict as text."""
        lines = [f"{self.plan.title}: {len(self.positions)} positions"]
        for number, each in enumerate(self.positions, start=1):
            reason = f": {each.reason}" if each.reason else ""
            lines.append(f"{number:3}  {each.artefact:12} {each.name:18} {each.file:28} {each.state}{reason}")
        if self.outstanding:
            first = self.outstanding[0]
            again = "measure again" if first.state == "failed" else "measure"
            lines.append(f"next: {again} {first.artefact}, {first.name}, into {first.file}")
        lines.append(f"decision rule: {RULES[self.plan.decision_rule]}")
        lines += [format_characteristic(each) for each in self.characteristics]
        lines += [
            f"{'done' if each.met else 'not met'}: {each.clause}: {each.required}; {each.done}"
            for each in self.requirements
        ]
        lines += [f"note: {each}" for each in self.remarks]
        return [*lines, self.conclusion]

    @check_arguments
    def save(self, path: str | Path, *, overwrite: bool = False) -> None:
        """Write the result as sealed JSON, completely or not at all; OutputError if writing fails."""
        write_model(path, self, file_format=FORMAT, version=VERSION, overwrite=overwrite)


def format_characteristic(each: Characteristic) -> str:
    """Return a characteristic as one line of text."""
    text, _ = NAMES[each.symbol]
    limit = f"MPE {each.limit_text()} mm" if each.limit_text() else "no MPE stated"
    if each.worst is None:
        return f"{each.symbol:5} {text}: not measured, {limit}"
    u = "U not known" if each.worst.expanded_mm is None else f"U {each.worst.expanded_mm:.4f} mm"
    where = f"{each.worst.position}, {each.worst.label}"
    sign = "" if each.symbol in ("PF", "PF95", "F", "F95") else "+"
    chance = f", probability of conformity {each.probability_text()}" if each.probability is not None else ""
    return (
        f"{each.symbol:5} {text}: {each.worst.value_mm:{sign}.4f} mm ({where}; {each.count} measured), {u}, {limit}"
        f"{chance}: {each.decision_text()}"
    )


def accept(
    plan: str | Path, *, earlier: Acceptance | str | Path | None = None, progress: ProgressListener = ignore_progress
) -> Acceptance:
    """Judge a sensor by scans of artefacts against maximum permissible errors, position by position of a plan.

    The plan names the artefacts with their certificates, the captures or clouds of each position, and the limits. Files
    that are not there yet are reported as missing, so that the test can be repeated while an operator works through the
    plan. Characteristics are those of VDI/VDE 2634 part 2 and ISO 10360-13. The test value uncertainty contains
    calibration, form, alignment and temperature of the artefacts (ISO 14253-5, ISO/TS 23165). The plan states the
    decision rule. All points in an artefact's region are measurements of it: none is left out by its distance, except
    the 0.3 % that VDI/VDE 2634 permits.

    Parameters
    ----------
    plan : str or Path
        Plan of an acceptance test (TOML; docs: accept a sensor). Its files are beside it.
    earlier : Acceptance or path, optional
        Earlier result of the plan, from which unchanged positions are taken.
    progress : callable, optional
        Called after each position with the number of positions done and the total number.

    Returns
    -------
    Acceptance
        States of the positions, characteristics with decisions, requirements of the guideline, and the verdict.

    Raises
    ------
    DescriptionError
        The file is not a plan, or names a capture but no calibration.
    CaptureError, CalibrationError
        The calibration or the earlier result cannot be read.
    """
    path, stated = Path(plan), load_plan(plan)
    known = read_acceptance(earlier) if isinstance(earlier, str | Path) else earlier
    before = {} if known is None else {each.inputs: each for each in known.positions if each.state == "judged"}
    calibration = None
    if stated.calibration is not None:
        calibration = load_calibration(path.parent / stated.calibration)
    judged: list[JudgedPosition] = []
    for position in stated.positions:
        judged.append(_judge_position(path.parent, stated, position, calibration, before))
        progress(len(judged), len(stated.positions))
    values = [value for each in judged for value in each.values]
    characteristics = tuple(
        judge_characteristic(
            symbol, values, stated.mpe.of(symbol), mpe_mm_per_m=stated.mpe.per_metre(symbol), rule=stated.decision_rule
        )
        for symbol in SYMBOLS
        if stated.mpe.of(symbol) is not None or any(value.symbol == symbol for value in values)
    )
    shares = [each.rejected / each.on_artefact for each in judged if each.on_artefact]
    requirements = check_requirements(stated, values, shares)
    verdict, reason = _conclude(characteristics, judged)
    unmet = sum(not each.met for each in requirements)
    if verdict in ("conformity proven", "accepted") and unmet:
        reason += f"; {unmet} requirements of VDI/VDE 2634 part 2 are not met"
    edited = () if known is None or not known.edited else ("the earlier result was edited after it was written",)
    return Acceptance(
        plan=stated,
        positions=tuple(judged),
        characteristics=characteristics,
        requirements=requirements,
        verdict=verdict,
        conclusion=f"{verdict}: {reason}",
        remarks=(*_list_remarks(stated, characteristics), *_list_warnings(judged), *edited),
        calibration=None if calibration is None else calibration_digest(calibration),
        software=f"uwlts {__version__}",
        date=datetime.now(UTC).isoformat(timespec="seconds"),
        edited=bool(edited),
    )


def read_acceptance(path: str | Path) -> Acceptance:
    """Read the result of an acceptance test; CaptureError if it is missing, newer, damaged, or of another format."""
    return read_model(path, Acceptance, file_format=FORMAT, version=VERSION, called="acceptance test")


def _conclude(characteristics: Sequence[Characteristic], positions: Sequence[JudgedPosition]) -> tuple[Verdict, str]:
    """Return the verdict on all characteristics, and its reason."""
    limited = [each for each in characteristics if each.mpe_mm is not None]
    for against in ("nonconformity proven", "rejected"):
        if failed := [each.symbol for each in limited if each.decision == against]:
            guarded = " by more than the guard band" if against == "nonconformity proven" else ""
            return against, f"{', '.join(failed)} beyond the maximum permissible error{guarded}"
    open_ones = [f"{each.symbol}: {each.reason}" for each in limited if each.decision == "undecided"]
    left = sum(each.state == "missing" for each in positions)
    reasons = [f"{left} of {len(positions)} positions are still to be measured"] if left else []
    reasons += [f"{each.name} failed: {each.reason}" for each in positions if each.state == "failed"]
    reasons += open_ones if not reasons else []
    if not limited:
        reasons.append("no maximum permissible error is stated")
    if reasons:
        return "undecided", "; ".join(reasons)
    if all(each.decision == "accepted" for each in limited):
        return "accepted", "every value is within its maximum permissible error, without a guard band"
    return "conformity proven", "every value with its guard band is within its maximum permissible error"


def _judge_position(
    folder: Path,
    plan: AcceptancePlan,
    position: PlannedPosition,
    calibration: AnyCalibration | None,
    before: dict[str | None, JudgedPosition],
) -> JudgedPosition:
    file, artefact = folder / position.file, plan.artefacts[position.artefact]
    plain = position.model_dump()
    if not is_regular_file(file):
        return JudgedPosition(**plain, state="missing")
    content = {
        "file": hash_file(file),
        "calibration": None if calibration is None or is_cloud(file) else calibration_digest(calibration),
        "artefact": artefact.model_dump(mode="json"),
        "temperature": None if plan.temperature is None else plan.temperature.model_dump(mode="json"),
        "position": plain,
        "margin_mm": plan.margin_mm(artefact),
        "software": __version__,
    }
    inputs = hashlib.sha256(to_canonical_json(content)).hexdigest()
    if inputs in before:
        return before[inputs]
    state = {"sha256": content["file"], "inputs": inputs}
    try:
        cloud = _measure_cloud(file, calibration)
        values, on_artefact, rejected = measure_position(cloud, plan, position)
    except DescriptionError:
        raise
    except Error as error:
        return JudgedPosition(**plain, **state, state="failed", reason=str(error))
    edited = [f"the {part} was edited after it was written" for part in [cloud.metadata.get(EDITED)] if part]
    return JudgedPosition(
        **plain,
        **state,
        state="judged",
        points=len(cloud),
        on_artefact=on_artefact,
        rejected=rejected,
        warnings=(*cloud.warnings, *edited),
        values=tuple(values),
    )


def _measure_cloud(file: Path, calibration: AnyCalibration | None) -> PointCloud:
    """Return the cloud in a file, or that of a capture."""
    if is_cloud(file):
        return load_cloud(file)
    if calibration is None:
        raise DescriptionError(f"{file} is a capture: the plan must name the `calibration` that reconstructs it")
    with Capture(file) as capture:
        return reconstruct(capture, calibration, with_uncertainty=False)


def _list_remarks(plan: AcceptancePlan, characteristics: Sequence[Characteristic]) -> Iterator[str]:
    for each in characteristics:
        if each.mpe_mm is None:
            yield f"{each.symbol}: no maximum permissible error is stated"
    for symbol, what in (("PF", "probing"), ("SD", "sphere spacing"), ("F", "flatness")):
        if symbol not in {each.symbol for each in characteristics}:
            yield f"{symbol}: neither measured nor limited: {what} is not tested"
    for name, artefact in plan.artefacts.items():
        standard = artefact.standard
        if missing := describe_missing(artefact):
            yield f"{name}: without {', '.join(missing)} of the certificate there is no test value uncertainty"
        heated = artefact.expansion_per_k is not None and plan.temperature is not None
        if not heated and not isinstance(standard, PlaneStandard):
            yield f"{name}: temperature or expansion is not stated; the test value uncertainty does not contain it"


def _list_warnings(judged: Sequence[JudgedPosition]) -> list[str]:
    """Return the warnings of the clouds, each with its positions."""
    where: dict[str, list[str]] = {}
    for position in judged:
        for text in position.warnings:
            where.setdefault(text, []).append(position.name)
    return [f"{', '.join(names)}: {text}" for text, names in where.items()]
