"""Fusion of images of one place at several exposures, and marks of clipped pixels in images calculated from others.

If black rubber and shining steel are both in view, no exposure shows both without darkness or saturation. Images of one
place at increasing exposures form a bracket. Their fused image has the grey values of the longest exposure.

A pixel that the camera clipped has no known light. Subtracted backgrounds and formulas of channels may give it any grey
value. Such an image has a ``saturation_dn`` of 2^k - 1, and 2^k is added to its clipped pixels. Thus the marks travel
with the image through captures, exports and cuts, and clipped pixels are not below ``saturation_dn`` in any image.
Images from cameras of k bits have no grey values above 2^k - 1, which are marks only.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Protocol

import numpy as np

from uwlts.model.sensor import LEAST_BRACKET_STEP, MOST_IN_BRACKET, CaptureHeader


def mark_clipped(image: np.ndarray, clipped: np.ndarray, *, saturation_dn: int) -> np.ndarray:
    """Return grey values (H, W), limited to 0 to ``saturation_dn``, as uint16 with marks where ``clipped`` (H, W).

    ``saturation_dn`` is 2^k - 1, at most 2^15 - 1.
    """
    return np.clip(image, 0, saturation_dn).astype(np.uint16) + np.uint16(saturation_dn + 1) * clipped


def has_marks(image: np.ndarray, saturation_dn: float) -> bool:
    """Return whether an image (H, W) has marks of clipped pixels."""
    mark = saturation_dn + 1
    can = image.dtype == np.uint16 and mark <= 2**15 and mark == int(mark) and int(mark).bit_count() == 1
    return can and bool(image.max() >= mark)


def split_clipped(image: np.ndarray, saturation_dn: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the grey values (H, W) of an image without marks, and whether each pixel was clipped (H, W)."""
    clipped = image >= saturation_dn
    if has_marks(image, saturation_dn):
        image = image & np.uint16(saturation_dn)
    return image, clipped


class _Rule:
    """Numbers of the fusion of several exposures.

    Chosen by hand with the reasons below; docs/studies/stripe_brackets.py shows the resulting stripes in rendered
    images of black rubber beside steel. Grey values "of full scale" are divided by the grey value of saturation.
    """

    exposure_slack: float = 0.98
    """Ratio of a camera's exposure step to the planned step, at least: cameras round exposures."""
    same_place_mm: float = 1e-3  # largest difference of readings of a stage at rest, mm
    # Range of grey values, of full scale, over which the weight of a pixel falls to zero. Full well and gain differ
    # between pixels, and a step of the weight at saturation would appear in the stripe's profile.
    roll_off_from: float = 0.85
    roll_off_to: float = 0.95
    well_exposed: float = 0.3  # least grey value, of full scale, of pixels that determine the ratio of two exposures
    fewest_pixels: int = 200  # fewest such pixels; with fewer pixels the ratio of the stated exposures is used
    dark_dn: float = 3.0
    """Distance of the background from the median, grey values, at least: covers rounding and offsets."""
    dark_sigmas: float = 4.0
    """Distance of the background from the median, standard deviations: all but one in 16,000 background pixels."""


_MAD_TO_STD = 1.4826  # standard deviation of Gaussian noise divided by its median absolute deviation


class BracketImages(Protocol):
    """Numbered sequence of images with exposure and place, such as an open capture."""

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

    def image(self, index: int) -> np.ndarray: ...

    def __len__(self) -> int: ...


def group_brackets(capture: BracketImages) -> list[np.ndarray]:
    """Return the numbers (K,) of the laser images of each bracket of a recording, shortest exposure first.

    A bracket consists of successive images at one place whose exposures differ by at least `LEAST_BRACKET_STEP`. A
    recording has brackets if at least two places have equally many such images; the last place may have fewer.
    Otherwise each image is a bracket of its own.
    """
    laser = np.flatnonzero(capture.laser_on)
    alone = [laser[k : k + 1] for k in range(len(laser))]
    if len(laser) < 4:
        return alone
    stage, pose, exposure = (values[laser] for values in (capture.stage_mm, capture.pose, capture.exposure_ms))
    moved = np.abs(np.diff(stage)) > _Rule.same_place_mm
    moved |= ~np.isclose(pose[1:], pose[:-1], rtol=0.0, atol=1e-9, equal_nan=True).all(axis=(1, 2))
    places = np.split(np.arange(len(laser)), np.flatnonzero(moved) + 1)
    count = len(places[0])
    if len(places) < 2 or not 2 <= count <= MOST_IN_BRACKET or len(places[-1]) > count:
        return alone
    if any(len(place) != count for place in places[:-1]):
        return alone
    places = [place[np.argsort(exposure[place], kind="stable")] for place in places]
    steps = [exposure[place[1:]] < _Rule.exposure_slack * LEAST_BRACKET_STEP * exposure[place[:-1]] for place in places]
    return alone if exposure.min() <= 0 or np.concatenate(steps).any() else [laser[place] for place in places]


def fuse_brackets(capture: BracketImages) -> Iterator[tuple[int, np.ndarray, float]]:
    """Yield number, image (H, W) and grey value of saturation for each place with the laser on.

    A single image is returned unchanged. A bracket gives its `fuse_exposures` image with the number of
    the longest exposure.
    """
    full_dn = float(capture.header.saturation_dn)
    for numbers in group_brackets(capture):
        if len(numbers) == 1:
            yield int(numbers[0]), capture.image(int(numbers[0])), full_dn
        else:
            images = [capture.image(number) for number in numbers.tolist()]
            yield int(numbers[-1]), *fuse_exposures(images, capture.exposure_ms[numbers], full_dn=full_dn)


def fuse_exposures(
    images: Sequence[np.ndarray], exposure_ms: np.ndarray, *, full_dn: float
) -> tuple[np.ndarray, float]:
    """Fuse K images (H, W) of one place, and return the float32 image and its grey value of saturation.

    ``exposure_ms`` (K,) is increasing. Let o be the grey value without light. A pixel with grey value y at exposure t
    corresponds to o + (y - o) T / t at the longest exposure T.

    The pixels are averaged with the weights t^2, which are optimal for the constant noise of faint pixels (Robertson,
    Borman and Stevenson, "Dynamic range improvement through multiple exposures", ICIP 1999, eq. 7). The weight falls to
    zero near saturation, except at the shortest exposure. The noise of bright pixels is dominated by speckle, which is
    equal in all exposures, so that their weights matter little.

    The offset is estimated from the background of the shortest and the longest image. Cameras expose some microseconds
    longer or shorter than they report. T / t is therefore estimated from pixels that are well exposed in both images.
    """
    # Clipped pixels of differences have any grey value (`mark_clipped`).
    known = (split_clipped(image, full_dn) for image in images)
    pixels = [np.where(clipped, full_dn, values).astype(np.float32) for values, clipped in known]
    offset = _estimate_offset(pixels[0], pixels[-1], float(exposure_ms[-1] / exposure_ms[0]))
    low, high = (share * (full_dn - offset) for share in (_Rule.roll_off_from, _Rule.roll_off_to))
    # From the longest to the shortest exposure: the scale is the product of successive ratios.
    scale, total, weight = 1.0, np.zeros_like(pixels[0]), np.zeros_like(pixels[0])
    for k in range(len(pixels) - 1, -1, -1):
        signal = pixels[k] - offset
        if k < len(pixels) - 1:
            longer = pixels[k + 1] - offset
            scale *= _measure_ratio(
                signal, longer, float(exposure_ms[k + 1] / exposure_ms[k]), low=_Rule.well_exposed * full_dn, high=low
            )
        part = np.float32(scale**-2) * (np.clip((high - signal) / (high - low), 0.0, 1.0) if k else 1.0)
        total += part * np.float32(scale) * signal
        weight += part
    return total / weight + np.float32(offset), offset + scale * (full_dn - offset)


def _estimate_offset(short: np.ndarray, long: np.ndarray, ratio: float) -> float:
    """Estimate the grey value without light from the background of two images with a ratio of exposures."""
    middle = float(np.median(long))
    spread = _Rule.dark_sigmas * _MAD_TO_STD * float(np.median(np.abs(long - middle)))
    dark = np.abs(long - middle) <= max(_Rule.dark_dn, spread)
    return float((ratio * short[dark].mean(dtype=float) - long[dark].mean(dtype=float)) / (ratio - 1.0))


def _measure_ratio(short: np.ndarray, long: np.ndarray, stated: float, *, low: float, high: float) -> float:
    """Return the ratio of the light in two images without offset; the stated one if too few pixels are usable."""
    both = (long > low) & (long < high)
    if np.count_nonzero(both) < _Rule.fewest_pixels:
        return stated
    return float(long[both].sum(dtype=float) / max(short[both].sum(dtype=float), 1e-9))
