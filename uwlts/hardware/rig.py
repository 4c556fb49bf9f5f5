"""Camera, stage and laser worked together: an image at a place, in a light, with an exposure."""

import time

import numpy as np

from uwlts.errors import HardwareError
from uwlts.hardware.camera import Camera, GrabbedFrame
from uwlts.hardware.grbl import GrblStage
from uwlts.hardware.scan_plan import Light, ScanPlan
from uwlts.sensor import Sensor

_TRIES = 3
"""How often an image is asked for whose frame was lost on its way."""
_PATIENCE_S = 3.0
_RUN_UP_MM = 1.0


class Rig:
    """Takes the images of a plan one by one. The laser is on for its own images only.

    Attributes
    ----------
    repeated : int
        Images that were asked for again, as their frames were lost or damaged on their way.
    """

    def __init__(self, plan: ScanPlan, sensor: Sensor, camera: Camera, stage: GrblStage):
        self._plan, self._bits, self._camera, self._stage = plan, sensor.detector.bits, camera, stage
        self._settle_s = sensor.stage.settling_s if plan.stage.settle_s is None else plan.stage.settle_s
        self._position_mm: float | None = None
        self._read_back_mm = stage.position_mm()
        self._exposure_ms: float | None = None
        self.repeated = 0

    def move_to(self, position_mm: float) -> float:
        """Move with the laser off and let the stage settle; the position read back in mm.

        Every position is reached in the direction of the plan, so that play of the drive does not show.
        """
        if self._position_mm is None or abs(self._position_mm - position_mm) > 1e-9:
            self._laser(False)
            ahead = 1.0 if self._plan.stage.step_mm >= 0 else -1.0
            if (position_mm - self._read_back_mm) * ahead < 0:
                low, high = self._stage.limits_mm
                self._move(min(max(position_mm - ahead * _RUN_UP_MM, low), high))
            self._read_back_mm = self._move(position_mm)
            time.sleep(self._settle_s)
            self._position_mm = position_mm
        return self._read_back_mm

    def _move(self, position_mm: float) -> float:
        return self._stage.move_to(position_mm, feed_mm_per_min=self._plan.stage.feed_mm_per_min)

    def image(self, light: Light, exposure_ms: float) -> tuple[np.ndarray, float]:
        """Image (H, W) in a light, "lamp" being that without laser, and its exposure in ms as the camera says."""
        self._laser(light == "laser")
        self._configure(exposure_ms)
        frame = self._grab()
        return frame.image, exposure_ms if frame.exposure_ms is None else frame.exposure_ms

    def _laser(self, on: bool) -> None:
        if (self._stage.laser_power > 0) != on:
            self._stage.laser(on, power=self._plan.laser_power)

    def _configure(self, exposure_ms: float) -> None:
        if self._exposure_ms is not None and abs(self._exposure_ms / exposure_ms - 1) < 1e-6:
            return
        self._camera.stop()
        self._camera.configure(exposure_ms=exposure_ms, gain_db=self._plan.gain_db, bits=self._bits, trigger="software")
        self._camera.start(faults="raise")
        self._exposure_ms = exposure_ms

    def _grab(self) -> GrabbedFrame:
        """One image; asked for again if its frame was lost, as the stage is at rest. Between tries the laser is off."""
        lit, last = self._stage.laser_power > 0, None
        for _ in range(_TRIES):
            self._laser(lit)
            try:
                self._camera.trigger()
                return self._camera.grab(_PATIENCE_S + 1e-3 * (self._exposure_ms or 0.0))
            except HardwareError as error:
                if not self._camera.running:
                    raise
                last = error
                self._laser(False)
                self.repeated += 1
        raise HardwareError(f"{last} (asked for {_TRIES} times)")
