"""Whether the stage has lost steps: an early place of a scan is visited again, and its picture compared.

The controller counts pulses and cannot know what the motor made of them. But where the object has relief along the
motion, its stripe moves through the image as the stage moves, by so many pixels per mm as its neighbours in the scan
tell; what the picture has moved between two visits of one place over that is by how much the stage stands elsewhere.
"""

from dataclasses import dataclass

import numpy as np

from uwlts.metrology.robust_fit import MAD_TO_STD
from uwlts.stripe import Stripe, StripeStatus

LARGEST_MM = 0.05
"""From here on steps are lost: four of 0.0125 mm, as much as the sensor's errors."""
_LEAST_RELIEF = 0.2
"""Way of the stripe in px per mm of the stage on lines that tell something; elsewhere its noise is no way."""
_LARGEST_BEND_PX = 2.0
"""Where the way changes by more from one image to the next there is an edge."""
_FEWEST_LINES = 20
_SIGMAS = 4.0
_GRAIN = 2.0
"""Neighbouring lines share their speckle, so that the scatter of their mean is so many times as large."""


@dataclass(frozen=True, eq=False)
class Place:
    """A laser image: its position and exposure, and the stripe's centres (N,) in px, NaN where there is none."""

    position_mm: float
    exposure_ms: float
    centre_px: np.ndarray


@dataclass(frozen=True, eq=False)
class Relief:
    """A place whose picture tells where the stage is: ``way_px_per_mm`` (N,), NaN on lines that tell nothing."""

    place: Place
    way_px_per_mm: np.ndarray

    def slip(self, again: np.ndarray) -> tuple[float, float]:
        """How far from it, in mm, the stage stands when the place shows the centres (N,) in px, and the standard error.

        Infinite where too few lines are left.
        """
        away = again - self.place.centre_px
        good = np.isfinite(away) & np.isfinite(self.way_px_per_mm)
        if good.sum() < _FEWEST_LINES:
            return np.inf, np.inf
        way, away = self.way_px_per_mm[good], away[good]
        # A weighted median of the slips that the lines tell: a line whose stripe is another one now has no say.
        slips, weights = away / way, np.abs(way)
        order = np.argsort(slips)
        heaped = np.cumsum(weights[order])
        slip_mm = float(slips[order][np.searchsorted(heaped, heaped[-1] / 2)])
        return slip_mm, _standard_error(away - slip_mm * way, way)

    def tells(self, slip_mm: float, error_mm: float) -> bool:
        """Whether the stage has slipped beyond doubt."""
        return np.isfinite(slip_mm) and abs(slip_mm) > max(LARGEST_MM, _SIGMAS * error_mm)


class SlipWatch:
    """Looks at the laser images of a scan, in their order, for the earliest place that tells where the stage is.

    Attributes
    ----------
    relief : Relief or None
    """

    def __init__(self) -> None:
        self.relief: Relief | None = None
        self._latest: list[Place] = []

    def see(self, place: Place) -> None:
        """Take an image into account."""
        if self.relief is None:
            self._latest = [*self._latest[-2:], place]
            self.relief = _relief(*self._latest) if len(self._latest) == 3 else None


def centres_of(stripe: Stripe) -> np.ndarray:
    """Centres (N,) in px of the lines with one stripe, NaN on the others."""
    return np.where(stripe.status == StripeStatus.OK, stripe.centre_px, np.nan)


def _relief(before: Place, here: Place, after: Place) -> Relief | None:
    """What the place between two others tells, None where that is more than a third of `LARGEST_MM` in doubt."""
    way = (after.centre_px - before.centre_px) / (after.position_mm - before.position_mm)
    bend = after.centre_px - 2 * here.centre_px + before.centre_px
    with np.errstate(invalid="ignore"):
        tells = (np.abs(way) > _LEAST_RELIEF) & (np.abs(bend) < _LARGEST_BEND_PX)
    # The bend has six times the variance of a centre, which counts twice in it, and a slip twice that of a centre.
    if tells.sum() < _FEWEST_LINES or _standard_error(bend[tells] / np.sqrt(3), way[tells]) > LARGEST_MM / 3:
        return None
    return Relief(here, np.where(tells, way, np.nan))


def _standard_error(scatter_px: np.ndarray, way_px_per_mm: np.ndarray) -> float:
    """Of the slip that lines tell together, in mm."""
    spread = MAD_TO_STD * np.median(np.abs(scatter_px - np.median(scatter_px)))
    return float(_GRAIN * spread / np.sqrt(np.sum(way_px_per_mm**2)))
