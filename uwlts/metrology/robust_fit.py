"""Robust fits: outliers are left out by a stated rule and counted."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Generic, Protocol, TypeVar

import numpy as np

from uwlts.metrology.least_squares import accepted_points

MAD_TO_STD = 1.4826
"""Standard deviation of a normal distribution over its median absolute deviation."""

VDI_OUTLIER_SHARE = 0.003
"""VDI/VDE 2634 lets at most 3 permille of the points be left out."""

DEFAULT_K = 5.0
"""Of normal noise 6 points in ten million lie farther out than 5 standard deviations."""

_RETURNING_ROUNDS = 20


class Fit(Protocol):
    """What `fit_robustly` needs of a fitted shape."""

    @property
    def residuals_mm(self) -> np.ndarray: ...

    def distances_mm(self, points: np.ndarray) -> np.ndarray: ...


FitT = TypeVar("FitT", bound=Fit)


@dataclass(frozen=True, eq=False)
class RobustFit(Generic[FitT]):
    """A fit to the inliers, and what was left out.

    Attributes
    ----------
    fit
        The shape, fitted to the inliers only.
    inliers : (N,) bool
    distances_mm : (N,)
        Distances of all points, inliers or not, from the fitted shape.
    limit_mm : float
        Points whose distance differs by more from the median distance (nearly zero) were left out.
    rounds : int
        Number of fits.
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
    end. The rule is for a few outliers on one surface, not for telling surfaces apart.

    Parameters
    ----------
    fit : callable
        `fit_sphere`, `fit_plane`, ... or a partial of them: points (M, D) to a shape.
    points : (N, D), mm
    k : float
        Limit in robust standard deviations.

    Raises
    ------
    EvaluationError
        The fit refuses the points or what is left of them.
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
