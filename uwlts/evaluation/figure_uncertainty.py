"""Uncertainty of an artefact's figures and of a cloud's position, including correlations between points."""

from dataclasses import replace

import numpy as np

from uwlts.evaluation.artefact_figures import (
    PipeEvaluation,
    PlaneEvaluation,
    SphereEvaluation,
    StepEvaluation,
    measure_ovality,
    measure_step,
)
from uwlts.evaluation.figures import ArtefactEvaluation, FigureUncertainty, Quantity, spread_mm
from uwlts.fitting.propagation import LinearisedFit, PointErrors, noise_shifts
from uwlts.model.artefacts import StepStandard
from uwlts.shapes.cylinder import Cylinder
from uwlts.shapes.flat import Plane
from uwlts.shapes.sphere import Sphere
from uwlts.shapes.step import StepFace
from uwlts.storage.cloud import PointCloud

_MOST_DRAWS, _FEWEST_DRAWS = 400, 50
"""Number of draws for figures that are not linear in the points: relative uncertainties of 3.5 % and 10 %."""
_DRAWN_POINTS = 4_000_000
"""Points of all draws together, for a second of computation: the number of draws follows within the limits above."""


def figure_uncertainties(cloud: PointCloud, evaluation: ArtefactEvaluation) -> dict[str, FigureUncertainty]:
    """Return the uncertainty of each figure of an evaluation by name; empty if the points have no uncertainty.

    Diameters, spacings and heights are linear in small shifts of the points: noise is propagated by their derivatives
    (GUM, section 5.1). Ranges and standard deviations of residuals are recalculated with random draws of noise. Each
    systematic pattern is added to the points. The assignment of points to surfaces is kept.
    """
    if (uncertainty := cloud.uncertainty) is None:
        return {}
    plain, figures = evaluation.figures_mm, linearise_figures(cloud, evaluation)

    def changed(by: np.ndarray) -> np.ndarray:
        moved = figures.figures_mm(by)
        return np.array([moved[name] - value for name, value in plain.items()])

    errors = PointErrors.from_uncertainty(uncertainty, cloud.frame)
    draws = int(np.clip(_DRAWN_POINTS // len(cloud.points_mm), _FEWEST_DRAWS, _MOST_DRAWS))
    by_noise, by_calibration = errors.propagate(changed, draws=draws)
    assert by_calibration is not None
    stated = {name: (float(r), float(s)) for name, r, s in zip(plain, by_noise, by_calibration, strict=True)}
    linear = {name: errors.linear_std(by_points) for name, by_points in figures.gradients().items()}
    return {name: FigureUncertainty(linear.get(name, random), system) for name, (random, system) in stated.items()}


def linearise_figures(
    cloud: PointCloud, evaluation: ArtefactEvaluation
) -> "LinearisedSpheres | _LinearisedPlane | _LinearisedPipe | _LinearisedStep":
    """Return the figures of an evaluation as functions of small shifts of the cloud's points."""
    match evaluation:
        case SphereEvaluation():
            return LinearisedSpheres(cloud.points_mm, evaluation)
        case PlaneEvaluation():
            return _LinearisedPlane(cloud.points_mm, evaluation)
        case PipeEvaluation():
            return _LinearisedPipe(cloud.points_mm, evaluation)
        case StepEvaluation():
            return _LinearisedStep(cloud, evaluation)
        case _:
            raise TypeError(f"no figures of {evaluation.kind} are known")


def shift_std_mm(cloud: PointCloud, used: np.ndarray) -> np.ndarray:
    """Return the standard uncertainty (3,) of the mean of the ``used`` (N,) points, mm; NaN without uncertainty.

    Patterns are common to all points, position errors to the points of an image, and noise is independent (GUM,
    Eq. 13).
    """
    if (uncertainty := cloud.uncertainty) is None:
        return np.full(3, np.nan)
    count = np.count_nonzero(used)
    together = uncertainty.patterns_mm[:, used].sum(axis=1)
    image = np.unique(cloud.frame[used], return_inverse=True)[1]
    by_image = [
        np.stack([np.bincount(image, moves) for moves in part[used].T], axis=1)
        for part in uncertainty.image_errors_mm()
    ]
    moved = np.vstack([together, *by_image, noise_shifts(uncertainty)[used]])
    return np.sqrt(np.sum(moved**2, axis=0)) / count


class _LinearisedPlane:
    """Linearised plane of an evaluation of points (N, 3), mm, with fixed outliers."""

    def __init__(self, points: np.ndarray, evaluation: PlaneEvaluation):
        used = np.flatnonzero(np.isfinite(evaluation.deviation_mm))
        self._evaluation = evaluation
        self._fit = LinearisedFit(Plane.fit(points[used], towards=np.array(evaluation.normal)), points, used)

    def figures_mm(self, moves: np.ndarray) -> dict[str, float]:
        """Return the evaluation's figures after shifts (N, 3) of all points."""
        _, residuals = self._fit.shift(moves)
        std_mm = self._fit.std_mm(residuals)
        return replace(self._evaluation, re_mm=spread_mm(residuals), std_mm=std_mm).figures_mm

    def gradients(self) -> dict[str, np.ndarray]:
        """Return the derivatives (N, 3) of figures that are linear in the points; here none."""
        return {}


class _LinearisedPipe:
    """Linearised cylinder of an evaluation of points (N, 3), mm, with fixed outliers."""

    def __init__(self, points: np.ndarray, evaluation: PipeEvaluation):
        used = np.flatnonzero(np.isfinite(evaluation.deviation_mm))
        self._points, self._evaluation, self._count = points[used], evaluation, len(points)
        self._pipe = Cylinder.fit(points[used], axis_start=evaluation.axis)
        self._fit = LinearisedFit(self._pipe, points, used)

    def figures_mm(self, moves: np.ndarray) -> dict[str, float]:
        """Return the evaluation's figures after shifts (N, 3) of all points."""
        step, residuals = self._fit.shift(moves)
        return replace(
            self._evaluation,
            diameter_error_mm=self._evaluation.diameter_error_mm + 2 * float(step[4]),
            range_mm=spread_mm(residuals),
            std_mm=self._fit.std_mm(residuals),
            ovality_mm=measure_ovality(self._points, replace(self._pipe, residuals_mm=residuals)),
        ).figures_mm

    def gradients(self) -> dict[str, np.ndarray]:
        """Return the derivatives (N, 3) of figures that are linear in the points."""
        (name,) = (f.key.name for f in self._evaluation.figures if f.key.quantity is Quantity.DIAMETER_ERROR)
        return {name: self._fit.gradient(np.array([0.0, 0.0, 0.0, 0.0, 2.0]), self._count)}


class _LinearisedStep:
    """Figures of a step in a cloud, with fixed faces."""

    def __init__(self, cloud: PointCloud, evaluation: StepEvaluation):
        assert isinstance(evaluation.artefact, StepStandard)
        self._cloud, self._evaluation, self._labels = cloud, evaluation, evaluation.labels
        self._artefact = evaluation.artefact

    def figures_mm(self, moves: np.ndarray) -> dict[str, float]:
        """Return the evaluation's figures after shifts (N, 3) of all points."""
        points = self._cloud.points_mm + moves
        return measure_step(points, self._cloud.frame, self._labels, self._artefact).figures_mm

    def gradients(self) -> dict[str, np.ndarray]:
        """Return the derivatives (N, 3) of the height: mean distance of a face from the plane of the other."""
        points, base = self._cloud.points_mm, StepFace[self._artefact.reference.upper()]
        used, across = (np.flatnonzero(self._labels == face) for face in (base, base.other))
        plane = Plane.fit(points[used])
        fit = LinearisedFit(plane, points, used)
        result = fit.gradient(plane.derivatives(points[across]).mean(axis=0), len(points))
        result[across] = plane.normal / len(across)
        (name,) = (f.key.name for f in self._evaluation.figures if f.key.quantity is Quantity.HEIGHT_ERROR)
        return {name: np.sign(plane.distances_mm(points[across]).mean()) * result}


class LinearisedSpheres:
    """Linearised spheres of an evaluation of points (N, 3), mm, with a fixed assignment of points."""

    def __init__(self, points: np.ndarray, evaluation: SphereEvaluation):
        self._evaluation, self._count = evaluation, len(points)
        diameters = evaluation.artefact.diameters_mm
        used = np.flatnonzero(np.isfinite(evaluation.deviation_mm))
        centres = np.array([sphere.centre_mm for sphere in evaluation.spheres])
        radii = np.array([sphere.diameter_mm for sphere in evaluation.spheres]) / 2
        off = np.abs(np.linalg.norm(points[used, None] - centres, axis=2) - radii)
        members = [used[np.argmin(off, axis=1) == number] for number in range(len(radii))]
        self._free = [LinearisedFit(Sphere.fit(points[own]), points, own) for own in members]
        self._known = [
            LinearisedFit(Sphere.fit(points[own], d / 2), points, own)
            for own, d in zip(members, diameters, strict=True)
        ]

    def figures_mm(self, moves: np.ndarray) -> dict[str, float]:
        """Return the evaluation's figures after shifts (N, 3) of all points."""
        free = [fit.shift(moves) for fit in self._free]
        moved = [fit.shape.centre_mm + step[:3] for fit, (step, _) in zip(self._free, free, strict=True)]
        known = [fit.shape.centre_mm + fit.shift(moves)[0] for fit in self._known]
        spheres = [
            replace(
                sphere,
                diameter_mm=sphere.diameter_mm + 2 * step[3],
                diameter_error_mm=sphere.diameter_error_mm + 2 * step[3],
                pe_mm=spread_mm(residuals),
                std_mm=fit.std_mm(residuals),
            )
            for sphere, fit, (step, residuals) in zip(self._evaluation.spheres, self._free, free, strict=True)
        ]
        spacings = []
        for number, spacing in enumerate(self._evaluation.spacings):
            calibrated = spacing.spacing_mm - spacing.sse_mm
            apart = float(np.linalg.norm(moved[number + 1] - moved[number]))
            apart_known = float(np.linalg.norm(known[number + 1] - known[number]))
            errors = {"sse_mm": apart - calibrated, "sse_known_radius_mm": apart_known - calibrated}
            spacings.append(replace(spacing, spacing_mm=apart, **errors))
        return replace(self._evaluation, spheres=tuple(spheres), spacings=tuple(spacings)).figures_mm

    def gradients(self) -> dict[str, np.ndarray]:
        """Return the derivatives (N, 3) of figures that are linear in the points."""
        found: dict[str, np.ndarray] = {}
        for key in (figure.key for figure in self._evaluation.figures):
            match key.quantity:
                case Quantity.DIAMETER_ERROR:
                    by_radius = np.array([0.0, 0.0, 0.0, 2.0])
                    found[key.name] = self._free[key.spheres[0] - 1].gradient(by_radius, self._count)
                case Quantity.SPACING_ERROR:
                    found[key.name] = self._spacing_gradient(key.spheres, self._free)
                case Quantity.SPACING_ERROR_KNOWN_RADIUS:
                    found[key.name] = self._spacing_gradient(key.spheres, self._known)
                case _:
                    pass  # ranges and standard deviations are not linear in the points
        return found

    def _spacing_gradient(self, spheres: tuple[int, ...], fits: list[LinearisedFit[Sphere]]) -> np.ndarray:
        first, second = fits[spheres[0] - 1 if spheres else 0 :][:2]
        between = second.shape.centre_mm - first.shape.centre_mm
        along = np.append(between / np.linalg.norm(between), 0.0)[: len(first.shape.covariance)]
        return second.gradient(along, self._count) - first.gradient(along, self._count)
