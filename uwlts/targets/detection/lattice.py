"""Lattice indices for the images of a regular array of circles, and a check of points against their neighbours."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import KDTree

from uwlts.errors import TargetError
from uwlts.targets.detection.ellipses import Ellipses, find_circles

# Half the side of the square of neighbours: 24 of them determine the six terms of a quadratic with room for gaps.
NEIGHBOURHOOD = 2
MIN_NEIGHBOURS = 3  # fewer neither support nor contradict a place
MAX_OVER_SPREAD = 8.0  # of the median distance from predictions: wrong points lie a good part of a step off
MODEL_ERROR = 0.002  # what a quadratic leaves of perspective and distortion over two steps, as a share of one step


def agreeing(points, indices):
    """Select the points of a lattice that agree with a quadratic through their neighbours.

    The worst point of each neighbourhood goes first and the others are judged again without it, because one wrong
    point spoils the predictions of all around it.

    ``points`` (N, 2) are in px, ``indices`` (N, 2) their distinct places. Returns the numbers (M,) of the points that
    agree, ascending.
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
    spare = np.linalg.eigvalsh(normal)[:, 0] < NO_RANK
    normal[spare, 3:, :], normal[spare, :, 3:] = 0.0, 0.0
    normal[spare] += np.diag([0.0, 0.0, 0.0, 1.0, 1.0, 1.0])
    line = np.linalg.eigvalsh(normal)[:, 0] < NO_RANK
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
    allowed = np.where(spare, allowed + AFFINE_ERROR * step, allowed)
    return np.where(valid & ~line, distance / np.maximum(allowed, 1e-12), 0.0)


NEIGHBOURS = 16  # circles among which the next ones along both axes are, for sides of up to 1 : 7
STEPS = ((1, 0), (-1, 0), (0, 1), (0, -1))

AFFINE_ERROR = 0.15  # of a step: perspective alone bends an affine prediction by up to a tenth of one
NO_RANK = 1e-6  # eigenvalue of normal equations in steps, below which neighbours do not determine the terms

# A neighbour is taken where it lies within this share of a step of its predicted place. One step changes by up to a
# tenth from one circle to the next in strong perspective; half a step would reach the neighbour's neighbour.
TOLERANCE = 0.25
MAX_SIZE_RATIO = 1.5  # of the radii of neighbouring circles

# Smallest sine of the angle between the steps of a seed, where the ellipse of its circle is a circle. An ellipse 20 %
# too round turns a right angle by up to 12 deg (sine 0.98); the diagonal of a lattice of sides 1 : 3 has the sine 0.95.
MIN_SINE = 0.95

MAX_CELL_RATIO = 1.4  # of the area of a seed's cell to the median, half-way between one and two cells
MIN_LABELLED = 4  # circles: one cell
MAX_SEEDS = 20  # pieces of lattice that are tried, the most regular ones first


@dataclass(frozen=True)
class Lattice:
    """Circles with their places in a lattice, and the number ``found`` in the image, with or without a place.

    ``indices`` (N, 2) int64 are steps (i, j) from an arbitrary circle; the turn from i to j is the turn from u to v,
    otherwise the choice of the axes is arbitrary.
    """

    circles: Ellipses
    indices: np.ndarray
    found: int


def detect_lattice(image):
    """Find the circles of a regular rectangular array without marks and number them.

    Returns the largest connected piece of lattice in an image (H, W) of uint8 or uint16; ImageError for other images,
    TargetError where fewer than four circles form a lattice.
    """
    circles = find_circles(image)
    indices, labelled = label_lattice(circles.centres, circles.shapes)
    if labelled.sum() < MIN_LABELLED:
        raise TargetError(
            f"found {len(circles)} circles, of which {labelled.sum()} form a lattice; expected at least "
            f"{MIN_LABELLED}: check that the target is in view, sharp and evenly lit"
        )
    return Lattice(circles[labelled], indices[labelled], len(circles))


def label_lattice(centres, shapes):
    """Number the points of a rectangular lattice by growing from a regular neighbourhood.

    The image of a small circle shows the local affine map, so distances and angles to neighbours are judged in the
    measure in which the ellipse is a circle: there the lattice is rectangular however oblique the view. From the seed,
    each next circle is expected one local step further on.

    ``centres`` (N, 2) and ``shapes`` (N, 2, 2) are as in `Ellipses`. Returns indices (N, 2), zero where not labelled,
    and whether (N,) a circle is labelled.
    """
    indices, labelled = np.zeros((len(centres), 2), np.int64), np.zeros(len(centres), bool)
    if len(centres) < MIN_LABELLED:
        return indices, labelled
    tree = KDTree(centres)
    radii = np.sqrt(np.linalg.det(shapes))
    bases, sines = _bases(centres, shapes, tree)
    tried, places = np.zeros(len(centres), bool), {}
    for seed in _seeds(centres, radii, bases, sines, tree):
        if tried[seed]:
            continue
        grown = _grown(seed, centres, radii, bases[seed], tree)
        tried[list(grown.values())] = True
        places = max(places, grown, key=len)
        if len(places) >= np.count_nonzero(~tried):
            break
    members, steps = np.fromiter(places.values(), int), np.array(list(places), np.int64).reshape(-1, 2)
    kept = agreeing(centres[members], steps)
    indices[members[kept]], labelled[members[kept]] = steps[kept], True
    return indices, labelled


def _bases(centres, shapes, tree):
    """Steps (N, 2, 2) along i (row 0) and j (row 1) to each circle's nearest neighbours, and the sine between, (N,).

    The second step is zero where there is none.
    """
    count = min(NEIGHBOURS + 1, len(centres))
    _, index = tree.query(centres, k=count)
    steps = centres[index[:, 1:]] - centres[:, None]
    seen = steps @ np.linalg.inv(shapes)
    length = np.linalg.norm(seen, axis=2)
    order = np.arange(len(centres))
    first = length.argmin(1)
    a, seen_a = steps[order, first], seen[order, first]
    across = np.abs(_cross(seen, seen_a[:, None])) / (length * np.linalg.norm(seen_a, axis=1)[:, None])
    length = np.where(across > MIN_SINE, length, np.inf)
    second = length.argmin(1)
    b = np.where(np.isfinite(length[order, second])[:, None], steps[order, second], 0.0)
    b *= np.sign(_cross(a, b))[:, None]
    return np.stack([a, b], 1), across[order, second]


def _cross(p, q):
    return p[..., 0] * q[..., 1] - p[..., 1] * q[..., 0]


def _seeds(centres, radii, bases, sines, tree):
    """Circles with four alike neighbours where their bases say, best first."""
    expected = centres[:, None] + np.concatenate([bases, -bases], 1)
    distance, index = tree.query(expected)
    step = np.linalg.norm(bases, axis=2)
    miss = (distance / np.maximum(np.tile(step, 2), 1e-9)).max(1)
    ratio = np.abs(np.log(radii[index] / radii[:, None])).max(1)
    # An edge of a narrow target may have no circle with four neighbours; two at a right angle are then enough.
    partial = np.sort(distance[:, :2] / np.maximum(step, 1e-9), 1)[:, 1]
    usable = (step > 0).all(1) & (partial < TOLERANCE)
    # Over the square of the radius the lattice's cell has one size in the whole image, whatever the perspective. Next
    # to gaps two diagonals may pass for a basis; their cell is twice as large.
    cell = _cross(bases[:, 0], bases[:, 1]) / radii**2
    if usable.any():
        usable &= np.abs(np.log(np.maximum(cell, 1e-9) / np.median(cell[usable]))) < np.log(MAX_CELL_RATIO)
    score = np.where(miss < TOLERANCE, miss, 1.0 + partial) + ratio + (1 - sines)
    return np.flatnonzero(usable)[np.argsort(score[usable])][:MAX_SEEDS]


def _grown(seed, centres, radii, basis, tree):
    """Places {(i, j): circle} of the piece of lattice around a seed."""
    # Complex numbers u + 1j v: the loop handles single points, for which arrays are slow.
    points, sizes = (centres @ (1, 1j)).tolist(), radii.tolist()
    places, where = {(0, 0): seed}, {seed: (0, 0)}
    steps = {seed: tuple((basis @ (1, 1j)).tolist())}
    frontier, reach = [seed], 1
    while frontier:
        expected, asked = [], []
        for circle in frontier:
            steps[circle] = _local_steps(where[circle], places, points, steps[circle])
            i, j = where[circle]
            for di, dj in STEPS:
                place = (i + reach * di, j + reach * dj)
                if place not in places:
                    expected.append(points[circle] + reach * (di * steps[circle][0] + dj * steps[circle][1]))
                    asked.append((circle, place, abs(dj)))
        fresh = []
        if asked:
            nearby = np.array(expected, complex)
            distance, index = tree.query(np.column_stack([np.real(nearby), np.imag(nearby)]))
            for ask in np.argsort(distance, kind="stable").tolist():
                (circle, place, axis), found = asked[ask], int(index[ask])
                if place in places or found in where or distance[ask] > TOLERANCE * abs(steps[circle][axis]):
                    continue
                if not 1 / MAX_SIZE_RATIO < sizes[found] / sizes[circle] < MAX_SIZE_RATIO:
                    continue
                places[place], where[found] = found, place
                steps[found] = steps[circle]
                fresh.append(found)
        if fresh:
            frontier, reach = fresh, 1
        elif reach == 1:
            # Step over single missing circles once nothing else is left.
            frontier, reach = list(where), 2
        else:
            frontier = []
    return places


def _local_steps(place, places, points, inherited):
    """Steps along i and j at a place: half the way between both neighbours, or the way to one, or as inherited."""
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
