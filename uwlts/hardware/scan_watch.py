"""Checks of a running scan by its images: whether the laser gives light and whether the stage has lost steps.

Laser: an image without a stripe may be right, because the object has been passed or is not reached yet. So where the
stripe is gone, or much smaller than in the image before, an image with the laser off is taken; if both show the same,
the stage returns to where the stripe was last seen. If the stripe is there, the scan goes on; if not, the laser has
failed. A scan that has seen no stripe yet looks for one at positions all over the plan.

Stage: the controller counts pulses, not motor steps. Where the object has relief along the motion, its stripe moves
through the image as the stage moves, by a number of pixels per mm that neighbouring images give. An early position is
visited again at the end; the stripe's displacement over that rate is the stage's error.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from uwlts.errors import HardwareError
from uwlts.fitting.least_squares import robust_std
from uwlts.hardware.rig import Rig, not_few, stripe_of
from uwlts.model.sensor import Sensor
from uwlts.storage.capture import Seen
from uwlts.stripe import Stripe, StripeStatus

LOOKS = 9
"""Positions at which a stripe is looked for before a scan is given up."""
_DROP = 0.5
"""A stripe on fewer lines, or at a lower level, than this share of the image before is checked."""
_AGAIN = 25
"""After so many images without stripe the laser is tried again."""
_SAME_PX = 1.0
"""Stripes of both images within this distance are the same; edges shown by noise lie elsewhere."""
_ITS_OWN = 0.5
"""Of a stripe of the laser at least this share of the height is gone when the laser is off."""


def spread(positions_mm: Sequence[float], count: int) -> list[float]:
    """At most so many of the positions, evenly spread, the first and the last among them."""
    chosen = np.unique(np.rint(np.linspace(0, len(positions_mm) - 1, count)).astype(int))
    return [positions_mm[k] for k in chosen]


def shows_laser(lit: Seen, unlit: Seen, sensor: Sensor, *, difference: bool) -> bool:
    """Whether an image has a stripe that another one (H, W) of the same place without laser does not have.

    The same of two centre lines. ``difference``: the stripe is measured in the difference of both; else it has to be in
    the image itself, as a lamp that is on while the laser is off leaves a difference of its own.
    """
    if isinstance(lit, Stripe) or isinstance(unlit, Stripe):
        with_laser, without = (centres_of(stripe_of(each, sensor)) for each in (lit, unlit))
        own = np.isfinite(with_laser) & ~(np.abs(with_laser - without) < _SAME_PX)
        return not_few(int(own.sum()), len(own))
    full = sensor.detector.full_scale_dn()
    added = stripe_of(lit, sensor, background=unlit)
    shown = added.status == StripeStatus.OK
    if not difference:
        alone = stripe_of(lit, sensor)
        # Elsewhere, or lower, is what noise leaves of edges that daylight shows in both.
        shown &= np.abs(alone.centre_px - added.centre_px) < _SAME_PX
        shown &= added.amplitude > _ITS_OWN * alone.amplitude
    flooded = ((lit >= full) & (unlit < full / 2)).any(axis=0 if sensor.camera.stripe_along == "width" else 1)
    return not_few(int((shown | flooded).sum()), len(shown))


@dataclass(frozen=True)
class LitPlace:
    """A position in mm at which the laser's stripe was seen, and with which exposure in ms."""

    position_mm: float
    exposure_ms: float


class LaserWatch:
    """Looks at every laser image of a scan.

    ``lit`` is where the stripe is known to be seen; ``difference`` as in `shows_laser`.
    """

    def __init__(self, rig: Rig, sensor: Sensor, positions_mm: Sequence[float], *, difference: bool):
        self._rig, self._sensor, self._difference = rig, sensor, difference
        self._positions_mm = positions_mm
        self.lit: LitPlace | None = None
        self._usual: tuple[int, float] | None = None
        self._without = 0

    def see(
        self, image: Seen, stripe: Stripe, level: float, here: LitPlace, *, unlit: np.ndarray | None, last: bool
    ) -> None:
        """Judge a laser image (H, W) or centre line, its stripe and its brightness ``level``, before it is stored.

        ``unlit`` is an image without laser beside it, if there is one; ``last``: no further image comes. May move the
        stage. HardwareError where the laser gives no light.
        """
        now = (int((stripe.status != StripeStatus.NO_STRIPE).sum()), level)
        if self._usual is None or any(a < _DROP * b for a, b in zip(now, self._usual, strict=True)):
            dark = self._rig.frame("lamp", here.exposure_ms).seen if unlit is None else unlit
            if not shows_laser(image, dark, self._sensor, difference=self._difference):
                self._without += 1
                if last or self._without % _AGAIN == 1:
                    self._look_elsewhere(here)
                return
        self._usual, self.lit, self._without = now, here, 0

    def _look_elsewhere(self, here: LitPlace) -> None:
        """See the stripe where it was, or somewhere; HardwareError where it is not."""
        others = [position for position in spread(self._positions_mm, LOOKS) if position != here.position_mm]
        for place in [self.lit] if self.lit else [LitPlace(position, here.exposure_ms) for position in others]:
            self._rig.move_to(place.position_mm)
            lit, unlit = (self._rig.frame(light, place.exposure_ms).seen for light in ("laser", "lamp"))
            if shows_laser(lit, unlit, self._sensor, difference=self._difference):
                self.lit = place
                self._rig.move_to(here.position_mm)
                return
        if self.lit is None:
            raise self.no_light(here.exposure_ms)
        passed = self._without - 1
        also = f"; the {passed} images before this one were without a stripe too" if passed else ""
        raise HardwareError(
            f"the laser has failed: at {self.lit.position_mm:g} mm, where its stripe was seen before, images with the "
            f"laser on and off show the same{also}. Check its supply, key and interlock, then go on with `resume`"
        )

    def no_light(self, exposure_ms: float) -> HardwareError:
        """The error of a scan that sees no stripe anywhere."""
        looked = spread(self._positions_mm, LOOKS)
        return HardwareError(
            f"no laser light at any of {len(looked)} positions from {looked[0]:g} to {looked[-1]:g} mm, exposed by "
            f"{exposure_ms:.3g} ms: images with the laser on and off show the same. Is the laser lit (supply, key, "
            "interlock), the object in the volume, the lens open?"
        )


LARGEST_MM = 0.05
"""From here on steps are lost: four of 0.0125 mm, as much as the sensor's errors."""
_LEAST_RELIEF = 0.2
"""Motion of the stripe in px per mm of the stage on lines that are used; below it noise dominates."""
_LARGEST_BEND_PX = 2.0
"""A change of the motion above this from one image to the next is an edge."""
_FEWEST_LINES = 20
"""Lines from which a median and its scatter are estimated."""
_SIGMAS = 4.0
"""A slip within this many standard errors is not reported: 6e-5 false alarms per scan."""
_GRAIN = 2.0
"""Neighbouring lines share their speckle, so that the scatter of their mean is so many times as large."""


@dataclass(frozen=True, eq=False)
class Place(LitPlace):
    """A laser image: its position and exposure, and the stripe's centres (N,) in px, NaN where there is none."""

    centre_px: np.ndarray


@dataclass(frozen=True, eq=False)
class Relief:
    """A place whose image shows where the stage is: ``motion_px_per_mm`` (N,), NaN on lines without relief."""

    place: Place
    motion_px_per_mm: np.ndarray

    def slip(self, again: np.ndarray) -> tuple[float, float]:
        """Distance of the stage from it in mm when the place shows the centres (N,) in px, and its standard error.

        Infinite where too few lines are left.
        """
        away = again - self.place.centre_px
        good = np.isfinite(away) & np.isfinite(self.motion_px_per_mm)
        if good.sum() < _FEWEST_LINES:
            return np.inf, np.inf
        motion, away = self.motion_px_per_mm[good], away[good]
        # A weighted median over the lines is robust to lines on which another stripe is found now.
        slips, weights = away / motion, np.abs(motion)
        order = np.argsort(slips)
        heaped = np.cumsum(weights[order])
        slip_mm = float(slips[order][np.searchsorted(heaped, heaped[-1] / 2)])
        return slip_mm, _standard_error(away - slip_mm * motion, motion)

    def is_significant(self, slip_mm: float, error_mm: float) -> bool:
        """Whether the stage has slipped beyond doubt."""
        return np.isfinite(slip_mm) and abs(slip_mm) > max(LARGEST_MM, _SIGMAS * error_mm)


class SlipWatch:
    """Finds the earliest laser image of a scan with enough ``relief`` to show where the stage is."""

    def __init__(self) -> None:
        self.relief: Relief | None = None
        self._latest: list[Place] = []

    def see(self, place: Place) -> None:
        """Take an image into account."""
        self._latest = [*self._latest[-2:], place]
        if self.relief is None and len(self._latest) == 3:
            self.relief = _relief(*self._latest)


def centres_of(stripe: Stripe) -> np.ndarray:
    """Centres (N,) in px of the lines with one stripe, NaN on the others."""
    return np.where(stripe.status == StripeStatus.OK, stripe.centre_px, np.nan)


def _relief(before: Place, here: Place, after: Place) -> Relief | None:
    """Relief of the place between two others; None where its uncertainty exceeds a third of `LARGEST_MM`."""
    motion = (after.centre_px - before.centre_px) / (after.position_mm - before.position_mm)
    bend = after.centre_px - 2 * here.centre_px + before.centre_px
    with np.errstate(invalid="ignore"):
        steep = (np.abs(motion) > _LEAST_RELIEF) & (np.abs(bend) < _LARGEST_BEND_PX)
    # The bend has six times the variance of a centre, which counts twice in it, and a slip twice that of a centre.
    if steep.sum() < _FEWEST_LINES or _standard_error(bend[steep] / np.sqrt(3), motion[steep]) > LARGEST_MM / 3:
        return None
    return Relief(here, np.where(steep, motion, np.nan))


def _standard_error(scatter_px: np.ndarray, motion_px_per_mm: np.ndarray) -> float:
    """Standard error of the slip of all lines, in mm."""
    spread = robust_std(scatter_px - np.median(scatter_px))
    return float(_GRAIN * spread / np.sqrt(np.sum(motion_px_per_mm**2)))
