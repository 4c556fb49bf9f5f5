"""Verification in the field: a known object is measured, and the result must agree with its certificate."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from uwlts.errors import EvaluationError, RangeError
from uwlts.evaluation.artefact_figures import evaluate_cloud
from uwlts.evaluation.figure_uncertainty import figure_uncertainties
from uwlts.model.any_calibration import AnyCalibration
from uwlts.model.artefacts import parse_artefact
from uwlts.model.sensor import Vector
from uwlts.reconstruction.reconstruct import reconstruct
from uwlts.storage.calibration_file import loaded_calibration
from uwlts.storage.capture import Capture, opened_capture


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """One calibrated quantity, measured, mm.

    The ``expanded`` values are uncertainties (k = 2), None where not known; ``limit_mm`` is the largest permissible
    error, if any.
    """

    quantity: str
    calibrated_mm: float
    measured_mm: float
    calibrated_expanded_mm: float | None
    measured_expanded_mm: float | None
    limit_mm: float | None

    @property
    def error_mm(self) -> float:
        """Measured less calibrated value."""
        return self.measured_mm - self.calibrated_mm

    @property
    def expanded_mm(self) -> float:
        """Expanded uncertainty of the error, of what is known of it."""
        return float(np.hypot(self.calibrated_expanded_mm or 0.0, self.measured_expanded_mm or 0.0))

    @property
    def normalised_error(self) -> float | None:
        """E_n of ISO/IEC 17043: error over expanded uncertainty; None where the measured value's is not known."""
        return None if self.measured_expanded_mm is None else abs(self.error_mm) / self.expanded_mm

    @property
    def passed(self) -> bool:
        """Whether E_n is 1 at most and the error within its limit, as far as there are these.

        The limit is kept if the error and its expanded uncertainty together do (ISO 14253-1, conformity proven).
        """
        agrees = self.normalised_error is None or self.normalised_error <= 1.0
        return agrees and (self.limit_mm is None or abs(self.error_mm) + self.expanded_mm <= self.limit_mm)

    @property
    def text(self) -> str:
        """The verdict in one line."""
        text = f"{self.quantity}: {self.measured_mm:.4f} mm, calibrated {self.calibrated_mm:.4f} mm, "
        text += f"error {self.error_mm:+.4f} ± {self.expanded_mm:.4f} mm"
        agreement = "" if self.normalised_error is None else f", E_n {self.normalised_error:.2f}"
        limit = "" if self.limit_mm is None else f", limit {self.limit_mm:g} mm"
        return f"{text}{agreement}{limit}: {'pass' if self.passed else 'FAIL'}"


@dataclass(frozen=True)
class Verification:
    """Verdicts on all calibrated quantities of an artefact, and what such an artefact cannot show."""

    verdicts: tuple[Verdict, ...]
    not_shown: tuple[str, ...] = ()

    @property
    def passed(self) -> bool:
        """Whether all verdicts are passed."""
        return all(verdict.passed for verdict in self.verdicts)

    @property
    def text(self) -> str:
        """One line for each verdict."""
        return "\n".join(verdict.text for verdict in self.verdicts)


def verify(
    capture: Capture | str | Path, calibration: AnyCalibration | str | Path, *, limit_mm: float | None = None
) -> Verification:
    """Measure the artefact that a capture shows and compare it with its calibrated values.

    Each calibrated size must agree with its certificate within both uncertainties (E_n at most 1, ISO/IEC 17043) and,
    with a limit, conform to it beyond doubt (ISO 14253-1).

    Parameters
    ----------
    capture : Capture or path
        Scan of an artefact with calibrated sizes.
    calibration : Calibration, PolynomialCalibration or path
        Calibration of the sensor; a joint one holds its uncertainty.
    limit_mm : float, optional
        Largest permissible error.

    Raises
    ------
    EvaluationError
        The capture names no artefact with a calibrated size, does not show it, or there is nothing to judge by: neither
        a limit nor a joint calibration, which alone holds the measurement's uncertainty.
    RangeError
        The limit is not positive.
    CalibrationError, CaptureError
        The calibration does not fit the capture, there is no stripe, or a file cannot be read.
    """
    if limit_mm is not None and not limit_mm > 0:
        raise RangeError(f"`limit_mm` is {limit_mm:g}; a permissible error is positive")
    calibration = loaded_calibration(calibration)
    with opened_capture(capture) as scan:
        if calibration.joint is None and limit_mm is None:
            advice = "give `limit_mm`, or calibrate jointly"
            raise EvaluationError(f"the calibration holds no uncertainty to judge by: {advice}")
        if scan.header.artefact is None:
            raise EvaluationError(f"{scan.path.name} does not say what it shows: its header needs an artefact")
        artefact = parse_artefact(scan.header.artefact)
        cloud = reconstruct(scan, calibration)
        not_shown = not_shown_by(artefact.kind, scan.stage_mm, scan.header.stage_direction)
    evaluation = evaluate_cloud(cloud, artefact)
    known = figure_uncertainties(cloud, evaluation)
    verdicts = tuple(
        Verdict(
            quantity=calibrated.name,
            calibrated_mm=calibrated.value_mm,
            measured_mm=figure.measured_mm,
            calibrated_expanded_mm=calibrated.uncertainty_mm,
            measured_expanded_mm=known[figure.key.name].expanded_mm if figure.key.name in known else None,
            limit_mm=limit_mm,
        )
        for figure in evaluation.figures
        if (calibrated := figure.key.calibrated) is not None and not figure.key.is_detail
    )
    if not verdicts:
        raise EvaluationError(f"the artefact '{artefact.kind}' has no calibrated size to verify by")
    return Verification(verdicts, not_shown)


_ACROSS = 0.1
"""Share of a stage's motion along the sheet below which a reversed stage makes a mirror image rather than a shear."""


def not_shown_by(kind: str, stage_mm: np.ndarray, direction: Vector) -> tuple[str, ...]:
    """What the sizes of an artefact of a kind say nothing of.

    ``stage_mm`` (F,) are the positions of its images, ``direction`` is that in which the stage moves the sensor, OCS.
    """
    x, y, z = direction
    if len(np.unique(stage_mm)) < 2 or np.hypot(y, z) > _ACROSS * abs(x):
        return ()
    return (
        "not shown: whether the stage moves as its direction says or the other way; the sizes of an artefact "
        f"({kind}) are the same in a mirror image. Look once at the cloud of something with lettering",
    )
