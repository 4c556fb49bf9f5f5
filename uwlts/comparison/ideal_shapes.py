"""Planes, spheres and cylinders as references of a comparison, given by a description or fitted to the cloud."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, assert_never

import numpy as np
from pydantic import Field, TypeAdapter, ValidationError, model_validator

from uwlts.errors import DescriptionError, describe_problems
from uwlts.evaluation.figures import TOWARDS_SENSOR
from uwlts.files.reading import MOST_TOML_BYTES, parse_toml, read_text
from uwlts.fitting.least_squares import fit_robustly, thin_evenly
from uwlts.model.sensor import Description, Positive, Vector
from uwlts.registration.surface_registration import Nearest, Registration, shape_registration
from uwlts.shapes.cylinder import Cylinder
from uwlts.shapes.flat import Plane
from uwlts.shapes.sphere import Sphere
from uwlts.storage.cloud import PointUncertainty

_MOST_FITTED = 50_000  # number of points above which a cloud is thinned for a fit; more take longer without a benefit

_MISFIT_STD = 5.0  # distance of a place from a fitted shape, in standard deviations, beyond which it departs from it
_MISFIT_SIZE = 0.002
"""Least such distance, divided by the radius, or by half the extent of a plane: out of roundness of usual parts."""
_MISFIT_SHARE = 0.4
"""Share of departing places from which a surface is no such shape: local changes cover less of it. Judged on the tubes
and bells of tests/uwlts/comparison/test_ideal_misfit.py."""


class _Shape(Description):
    """Base of ideal shapes; a shape without a position is fitted to the cloud."""

    @property
    def fitted(self) -> bool:
        return getattr(self, "point_mm", None) is None


class IdealPlane(_Shape):
    """Plane through a point; distances are positive on the side of the normal."""

    kind: Literal["plane"] = "plane"
    point_mm: Vector | None = None
    normal: Vector | None = None

    @model_validator(mode="after")
    def _placed_or_not(self) -> IdealPlane:
        if (self.point_mm is None) != (self.normal is None):
            raise ValueError("give both point_mm and normal of the plane, or neither to fit it")
        if self.normal is not None and not any(self.normal):
            raise ValueError("the normal is (0, 0, 0); expected a direction")
        return self


class IdealSphere(_Shape):
    """Sphere; fitted with a free or known diameter unless its centre ``point_mm`` is given."""

    kind: Literal["sphere"] = "sphere"
    diameter_mm: Positive | None = None
    point_mm: Vector | None = None

    @model_validator(mode="after")
    def _placed_with_a_size(self) -> IdealSphere:
        if self.point_mm is not None and self.diameter_mm is None:
            raise ValueError("a sphere with a given centre also needs diameter_mm")
        return self


class IdealCylinder(_Shape):
    """Cylinder; fitted with a free or known diameter unless ``point_mm`` on its axis and ``axis`` are given."""

    kind: Literal["cylinder"] = "cylinder"
    diameter_mm: Positive | None = None
    point_mm: Vector | None = None
    axis: Vector | None = None

    @model_validator(mode="after")
    def _placed_with_a_size(self) -> IdealCylinder:
        if (self.point_mm is None) != (self.axis is None):
            raise ValueError("give both point_mm and axis of the cylinder, or neither to fit it")
        if self.point_mm is not None and self.diameter_mm is None:
            raise ValueError("a cylinder with a given axis also needs diameter_mm")
        if self.axis is not None and not any(self.axis):
            raise ValueError("the axis is (0, 0, 0); expected a direction")
        return self


IdealShape = IdealPlane | IdealSphere | IdealCylinder

KINDS: dict[str, IdealShape] = {"plane": IdealPlane(), "sphere": IdealSphere(), "cylinder": IdealCylinder()}
"""Shapes of free size and position, by name."""


def read_shape(path: Path) -> IdealShape:
    """Read an ideal shape from a TOML file; CaptureError or DescriptionError if this fails."""
    text = read_text(path, most_bytes=MOST_TOML_BYTES, called="ideal shape", foreign="is not valid TOML")
    try:
        return TypeAdapter(Annotated[IdealShape, Field(discriminator="kind")]).validate_python(parse_toml(text))
    except ValidationError as error:
        raise DescriptionError(f"{path} contains no valid ideal shape: {describe_problems(error)}") from error
    except ValueError as error:
        raise DescriptionError(f"{path} is not valid TOML: {error}") from error


@dataclass(frozen=True, eq=False)
class PlacedShape:
    """Shape at a position."""

    kind: Literal["plane", "sphere", "cylinder"]
    point_mm: np.ndarray  # (3,); point of the plane, centre of the sphere, or point on the axis
    direction: np.ndarray | None  # (3,) or None; unit normal or axis; None for a sphere
    radius_mm: float  # radius; 0 for a plane
    registration: Registration | None = None  # uncertainty of a fitted shape; None for a given one

    def nearest(self, points_mm: np.ndarray, *, reach_mm: float = np.inf) -> Nearest:
        """Return signed distances and normals of points (N, 3), positive outwards or along a plane's normal."""
        away, direction = points_mm - self.point_mm, self.direction
        if self.kind == "plane" and direction is not None:
            normals, distance = np.broadcast_to(direction, away.shape), away @ direction
        else:
            if direction is not None:
                away = away - np.outer(away @ direction, direction)
            length = np.linalg.norm(away, axis=1)
            normals, distance = away / np.maximum(length, 1e-300)[:, None], length - self.radius_mm
        distance = np.where(np.abs(distance) <= reach_mm, distance, np.nan)
        return Nearest(distance, normals)

    def note_misfit(self, places_mm: np.ndarray, distance_mm: np.ndarray, variance_mm2: np.ndarray) -> str:
        """Return a note if most of a surface departs from this fitted shape; empty otherwise.

        ``distance_mm`` (P,) are local means at places (P, 3), NaN if farther away than searched, with their variance.
        A local change covers the smaller part of a surface, so that it does not count.
        """
        size = self.radius_mm or 0.5 * float(np.linalg.norm(np.ptp(places_mm, axis=0)))
        limit = np.maximum(_MISFIT_STD * np.sqrt(variance_mm2), _MISFIT_SIZE * size)
        share = float(np.mean(~(np.abs(distance_mm) <= limit)))
        if self.registration is None or share < _MISFIT_SHARE:
            return ""
        return (
            f"; {100 * share:.0f} % of the surface departs by more than {float(np.nanmedian(limit)):.2g} mm: it is no "
            f"{self.kind}, and distances are no local changes"
        )

    def describe(self) -> str:
        """Describe kind, size and position as text."""
        size = f" of {2 * self.radius_mm:.4f} mm diameter" if self.radius_mm else ""
        place = ", ".join(f"{value:.3f}" for value in self.point_mm)
        way = "" if self.direction is None else f", direction ({', '.join(f'{v:.5f}' for v in self.direction)})"
        return f"{self.kind}{size} at ({place}) mm{way}{'' if self.registration is None else ', fitted'}"


def place_shape(
    shape: IdealShape,
    points_mm: np.ndarray,
    *,
    uncertainty: PointUncertainty | None = None,
    frame: np.ndarray | None = None,
) -> PlacedShape:
    """Return a given shape, or fit it robustly to points (N, 3).

    EvaluationError if the points do not determine the shape.
    """
    if not shape.fitted:
        return _place_given_shape(shape)
    chosen = np.arange(len(points_mm))[:: -(-len(points_mm) // _MOST_FITTED)]
    points = points_mm[chosen]
    match shape:
        case IdealPlane():
            robust = fit_robustly(Plane.fit, points, towards=TOWARDS_SENSOR)
            placed = PlacedShape("plane", robust.fit.point_mm, robust.fit.normal, 0.0)
        case IdealSphere():
            known = None if shape.diameter_mm is None else shape.diameter_mm / 2
            robust = fit_robustly(Sphere.fit, points, radius_mm=known)
            placed = PlacedShape("sphere", robust.fit.centre_mm, None, robust.fit.radius_mm)
        case IdealCylinder():
            known = None if shape.diameter_mm is None else shape.diameter_mm / 2
            start = Cylinder.fit(thin_evenly(points, 2000), radius_mm=known).axis
            robust = fit_robustly(Cylinder.fit, points, radius_mm=known, axis_start=start)
            placed = PlacedShape("cylinder", robust.fit.point_mm, robust.fit.axis, robust.fit.radius_mm)
        case _:
            assert_never(shape)
    used = chosen[robust.inliers]
    registration = shape_registration(
        points_mm[used],
        placed.nearest(points_mm[used]),
        sized=not isinstance(shape, IdealPlane) and shape.diameter_mm is None,
        uncertainty=None if uncertainty is None else uncertainty[used],
        frame=None if frame is None else frame[used],
    )
    return PlacedShape(placed.kind, placed.point_mm, placed.direction, placed.radius_mm, registration)


def _place_given_shape(shape: IdealShape) -> PlacedShape:
    point = np.array(shape.point_mm, float)
    match shape:
        case IdealPlane():
            normal = np.array(shape.normal, float)
            return PlacedShape("plane", point, normal / np.linalg.norm(normal), 0.0)
        case IdealSphere():
            return PlacedShape("sphere", point, None, (shape.diameter_mm or 0.0) / 2)
        case IdealCylinder():
            axis = np.array(shape.axis, float)
            return PlacedShape("cylinder", point, axis / np.linalg.norm(axis), (shape.diameter_mm or 0.0) / 2)
        case _:
            assert_never(shape)
