"""Images of one place at several exposures, fused into one that shows faint and bright surfaces.

Black rubber beside shining steel leaves no exposure at which both are neither dark nor saturated. Images of one place
at growing exposures are a bracket; their fused image is in grey values of the longest exposure.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Protocol

import numpy as np

from uwlts.model.sensor import LEAST_BRACKET_STEP, MOST_IN_BRACKET, CaptureHeader
from uwlts.model.stripe import Stripe

_SLACK = 0.98
"""Exposures that a camera rounds to its own steps may differ by a little less than planned."""

_SAME_PLACE_MM = 1e-3
"""Readings of a stage at rest differ by less."""

_ROLL_OFF_FROM = 0.85
_ROLL_OFF_TO = 0.95
"""Shares of the full scale between which a pixel loses its weight: the full well and the gain differ from pixel to
pixel, and a step at the full scale itself would show in the stripe's profile."""

_WELL_EXPOSED = 0.3
"""Share of the full scale from which pixels of the longer exposure tell the ratio of two."""

_FEWEST_PIXELS = 200
"""Well exposed pixels from which the ratio of two images is measured rather than taken from the exposures."""

_DARK_DN = 3.0
"""Grey values about the median within which pixels show the background, whatever its noise: rounding and offsets."""

_DARK_SIGMAS = 4.0
"""Standard deviations about the median within which pixels show the background: all but one in 16,000 of them."""

_SIGMA_PER_MAD = 1.4826
"""Standard deviation of Gaussian noise over its median absolute deviation."""


class BracketImages(Protocol):
    """A sequence of images or centre lines, numbered, with exposure and place of each, such as an opened capture."""

    @property
    def path(self) -> Path: ...

    @property
    def header(self) -> CaptureHeader: ...

    @property
    def stage_mm(self) -> np.ndarray: ...

    @property
    def exposure_ms(self) -> np.ndarray: ...

    @property
    def laser_on(self) -> np.ndarray: ...

    @property
    def pose(self) -> np.ndarray: ...

    @property
    def has_image(self) -> np.ndarray: ...

    def seen(self, index: int) -> np.ndarray | Stripe: ...

    def image(self, index: int) -> np.ndarray: ...

    def __len__(self) -> int: ...


def brackets(capture: BracketImages) -> list[np.ndarray]:
    """Numbers (K,) of the laser images of each bracket of a recording, from the shortest exposure on.

    Images belong together where they follow each other at one place, with exposures that differ by
    `LEAST_BRACKET_STEP` or more. A recording is in brackets where that holds at each of two places or more, with
    equally many images; otherwise every image is a bracket of its own, and so is every centre line. The last place of a
    recording that goes on may have fewer.
    """
    laser = np.flatnonzero(capture.laser_on)
    alone = [laser[k : k + 1] for k in range(len(laser))]
    if len(laser) < 4 or not capture.has_image[laser].all():
        return alone
    stage, pose, exposure = (values[laser] for values in (capture.stage_mm, capture.pose, capture.exposure_ms))
    moved = np.abs(np.diff(stage)) > _SAME_PLACE_MM
    moved |= ~np.isclose(pose[1:], pose[:-1], rtol=0.0, atol=1e-9, equal_nan=True).all(axis=(1, 2))
    places = np.split(np.arange(len(laser)), np.flatnonzero(moved) + 1)
    count = len(places[0])
    if len(places) < 2 or not 2 <= count <= MOST_IN_BRACKET or len(places[-1]) > count:
        return alone
    if any(len(place) != count for place in places[:-1]):
        return alone
    places = [place[np.argsort(exposure[place], kind="stable")] for place in places]
    steps = [exposure[place[1:]] < _SLACK * LEAST_BRACKET_STEP * exposure[place[:-1]] for place in places]
    if exposure.min() <= 0 or np.concatenate(steps).any():
        return alone
    return [laser[place] for place in places]


def fused_images(capture: BracketImages) -> Iterator[tuple[int, np.ndarray | Stripe, float]]:
    """Number, image (H, W) and grey value of saturation of each place of a recording that the laser lights.

    A place with one image gives that image, one with a centre line this. The image of a bracket has the number of its
    longest exposure and is `fused`.
    """
    full_dn = float(capture.header.saturation_dn)
    for numbers in brackets(capture):
        if len(numbers) == 1:
            yield int(numbers[0]), capture.seen(int(numbers[0])), full_dn
        else:
            images = [capture.image(number) for number in numbers.tolist()]
            yield int(numbers[-1]), *fused(images, capture.exposure_ms[numbers], full_dn=full_dn)


def fused(images: Sequence[np.ndarray], exposure_ms: np.ndarray, *, full_dn: float) -> tuple[np.ndarray, float]:
    """One image (H, W) float32 of K images (H, W) of a place, and the grey value at which it saturates.

    ``exposure_ms`` (K,) grow. Grey values are those of the longest exposure T. A pixel that shows y at exposure t says
    that the longest would show o + (y - o) T / t, with the offset o of the dark image. The pixels' mean has the weights
    t^2, the best ones for the constant noise of faint pixels (Robertson, Borman and Stevenson, "Dynamic range
    improvement through multiple exposures", ICIP 1999, eq. 7), and none near the full scale, where only shorter ones
    count. In bright pixels speckle, which all exposures share, outweighs noise, so that their weights matter little.

    The offset follows from the background of the shortest and the longest image, T / t from pixels that are well
    exposed in both; cameras expose some microseconds longer or shorter than they report.
    """
    pixels = [image.astype(np.float32) for image in images]
    offset = _offset_dn(pixels[0], pixels[-1], float(exposure_ms[-1] / exposure_ms[0]))
    low, high = (share * (full_dn - offset) for share in (_ROLL_OFF_FROM, _ROLL_OFF_TO))
    # From the longest exposure to the shortest, whose scale is that of all longer ones multiplied.
    scale, total, weight = 1.0, np.zeros_like(pixels[0]), np.zeros_like(pixels[0])
    for k in range(len(pixels) - 1, -1, -1):
        signal = pixels[k] - offset
        if k < len(pixels) - 1:
            longer = pixels[k + 1] - offset
            scale *= _ratio(
                signal, longer, float(exposure_ms[k + 1] / exposure_ms[k]), low=_WELL_EXPOSED * full_dn, high=low
            )
        own = np.float32(scale**-2) * (np.clip((high - signal) / (high - low), 0.0, 1.0) if k else 1.0)
        total += own * np.float32(scale) * signal
        weight += own
    return total / weight + np.float32(offset), offset + scale * (full_dn - offset)


def _offset_dn(short: np.ndarray, long: np.ndarray, ratio: float) -> float:
    """Grey value that does not grow with the exposure, from the background of two images of a ratio of exposures."""
    middle = float(np.median(long))
    spread = _DARK_SIGMAS * _SIGMA_PER_MAD * float(np.median(np.abs(long - middle)))
    dark = np.abs(long - middle) <= max(_DARK_DN, spread)
    return float((ratio * short[dark].mean(dtype=float) - long[dark].mean(dtype=float)) / (ratio - 1.0))


def _ratio(short: np.ndarray, long: np.ndarray, stated: float, *, low: float, high: float) -> float:
    """Ratio of the light of two images above their offset, as stated where too few pixels are well exposed in both."""
    both = (long > low) & (long < high)
    if np.count_nonzero(both) < _FEWEST_PIXELS:
        return stated
    return float(long[both].sum(dtype=float) / max(short[both].sum(dtype=float), 1e-9))
