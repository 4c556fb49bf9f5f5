"""Numbers of points that belong together: in the same cube of space, or with the same key."""

import numpy as np


def number_cubes(points: np.ndarray, side: float) -> np.ndarray:
    """Return the cube (N,) of each point (N, 3) in a cubic grid; coordinates must not be negative."""
    cells = np.floor(points / side).astype(np.int64)
    _, rows, layers = cells.max(axis=0) + 1
    return (cells[:, 0] * rows + cells[:, 1]) * layers + cells[:, 2]


def group_rows(keys: np.ndarray) -> dict[int, np.ndarray]:
    """Return the rows with each key, in order; keys (N,) must not be negative."""
    order = np.argsort(keys, kind="stable")
    starts = np.flatnonzero(np.diff(keys[order], prepend=-1))
    return dict(zip(keys[order][starts].tolist(), np.split(order, starts[1:]), strict=True)) if len(order) else {}
