"""Spheres after VDI/VDE 2634: probing error and sphere spacing error."""

from dataclasses import dataclass
from itertools import pairwise, permutations
from typing import ClassVar

import numpy as np

from uwlts.errors import EvaluationError
from uwlts.metrology.artefact_descriptions import SphereStandard
from uwlts.metrology.evaluation import TOWARDS_SENSOR, ArtefactEvaluation, FigureId, Quantity, spread_mm
from uwlts.metrology.robust_fit import RobustFit, fit_robustly
from uwlts.metrology.round_fits import SphereFit, fit_sphere
from uwlts.metrology.sphere_search import LEAST_POINTS, FoundSphere, find_sphere

# Orders of the spheres whose misfit to the calibrated sizes differs by less than this share of the smallest diameter
# are equally good: measurement errors would decide between them.
_SAME_SIZE = 0.005


@dataclass(frozen=True)
class SphereResult:
    """One sphere, mm. `std` names are standard uncertainties from the scatter of the points alone.

    Attributes
    ----------
    centre_mm : tuple of float
        Of the free-radius fit, OCS.
    pe_mm : float
        Probing error: range of the radial residuals of the free-radius fit.
    std_mm : float
        Standard deviation of those residuals.
    points_mixed : int
        Points left aside where another surface crosses the sphere.
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
    """Distance of two consecutive centres, mm: of the free-radius fits, and its error with the known radii too."""

    spacing_mm: float
    sse_mm: float
    sse_known_radius_mm: float
    spacing_std_mm: float


@dataclass(frozen=True, eq=False, kw_only=True)
class SphereEvaluation(ArtefactEvaluation):
    """Spheres in the order of the artefact's description, and the spacings between consecutive ones."""

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
        """Largest standard deviation of the radial residuals of one sphere."""
        return max(sphere.std_mm for sphere in self.spheres)

    @property
    def sse_mm(self) -> float | None:
        """Sphere spacing error of the largest size, with its sign; None for a single sphere."""
        return max((spacing.sse_mm for spacing in self.spacings), key=abs, default=None)

    def values_mm(self) -> dict[FigureId, float | None]:
        values: dict[FigureId, float | None] = {
            (Quantity.PROBING_ERROR, ()): self.pe_mm,
            (Quantity.STD, ()): self.std_mm,
        }
        for number, sphere in enumerate(self.spheres, start=1):
            values[Quantity.PROBING_ERROR, (number,)] = sphere.pe_mm
            values[Quantity.STD, (number,)] = sphere.std_mm
            values[Quantity.DIAMETER_ERROR, (number,)] = sphere.diameter_error_mm
        for number, spacing in enumerate(self.spacings, start=1):
            values[Quantity.SPACING_ERROR, (number, number + 1)] = spacing.sse_mm
            values[Quantity.SPACING_ERROR_KNOWN_RADIUS, (number, number + 1)] = spacing.sse_known_radius_mm
        return values


def evaluate_spheres(points: np.ndarray, artefact: SphereStandard, *, seed: int = 0) -> SphereEvaluation:
    """Find the spheres in points (N, 3), mm, OCS, and evaluate them.

    Raises
    ------
    EvaluationError
        Fewer spheres than the artefact has; the message says which were found and where. Or they are hollow, as
        turned images make them.
    """
    found = _in_order(_found_spheres(points, artefact, np.random.default_rng(seed)), artefact)
    deviation = np.full(len(points), np.nan)
    spheres, fits = [], []
    for sphere, diameter in zip(found, artefact.diameters_mm, strict=True):
        members, robust = _within_cap(points, sphere, artefact.cap_angle_deg)
        used = members[robust.inliers]
        if np.mean((points[used] - robust.fit.centre_mm) @ TOWARDS_SENSOR) < 0:
            raise EvaluationError(
                "the spheres are hollow: their points lie behind their centres, where the sensor cannot see them. Are "
                "the images turned by 180 deg or mirrored against those of the calibration?"
            )
        deviation[used] = robust.fit.residuals_mm
        fits.append((robust.fit, fit_sphere(points[used], diameter / 2)))
        spheres.append(
            SphereResult(
                centre_mm=tuple(robust.fit.centre_mm.tolist()),
                diameter_mm=2 * robust.fit.radius_mm,
                diameter_error_mm=2 * robust.fit.radius_mm - diameter,
                diameter_std_mm=2 * float(np.sqrt(robust.fit.covariance[3, 3])),
                pe_mm=spread_mm(robust.fit.residuals_mm),
                std_mm=robust.fit.std_mm,
                points_used=len(used),
                points_rejected=robust.rejected,
                points_mixed=sphere.points_mixed,
            )
        )
    pairs = zip(pairwise(fits), artefact.spacings_mm, strict=True)
    return SphereEvaluation(
        artefact=artefact,
        points_used=sum(sphere.points_used for sphere in spheres),
        points_rejected=sum(sphere.points_rejected for sphere in spheres),
        deviation_mm=deviation,
        spheres=tuple(spheres),
        spacings=tuple(_spacing(first, second, calibrated) for (first, second), calibrated in pairs),
    )


def _found_spheres(points: np.ndarray, artefact: SphereStandard, rng: np.random.Generator) -> list[FoundSphere]:
    usable = np.ones(len(points), dtype=bool)
    found: list[FoundSphere] = []
    for diameter in artefact.diameters_mm:
        sphere = find_sphere(points, diameter / 2, usable=usable, rng=rng)
        if sphere is None:
            places = [
                "{:.2f} mm at ({:.1f}, {:.1f}, {:.1f}) with {} points".format(
                    2 * other.robust.fit.radius_mm, *other.robust.fit.centre_mm, len(other.used)
                )
                for other in found
            ]
            raise EvaluationError(
                f"{len(found)} of {len(artefact.diameters_mm)} spheres found among {len(points)} points"
                f"{': ' + ', '.join(places) if places else ''}; no other surface has a diameter near {diameter:g} mm "
                f"on at least {LEAST_POINTS} points. Scan all spheres of the artefact, or correct its description"
            )
        found.append(sphere)
        usable &= ~sphere.near
    return found


def _in_order(found: list[FoundSphere], artefact: SphereStandard) -> list[FoundSphere]:
    """The spheres in the order of the description: by sizes and spacings, and by position where those are equal."""
    centres = np.array([sphere.robust.fit.centre_mm for sphere in found])
    diameters = np.array([2 * sphere.robust.fit.radius_mm for sphere in found])
    along = int(np.ptp(centres[:, 1]) >= np.ptp(centres[:, 0]))
    orders = [list(order) for order in permutations(range(len(found)))]
    misfits = np.array(
        [
            max(
                np.abs(diameters[order] - artefact.diameters_mm).max(),
                np.abs(np.linalg.norm(np.diff(centres[order], axis=0), axis=1) - np.array(artefact.spacings_mm)).max(
                    initial=0.0
                ),
            )
            for order in orders
        ]
    )
    equal = np.flatnonzero(misfits <= misfits.min() + _SAME_SIZE * min(artefact.diameters_mm))
    best = max(equal, key=lambda number: centres[orders[number][-1], along] - centres[orders[number][0], along])
    return [found[position] for position in orders[best]]


def _within_cap(
    points: np.ndarray, sphere: FoundSphere, cap_angle_deg: float | None
) -> tuple[np.ndarray, RobustFit[SphereFit]]:
    if cap_angle_deg is None:
        return sphere.members, sphere.robust
    away = points[sphere.members] - sphere.robust.fit.centre_mm
    cosine = away @ TOWARDS_SENSOR / np.linalg.norm(away, axis=1)
    members = sphere.members[cosine >= np.cos(np.radians(cap_angle_deg))]
    if len(members) < LEAST_POINTS:
        raise EvaluationError(
            f"only {len(members)} of {len(away)} points of the sphere lie within {cap_angle_deg:g} deg of the point "
            f"that faces the sensor (-Z); {LEAST_POINTS} are needed. Widen cap_angle_deg"
        )
    return members, fit_robustly(fit_sphere, points[members])


def _spacing(
    first: tuple[SphereFit, SphereFit], second: tuple[SphereFit, SphereFit], calibrated: float
) -> SpacingResult:
    (free_1, known_1), (free_2, known_2) = first, second
    between = free_2.centre_mm - free_1.centre_mm
    spacing = float(np.linalg.norm(between))
    direction = between / spacing
    variance = direction @ (free_1.covariance + free_2.covariance)[:3, :3] @ direction
    return SpacingResult(
        spacing_mm=spacing,
        sse_mm=spacing - calibrated,
        sse_known_radius_mm=float(np.linalg.norm(known_2.centre_mm - known_1.centre_mm)) - calibrated,
        spacing_std_mm=float(np.sqrt(variance)),
    )
