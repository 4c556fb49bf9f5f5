"""Triangle mesh of one or several clouds, with the uncertainty of each vertex and open holes.

Local patches, weighted by the points' covariance, give a sparse signed-distance field at the corners of cubes near
points. Marching cubes (Lewiner et al., J. Graphics Tools 8, 2003) extract the triangles. The vertices are then moved
onto their own patches.
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
from uwlts.fitting.least_squares import robust_std
from uwlts.fitting.local_surface import LocalSurface, SurfacePoints, choose_disc_diameter, group_rows, surface_normals
from uwlts.runtime.progress import ProgressListener, ignore_progress
from uwlts.storage.cloud import PointCloud, project_image_errors, project_variance
from uwlts.storage.cloud_files import load_cloud
from uwlts.storage.mesh_file import SurfaceMesh
from uwlts.storage.number_tables import Unit

_BLOCK = 48  # cubes along the edge of a block that marching cubes processes at once
_PLACES_AT_A_TIME = 500_000  # to limit memory
_FEWEST = 50  # least number of points of a scan
_CUBES_OF_RADIUS = 3.0  # cubes per patch radius
_CUBES_OF_WALL = 1.5
"""Cubes per thickness of the thinnest wall. Without noise, walls up to 48 deg from the cube edges hold a corner."""
_WALLS_ASKED = 4000  # number of points at which the wall thickness is measured
_OPPOSITE = 0.7  # cosine of the largest angle (45 deg) between the normals of two opposite sides, one of them reversed
_RESOLVED = 3.0
"""Least thickness of a wall, in standard deviations of the height between neighbours on one side: four times the noise
of a point, at which few points lie beyond the middle of the wall."""
_FARTHEST_CUBES = 0.75  # largest distance of a vertex from its patch, in cubes; a larger one mixes two walls
_FEWEST_OF_PIECE = 20  # least number of triangles of a connected piece; smaller ones are outliers


def mesh(
    *clouds: PointCloud | str | os.PathLike[str],
    cube_mm: float | None = None,
    patch_radius_mm: float | None = None,
    towards: Sequence[tuple[float, float, float]] | None = None,
    unit: Unit | None = None,
    progress: ProgressListener = ignore_progress,
) -> SurfaceMesh:
    """Make a mesh with uncertainty and open holes from one or several clouds in one frame.

    Parameters
    ----------
    *clouds
        Clouds or their files. A cloud merged by `uwlts.register` is split into its scans.
    cube_mm
        Edge of the cubes, smaller than the walls; by default the smaller of a third of the patch radius and two thirds
        of the thinnest wall.
    patch_radius_mm
        Radius of the averaging patches; much smaller holes are closed. By default a patch holds about thirty points of
        three images.
    towards
        Direction x y z from the surface to the sensor for each cloud; by default -Z, rotated by the pose of each scan.
    unit
        As for `export`.
    progress
        Called with the number of places done and the total number.

    Returns
    -------
    SurfaceMesh
        Mesh with open holes. Points are weighted by their inverse variance along the normal. Systematic errors of
        different clouds are treated as independent.

    Raises
    ------
    CaptureError
        A cloud cannot be read.
    EvaluationError
        A cloud has too few points, lengths are not positive, or directions do not fit the clouds.

    Examples
    --------
    >>> surface = uwlts.mesh("left.cloud.h5", "right.cloud.h5")
    >>> surface.save("pipe.glb")
    """
    for name, length in (("cube_mm", cube_mm), ("patch_radius_mm", patch_radius_mm)):
        if length is not None and not 0 < length < np.inf:
            raise EvaluationError(f"`{name}` is {length:g}; expected a positive length in mm")
    if not clouds:
        raise EvaluationError("no cloud was given; a mesh needs at least one")
    read = [load_cloud(each, unit=unit) for each in clouds]
    if towards is not None and (np.shape(towards) != (len(read), 3) or not np.all(np.linalg.norm(towards, axis=1) > 0)):
        raise EvaluationError(
            f"the directions are not valid; expected {len(read)} of three numbers, one per cloud, none of them 0 0 0"
        )
    scans = [
        scan
        for number, cloud in enumerate(read)
        for scan in _split_scans(cloud, None if towards is None else np.asarray(towards[number], float))
    ]
    if small := [len(cloud) for cloud, _ in scans if len(cloud) < _FEWEST]:
        raise EvaluationError(f"a cloud or scan has {small[0]} points; at least {_FEWEST} are needed")
    radius = patch_radius_mm or max(0.65 * choose_disc_diameter(cloud.points_mm, cloud.frame) for cloud, _ in scans)
    if cube_mm is not None and cube_mm > radius:
        raise EvaluationError(f"cube_mm is {cube_mm:g}; expected at most the patches' radius, {radius:g} mm")
    points = _collect_points(scans, radius)
    cube = cube_mm or max(min(radius / _CUBES_OF_RADIUS, _measure_walls(points, radius) / _CUBES_OF_WALL), radius / 16)
    surface = LocalSurface(points, radius_mm=radius)
    low = points.points_mm.min(axis=0) - 4 * cube
    vertices, faces = _march_cubes(*_compute_signed_distances(surface, points.points_mm, low, cube, progress))
    places = low + cube * vertices
    del vertices
    patches = surface.patches(places, with_uncertainty=True)
    kept = patches.found & (np.abs(patches.height_mm) < _FARTHEST_CUBES * cube)
    places = places + np.where(kept, patches.height_mm, 0.0)[:, None] * patches.normals
    faces = _orient_faces(places, faces[kept[faces].all(axis=1)], patches.normals)
    used, faces = _remove_small_pieces(faces, len(places))
    if not len(faces):
        raise EvaluationError(
            f"no surface was found with patches of {radius:g} mm radius: the points may be too sparse. Give a larger "
            "`patch_radius_mm`"
        )
    every = points.points_mm[:: max(1, len(points.points_mm) // _WALLS_ASKED)]
    distance = np.asarray(KDTree(places[used]).query(every, distance_upper_bound=radius)[0])
    return SurfaceMesh(
        places[used],
        patches.normals[used],
        faces,
        patches.noise_mm[used],
        patches.shared_mm[used],
        cube,
        radius,
        float(np.mean(~np.isfinite(distance))),
        {"clouds": [dict(cloud.metadata) for cloud in read], "scans": len(scans)},
    )


def _split_scans(cloud: PointCloud, towards: np.ndarray | None) -> list[tuple[PointCloud, np.ndarray]]:
    """Split a cloud into its scans, each with the direction from the surface to the sensor."""
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
        (cloud.select(np.flatnonzero(owner == number)), way)
        for number, way in enumerate(ways)
        if np.any(owner == number)
    ]


def _collect_points(scans: list[tuple[PointCloud, np.ndarray]], radius: float) -> SurfacePoints:
    """Collect all points with their normals, and their uncertainty along the normals."""
    parts, first, most = [], 0, max((len(c.uncertainty.patterns_mm) for c, _ in scans if c.uncertainty), default=0)
    for number, (cloud, towards) in enumerate(scans):
        count, known = len(cloud), cloud.uncertainty
        normals = surface_normals(cloud.points_mm, radius_mm=radius, towards=towards)
        noise, position, patterns = np.zeros(count), np.zeros(count), np.zeros((most, count))
        weight = np.ones(count)
        if known is not None:
            noise = np.maximum(project_variance(known.random_mm2, normals), 0.0)
            # Simplification: shift and rotation of an image are combined into one shift that all its points share.
            position = np.sqrt(np.sum(project_image_errors(known, normals) ** 2, axis=0))
            patterns[: len(known.patterns_mm)] = np.einsum("mni,ni->mn", known.patterns_mm, normals)
            # The lower bound (0.1 um) squared keeps weights finite.
            weight = 1.0 / np.maximum(noise + position**2 + np.sum(patterns**2, axis=0), 1e-8)
        image = np.arange(count) if (cloud.frame < 0).any() else cloud.frame.astype(np.int64)
        owner = np.full(count, number)
        parts.append((cloud.points_mm, normals, weight, noise, position, image + first, patterns.T, owner))
        first += int(image.max()) + 1
    points, normals, weight, noise, position, image, patterns, owner = (
        np.concatenate(each) for each in zip(*parts, strict=True)
    )
    # Points without uncertainty receive the median weight of the others.
    stated = np.concatenate([np.full(len(cloud), cloud.uncertainty is not None) for cloud, _ in scans])
    if stated.any() and not stated.all():
        weight[~stated] = np.median(weight[stated])
    return SurfacePoints(points, normals, weight, noise, position, image, patterns.T, owner)


def _measure_walls(points: SurfacePoints, radius: float) -> float:
    """Return the thickness of the thinnest walls (2 % quantile over the points); infinite without walls."""
    places, tree = points.points_mm, KDTree(points.points_mm)
    chosen = np.arange(len(places))[:: max(1, len(places) // _WALLS_ASKED)]
    # A subset of the neighbours suffices, since a wall has many points on its other side.
    neighbours = cast(list[list[int]], tree.query_ball_point(places[chosen], radius))
    found = [near[:: max(1, len(near) // 200)] for near in neighbours]
    owner, other = np.repeat(chosen, [len(each) for each in found]), np.concatenate(found)
    facing = np.einsum("ni,ni->n", points.normals[owner], points.normals[other])
    below = -np.einsum("ni,ni->n", places[other] - places[owner], points.normals[owner])
    # Normals of noisy points are opposite by chance.
    behind = (facing < -_OPPOSITE) & (below > _RESOLVED * robust_std(below[facing > _OPPOSITE]))
    thickness = np.full(len(places), np.inf)
    np.minimum.at(thickness, owner[behind], below[behind])
    return float(np.quantile(thickness[chosen], 0.02, method="lower")) if len(chosen) else np.inf


def _list_corners_near(cells: np.ndarray) -> np.ndarray:
    """Return the corners (C, 3) of cubes that hold points, and of cubes up to two away."""
    shape = cells.max(axis=0) + 8
    keys = _sort_unique(np.asarray(np.ravel_multi_index(tuple(cells.T + 3), tuple(shape))))
    for axis in range(3):
        keys = _sort_unique((keys + int(np.prod(shape[axis + 1 :])) * np.arange(-2, 4)[:, None]).ravel())
    corners = np.empty((len(keys), 3), np.int32)
    for axis, place in enumerate(np.unravel_index(keys, tuple(shape))):
        corners[:, axis] = place - 3
    return corners


def _sort_unique(keys: np.ndarray) -> np.ndarray:
    """Return the sorted different keys: `numpy.unique`, which takes ten times as long, may use a hash table."""
    keys.sort()
    return keys[np.append(True, keys[1:] != keys[:-1])] if len(keys) else keys


def _compute_signed_distances(
    surface: LocalSurface, points_mm: np.ndarray, low: np.ndarray, cube: float, progress: ProgressListener
) -> tuple[np.ndarray, np.ndarray]:
    """Return corners (C, 3) of cubes near points, from ``low`` on, and their distances (C,) in cubes from the surface.

    Distances are positive outside. Only corners with a patch are returned.
    """
    corners = _list_corners_near(np.floor((points_mm - low) / cube).astype(np.int64))
    distance, known = np.zeros(len(corners)), np.zeros(len(corners), bool)
    for start in range(0, len(corners), _PLACES_AT_A_TIME):
        here = slice(start, start + _PLACES_AT_A_TIME)
        patches = surface.patches(low + cube * corners[here])
        distance[here], known[here] = -patches.height_mm / cube, patches.found
        progress(min(start + _PLACES_AT_A_TIME, len(corners)), len(corners))
    return corners[known], distance[known]


def _march_cubes(corners: np.ndarray, distance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Extract vertices (V, 3), in cubes, and triangles (F, 3) of the zero surface of distances at corners (C, 3)."""
    from skimage.measure import marching_cubes

    # A block has one more corner than cubes along each edge. Adjacent blocks share corners.
    block = np.floor_divide(corners, _BLOCK)
    low = block.min(axis=0, initial=0)
    size = block.max(axis=0, initial=0) - low + 1
    keys = np.asarray(np.ravel_multi_index(tuple((block - low).T), tuple(size)))
    members = {tuple(block[each[0]].tolist()): each for each in group_rows(keys).values()}
    del block, keys
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
        # The mask refers to the last corner of each cube.
        mask[1:, 1:, 1:] = np.logical_and.reduce(
            [here[x : _BLOCK + x, y : _BLOCK + y, z : _BLOCK + z] for x, y, z in np.ndindex(2, 2, 2)]
        )
        crossed = volume[mask]
        if not mask.any() or crossed.min() > 1.8 or crossed.max() < -1.8:
            continue
        try:
            found, triangles, _, _ = marching_cubes(volume, 0.0, mask=mask, allow_degenerate=False)
        except (RuntimeError, ValueError):
            # scikit-image raises these for a block without a zero crossing.
            continue
        vertices.append(found.astype(np.float64) + _BLOCK * np.array(each))
        faces.append((triangles + first).astype(np.int32))
        first += len(found)
    if not vertices:
        return np.empty((0, 3)), np.empty((0, 3), np.int64)
    del members
    return _weld_vertices(np.concatenate(vertices), np.concatenate(faces))


def _weld_vertices(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Merge coincident vertices on the boundaries of blocks."""
    distance = np.abs(vertices / _BLOCK - np.round(vertices / _BLOCK)) * _BLOCK
    shared = np.flatnonzero((distance < 1e-3).any(axis=1))
    if not len(shared):
        return vertices, faces
    pairs = shared[KDTree(vertices[shared]).query_pairs(1e-3, output_type="ndarray")]
    links = coo_array((np.ones(len(pairs), bool), pairs.T), shape=(len(vertices),) * 2)
    owner = connected_components(links, directed=False)[1]
    return vertices[np.unique(owner, return_index=True)[1]], owner[faces]


def _orient_faces(places: np.ndarray, faces: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Remove triangles of zero area, and orient the others along the normals of their vertices."""
    a, b, c = (places[faces[:, k]] for k in range(3))
    across = np.cross(b - a, c - a)
    backwards = np.einsum("fi,fi->f", across, normals[faces].sum(axis=1)) < 0
    faces = np.where(backwards[:, None], faces[:, [0, 2, 1]], faces)
    return faces[np.linalg.norm(across, axis=1) > 0]


def _remove_small_pieces(faces: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Remove small connected pieces; return the indices (V,) of the remaining vertices and their triangles."""
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]]])
    links = coo_array((np.ones(len(edges), bool), edges.T), shape=(count, count))
    piece = connected_components(links, directed=False)[1]
    of_face = piece[faces[:, 0]]
    faces = faces[np.bincount(of_face, minlength=int(piece.max(initial=0)) + 1)[of_face] >= _FEWEST_OF_PIECE]
    used, renumbered = np.unique(faces, return_inverse=True)
    return used, renumbered.reshape(-1, 3)
