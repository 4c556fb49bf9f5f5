"""Images taken by camera, stage and laser together, and automatic exposure.

Automatic exposure keeps the brightest lines of an image at a given fraction of full scale. It considers the profile
lines with light: in laser images those with a stripe, in images without laser those that are not dark compared with the
brightest line.
"""

import math
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
from pydantic import JsonValue

from uwlts._version import __version__
from uwlts.errors import HardwareError
from uwlts.hardware.camera_interface import CameraDevice, GrabbedFrame
from uwlts.hardware.grbl import GrblStage
from uwlts.hardware.scan_plan import Light, RigPlan, StageSettings
from uwlts.model.sensor import Sensor
from uwlts.storage.capture import CaptureHeader
from uwlts.stripe import Stripe, StripeStatus, extract_stripe

BRIGHT_SHARE = 0.98
"""Quantile of the peak values of the considered lines; 2 % of the lines may be brighter than requested."""
START_MS = 1.0  # first exposure: in the middle of the usual range, on a logarithmic scale
_FEW_SHARE = 0.01
_FEWEST_LINES = 3
"""Smallest fraction and number of lines with a stripe; fewer are attributed to a reflection or noise."""
_DIM_SHARE = 0.05  # lines below this fraction of the brightest one are dark
_MANY_SHARE = 0.05  # a larger fraction of saturated lines cannot be attributed to a reflection
_CLOSE = 0.1  # relative change of the exposure that ends the search
_SHORTEST_MS = 1e-3  # shortest exposure of usual cameras
_STEPS = 12  # largest number of images: either end of the range is reached in three, and bisection takes a few more
_DOWN = 1 / 16  # factor after a saturated image, whose excess is unknown
_UP = 30.0  # largest factor after a dark image, because noise limits the estimate


def get_stripe(image: np.ndarray, sensor: Sensor, *, background: np.ndarray | None = None) -> Stripe:
    """Extract the stripe of an image (H, W) minus a background (H, W), if given."""
    along, full_dn = sensor.camera.stripe_along, sensor.detector.full_scale_dn()
    return extract_stripe(image, stripe_along=along, saturation=full_dn, background=background)


def are_enough(count: int, lines: int) -> bool:
    """Return whether ``count`` of all lines are too many for a reflection or noise."""
    return count >= max(_FEW_SHARE * lines, _FEWEST_LINES)


@dataclass(frozen=True)
class Brightness:
    """Brightness of an image.

    ``level`` is the fraction of full scale below which 98 % of the ``counted`` lines stay. It is 0 if no line counts,
    and 1 if the image is too bright by an unknown amount. ``saturated`` counts the lines that reach full scale.
    """

    lines: int
    counted: int
    saturated: int
    level: float

    @property
    def dark(self) -> bool:
        """True if too few lines count to derive an exposure."""
        return not are_enough(self.counted, self.lines)

    @property
    def overexposed(self) -> bool:
        """True if more lines are saturated than a reflection explains."""
        return self.saturated > _MANY_SHARE * self.counted and are_enough(self.saturated, self.lines)


def measure_brightness(image: np.ndarray, sensor: Sensor, light: Light) -> Brightness:
    """Measure the brightness of an image (H, W) in grey values of the sensor's detector."""
    full, black = sensor.detector.full_scale_dn(), sensor.detector.black_level_dn
    peak = image.max(axis=0 if sensor.camera.stripe_along == "width" else 1).astype(float)
    counts = peak - black > _DIM_SHARE * (peak.max() - black)
    if light == "laser":
        counts &= get_stripe(image, sensor).status != StripeStatus.NO_STRIPE
    if not counts.any():
        return Brightness(peak.size, 0, 0, 0.0)
    level = float(np.quantile(peak[counts], BRIGHT_SHARE))
    share = 1.0 if level >= full else max(level - black, 0.0) / (full - black)
    return Brightness(peak.size, int(counts.sum()), int((peak[counts] >= full).sum()), share)


def find_exposure(
    take: Callable[[float], np.ndarray], *, sensor: Sensor, light: Light, start_ms: float = START_MS
) -> float | None:
    """Find the exposure in ms that brings an image to the sensor's ``auto_level``; None if all are too dark.

    ``take(exposure_ms)`` returns an image (H, W) in the light. The longest exposure is the sensor's ``longest_ms``.
    """
    wanted, longest_ms = sensor.exposure.auto_level, sensor.exposure.longest_ms
    exposure_ms, too_long_ms = min(start_ms, longest_ms), math.inf
    for _ in range(_STEPS):
        seen = measure_brightness(take(exposure_ms), sensor, light)
        if seen.level >= 1:
            if exposure_ms <= _SHORTEST_MS:
                break
            too_long_ms = exposure_ms
            # At full scale the excess is unknown; from below, one more step suffices.
            exposure_ms = max(exposure_ms * _DOWN, _SHORTEST_MS)
            continue
        needed_ms = math.inf if seen.dark else exposure_ms * wanted / max(seen.level, 1e-6)
        if abs(needed_ms / exposure_ms - 1) < _CLOSE:
            return min(needed_ms, longest_ms)
        if exposure_ms >= longest_ms and needed_ms > longest_ms:
            return None if seen.dark else longest_ms
        longer_ms = min(needed_ms, exposure_ms * _UP, longest_ms)
        exposure_ms = longer_ms if longer_ms < too_long_ms else math.sqrt(exposure_ms * too_long_ms)
    return exposure_ms


_TRIES = 3
_RETRIED_S = 5.0
"""An image whose frame is lost in transfer is taken again until both limits are exceeded, in attempts and in s. A
busy computer can lose several frames in a fraction of a second; the stage is at rest, so a later image is as good."""
_PATIENCE_S = 3.0
"""Longest wait for a frame beyond its exposure, long enough for several repetitions of a lost GigE command. The laser
is off for the last part."""
_LIGHT_S = 0.5
"""Longest light beyond an exposure: the camera's delay before the exposure and, because the light usually ends with the
frame, the transfer time. The controller ends the light within 0.1 s more, so that the total stays below a second."""
_LATENCIES = 8  # frames for comparison with a late one: only a few, because the clocks of camera and computer drift
_PROMPT_S = 0.1  # longest delay between a trigger and the start of the exposure
_RUN_UP_MM = 1.0  # more than the backlash of a ball screw or belt


def add_provenance(
    header: CaptureHeader, plan: RigPlan, camera: CameraDevice, *, source: str, stage: str, **more: JsonValue
) -> CaptureHeader:
    """Return the header of a capture with the provenance of its images, and ``more`` entries.

    ``source`` is the kind of the recording, such as "scan", ``stage`` the name of the stage's controller.
    """
    provenance = {
        "source": source,
        "title": plan.title,
        "camera": f"{camera.info.name} {camera.info.serial}".strip(),
        "black_level": camera.info.black_level,
        "stage": stage,
        **more,
        "laser_power": plan.laser_power,
        "uwlts": __version__,
    }
    return header.model_copy(update={"provenance": provenance})


class HandSwitchedLaser:
    """Substitute for a missing stage: asks the operator to switch the laser, and does not move."""

    limits_mm = (-math.inf, math.inf)
    lit_until_s = math.inf
    faulty = False

    def __init__(self, ask: Callable[[str], object]):
        self._ask = ask
        self.laser_power = 0.0

    def position_mm(self) -> float:
        """Return 0."""
        return 0.0

    def move_to(self, position_mm: float, *, feed_mm_per_min: float) -> float:
        """Return 0 without moving."""
        return 0.0

    def laser(self, on: bool, *, power: float = 1.0, at_most_s: float | None = None) -> None:
        """Ask the operator to switch the laser."""
        self._ask("switch the laser on and the lamp off" if on else "switch the laser off and the lamp on")
        self.laser_power = power if on else 0.0

    def keep_lit(self, wait_s: float = 0.0) -> None:
        """Do nothing: there is no guard."""


LaserStage = GrblStage | HandSwitchedLaser


class Rig:
    """Camera, stage and laser that take the images of a plan one by one.

    A switched laser is on only while the camera exposes. If a frame is late, the laser is switched off while waiting.
    The frame is accepted if its time stamp shows that it was exposed in the light.

    ``ahead`` is the direction of motion towards every position, 1 or -1, to eliminate backlash.
    ``repeated`` counts images that were taken again because their frames were lost or damaged.
    """

    def __init__(
        self,
        plan: RigPlan,
        settings: StageSettings,
        sensor: Sensor,
        camera: CameraDevice,
        stage: LaserStage,
        *,
        ahead: float,
    ):
        self._plan, self._sensor, self._camera, self._stage = plan, sensor, camera, stage
        self._feed_mm_per_min, self._ahead = settings.feed_mm_per_min, math.copysign(1.0, ahead)
        self._settle_s = sensor.stage.settling_s if settings.settle_s is None else settings.settle_s
        self._position_mm: float | None = None
        self._read_back_mm = stage.position_mm()
        self._exposure_ms: float | None = None
        self._latencies_s: deque[float] = deque(maxlen=_LATENCIES)
        self.repeated = 0

    def move_to(self, position_mm: float) -> float:
        """Move with the laser off, let the stage settle, and return the position read back in mm."""
        if self._position_mm is None or abs(self._position_mm - position_mm) > 1e-9:
            self._switch_laser(False)
            if (position_mm - self._read_back_mm) * self._ahead < 0:
                run_up_mm = float(np.clip(position_mm - self._ahead * _RUN_UP_MM, *self._stage.limits_mm))
                self._stage.move_to(run_up_mm, feed_mm_per_min=self._feed_mm_per_min)
            self._read_back_mm = self._stage.move_to(position_mm, feed_mm_per_min=self._feed_mm_per_min)
            time.sleep(self._settle_s)
            self._position_mm = position_mm
        return self._read_back_mm

    def frame(self, light: Light, exposure_ms: float) -> GrabbedFrame:
        """Take a frame in a light, "lamp" being without laser."""
        if self._exposure_ms is None or abs(self._exposure_ms / exposure_ms - 1) >= 1e-6:
            self._darken()
            camera, gain_db, bits = self._camera, self._plan.gain_db, self._sensor.detector.bits
            camera.stop()
            camera.configure(exposure_ms=exposure_ms, gain_db=gain_db, bits=bits, trigger="software")
            camera.start(faults="raise")
            self._exposure_ms = exposure_ms
        return self._grab(light)

    def find_exposure(self, light: Light, *, start_ms: float) -> float | None:
        """Find the exposure in ms for the present scene; None if even the longest is too dark."""
        return find_exposure(
            lambda exposure_ms: self.frame(light, exposure_ms).image,
            sensor=self._sensor,
            light=light,
            start_ms=start_ms,
        )

    def _switch_laser(self, on: bool) -> None:
        if (self._stage.laser_power > 0) != on:
            longest_s = 1e-3 * (self._exposure_ms or 0.0) + _LIGHT_S
            self._stage.laser(on, power=self._plan.laser_power, at_most_s=longest_s)

    def _darken(self) -> None:
        """Switch the laser off; an operator is asked only before an image without laser."""
        if not isinstance(self._stage, HandSwitchedLaser):
            self._switch_laser(False)

    def _grab(self, light: Light) -> GrabbedFrame:
        """Take one frame, repeated if it is lost, as the stage is at rest; the laser is off between attempts."""
        deadline, tries = time.monotonic() + _RETRIED_S, 0
        while True:
            tries += 1
            self._switch_laser(light == "laser")
            try:
                frame = self._take_one()
            except HardwareError as error:
                # Switch off first: closing a camera that is gone takes time.
                with suppress(HardwareError):
                    self._darken()
                # If the camera's driver hangs, the guard switches the laser off; the fault to report is the camera's.
                if self._stage.faulty or not self._camera.running:
                    raise
                if tries >= _TRIES and time.monotonic() > deadline:
                    raise HardwareError(f"{error} (tried {tries} times)") from error
                self.repeated += 1
            else:
                # Also checks whether the laser was on all the time.
                self._darken()
                return frame

    def _take_one(self) -> GrabbedFrame:
        """Trigger and wait; every step sends a beat to the laser guard, in case a driver hangs."""
        exposure_s = 1e-3 * (self._exposure_ms or 0.0)
        lit, lit_until_s = self._stage.laser_power > 0, self._stage.lit_until_s
        self._stage.keep_lit(exposure_s)
        asked_s = time.monotonic()
        self._camera.trigger()

        def waiting() -> None:
            if time.monotonic() < lit_until_s:
                self._stage.keep_lit()
            else:
                self._darken()

        frame = self._camera.grab(_PATIENCE_S + exposure_s, waiting=waiting)
        came_s, known = time.monotonic(), len(self._latencies_s) > 0
        # Includes the unknown offset between the clocks, which all frames share.
        self._latencies_s.append(frame.time_s - asked_s)
        began_s = asked_s + self._latencies_s[-1] - min(self._latencies_s)
        if not lit or came_s <= lit_until_s:
            return frame
        # Before anything else: it shows whether the guard, not the controller, has ended the light.
        self._darken()
        if not (known and began_s + exposure_s + _PROMPT_S < lit_until_s):
            raise HardwareError(
                f"the camera {self._camera.address} gave a frame {came_s - asked_s:.2g} s after its trigger, and the "
                f"laser was on for {exposure_s + _LIGHT_S:.2g} s: it may have been exposed in the dark"
            )
        return frame
