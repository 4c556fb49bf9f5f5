"""Scans on request that give the points of each image: recorded by a plan, or played from a capture."""

import math
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from itertools import count
from pathlib import Path

import numpy as np

from uwlts.desk.guided import Ended
from uwlts.desk.recording_view import LOOK_S, BackgroundView, follow_frames
from uwlts.desk.shown_state import FrameProfile
from uwlts.errors import Error, HardwareError
from uwlts.hardware.camera_interface import CameraDevice
from uwlts.hardware.continuous import ScanListeners
from uwlts.hardware.grbl import GrblStage
from uwlts.hardware.scan_plan import ScanPlan
from uwlts.hardware.scanning import record_scan
from uwlts.model.any_calibration import AnyCalibration
from uwlts.optics.fitness import check_fits
from uwlts.storage.capture import CaptureHeader, Frame, part_path
from uwlts.storage.cloud import PointCloud
from uwlts.stripe import find_stripe, warm_up


class ScanService:
    """Scans on request, one at a time, each in a thread of its own: recorded by a plan, or played from a capture.

    `start`, `stop` and `laser_off` return at once, with a text for the caller; they raise Error if refused. ``publish``
    is called with the points of each laser image, and the time of the image in s since the start of the scan. A played
    capture may still be recorded by another program; it needs neither camera nor stage. ``home`` homes the stage before
    a scan for which it is locked, ``unlock`` accepts its position. ``scans`` is the number of scans begun.
    """

    def __init__(
        self,
        source: ScanPlan | Path,
        calibration: AnyCalibration,
        publish: Callable[[PointCloud, float], None],
        *,
        folder: Path = Path(),
        camera: CameraDevice | None = None,
        stage: GrblStage | None = None,
        home: bool = False,
        unlock: bool = False,
        report: Callable[[str], None] = lambda line: None,
    ):
        self._source, self._calibration, self._publish, self._report = source, calibration, publish, report
        self._folder, self._camera, self._stage, self._home, self._unlock = folder, camera, stage, home, unlock
        self._stop, self._thread = threading.Event(), threading.Thread()
        self.scans = 0
        warm_up()

    def start(self) -> str:
        """Begin a scan; HardwareError if one is running, CalibrationError if the calibration is of another sensor."""
        if self._thread.is_alive():
            raise HardwareError("a scan is running: stop it first")
        if isinstance(self._source, Path):
            work, said = self._play, f"playing {self._source.name}"
        else:
            path = self._free_path(self._source.title)
            check_fits(self._source.header(path.stem), self._calibration, source=path.name)
            work, said = lambda: self._record(path), f"recording {path.name}"
        self._stop.clear()
        self.scans += 1
        self._thread = threading.Thread(target=self._run, args=(work,), name="scan", daemon=True)
        self._thread.start()
        return said

    def stop(self) -> str:
        """End the scan after the present image; HardwareError if none is running."""
        if not self._thread.is_alive():
            raise HardwareError("no scan is running")
        self._stop.set()
        return "the scan ends after the present image"

    def laser_off(self) -> str:
        """Switch the laser off at once, which ends a scan; HardwareError if that fails."""
        self._stop.set()
        if self._stage is None:
            raise HardwareError("no laser is connected: a capture is played")
        if not self._stage.darken():
            raise HardwareError("the laser CANNOT be switched off: switch its power off before going near")
        return "laser switched off: the next start needs a stage that is homed, or unlocked if it stood still"

    def wait(self, timeout_s: float | None = None) -> None:
        """Wait for the end of the scan."""
        if self._thread.ident is not None:
            self._thread.join(timeout_s)

    def _run(self, work: Callable[[], str]) -> None:
        try:
            self._report(work())
        except Ended:
            self._report("stopped")
        except Error as error:
            self._report(f"error: {error}")

    def _free_path(self, title: str) -> Path:
        name = "".join(sign if sign.isalnum() else "-" for sign in title.lower())
        paths = (self._folder / f"{name}-{number:03}.h5" for number in count(1))
        return next(path for path in paths if not (path.exists() or part_path(path).exists()))

    def _record(self, out: Path) -> str:
        plan, camera, stage = self._source, self._camera, self._stage
        if not isinstance(plan, ScanPlan) or camera is None or stage is None:
            raise HardwareError("camera and stage are not connected")
        if not stage.position_known and self._home:
            stage.home()
        elif not stage.position_known and self._unlock:
            stage.unlock()
        header = plan.header(out.stem)
        with BackgroundView(lambda frame, number: self._show(frame, number, header)) as shown:
            listeners = ScanListeners(report=self._report, between=self._end_if_stopped, recorded=shown.put)
            seen = record_scan(plan, out, camera=camera, stage=stage, listeners=listeners)
        return "; ".join([f"wrote {out}", *seen.warnings()])

    def _play(self) -> str:
        """Publish the images of a capture at the speed of the recording, and new ones of a recording when they come."""
        path = Path(str(self._source))
        finished, ahead_s = path.is_file(), math.nan
        for seen in follow_frames(path):
            self._end_if_stopped()
            if seen is None:
                self._stop.wait(LOOK_S)
                continue
            header, number, frame = seen
            if math.isnan(ahead_s):
                ahead_s = time.monotonic() - frame.time_s
            if finished:
                self._stop.wait(max(ahead_s + frame.time_s - time.monotonic(), 0.0))
            self._show(frame, number, header)
        return f"played {path}"

    def _end_if_stopped(self) -> None:
        if self._stop.is_set():
            raise Ended

    def _show(self, frame: Frame, number: int, header: CaptureHeader) -> None:
        if not frame.laser_on:
            return
        stripe = find_stripe(
            frame.seen, stripe_along=header.sensor.camera.stripe_along, saturation=header.saturation_dn
        )
        if len(stripe.lines):
            cloud = FrameProfile(frame, stripe, header, self._calibration).measured()
            placed = {"frame": np.full(len(cloud), number), "time_s": np.full(len(cloud), frame.time_s)}
            self._publish(replace(cloud, **placed), frame.time_s)

    def close(self) -> None:
        """End the scan, and wait for its end."""
        self._stop.set()
        self.wait()
