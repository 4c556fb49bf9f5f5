"""Verification in the field: a known object is measured, and the result must agree with its certificate."""

from dataclasses import dataclass

import numpy as np

from uwlts.calibration.any_calibration import AnyCalibration
from uwlts.capture import Capture
from uwlts.errors import EvaluationError
from uwlts.metrology.artefact_descriptions import parse_artefact
from uwlts.metrology.artefacts import evaluate_cloud
from uwlts.metrology.calibrated import calibrated_quantity
from uwlts.scan import reconstruct_capture
from uwlts.uncertainty.figures import figure_uncertainties


@dataclass(frozen=True)
class Verdict:
    """One calibrated quantity, measured.

    Attributes
    ----------
    quantity : str
    calibrated_mm, measured_mm : float
    reference_mm, measurement_mm : float or None
        Expanded uncertainties (k = 2) of the calibrated and of the measured value; None where not known.
    limit_mm : float or None
        Largest permissible error.
    """

    quantity: str
    calibrated_mm: float
    measured_mm: float
    reference_mm: float | None
    measurement_mm: float | None
    limit_mm: float | None

    @property
    def error_mm(self) -> float:
        """Measured less calibrated value."""
        return self.measured_mm - self.calibrated_mm

    @property
    def expanded_mm(self) -> float:
        """Expanded uncertainty of the error, of what is known of it."""
        return float(np.hypot(self.reference_mm or 0.0, self.measurement_mm or 0.0))

    @property
    def normalised_error(self) -> float | None:
        """E_n of ISO/IEC 17043: the error over its expanded uncertainty; None where the measurement tells none."""
        return None if self.measurement_mm is None else abs(self.error_mm) / self.expanded_mm

    @property
    def passed(self) -> bool:
        """Whether E_n is 1 at most and the error within its limit, as far as there are these.

        The limit is kept if the error and its expanded uncertainty together do (ISO 14253-1, conformity proven).
        """
        agrees = self.normalised_error is None or self.normalised_error <= 1.0
        return agrees and (self.limit_mm is None or abs(self.error_mm) + self.expanded_mm <= self.limit_mm)

    def words(self) -> str:
        """The verdict in one line."""
        said = f"{self.quantity}: {self.measured_mm:.4f} mm, calibrated {self.calibrated_mm:.4f} mm, "
        said += f"error {self.error_mm:+.4f} ± {self.expanded_mm:.4f} mm"
        if self.normalised_error is not None:
            said += f", E_n {self.normalised_error:.2f}"
        if self.limit_mm is not None:
            said += f", limit {self.limit_mm:g} mm"
        return f"{said}: {'pass' if self.passed else 'FAIL'}"


def verify(capture: Capture, calibration: AnyCalibration, *, limit_mm: float | None = None) -> list[Verdict]:
    """Measure the artefact that a capture shows and compare it with its calibrated values.

    Raises
    ------
    EvaluationError
        The capture names no artefact with a calibrated size, does not show it, or there is nothing to judge by: neither
        a limit nor a joint calibration, which alone knows the measurement's uncertainty.
    CalibrationError, CaptureError
        The calibration does not fit the capture, or there is no stripe.
    """
    joint = calibration.joint is not None
    if not joint and limit_mm is None:
        raise EvaluationError("the calibration tells no uncertainty to judge by: give --limit, or calibrate jointly")
    if capture.header.artefact is None:
        raise EvaluationError(f"{capture.path.name} does not say what it shows: its header needs an artefact")
    artefact = parse_artefact(capture.header.artefact)
    cloud = reconstruct_capture(capture, calibration, with_uncertainty=joint).cloud
    evaluation = evaluate_cloud(cloud, artefact)
    known = figure_uncertainties(cloud, artefact, evaluation)
    verdicts = []
    for figure, error in evaluation.figures_mm.items():
        quantity = calibrated_quantity(figure, artefact)
        if quantity is not None and "known radius" not in figure:
            measurement = known[figure].expanded_mm if figure in known else None
            verdicts.append(
                Verdict(quantity.name, quantity.value_mm, quantity.value_mm + error, quantity.uncertainty_mm,
                        measurement, limit_mm)
            )  # fmt: skip
    if not verdicts:
        raise EvaluationError(f"the artefact '{artefact.kind}' has no calibrated size to verify by")
    return verdicts
