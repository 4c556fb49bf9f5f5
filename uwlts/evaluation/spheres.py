"""Detection of spheres of known radius in clouds, and their evaluation by VDI/VDE 2634."""

from dataclasses import dataclass
from itertools import pairwise, permutations
from typing import ClassVar

import numpy as np

from uwlts.errors import EvaluationError
from uwlts.evaluation.figures import TOWARDS_SENSOR, ArtefactEvaluation, FigureId, Quantity, spread_mm
from uwlts.fitting.least_squares import RobustFit, fit_robustly
from uwlts.model.artefacts import SphereStandard
from uwlts.shapes.sphere import LEAST_POINTS, FoundSphere, Sphere

_SAME_SIZE = 0.005
"""Difference in misfit, relative to the smallest diameter, below which two orders of spheres are equivalent."""


@dataclass(frozen=True)
class SphereResult:
    """Sphere measured by its fit of free radius, mm, OCS.

    The probing error ``pe_mm`` is the range of the radial residuals, ``std_mm`` their standard deviation.
    ``diameter_std_mm`` is the standard uncertainty by the scatter of the points alone. ``points_mixed`` counts points
    that were excluded because another surface crosses the sphere there.
    """

    centre_mm: tuple[float, float, float]
    diameter_mm: float
    diameter_error_mm: float
    diameter_std_mm: float
    pe_mm: float
    std_mm: float
    points_used: int
    points_rejected: int
    points_mixed: int


@dataclass(frozen=True)
class SpacingResult:
    """Distance of two consecutive centres, mm, with its error for fits of free and of known radius."""

    spacing_mm: float
    sse_mm: float
    sse_known_radius_mm: float
    spacing_std_mm: float


@dataclass(frozen=True, eq=False, kw_only=True)
class SphereEvaluation(ArtefactEvaluation):
    """Evaluation of spheres in the order of the artefact's description, and of their consecutive spacings."""

    kind: ClassVar[str] = "spheres"

    artefact: SphereStandard
    spheres: tuple[SphereResult, ...]
    spacings: tuple[SpacingResult, ...]

    @property
    def pe_mm(self) -> float:
        """Probing error of the worst sphere."""
        return max(sphere.pe_mm for sphere in self.spheres)

    @property
    def std_mm(self) -> float:
        """Largest standard deviation of the radial residuals of a sphere."""
        return max(sphere.std_mm for sphere in self.spheres)

    @property
    def sse_mm(self) -> float | None:
        """Signed sphere spacing error of the largest absolute value; None for a single sphere."""
        return max((spacing.sse_mm for spacing in self.spacings), key=abs, default=None)

    def values_mm(self) -> dict[FigureId, float | None]:
        kind = Quantity
        values: dict[FigureId, float | None] = {(kind.PROBING_ERROR, ()): self.pe_mm, (kind.STD, ()): self.std_mm}
        for number, sphere in enumerate(self.spheres, start=1):
            values[kind.PROBING_ERROR, (number,)] = sphere.pe_mm
            values[kind.STD, (number,)] = sphere.std_mm
            values[kind.DIAMETER_ERROR, (number,)] = sphere.diameter_error_mm
        for number, spacing in enumerate(self.spacings, start=1):
            values[kind.SPACING_ERROR, (number, number + 1)] = spacing.sse_mm
            values[kind.SPACING_ERROR_KNOWN_RADIUS, (number, number + 1)] = spacing.sse_known_radius_mm
        return values


def evaluate_spheres(points: np.ndarray, artefact: SphereStandard) -> SphereEvaluation:
    """Find the spheres in points (N, 3), mm, in the OCS, and evaluate them.

    EvaluationError for missing spheres, or for hollow spheres, which indicate rotated images.
    """
    found = _sort_spheres(_find_spheres(points, artefact, np.random.default_rng(0)), artefact)
    deviation = np.full(len(points), np.nan)
    spheres, fits = [], []
    for sphere, diameter in zip(found, artefact.diameters_mm, strict=True):
        members, robust = _fit_cap(points, sphere, artefact.cap_angle_deg)
        used, fit = members[robust.inliers], robust.fit
        if np.mean((points[used] - fit.centre_mm) @ TOWARDS_SENSOR) < 0:
            raise EvaluationError(
                "the spheres are hollow: their points are behind their centres, where the sensor cannot see them. The "
                "images may be rotated by 180 deg or mirrored relative to those of the calibration"
            )
        deviation[used] = fit.residuals_mm
        fits.append((fit, Sphere.fit(points[used], diameter / 2)))
        spheres.append(
            SphereResult(
                centre_mm=tuple(fit.centre_mm.tolist()),
                diameter_mm=2 * fit.radius_mm,
                diameter_error_mm=2 * fit.radius_mm - diameter,
                diameter_std_mm=2 * float(np.sqrt(fit.covariance[3, 3])),
                pe_mm=spread_mm(fit.residuals_mm),
                std_mm=fit.std_mm,
                points_used=len(used),
                points_rejected=robust.rejected,
                points_mixed=sphere.points_mixed,
            )
        )
    spacings = []
    for ((free_1, known_1), (free_2, known_2)), calibrated in zip(pairwise(fits), artefact.spacings_mm, strict=True):
        between = free_2.centre_mm - free_1.centre_mm
        spacing = float(np.linalg.norm(between))
        direction = between / spacing
        variance = direction @ (free_1.covariance + free_2.covariance)[:3, :3] @ direction
        by_known = float(np.linalg.norm(known_2.centre_mm - known_1.centre_mm)) - calibrated
        spacings.append(SpacingResult(spacing, spacing - calibrated, by_known, float(np.sqrt(variance))))
    counts = sum(each.points_used for each in spheres), sum(each.points_rejected for each in spheres)
    return SphereEvaluation(
        artefact=artefact,
        points_used=counts[0],
        points_rejected=counts[1],
        deviation_mm=deviation,
        spheres=tuple(spheres),
        spacings=tuple(spacings),
        points_excluded=sum(len(sphere.members) for sphere in found) - sum(counts),
    )


def _find_spheres(points: np.ndarray, artefact: SphereStandard, rng: np.random.Generator) -> list[FoundSphere]:
    usable = np.ones(len(points), dtype=bool)
    found: list[FoundSphere] = []
    for diameter in artefact.diameters_mm:
        sphere = Sphere.find(points, diameter / 2, usable=usable, rng=rng)
        if sphere is None:
            place = "{:.2f} mm at ({:.1f}, {:.1f}, {:.1f}) with {} points".format
            fits = [(robust.fit, len(robust.inliers) - robust.rejected) for robust in (other.robust for other in found)]
            places = ", ".join(place(2 * fit.radius_mm, *fit.centre_mm, count) for fit, count in fits)
            raise EvaluationError(
                f"{len(found)} of {len(artefact.diameters_mm)} spheres found among {len(points)} points"
                f"{places and ': ' + places}; no other surface has a diameter near {diameter:g} mm "
                f"on at least {LEAST_POINTS} points. Scan all spheres of the artefact, or correct its description"
            )
        found.append(sphere)
        usable &= ~sphere.near
    return found


def _sort_spheres(found: list[FoundSphere], artefact: SphereStandard) -> list[FoundSphere]:
    """Sort the spheres in the order of the description by sizes and spacings; equivalent orders by position."""
    centres = np.array([sphere.robust.fit.centre_mm for sphere in found])
    diameters = np.array([2 * sphere.robust.fit.radius_mm for sphere in found])
    along = int(np.ptp(centres[:, 1]) >= np.ptp(centres[:, 0]))
    orders = np.array(list(permutations(range(len(found)))))
    spacings = np.linalg.norm(np.diff(centres[orders], axis=1), axis=2)
    sizes, calibrated = np.hstack([diameters[orders], spacings]), [*artefact.diameters_mm, *artefact.spacings_mm]
    misfits = np.abs(sizes - np.array(calibrated)).max(axis=1)
    equal = np.flatnonzero(misfits <= misfits.min() + _SAME_SIZE * min(artefact.diameters_mm))
    best = max(equal, key=lambda number: centres[orders[number][-1], along] - centres[orders[number][0], along])
    return [found[position] for position in orders[best]]


def _fit_cap(
    points: np.ndarray, sphere: FoundSphere, cap_angle_deg: float | None
) -> tuple[np.ndarray, RobustFit[Sphere]]:
    if cap_angle_deg is None:
        return sphere.members, sphere.robust
    away = points[sphere.members] - sphere.robust.fit.centre_mm
    cosine = away @ TOWARDS_SENSOR / np.linalg.norm(away, axis=1)
    members = sphere.members[cosine >= np.cos(np.radians(cap_angle_deg))]
    if len(members) < LEAST_POINTS:
        raise EvaluationError(
            f"only {len(members)} of {len(away)} points of the sphere are within {cap_angle_deg:g} deg of the point "
            f"nearest to the sensor (-Z); {LEAST_POINTS} are needed. Increase cap_angle_deg"
        )
    return members, fit_robustly(Sphere.fit, points[members])
