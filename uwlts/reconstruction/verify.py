"""Field verification: measurement of a calibrated artefact and comparison with its certificate."""

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from uwlts.argument_types import check_arguments
from uwlts.errors import EvaluationError, RangeError
from uwlts.evaluation.evaluate import evaluate
from uwlts.model.artefacts import parse_artefact
from uwlts.model.calibration import AnyCalibration, calibration_digest
from uwlts.model.sensor import Vector
from uwlts.reconstruction.reconstruct import reconstruct
from uwlts.storage.calibration_file import VerificationRecord, resolve_calibration, write_verification
from uwlts.storage.capture import Capture, open_capture


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """Result for one calibrated quantity, mm.

    Expanded uncertainties (k = 2) are None if unknown. ``limit_mm`` is the maximum permissible error, if any.
    """

    quantity: str
    calibrated_mm: float
    measured_mm: float
    calibrated_expanded_mm: float | None
    measured_expanded_mm: float | None
    limit_mm: float | None

    @property
    def error_mm(self) -> float:
        """Measured minus calibrated value."""
        return self.measured_mm - self.calibrated_mm

    @property
    def expanded_mm(self) -> float:
        """Expanded uncertainty of the error; unknown contributions count as zero."""
        return float(np.hypot(self.measured_expanded_mm or 0.0, self.calibrated_expanded_mm or 0.0))

    @property
    def normalised_error(self) -> float | None:
        """E_n of ISO/IEC 17043, error divided by expanded uncertainty; None if that of the measurement is unknown."""
        return None if self.measured_expanded_mm is None else abs(self.error_mm) / self.expanded_mm

    @property
    def passed(self) -> bool:
        """Whether E_n, if known, is at most 1, and the error conforms to its limit, if given.

        Conformity requires that the sum of absolute error and expanded uncertainty is within the limit (ISO 14253-1).
        """
        agrees = self.normalised_error is None or self.normalised_error <= 1.0
        return agrees and (self.limit_mm is None or abs(self.error_mm) + self.expanded_mm <= self.limit_mm)

    @property
    def text(self) -> str:
        """The result as one line of text."""
        text = f"{self.quantity}: {self.measured_mm:.4f} mm, calibrated {self.calibrated_mm:.4f} mm, "
        text += f"error {self.error_mm:+.4f} ± {self.expanded_mm:.4f} mm"
        agreement = "" if self.normalised_error is None else f", E_n {self.normalised_error:.2f}"
        limit = "" if self.limit_mm is None else f", limit {self.limit_mm:g} mm"
        return f"{text}{agreement}{limit}: {'pass' if self.passed else 'FAIL'}"


@dataclass(frozen=True)
class Verification:
    """Results for all calibrated quantities of an artefact, the share of other points, and errors that it cannot show.

    ``capture`` is its name, ``calibration`` the calibration's digest, and ``warnings`` those of the reconstruction.
    """

    verdicts: tuple[Verdict, ...]
    not_shown: tuple[str, ...] = ()
    capture: str = ""
    calibration: str = ""
    warnings: Sequence[str] = ()

    @property
    def passed(self) -> bool:
        """True if all quantities passed."""
        return all(verdict.passed for verdict in self.verdicts)

    @property
    def text(self) -> str:
        """One line of text for each quantity."""
        return "\n".join(verdict.text for verdict in self.verdicts)

    @check_arguments
    def save(self, calibration: str | Path) -> Path:
        """Write verdict and date beside the calibration's file, where `reconstruct` finds them; OutputError if not."""
        record = VerificationRecord(
            calibration=self.calibration,
            date=datetime.now(UTC),
            capture=self.capture,
            passed=self.passed,
            lines=tuple(verdict.text for verdict in self.verdicts),
        )
        return write_verification(calibration, record)


def verify(
    capture: Capture | str | Path, calibration: AnyCalibration | str | Path, *, limit_mm: float | None = None
) -> Verification:
    """Measure the artefact in a capture and compare it with its calibrated values.

    Each calibrated size must agree with its certificate within both uncertainties (E_n at most 1, ISO/IEC 17043). With
    a limit, conformity must be proven (ISO 14253-1).

    Parameters
    ----------
    capture : Capture or path
        Scan of an artefact with calibrated sizes.
    calibration : Calibration, PolynomialCalibration or path
        Calibration of the sensor; only a joint one states its uncertainty.
    limit_mm : float, optional
        Maximum permissible error.

    Returns
    -------
    Verification
        Verdict on each calibrated quantity, and errors that the artefact cannot reveal.

    Raises
    ------
    EvaluationError
        The capture names no artefact with a calibrated size, or does not show it, or shows it on too few of its points.
        There is neither a limit nor a joint calibration, which states the uncertainty of the measurement.
    RangeError
        The limit is not positive.
    CalibrationError, CaptureError
        The calibration does not fit the capture, there is no stripe, or a file cannot be read.
    """
    if limit_mm is not None and not limit_mm > 0:
        raise RangeError(f"`limit_mm` is {limit_mm:g}; expected a positive number")
    calibration = resolve_calibration(calibration)
    with open_capture(capture) as scan:
        if calibration.joint is None and limit_mm is None:
            raise EvaluationError("the calibration states no uncertainty: give `limit_mm`, or calibrate jointly")
        if scan.header.artefact is None:
            raise EvaluationError(f"the header of {scan.path.name} names no artefact; add the artefact that it shows")
        artefact = parse_artefact(scan.header.artefact)
        cloud = reconstruct(scan, calibration)
        not_shown = find_undetectable_errors(artefact.kind, scan.stage_mm, scan.header.stage_direction)
    found = evaluate(cloud, artefact)
    counts = found.evaluation
    assert counts is not None
    if doubts := counts.doubts():
        raise EvaluationError(f"nothing is verified: {doubts[0]}")
    verdicts = tuple(
        Verdict(
            quantity=calibrated.name,
            calibrated_mm=calibrated.value_mm,
            measured_mm=figure.measured_mm,
            calibrated_expanded_mm=calibrated.uncertainty_mm,
            measured_expanded_mm=figure.expanded_uncertainty_mm,
            limit_mm=limit_mm,
        )
        for figure in found.figures
        if (calibrated := figure.key.calibrated) is not None and not figure.key.is_detail
    )
    if not verdicts:
        raise EvaluationError(f"the artefact '{artefact.kind}' has no calibrated size; add one to its description")
    outliers = counts.points_rejected / (counts.points_used + counts.points_rejected)
    share = (
        f"{100 * counts.strange_share:.1f} % of the points do not belong to the artefact; "
        f"{100 * outliers:.1f} % of its own are outliers (VDI/VDE 2634 allows 0.3 %)"
    )
    return Verification(verdicts, (share, *not_shown), scan.path.name, calibration_digest(calibration), cloud.warnings)


_ACROSS = 0.1
"""Largest ratio of the stage motion along the sheet at which a reversed stage mirrors the cloud instead of shearing."""


def find_undetectable_errors(kind: str, stage_mm: np.ndarray, direction: Vector) -> tuple[str, ...]:
    """Return warnings of errors that the sizes of an artefact cannot reveal.

    ``stage_mm`` (F,) are the stage positions of the images; ``direction`` is the direction of the stage in the OCS.
    """
    x, y, z = direction
    if len(np.unique(stage_mm)) < 2 or np.hypot(y, z) > _ACROSS * abs(x):
        return ()
    travel = "" if kind == "spheres" else "; and a wrong travel of the stage or missing images, which spheres show"
    return (
        f"not shown by the sizes of an artefact ({kind}): what mirrors the cloud, such as a reversed stage, files in "
        f"reverse order, or mirrored images{travel}. Check once with an object with lettering",
    )
