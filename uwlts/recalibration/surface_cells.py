"""Observations of an unknown surface by several passes, without the surface's own parameters.

The surface is divided into cells. In each, all passes together determine a second-order surface, which is eliminated by
orthogonal projection. Only the offsets and slopes between passes remain: what a single pass deviates from such a
surface is the surface's own form. An unknown surface that all passes share is
unbiased, whereas the distance from a surface that one pass determines correlates with its noise. Normals and
derivatives are taken at observations that are corrected for their residuals (Gauss-Helmert model: Pope, Some pitfalls
to be avoided in the iterative adjustment of nonlinear problems, 1972).
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import KDTree

from uwlts.errors import CalibrationError
from uwlts.fitting.least_squares import DEFAULT_K, MAD_TO_STD

LINES = 4
"""One of these many profile lines is used: speckle correlates the noise of neighbours, which the surface would
follow. With all lines, lengths were 0.03 mm too short (seeds 1, 2, 6, 7)."""
CELL = 1.5
"""Size of a cell relative to the disc radius of the sparsest pass (`find_disc_radius`), in which a second-order surface
suffices; seen on simulated surfaces with wavelengths from 45 mm."""
_FEWEST = 8
"""Least number of points of a pass in a cell: two more than a second-order surface has coefficients."""
_ROUGHEST = 5.0
"""Largest scatter about the passes' own surfaces relative to the median cell: cells on edges exceed it."""
_CONDITION = 60.0
"""Largest condition number of a cell's surface and offsets. Usual cells have 5 to 30; those of one or two images, whose
curvature along the stage only noise determines, from 90 (seeds 3, 301 and 303 of the study)."""


@dataclass(frozen=True, eq=False)
class PassPoints:
    """Points of all passes (N) in the common frame, at corrected observations.

    ``places_mm`` (N, 3), ``number`` (N,) is that of the pass, ``by_unknowns`` (N, 3, U), ``by_px`` (N, 3) and
    ``correction_px`` (N,) of the stripe centre. ``noise_px`` (N,) is its standard deviation. ``image_mm`` (K, N, 3) are
    the shifts by one standard deviation of each error of the image's place, and ``image`` (N,) the number of the image.
    """

    places_mm: np.ndarray
    number: np.ndarray
    by_unknowns: np.ndarray
    by_px: np.ndarray
    correction_px: np.ndarray
    noise_px: np.ndarray
    image_mm: np.ndarray
    image: np.ndarray


@dataclass(frozen=True, eq=False)
class Cell:
    """One cell: its points ``some`` (n,) of the passes ``number`` (n,), ``normal`` (3,) and ``middle_mm`` (3,).

    ``rows`` (n, U) and ``residuals`` (n,) are whitened, without the surface; ``mean_row`` (U,) is the mean derivative
    of the height. ``apart`` (n, K) are orthonormal patterns of the passes' offsets and slopes. ``by_px`` (n,) are the
    derivatives of the height by the stripe centre, ``std`` (n,) its standard deviations, and ``images`` (K, n)
    the whitened effects of the images' places. ``scatter`` is the ratio of the heights' scatter to the stated noise, at
    least 1. ``offset_square`` is the mean square of the whitened disagreement of the passes.
    """

    some: np.ndarray
    number: np.ndarray
    normal: np.ndarray
    middle_mm: np.ndarray
    rows: np.ndarray
    mean_row: np.ndarray
    residuals: np.ndarray
    apart: np.ndarray
    by_px: np.ndarray
    std: np.ndarray
    images: np.ndarray
    scatter: float
    offset_square: float

    @property
    def passes(self) -> np.ndarray:
        """Numbers of the passes."""
        return np.unique(self.number)

    @property
    def apart_mm(self) -> np.ndarray:
        """Distances (n,) of the passes from the surface that they share, as offsets and slopes."""
        return self.apart @ (self.apart.T @ self.residuals) * self.std


def divide(places_mm: np.ndarray, size_mm: float) -> np.ndarray:
    """Return the cell (N,) of each point: the nearest of points on the surface that are about ``size_mm`` apart.

    Cells border on each other across the surface, never along it: a border along it would select points by their noise.
    """
    _, owner = np.unique(np.floor(places_mm / size_mm).astype(np.int64), axis=0, return_inverse=True)
    owner = owner.ravel()
    for _ in range(2):
        counts = np.bincount(owner)
        means = np.column_stack([np.bincount(owner, column) / np.maximum(counts, 1) for column in places_mm.T])
        owner = np.asarray(KDTree(means[counts > 0]).query(places_mm)[1])
    return owner


def observe(points: PassPoints, cell_of: np.ndarray, spread: float, *, keep: bool) -> list[Cell]:
    """Return the usable cells; ``spread`` multiplies all stated noise.

    ``cell_of`` (N,) is -1 for points without a cell. With ``keep``, all other points are used.

    Raises CalibrationError if no cell has two passes.
    """
    order = np.argsort(cell_of, kind="stable")[np.count_nonzero(cell_of < 0) :]
    starts = np.flatnonzero(np.r_[True, np.diff(cell_of[order]) > 0])
    fewest = min(2, len(np.unique(points.number)))
    cells = [_observe(points, some, spread, fewest=fewest, keep=keep) for some in np.split(order, starts[1:])]
    found = [cell for cell in cells if cell is not None]
    if not found:
        raise CalibrationError(
            "no part of the surface is seen by two passes with enough points: overlap the passes, or give the right "
            "poses"
        )
    most = _ROUGHEST * float(np.median([cell.scatter for cell in found]))
    return [cell for cell in found if keep or cell.scatter <= most]


def _observe(points: PassPoints, some: np.ndarray, spread: float, *, fewest: int, keep: bool) -> Cell | None:
    """Return a cell with the points ``some`` (n,), or None if fewer than ``fewest`` passes have enough points in it.

    Without ``keep``, outliers are left out.
    """
    numbers, counts = np.unique(points.number[some], return_counts=True)
    enough = numbers[counts >= _FEWEST]
    if len(enough) < fewest:
        return None
    some = some[np.isin(points.number[some], enough)]
    for _ in range(2):
        middle = points.places_mm[some].mean(axis=0)
        about = points.places_mm[some] - middle
        axes = np.linalg.eigh(about.T @ about)[1]
        u, v, w = (about @ axes[:, ::-1]).T
        size = max(float(np.abs(u).max()), 1e-9)
        u, v = u / size, v / size
        surface = np.column_stack([np.ones_like(u), u, v, u * u, u * v, v * v])
        # Offset and slopes of all passes but one, so that their disagreement is no scatter.
        others = points.number[some, None] == enough[1:]
        design = np.hstack([surface, (others[:, :, None] * surface[:, None, :3]).reshape(len(some), -1)])
        if not keep and np.linalg.cond(design) > _CONDITION:
            return None
        shape = np.linalg.lstsq(surface, w, rcond=None)[0] / size
        slope_u, slope_v = shape[1] + 2 * shape[3] * u + shape[4] * v, shape[2] + shape[4] * u + 2 * shape[5] * v
        up = axes[:, 0] - slope_u[:, None] * axes[:, 2] - slope_v[:, None] * axes[:, 1]
        by_px = np.einsum("ni,ni->n", up, points.by_px[some])
        by_image = np.einsum("ni,kni->kn", up, points.image_mm[:, some])
        std = spread * np.sqrt((by_px * points.noise_px[some]) ** 2 + np.sum(by_image**2, axis=0))
        height = (w - by_px * points.correction_px[some]) / std
        base = np.linalg.qr(design / std[:, None])[0]
        left = height - base @ (base.T @ height)
        freedom = len(some) - base.shape[1]
        if freedom < _FEWEST:
            return None
        robust = MAD_TO_STD * float(np.median(np.abs(left))) * np.sqrt(len(some) / freedom)
        good = keep | (np.abs(left) <= DEFAULT_K * max(robust, 1.0))
        if good.all():
            break
        some = some[good]
        if min(np.count_nonzero(points.number[some] == each) for each in enough) < _FEWEST:
            return None
    else:
        return None
    scatter = max(float(np.sqrt(np.sum(left**2) / freedom)), 1.0)
    std = std * scatter
    height, shared, independent = height / scatter, base[:, :6], base[:, 6:]
    rows = np.einsum("ni,niu->nu", up, points.by_unknowns[some]) / std[:, None]
    mean_row = (rows / std[:, None]).sum(axis=0) / np.sum(std**-2.0)
    # Heights along the mean normal, so that rows of another pass refer to the same direction.
    length, normal = float(np.linalg.norm(up.mean(axis=0))), up.mean(axis=0)
    return Cell(
        some,
        points.number[some],
        normal / length,
        middle,
        rows - shared @ (shared.T @ rows),
        mean_row / length,
        height - shared @ (shared.T @ height),
        independent,
        by_px,
        std,
        by_image / std,
        scatter,
        float(np.sum((independent.T @ height) ** 2)) / max(independent.shape[1], 1),
    )
