"""Which calibrated quantity an artefact's figure is the error of."""

import re
from dataclasses import dataclass

from uwlts.metrology.artefact_descriptions import Artefact, Pipe, SphereStandard, StepStandard


@dataclass(frozen=True)
class CalibratedQuantity:
    """A quantity of an artefact in mm: calibrated value and, if stated, its expanded uncertainty (k = 2)."""

    name: str
    value_mm: float
    uncertainty_mm: float | None


def calibrated_quantity(figure: str, artefact: Artefact | None) -> CalibratedQuantity | None:
    """The quantity whose error a figure of `Evaluation.figures_mm` is; None where it is no error of one."""
    numbers = [int(number) for number in re.findall(r"\d+", figure)]
    which = numbers[0] - 1 if numbers else 0
    match artefact:
        case SphereStandard() if figure.startswith("SSE") and which < len(artefact.spacings_mm):
            pair = figure.removeprefix("SSE")
            known = artefact.spacing_uncertainty_mm
            return CalibratedQuantity(f"sphere spacing{pair}", artefact.spacings_mm[which], known)
        case SphereStandard() if figure.startswith("diameter error") and which < len(artefact.diameters_mm):
            known = artefact.diameter_uncertainty_mm
            return CalibratedQuantity(f"diameter, sphere {which + 1}", artefact.diameters_mm[which], known)
        case StepStandard() if figure == "height error":
            return CalibratedQuantity("step height", artefact.height_mm, artefact.height_uncertainty_mm)
        case Pipe() if figure == "diameter error":
            return CalibratedQuantity("pipe diameter", artefact.diameter_mm, artefact.diameter_uncertainty_mm)
    return None
