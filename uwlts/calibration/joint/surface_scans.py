"""What a scan of spheres, a plane or a pipe says: that they have the form, and perhaps the size, that they have.

Along the stage's motion a length is the stage's, across it the camera's and the water's. What is round is as long as it
is wide and high, so that the two are compared without anything calibrated: that tells the index of the water and the
stage's direction. A plane stays one whatever linear map distorts it, and so tells neither; it tells what bends it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from uwlts.calibration.joint.observations import Residuals
from uwlts.calibration.joint.parameters import Parameters, View
from uwlts.calibration.joint.rays import COLUMNS
from uwlts.calibration.joint.surfaces import Surface, leaning
from uwlts.calibration.parameter_keys import StageParameter

SLOPES = (StageParameter.SLOPE_1, StageParameter.SLOPE_2)
"""How far the stage's direction leans from the one described, towards two directions across it."""

# Where the ray's crossing with the sheet moves almost along the surface, a residual in px would be out of all bounds.
_LEAST_SHARE = 0.4


@dataclass(frozen=True, eq=False)
class SurfaceScanEvidence:
    """Stripe pixels on something that stands still while the stage moves the sensor.

    The local parameters are those of the surface, camera frame at the stage position 0, and an error of each of the F
    stage positions.

    Attributes
    ----------
    view : View
    pixels : (N, 2)
    beside_mm : (3, N)
        From the sheet's middle to where their light comes from, camera frame; see `uwlts.brightness`.
    surface : Surface
        On which they lie.
    frame : (N,) int
        In which image each lies, from 0.
    stage_mm : (F,)
        Positions of the stage.
    direction, across_stage : (3,), (2, 3)
        In which growing positions move the sensor as described, and two directions across, orthonormal, camera frame.
    across : {0, 1}
        The coordinate of the pixel that runs across the stripe.
    image : int
        Number of the scan's first image among all of scans.
    source : str
        Name of the capture.
    predicted : (N, 2), optional
        Pixels near those predicted, where rays are taken; as found unless given.
    """

    view: View
    pixels: np.ndarray
    beside_mm: np.ndarray
    surface: Surface
    frame: np.ndarray
    stage_mm: np.ndarray
    direction: np.ndarray
    across_stage: np.ndarray
    across: int
    image: int
    source: str
    predicted: np.ndarray | None = None

    def sources(self) -> dict[int, str]:
        """Where each image comes from."""
        return {self.image + n: f"{self.source}, at {position:g} mm" for n, position in enumerate(self.stage_mm)}

    def local_std(self, *, alignment: float, position_mm: float) -> np.ndarray:
        """Standard uncertainty (k + F,) of the local parameters before; infinite where nothing is known."""
        return np.concatenate([self.surface.local_std(), np.full(len(self.stage_mm), position_mm)])

    def residuals(self, parameters: Parameters, global_values: np.ndarray, local: np.ndarray) -> list[Residuals] | None:
        """Those of each image; None where a ray misses the sheet."""
        at_px = self.pixels if self.predicted is None else self.predicted
        points = parameters.on_sheet(global_values, self.view, at_px)
        if points is None:
            return None
        count = len(local) - len(self.stage_mm)
        direction, by_slopes = self._direction(parameters, global_values)
        nominal = self.stage_mm[self.frame]
        travel = nominal * (1.0 + parameters.value(global_values, StageParameter.SCALE)) + local[count:][self.frame]
        off = self.surface.distances(points.points + self.beside_mm + direction[:, None] * travel, local[:count])
        by_rays = np.einsum("in,cin->cn", off.outward, points.by_rays)
        by_global = parameters.by_global(by_rays, self.view, np.einsum("in,cin->cn", off.outward, points.by_sheet))
        by_position = direction @ off.outward
        parameters.add(by_global, StageParameter.SCALE, by_position * nominal)
        for key, by in zip(SLOPES, by_slopes, strict=True):
            parameters.add(by_global, key, (by @ off.outward) * travel)
        column = COLUMNS.index("uv"[self.across])
        least = _LEAST_SHARE * np.linalg.norm(points.by_rays[column], axis=0)
        per_px = np.copysign(np.maximum(np.abs(by_rays[column]), least), by_rays[column])
        values = (self.pixels - at_px)[:, self.across] * (by_rays[column] / per_px) + off.values_mm / per_px
        by_local = np.column_stack([off.by_local, by_position])
        found = []
        for number in np.unique(self.frame):
            here = self.frame == number
            found.append(
                Residuals(
                    kind=self.surface.kind,
                    values=values[here],
                    by_global=by_global[here] / per_px[here, None],
                    by_local=by_local[here] / per_px[here, None],
                    local_columns=np.append(np.arange(count), count + number),
                    image=self.image + int(number),
                )
            )
        return found

    def known_lengths(self, local: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """What calibrated lengths are off (c,), in standard uncertainties, and derivatives (c, k) by the surface's."""
        return self.surface.known_lengths(local[: len(local) - len(self.stage_mm)])

    def linearised(self, residuals: Sequence[Residuals], used: Sequence[np.ndarray]) -> "SurfaceScanEvidence":
        """The same with rays taken at the pixels that these residuals predict, but as found where not ``used`` (n,)."""
        predicted = self.pixels.copy()
        for part, kept in zip(residuals, used, strict=True):
            predicted[self.frame == part.image - self.image, self.across] -= np.where(kept, part.values, 0.0)
        return replace(self, predicted=predicted)

    def moved_direction(self, parameters: Parameters, global_values: np.ndarray) -> np.ndarray:
        """The stage's direction (3,), camera frame."""
        return self._direction(parameters, global_values)[0]

    def _direction(self, parameters: Parameters, global_values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The stage's direction (3,) and its derivatives (2, 3) by the slopes."""
        slopes = np.array([parameters.value(global_values, key) for key in SLOPES])
        return leaning(self.direction, self.across_stage, slopes)


def across_of(direction: np.ndarray) -> np.ndarray:
    """Two unit vectors (2, 3) across a direction of the OCS and each other; along Y and Z for a motion along X."""
    second = np.cross((0.0, 0.0, 1.0) if abs(direction[2]) < 0.9 else (1.0, 0.0, 0.0), direction)
    second /= np.linalg.norm(second)
    return np.stack([second, np.cross(direction, second)])
