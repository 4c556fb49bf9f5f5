"""Camera, stage and laser behind the page: a thread does one task after another and shows live images in between.

Buttons put tasks into its queue by `Instrument.ask`. `laser_off`, `pause`, `resume` and `stop` act at once.
"""

import math
import queue
import sys
import threading
import time
import traceback
from collections.abc import Callable
from contextlib import ExitStack, suppress
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import partial
from pathlib import Path
from typing import ParamSpec

import numpy as np

from uwlts.calibration.calibrate import calibrate
from uwlts.desk.guided import guide
from uwlts.desk.guided_plan import GuidedPlan
from uwlts.desk.guided_screen import BoardScreen, darken
from uwlts.desk.laser_switch import LaserSwitch
from uwlts.desk.recording_view import BackgroundView, RecordingView
from uwlts.desk.shown_state import Board, Ended, FrameProfile, Picture
from uwlts.errors import DescriptionError, Error, HardwareError
from uwlts.hardware.camera_interface import CameraDevice, GrabbedFrame
from uwlts.hardware.continuous import ScanListeners
from uwlts.hardware.grbl import GrblStage
from uwlts.hardware.rig import START_MS, HandSwitchedLaser, LaserStage, Rig, get_stripe, measure_brightness
from uwlts.hardware.scan_plan import Light, ScanPlan
from uwlts.hardware.scanning import check_camera, open_camera, record_scan
from uwlts.model.calibration import AnyCalibration
from uwlts.model.sensor import Sensor
from uwlts.report.file_description import calibration_lines
from uwlts.storage.calibration_file import load_calibration
from uwlts.storage.capture import Capture, Frame, part_path
from uwlts.stripe import Stripe

_P = ParamSpec("_P")
_PREVIEW_S = 0.15  # pause between two live images
_MOST_LOST = 2  # consecutive live images that may be lost before an error is reported
_UNATTENDED_S = 5.0
"""Time without an operator's page after which live images with the laser end: loading it again takes less."""
_EARLIER = 200  # images of an interrupted scan that are shown again when it is continued


class InstrumentState(StrEnum):
    """State of the instrument, which determines the enabled buttons."""

    DISCONNECTED = "not connected"
    BUSY = "busy"
    READY = "ready"
    LOCKED = "the stage has to be homed, or unlocked where it stood still"
    SCANNING = "scanning"
    PAUSED = "paused"


@dataclass(frozen=True, eq=False)
class _Connected:
    plan: ScanPlan
    sensor: Sensor
    camera: CameraDevice
    stage: LaserStage
    closing: ExitStack


class Instrument:
    """Execution of the operator's tasks, with results on a board, from construction until `close`."""

    def __init__(self, board: Board):
        self._board = board
        self.switch = LaserSwitch(board, self.laser_off, in_use=lambda: self.laser_in_use)
        self._work: queue.Queue[Callable[[], None]] = queue.Queue()
        self._connected: _Connected | None = None
        self._ending, self._paused, self._stop = threading.Event(), threading.Event(), threading.Event()
        self.state = InstrumentState.DISCONNECTED
        self.light: Light | None = None
        self._screen: BoardScreen | None = None
        self._rig: Rig | None = None
        self._darkened, self._lost = False, 0
        self._live: Picture | None = None
        self._attended_s = -math.inf
        self.exposure_ms: dict[Light, float] = {"laser": START_MS, "lamp": START_MS}
        self.calibration: AnyCalibration | None = None
        """Calibration for the profile of live laser images."""
        self._thread = threading.Thread(target=self._run, name="instrument", daemon=True)
        self._thread.start()

    @property
    def _grbl(self) -> GrblStage | None:
        # Read once: another thread may disconnect.
        connected = self._connected
        return connected.stage if connected is not None and isinstance(connected.stage, GrblStage) else None

    # Immediate actions.

    def laser_off(self) -> None:
        """Switch the laser off at any time; this also ends a movement or a scan."""
        self.light = None
        if (screen := self._screen) is not None:
            screen.laser_off()
            return
        if (stage := self._grbl) is None:
            self._board.say("laser off: no laser is connected", "warning")
            return
        self._stop.set()
        self._paused.clear()
        self._darkened = True
        darken(stage, self._board)
        self._show_laser()
        self._work.put(self._recognise_darkening)

    def attend(self) -> None:
        """Record that an operator's page is open; live images with the laser end without it."""
        self._attended_s = time.monotonic()

    def show_light(self, light: Light | None) -> None:
        """Show live images in a light, or none; the laser is refused while no stage can switch it."""
        self.attend()
        if light == "laser" and self.state != InstrumentState.READY:
            self._board.say(f"the laser stays off: {self.state}", "warning")
        elif light == "laser" and not self._switches_laser():
            self._board.say("the laser stays off: no stage is connected that could switch it", "warning")
        else:
            self.light = light
            self._board.say("live images end" if light is None else f"live images with {light}")

    @property
    def laser_in_use(self) -> bool:
        """True if the laser is on, or may be switched on by the current task."""
        return self._board.laser in ("on", "flashing") or self.state in (InstrumentState.SCANNING, InstrumentState.BUSY)

    def pause(self) -> None:
        """Pause the scan after the present image, with the laser off."""
        if self.state == InstrumentState.SCANNING:
            self._paused.set()

    def resume(self) -> None:
        """Resume a paused scan."""
        self._paused.clear()

    def stop(self) -> None:
        """End a scan or a guided calibration after the present image; it can be continued later."""
        self._stop.set()
        self._paused.clear()
        if (screen := self._screen) is not None:
            screen.end()

    def answer(self, answer: str) -> None:
        """Pass the operator's answer to a guided calibration."""
        if (screen := self._screen) is not None:
            screen.press(answer)

    def close(self) -> None:
        """End all tasks and switch the laser off, once."""
        self._ending.set()
        self.stop()
        self._work.put(lambda: None)
        self._thread.join(30.0)

    def ask(self, task: Callable[_P, None], *args: _P.args, **kwargs: _P.kwargs) -> None:
        """Put a task into the queue of the worker thread."""
        self._work.put(partial(task, *args, **kwargs))

    def _run(self) -> None:
        while not self._ending.is_set():
            try:
                # Live images are shown when no other task waits.
                work = self._work.get(timeout=_PREVIEW_S)
            except queue.Empty:
                work = self._show_preview
            self._do(work)
        self._do(self.disconnect)

    def _do(self, work: Callable[[], None]) -> None:
        try:
            work()
        except Ended:
            self._board.say("stopped")
        except Error as error:
            # A task that was interrupted by switching the laser off by hand is expected to fail.
            if not self._darkened:
                self._board.say(str(error), "error")
            self.light = None
        except Exception as error:
            traceback.print_exc(file=sys.stderr)
            self._board.say(f"a bug in the program: {type(error).__name__}: {error}", "error")
            self.light = None
        self._settle_state()

    def _settle_state(self) -> None:
        stage, board = self._grbl, self._board
        if self._connected is None:
            self.state = InstrumentState.DISCONNECTED
        elif stage is not None and not stage.position_known:
            self.state = InstrumentState.LOCKED
        else:
            self.state = InstrumentState.READY
        how_it_ended = self.state == InstrumentState.READY and board.progress.phase in ("finished", "stopped")
        if board.progress.phase != self.state and not how_it_ended:
            board.phase(self.state, busy=False)
        self._show_laser()

    def _show_laser(self) -> None:
        if (stage := self._grbl) is None:
            self._board.laser = "none"
        elif stage.laser_unreachable:
            self._board.laser = "unknown"
        elif stage.laser_power > 0:
            self._board.laser = "on"
        else:
            previewed = self.state == InstrumentState.READY and self.light == "laser"
            used = not self._darkened and (previewed or self.state == InstrumentState.SCANNING)
            self._board.laser = "flashing" if used else "off"

    def _switches_laser(self) -> bool:
        return (stage := self._grbl) is not None and stage.position_known

    def _begin(self, phase: str) -> _Connected:
        if self._connected is None:
            raise HardwareError("nothing is connected: connect a camera first")
        self.state = InstrumentState.BUSY
        self._board.phase(phase)
        self._end_live()
        self._show_laser()
        return self._connected

    def _end_live(self) -> None:
        """Change the caption of the last live picture."""
        if self._live is not None and self._live is self._board.picture:
            self._board.show(replace(self._live, caption=f"not {self._live.caption}"))
        self._live = None

    # Tasks.

    def connect(self, plan: ScanPlan, *, camera: str, stage: str | None) -> None:
        """Open the camera, and the stage if its port is given, for a plan."""
        self.disconnect()
        self.state = InstrumentState.BUSY
        self._board.phase("connecting")
        if not camera:
            raise DescriptionError("give the camera's address, as in gige:NAME or replay:scan.h5")
        sensor = plan.described_sensor()
        with ExitStack() as stack:
            opened = stack.enter_context(open_camera(camera))
            check_camera(opened, sensor)
            moved: LaserStage = HandSwitchedLaser(self._board.say)
            if stage is not None:
                moved = stack.enter_context(GrblStage(stage))
                stack.callback(self.switch.lend, None)
                self.switch.lend(moved)
            self._connected = _Connected(plan, sensor, opened, moved, stack.pop_all())
        self.exposure_ms |= plan.planned_ms()
        self._board.say(f"connected: {opened.info.name} {opened.info.serial}".strip())
        if isinstance(moved, GrblStage):
            low, high = moved.limits_mm
            self._board.say(f"connected: Grbl {moved.version} on {stage}, travel {low:g} to {high:g} mm")
            self._board.position_mm = moved.position_mm() if moved.position_known else None
        else:
            self._board.say("no stage is connected: images are shown, nothing can be scanned")
        self.light = "lamp"

    def disconnect(self) -> None:
        """Close camera and stage."""
        connected, self._connected, self._rig, self.light = self._connected, None, None, None
        self._end_live()
        if connected is not None:
            self._board.position_mm = self._board.profile = None
            try:
                connected.closing.close()
            except Error as error:
                self._board.say(str(error), "warning")
            self._board.say("disconnected")

    def _require_stage(self) -> GrblStage:
        if (stage := self._grbl) is None:
            raise HardwareError("no stage is connected")
        return stage

    def _prepare_rig(self, connected: _Connected) -> Rig:
        """Return the rig, a new one after another task has used camera or stage."""
        if self._rig is None:
            plan, stage = connected.plan, connected.stage
            self._rig = Rig(plan, plan.stage, connected.sensor, connected.camera, stage, ahead=plan.stage.step_mm)
        return self._rig

    def _run_move(self, phase: str, work: Callable[[GrblStage], float]) -> None:
        self._begin(phase)
        stage, self._rig = self._require_stage(), None
        self._stop.clear()
        self._board.position_mm = work(stage)
        self._board.say(f"{phase} done: the stage is at {self._board.position_mm:.3f} mm")

    def home(self) -> None:
        """Home the stage."""
        self._run_move("homing", GrblStage.home)

    def unlock(self) -> None:
        """Unlock the stage and accept its position."""
        self._run_move("unlocking", GrblStage.unlock)

    def move(self, position_mm: float) -> None:
        """Move the stage to a position."""
        connected = self._begin(f"moving to {position_mm:.3f} mm")
        self._require_stage()
        self._board.position_mm = self._prepare_rig(connected).move_to(position_mm)

    def jog(self, by_mm: float) -> None:
        """Move the stage by some mm."""
        self._begin("moving")
        stage = self._require_stage()
        low, high = stage.limits_mm
        self.move(float(np.clip(stage.position_mm() + by_mm, low, high)))

    def _recognise_darkening(self) -> None:
        if (stage := self._grbl) is not None and not stage.faulty:
            # The next exchange detects the reset and sets the fault.
            with suppress(HardwareError):
                stage.position_mm()
        self._darkened = False

    def find_exposure(self) -> None:
        """Find the exposure for the light that is shown."""
        light, connected = self.light, self._begin("finding the exposure")
        if light is None:
            raise HardwareError("choose first which light is shown")
        if light == "laser":
            self._board.laser = "flashing"
        found = self._prepare_rig(connected).find_exposure(light, start_ms=self.exposure_ms[light])
        if found is None:
            self._board.say(f"too dark for a {light} image even at the longest exposure", "warning")
            return
        self.exposure_ms[light] = found
        self._board.say(f"{light}: exposed by {found:.4g} ms")

    def _show_preview(self) -> None:
        connected, light = self._connected, self.light
        if light == "laser" and not self._switches_laser():
            # A fault, or Laser off, has locked the stage.
            light = self.light = None
        if light == "laser" and time.monotonic() - self._attended_s > _UNATTENDED_S:
            light = self.light = None
            self._board.say("live images with the laser end: no operator's page is open", "warning")
        if connected is None or light is None or connected.stage.faulty:
            if connected is not None and connected.stage.faulty:
                # No live image until the stage is homed or unlocked; then the rig is set up again.
                self._rig = None
            self._end_live()
            return
        try:
            frame = self._prepare_rig(connected).frame(light, self.exposure_ms[light])
        except HardwareError:
            # A busy computer loses frames occasionally.
            self._lost += 1
            if self._lost > _MOST_LOST or connected.stage.faulty or not connected.camera.running:
                raise
            return
        self._lost = 0
        seen = measure_brightness(frame.image, connected.sensor, light)
        full, exposure_ms = connected.sensor.detector.full_scale_dn(), frame.exposure_ms or self.exposure_ms[light]
        caption = f"live, {light}, exposure {exposure_ms:.4g} ms, {100 * seen.level:.0f} % of full scale"
        pixels = None
        if light == "laser":
            stripe = get_stripe(frame.image, connected.sensor)
            pixels = stripe.pixels()
            caption += f"; stripe on {len(pixels)} of {len(stripe.status)} profile lines"
            self._show_profile(connected, frame, stripe)
        saturated = seen.saturated / max(seen.counted, 1)
        self._live = Picture(frame.image, full_dn=full, caption=caption, stripe=pixels, saturated=saturated)
        self._board.show(self._live)

    def _show_profile(self, connected: _Connected, frame: GrabbedFrame, stripe: Stripe) -> None:
        """Show the points of a live laser image; a calibration that does not fit is not used again."""
        if self.calibration is None:
            return
        # Until the first movement the position may be unknown.
        place_mm, exposure_ms = self._board.position_mm or 0.0, frame.exposure_ms or 0.0
        placed = Frame(frame.image, place_mm, True, exposure_ms, frame.time_s)
        profile = FrameProfile(placed, stripe, connected.plan.header("live"), self.calibration)
        try:
            # Making the points shows whether the calibration fits.
            self._board.profile = profile if len(stripe.lines) and len(profile.points) else None
        except Error as error:
            self.calibration = None
            self._board.say(f"no profile is shown: {error}", "error")

    def scan(self, plan: ScanPlan, out: Path, *, calibration: Path | None, resume: bool, overwrite: bool) -> None:
        """Record a scan by a plan.

        A ``calibration`` gives a cloud that grows during the scan. ``resume`` continues an interrupted capture.
        """
        known: AnyCalibration | None = None if calibration is None else load_calibration(calibration)
        connected, board = self._begin("beginning the scan"), self._board
        stage = self._require_stage()
        self._stop.clear()
        self._paused.clear()
        view = RecordingView(board, plan.header(out.stem), known, name=out.name)
        begun: list[int] = []
        if resume and part_path(out).is_file():
            with Capture(part_path(out)) as earlier:
                for number in range(0, len(earlier), -(-len(earlier) // _EARLIER) or 1):
                    view.show(earlier[number], number)

        def progress(done: int, total: int, stage: str = "") -> None:
            begun[:] = begun or [done - 1]
            board.count(done, total, before=begun[0])
            self._show_laser()

        def report(line: str) -> None:
            board.say(line)
            if line in ("recording", "finding the exposures", "checking for lost steps"):
                board.phase(line)

        # The rig does not know exposure and position after the scan.
        self.state, self._rig, kept_light = InstrumentState.SCANNING, None, self.light
        self._show_laser()
        try:
            with BackgroundView(view.show) as shown:
                seen = record_scan(
                    plan,
                    out,
                    camera=connected.camera,
                    stage=stage,
                    resume=resume,
                    overwrite=overwrite,
                    listeners=ScanListeners(
                        progress,
                        report,
                        warn=lambda text: board.say(text, "warning"),
                        between=self._pause_between_images,
                        recorded=shown.put,
                    ),
                )
        finally:
            board.phase("stopped", busy=False)
            # Do not switch the laser on again automatically.
            self.light = kept_light and "lamp"
        board.position_mm = stage.position_mm()
        for warning in seen.warnings():
            board.say(warning, "warning")
        board.say(f"wrote {out.name}")
        board.phase("finished", busy=False)

    def calibrate(self, plan: GuidedPlan, out: Path, *, resume: bool, overwrite: bool) -> None:
        """Lead through a guided calibration, which opens camera and stage itself, and calculate it."""
        self.disconnect()
        board = self._board
        self.state = InstrumentState.BUSY
        board.phase("guided calibration")
        screen = self._screen = BoardScreen(board, self.switch)
        try:
            recording = guide(plan, out, screen, resume=resume, overwrite=overwrite)
        finally:
            self._screen, board.request = None, ""
        for line in recording.missing:
            board.say(f"still missing: {line}; continue it for more images", "warning")
        board.phase("calibrating")
        found = calibrate(
            air=recording.air, water=recording.water, step=recording.step, target_poses=recording.poses, refractions=2
        )
        found.save(out, overwrite=overwrite)
        for line in calibration_lines(found):
            board.say(line)
        for warning in found.origin().warnings:
            board.say(warning, "warning")
        board.say(f"wrote {out.name}")
        board.phase("finished", busy=False)

    def _pause_between_images(self) -> None:
        """Pause or stop between two images of a scan, if requested."""
        if self._paused.is_set():
            self.state, before = InstrumentState.PAUSED, self._board.progress
            self._show_laser()
            self._board.say("paused, the laser is off")
            while self._paused.is_set():
                time.sleep(0.05)
            self.state, self._board.progress = InstrumentState.SCANNING, before
            self._show_laser()
        if self._stop.is_set():
            raise Ended
        self._show_laser()
