"""Images taken by camera, stage and laser together, and automatic exposure.

Automatic exposure keeps the brightest lines of an image below full scale by a given share. It considers the profile
lines that show light: in laser images those with a stripe, in images without laser those that are not dark compared
with the brightest one.
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
from uwlts.storage.capture import CaptureHeader, Seen
from uwlts.stripe import Stripe, StripeStatus, extract_stripe

BRIGHT_SHARE = 0.98
"""The brightest pixel of every line that counts is looked at; 2 % of the lines may be brighter than wanted."""
START_MS = 1.0
"""First exposure that is tried: in the middle of the usual range, on a logarithmic scale."""
_FEW_SHARE = 0.01
_FEWEST_LINES = 3
"""Fewer lines, as a share of all and as a number, are a reflection or noise."""
_DIM_SHARE = 0.05
"""Lines below this share of the brightest one are dark."""
_MANY_SHARE = 0.05
"""More saturated lines than this share are more than a reflection accounts for."""
_CLOSE = 0.1
"""Relative change of the exposure below which no further image is taken."""
_SHORTEST_MS = 1e-3
"""Shortest exposure of usual cameras."""
_STEPS = 12
"""Images at most: from the start to either end of the range takes three, and the bisection in between a few more."""
_DOWN = 1 / 16
"""Factor from a saturated image, in which it is unknown by how much it is too bright."""
_UP = 30.0
"""Largest factor from a dark image, in which noise limits the estimate."""


def stripe_of(seen: Seen, sensor: Sensor, *, background: np.ndarray | None = None) -> Stripe:
    """The stripe in what a sensor saw: a centre line, or an image (H, W) less a background (H, W) if there is one."""
    if isinstance(seen, Stripe):
        return seen
    along, full_dn = sensor.camera.stripe_along, sensor.detector.full_scale_dn()
    return extract_stripe(seen, stripe_along=along, saturation=full_dn, background=background)


def not_few(count: int, lines: int) -> bool:
    """Whether so many of all lines are a sign of light, rather than a reflection or noise."""
    return count >= max(_FEW_SHARE * lines, _FEWEST_LINES)


@dataclass(frozen=True)
class Brightness:
    """Brightness of an image.

    ``level`` is the share of the full scale that all but 2 % of the ``counted`` lines keep to: 0 where no line counts,
    1 where it is too bright by an unknown amount. ``saturated`` of the counted lines reach the full scale.
    """

    lines: int
    counted: int
    saturated: int
    level: float

    @property
    def dark(self) -> bool:
        """Whether too few lines count to derive an exposure from them."""
        return not not_few(self.counted, self.lines)

    @property
    def overexposed(self) -> bool:
        """Whether many lines are saturated, more than a reflection accounts for."""
        return self.saturated > _MANY_SHARE * self.counted and not_few(self.saturated, self.lines)


def brightness(image: Seen, sensor: Sensor, light: Light) -> Brightness:
    """Brightness of an image (H, W) in grey values, as the sensor's detector gives them, in a light.

    Of a centre line only the lines are known, the level is NaN.
    """
    if isinstance(image, Stripe):
        return Brightness(len(image.status), len(image.lines), 0, math.nan)
    full, black = sensor.detector.full_scale_dn(), sensor.detector.black_level_dn
    peak = image.max(axis=0 if sensor.camera.stripe_along == "width" else 1).astype(float)
    counts = peak - black > _DIM_SHARE * (peak.max() - black)
    if light == "laser":
        counts &= stripe_of(image, sensor).status != StripeStatus.NO_STRIPE
    if not counts.any():
        return Brightness(peak.size, 0, 0, 0.0)
    level = float(np.quantile(peak[counts], BRIGHT_SHARE))
    share = 1.0 if level >= full else max(level - black, 0.0) / (full - black)
    return Brightness(peak.size, int(counts.sum()), int((peak[counts] >= full).sum()), share)


def settled_exposure(
    take: Callable[[float], np.ndarray], *, sensor: Sensor, light: Light, start_ms: float = START_MS
) -> float | None:
    """Exposure in ms at which an image just keeps to the sensor's ``auto_level``; None if even the longest is dark.

    ``take(exposure_ms)`` returns an image (H, W) in the light. The longest is the sensor's ``longest_ms``.
    """
    wanted, longest_ms = sensor.exposure.auto_level, sensor.exposure.longest_ms
    exposure_ms, too_long_ms = min(start_ms, longest_ms), math.inf
    for _ in range(_STEPS):
        seen = brightness(take(exposure_ms), sensor, light)
        if seen.level >= 1:
            if exposure_ms <= _SHORTEST_MS:
                break
            too_long_ms = exposure_ms
            # At full scale it is unknown by how much it is too bright; from below one more step is enough.
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
"""Attempts to get an image whose frame was lost on its way."""
_PATIENCE_S = 3.0
"""Longest wait for a frame beyond its exposure, the last part in the dark: several repeats of a lost GigE command."""
_LIGHT_S = 0.5
"""Longest light beyond an exposure: what the camera takes to begin it and, as the light usually ends with the frame, to
send it. The controller ends the light within 0.1 s more, so that a second is kept."""
_LATENCIES = 8
"""Frames by which a late one is judged: a few, as the clocks of camera and computer drift apart."""
_PROMPT_S = 0.1
"""A camera begins an exposure within this time after its trigger."""
_RUN_UP_MM = 1.0
"""More than the play of a ball screw or belt."""


def with_provenance(
    header: CaptureHeader, plan: RigPlan, camera: CameraDevice, *, source: str, stage: str, **more: JsonValue
) -> CaptureHeader:
    """The header of a capture, with where its images come from."""
    provenance = {
        "source": source,
        "title": plan.title,
        "camera": f"{camera.info.name} {camera.info.serial}".strip(),
        "stage": stage,
        **more,
        "laser_power": plan.laser_power,
        "uwlts": __version__,
    }
    return header.model_copy(update={"provenance": provenance})


class HandSwitchedLaser:
    """In place of a stage where there is none: the operator is asked to switch the laser, and nothing moves."""

    limits_mm = (-math.inf, math.inf)
    lit_until_s = math.inf
    faulty = False

    def __init__(self, ask: Callable[[str], object]):
        self._ask = ask
        self.laser_power = 0.0

    def position_mm(self) -> float:
        """Nothing moves."""
        return 0.0

    def move_to(self, position_mm: float, *, feed_mm_per_min: float) -> float:
        """Nothing moves."""
        return 0.0

    def laser(self, on: bool, *, power: float = 1.0, at_most_s: float | None = None) -> None:
        """Ask for it."""
        self._ask("switch the laser on and the lamp off" if on else "switch the laser off and the lamp on")
        self.laser_power = power if on else 0.0

    def keep_lit(self, wait_s: float = 0.0) -> None:
        """No guard watches over it."""


LaserStage = GrblStage | HandSwitchedLaser


class Rig:
    """Takes the images of a plan one by one. A switched laser is on while the camera exposes its images, and no longer.

    A frame that comes late is waited for in the dark, and taken where the camera's time stamp says that it was exposed
    in the light.

    ``ahead`` is the direction in which the stage reaches every position, 1 or -1, so that play of the drive does not
    show. ``repeated`` counts images that were asked for again, as their frames were lost or damaged on their way.
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
        """Move with the laser off and let the stage settle; the position read back in mm."""
        if self._position_mm is None or abs(self._position_mm - position_mm) > 1e-9:
            self._laser(False)
            if (position_mm - self._read_back_mm) * self._ahead < 0:
                run_up_mm = float(np.clip(position_mm - self._ahead * _RUN_UP_MM, *self._stage.limits_mm))
                self._stage.move_to(run_up_mm, feed_mm_per_min=self._feed_mm_per_min)
            self._read_back_mm = self._stage.move_to(position_mm, feed_mm_per_min=self._feed_mm_per_min)
            time.sleep(self._settle_s)
            self._position_mm = position_mm
        return self._read_back_mm

    def image(self, light: Light, exposure_ms: float) -> tuple[np.ndarray, float]:
        """Image (H, W) in a light, "lamp" being that without laser, and its exposure in ms as the camera says.

        HardwareError where the camera gives centre lines.
        """
        frame = self.frame(light, exposure_ms)
        return frame.image, exposure_ms if frame.exposure_ms is None else frame.exposure_ms

    def frame(self, light: Light, exposure_ms: float) -> GrabbedFrame:
        """What the camera sees in a light: an image or a centre line."""
        if self._exposure_ms is None or abs(self._exposure_ms / exposure_ms - 1) >= 1e-6:
            self._rest()
            camera, gain_db, bits = self._camera, self._plan.gain_db, self._sensor.detector.bits
            camera.stop()
            camera.configure(exposure_ms=exposure_ms, gain_db=gain_db, bits=bits, trigger="software")
            camera.start(faults="raise")
            self._exposure_ms = exposure_ms
        return self._grab(light)

    def settled_exposure(self, light: Light, *, start_ms: float) -> float | None:
        """Exposure in ms for what is seen now; None if even the longest is dark."""
        return settled_exposure(
            lambda exposure_ms: self.image(light, exposure_ms)[0], sensor=self._sensor, light=light, start_ms=start_ms
        )

    def _laser(self, on: bool) -> None:
        if (self._stage.laser_power > 0) != on:
            longest_s = 1e-3 * (self._exposure_ms or 0.0) + _LIGHT_S
            self._stage.laser(on, power=self._plan.laser_power, at_most_s=longest_s)

    def _rest(self) -> None:
        """Switch the laser off; an operator is asked only when an image without laser is next."""
        if not isinstance(self._stage, HandSwitchedLaser):
            self._laser(False)

    def _grab(self, light: Light) -> GrabbedFrame:
        """One image; asked for again if its frame was lost, as the stage is at rest. Between tries the laser is off."""
        last = None
        for _ in range(_TRIES):
            self._laser(light == "laser")
            try:
                frame = self._one()
            except HardwareError as error:
                # At once: closing a camera that is gone takes its time.
                with suppress(HardwareError):
                    self._rest()
                # A camera whose driver hangs has the guard switch the laser off; what to mend is the camera.
                if self._stage.faulty or not self._camera.running:
                    raise
                last = error
                self.repeated += 1
            else:
                # Also shows whether the laser was on all the time.
                self._rest()
                return frame
        raise HardwareError(f"{last} (asked for {_TRIES} times)")

    def _one(self) -> GrabbedFrame:
        """Trigger and wait. The laser's guard hears of every step, so that a driver that hangs leaves no laser on."""
        exposure_s = 1e-3 * (self._exposure_ms or 0.0)
        lit, lit_until_s = self._stage.laser_power > 0, self._stage.lit_until_s
        self._stage.keep_lit(exposure_s)
        asked_s = time.monotonic()
        self._camera.trigger()

        def waiting() -> None:
            if time.monotonic() < lit_until_s:
                self._stage.keep_lit()
            else:
                self._rest()

        frame = self._camera.grab(_PATIENCE_S + exposure_s, waiting=waiting)
        came_s, known = time.monotonic(), len(self._latencies_s) > 0
        # Includes the unknown difference of both clocks, which all frames share.
        self._latencies_s.append(frame.time_s - asked_s)
        began_s = asked_s + self._latencies_s[-1] - min(self._latencies_s)
        if not lit or came_s <= lit_until_s:
            return frame
        # First of all, as this shows whether the guard, and not the controller's time, has ended the light.
        self._rest()
        if not (known and began_s + exposure_s + _PROMPT_S < lit_until_s):
            raise HardwareError(
                f"the camera {self._camera.address} gave a frame {came_s - asked_s:.2g} s after its trigger, and the "
                f"laser was on for {exposure_s + _LIGHT_S:.2g} s: it may have been exposed in the dark"
            )
        return frame
