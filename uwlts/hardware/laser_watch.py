"""Notices a laser that gives no light although its pin is on, which no controller can tell.

An image without stripe may be right: the object has been passed, or not been reached. So where the stripe is gone, or
much less than in the image before, an image with the laser off is taken beside it; where both show the same, the stage
goes back to where the stripe was last seen. If it is there, the laser is well and the scan goes on; if it is not, the
laser has failed. A scan that has seen no stripe yet looks for one at positions all over the plan.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from uwlts.errors import HardwareError
from uwlts.hardware.exposure import Brightness, not_few
from uwlts.hardware.rig import Rig
from uwlts.sensor import Sensor
from uwlts.stripe import Stripe, StripeStatus, extract_stripe

LOOKS = 9
"""Positions at which a stripe is looked for before a scan is given up."""
_DROP = 0.5
_AGAIN = 25
"""After so many images without stripe the laser is tried anew."""
_SAME_PX = 1.0
_ITS_OWN = 0.5
"""Of a stripe of the laser at least this share of the height is gone when the laser is off."""


def spread(positions_mm: Sequence[float], count: int) -> list[float]:
    """At most so many of the positions, evenly spread, the first and the last among them."""
    chosen = np.unique(np.rint(np.linspace(0, len(positions_mm) - 1, count)).astype(int))
    return [positions_mm[k] for k in chosen]


def shows_laser(lit: np.ndarray, unlit: np.ndarray, sensor: Sensor, *, difference: bool) -> bool:
    """Whether an image has a stripe that another one (H, W) of the same place without laser has not.

    ``difference`` tells that the stripe is measured in the difference of both; else it has to be in the image itself,
    as a lamp that is on while the laser is off leaves a difference of its own.
    """
    along, full = sensor.camera.stripe_along, sensor.detector.full_scale_dn()
    added = extract_stripe(lit, stripe_along=along, saturation=full, background=unlit)
    shown = added.status == StripeStatus.OK
    if not difference:
        alone = extract_stripe(lit, stripe_along=along, saturation=full)
        # Elsewhere, or lower, is what noise leaves of edges that daylight shows in both.
        shown &= np.abs(alone.centre_px - added.centre_px) < _SAME_PX
        shown &= added.amplitude > _ITS_OWN * alone.amplitude
    flooded = ((lit >= full) & (unlit < full / 2)).any(axis=0 if along == "width" else 1)
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

    def __init__(
        self, rig: Rig, sensor: Sensor, positions_mm: Sequence[float], *, difference: bool, lit: LitPlace | None = None
    ):
        self._rig, self._sensor, self._difference = rig, sensor, difference
        self._positions_mm, self._lit = positions_mm, lit
        self._usual: tuple[int, float] | None = None
        self._without = 0

    def see(
        self,
        image: np.ndarray,
        stripe: Stripe,
        bright: Brightness,
        place: LitPlace,
        *,
        unlit: np.ndarray | None = None,
        last: bool = False,
    ) -> None:
        """Judge a laser image (H, W), its stripe and brightness, before it is stored; may move the stage.

        ``unlit`` is an image without laser beside it, if there is one; ``last`` tells that no further image comes.

        Raises
        ------
        HardwareError
            The laser gives no light.
        """
        now = (int((stripe.status != StripeStatus.NO_STRIPE).sum()), bright.level)
        if self._usual is None or any(a < _DROP * b for a, b in zip(now, self._usual, strict=True)):
            unlit = self._rig.image("lamp", place.exposure_ms)[0] if unlit is None else unlit
            if not shows_laser(image, unlit, self._sensor, difference=self._difference):
                self._without += 1
                if last or self._without % _AGAIN == 1:
                    self._look_elsewhere(place)
                return
        self._usual, self._lit, self._without = now, place, 0

    def _look_elsewhere(self, here: LitPlace) -> None:
        """See the stripe where it was, or somewhere; HardwareError where it is not."""
        wanted = [self._lit] if self._lit else [
            LitPlace(position, here.exposure_ms)
            for position in spread(self._positions_mm, LOOKS) if position != here.position_mm
        ]  # fmt: skip
        for place in wanted:
            self._rig.move_to(place.position_mm)
            lit, unlit = (self._rig.image(light, place.exposure_ms)[0] for light in ("laser", "lamp"))
            if shows_laser(lit, unlit, self._sensor, difference=self._difference):
                self._lit = place
                self._rig.move_to(here.position_mm)
                return
        if self._lit is None:
            raise no_light(self._positions_mm, here.exposure_ms)
        passed = self._without - 1
        also = f"; the {passed} images before this one were without a stripe too" if passed else ""
        raise HardwareError(
            f"the laser has failed: at {self._lit.position_mm:g} mm, where its stripe was seen before, images with the "
            f"laser on and off show the same{also}. Check its supply, key and interlock, then go on with --resume"
        )


def no_light(positions_mm: Sequence[float], exposure_ms: float) -> HardwareError:
    """The error of a scan that sees no stripe anywhere."""
    looked = spread(positions_mm, LOOKS)
    return HardwareError(
        f"no laser light at any of {len(looked)} positions from {looked[0]:g} to {looked[-1]:g} mm, exposed by "
        f"{exposure_ms:.3g} ms: images with the laser on and off show the same. Is the laser lit (supply, key, "
        "interlock), the object in the volume, the lens open?"
    )
