"""A triangle mesh of one or several clouds, with the uncertainty of every vertex; open where nothing was seen.

The distance from the surface is evaluated on the corners of cubes near points (a sparse signed-distance field), each by
a local patch weighted by the points' covariance; marching cubes (Lewiner et al., J. Graphics Tools 8, 2003) give the
triangles, and the vertices are then moved onto their own patches.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import cast

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from uwlts.errors import EvaluationError
from uwlts.evaluation.figures import TOWARDS_SENSOR
from uwlts.fitting.local_surface import LocalSurface, SurfacePoints, surface_normals
from uwlts.fitting.point_spacing import disc_of
from uwlts.runtime.progress import ProgressListener, unheard
from uwlts.storage.cloud import PointCloud, images_along, variance_along
from uwlts.storage.cloud_files import loaded_cloud
from uwlts.storage.mesh_file import SurfaceMesh

_BLOCK = 48
"""Cubes along the edge of a block that marching cubes see at once."""
_PLACES_AT_A_TIME = 500_000
_FEWEST = 50
_CUBES_OF_RADIUS = 3.0
_CUBES_OF_WALL = 1.5
"""Every wall holds a corner of the cubes then, up to an angle of 48 deg to their edges with the noise left out."""
_WALLS_ASKED = 4000
_OPPOSITE = 0.7
"""Cosine of the angle between one side's normal and the other's turned about, at most: 45 deg."""
_FARTHEST_CUBES = 0.75
"""How far from its patch a vertex may lie: by linear interpolation it lies much nearer, unless two walls were mixed."""
_FEWEST_OF_PIECE = 20
"""Triangles of a piece that is kept; smaller ones are outliers."""


def mesh(
    *clouds: PointCloud | str | os.PathLike[str],
    cube_mm: float | None = None,
    radius_mm: float | None = None,
    towards: Sequence[tuple[float, float, float]] | None = None,
    progress: ProgressListener = unheard,
) -> SurfaceMesh:
    """Make a mesh from one or several clouds of one frame, open where nothing was seen, with uncertainty.

    Parameters
    ----------
    clouds
        Clouds or their files. In a cloud that `uwlts.register` has merged the scans count on their own.
    cube_mm
        Edge of the cubes; walls need to be thicker. A third of the patches' radius unless given, or two thirds of the
        thinnest wall.
    radius_mm
        Radius of the patches over which points are averaged: holes that are much smaller are closed. For some thirty
        points, and three images, unless given.
    towards
        Direction x y z from the surface to the sensor, once for each cloud; -Z turned as its scan was, unless given.
    progress
        Called with the number of places done and the number in all.

    Returns
    -------
    SurfaceMesh
        Holes are open where nothing was seen. Points are weighted by one over their variance along the normal, so that
        of two clouds the better one counts more; the clouds' shared errors count as independent of each other.

    Raises
    ------
    CaptureError
        A cloud cannot be read.
    EvaluationError
        A cloud has too few points, lengths are not positive, or directions do not fit the clouds.

    Examples
    --------
    >>> surface = uwlts.mesh("left.ply", "right.ply")
    >>> surface.save("pipe.glb")
    """
    for name, length in (("cube_mm", cube_mm), ("radius_mm", radius_mm)):
        if length is not None and not 0 < length < np.inf:
            raise EvaluationError(f"{name} is {length:g}; expected a positive length in mm")
    if not clouds:
        raise EvaluationError("a mesh needs at least one cloud")
    read = [loaded_cloud(each) for each in clouds]
    if towards is not None and (np.shape(towards) != (len(read), 3) or not np.all(np.linalg.norm(towards, axis=1) > 0)):
        raise EvaluationError(f"there are {len(read)} clouds: expected a direction of three numbers for each")
    scans = [
        scan
        for number, cloud in enumerate(read)
        for scan in _scans(cloud, None if towards is None else np.asarray(towards[number], float))
    ]
    if small := [len(cloud) for cloud, _ in scans if len(cloud) < _FEWEST]:
        raise EvaluationError(f"a cloud or scan has {small[0]} points; at least {_FEWEST} are needed")
    radius = radius_mm or max(0.65 * disc_of(cloud.points_mm, cloud.frame) for cloud, _ in scans)
    if cube_mm is not None and cube_mm > radius:
        raise EvaluationError(f"cube_mm is {cube_mm:g}; expected at most the patches' radius, {radius:g} mm")
    points = _surface_points(scans, radius)
    cube = cube_mm or max(min(radius / _CUBES_OF_RADIUS, _thinnest_wall(points, radius) / _CUBES_OF_WALL), radius / 16)
    surface = LocalSurface(points, radius_mm=radius)
    low = points.points_mm.min(axis=0) - 4 * cube
    corners = _corners_near(np.floor((points.points_mm - low) / cube).astype(np.int64))
    distance, known = _distances(surface, low + cube * corners, progress)
    vertices, faces = _marched(corners, distance / cube, known)
    places = low + cube * vertices
    patches = surface.patches(places, with_uncertainty=True)
    kept = patches.found & (np.abs(patches.height_mm) < _FARTHEST_CUBES * cube)
    places = places + np.where(kept, patches.height_mm, 0.0)[:, None] * patches.normals
    faces = _facing(places, faces[kept[faces].all(axis=1)], patches.normals)
    used, faces = _without_crumbs(faces, len(places))
    if not len(faces):
        raise EvaluationError(
            f"no surface was found with patches of {radius:g} mm radius: are the points so sparse? Give a "
            "larger radius_mm"
        )
    every = points.points_mm[:: max(1, len(points.points_mm) // _WALLS_ASKED)]
    away = np.asarray(KDTree(places[used]).query(every, distance_upper_bound=radius)[0])
    return SurfaceMesh(
        places[used],
        patches.normals[used],
        faces,
        patches.noise_mm[used],
        patches.shared_mm[used],
        cube,
        radius,
        float(np.mean(~np.isfinite(away))),
        {"clouds": [dict(cloud.metadata) for cloud in read], "scans": len(scans)},
    )


def _scans(cloud: PointCloud, towards: np.ndarray | None) -> list[tuple[PointCloud, np.ndarray]]:
    """The scans of a cloud with the direction from the surface to the sensor."""
    listed = cloud.metadata.get("scans")
    if towards is not None or not isinstance(listed, list) or not listed:
        way = TOWARDS_SENSOR if towards is None else towards
        return [(cloud, way / np.linalg.norm(way))]
    try:
        firsts = np.array([each["first_frame"] for each in listed], int)  # type: ignore[index, call-overload]
        poses = np.array([each["pose"] for each in listed], float)  # type: ignore[index, call-overload]
        ways = poses[:, :3, :3] @ TOWARDS_SENSOR
    except (KeyError, TypeError, ValueError, IndexError) as error:
        raise EvaluationError(f"the cloud's list of scans is not valid: {error!r}") from error
    owner = np.searchsorted(firsts, cloud.frame, side="right") - 1
    return [
        (cloud.selected(np.flatnonzero(owner == number)), way)
        for number, way in enumerate(ways)
        if np.any(owner == number)
    ]


def _surface_points(scans: list[tuple[PointCloud, np.ndarray]], radius: float) -> SurfacePoints:
    """All points with what is known of them along their normals."""
    parts, first, most = [], 0, max((len(c.uncertainty.patterns_mm) for c, _ in scans if c.uncertainty), default=0)
    for number, (cloud, towards) in enumerate(scans):
        count, known = len(cloud), cloud.uncertainty
        normals = surface_normals(cloud.points_mm, radius_mm=radius, towards=towards)
        noise, position, patterns = np.zeros(count), np.zeros(count), np.zeros((most, count))
        weight = np.ones(count)
        if known is not None:
            noise = np.maximum(variance_along(known.random_mm2, normals), 0.0)
            # Shift and turn of an image count together, as if they moved all its points alike.
            position = np.sqrt(np.sum(images_along(known, normals) ** 2, axis=0))
            patterns[: len(known.patterns_mm)] = np.einsum("mni,ni->mn", known.patterns_mm, normals)
            # A tenth of a micrometre, so that no point weighs infinitely.
            weight = 1.0 / np.maximum(noise + position**2 + np.sum(patterns**2, axis=0), 1e-8)
        image = np.arange(count) if (cloud.frame < 0).any() else cloud.frame.astype(np.int64)
        owner = np.full(count, number)
        parts.append((cloud.points_mm, normals, weight, noise, position, image + first, patterns.T, owner))
        first += int(image.max()) + 1
    points, normals, weight, noise, position, image, patterns, owner = (
        np.concatenate(each) for each in zip(*parts, strict=True)
    )
    # Clouds without uncertainty beside others count as the usual point of these.
    stated = np.concatenate([np.full(len(cloud), cloud.uncertainty is not None) for cloud, _ in scans])
    if stated.any() and not stated.all():
        weight[~stated] = np.median(weight[stated])
    return SurfacePoints(points, normals, weight, noise, position, image, patterns.T, owner)


def _thinnest_wall(points: SurfacePoints, radius: float) -> float:
    """Thickness of the thinnest walls (2 % of the points may lie on thinner ones); infinite where there are none."""
    places, tree = points.points_mm, KDTree(points.points_mm)
    chosen = np.arange(len(places))[:: max(1, len(places) // _WALLS_ASKED)]
    # Some of the neighbours are enough: a wall has many points on its other side.
    neighbours = cast(list[list[int]], tree.query_ball_point(places[chosen], radius))
    found = [near[:: max(1, len(near) // 200)] for near in neighbours]
    owner, other = np.repeat(chosen, [len(each) for each in found]), np.concatenate(found)
    opposite = np.einsum("ni,ni->n", points.normals[owner], points.normals[other]) < -_OPPOSITE
    below = -np.einsum("ni,ni->n", places[other] - places[owner], points.normals[owner])
    behind = opposite & (below > 0)
    thickness = np.full(len(places), np.inf)
    np.minimum.at(thickness, owner[behind], below[behind])
    return float(np.quantile(thickness[chosen], 0.02, method="lower")) if len(chosen) else np.inf


def _corners_near(cells: np.ndarray) -> np.ndarray:
    """Corners (C, 3) of the cubes that hold points, and of those two around."""
    corners = np.unique(cells, axis=0)
    shape = corners.max(axis=0) + 8
    keys = np.asarray(np.ravel_multi_index(tuple(corners.T + 3), tuple(shape)))
    for axis in range(3):
        step = int(np.prod(shape[axis + 1 :]))
        keys = np.unique((keys[:, None] + step * np.arange(-2, 4)).ravel())
    return np.stack(np.unravel_index(keys, tuple(shape)), axis=1) - 3


def _distances(surface: LocalSurface, places: np.ndarray, progress: ProgressListener) -> tuple[np.ndarray, np.ndarray]:
    """Signed distances (P,) of places from the surface, positive outside, and where they are known."""
    distance, known = np.zeros(len(places)), np.zeros(len(places), bool)
    for start in range(0, len(places), _PLACES_AT_A_TIME):
        here = slice(start, start + _PLACES_AT_A_TIME)
        patches = surface.patches(places[here])
        distance[here], known[here] = -patches.height_mm, patches.found
        progress(min(start + _PLACES_AT_A_TIME, len(places)), len(places))
    return distance, known


def _marched(corners: np.ndarray, distance: np.ndarray, known: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3), in units of the cubes, and triangles (F, 3) of the zero of distances at corners (C, 3)."""
    from skimage.measure import marching_cubes

    corners, distance = corners[known], distance[known]
    # A block has one more corner than cubes along each edge; corners between blocks belong to both.
    block = np.floor_divide(corners, _BLOCK)
    blocks, owner = np.unique(block, axis=0, return_inverse=True)
    order = np.argsort(owner.ravel(), kind="stable")
    bounds = np.searchsorted(owner.ravel()[order], np.arange(len(blocks) + 1))
    members = {tuple(each): order[a:b] for each, a, b in zip(blocks.tolist(), bounds[:-1], bounds[1:], strict=True)}
    vertices, faces, first = [], [], 0
    for each in members:
        volume = np.zeros((_BLOCK + 1,) * 3, np.float32)
        here = np.zeros(volume.shape, bool)
        for beside in np.ndindex(2, 2, 2):
            chosen = members.get(tuple(int(a + b) for a, b in zip(each, beside, strict=True)))
            if chosen is None:
                continue
            local = corners[chosen] - _BLOCK * np.array(each)
            inside = (local <= _BLOCK).all(axis=1)
            volume[tuple(local[inside].T)] = distance[chosen[inside]]
            here[tuple(local[inside].T)] = True
        mask = np.zeros(volume.shape, bool)
        # A cube stands at its last corner.
        mask[1:, 1:, 1:] = np.logical_and.reduce(
            [here[x : _BLOCK + x, y : _BLOCK + y, z : _BLOCK + z] for x, y, z in np.ndindex(2, 2, 2)]
        )
        crossed = volume[mask]
        if not mask.any() or crossed.min() > 1.8 or crossed.max() < -1.8:
            continue
        try:
            found, triangles, _, _ = marching_cubes(volume, 0.0, mask=mask, allow_degenerate=False)
        except (RuntimeError, ValueError):
            # The library's words for a block without a crossing.
            continue
        vertices.append(found.astype(np.float64) + _BLOCK * np.array(each))
        faces.append(triangles + first)
        first += len(found)
    if not vertices:
        return np.empty((0, 3)), np.empty((0, 3), np.int64)
    return _welded(np.concatenate(vertices), np.concatenate(faces).astype(np.int64))


def _welded(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The same with the vertices between blocks joined."""
    away = np.abs(vertices / _BLOCK - np.round(vertices / _BLOCK)) * _BLOCK
    shared = np.flatnonzero((away < 1e-3).any(axis=1))
    if not len(shared):
        return vertices, faces
    pairs = shared[KDTree(vertices[shared]).query_pairs(1e-3, output_type="ndarray")]
    links = coo_array((np.ones(len(pairs), bool), pairs.T), shape=(len(vertices),) * 2)
    owner = connected_components(links, directed=False)[1]
    first = np.unique(owner, return_index=True)[1]
    return vertices[first], owner[faces]


def _facing(places: np.ndarray, faces: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Triangles without those of no area, turned so that they face along the vertices' normals."""
    a, b, c = (places[faces[:, k]] for k in range(3))
    across = np.cross(b - a, c - a)
    backwards = np.einsum("fi,fi->f", across, normals[faces].sum(axis=1)) < 0
    faces = np.where(backwards[:, None], faces[:, [0, 2, 1]], faces)
    return faces[np.linalg.norm(across, axis=1) > 0]


def _without_crumbs(faces: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V,) that are left, and triangles of these, without pieces of few triangles."""
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]]])
    links = coo_array((np.ones(len(edges), bool), edges.T), shape=(count, count))
    piece = connected_components(links, directed=False)[1]
    own = piece[faces[:, 0]]
    faces = faces[np.bincount(own, minlength=int(piece.max(initial=0)) + 1)[own] >= _FEWEST_OF_PIECE]
    used, renumbered = np.unique(faces, return_inverse=True)
    return used, renumbered.reshape(-1, 3)
