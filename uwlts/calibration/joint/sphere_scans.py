"""What a scan of spheres says: that they are round tells the index of the water and the stage's direction.

Along the stage's motion a length is the stage's, across it the camera's and the water's. A sphere of whatever size is
as long as it is wide and high, so that the two are compared without anything calibrated.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from uwlts.calibration.joint.observations import Residuals
from uwlts.calibration.joint.parameters import Parameters, View
from uwlts.calibration.joint.rays import COLUMNS

SPHERE = "stripe on the spheres"
SLOPES = ("scan_slope_1", "scan_slope_2")
"""How far the stage's direction leans from the one described, towards two directions across it."""

# Where the ray's crossing with the sheet moves almost along the sphere, a residual in px would be out of all bounds.
_LEAST_SHARE = 0.4


@dataclass(frozen=True, eq=False)
class SphereScanEvidence:
    """Stripe pixels on spheres that stand still while the stage moves the sensor.

    The own parameters are the S centres in mm, camera frame at the stage position 0, what the S diameters are more than
    ``diameters_mm``, and an error of each of the F stage positions.

    Attributes
    ----------
    view : View
    pixels : (N, 2)
    sphere, frame : (N,) int
        On which sphere and in which image each lies, from 0.
    stage_mm : (F,)
        Positions of the stage.
    direction, across_stage : (3,), (2, 3)
        In which growing positions move the sensor as described, and two directions across, orthonormal, camera frame.
    diameters_mm, diameter_std_mm : (S,)
        As known before; the standard uncertainty is infinite for unknown ones.
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
    sphere: np.ndarray
    frame: np.ndarray
    stage_mm: np.ndarray
    direction: np.ndarray
    across_stage: np.ndarray
    diameters_mm: np.ndarray
    diameter_std_mm: np.ndarray
    across: int
    image: int
    source: str
    predicted: np.ndarray | None = None

    def sources(self) -> dict[int, str]:
        """Where each image comes from."""
        return {self.image + n: f"{self.source}, at {position:g} mm" for n, position in enumerate(self.stage_mm)}

    def own_std(self, *, alignment: float, position_mm: float) -> np.ndarray:
        """Standard uncertainty (4 S + F,) of the own parameters before; infinite for the centres."""
        spheres = len(self.diameters_mm)
        return np.concatenate(
            [np.full(3 * spheres, np.inf), self.diameter_std_mm, np.full(len(self.stage_mm), position_mm)]
        )

    def residuals(self, parameters: Parameters, shared: np.ndarray, own: np.ndarray) -> list[Residuals] | None:
        """Those of each image; None where a ray misses the sheet."""
        at_px = self.pixels if self.predicted is None else self.predicted
        points = parameters.on_sheet(shared, self.view, at_px)
        if points is None:
            return None
        spheres = len(self.diameters_mm)
        direction, by_slopes = self._direction(parameters, shared)
        nominal = self.stage_mm[self.frame]
        scale = 1.0 + parameters.value(shared, "stage_scale")
        travel = nominal * scale + own[4 * spheres :][self.frame]
        centres = own[: 3 * spheres].reshape(-1, 3)[self.sphere].T
        away = points.points + direction[:, None] * travel - centres
        distance = np.linalg.norm(away, axis=0)
        outward = away / distance
        radius = 0.5 * (self.diameters_mm + own[3 * spheres : 4 * spheres])[self.sphere]
        by_rays = np.einsum("in,cin->cn", outward, points.by_rays)
        by_shared = parameters.by_shared(by_rays, self.view, np.einsum("in,cin->cn", outward, points.by_sheet))
        parameters.add(by_shared, "stage_scale", (direction @ outward) * nominal)
        for name, by in zip(SLOPES, by_slopes, strict=True):
            parameters.add(by_shared, name, (by @ outward) * travel)
        column = COLUMNS.index("uv"[self.across])
        least = _LEAST_SHARE * np.linalg.norm(points.by_rays[column], axis=0)
        per_px = np.copysign(np.maximum(np.abs(by_rays[column]), least), by_rays[column])
        values = (self.pixels - at_px)[:, self.across] * (by_rays[column] / per_px) + (distance - radius) / per_px
        found = []
        for number in np.unique(self.frame):
            here = np.flatnonzero(self.frame == number)
            own_here, by_own = self._by_own(here, outward, direction, int(number))
            found.append(
                Residuals(
                    kind=SPHERE,
                    values=values[here],
                    by_shared=by_shared[here] / per_px[here, None],
                    by_own=by_own / per_px[here, None],
                    own=own_here,
                    image=self.image + int(number),
                )
            )
        return found

    def linearised(self, residuals: Sequence[Residuals], used: Sequence[np.ndarray]) -> "SphereScanEvidence":
        """The same with rays taken at the pixels that these residuals predict, but as found where not ``used`` (n,)."""
        predicted = self.pixels.copy()
        for part, kept in zip(residuals, used, strict=True):
            predicted[self.frame == part.image - self.image, self.across] -= np.where(kept, part.values, 0.0)
        return replace(self, predicted=predicted)

    def moved_direction(self, parameters: Parameters, shared: np.ndarray) -> np.ndarray:
        """The stage's direction (3,), camera frame."""
        return self._direction(parameters, shared)[0]

    def _direction(self, parameters: Parameters, shared: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The stage's direction (3,) and its derivatives (2, 3) by the slopes."""
        slopes = np.array([parameters.value(shared, name) for name in SLOPES])
        raw = self.direction + slopes @ self.across_stage
        length = np.linalg.norm(raw)
        direction = raw / length
        return direction, (self.across_stage - np.outer(self.across_stage @ direction, direction)) / length

    def _by_own(
        self, here: np.ndarray, outward: np.ndarray, direction: np.ndarray, number: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """Which own parameters matter in an image, and the derivatives (n, c) of the miss in mm by them."""
        spheres = len(self.diameters_mm)
        own = np.append(np.arange(4 * spheres), 4 * spheres + number)
        by_own = np.zeros((len(here), len(own)))
        which = self.sphere[here]
        for axis in range(3):
            by_own[np.arange(len(here)), 3 * which + axis] = -outward[axis, here]
        by_own[np.arange(len(here)), 3 * spheres + which] = -0.5
        by_own[:, -1] = direction @ outward[:, here]
        return own, by_own
