"""Sides of a mesh that a scan saw: a thin part has two surfaces within the search depth."""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import breadth_first_order, connected_components, minimum_spanning_tree
from scipy.spatial import KDTree

_OPPOSITE = -0.5
"""Largest cosine between the normals of opposite sides: 120 deg, beyond the angle of two faces at an edge."""
_SMOOTH = 0.7
"""Least absolute cosine between normals of one face: orientation is not carried across an edge of 90 deg."""
_NEARER = 0.25
"""Ratio of the distances to both sides below which a place clearly belongs to the nearer one."""
_BOTH = 0.25
"""Fraction of the places on the other side from which the scan contains both sides. Wear nearly as deep
as the part is thick must cover more than this fraction of a face to be mistaken for its other side."""


def orient_triangles(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return faces (F, 3) whose normals agree across edges, in each connected part with most of its area unchanged.

    Parts that have only one side, such as a Moebius strip, are unchanged. Normals of a closed mesh point outwards.
    """
    joined = np.unique(vertices, axis=0, return_inverse=True)[1].reshape(-1)[faces]
    edges, face = joined[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), np.repeat(np.arange(len(faces)), 3)
    forward, edges = edges[:, 0] < edges[:, 1], np.sort(edges, axis=1)
    owner, count = np.unique(edges, axis=0, return_inverse=True, return_counts=True)[1:]
    order = np.argsort(owner, kind="stable")
    # Edges of more than two triangles do not determine which of them continue each other.
    order = order[(count == 2)[owner.reshape(-1)[order]]].reshape(-1, 2)
    (one, other), turned = face[order].T, forward[order[:, 0]] == forward[order[:, 1]]
    # Each triangle is two nodes, as it is and turned. Consistent triangles are connected.
    many = len(faces)
    starts, ends = np.concatenate([one, one + many]), np.concatenate([other + many * turned, other + many * ~turned])
    part = connected_components(coo_array((np.ones(len(starts)), (starts, ends)), shape=(2 * many,) * 2))[1]
    one, two = (vertices[faces[:, k]] - vertices[faces[:, 0]] for k in (1, 2))
    area = np.linalg.norm(np.cross(one, two), axis=1)
    kept = np.bincount(part[:many], area, minlength=part.max() + 1)
    turn = kept[part[many:]] > kept[part[:many]]
    result = faces.copy()
    result[turn] = faces[turn][:, ::-1]
    corners = vertices[result] - vertices[faces].mean(axis=(0, 1))
    return result[:, ::-1] if (count == 2).all() and np.linalg.det(corners).sum() < 0 else result


def select_seen_side(
    places: np.ndarray, samples: np.ndarray, normals: np.ndarray, *, deep_mm: float, apart_mm: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return a mask (M,) of the samples of a mesh on the side that a scan saw, and search depths (P,) at its places.

    If the opposite side lies within the search depth, neighbouring places of a face decide together: the scan saw
    the side to which more of them are nearer. A scan of both sides keeps all samples, and the depth is half of the
    thickness there.

    ``places`` (P, 3) of the scan have a spacing ``apart_mm``; ``samples`` and ``normals`` (M, 3) are those of the mesh.
    """
    nearest = np.asarray(KDTree(samples).query(places, workers=-1)[1])
    facing = normals[nearest]
    # With normals as further coordinates, the nearest sample within the depth has the opposite normal if there is one.
    reach = deep_mm + apart_mm  # a place may lie in a worn part, or between the sides
    six = KDTree(np.hstack([samples, reach * normals]))
    other = np.asarray(six.query(np.hstack([places, -reach * facing]), workers=-1)[1])
    double = np.einsum("pi,pi->p", normals[other], facing) < _OPPOSITE
    double &= np.linalg.norm(samples[other] - places, axis=1) <= reach
    deep = np.full(len(places), deep_mm)
    if not double.any():
        return np.ones(len(samples), bool), deep
    here, there = (np.abs(np.einsum("pi,pi->p", places - samples[index], normals[index])) for index in (nearest, other))
    sign, part = _orient_places(places, facing, apart_mm)
    clear = ~double | (here < _NEARER * there)
    sure = np.bincount(part, clear)
    outwards = np.bincount(part, clear * (sign > 0))
    both = np.minimum(outwards, sure - outwards) > _BOTH * sure
    side = np.where(np.bincount(part, sign) >= 0, 1, -1)
    keeps = np.where(both[part], 1, side[part] * sign)
    nearby, place = KDTree(places).query(samples, workers=-1)
    seen = np.einsum("mi,mi->m", normals, keeps[place, None] * facing[place]) > 0
    # With both sides, the nearest place of a sample may be on the other one.
    seen |= (nearby > reach) | both[part[place]]
    limited = double & seen[np.where(keeps > 0, other, nearest)]
    deep[limited] = (here + there)[limited] / 2
    return seen, deep


def _orient_places(places: np.ndarray, normals: np.ndarray, apart_mm: float) -> tuple[np.ndarray, np.ndarray]:
    """Return signs (P,) that make normals of neighbours on a face agree, and the number (P,) of the face.

    Orientations spread along the minimum spanning tree of the angles (Hoppe et al., SIGGRAPH 1992).
    """
    pairs = KDTree(places).query_pairs(2 * apart_mm, output_type="ndarray")
    cosine = np.einsum("pi,pi->p", normals[pairs[:, 0]], normals[pairs[:, 1]])
    pairs, cosine = pairs[np.abs(cosine) > _SMOOTH], cosine[np.abs(cosine) > _SMOOTH]
    # A weight of zero would be no edge.
    weight = np.maximum(1 - np.abs(cosine), 0) + 1e-6
    tree = minimum_spanning_tree(coo_array((weight, pairs.T), shape=(len(places),) * 2).tocsr())
    count, part = connected_components(tree, directed=False)
    sign = np.ones(len(places))
    for first in np.unique(part, return_index=True)[1] if count else ():
        order, before = breadth_first_order(tree, first, directed=False)
        for place in order[1:]:
            sign[place] = sign[before[place]] * np.sign(normals[place] @ normals[before[place]])
    return sign, part
