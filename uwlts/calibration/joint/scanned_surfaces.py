"""Scans of spheres, planes and pipes as evidence: distances of points from the surface, and derivatives."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar, Self

import numpy as np
from scipy import sparse

from uwlts.calibration.joint.parameters import Parameters
from uwlts.calibration.joint.residuals import Distances, Residuals, StripeEvidence
from uwlts.fitting.local_surface import group_rows
from uwlts.fitting.schur_least_squares import LocalPrior
from uwlts.model.parameter_keys import StageParameter
from uwlts.model.sensor import Uncertainty
from uwlts.optics.window import tilt_direction


@dataclass(frozen=True, eq=False)
class Sizes:
    """Described sizes (c,) in mm with their ``names``, and their deviations by the local parameters.

    ``off_mm`` are the estimated sizes minus ``described_mm``, ``by_local`` (c, k) the derivatives. ``std_mm`` is the
    stated standard uncertainty, infinite for an unknown size.
    """

    names: tuple[str, ...]
    described_mm: np.ndarray
    std_mm: np.ndarray
    off_mm: np.ndarray
    by_local: np.ndarray

    def residuals(self) -> tuple[np.ndarray, np.ndarray]:
        """Return deviations of known sizes in standard uncertainties (n,), and derivatives (n, k)."""
        known = np.isfinite(self.std_mm)
        std = self.std_mm[known]
        return self.off_mm[known] / std, self.by_local[known] / std[:, None]


@dataclass(frozen=True, eq=False)
class ScannedSpheres:
    """S spheres. Local parameters: centres in mm, then deviations of the diameters from ``diameters_mm`` (S,).

    ``spacings_mm`` (S - 1,) are the distances of consecutive centres. Standard uncertainties are infinite for unknown
    sizes. ``sphere`` (N,) is the sphere of each pixel of the scan. As all surfaces, they are given in the camera frame
    at the stage position 0.
    """

    kind: ClassVar[str] = "stripe on the spheres"  # name of the residuals

    diameters_mm: np.ndarray
    diameter_std_mm: np.ndarray
    spacings_mm: np.ndarray
    spacing_std_mm: np.ndarray
    sphere: np.ndarray

    @property
    def count(self) -> int:
        """Number of bodies."""
        return len(self.diameters_mm)

    @property
    def parameter_count(self) -> int:
        """Number k of local parameters, known before only by `sizes`."""
        return 4 * self.count

    def distances(self, points: np.ndarray, local: np.ndarray) -> Distances:
        """Return the distances of points (3, N) of the scan's pixels, in their order."""
        offset = points - self._read_centres(local)[self.sphere].T
        distance = np.linalg.norm(offset, axis=0)
        outward = offset / distance
        radius = 0.5 * (self.diameters_mm + local[3 * self.count :])[self.sphere]
        by_local, rows = np.zeros((len(distance), len(local))), np.arange(len(distance))
        for axis in range(3):
            by_local[rows, 3 * self.sphere + axis] = -outward[axis]
        by_local[rows, 3 * self.count + self.sphere] = -0.5
        return Distances(distance - radius, outward, by_local)

    def sizes(self, local: np.ndarray) -> Sizes:
        """Return the described sizes; empty for a surface without a size."""
        differences = np.diff(self._read_centres(local), axis=0)
        length = np.linalg.norm(differences, axis=1)
        by_local = np.zeros((self.count + len(length), len(local)))
        by_local[: self.count, 3 * self.count :] = np.eye(self.count)
        for number, unit in enumerate(differences / length[:, None]):
            by_local[self.count + number, 3 * number : 3 * number + 6] = np.concatenate([-unit, unit])
        spheres = range(1, self.count + 1)
        return Sizes(
            (
                *(f"diameter of sphere {n}" for n in spheres),
                *(f"spacing of spheres {n} and {n + 1}" for n in spheres[:-1]),
            ),
            np.append(self.diameters_mm, self.spacings_mm),
            np.append(self.diameter_std_mm, self.spacing_std_mm),
            np.append(local[3 * self.count :], length - self.spacings_mm),
            by_local,
        )

    def free_sizes(self) -> Self:
        """Return the surface with unknown sizes."""
        unknown = {name: np.full_like(getattr(self, name), np.inf) for name in ("diameter_std_mm", "spacing_std_mm")}
        return replace(self, **unknown)

    def _read_centres(self, local: np.ndarray) -> np.ndarray:
        return local[: 3 * self.count].reshape(-1, 3)


@dataclass(frozen=True, eq=False)
class ScannedPlane:
    """Plane near the one through ``point_mm`` (3,) with the unit ``normal`` (3,).

    Local parameters: two slopes of its normal towards the unit vectors ``across`` (2, 3), and its distance in mm from
    the point. The unit vectors are perpendicular to ``normal`` and each other.
    """

    kind: ClassVar[str] = "stripe on the plane"
    count: ClassVar[int] = 1
    parameter_count: ClassVar[int] = 3

    point_mm: np.ndarray
    normal: np.ndarray
    across: np.ndarray

    def distances(self, points: np.ndarray, local: np.ndarray) -> Distances:
        normal, by_slopes = tilt_direction(self.normal, self.across, local[:2])
        offset = points - self.point_mm[:, None]
        by_local = np.column_stack([(by_slopes @ offset).T, np.full(points.shape[1], -1.0)])
        return Distances(normal @ offset - local[2], np.broadcast_to(normal[:, None], points.shape), by_local)

    def sizes(self, local: np.ndarray) -> Sizes:
        return Sizes((), np.empty(0), np.empty(0), np.empty(0), np.empty((0, len(local))))

    def free_sizes(self) -> Self:
        return self


@dataclass(frozen=True, eq=False)
class ScannedPipe:
    """Cylinder near the one with the unit ``axis`` (3,) through ``point_mm`` (3,), seen from outside or inside.

    Local parameters: two shifts of its axis in mm at the point and two slopes, along the unit vectors ``across`` (2,
    3), and the deviation from ``diameter_mm``. The unit vectors are perpendicular to ``axis`` and each other. The
    standard uncertainty of the diameter is infinite if unknown.
    """

    kind: ClassVar[str] = "stripe on the pipe"
    count: ClassVar[int] = 1
    parameter_count: ClassVar[int] = 5

    point_mm: np.ndarray
    axis: np.ndarray
    across: np.ndarray
    diameter_mm: float
    diameter_std_mm: float

    def sizes(self, local: np.ndarray) -> Sizes:
        described, std = np.array([self.diameter_mm]), np.array([self.diameter_std_mm])
        return Sizes(("diameter of the pipe",), described, std, local[4:], np.eye(5)[4:])

    def free_sizes(self) -> Self:
        return replace(self, diameter_std_mm=np.inf)

    def distances(self, points: np.ndarray, local: np.ndarray) -> Distances:
        axis, by_slopes = tilt_direction(self.axis, self.across, local[2:4])
        offset = points - (self.point_mm + local[:2] @ self.across)[:, None]
        along = axis @ offset
        radial = offset - axis[:, None] * along
        distance = np.linalg.norm(radial, axis=0)
        outward = radial / distance
        by_slopes = -(along * (by_slopes @ outward)).T
        by_local = np.column_stack([-(self.across @ outward).T, by_slopes, np.full(len(distance), -0.5)])
        return Distances(distance - 0.5 * (self.diameter_mm + local[4]), outward, by_local)


Surface = ScannedSpheres | ScannedPlane | ScannedPipe
SCANNED = (ScannedSpheres.kind, ScannedPlane.kind, ScannedPipe.kind)
"""Names of residuals on these surfaces."""
SLOPES = (StageParameter.SLOPE_1, StageParameter.SLOPE_2)
"""Slopes of the stage's direction relative to the described one, towards two perpendicular directions."""
# Limits residuals in px of points that move nearly along the surface if the pixel changes.
LEAST_SHARE = 0.4


@dataclass(frozen=True, eq=False, kw_only=True)
class SurfaceScanEvidence(StripeEvidence):
    """Stripe pixels on a surface that stands still while the stage moves the sensor.

    The local parameters are those of the surface (camera frame at the stage position 0), and an error of each of the F
    stage positions ``stage_mm``.
    """

    beside_mm: np.ndarray
    """(3, N); offset of the light's origin from the sheet's middle, camera frame (`uwlts.optics.brightness`)."""
    common_px: np.ndarray
    """(N,); standard uncertainty of remaining brightness and blur errors, common to all points of a body."""
    surface: Surface
    frame: np.ndarray  # (N,) int; image number of each pixel, from 0
    stage_mm: np.ndarray
    # (3,), (2, 3); described direction of the sensor at increasing positions, and two perpendicular directions,
    # orthonormal, camera frame.
    direction: np.ndarray
    across_stage: np.ndarray
    image: int  # number of the scan's first image among those of all scans

    def scan(self) -> str:
        """Return the name of the scan's capture."""
        return self.sources[self.image].rsplit(", at ", 1)[0]

    def local_std(self, uncertainty: Uncertainty) -> np.ndarray:
        positions = np.full(len(self.stage_mm), uncertainty.stage_position_mm)
        return np.append(np.full(self.surface.parameter_count, np.inf), positions)

    def known_before(self, local: np.ndarray, uncertainty: Uncertainty) -> LocalPrior:
        known = super().known_before(local, uncertainty)
        sizes, by_surface = self.surface.sizes(local[: -len(self.stage_mm)]).residuals()
        by_sizes = np.pad(by_surface, ((0, 0), (0, len(self.stage_mm))))
        return LocalPrior(
            np.append(known.residuals, sizes[:, None], axis=0),
            sparse.csr_array(sparse.vstack([known.by_local, sparse.csr_array(by_sizes)])),
        )

    @cached_property
    def _pixels_of_frame(self) -> dict[int, np.ndarray]:
        return group_rows(self.frame)

    def stripe_pixels(self, image: int) -> np.ndarray | slice:
        return self._pixels_of_frame[image - self.image]

    def residuals(self, parameters: Parameters, global_values: np.ndarray, local: np.ndarray) -> list[Residuals] | None:
        points = self.on_sheet(parameters, global_values).points()
        if points is None:
            return None
        count = len(local) - len(self.stage_mm)
        direction, by_slopes = self.stage_direction(parameters, global_values)
        nominal = self.stage_mm[self.frame]
        travel = nominal * (1.0 + parameters.value(global_values, StageParameter.SCALE)) + local[count:][self.frame]
        off = self.surface.distances(points.points + self.beside_mm + direction[:, None] * travel, local[:count])
        by_position = direction @ off.outward
        by_global = {key: (by @ off.outward) * travel for key, by in zip(SLOPES, by_slopes, strict=True)}
        off = replace(
            off,
            by_local=np.column_stack([off.by_local, by_position]),
            by_global=by_global | {StageParameter.SCALE: by_position * nominal},
        )
        kind, surface_columns, found = self.surface.kind, np.arange(count), []
        of_all = self.stripe_residuals(
            parameters, points, off, kind=kind, local_columns=surface_columns, image=self.image, least_share=LEAST_SHARE
        )
        for number, here in self._pixels_of_frame.items():
            columns = np.append(surface_columns, count + number)
            rows = of_all.values[here], of_all.by_global[here], of_all.by_local[here]
            found.append(Residuals(kind, *rows, columns, self.image + number))
        return found

    def stage_direction(self, parameters: Parameters, global_values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the stage's direction (3,), camera frame, and its derivatives (2, 3) by the slopes."""
        slopes = np.array([parameters.value(global_values, key) for key in SLOPES])
        return tilt_direction(self.direction, self.across_stage, slopes)


def perpendicular_directions(direction: np.ndarray) -> np.ndarray:
    """Return two unit vectors (2, 3) perpendicular to a direction and each other; Y and Z for a motion along X."""
    second = np.cross((0.0, 0.0, 1.0) if abs(direction[2]) < 0.9 else (1.0, 0.0, 0.0), direction)
    second /= np.linalg.norm(second)
    return np.stack([second, np.cross(direction, second)])
