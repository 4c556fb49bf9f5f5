"""Points of artefacts in an acceptance test, chosen by geometry, and the surfaces fitted to them.

The place of an artefact is found in the cloud, its size is that of the certificate. All points in the region about it
are measurements of the artefact, wherever they lie: only the share that VDI/VDE 2634 permits is left out.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Generic

import numpy as np
from scipy.spatial import KDTree

from uwlts.errors import EvaluationError
from uwlts.evaluation.artefact_figures import StepEvaluation, evaluate_plane, evaluate_step, measure_step
from uwlts.evaluation.figures import TOWARDS_SENSOR, spread_mm
from uwlts.evaluation.spheres import evaluate_spheres
from uwlts.fitting.least_squares import VDI_OUTLIER_SHARE, FitT
from uwlts.model.artefacts import PlaneStandard, SphereStandard, StepStandard
from uwlts.shapes.flat import Plane
from uwlts.shapes.sphere import Sphere
from uwlts.shapes.step import StepFace

_HEMISPHERE_DEG = 90.0
"""Largest angle between a sphere's surface normal and the direction to the sensor: all that light along Z reaches."""
_FACE_BAND = 0.25
"""Half width (unit: step height) of the region of a face: both regions and the riser between them are equally wide."""


@dataclass(frozen=True, eq=False)
class MeasuredSurface(Generic[FitT]):
    """Surface fitted by least squares to the points of its region, without those that the rule leaves out.

    Attributes
    ----------
    fit : Sphere or Plane
        Fit to the kept points.
    range_mm : float
        Range of the distances of the kept points from the fit.
    range_95_mm : float
        Width of the narrowest band about the fit that contains 95 % of all points.
    points : int
        Number of points on the artefact.
    rejected : int
        Number of points that were left out: the farthest 0.3 %, rounded down.
    """

    fit: FitT
    range_mm: float
    range_95_mm: float
    points: int
    rejected: int


def measure_spheres(points: np.ndarray, standard: SphereStandard, *, margin_mm: float) -> list[MeasuredSurface[Sphere]]:
    """Fit the spheres of a standard to points (N, 3), mm, in the order of the description.

    The points of a sphere are those within the margin of its surface, and all points in front of its outline along Z,
    where nothing else is measured. Both are limited to the half space that faces the sensor, or to the standard's cap.

    EvaluationError if a sphere is missing, or more than 0.3 % of its points are farther than the margin from it.
    """
    found = evaluate_spheres(points, standard).spheres
    away = points[:, None] - np.array([sphere.centre_mm for sphere in found])
    distance = np.linalg.norm(away, axis=2)
    off = distance - np.array([sphere.diameter_mm / 2 for sphere in found])
    nearest = np.argmin(np.abs(off), axis=1)
    cap = np.radians(standard.cap_angle_deg or _HEMISPHERE_DEG)
    toward = away @ TOWARDS_SENSOR
    facing = toward >= np.cos(cap) * distance
    aside = np.sqrt(np.maximum(distance**2 - toward**2, 0.0))
    measured = []
    for number, sphere in enumerate(found):
        before = aside[:, number] <= np.sin(cap) * sphere.diameter_mm / 2
        own = (nearest == number) & facing[:, number] & (before | (np.abs(off[:, number]) <= margin_mm))
        name = f"sphere {number + 1}"
        measured.append(_fit_kept(Sphere.fit, points[own], off[own, number], margin_mm=margin_mm, name=name))
    return measured


def measure_plane(points: np.ndarray, standard: PlaneStandard, *, margin_mm: float) -> MeasuredSurface[Plane]:
    """Fit a plane to all points (N, 3), mm.

    EvaluationError if the points show no plane, or more than 0.3 % of them are farther than the margin from it.
    """
    found = evaluate_plane(points, standard)
    off = (points - found.point_mm) @ np.array(found.normal)
    return _fit_kept(partial(Plane.fit, towards=TOWARDS_SENSOR), points, off, margin_mm=margin_mm, name="plane")


def measure_step_height(points: np.ndarray, frame: np.ndarray, standard: StepStandard) -> StepEvaluation:
    """Measure a step by all points (N, 3), mm, within a quarter of its height from a face, apart from the edges.

    EvaluationError if the points show no two faces of this height.
    """
    found = evaluate_step(points, frame, standard)
    normal = np.array(found.normal)
    height = points @ normal
    levels = {face: float(np.median(height[found.labels == face])) for face in (StepFace.LOWER, StepFace.UPPER)}
    along = points @ np.linalg.svd(normal[None])[2][1:].T
    labels = np.zeros(len(points), dtype=np.int8)
    for face, level in levels.items():
        on_it = np.abs(height - level) <= _FACE_BAND * standard.height_mm
        members = np.flatnonzero(on_it)
        # The riser and the other face; single flyers have no edge.
        others = along[np.abs(height - levels[face.other]) <= _FACE_BAND * standard.height_mm]
        if standard.edge_mm > 0:
            near, _ = KDTree(others).query(along[members], distance_upper_bound=standard.edge_mm)
            members = members[near > standard.edge_mm]
        labels[members] = face
    return measure_step(points, frame, labels, standard)


def _fit_kept(
    fit: Callable[[np.ndarray], FitT], points: np.ndarray, off_mm: np.ndarray, *, margin_mm: float, name: str
) -> MeasuredSurface[FitT]:
    """Fit a surface to its points (N, 3), mm, without the 0.3 % with the largest distances ``off_mm`` (N,)."""
    rejected = int(VDI_OUTLIER_SHARE * len(points))
    beyond = int(np.count_nonzero(np.abs(off_mm) > margin_mm))
    if beyond > rejected:
        raise EvaluationError(
            f"{name}: {beyond} of {len(points)} points ({100 * beyond / len(points):.2g} %) are more than "
            f"{margin_mm:g} mm off; VDI/VDE 2634 permits leaving out 0.3 %. Scan again, or exclude other surfaces by "
            "`region_mm` or `cap_angle_deg`"
        )
    kept = np.argsort(np.abs(off_mm), kind="stable")[: len(points) - rejected]
    shape = fit(points[kept])
    distances = np.sort(shape.distances_mm(points))
    inside = int(np.ceil(0.95 * len(points)))
    narrowest = float(np.min(distances[inside - 1 :] - distances[: len(points) - inside + 1]))
    return MeasuredSurface(shape, spread_mm(shape.residuals_mm), narrowest, len(points), rejected)
