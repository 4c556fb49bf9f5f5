"""Whether points lie where their neighbours in the lattice put them."""

import numpy as np

# Half the side of the square of neighbours: 24 of them determine the six terms of a quadratic with room for gaps.
NEIGHBOURHOOD = 2

# Fewer neighbours than this neither support nor contradict a place.
MIN_NEIGHBOURS = 3

MAX_OVER_SPREAD = 8.0

# What a quadratic leaves of perspective and distortion over two steps, as a share of one step.
MODEL_ERROR = 0.002


def agreeing(points, indices):
    """Select the points of a lattice that agree with a quadratic through their neighbours.

    The worst point of each neighbourhood goes first and the others are judged again without it, because one wrong
    point spoils the predictions of all around it.

    Parameters
    ----------
    points : (N, 2) float64, px
    indices : (N, 2) int64
        Distinct places.

    Returns
    -------
    (M,) int64
        The points that agree, ascending.
    """
    if len(points) == 0:
        return np.empty(0, np.int64)
    low = indices.min(0) - NEIGHBOURHOOD
    shape = indices.max(0) - low + NEIGHBOURHOOD + 1
    member = np.full(shape, -1)
    place = indices - low
    member[tuple(place.T)] = np.arange(len(points))
    span = np.arange(-NEIGHBOURHOOD, NEIGHBOURHOOD + 1)
    offsets = np.array([(i, j) for i in span for j in span if (i, j) != (0, 0)])
    around = member[place[:, None, 0] + offsets[:, 0], place[:, None, 1] + offsets[:, 1]]
    i, j = offsets.T.astype(float)
    terms = np.stack([np.ones(len(offsets)), i, j, i * i, i * j, j * j], 1)
    valid = np.ones(len(points), bool)
    while valid.any():
        present = (around >= 0) & valid[around]
        alone = valid & (present.sum(1) < MIN_NEIGHBOURS)
        if alone.any():
            valid &= ~alone
            continue
        excess = _excess(points, around, present, terms, valid)
        rivals = np.where(present, excess[around], 0.0).max(1)
        wrong = valid & (excess > 1) & (excess >= rivals)
        if not wrong.any():
            break
        valid &= ~wrong
    return np.flatnonzero(valid)


def _excess(points, around, present, terms, valid):
    """Distance of each point from its prediction, over what is allowed there; zero where nothing is predicted."""
    weight = present.astype(float)
    normal = np.einsum("np,pa,pb->nab", weight, terms, terms)
    # Too few neighbours for a quadratic: keep its second-order terms at zero.
    spare = np.linalg.eigvalsh(normal)[:, 0] < 1e-6
    normal[spare, 3:, :], normal[spare, :, 3:] = 0.0, 0.0
    normal[spare] += np.diag([0.0, 0.0, 0.0, 1.0, 1.0, 1.0])
    line = np.linalg.eigvalsh(normal)[:, 0] < 1e-6
    normal[line] = np.eye(6)
    steps = (points[around] - points[:, None]) * weight[:, :, None]
    right = terms.T @ steps
    right[spare, 3:] = 0.0
    solved = np.linalg.solve(normal, right)
    # Variance of the prediction for unit variance of the neighbours, and the point's own.
    spread = np.sqrt(1 + np.linalg.inv(normal)[:, 0, 0])
    distance = np.linalg.norm(solved[:, 0], axis=1) / spread
    step = np.linalg.norm(solved[:, 1:3], axis=2).min(1)
    judged = valid & ~line & ~spare
    usual = np.median(distance[judged]) if judged.any() else 0.0
    allowed = MAX_OVER_SPREAD * usual + MODEL_ERROR * step
    # Perspective alone bends the affine prediction by up to a tenth of a step.
    allowed = np.where(spare, allowed + 0.15 * step, allowed)
    return np.where(valid & ~line, distance / np.maximum(allowed, 1e-12), 0.0)
