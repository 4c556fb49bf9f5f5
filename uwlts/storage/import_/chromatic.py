"""Colours that a lens magnifies differently: the target is seen in the lamp's, the stripe in the laser's."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from uwlts.errors import Error
from uwlts.storage.image_file import read_image
from uwlts.storage.import_.channels import one_channel
from uwlts.targets import Target

_MOST_IMAGES, _MOST_TRIED, _FEWEST_POINTS = 3, 6, 8
_OTHER_NUMBERS_PX = 5.0  # colours are never so far apart: points of a symmetric target were numbered in two ways
_LEAST_PX, _SIGMAS = 0.1, 5.0  # from where two colours count as apart in the image's corners
_BLUE_TO_GREEN_NM, _GREEN_TO_RED_NM = 490.0, 580.0


def laser_colour(wavelength_nm: float) -> str:
    """The channel of a colour camera that sees most of a laser's light."""
    if wavelength_nm < _BLUE_TO_GREEN_NM:
        return "blue"
    return "green" if wavelength_nm < _GREEN_TO_RED_NM else "red"


def chromatic_warnings(
    images: Sequence[Path], target: Target, *, lamp_channel: str | None, wavelength_nm: float
) -> list[str]:
    """What speaks against taking the target from ``lamp_channel`` and the stripe from the laser's colour, in words.

    Of the first of the lamp images. The points of one colour are those of the other, moved and magnified
    about the image's middle, as lateral chromatic aberration and a colour filter array do.
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
    shift, magnified, certain = _magnified(lamp - size / 2, laser - size / 2)
    corners = np.array([[-1, -1], [-1, 1], [1, -1], [1, 1]]) * size / 2
    largest = float(np.linalg.norm(shift + (magnified - 1) * corners, axis=1).max())
    if largest < _LEAST_PX or not certain:
        return []
    return [
        f"{colour}, the laser's colour, and {lamp_channel}, in which the target is seen, are apart in the image: "
        f"{colour} is magnified by {magnified:.5f} and moved by {np.linalg.norm(shift):.2f} px, {largest:.2f} px in "
        f"the corners: take the target from the laser's colour as well, lamp_channel = '{colour}'"
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


def _magnified(places: np.ndarray, others: np.ndarray) -> tuple[np.ndarray, float, bool]:
    """Shift (2,) and magnification that lead from places (N, 2) to others, and whether they are certain."""
    design = np.column_stack([np.tile(np.eye(2), (len(places), 1)), places.ravel()])
    off = (others - places).ravel()
    found = np.linalg.lstsq(design, off, rcond=None)[0]
    variance = np.sum((off - design @ found) ** 2) / (off.size - 3)
    std = np.sqrt(variance * np.diag(np.linalg.inv(design.T @ design)))
    return found[:2], 1 + float(found[2]), bool((np.abs(found) > _SIGMAS * std).any())
