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


class PeakRule(StrEnum):
    """Rule that selects one of several stripes on a line. First and last refer to the order of pixels.

    Direct selects, in recordings, the stripe that the laser itself draws, not a reflection (`uwlts.stripe.direct`). In
    a single image it selects the strongest stripe.
    """

    DIRECT = "direct"
    STRONGEST = "strongest"
    FIRST = "first"
    LAST = "last"


@dataclass(frozen=True, kw_only=True)
class StripeOptions:
    """Options of `uwlts.stripe.extract_stripe`; RangeError for a number out of range.

    Attributes
    ----------
    method : str
        Method that locates the centre of a stripe: one of `uwlts.stripe.method_names`.
    peak : PeakRule
        Rule for several stripes on a line.
    half_window_px : int
        Number of pixels on either side of the centre that may be used: stripe, tails and background beside them.
        Stripes with a full width at half maximum up to this number are measured. At least 8.
    widest_window_px : int
        `half_window_px` and `smoothing_px` are doubled, up to this window, while many lines of an image show a bright
        stripe too wide to be measured. Bright means at least a quarter of the saturation, which haze does not reach.
    smoothing_px : float
        Sigma, px, of the Gaussian low-pass across the stripe for detection, width and the quadratic fit. The other
        methods use the unsmoothed profile.
    smoothing_lines : int
        Odd number of neighbouring lines that are averaged first; 1 for no averaging. Averaging reduces the noise on
        smooth surfaces and blurs depth edges.
    threshold_sigmas : float
        Least height of a stripe in standard deviations of the low-passed background noise.
    threshold_floor : float
        Least height of a stripe in grey levels, for any noise.
    min_fwhm_px : float
        Least full width at half maximum, px; narrower peaks are hot pixels.
    ambiguous_ratio : float
        Ratio of a peak's height to the strongest peak on its line, from this value on it counts as a stripe. Under the
        rules ``strongest``, and ``direct`` in a single image, two such stripes make a line ambiguous. ``first`` and
        ``last`` choose among them: the line is ambiguous only if another stripe overlaps the pixels used. Within one
        window, a peak above half height of the first one is separate if the profile falls below this level between
        them. A lower peak is separate if the profile falls below half of its own height.
    end_lines : int
        Lines omitted on either side of an end of the stripe, or of a jump by more than half of `half_window_px` between
        lines: at an edge or limb only a part of the sheet's width meets the surface. 0 keeps these lines.
    low_pass : float, optional
        Tolerance of the thesis's low-pass filter (`uwlts.stripe.extract`), 0.4 for LabVIEW's, 0 for a plain mean. The
        centres found by `method` are then replaced by those of a quadratic through `low_pass_fit_px` filtered pixels,
        an odd number.
    """

    method: str = "profile-fit"
    peak: PeakRule = PeakRule.DIRECT
    half_window_px: int = 16
    widest_window_px: int = 64
    smoothing_px: float = 1.0
    smoothing_lines: int = 1
    threshold_sigmas: float = 6.0
    threshold_floor: float = 3.0
    min_fwhm_px: float = 1.0
    ambiguous_ratio: float = 0.6
    end_lines: int = 2
    low_pass: float | None = None
    low_pass_fit_px: int = 5

    def __post_init__(self) -> None:
        for name, known in (("method", method_names()), ("peak", tuple(PeakRule))):
            value = getattr(self, name)
            if value not in known:
                raise RangeError(f"{name} is {value!r}; use one of {', '.join(repr(str(k)) for k in known)}")
        object.__setattr__(self, "peak", PeakRule(self.peak))
        for name in ("half_window_px", "widest_window_px", "smoothing_lines", "end_lines", "low_pass_fit_px"):
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
            "low_pass_fit_px": (3, 15),
        } | ({} if self.low_pass is None else {"low_pass": (0.0, 10.0)})
        for name, (low, high) in ranges.items():
            if not low <= (value := getattr(self, name)) <= high:
                raise RangeError(f"{name} is {value!r}; expected a number from {low:g} to {high:g}")
        if self.smoothing_lines % 2 == 0:
            raise RangeError(f"smoothing_lines is {self.smoothing_lines}; use an odd number, 1 for no averaging")
        if self.low_pass_fit_px % 2 == 0:
            raise RangeError(f"low_pass_fit_px is {self.low_pass_fit_px}; use an odd number")

    @classmethod
    def resolve(cls, sensor: Sensor, settings: StripeSettings = None) -> StripeOptions:
        """Return the options for a sensor's images: the given ones, or the sensor's own with changed settings.

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
        """Distance between centres on neighbouring lines above which they belong to two stripes."""
        return self.half_window_px / 2

    def double_width(self) -> StripeOptions:
        """Return the options for stripes twice as wide."""
        return replace(self, half_window_px=2 * self.half_window_px, smoothing_px=2 * self.smoothing_px)


StripeSettings = StripeOptions | Mapping[str, Any] | None
"""All options; some options that replace the sensor's own; or None for the sensor's own options."""
