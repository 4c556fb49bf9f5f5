"""What images in new water changed: its index, and how well lengths in it are known."""

from dataclasses import dataclass

import numpy as np

from uwlts.calibration.joint.estimate import Estimate
from uwlts.calibration.joint.volume import Lengths, Region, estimate_in, lengths_over, regions
from uwlts.calibration.model import Calibration
from uwlts.calibration.parameter_keys import MediumIndex


@dataclass(frozen=True)
class LengthChange:
    """The length over the volume that was known worst before.

    Attributes
    ----------
    length_mm : float
    before_mm, after_mm : float
        Standard uncertainty by the calibration.
    longer_mm : float
        By how much it is measured longer than by what was known before.
    """

    length_mm: float
    before_mm: float
    after_mm: float
    longer_mm: float


@dataclass(frozen=True)
class WaterChange:
    """New water by its name, its index with its standard uncertainty before and after, and what a length gains."""

    name: str
    index_before: float
    std_before: float
    index: float
    std: float
    length: LengthChange | None

    def lines(self) -> list[str]:
        """The change in words."""
        lines = [
            f"index of {self.name}: {self.index_before:.5f} ± {self.std_before:.2g} before, {self.index:.5f} ± "
            f"{self.std:.2g} by the step (standard uncertainties)"
        ]
        if self.length is not None:
            length = self.length
            lines.append(
                f"a length of {length.length_mm:.0f} mm, the one known worst: ± {2 * length.before_mm:.4f} mm before, "
                f"± {2 * length.after_mm:.4f} mm now (k = 2, by the calibration); it is measured "
                f"{abs(length.longer_mm):.4f} mm {'longer' if length.longer_mm > 0 else 'shorter'}"
            )
        return lines


def water_changes(calibration: Calibration, result: Estimate) -> list[WaterChange]:
    """What an estimate to which an earlier one was known says of the media that are new in it and were seen.

    Parameters
    ----------
    calibration : Calibration
        That of the estimate.
    result : Estimate
    """
    parameters, earlier = result.parameters, result.parameters.earlier
    if earlier is None:
        return []
    count, before = len(earlier.values), parameters.prior_mean()
    before[:count] = earlier.values
    covariance = np.diag(parameters.prior_std() ** 2)
    covariance[:count] = 0.0
    covariance[:count, :count] = earlier.covariance
    std_before, std = np.sqrt(np.diag(covariance)), result.std()
    seen = {region.view.medium: region for region in regions(calibration)}
    found = []
    for number, name in enumerate(parameters.media):
        key = MediumIndex(name)
        place = parameters.keys.index(key)
        if place < count or number not in seen:
            continue
        lengths = _lengths(calibration, seen[number])
        found.append(
            WaterChange(
                name, float(before[place]), float(std_before[place]), float(result.values[place]),
                std[key],
                None if lengths is None else _length_change(lengths, result, before, covariance),
            )
        )  # fmt: skip
    return found


def _lengths(calibration: Calibration, region: Region) -> Lengths | None:
    return lengths_over(calibration, estimate_in(calibration, region), region) if region.has_area() else None


def _length_change(lengths: Lengths, result: Estimate, before: np.ndarray, covariance: np.ndarray) -> LengthChange:
    std = lengths.std_mm(covariance)
    worst = int(np.argmax(std))
    return LengthChange(
        length_mm=float(lengths.length_mm[worst]), before_mm=float(std[worst]),
        after_mm=float(lengths.std_mm(result.covariance)[worst]),
        longer_mm=float(lengths.by_parameters[worst] @ (result.values - before)),
    )  # fmt: skip
