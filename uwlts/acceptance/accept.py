"""Acceptance test of a sensor by artefacts in stated positions, and its result file (JSON)."""

import hashlib
from collections.abc import Iterator, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal

from pydantic import SerializerFunctionWrapHandler, model_serializer, model_validator

from uwlts._version import __version__
from uwlts.acceptance.acceptance_plan import SYMBOLS, AcceptancePlan, PlannedPosition, Symbol, load_plan
from uwlts.acceptance.characteristics import (
    NAMES,
    Characteristic,
    CharacteristicValue,
    Decision,
    StoredPart,
    describe_missing,
    judge_characteristic,
    measure_position,
)
from uwlts.acceptance.directional_scale import DirectionalScale, ScaleComponent, fit_directional_scale
from uwlts.argument_types import check_arguments
from uwlts.errors import DescriptionError, Error
from uwlts.files.json_files import EDITED, read_model, to_canonical_json, trusting, write_model
from uwlts.files.reading import is_regular_file
from uwlts.files.writing import hash_file
from uwlts.model.any_calibration import AnyCalibration, calibration_digest
from uwlts.model.artefacts import PlaneStandard, SphereStandard
from uwlts.model.brief import Brief
from uwlts.model.sensor import Vector
from uwlts.reconstruction.reconstruct import reconstruct
from uwlts.runtime.progress import ProgressListener, ignore_progress
from uwlts.storage.calibration_file import load_calibration
from uwlts.storage.capture import Capture
from uwlts.storage.cloud import PointCloud
from uwlts.storage.cloud_files import is_cloud, read_cloud

FORMAT, VERSION = "uwlts-acceptance", 1

State = Literal["missing", "failed", "judged"]
Verdict = Literal["incomplete", "nonconformity proven", "conformity not proven", "conformity proven"]

_LEAST_SPACING = 0.3
"""Least sphere spacing relative to the diagonal of the measuring volume (VDI/VDE 2634 part 2)."""


class JudgedPosition(StoredPart):
    """Position of the plan: whether its file is missing, could not be evaluated (with the reason), or is judged.

    ``inputs`` is the digest of file, calibration and artefact; a later run takes the values of an unchanged position
    from the earlier result.
    """

    name: str
    artefact: str
    file: str
    state: State
    reason: str = ""
    sha256: str | None = None
    inputs: str | None = None
    points: int = 0
    warnings: tuple[str, ...] = ()
    stage_direction: Vector | None = None
    values: tuple[CharacteristicValue, ...] = ()


class Acceptance(Brief, StoredPart):
    """Result of `accept`, and the content of its file.

    Attributes
    ----------
    plan : AcceptancePlan
        The plan with certificates and maximum permissible errors.
    positions : tuple of JudgedPosition
        State and measured values of each position.
    characteristics : tuple of Characteristic
        Worst value, limit and decision of each characteristic that is measured or limited.
    scale : DirectionalScale or None
        Shares of stage and sensor in the length errors.
    remarks : tuple of str
        Deviations from the guideline, and what is missing.
    calibration : str or None
        Digest of the calibration.
    software, date : str
        Software, and time of the judgement (ISO 8601).
    edited : bool
        True if the file was edited by hand and trusted.
    """

    plan: AcceptancePlan
    positions: tuple[JudgedPosition, ...]
    characteristics: tuple[Characteristic, ...]
    scale: DirectionalScale | None
    remarks: tuple[str, ...]
    calibration: str | None
    software: str
    date: str
    edited: bool = False

    @model_validator(mode="after")
    def _names_fit(self) -> "Acceptance":
        for each in self.positions:
            if each.artefact not in self.plan.artefacts:
                raise ValueError(
                    f"the position {each.name!r} is of the artefact {each.artefact!r}, which has no certificate"
                )
            if others := {value.position for value in each.values} - {each.name}:
                raise ValueError(f"the position {each.name!r} has values of {sorted(others)[0]!r}")
        return self

    @model_serializer(mode="wrap")
    def _without_default(self, plain: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Omit ``edited`` unless it is set: it is an entry of edited files only."""
        return {key: value for key, value in plain(self).items() if key != EDITED or value}

    @property
    def verdict(self) -> Verdict:
        """Verdict on all characteristics: a proven nonconformity counts at once, conformity when all is measured."""
        found: set[Decision] = {each.decision for each in self.characteristics if each.mpe_mm is not None}
        if "nonconformity proven" in found:
            return "nonconformity proven"
        if self.outstanding or not found:
            return "incomplete"
        return "conformity proven" if found == {"conformity proven"} else "conformity not proven"

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
        lines += [format_characteristic(each) for each in self.characteristics]
        if self.scale is not None:
            known = (each for each in self.scale.components if each.value is not None)
            lines += [f"{format_scale(each)} ({each.share})" for each in known]
        lines += [f"note: {each}" for each in self.remarks]
        return [*lines, self.verdict]

    @check_arguments
    def save(self, path: str | Path, *, overwrite: bool = False) -> None:
        """Write the result as sealed JSON, completely or not at all; OutputError if writing fails."""
        write_model(path, self, file_format=FORMAT, version=VERSION, overwrite=overwrite)


def format_characteristic(each: Characteristic) -> str:
    """Return a characteristic as one line of text."""
    words, _ = NAMES[each.symbol]
    limit = f"MPE {each.limit_text()} mm" if each.limit_text() else "no MPE stated"
    if each.worst is None:
        return f"{each.symbol:5} {words}: not measured, {limit}"
    u = "U not known" if each.worst.expanded_mm is None else f"U {each.worst.expanded_mm:.4f} mm"
    where = f"{each.worst.position}, {each.worst.label}"
    sign = "" if each.symbol in ("PF", "PF95", "F", "F95") else "+"
    return (
        f"{each.symbol:5} {words}: {each.worst.value_mm:{sign}.4f} mm ({where}; {each.count} measured), {u}, {limit}: "
        f"{each.decision}"
    )


def format_scale(each: ScaleComponent) -> str:
    """Return a determined component with its 95 % interval as text."""
    assert each.value is not None
    half = "" if each.half_interval is None else f" ± {1e6 * each.half_interval:.0f}"
    return f"{each.words}: {1e6 * each.value:+.0f}{half} µm/m"


@trusting
def accept(
    plan: str | Path,
    *,
    earlier: Acceptance | str | Path | None = None,
    trust_edited: bool = False,
    progress: ProgressListener = ignore_progress,
) -> Acceptance:
    """Judge a sensor by scans of artefacts against maximum permissible errors, position by position of a plan.

    The plan names the artefacts with their certificates, the captures or clouds of each position, and the limits. Files
    that are not there yet are reported as missing, so that the test can be repeated while an operator works through the
    plan. Characteristics are those of VDI/VDE 2634 part 2 and ISO 10360-13. The test value uncertainty contains
    calibration, form, alignment and temperature of the artefacts (ISO 14253-5, ISO/TS 23165). The decision is that of
    ISO 14253-1.

    Parameters
    ----------
    plan : str or Path
        Plan of an acceptance test (TOML; docs: accept a sensor). Its files are beside it.
    earlier : Acceptance or path, optional
        Earlier result of the plan, from which unchanged positions are taken.
    trust_edited : bool
        As for `read`.
    progress : callable, optional
        Called after each position with the number of positions done and the total number.

    Returns
    -------
    Acceptance
        States of the positions, characteristics with decisions, and the shares of stage and sensor.

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
    values = [(value, each) for each in judged for value in each.values]
    scale = fit_directional_scale(
        [value for value, _ in values],
        [each.artefact for _, each in values],
        [each.stage_direction or stated.stage_direction for _, each in values],
    )
    characteristics = tuple(
        judge_characteristic(
            symbol, [value for value, _ in values], stated.mpe.of(symbol), mpe_mm_per_m=stated.mpe.per_metre(symbol)
        )
        for symbol in SYMBOLS
        if stated.mpe.of(symbol) is not None or any(value.symbol == symbol for value, _ in values)
    )
    edited = () if known is None or not known.edited else ("the earlier result was edited after it was written",)
    return Acceptance(
        plan=stated,
        positions=tuple(judged),
        characteristics=characteristics,
        scale=scale,
        remarks=(*_remarks(stated, characteristics), *_warnings(judged), *edited),
        calibration=None if calibration is None else calibration_digest(calibration),
        software=f"uwlts {__version__}",
        date=datetime.now(UTC).isoformat(timespec="seconds"),
        edited=bool(edited),
    )


def read_acceptance(path: str | Path) -> Acceptance:
    """Read the result of an acceptance test; CaptureError if it is missing, newer, damaged, or of another format."""
    return read_model(path, Acceptance, file_format=FORMAT, version=VERSION, called="acceptance test")


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
        "software": __version__,
    }
    inputs = hashlib.sha256(to_canonical_json(content)).hexdigest()
    if inputs in before:
        return before[inputs]
    state = {"sha256": content["file"], "inputs": inputs}
    try:
        cloud, direction = _measure_cloud(file, calibration)
        values = measure_position(cloud, artefact, position.name, plan.temperature)
    except DescriptionError:
        raise
    except Error as error:
        return JudgedPosition(**plain, **state, state="failed", reason=str(error))
    return JudgedPosition(
        **plain,
        **state,
        state="judged",
        points=len(cloud),
        warnings=(*cloud.warnings, *_edited_parts(cloud)),
        stage_direction=direction,
        values=tuple(values),
    )


def _measure_cloud(file: Path, calibration: AnyCalibration | None) -> tuple[PointCloud, Vector | None]:
    """Return the cloud in a file, or that of a capture, and the stage's direction if the file states it."""
    if is_cloud(file):
        return read_cloud(file), None
    if calibration is None:
        raise DescriptionError(f"{file} is a capture: the plan must name the `calibration` that reconstructs it")
    with Capture(file) as capture:
        cloud = reconstruct(capture, calibration, with_uncertainty=False)
        return cloud, capture.header.stage_direction


def _edited_parts(cloud: PointCloud) -> list[str]:
    """Return a warning if the cloud is based on a file that was edited after it was written."""
    return [f"the {part} was edited after it was written" for part in [cloud.metadata.get(EDITED)] if part]


def _remarks(plan: AcceptancePlan, characteristics: Sequence[Characteristic]) -> Iterator[str]:
    for each in characteristics:
        if each.mpe_mm is None:
            yield f"{each.symbol}: no maximum permissible error is stated"
        planned = sum(_count_of(plan, one, each.symbol) for one in plan.positions)
        if planned < each.wanted:
            yield f"{each.symbol}: the plan has {planned} measurements, the guideline demands at least {each.wanted}"
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
        least = _LEAST_SPACING * plan.diagonal_mm()
        for spacing in standard.spacings_mm if isinstance(standard, SphereStandard) else ():
            if spacing < least:
                yield f"{name}: a spacing of {spacing:g} mm; the guideline demands {least:.0f} mm in this volume"


def _warnings(judged: Sequence[JudgedPosition]) -> list[str]:
    """Return the warnings of the clouds, each with its positions."""
    where: dict[str, list[str]] = {}
    for position in judged:
        for text in position.warnings:
            where.setdefault(text, []).append(position.name)
    return [f"{', '.join(names)}: {text}" for text, names in where.items()]


def _symbols_of(plan: AcceptancePlan, position: PlannedPosition) -> tuple[Symbol, ...]:
    standard = plan.artefacts[position.artefact].standard
    if isinstance(standard, SphereStandard):
        return ("PF", "PF95", "PS", "SD") if standard.spacings_mm else ("PF", "PF95", "PS")
    return ("F", "F95") if isinstance(standard, PlaneStandard) else ("E",)


def _count_of(plan: AcceptancePlan, position: PlannedPosition, symbol: Symbol) -> int:
    """Return how many values of a characteristic a position gives."""
    standard = plan.artefacts[position.artefact].standard
    if symbol not in _symbols_of(plan, position):
        return 0
    if not isinstance(standard, SphereStandard):
        return 1
    return len(standard.spacings_mm) if symbol == "SD" else len(standard.diameters_mm)
