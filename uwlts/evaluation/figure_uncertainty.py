"""Uncertainty of an artefact's figures and of a cloud's position, including correlations between points."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from uwlts.evaluation.artefact_figures import (
    PipeEvaluation,
    PlaneEvaluation,
    SphereEvaluation,
    StepEvaluation,
    measure_ovality,
    measure_step,
)
from uwlts.evaluation.figures import ArtefactEvaluation, FigureUncertainty, Quantity
from uwlts.fitting.propagation import LinearisedFit, PointErrors
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
    figures = linearise_figures(cloud, evaluation)
    errors = PointErrors.from_uncertainty(uncertainty, cloud.frame)
    draws = int(np.clip(_DRAWN_POINTS // len(cloud.points_mm), _FEWEST_DRAWS, _MOST_DRAWS))
    stated = propagate_figures(errors, evaluation.figures_mm, figures.figures_mm, draws=draws)
    linear = {name: errors.linear_std(by_points) for name, by_points in figures.gradients.items()}
    return stated | {name: replace(stated[name], random_mm=std) for name, std in linear.items()}


def propagate_figures(
    errors: PointErrors, figures_mm: dict[str, float], after: Callable[[np.ndarray], dict[str, float]], *, draws: int
) -> dict[str, FigureUncertainty]:
    """Return the uncertainties of figures; ``after`` returns the figures after shifts (N, 3) of the points."""

    def changed(moves: np.ndarray) -> list[float]:
        moved = after(moves)
        return [moved[name] - value for name, value in figures_mm.items()]

    random, systematic = errors.propagate(changed, draws=draws)
    assert systematic is not None
    found = zip(figures_mm, random, systematic, strict=True)
    return {name: FigureUncertainty(float(by_noise), float(common)) for name, by_noise, common in found}


@dataclass(frozen=True, eq=False)
class LinearisedFigures:
    """Figures of an evaluation as functions of small shifts of the cloud's points, with a fixed choice of points."""

    figures_mm: Callable[[np.ndarray], dict[str, float]]  # figures by name after shifts (N, 3)
    gradients: dict[str, np.ndarray]  # derivatives (N, 3) of the figures that are linear in the points


def linearise_figures(cloud: PointCloud, evaluation: ArtefactEvaluation) -> LinearisedFigures:
    """Return the figures of an evaluation as functions of small shifts of the cloud's points."""
    match evaluation:
        case SphereEvaluation():
            return _linearise_spheres(cloud.points_mm, evaluation)
        case PlaneEvaluation():
            return _linearise_plane(cloud.points_mm, evaluation)
        case PipeEvaluation():
            return _linearise_pipe(cloud.points_mm, evaluation)
        case StepEvaluation():
            return _linearise_step(cloud, evaluation)
        case _:
            raise TypeError(f"no figures of {evaluation.artefact.kind} are known")


def shift_std_mm(cloud: PointCloud, used: np.ndarray) -> np.ndarray:
    """Return the standard uncertainty (3,) of the mean of the ``used`` (N,) points, mm; NaN without uncertainty.

    Patterns are common to all points, position errors to those of an image; noise is independent (GUM, Eq. 13).
    """
    if (uncertainty := cloud.uncertainty) is None:
        return np.full(3, np.nan)
    errors = PointErrors.from_uncertainty(uncertainty, cloud.frame)
    axes = np.eye(3)[:, None] * (used / np.count_nonzero(used))[:, None]
    common = np.einsum("mni,ani->ma", uncertainty.patterns_mm, axes)
    return np.hypot([errors.linear_std(axis) for axis in axes], np.linalg.norm(common, axis=0))


def _linearise_plane(points: np.ndarray, evaluation: PlaneEvaluation) -> LinearisedFigures:
    used = np.flatnonzero(np.isfinite(evaluation.deviation_mm))
    fit = LinearisedFit(Plane.fit(points[used], towards=np.array(evaluation.normal)), points, used)

    def figures_mm(moves: np.ndarray) -> dict[str, float]:
        residuals = fit.shift(moves)[1]
        return replace(evaluation, re_mm=float(np.ptp(residuals)), std_mm=fit.std_mm(residuals)).figures_mm

    return LinearisedFigures(figures_mm, {})


def _linearise_pipe(points: np.ndarray, evaluation: PipeEvaluation) -> LinearisedFigures:
    used = np.flatnonzero(np.isfinite(evaluation.deviation_mm))
    pipe = Cylinder.fit(points[used], axis_start=evaluation.axis)
    fit = LinearisedFit(pipe, points, used)

    def figures_mm(moves: np.ndarray) -> dict[str, float]:
        step, residuals = fit.shift(moves)
        return replace(
            evaluation,
            diameter_error_mm=evaluation.diameter_error_mm + 2 * float(step[4]),
            range_mm=float(np.ptp(residuals)),
            std_mm=fit.std_mm(residuals),
            ovality_mm=measure_ovality(points[used], replace(pipe, residuals_mm=residuals)),
        ).figures_mm

    by_radius = fit.gradient(np.array([0.0, 0.0, 0.0, 0.0, 2.0]), len(points))
    return LinearisedFigures(figures_mm, {str(Quantity.DIAMETER_ERROR): by_radius})


def _linearise_step(cloud: PointCloud, evaluation: StepEvaluation) -> LinearisedFigures:
    artefact, labels, points = evaluation.artefact, evaluation.labels, cloud.points_mm
    assert isinstance(artefact, StepStandard)

    def figures_mm(moves: np.ndarray) -> dict[str, float]:
        return measure_step(points + moves, cloud.frame, labels, artefact).figures_mm

    # The height is the mean distance of a face from the plane of the other.
    base = StepFace[artefact.reference.upper()]
    used, across = (np.flatnonzero(labels == face) for face in (base, base.other))
    plane = Plane.fit(points[used])
    result = LinearisedFit(plane, points, used).gradient(plane.derivatives(points[across]).mean(axis=0), len(points))
    result[across] = plane.normal / len(across)
    by_points = np.sign(plane.distances_mm(points[across]).mean()) * result
    return LinearisedFigures(figures_mm, {str(Quantity.HEIGHT_ERROR): by_points})


def _linearise_spheres(points: np.ndarray, evaluation: SphereEvaluation) -> LinearisedFigures:
    artefact = evaluation.artefact
    members = [np.flatnonzero(evaluation.labels == number) for number in range(len(evaluation.spheres))]
    free, known = (
        [
            LinearisedFit(Sphere.fit(points[indices], radius), points, indices)
            for indices, radius in zip(members, radii_mm, strict=True)
        ]
        for radii_mm in ([None] * len(members), [diameter / 2 for diameter in artefact.diameters_mm])
    )

    def figures_mm(moves: np.ndarray) -> dict[str, float]:
        spheres, errors = [], []
        for fits in (free, known):
            moved = [fit.shift(moves) for fit in fits]
            middles = [fit.shape.centre_mm + step[:3] for fit, (step, _) in zip(fits, moved, strict=True)]
            errors.append(np.linalg.norm(np.diff(middles, axis=0), axis=1) - artefact.spacings_mm)
            spheres.append(moved)
        measured = tuple(
            replace(
                sphere,
                diameter_error_mm=sphere.diameter_error_mm + 2 * step[3],
                pe_mm=float(np.ptp(residuals)),
                std_mm=fit.std_mm(residuals),
            )
            for sphere, fit, (step, residuals) in zip(evaluation.spheres, free, spheres[0], strict=True)
        )
        spacings = tuple(
            replace(spacing, sse_mm=by_free, sse_known_radius_mm=by_known)
            for spacing, by_free, by_known in zip(evaluation.spacings, *errors, strict=True)
        )
        return replace(evaluation, spheres=measured, spacings=spacings).figures_mm

    gradients: dict[str, np.ndarray] = {}
    for key in (figure.key for figure in evaluation.figures):
        match key.quantity:
            case Quantity.DIAMETER_ERROR:
                by_radius = np.array([0.0, 0.0, 0.0, 2.0])
                gradients[key.name] = free[key.spheres[0] - 1].gradient(by_radius, len(points))
            case Quantity.SPACING_ERROR | Quantity.SPACING_ERROR_KNOWN_RADIUS:
                fits = free if key.quantity is Quantity.SPACING_ERROR else known
                first, second = (fits[number - 1] for number in key.spheres)
                between = second.shape.centre_mm - first.shape.centre_mm
                along = np.append(between / np.linalg.norm(between), 0.0)[: len(first.shape.covariance)]
                gradients[key.name] = second.gradient(along, len(points)) - first.gradient(along, len(points))
            case _:
                pass  # ranges and standard deviations are not linear in the points
    return LinearisedFigures(figures_mm, gradients)
