"""Continuous recording: the stage travels at a constant speed while the camera runs at its own frame rate.

Frames are assigned positions by time. The camera stamps each frame, and the stage reports its position about ten times
a second. A line fitted to the reports of a pass gives the position at any time. Alternatively, an encoder wired to the
camera delivers a count with each frame. The delay between the two clocks is measured by a return pass over the same
surface (`measure_latency`).
"""

import math
import threading
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from uwlts.errors import EvaluationError, HardwareError, RangeError
from uwlts.fitting.least_squares import DEFAULT_K, robust_std
from uwlts.hardware.camera_interface import CameraDevice, GrabbedFrame
from uwlts.hardware.grbl import GrblStage, StageReport
from uwlts.hardware.scan_plan import Continuous, ScanPlan
from uwlts.model.sensor import CaptureHeader
from uwlts.model.stripe import Stripe
from uwlts.reconstruction.latency import measure_latency
from uwlts.runtime.progress import ProgressListener, ignore_progress
from uwlts.storage.capture import Frame
from uwlts.storage.capture_writer import CaptureWriter
from uwlts.storage.numbering import unwrap_counts
from uwlts.stripe import extract_stripe, warm_up

_SPARE_MM, _SPARE_S = 1.0, 0.3
"""Travel at constant speed before and after the stored frames: a distance, and in addition a time."""
_TRIGGERS = 8  # triggered frames used to compare the clocks; the one with the shortest delay counts
_PATIENCE_S = 3.0  # longest wait for a frame beyond its exposure
_GAP_S = 0.8
"""Longest gap between frames while the laser is on, including the braking time. Its detection takes 0.1 s more."""
_SLOW_REPORT = 2.0  # reports that took this many times as long as the fastest are ignored: their time is less certain
_FEWEST_REPORTS = 4  # of the stage's position: two determine the motion, the others check it
_SET_S = 0.1
"""Least change of the offset between both clocks that is neither drift (100 ppm in 15 minutes) nor a busy computer."""
_BUSY = 0.9  # largest fraction of the frame period that the exposure may take


@dataclass(frozen=True)
class ScanListeners:
    """Functions that a scan calls: ``report`` and ``warn`` with lines of text, ``progress`` as in `uwlts.scan`.

    ``between`` is called before every image, with the laser off: it may wait, or end the scan by an exception.
    ``recorded`` is called with every image that is in the file, and its number; ``counted`` with the stripe of every
    frame of a continuous scan.
    """

    progress: ProgressListener = ignore_progress
    report: Callable[[str], None] = lambda line: None
    warn: Callable[[str], None] = lambda text: None
    between: Callable[[], None] = lambda: None
    recorded: Callable[[Frame, int], None] = lambda frame, number: None
    counted: Callable[[Stripe], None] = lambda stripe: None


def plan_passes(plan: ScanPlan, continuous: Continuous, stage: GrblStage) -> list[tuple[float, float]]:
    """Return the start and end of each pass in mm, ramps included; raises RangeError if the stage cannot do it."""
    speed, settings = continuous.speed_mm_per_s, stage.settings
    if 60 * speed > settings.max_feed_mm_per_min:
        raise RangeError(
            f"speed_mm_per_s is {speed:g}, the stage does at most {settings.max_feed_mm_per_min / 60:g} mm/s ($110)"
        )
    if speed > (fastest := stage.fastest_sweep_mm_per_s):
        raise RangeError(
            f"speed_mm_per_s is {speed:g}, too fast for a moving stage with the laser on: at most {fastest:.3g} mm/s, "
            "so that the stage stops by itself in time ($120)"
        )
    positions = plan.stage.positions_mm()
    ahead = 1.0 if positions[-1] >= positions[0] else -1.0
    ramp = _compute_ramp_mm(speed, stage) + _SPARE_MM + _SPARE_S * speed
    first, last = positions[0] - ahead * ramp, positions[-1] + ahead * ramp
    low, high = stage.limits_mm
    if min(first, last) < low or max(first, last) > high:
        raise RangeError(
            f"with {ramp:.1f} mm to reach {speed:g} mm/s the stage would go from {min(first, last):.1f} to "
            f"{max(first, last):.1f} mm, but its travel is {low:g} to {high:g} mm: travel more slowly, or scan less"
        )
    return [(first, last), (last, first)] if continuous.both_ways else [(first, last)]


def _compute_ramp_mm(speed: float, stage: GrblStage) -> float:
    """Return the acceleration distance in mm to a speed in mm/s."""
    return speed**2 / (2 * stage.settings.acceleration_mm_per_s2)


def record_continuously(
    plan: ScanPlan,
    out: Path,
    *,
    camera: CameraDevice,
    stage: GrblStage,
    header: CaptureHeader,
    exposure_ms: float,
    overwrite: bool,
    listeners: ScanListeners,
) -> str:
    """Record the passes of a plan, assign positions to its frames, and return a line about latency and speed.

    The errors are those of `uwlts.desk.scan.scan`.
    """
    sensor, continuous, warn = header.sensor, plan.continuous, listeners.warn
    assert continuous is not None
    positions, passes = plan.stage.positions_mm(), plan_passes(plan, continuous, stage)
    rate_hz = continuous.speed_mm_per_s / abs(plan.stage.step_mm)
    if 1e-3 * exposure_ms * rate_hz > _BUSY:
        raise RangeError(
            f"at {continuous.speed_mm_per_s:g} mm/s the camera has {1e3 / rate_hz:.3g} ms for a step of "
            f"{abs(plan.stage.step_mm):g} mm, too little for an exposure of {exposure_ms:.3g} ms: travel more slowly"
        )
    expected = len(positions) * len(passes)
    dtype = np.dtype(np.uint16 if camera.info.bits > 8 else np.uint8)
    settings = {"exposure_ms": exposure_ms, "gain_db": plan.gain_db, "bits": sensor.detector.bits}
    camera.stop()
    warm_up()  # before the laser is on: the first image would hold up the frames after it
    stage.move_to(passes[0][0], feed_mm_per_min=plan.stage.feed_mm_per_min)
    offset_s, encoder = _compare_clocks(camera, **settings)
    at_rest_mm = stage.position_mm()
    rate_set = camera.configure(**settings, frame_rate_hz=rate_hz).frame_rate_hz
    if rate_set is None or abs(rate_set / rate_hz - 1) > 0.01:
        warn(f"the camera takes {rate_set} frames/s where the plan needs {rate_hz:.4g}: steps differ from the plan's")
    with CaptureWriter(out, header, dtype=dtype, moving=True, plan=plan.make_record(), overwrite=overwrite) as writer:
        frame_s, within = 1e-3 * exposure_ms + 1.0 / rate_hz, (min(positions), max(positions))
        braking_s = continuous.speed_mm_per_s / stage.settings.acceleration_mm_per_s2

        def stored(frame: Frame, stripe: Stripe, number: int) -> None:
            listeners.counted(stripe)
            listeners.progress(min(number + 1, expected), expected)
            listeners.recorded(frame, number)

        times = {"frame_s": frame_s, "longest_s": frame_s + _GAP_S - braking_s}
        reader = _FrameReader(camera, writer, stored, offset_s, exposure_ms, within_mm=within, **times)
        camera.start(faults="skip")
        thread = threading.Thread(target=reader.run, name="continuous-frames", daemon=True)
        feed_mm_per_min = 60 * continuous.speed_mm_per_s
        try:
            thread.start()
            for _, end in passes:
                reader.begin_pass()
                stage.sweep(end, feed_mm_per_min=feed_mm_per_min, power=plan.laser_power, reported=reader.report)
            reader.end_s = time.monotonic()
            listeners.report("waiting for the last frames")
            thread.join()
        finally:
            reader.ending.set()
            with suppress(RuntimeError):  # raised if the thread was not started
                thread.join()
            camera.stop()
        if reader.error is not None:
            raise reader.error
        if continuous.mm_per_count is None:
            set_s = _compare_clocks(camera, **settings)[0] - offset_s
            if abs(set_s) > _SET_S:
                raise HardwareError(
                    f"the camera's clock was set by {-set_s:+.3g} s during the scan: positions of frames are "
                    "not known: switch off its synchronisation (PTP), or wait until it has settled"
                )
        if lost := camera.counts.dropped + camera.counts.short:
            warn(f"{lost} frames were lost between camera and computer: the steps there are larger")
        ends = sorted(passes[0])
        ramp = _compute_ramp_mm(continuous.speed_mm_per_s, stage)
        return reader.assign_positions(continuous, (ends[0] + ramp, ends[1] - ramp), (at_rest_mm, encoder), warn)


def _compare_clocks(camera: CameraDevice, *, exposure_ms: float, **settings: Any) -> tuple[float, int | None]:
    """Return the offset in s from the camera's time stamps to `time.monotonic`, and the encoder count at rest."""
    offsets, encoder = [], None
    camera.configure(exposure_ms=exposure_ms, **settings, trigger="software")
    camera.start(faults="skip")
    for _ in range(_TRIGGERS):
        asked_s = time.monotonic()
        camera.trigger()
        frame = camera.grab(_PATIENCE_S + 1e-3 * exposure_ms)
        offsets.append(asked_s - frame.time_s)
        encoder = frame.encoder
    camera.stop()
    # A delayed time stamp makes the difference too small, never too large.
    return max(offsets), encoder


class _FrameReader:
    """Reader of camera frames in its own thread, which stores those within the planned positions."""

    def __init__(
        self,
        camera: CameraDevice,
        writer: CaptureWriter,
        stored: Callable[[Frame, Stripe, int], None],
        offset_s: float,
        exposure_ms: float,
        *,
        within_mm: tuple[float, float],
        frame_s: float,
        longest_s: float,
    ):
        self._camera, self._writer, self._stored = camera, writer, stored
        self._offset_s, self._exposure_ms, self._within_mm = offset_s, exposure_ms, within_mm
        self._frame_s, self._longest_s = frame_s, longest_s
        self._passes: list[list[StageReport]] = []
        self._pending: deque[tuple[GrabbedFrame, float]] = deque()
        self._stripes: list[np.ndarray] = []
        self._times: list[float] = []
        self._encoders: list[float] = []
        self._began_s, self._heard_s = time.monotonic(), math.inf
        self.end_s: float | None = None
        self.ending = threading.Event()
        self.error: Exception | None = None

    def begin_pass(self) -> None:
        """Assign the following reports to a new pass."""
        self._passes.append([])
        self._heard_s = time.monotonic()

    def report(self, report: StageReport) -> None:
        """Add a report of the stage; raises the error that ended the reading, or HardwareError without frames."""
        self._passes[-1].append(report)
        if self.error is not None:
            raise self.error
        if time.monotonic() - self._heard_s > self._longest_s:
            raise HardwareError(
                f"the camera gave no frame for {self._longest_s:.2g} s while the laser was on: check power and cable, "
                "and whether it is fast enough"
            )

    def run(self) -> None:
        """Read frames until one was exposed after the end of the last pass."""
        try:
            while not self.ending.is_set():
                frame = self._camera.grab(_PATIENCE_S + self._frame_s)
                self._heard_s = time.monotonic()
                middle_s = frame.time_s + self._offset_s + 0.5e-3 * self._exposure_ms
                self._pending.append((frame, middle_s))
                self._store_located()
                # By both clocks, as the camera's may be set.
                if self.end_s is not None and max(middle_s, time.monotonic() - _PATIENCE_S) > self.end_s:
                    return
        except Exception as error:
            self.error = error

    def _store_located(self) -> None:
        """Store the frames exposed before the latest report, with positions interpolated between reports."""
        known = [each for one in list(self._passes) for each in list(one)]
        if not known:
            return
        times, places = np.array([_date(each) for each in known]), [each.position_mm for each in known]
        while self._pending and (self._pending[0][1] < times[-1] or self.end_s is not None):
            frame, middle_s = self._pending.popleft()
            place = float(np.interp(middle_s, times, places))
            if not (self._within_mm[0] <= place <= self._within_mm[1] and times[0] <= middle_s <= times[-1]):
                continue
            exposure_ms = self._exposure_ms if frame.exposure_ms is None else frame.exposure_ms
            kept = Frame(frame.image, place, True, exposure_ms, middle_s - self._began_s)
            self._writer.append(kept)
            header = self._writer.header
            along, full_dn = header.sensor.camera.stripe_along, header.saturation_dn
            stripe = extract_stripe(frame.image, stripe_along=along, saturation=full_dn)
            self._stripes.append(stripe.centre_px)
            self._times.append(middle_s)
            self._encoders.append(np.nan if frame.encoder is None else frame.encoder)
            self._stored(kept, stripe, len(self._times) - 1)

    def assign_positions(
        self,
        continuous: Continuous,
        even: tuple[float, float],
        at_rest: tuple[float, int | None],
        warn: Callable[[str], None],
    ) -> str:
        """Assign final positions to all frames, from lines fitted where the speed is constant; return a line of text.

        ``even`` is the range of positions in mm with constant speed, ``at_rest`` are position and encoder count before
        the travel. Raises HardwareError if no frame shows a stripe,
        or if there are too few reports.
        """
        times, centres = np.array(self._times), np.array(self._stripes)
        if not len(times) or not np.isfinite(centres).any():
            raise HardwareError(
                f"no stripe in any of {len(times)} frames: is the laser on (supply, key, interlock), the exposure "
                "long enough, the object in the volume?"
            )
        stage, speed, scatters, speeds = np.full(len(times), np.nan), np.zeros(len(times)), [], []
        for one in self._passes:
            within = (times >= _date(one[0])) & (times <= _date(one[-1])) if one else np.zeros(len(times), bool)
            if not within.any():
                continue
            constant = [each for each in one if even[0] <= each.position_mm <= even[1]]
            stage[within], speed[within], scatter_s = _fit_line(constant, times[within])
            scatters.append(scatter_s)
            speeds.append(float(speed[within][0]))
        if continuous.mm_per_count is not None:
            counts = np.array(self._encoders)
            if at_rest[1] is None or not np.isfinite(counts).all():
                raise HardwareError(
                    "mm_per_count is given, but the camera sends no ChunkEncoderValue with its frames: wire the "
                    "encoder to it and set its EncoderSource, or leave mm_per_count out"
                )
            counts = unwrap_counts(np.append(at_rest[1], counts), continuous.encoder_bits)
            stage = at_rest[0] + continuous.mm_per_count * (counts[1:] - counts[0])
        latency_s, std_s = 1e-3 * (continuous.latency_ms or 0.0), None
        if continuous.latency_ms is None and continuous.mm_per_count is None:
            try:
                latency_s, std_s = measure_latency(centres, stage, speed)
            except EvaluationError as error:
                warn(f"the latency of the stage is unknown and taken as 0: {error}")
        stage = stage + speed * latency_s
        reports = [(_date(each) - self._began_s, each.position_mm) for one in self._passes for each in one]
        self._writer.place(stage, speed, np.array(reports))
        known = "as given" if std_s is None else f"measured, std {1e3 * std_s:.3f} ms"
        return (
            f"latency of the stage {1e3 * latency_s:+.3f} ms ({known}); its reports scatter by "
            f"{1e3 * max(scatters):.2f} ms; speed {', '.join(f'{each:+.3f}' for each in speeds)} mm/s"
        )


def _date(report: StageReport) -> float:
    return 0.5 * (report.asked_s + report.answered_s)


def _fit_line(reports: list[StageReport], at_s: np.ndarray) -> tuple[np.ndarray, float, float]:
    """Fit a line to the reports of a pass at constant speed, without slow ones and outliers.

    Return the positions in mm at times (N,) in s, the speed in mm/s, and the scatter of the reports as a time in s.
    Raises HardwareError if there are too few reports.
    """
    if len(reports) < _FEWEST_REPORTS:
        raise HardwareError(
            f"the stage reported {len(reports)} positions at constant speed within a pass, expected at least "
            f"{_FEWEST_REPORTS}: travel more slowly, or scan a longer distance"
        )
    # At least half of the reports, the fastest, are used.
    took = np.sort([each.answered_s - each.asked_s for each in reports])
    longest = max(_SLOW_REPORT * took[0], took[max(len(reports) // 2, _FEWEST_REPORTS - 1)])
    used = [each for each in reports if each.answered_s - each.asked_s <= longest]
    times, places = np.array([_date(each) for each in used]), np.array([each.position_mm for each in used])
    middle, kept, speed, start = times.mean(), np.ones(len(used), bool), 0.0, 0.0
    outside, fitted = places, kept
    for _ in range(3):
        speed, start = np.polyfit(times[kept] - middle, places[kept], 1)
        outside, fitted = places - (start + speed * (times - middle)), kept
        kept = np.abs(outside) <= DEFAULT_K * max(robust_std(outside), 1e-6)
    # The line takes two degrees of freedom.
    scatter = float(np.sqrt((outside[fitted] ** 2).sum() / max(np.count_nonzero(fitted) - 2, 1)))
    return start + speed * (at_s - middle), float(speed), scatter / abs(float(speed))
