"""Motion of a sensor in a scene: steps of a linear stage, and the images taken along them."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, model_validator

from uwlts.model.sensor import Bracket, Description, NotNegative, Vector

Light = Literal["lamp", "laser", "day"]


class Motion(Description):
    """Steps of a linear stage that moves the sensor: ``count`` positions from ``start_mm`` in steps of ``step_mm``.

    ``direction`` is the true direction of travel; the capture records ``nominal_direction``. At every position, the
    images in ``lights`` are taken in turn, those with the laser at every exposure factor in ``bracket``.
    ``position_errors_mm`` is the true minus the recorded position (default: 0). ``speed_mm_per_s`` is the speed of the
    stage along ``direction`` during an exposure, 0 if it stops.
    """

    start_mm: float = 0.0
    step_mm: float = 1.0
    count: Annotated[int, Field(ge=1, le=100000)] = 1
    direction: Vector = (1.0, 0.0, 0.0)
    nominal_direction: Vector | None = None
    position_errors_mm: tuple[float, ...] = ()
    lights: tuple[Literal["lamp", "laser"], ...] = ("laser",)
    bracket: Bracket = (1.0,)
    speed_mm_per_s: NotNegative = 0.0

    @model_validator(mode="after")
    def _has_direction(self) -> "Motion":
        for vector in (self.direction, self.nominal_direction):
            if vector is not None and np.linalg.norm(vector) < 1e-9:
                raise ValueError(f"direction {vector} has no length")
        if self.position_errors_mm and len(self.position_errors_mm) != self.count:
            raise ValueError(f"position_errors_mm has {len(self.position_errors_mm)} values for {self.count} positions")
        if not self.lights:
            raise ValueError("lights is empty: name 'lamp', 'laser' or both")
        if self.speed_mm_per_s > 0 and self.images() > self.count:
            raise ValueError(
                "a moving stage takes one image at each position: name one light and no bracket, or stop with speed 0"
            )
        return self

    def unit_direction(self) -> np.ndarray:
        """Return the true unit direction (3,) of the sensor's travel in the scene."""
        return np.array(self.direction) / np.linalg.norm(self.direction)

    def recorded_direction(self) -> tuple[float, float, float]:
        """Return the unit direction that the capture records."""
        vector = np.array(self.nominal_direction or self.direction)
        x, y, z = (vector / np.linalg.norm(vector)).tolist()
        return x, y, z

    def shots(self) -> Iterator["Shot"]:
        """Yield all images of the scan in order."""
        for index in range(self.count):
            stage_mm = self.start_mm + index * self.step_mm
            error = self.position_errors_mm[index] if self.position_errors_mm else 0.0
            for light in self.lights:
                for exposure in self.bracket if light == "laser" else (1.0,):
                    yield Shot(stage_mm=stage_mm, travelled_mm=stage_mm + error, light=light, exposure=exposure)

    def moves(self) -> bool:
        """Return whether the sensor moves during exposures."""
        return self.speed_mm_per_s > 0

    def images(self) -> int:
        """Return the number of images of the scan."""
        laser = self.lights.count("laser")
        return self.count * (len(self.lights) + laser * (len(self.bracket) - 1))


@dataclass(frozen=True)
class Shot:
    """One image to take.

    ``stage_mm`` and ``travelled_mm`` are the recorded and the true position of the stage; on other platforms,
    ``travelled_mm`` is the path length of the sensor and ``time_s`` the time since the first image. ``light`` is on in
    addition to daylight; ``exposure`` multiplies the exposure time.
    """

    stage_mm: float
    travelled_mm: float
    light: Light
    exposure: float = 1.0
    time_s: float | None = None
