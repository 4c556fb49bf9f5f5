"""Local surface at any place: spacing of points, oriented normals, curved patches, and errors of patches.

A patch is a paraboloid over the tangent plane, fitted by moving least squares (Levin, Math. Comp. 67, 1998) to the
points on one side of a wall. Its height is linear in the points, so their uncertainty propagates linearly.

Overlapping patches share points, and patches along an image share its position. Their heights are therefore correlated:
positively by errors of images. Noise correlates some of them negatively, because a second-order fit subtracts points
near the border of its disc. The variance of a sum of heights follows from the errors themselves.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, NamedTuple, Self

import numpy as np
from scipy.sparse import csr_array, hstack
from scipy.spatial import KDTree

from uwlts.runtime.compiled import compiled, compiled_with_arrays
from uwlts.storage.cloud import FOOTPRINT, FOOTPRINT_STD, PointCloud

_SAME_SIDE = 0.5  # cosine of the largest angle (60 deg) between normals of points on the same side of a wall or an edge
_FEWEST = 8  # least number of points of a patch, which has six coefficients
_MOST_IMAGES = 256  # largest number of images of a patch that are distinguished; further ones are combined
_TERMS = 6  # of a polynomial of second order in two variables
_AT_A_TIME = 500_000  # number of points whose normals are computed together; their matrices take 100 MB


class PointGrid(NamedTuple):
    """Points (N, 3) sorted into cubes of size ``cell_mm`` for fast neighbour searches."""

    points_mm: np.ndarray
    order: np.ndarray  # (N,); numbers of the points before sorting
    keys: np.ndarray  # (N,); cube of each point
    low: np.ndarray  # (3,); corner of the cubes
    shape: np.ndarray  # (3,); number of cubes along each axis
    cell_mm: float

    @classmethod
    def sort(cls, points_mm: np.ndarray, cell_mm: float) -> Self:
        """Sort points (N, 3) into cubes."""
        low = points_mm.min(axis=0) - cell_mm
        cells = np.floor((points_mm - low) / cell_mm).astype(np.int64)
        # A border of empty cubes keeps neighbour keys from wrapping around.
        shape = cells.max(axis=0) + 2
        keys = (cells[:, 0] * shape[1] + cells[:, 1]) * shape[2] + cells[:, 2]
        order = np.argsort(keys, kind="stable")
        points = np.ascontiguousarray(points_mm[order], dtype=np.float64)
        return cls(points, order, keys[order], np.asarray(low, float), shape, float(cell_mm))


@dataclass(frozen=True, eq=False)
class SurfacePoints:
    """Points for the fit of patches, with their uncertainty along the normals."""

    # (N, 3); points and outward unit normals.
    points_mm: np.ndarray
    normals: np.ndarray
    weight: np.ndarray  # (N,); inverse of the total variance along the normal
    noise_mm2: np.ndarray  # (N,); noise variance of each point along the normal; 0 if unknown
    position_mm: np.ndarray
    """(N,); standard deviation along the normal by the position of the image, common to all points of an image."""
    image: np.ndarray  # (N,) int64; image of each point
    patterns_mm: np.ndarray  # (M, N); shift along the normal by each systematic pattern, common to all points of a scan
    scan: np.ndarray  # (N,) int64; scan of each point; the patterns of different scans are independent


@dataclass(frozen=True, eq=False)
class LocalPatches:
    """Patches at P places."""

    height_mm: np.ndarray  # (P,); height of the surface above the place, along the normal
    normals: np.ndarray  # (P, 3); outward unit normals of the patches
    found: np.ndarray
    """(P,) bool; mask of places whose height is better determined than by one point; elsewhere it would be an
    extrapolation."""
    # (P,); standard uncertainty of the height by errors of points and images, and by systematic errors of a scan.
    noise_mm: np.ndarray
    shared_mm: np.ndarray


def surface_normals(points_mm: np.ndarray, *, radius_mm: float, towards: np.ndarray) -> np.ndarray:
    """Return unit normals (N, 3) of planes through the points within a radius of each, oriented ``towards`` (3,)."""
    grid, normals = PointGrid.sort(points_mm, radius_mm), np.empty((len(points_mm), 3))
    for start in range(0, len(points_mm), _AT_A_TIME):
        places = points_mm[start : start + _AT_A_TIME].astype(np.float64)
        moments = np.empty((len(places), 6))
        _fill_moments(places, grid, moments)
        matrices = moments[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)
        found = np.linalg.eigh(matrices)[1][:, :, 0]
        normals[start : start + _AT_A_TIME] = np.where((found @ towards)[:, None] < 0, -found, found)
    return normals


class LocalSurface:
    """Surface given by `SurfacePoints`, smoothed over a radius."""

    def __init__(self, surface: SurfacePoints, *, radius_mm: float):
        self.radius_mm = radius_mm
        self._grid = grid = PointGrid.sort(surface.points_mm, radius_mm)
        self._columns = tuple(
            np.ascontiguousarray(each[grid.order])
            for each in (surface.normals, surface.weight, surface.noise_mm2, surface.position_mm, surface.image)
        )
        self._patterns = np.ascontiguousarray(surface.patterns_mm[:, grid.order].T)
        self._scan = np.ascontiguousarray(surface.scan[grid.order])

    def patches(self, places_mm: np.ndarray, *, with_uncertainty: bool = False) -> LocalPatches:
        """Fit patches at places (P, 3), each to the side of a wall that holds the nearest point."""
        places = np.ascontiguousarray(places_mm, dtype=np.float64)
        height, found = np.zeros(len(places)), np.zeros(len(places), np.bool_)
        normals, variance = np.zeros((len(places), 3)), np.zeros((len(places), 2))
        patterns = self._patterns if with_uncertainty else self._patterns[:, :0]
        systematic = patterns, self._scan, int(self._scan.max(initial=0)) + 1
        _fit_patches(places, self._grid, self._columns, systematic, (height, normals, found, variance))
        return LocalPatches(height, normals, found, np.sqrt(variance[:, 0]), np.sqrt(variance[:, 1]))


@compiled
def _find_row(grid, place, row):
    """Return the range of sorted points in three adjacent cubes, one of the nine rows around a place."""
    low, shape, cell, keys = grid.low, grid.shape, grid.cell_mm, grid.keys
    x = int(np.floor((place[0] - low[0]) / cell)) + row // 3 - 1
    y = int(np.floor((place[1] - low[1]) / cell)) + row % 3 - 1
    z = int(np.floor((place[2] - low[2]) / cell))
    if x < 0 or y < 0 or x >= shape[0] or y >= shape[1] or z < -1 or z > shape[2]:
        return 0, 0
    first = (x * shape[1] + y) * shape[2]
    start = np.searchsorted(keys, first + max(z - 1, 0))
    return start, np.searchsorted(keys, first + min(z + 1, shape[2] - 1), side="right")


@compiled
def _fill_moments(places, grid, moments):
    """Fill the second central moments (P, 6) xx, xy, xz, yy, yz, zz of the points within a cell's size."""
    points, radius = grid.points_mm, grid.cell_mm
    for number in range(len(places)):
        place, count = places[number], 0
        x = y = z = xx = xy = xz = yy = yz = zz = 0.0
        for row in range(9):
            start, end = _find_row(grid, place, row)
            for k in range(start, end):
                a, b, c = points[k, 0] - place[0], points[k, 1] - place[1], points[k, 2] - place[2]
                if a * a + b * b + c * c <= radius * radius:
                    count += 1
                    x, y, z = x + a, y + b, z + c
                    xx, xy, xz = xx + a * a, xy + a * b, xz + a * c
                    yy, yz, zz = yy + b * b, yz + b * c, zz + c * c
        share = 1 / max(count, 1)
        x, y, z = share * x, share * y, share * z
        moments[number, 0], moments[number, 1] = share * xx - x * x, share * xy - x * y
        moments[number, 2], moments[number, 3] = share * xz - x * z, share * yy - y * y
        moments[number, 4], moments[number, 5] = share * yz - y * z, share * zz - z * z


@compiled_with_arrays
def _fit_patches(places, grid, columns, systematic, results):
    """Fit patches of the grid's cell size as their radius.

    ``columns`` are normals, weight, noise, position and image of `SurfacePoints`; ``systematic`` are its patterns,
    scans, and the number of scans. ``results`` are heights (P,), normals (P, 3), whether a patch is found (P,), and
    variances (P, 2) by noise and by systematic errors.
    """
    radius, normals = grid.cell_mm, columns[0]
    patterns, _, scans = systematic
    height, fitted_normals, found, variance = results
    by, frame = np.empty(_TERMS + 1), np.empty((3, 3))
    matrix, right = np.empty((_TERMS, _TERMS)), np.empty(_TERMS)
    images, moves = np.empty(_MOST_IMAGES, np.int64), np.empty(_MOST_IMAGES)
    for number in range(len(places)):
        place = places[number]
        nearest = _find_nearest(grid, place)
        if nearest < 0:
            continue
        x, y, z = normals[nearest]
        # Two tangents, and the normal.
        first = np.array((0.0, -z, y)) if abs(x) < 0.7 else np.array((-y, x, 0.0))
        first /= np.sqrt(np.sum(first * first))
        frame[0], frame[1], frame[2] = first, np.cross(normals[nearest], first), normals[nearest]
        count, total, beside = _fill_equations(place, grid, columns, frame, by, matrix, right)
        if count < _FEWEST:
            continue
        for i in range(_TERMS):
            # A small ridge suppresses the curvature that points on few lines leave undetermined.
            matrix[i, i] += 1e-6 * total
        inverse = np.linalg.inv(matrix)
        coefficients = inverse @ right
        shared = np.zeros((scans, patterns.shape[1]))
        moves[:] = 0.0
        square, scatter, by_points = _sum_errors(
            place, grid, columns, systematic, frame, by, (inverse[0], coefficients), (images, moves, shared)
        )
        # Reject heights that are less certain than one point, and places at the border of their points.
        if square >= 1.0 or beside > 0.4 * radius:
            continue
        found[number] = True
        height[number] = coefficients[0]
        slope = frame[2] - (coefficients[1] * frame[0] + coefficients[2] * frame[1]) / radius
        fitted_normals[number] = slope / np.sqrt(np.sum(slope * slope))
        rough = scatter * count / max(count - _TERMS, 1) * square
        variance[number, 0] = max(by_points, rough) + np.sum(moves * moves)
        variance[number, 1] = np.sum(shared * shared)


@compiled
def _find_nearest(grid, place):
    """Return the number of the point nearest to a place within the cell size, or -1."""
    points, nearest, least = grid.points_mm, -1, grid.cell_mm * grid.cell_mm
    for row in range(9):
        start, end = _find_row(grid, place, row)
        for k in range(start, end):
            dist = (points[k, 0] - place[0]) ** 2 + (points[k, 1] - place[1]) ** 2 + (points[k, 2] - place[2]) ** 2
            if dist < least:
                nearest, least = k, dist
    return nearest


@compiled
def _fill_equations(place, grid, columns, frame, by, matrix, right):
    """Fill the normal equations of a patch; return number and weight of its points, and the distance of their mean."""
    normals, weight = columns[0], columns[1]
    matrix[:], right[:] = 0.0, 0.0
    count, total, left_u, left_v = 0, 0.0, 0.0, 0.0
    for row in range(9):
        start, end = _find_row(grid, place, row)
        for k in range(start, end):
            kernel = _fill_terms(grid.points_mm[k], place, frame, normals[k], grid.cell_mm, by)
            if kernel <= 0:
                continue
            share = kernel * weight[k]
            count, total = count + 1, total + share
            left_u, left_v = left_u + share * by[1], left_v + share * by[2]
            for i in range(_TERMS):
                right[i] += share * by[i] * by[_TERMS]
                for j in range(_TERMS):
                    matrix[i, j] += share * by[i] * by[j]
    return count, total, grid.cell_mm * np.sqrt(left_u * left_u + left_v * left_v) / max(total, 1e-300)


@compiled
def _sum_errors(place, grid, columns, systematic, frame, by, fitted, sums):
    """Return the sum of squared parts of the points in a patch's height, their scatter, and the variance by noise.

    ``fitted`` are the row of the inverse for the height and the coefficients. ``sums`` are images, and the changes of
    the height to fill: by the position of each of these, and by patterns of each scan.
    """
    normals, weight, noise, position, image = columns
    patterns, scan, _ = systematic
    (answer, coefficients), (images, moves, shared) = fitted, sums
    square, scatter, freedom, by_points, many = 0.0, 0.0, 0.0, 0.0, 0
    for row in range(9):
        start, end = _find_row(grid, place, row)
        for k in range(start, end):
            kernel = _fill_terms(grid.points_mm[k], place, frame, normals[k], grid.cell_mm, by)
            if kernel <= 0:
                continue
            share, height, residual = kernel * weight[k], 0.0, by[_TERMS]
            for i in range(_TERMS):
                height += answer[i] * by[i]
                residual -= coefficients[i] * by[i]
            part = share * height
            square, by_points = square + part * part, by_points + part * part * noise[k]
            scatter, freedom = scatter + share * residual * residual, freedom + share
            at = 0
            while at < many and images[at] != image[k]:
                at += 1
            if at == many and many < _MOST_IMAGES:
                images[at], many = image[k], many + 1
            moves[min(at, _MOST_IMAGES - 1)] += part * position[k]
            for m in range(patterns.shape[1]):
                shared[scan[k], m] += part * patterns[k, m]
    return square, scatter / freedom, by_points


@compiled
def _fill_terms(point, place, frame, normal_there, radius, by):
    """Fill 1, u, v, u^2, u v, v^2 of a point (unit: radius) and its height (7,); return its kernel weight."""
    first, second, normal = frame[0], frame[1], frame[2]
    if normal_there[0] * normal[0] + normal_there[1] * normal[1] + normal_there[2] * normal[2] < _SAME_SIDE:
        return 0.0
    a, b, c = point[0] - place[0], point[1] - place[1], point[2] - place[2]
    u = (a * first[0] + b * first[1] + c * first[2]) / radius
    v = (a * second[0] + b * second[1] + c * second[2]) / radius
    up = a * normal[0] + b * normal[1] + c * normal[2]
    across = u * u + v * v
    if across >= 1.0 or abs(up / radius) > 1.0:
        return 0.0
    by[0], by[1], by[2], by[3], by[4], by[5], by[6] = 1.0, u, v, u * u, u * v, v * v, up
    return (1.0 - across) ** 2


@dataclass(frozen=True, eq=False)
class PatchErrors:
    """Independent errors of a cloud, and the changes of the heights of P patches by them."""

    near: np.ndarray  # (P, K) int; averages of points in each disc
    rows: np.ndarray
    """(P, K) float32; derivatives of the height in the middle of a disc by the heights of these averages."""
    noise_mm: np.ndarray  # (P,); standard deviation of one point along the normal
    normals: np.ndarray  # (P, 3); normals of the patches in the cloud's frame
    counts: np.ndarray  # (C,); number of points in each average
    images: csr_array  # (C, I) sparse; fraction of the points of each average in each image
    image_shifts_mm: np.ndarray
    """(J, C, 3); shift of each average for one standard deviation of each error of its image."""

    def __getitem__(self, selection: Any) -> PatchErrors:
        """Select patches by a slice, indices or a mask."""
        names = ("near", "rows", "noise_mm", "normals")
        return replace(self, **{name: getattr(self, name)[selection] for name in names})

    def height_changes(self) -> csr_array:
        """Return the changes (P, C + J I), mm, of the heights for one standard deviation of each independent error."""
        return csr_array(hstack([self._differentiate_by_noise(), *self._sum_by_images()], format="csr"))

    def noise_variance(self) -> np.ndarray:
        """Return the variance (P,), mm2, of the heights by noise."""
        return self.noise_mm**2 * np.sum(self.rows**2 / self.counts[self.near], axis=1)

    def image_variance(self) -> np.ndarray:
        """Return the variance (P,), mm2, of the heights by errors of images."""
        return sum(
            (np.asarray((each * each).sum(axis=1)).ravel() for each in self._sum_by_images()), np.zeros(len(self.rows))
        )

    def correlation(self, *, by_images: bool) -> float:
        """Return the variance of the sum of all heights relative to the sum of their variances, by noise or images."""
        parts = self._sum_by_images() if by_images else [self._differentiate_by_noise()]
        together = sum(float(np.sum(np.asarray(each.sum(axis=0)) ** 2)) for each in parts)
        single = sum(float((each * each).sum()) for each in parts)
        return together / single if single > 0 else 1.0

    def _differentiate_by_noise(self) -> csr_array:
        return self._make_sparse(self.rows * self.noise_mm[:, None] / np.sqrt(self.counts[self.near]))

    def _sum_by_images(self) -> list[csr_array]:
        along = (np.einsum("pki,pi->pk", shift[self.near], self.normals) for shift in self.image_shifts_mm)
        return [csr_array(self._make_sparse(self.rows * each) @ self.images) for each in along]

    def _make_sparse(self, values: np.ndarray) -> csr_array:
        ends = np.arange(0, self.near.size + 1, self.near.shape[1])
        return csr_array((values.ravel(), self.near.ravel(), ends), shape=(len(self.near), len(self.counts)))


POINTS_PER_DISC = 30  # number of points of an averaging disc: the mean has about a fifth of their noise
_IMAGES_PER_DISC = 3.0  # least number of images in a disc, so that errors of single images average
_SAMPLED = 2000  # number of points for the median spacing, which is then accurate to a few percent
_ASKED = 64  # number of points for the median distance between images
_STEEPEST = 0.3  # least cosine of the angle between surface normal and laser, which limits the length of a footprint


def choose_disc_diameter(points_mm: np.ndarray, frame: np.ndarray | None = None) -> float:
    """Return the diameter of discs with about thirty points (N, 3) and, given ``frame`` (N,), at least three images."""
    tree, sample = KDTree(points_mm), points_mm[:: max(1, len(points_mm) // _SAMPLED)]
    seventh = np.asarray(tree.query(sample, k=7)[0])[:, 6]
    # A disc with the radius of the sixth neighbour holds six points. Thirty points need five times its area.
    disc = float(2 * np.median(seventh) * np.sqrt(POINTS_PER_DISC / 6.0))
    if frame is None or (frame < 0).any() or frame.min() == frame.max():
        return disc
    return max(disc, _IMAGES_PER_DISC * _measure_image_gap(points_mm, frame))


def _measure_image_gap(points_mm: np.ndarray, frame: np.ndarray) -> float:
    """Return the median distance between a point and the nearest point of another image."""
    middle = np.unique(frame)
    chosen = np.isin(frame, middle[:: max(1, len(middle) // 20)])
    sample = np.flatnonzero(chosen)
    sample = sample[:: max(1, len(sample) // _ASKED)]
    least = [np.linalg.norm(points_mm[frame != frame[k]] - points_mm[k], axis=1).min() for k in sample]
    return float(np.median(least))


def measure_spacing(places: np.ndarray, chosen: np.ndarray) -> np.ndarray:
    """Return the median spacings (2,) of places (N, 2) near chosen (K,) ones, along the first and the second direction.

    The next place along a direction lies within 45 deg of it: points of the same profile do not count across it.
    """
    sample = chosen[:: max(1, len(chosen) // _ASKED)]
    least = np.full((len(sample), 2), np.inf)
    for number, point in enumerate(sample):
        distance = np.abs(places - places[point])
        for k in (0, 1):
            ahead = distance[:, k][distance[:, k] > distance[:, 1 - k]]
            least[number, k] = ahead.min(initial=np.inf)
    known = np.isfinite(least)
    return np.array([np.median(least[known[:, k], k]) if known[:, k].any() else 0.0 for k in (0, 1)])


def project_footprint(cloud: PointCloud, chosen: np.ndarray, tangents: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the footprints of chosen (K,) points along tangents (K, 2, 3), and their relative uncertainty.

    A footprint is a pair of standard deviations (K, 2) in mm. The uncertainty is that of their squares. Both are zero
    if the cloud states no footprint, for example for moved sensors or clouds of other programs.
    """
    known = cloud.metadata.get(FOOTPRINT)
    if not (isinstance(known, list) and len(known) == 2 and all(isinstance(each, float) for each in known)):
        return np.zeros((len(chosen), 2)), 0.0
    size, std = np.array(known, float), cloud.metadata.get(FOOTPRINT_STD)
    # The laser is parallel to Z. Its footprint in X and Y is longer on an inclined surface.
    flat = tangents[:, :, :2]
    leaning = np.abs(flat[:, 0, 0] * flat[:, 1, 1] - flat[:, 0, 1] * flat[:, 1, 0])
    # Inverse times its determinant, without the signs of its elements.
    inverse = flat[:, ::-1, ::-1]
    spread = np.linalg.norm(inverse * size, axis=2) / np.maximum(leaning, _STEEPEST)[:, None]
    return spread, float(std) if isinstance(std, float) else 0.0


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
