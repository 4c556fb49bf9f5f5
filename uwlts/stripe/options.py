"""Options of stripe extraction."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from enum import StrEnum
from typing import Any

import numpy as np

from uwlts.errors import DescriptionError, RangeError
from uwlts.model.sensor import Sensor
from uwlts.stripe.methods import method_names

LEARNED = "learned"
"""The method of a trained network."""


class PeakRule(StrEnum):
    """Which of several stripes on one line counts. First and last are in the order of growing pixel index.

    Direct is, in recordings, the one that the laser itself draws, not a reflection (`uwlts.stripe.direct`); in a single
    image the strongest.
    """

    DIRECT = "direct"
    STRONGEST = "strongest"
    FIRST = "first"
    LAST = "last"


@dataclass(frozen=True, kw_only=True)
class StripeOptions:
    """Options of `uwlts.stripe.extract_stripe`; RangeError for a number outside the ranges stated below.

    Attributes
    ----------
    method : str
        How the centre is placed once the stripe is found: one of `uwlts.stripe.method_names`; or "learned": the network
        in ``model`` both finds it and places it.
    model : str
        ONNX file of the method "learned" (`uwlts.stripe.learned`).
    peak : PeakRule
        Which of several stripes on a line counts.
    half_window_px : int
        Pixels on either side of the centre that may be used: stripe, tails and the background beside them. Stripes
        whose full width at half maximum is at most this are measured. At least 8.
    widest_window_px : int
        `half_window_px` and `smoothing_px` are doubled, up to this window, while many lines of an image show a stripe
        that is too wide to be measured, and bright: a quarter of the saturation or more, which no haze reaches.
    smoothing_px : float
        Sigma of the Gaussian low-pass across the stripe, px, for detection, width and the quadratic fit. The other
        methods place the centre on the unsmoothed profile.
    smoothing_lines : int
        Odd number of neighbouring lines averaged beforehand; 1 averages none. More lines lower the noise of smooth
        surfaces and blur depth edges.
    threshold_sigmas : float
        Least height of a stripe in standard deviations of the low-passed background noise.
    threshold_floor : float
        Least height of a stripe in grey levels, whatever the noise.
    min_fwhm_px : float
        Least full width at half maximum, px; narrower things are hot pixels.
    ambiguous_ratio : float
        Share of the strongest peak from which another one on the line counts as a stripe too. Under the rules
        ``strongest``, and ``direct`` in a single image, two such stripes make the line ambiguous; ``first`` and
        ``last`` choose among them, and the line is ambiguous only if another reaches into the pixels used. Within one
        window a second peak that is higher than half the first one is separate if the profile falls below that half
        between them, and a lower one if it falls below half the second one's own height.
    end_lines : int
        Lines left out on either side of a place where the stripe ends, or jumps by more than half of `half_window_px`
        from one line to the next: at an edge or a limb the sheet's width meets the surface only in part. 0 keeps them.
    """

    method: str = "profile-fit"
    model: str = ""
    peak: PeakRule = PeakRule.DIRECT
    half_window_px: int = 16
    widest_window_px: int = 64
    smoothing_px: float = 1.0
    smoothing_lines: int = 1
    threshold_sigmas: float = 6.0
    threshold_floor: float = 3.0
    min_fwhm_px: float = 1.3
    ambiguous_ratio: float = 0.6
    end_lines: int = 2

    def __post_init__(self) -> None:
        for name, known in (("method", (*method_names(), LEARNED)), ("peak", tuple(PeakRule))):
            value = getattr(self, name)
            if value not in known:
                raise RangeError(f"{name} is {value!r}; use one of {', '.join(repr(str(k)) for k in known)}")
        object.__setattr__(self, "peak", PeakRule(self.peak))
        if not isinstance(self.model, str) or bool(self.model) != (self.method == LEARNED):
            raise RangeError(
                f"method is {self.method!r} and model {self.model!r}; the method {LEARNED!r}, and no other, needs the "
                "ONNX file of its model"
            )
        for name in ("half_window_px", "widest_window_px", "smoothing_lines", "end_lines"):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int | np.integer):
                raise RangeError(f"{name} is {value!r}; expected a whole number")
        ranges = {
            "half_window_px": (8, 512),
            "widest_window_px": (8, 512),
            "smoothing_px": (0.5, self.half_window_px / 4),
            "smoothing_lines": (1, 101),
            "threshold_sigmas": (1.0, 1e6),
            "threshold_floor": (0.0, 1e9),
            "min_fwhm_px": (0.0, self.half_window_px),
            "ambiguous_ratio": (0.05, 1.0),
            "end_lines": (0, 100),
        }
        for name, (low, high) in ranges.items():
            if not low <= (value := getattr(self, name)) <= high:
                raise RangeError(f"{name} is {value!r}; expected a number from {low:g} to {high:g}")
        if self.smoothing_lines % 2 == 0:
            raise RangeError(f"smoothing_lines is {self.smoothing_lines}; use an odd number, 1 for no averaging")

    @classmethod
    def of(cls, sensor: Sensor, settings: StripeSettings = None) -> StripeOptions:
        """Options for a sensor's images: those given, or the sensor's own with the settings given in their place.

        DescriptionError for a setting that is unknown, of the wrong type or out of range.
        """
        if isinstance(settings, StripeOptions):
            return settings
        wanted = sensor.stripe | dict(settings or {})
        known = [field.name for field in fields(cls)]
        if unknown := [name for name in wanted if name not in known]:
            raise DescriptionError(f"unknown setting of the stripe: {', '.join(unknown)}; known are {', '.join(known)}")
        try:
            return replace(cls(), **wanted)
        except (RangeError, TypeError) as error:
            raise DescriptionError(f"settings of the stripe: {error}") from error

    @property
    def jump_px(self) -> float:
        """Distance of neighbouring lines' centres above which they belong to two stripes."""
        return self.half_window_px / 2

    def doubled(self) -> StripeOptions:
        """Return the options for stripes twice as wide."""
        return replace(self, half_window_px=2 * self.half_window_px, smoothing_px=2 * self.smoothing_px)


StripeSettings = StripeOptions | Mapping[str, Any] | None
"""How the stripe is found: all options; some, in place of the sensor's own; or None, the sensor's own."""
