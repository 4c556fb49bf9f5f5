"""Checks of a running scan by its images: whether the laser emits light and whether the stage has lost steps.

Stage: the controller counts pulses, not motor steps. On an object with relief along the motion, the stripe moves
through the image as the stage moves; neighbouring images give the rate in px per mm. An early position is revisited at
the end: the stripe's displacement divided by that rate is the stage's error.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from uwlts.fitting.least_squares import robust_std
from uwlts.hardware.rig import are_enough, get_stripe
from uwlts.model.sensor import Sensor
from uwlts.stripe import Stripe, StripeStatus
from uwlts.stripe.capture_stripes import FEWEST_LINES

LOOKS = 9  # number of positions searched for a stripe before a scan is given up
_SAME_PX = 1.0  # stripes of two images within this distance are the same; edges caused by noise are displaced more
_ITS_OWN = 0.5  # smallest fraction of the stripe's height that vanishes when the laser is switched off


def select_evenly(positions_mm: Sequence[float], count: int) -> list[float]:
    """Select at most ``count`` positions, evenly distributed, including the first and the last."""
    chosen = np.unique(np.rint(np.linspace(0, len(positions_mm) - 1, count)).astype(int))
    return [positions_mm[k] for k in chosen]


def shows_laser(lit: np.ndarray, unlit: np.ndarray, sensor: Sensor, *, difference: bool) -> bool:
    """Return whether an image has a stripe that the image (H, W) at the same position without laser does not have.

    With ``difference`` the stripe is extracted from the difference. Otherwise
    it must also be in the image itself, because a lamp that is on only while the laser is off leaves a difference.
    """
    full = sensor.detector.full_scale_dn()
    added = get_stripe(lit, sensor, background=unlit)
    shown = added.status == StripeStatus.OK
    if not difference:
        alone = get_stripe(lit, sensor)
        # Noise on edges that daylight shows in both images is displaced, or lower.
        shown &= np.abs(alone.centre_px - added.centre_px) < _SAME_PX
        shown &= added.amplitude > _ITS_OWN * alone.amplitude
    flooded = ((lit >= full) & (unlit < full / 2)).any(axis=0 if sensor.camera.stripe_along == "width" else 1)
    return are_enough(int((shown | flooded).sum()), len(shown))


@dataclass(frozen=True)
class LitPlace:
    """Position in mm with a visible stripe, and its exposure in ms."""

    position_mm: float
    exposure_ms: float


LARGEST_MM = 0.05  # largest slip that is not reported: four steps of 0.0125 mm, comparable with the sensor's errors
_LEAST_RELIEF = 0.2
"""Smallest motion of the stripe in px per mm of the stage on lines that are used; below it noise dominates."""
_LARGEST_BEND_PX = 2.0  # a larger change of the motion between two images is caused by an edge
_SIGMAS = 4.0  # a slip within this many standard errors is not reported: 6e-5 false alarms per scan
_GRAIN = 2.0  # factor on the standard error of a mean, because neighbouring lines share their speckle


@dataclass(frozen=True, eq=False)
class Place(LitPlace):
    """A laser image: its position and exposure, and the stripe's centres (N,) in px, NaN without a stripe."""

    centre_px: np.ndarray


class SlipWatch:
    """Search for the earliest laser image of a scan that shows the stage's position, and the stage's slip in it.

    ``place`` is that image, or None if none has enough relief.
    """

    def __init__(self) -> None:
        self.place: Place | None = None
        self._motion_px_per_mm = np.empty(0)  # (N,), NaN on lines without relief
        self._latest: list[Place] = []

    def add(self, place: Place) -> None:
        """Consider an image; the middle one of three has enough relief if its error is a third of `LARGEST_MM`."""
        self._latest = [*self._latest[-2:], place]
        if self.place is not None or len(self._latest) < 3:
            return
        before, here, after = self._latest
        motion = (after.centre_px - before.centre_px) / (after.position_mm - before.position_mm)
        bend = after.centre_px - 2 * here.centre_px + before.centre_px
        with np.errstate(invalid="ignore"):
            steep = (np.abs(motion) > _LEAST_RELIEF) & (np.abs(bend) < _LARGEST_BEND_PX)
        # The bend has six times the variance of a centre, and a slip twice that variance.
        if steep.sum() >= FEWEST_LINES and _estimate_error(bend[steep] / np.sqrt(3), motion[steep]) <= LARGEST_MM / 3:
            self.place, self._motion_px_per_mm = here, np.where(steep, motion, np.nan)

    def measure_slip(self, again: np.ndarray) -> tuple[float, float]:
        """Return the stage's displacement in mm from new centres (N,) in px at this place, and its standard error.

        Both are infinite if too few lines remain.
        """
        assert self.place is not None
        shift = again - self.place.centre_px
        good = np.isfinite(shift) & np.isfinite(self._motion_px_per_mm)
        if good.sum() < FEWEST_LINES:
            return np.inf, np.inf
        motion, shift = self._motion_px_per_mm[good], shift[good]
        # The weighted median is robust to lines that now show another stripe.
        slips, weights = shift / motion, np.abs(motion)
        order = np.argsort(slips)
        heaped = np.cumsum(weights[order])
        slip_mm = float(slips[order][np.searchsorted(heaped, heaped[-1] / 2)])
        return slip_mm, _estimate_error(shift - slip_mm * motion, motion)

    def is_significant(self, slip_mm: float, error_mm: float) -> bool:
        """Return whether a slip exceeds `LARGEST_MM` and its uncertainty."""
        return np.isfinite(slip_mm) and abs(slip_mm) > max(LARGEST_MM, _SIGMAS * error_mm)


def select_centres(stripe: Stripe) -> np.ndarray:
    """Return the centres (N,) in px of the lines with one stripe, NaN on the others."""
    return np.where(stripe.status == StripeStatus.OK, stripe.centre_px, np.nan)


def _estimate_error(scatter_px: np.ndarray, motion_px_per_mm: np.ndarray) -> float:
    """Return the standard error in mm of the slip from all lines."""
    spread = robust_std(scatter_px - np.median(scatter_px))
    return float(_GRAIN * spread / np.sqrt(np.sum(motion_px_per_mm**2)))
