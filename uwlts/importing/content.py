"""What the images of a folder show, looked at while they pass: black, saturated, without a stripe."""

from dataclasses import dataclass, field

import numpy as np

from uwlts.errors import ImageError
from uwlts.sensor import Sensor
from uwlts.stripe.absence import BLACK, WHITE, has_stripe, is_black, runs_across, white_share


def check_size(image: np.ndarray, sensor: Sensor, *, name: str, first: bool) -> None:
    """Refuse an image (H, W) or (H, W, 3) of another size than the sensor's; the ``first`` one's tells of the sensor.

    Raises
    ------
    ImageError
    """
    camera = sensor.camera
    height, width = image.shape[:2]
    if (width, height) == (camera.width_px, camera.height_px):
        return
    wanted = f"{camera.width_px} x {camera.height_px}"
    before = "" if first else " and the images before it"
    if (width, height) == (camera.height_px, camera.width_px):
        advice = (
            "it is turned by a quarter turn: turn it back"
            if not first
            else "the images are turned by a quarter turn: turn them back, or exchange width_px and height_px of the "
            "sensor and see to stripe_along"
        )
    else:
        advice = (
            "leave it out (ignore), or import it on its own"
            if not first
            else "give the description of the sensor that took the images, or correct its width_px and height_px"
        )
    raise ImageError(
        f"{name} has {width} x {height} pixels; expected {wanted} as the sensor '{sensor.name}' has{before}: {advice}"
    )


@dataclass(eq=False)
class Content:
    """Keeps account of the images of one import; ``saturation_dn`` is that of the files, ``target``: one is told.

    ``black`` has the names of the dark images and ``seen`` the number of all, by whether the laser was on;
    ``with_stripe`` counts the images with a stripe, ``sideways`` those with one across.
    """

    sensor: Sensor
    saturation_dn: int
    target: bool
    black: dict[bool, list[str]] = field(default_factory=lambda: {False: [], True: []})
    seen: dict[bool, int] = field(default_factory=lambda: {False: 0, True: 0})
    with_stripe: int = 0
    sideways: int = 0

    def look(self, image: np.ndarray, *, laser_on: bool, name: str) -> None:
        """Take an image (H, W) as the camera gave it into account.

        Raises
        ------
        ImageError
            Most of it is saturated.
        """
        self.seen[laser_on] += 1
        white = white_share(image, self.saturation_dn)
        if white > WHITE:
            raise ImageError(
                f"{name} is white: {100 * white:.0f} % of its pixels are saturated ({self.saturation_dn} DN): expose "
                "shorter, or leave it out (ignore)"
            )
        if is_black(image, self.saturation_dn):
            self.black[laser_on].append(name)

    def look_for_stripe(self, image: np.ndarray) -> None:
        """Take a laser image (H, W) into account, from which its background is subtracted if there is one."""
        along = self.sensor.camera.stripe_along
        if has_stripe(image, stripe_along=along):
            self.with_stripe += 1
        else:
            self.sideways += runs_across(image, stripe_along=along)

    def refuse_black(self) -> None:
        """Raise ImageError where all laser images are black, or all lamp images that should show a target."""
        if self.seen[True] and len(self.black[True]) == self.seen[True]:
            raise ImageError(
                f"all {self.seen[True]} laser images are black, no pixel reaches {100 * BLACK:g} % of full scale: is "
                "the laser on, the exposure long enough, the channel that of its colour, bits right?"
            )
        if self.target and self.seen[False] and len(self.black[False]) == self.seen[False]:
            raise ImageError(
                f"all {self.seen[False]} lamp images are black, no pixel reaches {100 * BLACK:g} % of full scale: is "
                "the lamp on, the exposure long enough, bits right?"
            )

    def verdict(self) -> list[str]:
        """Warnings, once all images were seen."""
        warnings = [
            f"{len(self.black[on])} of {self.seen[on]} {light} images are black, such as {self.black[on][0]}"
            for on, light in ((True, "laser"), (False, "lamp"))
            if self.black[on]
        ]
        lasers = self.seen[True]
        if lasers and not self.with_stripe:
            along = self.sensor.camera.stripe_along
            turned = (
                f"in {self.sideways} of them one runs across: the images are turned, or the sensor's stripe_along "
                f"('{along}') is wrong"
                if self.sideways
                else "check which images are laser images, the channel, and the exposure"
            )
            warnings.append(f"no stripe in any of the {lasers} laser images: {turned}")
        elif self.with_stripe < lasers:
            warnings.append(f"{lasers - self.with_stripe} of {lasers} laser images show no stripe")
        return warnings
