"""What makes a camera's pixels differ from each other, the same in every image it takes."""

from dataclasses import dataclass

import numpy as np

from uwlts.sensor import Detector

_STREAM = 1288
"""Keeps the pattern's random numbers apart from those of the images, whatever their seeds."""


@dataclass(frozen=True)
class FixedPattern:
    """Non-uniformity of one camera's pixels; every array is (H, W), float32."""

    gain: np.ndarray
    """Factor of the photo-electrons, 1 in the mean."""
    offset_e: np.ndarray
    """Offset of the readout in electrons, 0 in the mean."""
    hot_e_per_s: np.ndarray
    """Dark current of the hot pixels beyond that of the others, at the image sensor's temperature."""

    def bands(self, count: int) -> list["FixedPattern"]:
        """The pattern of ``count`` bands of rows, as `numpy.array_split` cuts them."""
        parts = (np.array_split(array, count) for array in (self.gain, self.offset_e, self.hot_e_per_s))
        return [FixedPattern(*band) for band in zip(*parts, strict=True)]


def fixed_pattern(detector: Detector, *, height: int, width: int) -> FixedPattern | None:
    """The pattern of the camera with the detector's ``pattern_seed``; None if its pixels are all alike.

    Gain and offset are normal, the hot pixels' dark currents exponentially distributed, all independent from pixel to
    pixel. Each has random numbers of its own: changing one value leaves the others' pattern as it is.
    """
    spreads = (detector.prnu, detector.dsnu_e, detector.dsnu_row_e, detector.dsnu_column_e)
    if not any(spreads) and detector.hot_pixels_per_million == 0:
        return None
    seeds = np.random.SeedSequence(detector.pattern_seed, spawn_key=(_STREAM,)).spawn(5)
    rngs = [np.random.default_rng(seed) for seed in seeds]
    shapes = ((height, width), (height, width), (height, 1), (1, width))
    gain, pixels, rows, columns = (
        np.float32(spread) * rng.standard_normal(shape, dtype=np.float32)
        for spread, rng, shape in zip(spreads, rngs[:4], shapes, strict=True)
    )
    hot = np.zeros(height * width, np.float32)
    count = rngs[4].binomial(hot.size, 1e-6 * detector.hot_pixels_per_million)
    places = rngs[4].choice(hot.size, size=count, replace=False)
    mean = detector.hot_pixel_dark_current_e_per_s * detector.dark_current_growth()
    hot[places] = mean * rngs[4].standard_exponential(count, dtype=np.float32)
    return FixedPattern(1 + gain, pixels + rows + columns, hot.reshape(height, width))
