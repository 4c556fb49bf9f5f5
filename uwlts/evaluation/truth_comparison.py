"""Compares measured points with ground truth, point by point."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from uwlts.errors import EvaluationError
from uwlts.storage.truth import TruthStatus


@dataclass(frozen=True, eq=False)
class TruthComparison:
    """Errors of the points, and how complete and how clean they are.

    Attributes
    ----------
    matched : (N,) bool
        Points whose frame and line have a true stripe; all others are false points.
    error_mm : (N, 3)
        Point less true point; NaN where not matched.
    distance_mm : (N,)
        Component of the error along the true surface's normal; NaN where not matched.
    mean_mm, std_mm, rms_mm : float
        Of the distances of the matched points; percentiles and the largest are of their absolute values.
    share_within_tolerance : float
        Share of the matched points with an absolute distance of at most `tolerance_mm`.
    false_points, missed : int
        Points without a true stripe, and true stripes (a line of a frame) without a point.
    """

    matched: np.ndarray
    error_mm: np.ndarray
    distance_mm: np.ndarray
    tolerance_mm: float
    mean_mm: float
    std_mm: float
    rms_mm: float
    p95_mm: float
    p99_mm: float
    largest_mm: float
    share_within_tolerance: float
    false_points: int
    missed: int

    @property
    def shift_mm(self) -> np.ndarray:
        """Mean error (3,) of the matched points."""
        return np.mean(self.error_mm[self.matched], axis=0)

    def as_dict(self) -> dict[str, Any]:
        """The statistics as plain JSON, with the number of matched points."""
        arrays = ("matched", "error_mm", "distance_mm")
        statistics = {name: value for name, value in vars(self).items() if name not in arrays}
        return {"matched": int(np.count_nonzero(self.matched)), **statistics}


def compare_with_truth(
    points: np.ndarray,
    frame: np.ndarray,
    line: np.ndarray,
    *,
    point_mm: np.ndarray,
    normal: np.ndarray,
    status: np.ndarray,
    tolerance_mm: float = 0.01,
) -> TruthComparison:
    """Signed distances (p - p_true) . n of points (N, 3), mm, to the true surface, and their statistics.

    ``frame`` and ``line`` (N,) are the image and row (or column) of each point. ``point_mm`` and ``normal`` (F, L, 3)
    are the true point and unit surface normal of each line of each frame, in the frame of the points, where its
    ``status`` (F, L) is 0, a visible stripe.

    Raises
    ------
    EvaluationError
        Points without frame and line, or with ones beyond the truth; truth that is not finite or has no unit normals
        where it says visible; no point matches.
    """
    points, point_mm, normal = (np.asarray(values, dtype=np.float64) for values in (points, point_mm, normal))
    frame, line = np.asarray(frame), np.asarray(line)
    visible = np.asarray(status) == TruthStatus.VISIBLE
    if points.shape != (len(points), 3) or frame.shape != (len(points),) or line.shape != frame.shape:
        raise ValueError(f"(N, 3) points and (N,) indices expected: {points.shape}, {frame.shape}, {line.shape}")
    shapes = point_mm.shape, normal.shape, visible.shape
    if visible.ndim != 2 or shapes[:2] != ((*visible.shape, 3),) * 2:
        raise ValueError(f"truth of the shapes (F, L, 3), (F, L, 3), (F, L) expected: {shapes}")
    outside = (frame < 0) | (frame >= visible.shape[0]) | (line < 0) | (line >= visible.shape[1])
    if not np.isfinite(points).all():
        raise EvaluationError("points to be compared must be finite; leave the others out")
    if outside.any():
        first = int(np.argmax(outside))
        raise EvaluationError(
            f"{np.count_nonzero(outside)} of {len(points)} points have no place in the truth of {visible.shape[0]} "
            f"frames and {visible.shape[1]} lines (the first: frame {frame[first]}, line {line[first]}); "
            f"cloud and truth belong to different captures"
        )
    if not np.isfinite(point_mm[visible]).all():
        raise EvaluationError("the truth is not finite on lines whose stripe it calls visible")
    # Normals may come in single precision (1e-7); a wrong length would scale every distance.
    if not np.allclose(np.sum(np.square(normal[visible]), axis=1), 1.0, rtol=0, atol=1e-5):
        raise EvaluationError("the truth has normals that are not of unit length on lines it calls visible")
    matched = visible[frame, line]
    if not matched.any():
        raise EvaluationError(f"none of the {len(points)} points lies on a frame and line with a visible true stripe")
    error, distance = np.full(points.shape, np.nan), np.full(len(points), np.nan)
    at = frame[matched], line[matched]
    error[matched] = points[matched] - point_mm[at]
    signed = distance[matched] = np.sum(error[matched] * normal[at], axis=1)
    size = np.abs(signed)
    found = np.zeros_like(visible)
    found[at] = True
    p95, p99 = np.percentile(size, [95, 99])
    return TruthComparison(
        matched=matched,
        error_mm=error,
        distance_mm=distance,
        tolerance_mm=float(tolerance_mm),
        mean_mm=float(signed.mean()),
        std_mm=float(signed.std()),
        rms_mm=float(np.sqrt(np.mean(signed**2))),
        p95_mm=float(p95),
        p99_mm=float(p99),
        largest_mm=float(size.max()),
        share_within_tolerance=float(np.mean(size <= tolerance_mm)),
        false_points=int(np.count_nonzero(~matched)),
        missed=int(np.count_nonzero(visible & ~found)),
    )
