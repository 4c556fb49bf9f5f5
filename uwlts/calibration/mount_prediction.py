"""How well the poses of a mount calibration fit."""

import numpy as np

from uwlts.calibration.mount_model import MountState, Problem


def misfits(problem: Problem, state: MountState) -> np.ndarray:
    """Root mean square distance (P,) of the points of each pose."""
    squares = problem.distances(state) ** 2
    return np.sqrt(np.bincount(problem.poses, squares) / problem.counts)
