"""Dummy head with the stub of its neck."""

from typing import Literal

import numpy as np

from twin.scene.forms.triangles import grid_faces
from twin.scene.scene_object import FreeForm
from uwlts.model.sensor import Positive

# Tables in units of the head's height, from the end of the neck at y = -0.5 to the crown at 0.5.
# Bodies of front and back half-ellipses about the y axis: y of the centre, half height, flatness of the ends, half
# width, front, back.
_BODIES = np.array(
    [
        (0.150, 0.350, 2.0, 0.285, 0.330, 0.340),  # skull
        (-0.110, 0.285, 3.0, 0.220, 0.325, 0.150),  # jaw
        (-0.550, 0.450, 6.0, 0.135, 0.130, 0.200),  # neck
    ]
)
_UNION_POWER = 6
# Gaussian features of the face: x (with its mirror image if not 0), y, standard deviations, and height.
_FEATURES = np.array(
    [
        (0.090, 0.155, 0.055, 0.025, 0.018),  # brows
        (0.095, 0.090, 0.042, 0.030, -0.050),  # sockets
        (0.095, 0.084, 0.026, 0.020, 0.032),  # eyes
        (0.150, -0.015, 0.045, 0.040, 0.022),  # cheekbones
        (0.105, -0.120, 0.040, 0.050, -0.016),  # cheeks
        (0.000, 0.080, 0.024, 0.045, 0.024),  # bridge of the nose
        (0.000, 0.010, 0.024, 0.045, 0.055),  # its ridge
        (0.000, -0.060, 0.028, 0.030, 0.085),  # its tip
        (0.036, -0.072, 0.020, 0.022, 0.034),  # its wings
        (0.000, -0.163, 0.042, 0.015, 0.020),  # upper lip
        (0.000, -0.205, 0.038, 0.016, 0.022),  # lower lip
        (0.000, -0.290, 0.045, 0.032, 0.035),  # chin
    ]
)
_ROWS = 900
"""Number of rows of facets from crown to neck."""
_COLUMNS = 640  # number of facets around the head
_FINER_IN_FRONT = 0.45  # relative refinement of the facets on the face


class Head(FreeForm):
    """A dummy head with the stub of its neck, centred at its origin; the face looks along -z, the crown is at +y.

    ``height_mm`` is measured from the end of the neck to the crown.
    """

    kind: Literal["head"]
    height_mm: Positive = 160.0

    def triangles(self) -> tuple[np.ndarray, np.ndarray]:
        """Return a closed surface, scaled to its height: 0.57 wide, and 0.79 from nose to back."""
        vertices, faces = _make_unit_triangles()
        return self.height_mm * vertices, faces


def _make_unit_triangles() -> tuple[np.ndarray, np.ndarray]:
    # Rows at equal distances along the front outline, from the crown, where it is level, to the neck.
    y = 0.5 - np.square(np.linspace(0, 1, 20 * _ROWS))
    way = np.concatenate([[0], np.cumsum(np.hypot(np.diff(y), np.diff(_compute_outline(y)[1])))])
    y = np.interp(np.linspace(0, way[-1], _ROWS + 1), way, y)[1:, None]
    angle = np.linspace(-np.pi, np.pi, _COLUMNS, endpoint=False)
    angle = angle - _FINER_IN_FRONT * np.sin(angle)
    half_width, front, back = _compute_outline(y)
    x, facing = half_width * np.sin(angle), np.broadcast_to(np.cos(angle), (_ROWS, _COLUMNS))
    z = np.where(facing > 0, _compute_front(x, y, front, facing), -back * facing)
    sides = np.stack([x, np.broadcast_to(y, x.shape), z], axis=-1).reshape(-1, 3)

    ring = np.arange(_COLUMNS)
    crown, cut = len(sides), len(sides) + 1
    last = crown - _COLUMNS + ring
    faces = np.concatenate(
        [
            grid_faces((_ROWS, _COLUMNS), closed=True),
            np.stack([np.full_like(ring, crown), np.roll(ring, -1), ring], axis=1),
            np.stack([np.full_like(ring, cut), last, np.roll(last, -1)], axis=1),
        ]
    )
    return np.concatenate([sides, [[0, 0.5, 0], [0, -0.5, 0]]]), faces


def _compute_outline(y: np.ndarray) -> np.ndarray:
    """Return half width, front and back (3, ...) of the head at heights y (...), as a smooth union of its bodies."""
    middle, half, flatness, *radii = (column[:, *[None] * np.ndim(y)] for column in _BODIES.T)
    share = np.sqrt(np.maximum(1 - np.abs((y - middle) / half) ** flatness, 0))
    return np.stack([np.sum((radius * share) ** _UNION_POWER, axis=0) ** (1 / _UNION_POWER) for radius in radii])


def _compute_front(x: np.ndarray, y: np.ndarray, front: np.ndarray, facing: np.ndarray) -> np.ndarray:
    """Return z of the face; ``facing`` (1 in the middle, 0 at the sides) fades the features out."""
    relief = sum(
        height * np.exp(-0.5 * (np.square((x - side * at_x) / sigma_x) + np.square((y - at_y) / sigma_y)))
        for at_x, at_y, sigma_x, sigma_y, height in _FEATURES
        for side in ((1, -1) if at_x else (1,))
    )
    return -front * facing - relief * np.square(facing)
