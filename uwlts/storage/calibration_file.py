"""Files of calibrations, and of the last verification of each, in a file beside it."""

from datetime import UTC, datetime, timedelta
from pathlib import Path

from pydantic import AwareDatetime

from uwlts.files.json_files import read_json, read_model, write_model
from uwlts.files.reading import is_regular_file
from uwlts.model.calibration import (
    FORMAT,
    POLYNOMIALS_FORMAT,
    VERSION,
    AnyCalibration,
    Calibration,
    PolynomialCalibration,
    calibration_digest,
)
from uwlts.model.sensor import Description


def read_calibration(path: str | Path) -> Calibration:
    """Read a calibration; raises CaptureError if the file is missing, foreign, newer or damaged."""
    return read_model(path, Calibration, file_format=FORMAT, version=VERSION, called="calibration")


def load_calibration(path: str | Path) -> AnyCalibration:
    """Read a calibration of any kind; raises CaptureError if the file is missing, foreign, newer or damaged."""
    if read_json(path, called="calibration", check_seal=False).get("format") != POLYNOMIALS_FORMAT:
        return read_calibration(path)
    known = {"file_format": POLYNOMIALS_FORMAT, "version": VERSION, "called": "polynomial calibration"}
    return read_model(path, PolynomialCalibration, **known)


def resolve_calibration(calibration: AnyCalibration | str | Path) -> AnyCalibration:
    """Return a calibration unchanged, or read it from a file; raises the errors of `load_calibration`."""
    return load_calibration(calibration) if isinstance(calibration, str | Path) else calibration


_VERIFICATION, _VERIFICATION_VERSION = "uwlts-verification", 1
_VALID = timedelta(days=1)
"""Validity of a verification, and of a new calibration: one day of use. Chosen by hand."""


class VerificationRecord(Description):
    """Verdict on a calibration, given by its digest, from a capture at a date; ``lines`` are the results as text."""

    calibration: str
    date: AwareDatetime
    capture: str
    passed: bool
    lines: tuple[str, ...]
    edited: bool = False


def verification_path(calibration: str | Path) -> Path:
    """Return the path of the record beside a calibration's file: for water.json, water.verification.json."""
    return Path(calibration).with_suffix(".verification.json")


def write_verification(calibration: str | Path, record: VerificationRecord) -> Path:
    """Write the record beside the calibration, in place of the last one; OutputError if that fails."""
    path = verification_path(calibration)
    write_model(path, record, file_format=_VERIFICATION, version=_VERIFICATION_VERSION, overwrite=True)
    return path


def describe_verification(
    path: str | Path, calibration: AnyCalibration, *, now: datetime | None = None
) -> tuple[str | None, list[str]]:
    """Return until when a calibration's file is verified, as text or None, and warnings if it is not.

    There is no warning in the first day after the calibration, or if its date is unknown.
    """
    now, record = now or datetime.now(UTC), None
    if is_regular_file(beside := verification_path(path)):
        record = read_model(
            beside, VerificationRecord, file_format=_VERIFICATION, version=_VERIFICATION_VERSION, called="verification"
        )
    if record is None or record.calibration != calibration_digest(calibration):
        try:
            made = datetime.fromisoformat(str(calibration.provenance.get("date")))
        except ValueError:
            return None, []
        if abs(now - (made if made.tzinfo else made.replace(tzinfo=UTC))) <= _VALID:
            return None, []
        return None, [f"the calibration of {made:%Y-%m-%d} was not verified since: measure an artefact (uwlts verify)"]
    if not record.passed:
        return None, [f"the calibration FAILED its verification of {record.date:%Y-%m-%d}: {'; '.join(record.lines)}"]
    # A date in the future is that of another clock, or the clock was set back.
    if abs(now - record.date) > _VALID:
        return None, [f"the calibration was last verified on {record.date:%Y-%m-%d}: today's check is missing"]
    return f"{record.date + _VALID:%Y-%m-%d %H:%M} UTC", []
