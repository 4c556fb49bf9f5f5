"""Point-by-point comparison of measured points with ground truth."""

from typing import Annotated, Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, SerializerFunctionWrapHandler, model_serializer

from uwlts.errors import EvaluationError
from uwlts.storage.truth import TruthStatus

Count = Annotated[int, Field(ge=0)]
_NO_POINTS = np.zeros(0)


class StoredResult(BaseModel):
    """Base of results that are files or parts of files; fields that are not in the file do not count as differences."""

    # Keep results of specific artefacts and fields of newer versions.
    model_config = ConfigDict(frozen=True, extra="allow", allow_inf_nan=False, arbitrary_types_allowed=True)

    def __eq__(self, other: object) -> bool:
        """Return whether the contents of two files are equal."""
        return isinstance(other, StoredResult) and self.model_dump() == other.model_dump()


class TruthComparison(StoredResult):
    """Errors, completeness and false points of a cloud.

    Statistics are of the signed distances of matched points; percentiles and maximum are of their absolute values.
    ``false_points`` have no true stripe, and ``missed`` counts true stripes (a line of a frame) without a point.
    ``shift_mm`` is the mean error of the points along X, Y and Z, ``shift_expanded_mm`` its stated uncertainty (k = 2).
    The arrays are not in files. ``is_matched`` (N,) marks points whose frame and line have a true stripe. ``error_mm``
    (N, 3) is the measured minus the true point, NaN if not matched. ``distance_mm`` (N,) is its component along the
    true normal.
    """

    matched: Count
    tolerance_mm: float
    mean_mm: float
    std_mm: float
    rms_mm: float
    p95_mm: float
    p99_mm: float
    largest_mm: float
    share_within_tolerance: Annotated[float, Field(ge=0, le=1)]
    false_points: Count
    missed: Count
    after_best_fit: "TruthComparison | None" = None
    shift_mm: tuple[float, float, float] | None = None
    shift_expanded_mm: tuple[float, float, float] | None = None
    is_matched: np.ndarray = Field(default=_NO_POINTS, exclude=True)
    error_mm: np.ndarray = Field(default=_NO_POINTS, exclude=True)
    distance_mm: np.ndarray = Field(default=_NO_POINTS, exclude=True)

    @model_serializer(mode="wrap")
    def _without_missing(self, plain: SerializerFunctionWrapHandler) -> dict[str, Any]:
        return {key: value for key, value in plain(self).items() if value is not None}


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
        matched=int(np.count_nonzero(matched)),
        is_matched=matched,
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
