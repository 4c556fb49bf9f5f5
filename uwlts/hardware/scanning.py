"""Records a scan: moves the stage, waits until it rests, switches the laser, has the camera take an image, stores it.

Every complete image is in the file before the next one is asked for, with the position read back from the stage. The
laser is on for its own images only; the stage's driver switches it off however a scan ends.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np

import uwlts
from uwlts.capture import Capture, CaptureWriter, Frame, part_path
from uwlts.errors import HardwareError
from uwlts.hardware.camera import Camera, GrabbedFrame
from uwlts.hardware.grbl import GrblStage
from uwlts.hardware.scan_plan import Light, ScanPlan, check_plan
from uwlts.importing.images import without_background
from uwlts.sensor import Sensor
from uwlts.stripe import StripeStatus, extract_stripe

_TRIES = 3
"""How often an image is asked for whose frame was lost on its way."""
_PATIENCE_S = 3.0
_STEPS_OF_EXPOSURE = 8
_BRIGHT_SHARE = 0.98
"""Automatic exposure looks at the brightest pixel of every profile line and lets 2 % of the lines be brighter."""
_CLOSE = 0.1
_SATURATED_SHARE, _FAINT_SHARE = 0.05, 0.1


@dataclass(frozen=True)
class Shot:
    """An image to take: its number, the position of the stage in mm, and the light."""

    number: int
    position_mm: float
    light: Light


@dataclass
class Seen:
    """What the images of a scan showed so far.

    ``lines`` and ``found`` count the profile lines of laser images and those with a stripe, ``saturated`` and ``faint``
    the laser images on which too many lines are at the full scale, or that hardly reach a tenth of it; ``repeated``
    the images that were asked for again. ``exposure_ms`` are the exposures used.
    """

    lines: int = 0
    found: int = 0
    saturated: int = 0
    faint: int = 0
    repeated: int = 0
    images: int = 0
    exposure_ms: dict[Light, float] = field(default_factory=dict)

    def warnings(self) -> list[str]:
        """What should be seen to."""
        said = []
        if self.saturated:
            said.append(f"{self.saturated} laser images are saturated on many lines: shorten laser_ms")
        if self.faint:
            said.append(f"{self.faint} laser images are faint: lengthen laser_ms, or is the laser lit?")
        if self.lines and self.found < 0.05 * self.lines:
            said.append(f"only {self.found} of {self.lines} profile lines show a stripe: is the laser lit, the object "
                        "in the volume?")  # fmt: skip
        if self.repeated:
            said.append(f"{self.repeated} images were lost on their way from the camera and taken again")
        return said


def shots_of(plan: ScanPlan) -> list[Shot]:
    """All images of a plan in their order."""
    pairs = [(position, light) for position in plan.stage.positions_mm() for light in plan.lights]
    return [Shot(number, position, light) for number, (position, light) in enumerate(pairs)]


def record_scan(
    plan: ScanPlan,
    out: Path,
    *,
    camera: Camera,
    stage: GrblStage,
    overwrite: bool = False,
    resume: bool = False,
    progress: Callable[[int, int, Seen], None] = lambda done, total, seen: None,
) -> Seen:
    """Carry out a plan with an open camera and a stage that knows where it is, into a capture.

    An interrupted scan leaves its complete images in ``out.part``; ``resume`` goes on after them, at exposures that
    the recorded images have. ``progress(done, total, seen)`` is called after every image.

    Raises
    ------
    RangeError, DesignError, DescriptionError
        The plan cannot be carried out; nothing has moved.
    HardwareError
        Camera, stage or laser fail, or the camera has another image size than the sensor's description.
    OutputError
        The file exists, or cannot be written.
    """
    sensor = plan.described_sensor()
    _check_camera(camera, sensor)
    check_plan(plan, limits_mm=stage.limits_mm, fastest_mm_per_min=stage.settings.max_feed_mm_per_min)
    zero_dn = plan.zero_dn(sensor)
    dtype = np.dtype(np.uint16) if zero_dn or camera.info.bits > 8 else np.dtype(np.uint8)
    provenance = {
        "source": "scan", "title": plan.title, "camera": f"{camera.info.name} {camera.info.serial}".strip(),
        "stage": f"Grbl {stage.version}", "background": plan.background, "laser_power": plan.laser_power,
        "uwlts": uwlts.__version__,
    }  # fmt: skip
    shots, seen = shots_of(plan), Seen()
    before_s = _recorded(part_path(out), seen) if resume else 0.0
    with CaptureWriter(out, plan.header(out.stem, provenance=provenance), dtype=dtype, overwrite=overwrite,
                       resume=resume) as writer:  # fmt: skip
        begun = len(writer)
        taking = _Taking(plan, sensor, camera, stage, seen)
        start_s = time.monotonic() - before_s
        for shot in shots[begun:]:
            position = taking.move_to(shot.position_mm)
            image, exposure_ms = taking.image(shot.light)
            dark = taking.image("lamp", exposure_ms=exposure_ms)[0] if zero_dn and shot.light == "laser" else None
            taking.look(image, shot.light)
            if zero_dn:
                image = image.astype(np.uint16) if dark is None else without_background(image, dark, zero_dn=zero_dn)
            writer.append(
                Frame(image.astype(dtype, copy=False), position, shot.light == "laser", exposure_ms,
                      time.monotonic() - start_s)
            )  # fmt: skip
            progress(shot.number + 1, len(shots), seen)
    return seen


def _recorded(part: Path, seen: Seen) -> float:
    """Time in s of an interrupted scan's last image, 0 without one; takes over the exposures of its lights."""
    if not part.exists():
        return 0.0
    with Capture(part) as left:
        for laser_on, exposure_ms in zip(left.laser_on.tolist(), left.exposure_ms.tolist(), strict=True):
            seen.exposure_ms["laser" if laser_on else "lamp"] = exposure_ms
        return float(left.time_s[-1]) if len(left) else 0.0


def _check_camera(camera: Camera, sensor: Sensor) -> None:
    described, found = sensor.camera, camera.info
    if (found.width_px, found.height_px) != (described.width_px, described.height_px):
        raise HardwareError(
            f"the camera has {found.width_px} x {found.height_px} px, the sensor '{sensor.name}' "
            f"{described.width_px} x {described.height_px} px: give the description of this sensor"
        )
    if found.bits < sensor.detector.bits:
        raise HardwareError(
            f"the camera gives {found.bits} bits, the sensor '{sensor.name}' is described with {sensor.detector.bits}"
        )


class _Taking:
    """Takes images one by one, with the exposures settled at the first of each light."""

    def __init__(self, plan: ScanPlan, sensor: Sensor, camera: Camera, stage: GrblStage, seen: Seen):
        self._plan, self._sensor, self._camera, self._stage, self._seen = plan, sensor, camera, stage, seen
        self._settle_s = sensor.stage.settling_s if plan.stage.settle_s is None else plan.stage.settle_s
        self._along_width = sensor.camera.stripe_along == "width"
        self._position_mm: float | None = None
        self._exposure_ms: float | None = None

    def move_to(self, position_mm: float) -> float:
        """Move with the laser off and let the stage settle; the position read back."""
        if self._position_mm is None or abs(self._position_mm - position_mm) > 1e-9:
            self._laser(False)
            self._read_back = self._stage.move_to(position_mm, feed_mm_per_min=self._plan.stage.feed_mm_per_min)
            time.sleep(self._settle_s)
            self._position_mm = position_mm
        return self._read_back

    def image(self, light: Light, *, exposure_ms: float | None = None) -> tuple[np.ndarray, float]:
        """Image (H, W) in a light, and its exposure in ms."""
        self._laser(light == "laser")
        wanted = exposure_ms if exposure_ms is not None else self._exposure(light)
        self._configure(wanted)
        frame = self._grab()
        return frame.image, wanted if frame.exposure_ms is None else frame.exposure_ms

    def look(self, image: np.ndarray, light: Light) -> None:
        """Count what an image shows."""
        self._seen.images += 1
        if light != "laser":
            return
        stripe = extract_stripe(image, stripe_along=self._sensor.camera.stripe_along)
        self._seen.lines += len(stripe.status)
        self._seen.found += int((stripe.status == StripeStatus.OK).sum())
        brightest = self._brightest(image)
        full = self._sensor.detector.full_scale_dn()
        if (brightest >= full).mean() > _SATURATED_SHARE:
            self._seen.saturated += 1
        if np.quantile(brightest, _BRIGHT_SHARE) < _FAINT_SHARE * full:
            self._seen.faint += 1

    def _brightest(self, image: np.ndarray) -> np.ndarray:
        """Brightest pixel of every profile line."""
        return image.max(axis=0 if self._along_width else 1)

    def _laser(self, on: bool) -> None:
        if (self._stage.laser_power > 0) != on:
            self._stage.laser(on, power=self._plan.laser_power)

    def _exposure(self, light: Light) -> float:
        """Exposure as planned, or such that the light just reaches the wanted level; settled once for each light."""
        if light not in self._seen.exposure_ms:
            planned: float | Literal["auto"] = self._plan.laser_ms if light == "laser" else self._plan.lamp_ms
            self._seen.exposure_ms[light] = self._settled() if planned == "auto" else planned
        return self._seen.exposure_ms[light]

    def _settled(self) -> float:
        """Exposure in ms at which all but the brightest lines stay below the wanted level."""
        wishes, full = self._sensor.exposure, self._sensor.detector.full_scale_dn()
        black = self._sensor.detector.black_level_dn
        exposure = min(1.0, wishes.longest_ms)
        for _ in range(_STEPS_OF_EXPOSURE):
            self._configure(exposure)
            level = float(np.quantile(self._brightest(self._grab().image), _BRIGHT_SHARE))
            share = max(level - black, 0.5) / (full - black)
            if abs(share / wishes.auto_level - 1) < _CLOSE or (exposure >= wishes.longest_ms and share < 1):
                break
            # At the full scale nothing tells by how much it is too bright.
            factor = 0.25 if level >= full else min(wishes.auto_level / share, 30.0)
            exposure = min(exposure * factor, wishes.longest_ms)
        return exposure

    def _configure(self, exposure_ms: float) -> None:
        if self._exposure_ms is not None and abs(self._exposure_ms / exposure_ms - 1) < 1e-6:
            return
        self._camera.stop()
        self._camera.configure(
            exposure_ms=exposure_ms, gain_db=self._plan.gain_db, bits=self._sensor.detector.bits, trigger="software"
        )
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
                last = error
                self._laser(False)
                self._seen.repeated += 1
        raise HardwareError(f"{last} (asked for {_TRIES} times)")


def plan_text(plan: ScanPlan) -> str:
    """What a plan is going to do, in words."""
    positions = plan.stage.positions_mm()
    images = len(positions) * (len(plan.lights) + int(plan.background and "laser" in plan.lights))
    return f"{len(positions)} positions from {positions[0]:g} to {positions[-1]:g} mm, {images} images to take"
