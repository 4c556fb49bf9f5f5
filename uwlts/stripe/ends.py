"""Lines at the ends of a stripe, where the sheet only half meets the surface and the profile is lopsided."""

import numpy as np

_SHORT_GAP = 2
"""A stripe that is lost for so few lines, as in noise, has not ended."""


def half_lit(good: np.ndarray, centre: np.ndarray, *, lines: int, jump_px: float) -> np.ndarray:
    """Numbers (M,) of the lines with a centre that are among the ``lines`` last before a stripe ends or jumps.

    ``good`` (L,) tells which lines have a centre. A stripe ends where more than a few lines in a row have none, and
    jumps where neighbouring centres lie more than ``jump_px`` apart. The image's own border is no end.
    """
    if good.all() and np.abs(centre[1:] - centre[:-1]).max(initial=0.0) <= jump_px:
        return np.empty(0, np.intp)
    found = np.flatnonzero(good)
    if len(found) == 0:
        return found
    # breaks[k] stands before found[k], the last one after all of them.
    breaks = np.empty(len(found) + 1, bool)
    breaks[1:-1] = (np.diff(found) > _SHORT_GAP + 1) | (np.abs(np.diff(centre[found])) > jump_px)
    breaks[0], breaks[-1] = found[0] > _SHORT_GAP, len(good) - 1 - found[-1] > _SHORT_GAP
    near = np.zeros(len(found), bool)
    for away in range(min(lines, len(found))):
        near[: len(found) - away] |= breaks[1 + away :]
        near[away:] |= breaks[: len(found) - away]
    return found[near]
