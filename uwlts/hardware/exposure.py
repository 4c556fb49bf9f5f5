"""Automatic exposure: as long as the brightest lines of an image stay below the full scale, by a share that is wished.

What counts are the profile lines that show something: of laser images those with a stripe, of images without laser
those that are not dark beside the brightest one.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from uwlts.hardware.scan_plan import Light
from uwlts.sensor import Sensor
from uwlts.stripe import StripeStatus, extract_stripe

BRIGHT_SHARE = 0.98
"""The brightest pixel of every line that counts is looked at; 2 % of the lines may be brighter than is wished."""
START_MS = 1.0
_FEW, _LEAST = 0.01, 3
_DIM = 0.05
_MANY = 0.05
_CLOSE = 0.1
_SHORTEST_MS = 1e-3
_STEPS = 12
_DOWN, _UP = 1 / 16, 30.0


def not_few(count: int, lines: int) -> bool:
    """Whether so many of all lines are a sign of light, rather than a reflection or noise."""
    return count >= max(_FEW * lines, _LEAST)


@dataclass(frozen=True)
class Brightness:
    """How bright an image is.

    ``level`` is the share of the full scale that all but 2 % of the ``counted`` lines keep to: 0 where no line counts,
    1 where nothing tells by how much it is too bright. ``saturated`` of the counted lines reach the full scale.
    """

    lines: int
    counted: int
    saturated: int
    level: float

    @property
    def dark(self) -> bool:
        """Whether too few lines count for an exposure to be told by them."""
        return not not_few(self.counted, self.lines)

    @property
    def overexposed(self) -> bool:
        """Whether many lines are saturated, more than a reflection accounts for."""
        return self.saturated > _MANY * self.counted and not_few(self.saturated, self.lines)


def brightness(image: np.ndarray, sensor: Sensor, light: Light) -> Brightness:
    """Brightness of an image (H, W) in grey values, as the sensor's detector gives them, in a light."""
    along, full = sensor.camera.stripe_along, sensor.detector.full_scale_dn()
    black = sensor.detector.black_level_dn
    peak = image.max(axis=0 if along == "width" else 1).astype(float)
    counts = peak - black > _DIM * (peak.max() - black)
    if light == "laser":
        counts &= extract_stripe(image, stripe_along=along, saturation=full).status != StripeStatus.NO_STRIPE
    if not counts.any():
        return Brightness(peak.size, 0, 0, 0.0)
    level = float(np.quantile(peak[counts], BRIGHT_SHARE))
    share = 1.0 if level >= full else max(level - black, 0.0) / (full - black)
    return Brightness(peak.size, int(counts.sum()), int((peak[counts] >= full).sum()), share)


def settled_exposure(
    take: Callable[[float], np.ndarray], *, sensor: Sensor, light: Light, start_ms: float = START_MS
) -> float | None:
    """Exposure in ms at which an image just keeps to the sensor's ``auto_level``; None if even the longest is dark.

    ``take(exposure_ms)`` returns an image (H, W) in the light. The longest is the sensor's ``longest_ms``.
    """
    wished, longest_ms = sensor.exposure.auto_level, sensor.exposure.longest_ms
    exposure_ms, too_long_ms = min(start_ms, longest_ms), math.inf
    for _ in range(_STEPS):
        seen = brightness(take(exposure_ms), sensor, light)
        if seen.level >= 1:
            if exposure_ms <= _SHORTEST_MS:
                break
            too_long_ms = exposure_ms
            # At the full scale nothing tells by how much it is too bright; from below one more step is enough.
            exposure_ms = max(exposure_ms * _DOWN, _SHORTEST_MS)
            continue
        needed_ms = math.inf if seen.dark else exposure_ms * wished / max(seen.level, 1e-6)
        if abs(needed_ms / exposure_ms - 1) < _CLOSE:
            return min(needed_ms, longest_ms)
        if exposure_ms >= longest_ms and needed_ms > longest_ms:
            return None if seen.dark else longest_ms
        longer_ms = min(needed_ms, exposure_ms * _UP, longest_ms)
        exposure_ms = longer_ms if longer_ms < too_long_ms else math.sqrt(exposure_ms * too_long_ms)
    return exposure_ms
