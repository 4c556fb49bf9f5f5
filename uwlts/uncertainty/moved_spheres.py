"""Spheres whose points move a little: their figures by one Gauss-Newton step, without a search."""

from dataclasses import dataclass, replace

import numpy as np

from uwlts.metrology.artefact_descriptions import SphereStandard
from uwlts.metrology.evaluation import spread_mm
from uwlts.metrology.sphere_evaluation import SphereEvaluation
from uwlts.metrology.sphere_fit import fit_sphere


@dataclass(frozen=True, eq=False)
class _Fit:
    """A sphere's fit: its points (K,) in the cloud, centre, outward unit vectors (K, 3), residuals (K,), and a step.

    ``solve`` (4 or 3, K) times changes of the residuals is how centre and, where it is free, radius follow them. Moves
    are so small against the radius that the outward vectors stay.
    """

    used: np.ndarray
    centre_mm: np.ndarray
    outward: np.ndarray
    residuals_mm: np.ndarray
    solve: np.ndarray

    @classmethod
    def of(cls, points: np.ndarray, used: np.ndarray, radius_mm: float | None) -> "_Fit":
        fit = fit_sphere(points[used], radius_mm)
        outward = points[used] - fit.centre_mm
        outward /= np.linalg.norm(outward, axis=1, keepdims=True)
        by_parameters = outward if radius_mm is not None else np.column_stack([outward, np.ones(len(used))])
        solve = np.linalg.solve(by_parameters.T @ by_parameters, by_parameters.T)
        return cls(used, fit.centre_mm, outward, fit.residuals_mm, solve)

    def moved(self, moves: np.ndarray) -> tuple[np.ndarray, float, np.ndarray]:
        """Centre (3,), change of the radius (0 where it is known) and residuals (K,) after moves (N, 3)."""
        change = np.einsum("ni,ni->n", self.outward, moves[self.used])
        step = self.solve @ change
        by_radius = float(step[3]) if len(step) > 3 else 0.0
        residuals = self.residuals_mm + change - self.outward @ step[:3] - by_radius
        return self.centre_mm + step[:3], by_radius, residuals


class MovedSpheres:
    """The spheres of an evaluation of points (N, 3), in mm: the same points belong to each wherever they move."""

    def __init__(self, points: np.ndarray, artefact: SphereStandard, evaluation: SphereEvaluation):
        self._evaluation = evaluation
        used = np.flatnonzero(np.isfinite(evaluation.deviation_mm))
        centres = np.array([sphere.centre_mm for sphere in evaluation.spheres])
        radii = np.array([sphere.diameter_mm for sphere in evaluation.spheres]) / 2
        off = np.abs(np.linalg.norm(points[used, None] - centres, axis=2) - radii)
        members = [used[np.argmin(off, axis=1) == number] for number in range(len(radii))]
        self._free = [_Fit.of(points, own, None) for own in members]
        self._known = [_Fit.of(points, own, d / 2) for own, d in zip(members, artefact.diameters_mm, strict=True)]

    def figures_mm(self, moves: np.ndarray) -> dict[str, float]:
        """The evaluation's figures after moves (N, 3) of all points."""
        free = [fit.moved(moves) for fit in self._free]
        known = [fit.moved(moves)[0] for fit in self._known]
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
            spacings.append(
                replace(spacing, spacing_mm=apart, sse_mm=apart - calibrated,
                        sse_known_radius_mm=apart_known - calibrated)
            )  # fmt: skip
        return replace(self._evaluation, spheres=tuple(spheres), spacings=tuple(spacings)).figures_mm
