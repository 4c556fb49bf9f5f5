"""Common parts of all fits: accepted points, a checked solution with its covariance, and robust weights.

Outliers are handled in two ways. `fit_robustly` leaves points out by a stated rule, as a standard of acceptance needs
it. `fit_biweight` lowers their weights, and `biweight` gives these weights to a registration, which matches its points
anew in each round.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Generic, Protocol, TypeVar

import numpy as np
from scipy.optimize import least_squares

from uwlts.errors import EvaluationError
from uwlts.model.calibration import rigid_transform

MAD_TO_STD = 1.4826
"""Standard deviation of a normal distribution over its median absolute deviation."""

TUKEY_BOUND = 4.685
"""Bound of Tukey's biweight, in standard deviations: 95 % efficient for normal noise (Holland and Welsch,
Communications in Statistics A 6, 1977)."""

VDI_OUTLIER_SHARE = 0.003
"""VDI/VDE 2634 lets at most 3 permille of the points be left out."""

DEFAULT_K = 5.0
"""Of normal noise 6 points in ten million lie farther out than 5 standard deviations."""

_RETURNING_ROUNDS = 20


class Fit(Protocol):
    """A fitted shape, as `fit_robustly` needs it."""

    @property
    def residuals_mm(self) -> np.ndarray: ...

    def distances_mm(self, points: np.ndarray) -> np.ndarray: ...


FitT = TypeVar("FitT", bound=Fit)


@dataclass(frozen=True, eq=False)
class RobustFit(Generic[FitT]):
    """A fit to the ``inliers`` (N,) only, the distances (N,) of all points from it, and the number of fits.

    Points whose distance differs by more than ``limit_mm`` from the median distance (nearly zero) were left out.
    """

    fit: FitT
    inliers: np.ndarray
    distances_mm: np.ndarray
    limit_mm: float
    rounds: int

    @property
    def rejected(self) -> int:
        """Number of points left out."""
        return int(np.count_nonzero(~self.inliers))

    @property
    def rejected_share(self) -> float:
        """Share of the points left out."""
        return self.rejected / len(self.inliers)


def fit_robustly(fit: Callable[[np.ndarray], FitT], points: Any, *, k: float = DEFAULT_K) -> RobustFit[FitT]:
    """Fit, leave out the points that lie off by more than k robust standard deviations, and fit again.

    A point is off by the difference of its distance from the median distance of all points; the robust standard
    deviation is 1.4826 times the median size of these differences (the median absolute deviation). A point that was
    left out comes back when a later fit passes within the limit; after 20 rounds points only leave, so that the rounds
    end. The rule is for a few outliers on one surface, not for separating surfaces. ``fit`` makes a shape of points
    (M, D), mm, as `fit_sphere` and `fit_plane` do; EvaluationError where it refuses the points or what is left of them.
    """
    points = accepted_points(points, least=1, what="a robust fit", dimensions=(2, 3))
    # Rounding alone must not make outliers of exact points.
    smallest = 1e-9 * float(np.ptp(points, axis=0).max() + np.abs(points).max())
    inliers = np.ones(len(points), dtype=bool)
    rounds = 0
    while True:
        shape = fit(points[inliers])
        rounds += 1
        distances = shape.distances_mm(points)
        # About the median: outliers on one side pull the first shape away from most points.
        off = np.abs(distances - np.median(distances))
        limit = max(k * MAD_TO_STD * float(np.median(off)), smallest)
        within = off <= limit
        if rounds > _RETURNING_ROUNDS:
            within &= inliers
        if np.array_equal(within, inliers):
            return RobustFit(shape, inliers, distances, limit, rounds)
        inliers = within


_STEADY = 1e-6
"""Change of every weight that ends the re-weighting."""
_MOST_REWEIGHTED = 50
"""Re-weighted fits at most; each usually divides the changes by three to ten."""
_DEPENDENT = 1e-12
"""Eigenvalue of a normal matrix, relative to the largest, below which columns of a design depend on each other."""


def robust_std(residuals: np.ndarray) -> float:
    """Return the standard deviation of residuals (N,) about zero by their median absolute deviation."""
    return MAD_TO_STD * float(np.median(np.abs(residuals)))


def noise_factor(relative: np.ndarray) -> float:
    """Return by how much residuals (N,), in their stated standard deviations, scatter more than stated; at least 1."""
    return max(robust_std(relative), 1.0) if len(relative) else 1.0


def biweight(relative: np.ndarray) -> np.ndarray:
    """Return Tukey's biweight (N,) of residuals in standard deviations: 1 at zero, 0 beyond `TUKEY_BOUND`."""
    return np.square(np.clip(1 - np.square(relative / TUKEY_BOUND), 0, None))


def fit_biweight(design: np.ndarray, values: np.ndarray, counted: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Fit a linear model by least squares with Tukey's biweight, until its weights are steady.

    Parameters
    ----------
    design, values : (N, K) and (N,)
    counted : (N,) bool
        Rows of the fit; the others have no weight.

    Returns
    -------
    rows : (K, N)
        Their product with ``values`` is the coefficients; to first order they propagate errors of the values.
    weights : (N,)
    """
    weights, inverse = counted.astype(float), np.zeros((design.shape[1],) * 2)
    # Rounding alone must not make outliers of exact values.
    smallest = 1e-12 + 1e-12 * float(np.abs(values[counted]).max(initial=0.0))
    for _ in range(_MOST_REWEIGHTED):
        before, loaded = weights, (design * weights[:, None]).T
        inverse = np.linalg.pinv(loaded @ design, rcond=_DEPENDENT, hermitian=True)
        left = values - design @ (inverse @ (loaded @ values))
        weights = counted * biweight(left / max(robust_std(left[counted]), smallest))
        if np.abs(weights - before).max(initial=0.0) < _STEADY:
            break
    return inverse @ (design * weights[:, None]).T, weights


# Singular values this much smaller than the largest one are rounding noise of coordinates of size one.
_SINGULAR = 1e-9

_STEPS = 300

LARGEST_RELATIVE_STD = 0.2
"""A radius that is uncertain by more than this share of itself may as well be infinite: the shape may be a plane."""


def accepted_points(points: Any, *, least: int, what: str, dimensions: tuple[int, ...] = (3,)) -> np.ndarray:
    """Points (N, D) for a fit; EvaluationError for fewer than `least` or not finite, ValueError for another shape."""
    points = np.asarray(points, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] not in dimensions:
        raise ValueError(f"points of the shape (N, {' or '.join(map(str, dimensions))}) expected, not {points.shape}")
    if len(points) < least:
        raise EvaluationError(f"{what} needs at least {least} points; there are {len(points)}")
    unusable = int(np.count_nonzero(~np.isfinite(points).all(axis=1)))
    if unusable:
        raise EvaluationError(f"{what}: {unusable} of {len(points)} points are not finite; leave them out")
    return points


@dataclass(frozen=True, eq=False)
class Normalised:
    """Points (N, D) for a fit, and the same moved to their centroid and scaled to a mean square distance of one.

    ``extents`` (D,) are the root sums of squares of the scaled points along their principal ``axes`` (D, D), in rows,
    the longest first.
    """

    given_mm: np.ndarray
    points: np.ndarray
    centroid_mm: np.ndarray
    scale_mm: float
    extents: np.ndarray
    axes: np.ndarray

    def is_flat(self, dimension: int) -> bool:
        """Whether the points span no more than `dimension` directions."""
        return bool(self.extents[dimension] <= _SINGULAR * self.extents[0])


def normalised(points: Any, *, least: int, what: str, dimensions: tuple[int, ...] = (3,)) -> Normalised:
    """Accepted points, centred and scaled; EvaluationError as `accepted_points`, and for points all in one place."""
    points = accepted_points(points, least=least, what=what, dimensions=dimensions)
    centroid = points.mean(axis=0)
    centred = points - centroid
    scale = rms_distance(points, centroid)
    if scale <= 1e-12 * float(np.abs(centroid).max()):
        raise EvaluationError(f"{what}: all {len(points)} points lie in one place")
    return Normalised(points, centred / scale, centroid, scale, *principal_axes(centred / scale))


def rms_distance(points: np.ndarray, centre: np.ndarray) -> float:
    """Return the root-mean-square distance of points (N, D) from a centre (D,)."""
    return float(np.sqrt(np.mean(np.sum((points - centre) ** 2, axis=1))))


def fit_rigid_transform(source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Fit the rigid transform (4, 4) that moves points (N, 3) closest to others in the same order, by least squares.

    Singular value decomposition of the cross-covariance (Kabsch, Acta Crystallographica A32, 1976).
    """
    source_mean, target_mean = source.mean(axis=0), target.mean(axis=0)
    left, _, right = np.linalg.svd((target - target_mean).T @ (source - source_mean))
    rotation = left @ np.diag([1.0, 1.0, np.sign(np.linalg.det(left @ right))]) @ right
    return rigid_transform(rotation, target_mean - rotation @ source_mean)


def principal_axes(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Root sums of squares (D,) along, and directions (D, D) in rows of, the principal axes, the longest first.

    By the singular values of the points themselves: their scatter matrix would lose half of the digits.
    """
    _, extents, axes = np.linalg.svd(np.linalg.qr(points, mode="r"))
    return extents, axes


def evenly_thinned(points: np.ndarray, at_most: int) -> np.ndarray:
    """At most about `at_most` of the points, spread evenly over their order."""
    return points[:: max(1, -(-len(points) // at_most))]


def minimised(
    residuals: Callable[[np.ndarray], np.ndarray], jacobian: Callable[[np.ndarray], np.ndarray], start: np.ndarray
) -> tuple[np.ndarray, float]:
    """Parameters and sum of squares of a least-squares solution (Levenberg-Marquardt, MINPACK).

    The sum is infinite where the search does not converge, so that the best of several starts can be taken.
    """
    limits: dict[str, Any] = {"xtol": 1e-13, "ftol": 1e-15, "gtol": 1e-15, "max_nfev": _STEPS}
    solution = least_squares(residuals, start, jac=jacobian, method="lm", **limits)  # pyright: ignore[reportArgumentType]
    converged = solution.success and np.isfinite(solution.x).all()
    return solution.x, 2.0 * float(solution.cost) if converged else np.inf


def covariance_of(jacobian: np.ndarray, sum_of_squares: float, *, what: str) -> tuple[np.ndarray, float]:
    """Covariance (P, P) of the parameters of a shape and standard deviation of one residual.

    s2 (J^T J)^-1 with s2 = sum of squares / (N - P): equal, independent noise on every residual. EvaluationError for
    the infinite sum of a search that did not converge, or a singular Jacobian (N, P): some parameter could have any
    value.
    """
    if not np.isfinite(sum_of_squares):
        raise EvaluationError(f"{what} fit does not converge; the points do not have this shape")
    count, parameters = jacobian.shape
    _, strengths, directions = np.linalg.svd(np.linalg.qr(jacobian, mode="r"))
    if not strengths[-1] > _SINGULAR * strengths[0]:
        raise EvaluationError(f"the {count} points do not determine {what}")
    variance = sum_of_squares / (count - parameters)
    inverse = directions.T / strengths
    return variance * inverse @ inverse.T, float(np.sqrt(variance))
