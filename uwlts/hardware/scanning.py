"""Recording of a scan: moves the stage, waits until it is at rest, switches the laser, takes an image and stores it.

Every complete image is in the file before the next one is taken, with the position read back from the stage. The laser
is on only for its own images; the stage's driver switches it off however a scan ends.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from pathlib import Path

import numpy as np

from uwlts.errors import DescriptionError, HardwareError
from uwlts.hardware.aravis import AravisCamera
from uwlts.hardware.camera_interface import CameraDevice, ReplayCamera
from uwlts.hardware.continuous import ScanListeners, plan_passes, record_continuously
from uwlts.hardware.grbl import GrblStage
from uwlts.hardware.rig import START_MS, Brightness, Rig, add_provenance, get_stripe, measure_brightness
from uwlts.hardware.scan_plan import Light, ScanPlan
from uwlts.hardware.scan_watch import LOOKS, LitPlace, Place, SlipWatch, select_centres, select_evenly, shows_laser
from uwlts.model.sensor import Sensor
from uwlts.storage.capture import Capture, Frame, part_path
from uwlts.storage.capture_writer import CaptureWriter
from uwlts.storage.import_.grey_values import subtract_background
from uwlts.stripe import Stripe, StripeStatus

ADDRESSES = """\
  gige:NAME or aravis:NAME  GigE Vision or USB3 Vision by Aravis: identifier, serial number or IP address;
                            without NAME the only camera there is
  replay:PATH               a folder of images, or a capture"""


def open_camera(address: str) -> CameraDevice:
    """Open the camera at an address such as "gige:127.0.0.1", see `ADDRESSES`.

    The camera is open but not configured. Use it as a context manager, which closes it.

    Raises HardwareError if the address has an unknown form, or no camera answers to it; the message lists the cameras
    found; SetupError if a library is missing; the message says how to install it.
    """
    kind, colon, rest = address.partition(":")
    camera: CameraDevice
    if kind in ("gige", "aravis") and colon:
        camera = AravisCamera(rest, address=address)
    elif kind == "replay" and rest:
        camera = ReplayCamera(rest, address=address)
    else:
        raise HardwareError(f"'{address}' is not a camera address; expected one of\n{ADDRESSES}")
    camera.open()
    return camera


_FAINT = 0.1  # laser images below this fraction of full scale are reported as faint
_EXPOSED_AT = 5  # number of positions, evenly distributed over a plan, used by automatic exposure
_DROP = 0.5  # a stripe whose number of lines or level is below this fraction of the previous image's is checked
_AGAIN = 25  # number of images without a stripe after which the laser is checked again


@dataclass
class ScanProgress:
    """Summary of the images of a scan so far.

    ``lines`` and ``found`` count the profile lines of laser images and those with a stripe. ``saturated`` and ``faint``
    count the laser images with many lines at full scale, or with all below a tenth of it. ``repeated`` counts images
    taken again. ``exposure_ms`` are the latest exposures.
    """

    lines: int = 0
    found: int = 0
    saturated: int = 0
    faint: int = 0
    repeated: int = 0
    exposure_ms: dict[Light, float] = field(default_factory=dict)

    def warnings(self) -> list[str]:
        """Return warnings for the operator."""
        few = self.found < 0.05 * self.lines
        texts = {
            f"{self.saturated} laser images are saturated on many lines: shorten laser_ms": self.saturated,
            f"{self.faint} laser images are faint: lengthen laser_ms, or is the laser off?": self.faint,
            f"only {self.found} of {self.lines} profile lines show a stripe: is the laser on, the object in the "
            "volume?": few,
            f"{self.repeated} images were lost between camera and computer and taken again": self.repeated,
        }
        return [text for text, found in texts.items() if found]


def record_scan(
    plan: ScanPlan,
    out: Path,
    *,
    camera: CameraDevice,
    stage: GrblStage,
    resume: bool = False,
    overwrite: bool = False,
    listeners: ScanListeners,
) -> ScanProgress:
    """Record a scan with an open camera and a stage that may move. The errors are those of `uwlts.desk.scan.scan`."""
    report, between = listeners.report, listeners.between
    positions_mm = plan.stage.positions_mm()
    shots = list(product(positions_mm, plan.images()))
    images = len(shots) + (len(positions_mm) * len(plan.bracket) if plan.background and "laser" in plan.lights else 0)
    report(
        f"{len(positions_mm)} positions from {positions_mm[0]:g} to {positions_mm[-1]:g} mm, {images} images to take"
    )
    sensor = plan.described_sensor()
    check_camera(camera, sensor)
    plan.check(stage)
    dtype = np.dtype(np.uint16 if plan.background or camera.info.bits > 8 else np.uint8)
    header = add_provenance(
        plan.header(out.stem),
        plan,
        camera,
        source="scan",
        stage=f"Grbl {stage.version}",
        images=len(shots),
        background=plan.background,
    )

    def begin(seen: ScanProgress) -> _Taking:
        rig = Rig(plan, plan.stage, sensor, camera, stage, ahead=plan.stage.step_mm)
        taking = _Taking(plan, sensor, rig, seen, listeners.warn)
        report("finding the exposures")
        taking.settle_exposures(between)
        report("recording")
        return taking

    if plan.continuous is not None:
        if resume:
            raise DescriptionError("a continuous scan cannot be resumed: give `overwrite` to scan again")
        plan_passes(plan, plan.continuous, stage)
        seen = ScanProgress()
        taking = begin(seen)
        line = record_continuously(
            plan,
            out,
            camera=camera,
            stage=stage,
            header=header,
            exposure_ms=seen.exposure_ms["laser"],
            overwrite=overwrite,
            listeners=replace(listeners, counted=taking.count_stripe),
        )
        report(line)
        return seen
    known_ms, before_s = read_unfinished(out, [multiple for _, multiple in plan.images()]) if resume else ({}, 0.0)
    seen = ScanProgress(exposure_ms=known_ms)
    with CaptureWriter(out, header, dtype=dtype, plan=plan.make_record(), overwrite=overwrite, resume=resume) as writer:
        begun = len(writer)
        if begun == len(shots):
            return seen
        taking = begin(seen)
        start_s = time.monotonic() - before_s
        for done, (position_mm, (light, multiple)) in enumerate(shots[begun:], begun + 1):
            between()
            taken = taking.take(position_mm, light, multiple, last=done == len(shots))
            image = taken.image.astype(dtype, copy=False)
            frame = replace(taken, image=image, time_s=time.monotonic() - start_s)
            writer.append(frame)
            listeners.progress(done, len(shots))
            listeners.recorded(frame, done - 1)
        # A replay does not know where the stage is.
        if plan.check_steps and not isinstance(camera, ReplayCamera):
            report("checking for lost steps")
            taking.check_steps()
        return seen


def read_unfinished(path: Path, multiples: Sequence[float] = (1.0,)) -> tuple[dict[Light, float], float]:
    """Read the latest exposures in ms of an interrupted recording, and the time in s of its last image.

    ``multiples`` of a light's exposure are taken in turn.
    """
    if not part_path(path).exists():
        return {}, 0.0
    with Capture(part_path(path)) as capture:
        lights: list[Light] = ["laser" if on else "lamp" for on in capture.laser_on.tolist()]
        single_ms = capture.exposure_ms / np.resize(multiples, len(lights))
        known = dict(zip(lights, single_ms.tolist(), strict=True))
        return known, float(capture.time_s[-1]) if len(capture) else 0.0


def check_camera(camera: CameraDevice, sensor: Sensor) -> None:
    """Raise HardwareError if a camera is not the sensor's: another image size, or fewer bits."""
    described, found = sensor.camera, camera.info
    if (found.width_px, found.height_px) != (described.width_px, described.height_px):
        raise HardwareError(
            f"the camera has {found.width_px} x {found.height_px} px, the sensor '{sensor.name}' "
            f"{described.width_px} x {described.height_px} px: give the description of this camera's sensor"
        )
    if found.bits < sensor.detector.bits:
        raise HardwareError(
            f"the camera gives {found.bits} bits, the sensor '{sensor.name}' is described with {sensor.detector.bits}"
        )


class _Taking:
    """Images of a scan, with exposures settled before the first one of each light, and checks of laser and stage.

    An image without a stripe may be correct, before or after the object. If the stripe is missing, or much smaller than
    in the previous image, an image with the laser off is taken. If both show the same, the stage returns to where the
    stripe was last seen. If the stripe is there, the scan continues; if not, the laser has failed. A scan that has not
    yet seen a stripe searches for one at positions over the whole plan.
    """

    def __init__(self, plan: ScanPlan, sensor: Sensor, rig: Rig, seen: ScanProgress, warn: Callable[[str], None]):
        self._plan, self._sensor, self._rig, self._seen, self._warn = plan, sensor, rig, seen, warn
        self._positions_mm = plan.stage.positions_mm()
        self._slip = SlipWatch()
        self._lit: LitPlace | None = None
        self._usual: tuple[int, float] | None = None
        self._without = 0

    def settle_exposures(self, between: Callable[[], None]) -> None:
        """Set the planned exposures, or the shortest that is needed at positions over the whole plan."""
        exposures, planned_ms = self._seen.exposure_ms, self._plan.planned_ms()
        lights: list[Light] = [light for light in dict.fromkeys(self._plan.lights) if light not in exposures]
        missing: list[Light] = [light for light in lights if light not in planned_ms]
        exposures.update({light: planned_ms[light] for light in lights if light in planned_ms})
        looked = select_evenly(self._positions_mm, _EXPOSED_AT)
        further = [position for position in select_evenly(self._positions_mm, LOOKS) if position not in looked]
        for position in looked + further if missing else ():
            if position in further and "laser" in exposures:
                break
            between()
            self._rig.move_to(position)
            for light in missing:
                self._settle(light, position)
        for light in missing:
            if light not in exposures:
                longest_ms = self._sensor.exposure.longest_ms
                if light == "laser":
                    raise self._explain_no_light(longest_ms)
                exposures[light] = longest_ms

    def _settle(self, light: Light, position_mm: float) -> None:
        """Shorten the exposure of a light if it is too long here; find it if nothing was seen in this light before."""
        exposures = self._seen.exposure_ms
        if light in exposures:
            here = measure_brightness(self._rig.frame(light, exposures[light]).image, self._sensor, light)
            if here.level <= self._sensor.exposure.auto_level:
                return
        exposure_ms = self._rig.find_exposure(light, start_ms=exposures.get(light, START_MS))
        if exposure_ms is None:
            return
        if light == "laser":
            # Daylight on an object's edges can look like a stripe at long exposures.
            lit, unlit = (self._rig.frame(each, exposure_ms).image for each in ("laser", "lamp"))
            if not self._shows_laser(lit, unlit):
                return
            self._lit = LitPlace(position_mm, exposure_ms)
        exposures[light] = min(exposure_ms, exposures.get(light, exposure_ms))

    def take(self, position_mm: float, light: Light, multiple: float, *, last: bool) -> Frame:
        """Take the frame to store, at a multiple of the light's own exposure; its time is not set.

        Only images at the light's own exposure are checked; longer ones of a bracket may be saturated.
        """
        rig, seen, zero_dn = self._rig, self._seen, self._plan.zero_dn(self._sensor)
        position = rig.move_to(position_mm)
        asked_ms = seen.exposure_ms[light] * multiple
        frame = rig.frame(light, asked_ms)
        bright = measure_brightness(frame.image, self._sensor, light)
        if (
            multiple == 1
            and bright.overexposed
            and light not in self._plan.planned_ms()
            and self._shorten(light, position_mm)
        ):
            asked_ms = seen.exposure_ms[light]
            frame = rig.frame(light, asked_ms)
            bright = measure_brightness(frame.image, self._sensor, light)
        image, exposure_ms = frame.image, asked_ms if frame.exposure_ms is None else frame.exposure_ms
        unlit = rig.frame("lamp", exposure_ms).image if zero_dn and light == "laser" else None
        if light == "laser" and multiple == 1:
            stripe, place = get_stripe(image, self._sensor, background=unlit), LitPlace(position_mm, exposure_ms)
            self._slip.add(Place(position, exposure_ms, select_centres(stripe)))
            self._check_laser(image, stripe, bright.level, place, unlit=unlit, last=last)
            self._count(stripe, bright)
        seen.repeated = rig.repeated
        if zero_dn:
            clipped = image >= self._sensor.detector.full_scale_dn()
            lit = image.astype(np.uint16)
            image = lit if unlit is None else subtract_background(image, unlit, clipped, zero_dn=zero_dn)
        return Frame(image, position, light == "laser", exposure_ms, 0.0)

    def _shows_laser(self, lit: np.ndarray, unlit: np.ndarray) -> bool:
        return shows_laser(lit, unlit, self._sensor, difference=self._plan.background)

    def _check_laser(
        self, image: np.ndarray, stripe: Stripe, level: float, here: LitPlace, *, unlit: np.ndarray | None, last: bool
    ) -> None:
        """Check that the laser emitted light in an image (H, W), before it is stored. The stage may move.

        ``level`` is the brightness of the stripe, which is compared with that of the image before. ``unlit`` (H, W) is
        an image without laser at the same position; if missing, it is taken when it is needed. No further image follows
        the ``last``. Raises HardwareError if the laser emits no light.
        """
        now = (int((stripe.status != StripeStatus.NO_STRIPE).sum()), level)
        if self._usual is None or any(a < _DROP * b for a, b in zip(now, self._usual, strict=True)):
            dark = self._rig.frame("lamp", here.exposure_ms).image if unlit is None else unlit
            if not self._shows_laser(image, dark):
                self._without += 1
                if last or self._without % _AGAIN == 1:
                    self._look_elsewhere(here)
                return
        self._usual, self._lit, self._without = now, here, 0

    def _look_elsewhere(self, here: LitPlace) -> None:
        """Look for the stripe where it was seen, or over the whole plan; raises HardwareError if it is nowhere."""
        others = [position for position in select_evenly(self._positions_mm, LOOKS) if position != here.position_mm]
        for place in [self._lit] if self._lit else [LitPlace(position, here.exposure_ms) for position in others]:
            self._rig.move_to(place.position_mm)
            lit, unlit = (self._rig.frame(light, place.exposure_ms).image for light in ("laser", "lamp"))
            if self._shows_laser(lit, unlit):
                self._lit = place
                self._rig.move_to(here.position_mm)
                return
        if self._lit is None:
            raise self._explain_no_light(here.exposure_ms)
        passed = self._without - 1
        also = f"; the {passed} images before this one have no stripe either" if passed else ""
        raise HardwareError(
            f"the laser has failed: at {self._lit.position_mm:g} mm, where its stripe was seen before, images with the "
            f"laser on and off show the same{also}. Check its supply, key and interlock, then continue with `resume`"
        )

    def _explain_no_light(self, exposure_ms: float) -> HardwareError:
        """Return the error for a scan that sees no stripe anywhere."""
        looked = select_evenly(self._positions_mm, LOOKS)
        return HardwareError(
            f"no laser light at any of {len(looked)} positions from {looked[0]:g} to {looked[-1]:g} mm, exposed by "
            f"{exposure_ms:.3g} ms: images with the laser on and off show the same. Is the laser on (supply, key, "
            "interlock), the object in the volume, the lens cap off?"
        )

    def check_steps(self) -> None:
        """Revisit an early place with relief, if any; raises HardwareError if the stage is displaced."""
        if (place := self._slip.place) is None:
            return
        self._rig.move_to(place.position_mm)
        image = self._rig.frame("laser", place.exposure_ms).image
        unlit = self._rig.frame("lamp", place.exposure_ms).image if self._plan.background else None
        slip_mm, error_mm = self._slip.measure_slip(select_centres(get_stripe(image, self._sensor, background=unlit)))
        if not np.isfinite(slip_mm):
            seen = "shows no stripe at its earlier place; or the laser has failed since the last image"
        elif self._slip.is_significant(slip_mm, error_mm):
            seen = f"shows a displacement of the stage of {slip_mm:+.2f} mm (std {error_mm:.2f} mm)"
        else:
            return
        raise HardwareError(
            f"the stage has lost steps, or sensor or object were moved: the image back at {place.position_mm:g} mm "
            f"{seen}. All images are recorded, but some at wrong positions: find the cause (feed, "
            "acceleration, an obstacle) and scan again with `overwrite`, or accept them with "
            "`resume`"
        )

    def _shorten(self, light: Light, position_mm: float) -> bool:
        """Find the exposure of a light again if it is too long; return False if that does not help."""
        before_ms = self._seen.exposure_ms[light]
        shorter_ms = self._rig.find_exposure(light, start_ms=before_ms)
        if shorter_ms is None or shorter_ms >= before_ms:
            return False
        self._seen.exposure_ms[light] = shorter_ms
        self._warn(
            f"{light} images at {position_mm:g} mm are saturated on many lines: exposed by {shorter_ms:.3g} ms from "
            f"here on, by {before_ms:.3g} ms before"
        )
        return True

    def count_stripe(self, stripe: Stripe) -> None:
        """Count the profile lines with a stripe."""
        self._seen.lines += len(stripe.status)
        self._seen.found += int((stripe.status == StripeStatus.OK).sum())

    def _count(self, stripe: Stripe, bright: Brightness) -> None:
        seen = self._seen
        self.count_stripe(stripe)
        if bright.overexposed:
            seen.saturated += 1
            if seen.saturated == 1:
                self._warn("a laser image is saturated on many lines: shorten laser_ms")
        if not bright.dark and bright.level < _FAINT:
            seen.faint += 1
