"""Warning where the target is seen in another colour than the stripe, and the lens images them apart."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from uwlts.errors import Error
from uwlts.optics.lateral_colour import colour_shift, laser_colour
from uwlts.storage.image_file import read_image
from uwlts.storage.import_.grey_values import one_channel
from uwlts.targets import Target

_MOST_IMAGES = 3  # with the target in both colours; one alone covers little of the image
_MOST_TRIED = 6  # an import is not to wait for a target that one colour does not show
_FEWEST_POINTS = 8  # of an image: four would do for shift and magnification, without any to judge them by
_OTHER_NUMBERS_PX = 5.0  # colours are never so far apart: points of a symmetric target were numbered in two ways


def chromatic_warnings(
    images: Sequence[Path], target: Target, *, lamp_channel: str | None, wavelength_nm: float
) -> list[str]:
    """Warnings against taking the target from ``lamp_channel`` and the stripe from the laser's colour.

    They are by the target's points in both colours, in the first of the lamp images.
    """
    colour = laser_colour(wavelength_nm)
    if lamp_channel in (None, colour):
        return []
    pairs, size = [], np.zeros(2)
    for path in images[:_MOST_TRIED]:
        raw = read_image(path)
        if raw.ndim == 2:
            return []
        in_lamp = _seen(target, raw, lamp_channel)
        in_laser = _seen(target, raw, colour) if in_lamp else {}
        both = sorted(in_lamp.keys() & in_laser.keys())
        lamp, laser = (np.array([points[place] for place in both]).reshape(-1, 2) for points in (in_lamp, in_laser))
        if len(both) >= _FEWEST_POINTS and np.median(np.abs(laser - lamp)) < _OTHER_NUMBERS_PX:
            size = np.array(raw.shape[1::-1])
            pairs.append((lamp, laser))
        if len(pairs) == _MOST_IMAGES:
            break
    if not pairs:
        return []
    lamp, laser = (np.vstack(points) for points in zip(*pairs, strict=True))
    shift = colour_shift(lamp, laser, size)
    if not shift.significant:
        return []
    return [
        f"{colour}, the laser's colour, and {lamp_channel}, in which the target is seen, are apart in the image: "
        f"{colour} is magnified by {shift.magnification:.5f} and moved by {shift.shift_px:.2f} px, "
        f"{shift.largest_px:.2f} px in the corners: take the target from the laser's colour as well, "
        f"lamp_channel = '{colour}'"
    ]


def _seen(target: Target, raw: np.ndarray, channel: str) -> dict[tuple[int, ...], np.ndarray]:
    """Pixels (2,) of a target's points by their places in it; none where the channel does not show it."""
    # What a formula gives may be negative.
    grey = np.clip(one_channel(raw, channel, name="the image"), 0, None).astype(raw.dtype)
    try:
        view = target.detect(grey)
    except Error:
        return {}
    return dict(zip(map(tuple, view.indices.tolist()), view.pixels, strict=True))
