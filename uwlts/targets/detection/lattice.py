"""Lattice indices for the images of a regular array of circles, and a check of points against their neighbours."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import KDTree

from uwlts.errors import TargetError
from uwlts.targets.detection.ellipses import Ellipses, find_circles


@dataclass(frozen=True, kw_only=True)
class LatticeRule:
    """Numbers of the numbering of lattices. A step is the distance between neighbouring points.

    Chosen by hand with the reasons below, not fitted to data. Results with these numbers are checked on the drawn
    plates and boards of tests/uwlts/targets and on real photographs (tests/system/test_real_images.py).
    """

    neighbourhood: int = 2
    """Half the side of the square of neighbours: 24 neighbours determine the six terms of a quadratic, even with
    gaps."""
    fewest_neighbours: int = 3  # fewest neighbours for a check of a place
    over_median: float = 8.0
    """Largest distance from the prediction, in median distances; wrong points are off by a large part of a step."""
    model_error: float = 0.002  # error of a quadratic over two steps by perspective and distortion, in steps
    affine_error: float = 0.15  # error of an affine prediction, in steps: perspective alone contributes up to 0.1
    least_eigenvalue: float = 1e-6
    """Eigenvalue of normal equations, in steps, below which neighbours do not determine the terms."""
    candidates: int = 16  # nearest circles that contain the next ones along both axes, for sides of up to 1 : 7
    tolerance: float = 0.25
    """Largest distance of a neighbour from its predicted place, in steps. In strong perspective a step changes by up
    to 0.1 from one circle to the next; half a step would reach the neighbour's neighbour."""
    size_ratio: float = 1.5  # largest ratio of the radii of neighbouring circles
    seed_sine: float = 0.95
    """Least sine of the angle between the steps of a seed, in the metric of its circle. An ellipse 20 % too round
    changes a right angle by up to 12 deg (sine 0.98); the diagonal of a lattice with sides 1 : 3 has a sine of 0.95."""
    cell_ratio: float = 1.4  # largest ratio of a seed's cell to the median cell, halfway between one and two cells
    fewest_labelled: int = 4  # fewest circles of a lattice: one cell
    most_seeds: int = 20  # most seeds that are tried, the most regular ones first


LATTICE_RULE = LatticeRule()


def select_agreeing(points, indices):
    """Select the points of a lattice that agree with a quadratic through their neighbours.

    The worst point of each neighbourhood is removed first, and the others are checked again without it, because a wrong
    point changes the predictions of all its neighbours.

    ``points`` (N, 2) are in px, ``indices`` (N, 2) their distinct places. Returns the indices (M,) of the points that
    agree, in ascending order.
    """
    if len(points) == 0:
        return np.empty(0, np.int64)
    low = indices.min(0) - LATTICE_RULE.neighbourhood
    member = np.full(indices.max(0) - low + LATTICE_RULE.neighbourhood + 1, -1)
    place = indices - low
    member[tuple(place.T)] = np.arange(len(points))
    span = np.arange(-LATTICE_RULE.neighbourhood, LATTICE_RULE.neighbourhood + 1)
    offsets = np.array([(i, j) for i in span for j in span if (i, j) != (0, 0)])
    around = member[place[:, None, 0] + offsets[:, 0], place[:, None, 1] + offsets[:, 1]]
    i, j = offsets.T.astype(float)
    terms = np.stack([np.ones(len(offsets)), i, j, i * i, i * j, j * j], 1)
    valid = np.ones(len(points), bool)
    while valid.any():
        present = (around >= 0) & valid[around]
        alone = valid & (present.sum(1) < LATTICE_RULE.fewest_neighbours)
        if alone.any():
            valid &= ~alone
            continue
        excess = _compute_relative_errors(points, around, present, terms, valid)
        wrong = valid & (excess > 1) & (excess >= np.where(present, excess[around], 0.0).max(1))
        if not wrong.any():
            break
        valid &= ~wrong
    return np.flatnonzero(valid)


def _compute_relative_errors(points, around, present, terms, valid):
    """Return each point's distance from its prediction, divided by the allowed one; zero without a prediction."""
    weight = present.astype(float)
    normal = np.einsum("np,pa,pb->nab", weight, terms, terms)
    # With too few neighbours for a quadratic, fix its second-order terms at zero.
    spare = np.linalg.eigvalsh(normal)[:, 0] < LATTICE_RULE.least_eigenvalue
    normal[spare, 3:, :], normal[spare, :, 3:] = 0.0, 0.0
    normal[spare] += np.diag([0.0, 0.0, 0.0, 1.0, 1.0, 1.0])
    line = np.linalg.eigvalsh(normal)[:, 0] < LATTICE_RULE.least_eigenvalue
    normal[line] = np.eye(6)
    steps = (points[around] - points[:, None]) * weight[:, :, None]
    right = terms.T @ steps
    right[spare, 3:] = 0.0
    solved = np.linalg.solve(normal, right)
    # Variance of the prediction for unit variance of the neighbours, plus the point's own variance.
    spread = np.sqrt(1 + np.linalg.inv(normal)[:, 0, 0])
    distance = np.linalg.norm(solved[:, 0], axis=1) / spread
    step = np.linalg.norm(solved[:, 1:3], axis=2).min(1)
    judged = valid & ~line & ~spare
    usual = np.median(distance[judged]) if judged.any() else 0.0
    allowed = LATTICE_RULE.over_median * usual + LATTICE_RULE.model_error * step
    allowed = np.where(spare, allowed + LATTICE_RULE.affine_error * step, allowed)
    return np.where(valid & ~line, distance / np.maximum(allowed, 1e-12), 0.0)


@dataclass(frozen=True)
class Lattice:
    """Circles with their places in a lattice."""

    circles: Ellipses
    indices: np.ndarray
    """(N, 2) int64; steps (i, j) from an arbitrary circle. The rotation from i to j has the direction from u to v;
    otherwise the choice of the axes is arbitrary."""
    found: int  # number of circles found in the image, with or without a place


def detect_lattice(image, read=lambda lattice: lattice):
    """Find the circles of a regular rectangular array without marks and number them.

    ``read`` turns the largest connected part of a lattice into a result, or raises `TargetError`: then the next family
    of circles is tried. If none has a result, the TargetError is that of the largest lattice.
    """
    most, reason = -1, TargetError("")
    for circles in find_circles(image):
        indices, labelled = label_lattice(circles.centres, circles.shapes)
        count = int(labelled.sum())
        try:
            if count < LATTICE_RULE.fewest_labelled:
                raise TargetError(
                    f"found {len(circles)} circles, {count} of them in a lattice; expected at least "
                    f"{LATTICE_RULE.fewest_labelled}: check that the target is in view, sharp and evenly lit"
                )
            return read(Lattice(circles[labelled], indices[labelled], len(circles)))
        except TargetError as error:
            if count > most:
                most, reason = count, error
    raise reason


def label_lattice(centres, shapes):
    """Assign indices to points of a rectangular lattice, starting from a regular neighbourhood.

    The image of a small circle shows the local affine map. Distances and angles to neighbours are measured in the
    metric that makes the ellipse a circle: there the lattice is rectangular in any oblique view. From the seed on, each
    next circle is expected one local step further.

    ``centres`` (N, 2) and ``shapes`` (N, 2, 2) are described in `Ellipses`. Returns indices (N, 2), zero for unlabelled
    circles, and a mask (N,) of labelled circles.
    """
    indices, labelled = np.zeros((len(centres), 2), np.int64), np.zeros(len(centres), bool)
    if len(centres) < LATTICE_RULE.fewest_labelled:
        return indices, labelled
    tree = KDTree(centres)
    radii = np.sqrt(np.linalg.det(shapes))
    bases, sines = _find_bases(centres, shapes, tree)
    tried, places = np.zeros(len(centres), bool), {}

    def are_alike(circle, other, _):
        return 1 / LATTICE_RULE.size_ratio < radii[other] / radii[circle] < LATTICE_RULE.size_ratio

    for seed in _choose_seeds(centres, radii, bases, sines, tree):
        if tried[seed]:
            continue
        grown = grow_lattice(seed, bases[seed], centres, tree, nearest=1, may_be_neighbours=are_alike)
        tried[list(grown.values())] = True
        places = max(places, grown, key=len)
        if len(places) >= np.count_nonzero(~tried):
            break
    members, steps = np.fromiter(places.values(), int), np.array(list(places), np.int64).reshape(-1, 2)
    kept = select_agreeing(centres[members], steps)
    indices[members[kept]], labelled[members[kept]] = steps[kept], True
    return indices, labelled


def _find_bases(centres, shapes, tree):
    """Return steps (N, 2, 2) along i (row 0) and j (row 1) to each circle's neighbours, and the sine (N,) between them.

    The second step is zero if there is no such neighbour.
    """
    _, index = tree.query(centres, k=min(LATTICE_RULE.candidates + 1, len(centres)))
    steps = centres[index[:, 1:]] - centres[:, None]
    seen = steps @ np.linalg.inv(shapes)
    length = np.linalg.norm(seen, axis=2)
    order = np.arange(len(centres))
    first = length.argmin(1)
    a, seen_a = steps[order, first], seen[order, first]
    across = np.abs(_cross(seen, seen_a[:, None])) / (length * np.linalg.norm(seen_a, axis=1)[:, None])
    length = np.where(across > LATTICE_RULE.seed_sine, length, np.inf)
    second = length.argmin(1)
    b = np.where(np.isfinite(length[order, second])[:, None], steps[order, second], 0.0)
    b *= np.sign(_cross(a, b))[:, None]
    return np.stack([a, b], 1), across[order, second]


def _cross(p, q):
    return p[..., 0] * q[..., 1] - p[..., 1] * q[..., 0]


def _choose_seeds(centres, radii, bases, sines, tree):
    """Return circles with four neighbours where their steps predict them, the most regular ones first."""
    distance, index = tree.query(centres[:, None] + np.concatenate([bases, -bases], 1))
    step = np.linalg.norm(bases, axis=2)
    miss = (distance / np.maximum(np.tile(step, 2), 1e-9)).max(1)
    ratio = np.abs(np.log(radii[index] / radii[:, None])).max(1)
    # In a narrow target no circle may have four neighbours; two at a right angle are sufficient.
    partial = np.sort(distance[:, :2] / np.maximum(step, 1e-9), 1)[:, 1]
    usable = (step > 0).all(1) & (partial < LATTICE_RULE.tolerance)
    # A cell's area divided by the squared radius is constant in the image, for any perspective. Next to gaps, two
    # diagonals may be taken for a basis; their cell is twice as large.
    cell = _cross(bases[:, 0], bases[:, 1]) / radii**2
    if usable.any():
        usable &= np.abs(np.log(np.maximum(cell, 1e-9) / np.median(cell[usable]))) < np.log(LATTICE_RULE.cell_ratio)
    score = np.where(miss < LATTICE_RULE.tolerance, miss, 1.0 + partial) + ratio + (1 - sines)
    return np.flatnonzero(usable)[np.argsort(score[usable])][: LATTICE_RULE.most_seeds]


def grow_lattice(seed, basis, points, tree, *, nearest, may_be_neighbours):
    """Return places {(i, j): point} of the connected part of a lattice around a seed with the steps ``basis`` (2, 2).

    From each point the lattice grows by one local step along both axes, to one of the ``nearest`` points (N, 2) of the
    place that ``may_be_neighbours(point, other, reach)`` accepts. When no further point is found, it skips single
    missing points: ``reach`` is 2.
    """
    # Complex numbers u + 1j v: arrays are slow for the single points of this loop.
    at = (points @ (1, 1j)).tolist()
    places, where = {(0, 0): seed}, {seed: (0, 0)}
    steps = {seed: tuple((basis @ (1, 1j)).tolist())}
    frontier, reach, ranks = [seed], 1, range(1, min(nearest, len(points)) + 1)
    while frontier:
        asked, expected, lengths = [], [], []
        for point in frontier:
            steps[point] = _find_local_steps(where[point], places, at, steps[point])
            i, j = where[point]
            for di, dj in ((1, 0), (-1, 0), (0, 1), (0, -1)):
                if (place := (i + reach * di, j + reach * dj)) not in places:
                    step = (di + dj) * steps[point][abs(dj)]
                    asked.append((point, place))
                    expected.append(at[point] + reach * step)
                    lengths.append(abs(step))
        frontier = []
        if asked:
            distance, index = tree.query(np.array(expected, complex).view(float).reshape(-1, 2), k=ranks)
            ask_of, rank_of = np.nonzero(distance < LATTICE_RULE.tolerance * np.array(lengths)[:, None])
            found, order = index[ask_of, rank_of].tolist(), np.argsort(distance[ask_of, rank_of], kind="stable")
            for (point, place), other in ((asked[ask_of[k]], found[k]) for k in order.tolist()):
                if place not in places and other not in where and may_be_neighbours(point, other, reach):
                    places[place], where[other], steps[other] = other, place, steps[point]
                    frontier.append(other)
        if frontier:
            reach = 1
        elif reach == 1:
            reach, frontier = 2, list(where)
    return places


def _find_local_steps(place, places, points, inherited):
    """Return the steps along i and j at a place: the mean over both neighbours, one neighbour, or as inherited."""
    i, j = place
    here = points[places[place]]
    steps = list(inherited)
    for axis, (after, before) in enumerate((((i + 1, j), (i - 1, j)), ((i, j + 1), (i, j - 1)))):
        if after in places and before in places:
            steps[axis] = (points[places[after]] - points[places[before]]) / 2
        elif after in places:
            steps[axis] = points[places[after]] - here
        elif before in places:
            steps[axis] = here - points[places[before]]
    return tuple(steps)
