"""Figures of artefact evaluations: keys, calibrated values, uncertainty, verdicts; comparison of points with truth."""

import dataclasses
from dataclasses import dataclass
from enum import StrEnum
from typing import Annotated, Any, assert_never

import numpy as np
import pydantic
from pydantic import BaseModel, ConfigDict, Field, SerializerFunctionWrapHandler, model_serializer
from pydantic_core import to_jsonable_python

from uwlts.errors import EvaluationError
from uwlts.fitting.least_squares import VDI_OUTLIER_SHARE
from uwlts.model.artefacts import Artefact, PipeStandard, PlaneStandard, SphereStandard, StepStandard
from uwlts.storage.cloud import PointCloud
from uwlts.storage.truth import Truth, TruthStatus

TOWARDS_SENSOR = np.array([0.0, 0.0, -1.0])
"""Direction from a surface to the sensor in the object coordinate system."""


class Quantity(StrEnum):
    """Kind of a figure; PE, RE and SSE are the probing, range and sphere spacing errors of VDI/VDE 2634."""

    PROBING_ERROR = "PE"
    RANGE_ERROR = "RE"
    RANGE = "range"
    STD = "STD"
    OVALITY = "ovality"
    DIAMETER_ERROR = "diameter error"
    SPACING_ERROR = "SSE"
    SPACING_ERROR_KNOWN_RADIUS = "SSE known radius"
    HEIGHT_ERROR = "height error"
    PROFILE_HEIGHT_ERROR = "profile height error"


_FIELDS = {
    Quantity.PROBING_ERROR: "pe_mm",
    Quantity.RANGE_ERROR: "re_mm",
    Quantity.RANGE: "range_mm",
    Quantity.STD: "std_mm",
    Quantity.OVALITY: "ovality_mm",
    Quantity.DIAMETER_ERROR: "diameter_error_mm",
    Quantity.SPACING_ERROR: "sse_mm",
    Quantity.SPACING_ERROR_KNOWN_RADIUS: "sse_known_radius_mm",
    Quantity.HEIGHT_ERROR: "height_error_mm",
    Quantity.PROFILE_HEIGHT_ERROR: "profile_height_error_mm",
}
"""Fields of an evaluation, a sphere or a spacing."""


@dataclass(frozen=True)
class CalibratedQuantity:
    """Calibrated quantity of an artefact, mm, and its expanded uncertainty (k = 2) if stated."""

    name: str
    value_mm: float
    uncertainty_mm: float | None


@dataclass(frozen=True)
class FigureKey:
    """Identifier of a figure of an artefact.

    Attributes
    ----------
    quantity : Quantity
    name : str
        Name in evaluation files and on pages.
    spheres : tuple of int
        Numbers, from 1, of the spheres of the figure; empty for a figure of the whole artefact.
    calibrated : CalibratedQuantity or None
        Calibrated quantity, if the figure is its error.
    """

    quantity: Quantity
    name: str
    spheres: tuple[int, ...] = ()
    calibrated: CalibratedQuantity | None = None

    @property
    def is_detail(self) -> bool:
        """True if another figure of the same evaluation summarises or supersedes this one."""
        if self.quantity in (Quantity.PROBING_ERROR, Quantity.STD):
            return bool(self.spheres)
        return self.quantity in (Quantity.SPACING_ERROR_KNOWN_RADIUS, Quantity.PROFILE_HEIGHT_ERROR)


@pydantic.dataclasses.dataclass(frozen=True)
class FigureUncertainty:
    """Standard uncertainties of a figure, mm: by noise of stripe and positions, and by calibration and stage."""

    random_mm: float
    systematic_mm: float

    @pydantic.computed_field
    @property
    def expanded_mm(self) -> float:
        """Expanded uncertainty, mm, with the coverage factor 2."""
        return 2.0 * float(np.hypot(self.random_mm, self.systematic_mm))


@dataclass(frozen=True)
class Figure:
    """Key and value (mm) of a figure, and its uncertainty if the points have one."""

    key: FigureKey
    value_mm: float
    uncertainty: FigureUncertainty | None = None

    @property
    def calibrated_mm(self) -> float | None:
        """Calibrated value of the quantity; None if the figure is not the error of one."""
        return None if self.key.calibrated is None else self.key.calibrated.value_mm

    @property
    def error_mm(self) -> float | None:
        """Measured minus calibrated value; None without a calibrated value."""
        return None if self.key.calibrated is None else self.value_mm

    @property
    def measured_mm(self) -> float:
        """Measured value of the quantity, which is the sum of an error and its calibrated value."""
        return self.value_mm + (self.calibrated_mm or 0.0)

    @property
    def expanded_uncertainty_mm(self) -> float | None:
        """Expanded uncertainty (k = 2) of the measured value; None if unknown."""
        return None if self.uncertainty is None else self.uncertainty.expanded_mm


def figure_keys(artefact: Artefact) -> tuple[FigureKey, ...]:
    """Return the keys of all possible figures of an artefact, in their order."""
    errors, plain = [], ()
    match artefact:
        case SphereStandard():
            keys = [FigureKey(quantity, str(quantity)) for quantity in (Quantity.PROBING_ERROR, Quantity.STD)]
            for number, diameter in enumerate(artefact.diameters_mm, start=1):
                known = CalibratedQuantity(f"diameter, sphere {number}", diameter, artefact.diameter_uncertainty_mm)
                own = (Quantity.PROBING_ERROR, None), (Quantity.STD, None), (Quantity.DIAMETER_ERROR, known)
                keys += [FigureKey(quantity, f"{quantity} sphere {number}", (number,), size) for quantity, size in own]
            for number, spacing in enumerate(artefact.spacings_mm, start=1):
                pair = "" if len(artefact.spacings_mm) == 1 else f" {number}-{number + 1}"
                for quantity in (Quantity.SPACING_ERROR, Quantity.SPACING_ERROR_KNOWN_RADIUS):
                    named = f"{pair}{str(quantity).removeprefix('SSE')}"
                    known = CalibratedQuantity(f"sphere spacing{named}", spacing, artefact.spacing_uncertainty_mm)
                    keys.append(FigureKey(quantity, f"SSE{named}", (number, number + 1), known))
            return tuple(keys)
        case PlaneStandard():
            plain = Quantity.RANGE_ERROR, Quantity.STD
        case StepStandard():
            height = CalibratedQuantity("step height", artefact.height_mm, artefact.height_uncertainty_mm)
            errors, plain = [(Quantity.HEIGHT_ERROR, height)], (Quantity.STD, Quantity.PROFILE_HEIGHT_ERROR)
        case PipeStandard():
            diameter = CalibratedQuantity("pipe diameter", artefact.diameter_mm, artefact.diameter_uncertainty_mm)
            errors, plain = [(Quantity.DIAMETER_ERROR, diameter)], (Quantity.RANGE, Quantity.STD, Quantity.OVALITY)
        case _:
            assert_never(artefact)
    with_errors = [*errors, *((quantity, None) for quantity in plain)]
    return tuple(FigureKey(quantity, str(quantity), calibrated=known) for quantity, known in with_errors)


@dataclass(frozen=True, eq=False, kw_only=True)
class ArtefactEvaluation:
    """Figures of an artefact and the numbers of its points.

    ``points_rejected`` counts the outliers on the artefact (`fit_robustly`). Points that do not belong to the artefact
    are the rest of the cloud. ``deviation_mm`` (N,) is the signed deviation of each used point of the
    cloud, NaN for all others.
    """

    artefact: Artefact
    points_used: int
    points_rejected: int
    deviation_mm: np.ndarray
    points_excluded: int = 0  # of the artefact, by its description

    @property
    def rejected_share(self) -> float:
        """Fraction of the artefact's points that were rejected."""
        return self.points_rejected / (self.points_used + self.points_rejected)

    @property
    def points_total(self) -> int:
        """Number of points of the cloud, without those that the artefact's description excludes."""
        return len(self.deviation_mm) - self.points_excluded

    @property
    def within_vdi_outliers(self) -> bool:
        """True if the rejected fraction is at most 0.3 %, the limit of VDI/VDE 2634."""
        return self.rejected_share <= VDI_OUTLIER_SHARE

    def part_of(self, spheres: tuple[int, ...]) -> object:
        """Return the result that has the figures of one sphere or of two; the evaluation itself without any."""
        return self

    @property
    def figures(self) -> tuple[Figure, ...]:
        """Figures of the artefact that could be measured."""
        keys = figure_keys(self.artefact)
        found = ((key, getattr(self.part_of(key.spheres), _FIELDS[key.quantity])) for key in keys)
        return tuple(Figure(key, value) for key, value in found if value is not None)

    @property
    def figures_mm(self) -> dict[str, float]:
        """Values of the figures by name, mm, as in evaluation files."""
        return {figure.key.name: figure.value_mm for figure in self.figures}

    def as_dict(self) -> dict[str, Any]:
        """Return everything except the artefact and the deviations of single points as JSON."""
        extra = [
            field.name for field in dataclasses.fields(self) if field.name not in ("artefact", "deviation_mm", "labels")
        ]
        used = self.deviation_mm[np.isfinite(self.deviation_mm)]
        # VDI/VDE 2634 allows to leave out 0.3 % of the points, those with the largest deviations.
        kept = used[np.argsort(np.abs(used))[: len(used) - int(VDI_OUTLIER_SHARE * len(used))]]
        return {
            "kind": self.artefact.kind,
            "figures_mm": self.figures_mm,
            "points_total": self.points_total,
            **{name: to_jsonable_python(getattr(self, name)) for name in extra},
            "rejected_share": self.rejected_share,
            "vdi_range_mm": float(np.ptp(kept)),
            "within_vdi_outliers": self.within_vdi_outliers,
        }


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
    def _omit_missing(self, plain: SerializerFunctionWrapHandler) -> dict[str, Any]:
        return {key: value for key, value in plain(self).items() if value is not None}


def compare_with_truth(cloud: PointCloud, truth: Truth, *, tolerance_mm: float) -> TruthComparison:
    """Compare points with the true surface by their signed distances (p - p_true) . n.

    The true point and unit normal of a point's frame and line count where the true stripe is visible.

    Raises EvaluationError if the cloud is of another capture, or points have no frame and line within the truth. The
    same if visible truth is not finite or has no unit normals, or if no point matches.
    """
    images = cloud.metadata.get("images")
    if images is not None and images != len(truth.status):
        raise EvaluationError(
            f"the cloud is of a capture of {images} images, the truth of one of {len(truth.status)}: give the truth "
            "of the cloud's capture"
        )
    points, frame, line = cloud.points_mm, cloud.frame, cloud.line
    point_mm, normal = (np.asarray(values, dtype=np.float64) for values in (truth.point_mm, truth.normal))
    visible = truth.status == TruthStatus.VISIBLE
    outside = (frame < 0) | (frame >= visible.shape[0]) | (line < 0) | (line >= visible.shape[1])
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
        tolerance_mm=tolerance_mm,
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
