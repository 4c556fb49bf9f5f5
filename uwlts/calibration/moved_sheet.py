"""Moves of the laser sheet during a capture: a step of the stripe's distance from the sheet between two images."""

from collections.abc import Sequence

import numpy as np
from scipy.stats import t

_FEWEST = 3  # images on either side of a move: a wrong image at an end also looks like one
_FALSE_ALARM = 1e-3  # probability of a warning for a capture with a sheet at rest and normal errors
_LEAST_SHARE = 0.75
"""Share of the variance about a parabola that a step must explain. In smooth curves, from errors of lens, target and
stage, it explains at most 0.51: polynomials of degrees 3 to 6 in 7 to 50 images."""


def doubt_sheet_at_rest(
    names: Sequence[str], pixels: Sequence[np.ndarray], off: Sequence[np.ndarray], *, across: int, unit: str
) -> list[str]:
    """Return a warning for each capture in which the sheet moved from one image to the next.

    Parameters
    ----------
    names
        Capture and frame of each image, in their order.
    pixels, off
        Stripe of each image, in pixels or on any other scale (N, 2), and its distances (N,) from the sheet of all.
    across
        Coordinate across the stripe, 0 or 1.
    unit
        Unit of the distances.
    """
    captures: dict[str, list[int]] = {}
    for number, name in enumerate(names):
        if len(pixels[number]) > 1:
            captures.setdefault(name.rsplit(", frame ", 1)[0], []).append(number)
    said = []
    for own in captures.values():
        places = np.array([np.median(pixels[number][:, across]) for number in own])
        halves = [np.array_split(off[number][np.argsort(pixels[number][:, 1 - across])], 2) for number in own]
        if (found := find_step(places, np.array([[np.median(half) for half in each] for each in halves]))) is not None:
            image, size = found
            said.append(
                f"{names[own[image]]}: the laser sheet moved by {size:.2g} {unit} before this image: fix the laser, "
                "and calibrate from images before the move only, or from those after it only"
            )
    return said


def find_step(places: np.ndarray, distances: np.ndarray) -> tuple[int, float] | None:
    """Return the first image after a step of distances (F, 2), and its size; None if there is no significant one.

    Without a step, the mean and the difference of both columns are parabolas of the stripe's place (F,) with normal
    errors. Each possible moment is tested by Student's t, with a significance divided by the number of tests.
    """
    count = len(places)
    moments = np.arange(_FEWEST, count - _FEWEST + 1)
    if len(moments) < 2:
        return None
    smooth = np.linalg.qr(np.vander((places - places.mean()) / (np.ptp(places) or 1.0), 3))[0]
    modes = distances @ np.array([[0.5, -1.0], [0.5, 1.0]])
    left, steps = (each - smooth @ (smooth.T @ each) for each in (modes, np.arange(count)[:, None] >= moments))
    squares = np.maximum(np.sum(steps**2, axis=0), np.finfo(float).eps)[:, None]
    jumps = steps.T @ left / squares
    share = jumps**2 * squares / np.maximum(np.sum(left**2, axis=0), np.finfo(float).tiny)
    best = int(np.argmax(share.max(axis=1)))
    least = t.isf(_FALSE_ALARM / (2 * share.size), count - 4) ** 2
    if share[best].max() < max(_LEAST_SHARE, least / (least + count - 4)):
        return None
    return int(moments[best]), float(abs(jumps[best, 0]) + abs(jumps[best, 1]) / 2)
