"""Movements that evidence does not determine, as shifts along a direction and turns about a line."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

_PART = 0.1
"""Of the largest: a scan with a smaller part in an open direction does not move in it."""
_NO_TURN = 0.05
"""Of a movement, by the shift that its turn gives to the usual point: less is a shift."""


@dataclass(frozen=True, eq=False)
class OpenMovement:
    """A movement of a scan that is open: a shift along a unit direction, or a turn about a line through a point.

    ``point_mm`` is None for a shift; for a turn it is the point of the line that lies nearest to the scan's middle.
    """

    scan: int
    direction: np.ndarray
    point_mm: np.ndarray | None

    def words(self) -> str:
        """The movement in words, in the common frame."""
        along = "({:.3f}, {:.3f}, {:.3f})".format(*(self.direction + 0.0))
        if self.point_mm is None:
            return f"shift along {along}"
        return "turn about the line through ({:.1f}, {:.1f}, {:.1f}) mm along ".format(*self.point_mm) + along


def open_movements(directions: np.ndarray, middles_mm: np.ndarray, sizes_mm: np.ndarray) -> tuple[OpenMovement, ...]:
    """Movements of N scans, the first fixed, from open directions (K, 6 (N - 1)): shifts, then turns about middles."""
    found = []
    for number in range(1, len(middles_mm)):
        twists = directions[:, 6 * (number - 1) : 6 * number] * np.repeat([1.0, sizes_mm[number]], 3)
        if not len(twists):
            continue
        _, strengths, rows = np.linalg.svd(twists, full_matrices=False)
        basis = rows[strengths > _PART]
        if not len(basis):
            continue
        # Combinations without a turn first, each as a row of coefficients.
        left, turns, _ = np.linalg.svd(basis[:, 3:], full_matrices=True)
        turns = np.append(turns, np.zeros(len(basis) - len(turns)))
        for coefficients, turn in zip(left.T[::-1], turns[::-1], strict=True):
            shift, turned = (coefficients @ basis).reshape(2, 3)
            turned = turned / sizes_mm[number]
            if turn < _NO_TURN:
                found.append(OpenMovement(number, _pointing(shift), None))
            else:
                nearest = middles_mm[number] + np.cross(turned, shift) / (turned @ turned)
                found.append(OpenMovement(number, _pointing(turned), nearest))
    return tuple(found)


def _pointing(direction: np.ndarray) -> np.ndarray:
    """The unit vector along a direction whose largest part is positive."""
    unit = direction / np.linalg.norm(direction)
    return unit * np.sign(unit[np.argmax(np.abs(unit))])
