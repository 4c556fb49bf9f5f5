"""The images of a guided calibration: lamp and laser, with exposures that are settled when they are first needed."""

import numpy as np

from uwlts.hardware.exposure import START_MS, settled_exposure
from uwlts.hardware.rig import Rig
from uwlts.hardware.scan_plan import Light, ScanPlan
from uwlts.sensor import Sensor


class GuidedImages:
    """Takes images at the exposure of their light.

    Parameters
    ----------
    dtype : dtype
        Of the images.
    known_ms : dict
        Exposures already settled, as those of a recording that is gone on with.
    """

    def __init__(self, rig: Rig, plan: ScanPlan, sensor: Sensor, *, dtype: np.dtype, known_ms: dict[Light, float]):
        self._rig, self._sensor, self._dtype = rig, sensor, dtype
        self._planned = {"lamp": plan.lamp_ms, "laser": plan.laser_ms}
        self._exposure_ms: dict[Light, float] = dict(known_ms)

    def move_to(self, position_mm: float) -> float:
        """Move and let the stage settle; the position read back in mm."""
        return self._rig.move_to(position_mm)

    def take(self, light: Light) -> tuple[np.ndarray, float]:
        """Image (H, W) in a light, and its exposure in ms."""
        known = light in self._exposure_ms or self.settle(light)
        image, exposure_ms = self._rig.image(light, self._exposure_ms[light] if known else START_MS)
        return image.astype(self._dtype, copy=False), exposure_ms

    def unlit(self) -> np.ndarray:
        """A short image (H, W) without laser, in whatever light there is."""
        return self._rig.image("lamp", START_MS)[0]

    def settle(self, light: Light) -> bool:
        """Find the exposure for what is seen now; whether there is one: in the dark there is none."""
        planned = self._planned[light]
        if planned != "auto":
            self._exposure_ms[light] = planned
            return True
        found = settled_exposure(
            lambda exposure_ms: self._rig.image(light, exposure_ms)[0], sensor=self._sensor, light=light,
            start_ms=self._exposure_ms.get(light, START_MS),
        )  # fmt: skip
        if found is not None:
            self._exposure_ms[light] = found
        return found is not None

    def resettle(self, light: Light) -> bool:
        """Find the exposure anew; whether that can change anything."""
        return self._planned[light] == "auto" and self.settle(light)
