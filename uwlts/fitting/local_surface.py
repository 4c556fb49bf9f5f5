"""Local surface of a cloud: spacing of points, oriented normals, and errors of patches.

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

from uwlts.runtime.compiled import compiled
from uwlts.storage.cloud import FOOTPRINT, FOOTPRINT_STD, PointCloud

_AT_A_TIME = 500_000  # number of points whose normals are computed together; their matrices take 100 MB


class PointGrid(NamedTuple):
    """Points (N, 3) sorted into cubes of size ``cell_mm`` for fast neighbour searches."""

    points_mm: np.ndarray
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
        return cls(points, keys[order], np.asarray(low, float), shape, float(cell_mm))


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
