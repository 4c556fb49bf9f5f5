"""Point-by-point comparison of measured points with ground truth."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from uwlts.errors import EvaluationError
from uwlts.storage.truth import TruthStatus


@dataclass(frozen=True, eq=False)
class TruthComparison:
    """Errors, completeness and false points of a cloud."""

    matched: np.ndarray  # (N,) bool; points whose frame and line have a true stripe; all others are false points
    error_mm: np.ndarray  # (N, 3); measured minus true point; NaN if not matched
    distance_mm: np.ndarray  # (N,); component of the error along the true normal; NaN if not matched
    tolerance_mm: float
    # Statistics of the distances of matched points.
    mean_mm: float
    std_mm: float
    rms_mm: float
    # Percentiles and maximum of their absolute values.
    p95_mm: float
    p99_mm: float
    largest_mm: float
    share_within_tolerance: float  # fraction of the matched points with an absolute distance of at most `tolerance_mm`
    # Number of points without a true stripe, and of true stripes (a line of a frame) without a point.
    false_points: int
    missed: int

    @property
    def shift_mm(self) -> np.ndarray:
        """Mean error (3,) of the matched points."""
        return np.mean(self.error_mm[self.matched], axis=0)

    def as_dict(self) -> dict[str, Any]:
        """Return the statistics and the number of matched points as JSON."""
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
    """Compare points with the true surface by their signed distances (p - p_true) . n.

    ``points`` (N, 3) in mm come with their image and row or column (N,). ``point_mm`` and ``normal`` (F, L, 3) are the
    true point and unit normal of each line of each frame, in the frame of the points. They count where ``status`` (F,
    L) is 0, a visible stripe.

    Raises EvaluationError if points have no frame and line or ones outside the truth, visible truth is not finite or
    has no unit normals, or no point matches.
    """
    points, point_mm, normal = (np.asarray(values, dtype=np.float64) for values in (points, point_mm, normal))
    frame, line = np.asarray(frame), np.asarray(line)
    visible = np.asarray(status) == TruthStatus.VISIBLE
    if points.shape != (len(points), 3) or frame.shape != (len(points),) or line.shape != frame.shape:
        raise ValueError(f"expected (N, 3) points and (N,) indices; found {points.shape}, {frame.shape}, {line.shape}")
    shapes = point_mm.shape, normal.shape, visible.shape
    if visible.ndim != 2 or shapes[:2] != ((*visible.shape, 3),) * 2:
        raise ValueError(f"expected truth of the shapes (F, L, 3), (F, L, 3), (F, L); found {shapes}")
    outside = (frame < 0) | (frame >= visible.shape[0]) | (line < 0) | (line >= visible.shape[1])
    if not np.isfinite(points).all():
        raise EvaluationError("some points are not finite; remove them")
    if outside.any():
        first = int(np.argmax(outside))
        raise EvaluationError(
            f"{np.count_nonzero(outside)} of {len(points)} points are outside the truth of {visible.shape[0]} "
            f"frames and {visible.shape[1]} lines (the first: frame {frame[first]}, line {line[first]}); "
            f"cloud and truth belong to different captures"
        )
    if not np.isfinite(point_mm[visible]).all():
        raise EvaluationError("the truth is not finite on lines with a visible stripe")
    # The tolerance allows for normals in single precision (1e-7). A wrong length would scale all distances.
    if not np.allclose(np.sum(np.square(normal[visible]), axis=1), 1.0, rtol=0, atol=1e-5):
        raise EvaluationError("the truth has normals that are not of unit length on lines with a visible stripe")
    matched = visible[frame, line]
    if not matched.any():
        raise EvaluationError(f"none of the {len(points)} points has a visible true stripe on its frame and line")
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
