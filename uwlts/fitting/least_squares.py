"""Common parts of all fits: accepted points, a checked solution with its covariance, and robust weights.

Outliers are handled by two functions. `fit_robustly` rejects points by a stated rule, as acceptance standards require.
`fit_biweight` reduces their weights. A registration uses the weights of `biweight` directly, because it finds new
correspondences in each round.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Generic, Protocol, TypeVar

import numpy as np
from scipy.optimize import least_squares

from uwlts.errors import EvaluationError
from uwlts.model.calibration import rigid_transform

MAD_TO_STD = 1.4826  # standard deviation of a normal distribution divided by its median absolute deviation

TUKEY_BOUND = 4.685
"""Bound of Tukey's biweight, in standard deviations: 95 % efficient for normal noise (Holland and Welsch,
Communications in Statistics A 6, 1977)."""

VDI_OUTLIER_SHARE = 0.003  # VDI/VDE 2634 permits rejecting at most 0.3 % of the points

DEFAULT_K = 5.0  # rejection limit in standard deviations: 6 in ten million points of normal noise exceed it

_RETURNING_ROUNDS = 20  # rounds after which rejected points no longer return, so that the iteration ends


class Fit(Protocol):
    """Fitted shape of `uwlts.shapes` with the derivatives of its distances."""

    @property
    def residuals_mm(self) -> np.ndarray: ...

    def distances_mm(self, points: np.ndarray) -> np.ndarray: ...

    def normals_at(self, points: np.ndarray) -> np.ndarray: ...

    def derivatives(self, points: np.ndarray) -> np.ndarray: ...


FitT = TypeVar("FitT", bound=Fit)


@dataclass(frozen=True, eq=False)
class RobustFit(Generic[FitT]):
    """Fit to the ``inliers`` (N,), distances (N,) of all points from it, and the number of fits.

    Outliers are points whose distance differs from the median distance (nearly zero) by more than ``limit_mm``.
    """

    fit: FitT
    inliers: np.ndarray
    distances_mm: np.ndarray
    limit_mm: float
    rounds: int

    @property
    def rejected(self) -> int:
        """Number of rejected points."""
        return int(np.count_nonzero(~self.inliers))

    @property
    def rejected_share(self) -> float:
        """Fraction of rejected points."""
        return self.rejected / len(self.inliers)


def fit_robustly(fit: Callable[..., FitT], points: Any, *, k: float = DEFAULT_K, **known: Any) -> RobustFit[FitT]:
    """Fit a shape repeatedly, rejecting points beyond k robust standard deviations.

    The deviation of a point is the difference between its distance and the median distance. The robust standard
    deviation is 1.4826 times the median absolute deviation. A rejected point returns if a later fit passes within the
    limit. The rule suits a few outliers on one surface; it does not separate surfaces.

    ``fit`` fits a shape to points (M, D), such as `Sphere.fit`, with what is ``known``; ``points`` (N, D) are in mm.

    Raises EvaluationError if the points or the inliers do not determine the shape.
    """
    points = check_points(points, least=1, what="a robust fit", dimensions=(2, 3))
    # Lower bound of the limit, so that rounding of exact points produces no outliers.
    smallest = 1e-9 * float(np.ptp(points, axis=0).max() + np.abs(points).max())
    inliers = np.ones(len(points), dtype=bool)
    rounds = 0
    while True:
        shape = fit(points[inliers], **known)
        rounds += 1
        distances = shape.distances_mm(points)
        # Deviations from the median, since outliers on one side shift the first fit away from most points.
        off = np.abs(distances - np.median(distances))
        limit = max(k * MAD_TO_STD * float(np.median(off)), smallest)
        within = off <= limit
        if rounds > _RETURNING_ROUNDS:
            within &= inliers
        if np.array_equal(within, inliers):
            return RobustFit(shape, inliers, distances, limit, rounds)
        inliers = within


_STEADY = 1e-6  # largest change of a weight in the last round of reweighting
_MOST_REWEIGHTED = 50  # largest number of reweighted fits; each usually reduces the changes by a factor of three to ten
_DEPENDENT = 1e-12
"""Eigenvalue of a normal matrix, relative to the largest, below which the columns are linearly dependent."""


def robust_std(residuals: np.ndarray) -> float:
    """Return the robust standard deviation of residuals (N,) about zero (scaled median absolute value)."""
    return MAD_TO_STD * float(np.median(np.abs(residuals)))


def noise_factor(relative: np.ndarray) -> float:
    """Return the ratio of robust scatter to stated noise for normalised residuals (N,); at least 1."""
    return max(robust_std(relative), 1.0) if len(relative) else 1.0


def biweight(relative: np.ndarray) -> np.ndarray:
    """Return Tukey's biweight (N,) of normalised residuals: 1 at zero, 0 beyond `TUKEY_BOUND`."""
    return np.square(np.clip(1 - np.square(relative / TUKEY_BOUND), 0, None))


def fit_biweight(design: np.ndarray, values: np.ndarray, counted: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Fit a linear model by iteratively reweighted least squares with Tukey's biweight.

    ``design`` is (N, K), ``values`` (N,); rows outside the mask ``counted`` (N,) have zero weight. Returns rows (K, N),
    whose product with the values gives the coefficients and to first order propagates their errors, and the final
    weights (N,).
    """
    weights, inverse = counted.astype(float), np.zeros((design.shape[1],) * 2)
    # Lower bound of the scale, so that rounding of exact values produces no outliers.
    smallest = 1e-12 + 1e-12 * float(np.abs(values[counted]).max(initial=0.0))
    for _ in range(_MOST_REWEIGHTED):
        before, loaded = weights, (design * weights[:, None]).T
        inverse = np.linalg.pinv(loaded @ design, rcond=_DEPENDENT, hermitian=True)
        left = values - design @ (inverse @ (loaded @ values))
        weights = counted * biweight(left / max(robust_std(left[counted]), smallest))
        if np.abs(weights - before).max(initial=0.0) < _STEADY:
            break
    return inverse @ (design * weights[:, None]).T, weights


_SINGULAR = 1e-9  # singular value, relative to the largest, that rounding of coordinates of unit size produces

_STEPS = 300  # largest number of function evaluations

LARGEST_RELATIVE_STD = 0.2
"""Largest relative standard uncertainty of a radius; with a larger one, the shape may be a plane."""


def check_points(points: Any, *, least: int, what: str, dimensions: tuple[int, ...] = (3,)) -> np.ndarray:
    """Check points (N, D) for a fit and return them as float64.

    ValueError for a wrong shape; EvaluationError for fewer than ``least`` points or points that are not finite.
    """
    points = np.asarray(points, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] not in dimensions:
        raise ValueError(f"points have the shape {points.shape}; expected (N, {' or '.join(map(str, dimensions))})")
    if len(points) < least:
        raise EvaluationError(f"{what} needs at least {least} points; found {len(points)}")
    unusable = int(np.count_nonzero(~np.isfinite(points).all(axis=1)))
    if unusable:
        raise EvaluationError(f"{what}: {unusable} of {len(points)} points are not finite; remove them")
    return points


@dataclass(frozen=True, eq=False)
class Normalised:
    """Points (N, D) for a fit, as given and normalised to zero mean and unit rms distance.

    ``extents`` (D,) are the root sums of squares of the normalised points along their principal ``axes`` (rows of
    (D, D)), in descending order. ``rank`` counts the directions that they span beyond rounding errors.
    """

    given_mm: np.ndarray
    points: np.ndarray
    centroid_mm: np.ndarray
    scale_mm: float
    extents: np.ndarray
    axes: np.ndarray
    rank: int


def normalise_points(points: Any, *, least: int, what: str, dimensions: tuple[int, ...] = (3,)) -> Normalised:
    """Check points, centre and scale them; EvaluationError as `check_points`, and for coincident points."""
    points = check_points(points, least=least, what=what, dimensions=dimensions)
    centroid = points.mean(axis=0)
    centred = points - centroid
    scale = float(np.sqrt(np.mean(np.sum(centred**2, axis=1))))
    if scale <= 1e-12 * float(np.abs(centroid).max()):
        raise EvaluationError(f"{what}: all {len(points)} points coincide")
    extents, axes = principal_axes(centred / scale)
    rank = int(np.count_nonzero(extents > _SINGULAR * extents[0]))
    return Normalised(points, centred / scale, centroid, scale, extents, axes, rank)


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
    """Return root sums of squares (D,) along the principal axes, and the axes (rows of (D, D)), in descending order.

    The singular values of the points are used, since their scatter matrix has only half of the digits.
    """
    _, extents, axes = np.linalg.svd(np.linalg.qr(points, mode="r"))
    return extents, axes


def thin_evenly(points: np.ndarray, at_most: int) -> np.ndarray:
    """Select every k-th point so that at most ``at_most`` remain."""
    return points[:: max(1, -(-len(points) // at_most))]


def minimise_squares(
    residuals: Callable[[np.ndarray], np.ndarray], jacobian: Callable[[np.ndarray], np.ndarray], start: np.ndarray
) -> tuple[np.ndarray, float]:
    """Return parameters and sum of squares of a least-squares solution (Levenberg-Marquardt, MINPACK).

    The sum is infinite if the iteration does not converge, so that the best of several starts can be selected.
    """
    limits: dict[str, Any] = {"xtol": 1e-13, "ftol": 1e-15, "gtol": 1e-15, "max_nfev": _STEPS}
    solution = least_squares(residuals, start, jac=jacobian, method="lm", **limits)  # pyright: ignore[reportArgumentType]
    converged = solution.success and np.isfinite(solution.x).all()
    return solution.x, 2.0 * float(solution.cost) if converged else np.inf


def parameter_covariance(jacobian: np.ndarray, sum_of_squares: float, *, what: str) -> tuple[np.ndarray, float]:
    """Return the covariance (P, P) of the parameters of a shape, and the standard deviation of one residual.

    The covariance is s2 (J^T J)^-1 with s2 = sum of squares / (N - P), for equal independent noise of all residuals.
    EvaluationError if the sum is infinite (no convergence) or the Jacobian (N, P) is singular.
    """
    if not np.isfinite(sum_of_squares):
        raise EvaluationError(f"the fit of {what} does not converge; the points do not have this shape")
    count, parameters = jacobian.shape
    _, strengths, directions = np.linalg.svd(np.linalg.qr(jacobian, mode="r"))
    if not strengths[-1] > _SINGULAR * strengths[0]:
        raise EvaluationError(f"the {count} points do not determine {what}")
    variance = sum_of_squares / (count - parameters)
    inverse = directions.T / strengths
    return variance * inverse @ inverse.T, float(np.sqrt(variance))
