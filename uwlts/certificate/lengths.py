"""What lengths measured with a joint calibration are worth, along the axes of the OCS over the covered volume."""

from dataclasses import dataclass

import numpy as np

from uwlts.calibration.joint.observations import STEP, STRIPE
from uwlts.calibration.joint.stored import StoredEstimate, require_joint
from uwlts.calibration.joint.surfaces import SCANNED
from uwlts.calibration.joint.volume import Lengths, Region, estimate_in, lengths_between, points_at
from uwlts.calibration.model import Calibration
from uwlts.calibration.parameter_keys import MediumIndex
from uwlts.sensor import Uncertainty

LENGTHS_MM = (10.0, 20.0, 50.0, 100.0, 150.0, 200.0, 300.0, 500.0)
_PLACES = 9


@dataclass(frozen=True)
class Worth:
    """Expanded uncertainties (k = 2) in mm of one length along one axis, the largest over the volume.

    Attributes
    ----------
    axis : {"X", "Y", "Z"}
    length_mm : float
    calibration_mm : float
        By the calibration alone, as for points averaged over surfaces; along X by the stage alone.
    point_mm : float
        With the noise of a single stripe centre at each end.
    """

    axis: str
    length_mm: float
    calibration_mm: float
    point_mm: float


@dataclass(frozen=True, eq=False)
class InUse:
    """A joint estimate as it holds for measurements, in the region that it covers.

    ``covariance`` (P, P) is that of the estimate with the drift of the medium's index since; ``noise_px`` the standard
    deviation of a stripe's centre.
    """

    calibration: Calibration
    region: Region
    known: StoredEstimate
    covariance: np.ndarray
    uncertainty: Uncertainty
    noise_px: float


def in_use(calibration: Calibration, region: Region) -> InUse:
    """A joint calibration in one of its regions; CalibrationError where it is damaged."""
    known = estimate_in(calibration, region)
    uncertainty = calibration.origin().known_before
    covariance, index = known.covariance.copy(), index_key(known)
    if index in known.parameters.keys:
        place = known.parameters.keys.index(index)
        drift = region.medium.index_per_kelvin(calibration.wavelength_nm) * uncertainty.drift_k
        covariance[place, place] += drift**2
    scatter = require_joint(calibration).scatter_px
    noise = next((scatter[kind] for kind in (STRIPE, STEP, *SCANNED) if kind in scatter), 0.0)
    return InUse(calibration, region, known, covariance, uncertainty, noise)


def index_key(known: StoredEstimate) -> MediumIndex | None:
    """The index of what the camera looks into; None in air."""
    return None if known.view.medium is None else known.parameters.index_key(known.view.medium)


def worth_of_lengths(use: InUse) -> list[Worth]:
    """Every length that fits into the volume, along X, Y and Z."""
    found = [_along_x(length, use.uncertainty) for length in LENGTHS_MM]
    for axis in "YZ":
        for length in LENGTHS_MM:
            ends = ends_over(use.region, axis, length)
            if len(ends):
                known = lengths_of(use, ends)
                found.append(
                    Worth(
                        axis, length, 2 * float(known.std_mm(use.covariance).max()),
                        2 * float(known.std_mm(use.covariance, noise_px=use.noise_px).max()),
                    )
                )  # fmt: skip
    fitting = {worth.length_mm for worth in found if worth.axis != "X"}
    return [worth for worth in found if worth.length_mm in fitting]


def lengths_of(use: InUse, ends: np.ndarray) -> Lengths:
    """Lengths between Y and Z (M, 2, 2)."""
    points = points_at(use.calibration, use.known, ends.reshape(-1, 2))
    first = 2 * np.arange(len(ends))
    return lengths_between(points, first, first + 1)


def _along_x(length_mm: float, uncertainty: Uncertainty) -> Worth:
    """A length along the stage's motion: the same place of the sheet sees both ends, so that only the stage counts."""
    std = float(np.hypot(np.sqrt(2.0) * uncertainty.stage_position_mm, uncertainty.stage_scale * length_mm))
    return Worth("X", length_mm, 2 * std, 2 * std)


def ends_over(region: Region, axis: str, length_mm: float) -> np.ndarray:
    """Ends (M, 2, 2) of lengths along an axis all over a region; none where it does not fit."""
    depths = region.mesh(_PLACES, 2)[:, 0, 1]
    found = []
    if axis == "Y":
        for depth in depths:
            low, high = region.width_at(depth)
            starts = np.linspace(low, high - length_mm, _PLACES) if high - low >= length_mm else ()
            found += [((y, depth), (y + length_mm, depth)) for y in starts]
    elif np.ptp(depths) >= length_mm:
        for depth in np.linspace(depths[0], depths[-1] - length_mm, _PLACES):
            low, high = zip(region.width_at(depth), region.width_at(depth + length_mm), strict=True)
            starts = np.linspace(max(low), min(high), _PLACES) if max(low) < min(high) else ()
            found += [((y, depth), (y, depth + length_mm)) for y in starts]
    return np.array(found).reshape(-1, 2, 2)
