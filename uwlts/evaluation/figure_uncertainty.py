"""Uncertainty of an artefact's figures and of a cloud's position, including correlations between points."""

from dataclasses import replace

import numpy as np

from uwlts.evaluation.artefact_figures import evaluate_cloud
from uwlts.evaluation.figures import ArtefactEvaluation, FigureUncertainty, spread_mm
from uwlts.evaluation.spheres import SphereEvaluation
from uwlts.fitting.propagation import PointErrors, noise_shifts
from uwlts.fitting.shapes import fit_sphere
from uwlts.storage.cloud import PointCloud

_DRAWS = 8
"""Number of draws with a full evaluation: their standard deviation has a relative uncertainty of 27 %."""
_QUICK_DRAWS = 50
"""Number of draws for spheres with linearised fits: their standard deviation has a relative uncertainty of 10 %."""


def figure_uncertainties(cloud: PointCloud, evaluation: ArtefactEvaluation) -> dict[str, FigureUncertainty]:
    """Return the uncertainty of each figure of an evaluation by name; empty if the points have no uncertainty.

    Figures are recalculated with each systematic pattern added to the points, and with random draws of noise
    (`PointErrors.propagate`). The assignment of points to spheres is kept. EvaluationError as `evaluate_cloud`.
    """
    if (uncertainty := cloud.uncertainty) is None:
        return {}
    plain = evaluation.figures_mm
    spheres = LinearisedSpheres(cloud.points_mm, evaluation) if isinstance(evaluation, SphereEvaluation) else None

    def changed(by: np.ndarray) -> np.ndarray:
        if spheres is not None:
            figures = spheres.figures_mm(by)
        else:
            figures = evaluate_cloud(replace(cloud, points_mm=cloud.points_mm + by), evaluation.artefact).figures_mm
        return np.array([figures[name] - value for name, value in plain.items()])

    draws = _DRAWS if spheres is None else _QUICK_DRAWS
    by_noise, by_calibration = PointErrors.from_uncertainty(uncertainty, cloud.frame).propagate(changed, draws=draws)
    assert by_calibration is not None
    return {
        name: FigureUncertainty(float(r), float(s)) for name, r, s in zip(plain, by_noise, by_calibration, strict=True)
    }


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


class _LinearisedSphere:
    """Linearised sphere fit of free or known radius to the ``used`` (K,) of points (N, 3).

    Centre and free radius are linear in changes of the residuals. The outward unit vectors are constant, since shifts
    of points are small compared with the radius.
    """

    def __init__(self, points: np.ndarray, used: np.ndarray, radius_mm: float | None):
        self._used, self._fit = used, fit_sphere(points[used], radius_mm)
        outward = points[used] - self._fit.centre_mm
        self._outward = outward / np.linalg.norm(outward, axis=1, keepdims=True)
        free = np.ones((len(used), 1 if radius_mm is None else 0))
        by_parameters = np.hstack([self._outward, free])
        self._solve = np.linalg.solve(by_parameters.T @ by_parameters, by_parameters.T)

    def shift(self, moves: np.ndarray) -> tuple[np.ndarray, float, np.ndarray]:
        """Return centre (3,), change of radius (0 if known) and residuals (K,) after shifts (N, 3) of points."""
        change = np.einsum("ni,ni->n", self._outward, moves[self._used])
        step = self._solve @ change
        by_radius = float(step[3:].sum())
        residuals = self._fit.residuals_mm + change - self._outward @ step[:3] - by_radius
        return self._fit.centre_mm + step[:3], by_radius, residuals


class LinearisedSpheres:
    """Linearised spheres of an evaluation of points (N, 3), mm, with a fixed assignment of points."""

    def __init__(self, points: np.ndarray, evaluation: SphereEvaluation):
        self._evaluation = evaluation
        diameters = evaluation.artefact.diameters_mm
        used = np.flatnonzero(np.isfinite(evaluation.deviation_mm))
        centres = np.array([sphere.centre_mm for sphere in evaluation.spheres])
        radii = np.array([sphere.diameter_mm for sphere in evaluation.spheres]) / 2
        off = np.abs(np.linalg.norm(points[used, None] - centres, axis=2) - radii)
        members = [used[np.argmin(off, axis=1) == number] for number in range(len(radii))]
        self._free = [_LinearisedSphere(points, own, None) for own in members]
        self._known = [_LinearisedSphere(points, own, d / 2) for own, d in zip(members, diameters, strict=True)]

    def figures_mm(self, moves: np.ndarray) -> dict[str, float]:
        """Return the evaluation's figures after shifts (N, 3) of all points."""
        free = [fit.shift(moves) for fit in self._free]
        known = [fit.shift(moves)[0] for fit in self._known]
        spheres = [
            replace(
                sphere,
                diameter_mm=sphere.diameter_mm + 2 * by_radius,
                diameter_error_mm=sphere.diameter_error_mm + 2 * by_radius,
                pe_mm=spread_mm(residuals),
                std_mm=float(np.sqrt(residuals @ residuals / (len(residuals) - 4))),
            )
            for sphere, (_, by_radius, residuals) in zip(self._evaluation.spheres, free, strict=True)
        ]
        spacings = []
        for number, spacing in enumerate(self._evaluation.spacings):
            calibrated = spacing.spacing_mm - spacing.sse_mm
            apart = float(np.linalg.norm(free[number + 1][0] - free[number][0]))
            apart_known = float(np.linalg.norm(known[number + 1] - known[number]))
            errors = {"sse_mm": apart - calibrated, "sse_known_radius_mm": apart_known - calibrated}
            spacings.append(replace(spacing, spacing_mm=apart, **errors))
        return replace(self._evaluation, spheres=tuple(spheres), spacings=tuple(spacings)).figures_mm
