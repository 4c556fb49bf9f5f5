"""Common interface of all cameras: settings, frames, and the check of every frame; the replay of images.

A driver implements the methods that begin with an underscore. `CameraDevice` keeps the order of the calls, checks every
frame and reports faults. `uwlts.hardware.scanning.open_camera` opens a camera by its address. A camera must be
used from one thread only.

Cameras number their frames and stamp them with their own clock. A delivered frame may lack packets, be repeated, be
late, or follow frames that were lost in transfer.
"""

import math
import time
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from enum import StrEnum
from pathlib import Path
from typing import Literal, Self

import numpy as np

from uwlts.errors import HardwareError, ImageError
from uwlts.files.reading import is_regular_file, log_warnings, natural_key
from uwlts.storage.capture import Capture
from uwlts.storage.image_file import SUFFIXES, read_image

Trigger = Literal["free", "software"]

_WAIT_S = 0.1  # longest single wait in a driver's library, during which Ctrl-C has no effect
# GigE Vision 1.x counts frames in 16 bits and skips 0.
_COUNTER_16_BIT = 2**16 - 1


class FrameStatus(StrEnum):
    """Fault of a frame; the worst comes first if several apply.

    SHORT: parts of the image are missing. DUPLICATED: a repetition of the previous frame, by number or time stamp.
    DROPPED: a good frame after lost frames. LATE: a good frame with a time stamp more than a period too late for its
    number. LATE also marks a frame that arrived after a later frame or after its timeout.
    """

    SHORT = "short"
    DUPLICATED = "duplicated"
    DROPPED = "dropped"
    LATE = "late"
    OK = "ok"


@dataclass(frozen=True)
class FrameCounts:
    """Numbers of frames of each status, of unanswered triggers, and of numbers that contradict the time stamps."""

    ok: int = 0
    short: int = 0
    duplicated: int = 0
    dropped: int = 0
    late: int = 0
    unanswered: int = 0
    renumbered: int = 0


class FrameCheck:
    """Comparison of each frame with the previous one.

    ``period_s`` is the time between frames of a free-running camera. Without it the time stamp marks no frame as late.
    With ``triggered``, each frame answers a trigger.

    Frames are lost only if there was time for them. A number without, of cameras that count other frames, too, or
    restart when a setting changes, is counted as ``renumbered``, and is no fault. Frames may come faster than stated.
    """

    def __init__(self, *, period_s: float | None = None, triggered: bool = False):
        self._period_s, self._triggered, self._shortest_s = period_s, triggered, period_s
        self._last_id: int | None = None
        self._last_time_s: float | None = None
        self._counts: Counter[str] = Counter()

    @property
    def counts(self) -> FrameCounts:
        """Numbers of good and faulty frames so far."""
        return FrameCounts(**self._counts)

    def judge(self, *, frame_id: int, time_s: float | None, complete: bool) -> FrameStatus:
        """Return the status of the next frame; ``time_s`` is None without a time stamp."""
        since_s = None if time_s is None or self._last_time_s is None else time_s - self._last_time_s
        advance = 1 if self._last_id is None else self._correct(_advance(self._last_id, frame_id), since_s)
        self._counts["dropped"] += max(advance - 1, 0)
        if not complete:
            status = FrameStatus.SHORT
        elif advance == 0 or since_s == 0:
            status = FrameStatus.DUPLICATED
        elif advance > 1:
            status = FrameStatus.DROPPED
        elif advance < 0 or (self._period_s is not None and since_s is not None and since_s > 2 * self._period_s):
            status = FrameStatus.LATE
        else:
            status = FrameStatus.OK
        # Lost frames are counted individually above.
        if status is not FrameStatus.DROPPED:
            self._counts[status.value] += 1
        if advance >= 0:
            self._last_id, self._last_time_s = frame_id, time_s
        return status

    def _correct(self, advance: int, since_s: float | None) -> int:
        """Return the increment of the frame number that fits the time since the previous frame, if that is known."""
        restarted = advance < 0 and since_s is not None and since_s > 0
        most = 1 if self._triggered or restarted else math.inf
        if most > 1 and self._shortest_s is not None and since_s is not None:
            if advance == 1 and since_s > 0:
                self._shortest_s = min(self._shortest_s, since_s)
            most = max(round(since_s / self._shortest_s), 1)
        self._counts["renumbered"] += restarted or advance > most
        return int(most) if restarted or advance > most else advance

    def restart_comparison(self, counted: Literal["unanswered", "late"]) -> None:
        """Count an unanswered trigger or a discarded late frame, and forget the previous frame.

        The next frame is not compared with earlier ones because the camera may restart its frame counter.
        """
        self._counts[counted] += 1
        self._last_id = self._last_time_s = None


def _advance(last: int, now: int) -> int:
    """Return the increment of the frame number: 1 for the next frame, 0 for the same, negative for an older one."""
    wrapped = last <= _COUNTER_16_BIT and last - now > _COUNTER_16_BIT // 2
    # A counter that does not skip 0 would appear to stand still there.
    return max(now - last + _COUNTER_16_BIT, 1) if wrapped else now - last


_MEANING = {
    FrameStatus.SHORT: "incomplete: packets were lost; check cable, network load and packet size",
    FrameStatus.DUPLICATED: "duplicated: it repeats the previous frame",
    FrameStatus.DROPPED: "preceded by dropped frames; lower the frame rate or the load",
    FrameStatus.LATE: "late: more than one frame period after the previous one",
}


@dataclass(frozen=True)
class CameraInfo:
    """Identity of a camera: name, serial number, size of the image sensor, and bit depth.

    ``black_level`` is the camera's feature of this name, if it has one.
    """

    name: str
    serial: str
    width_px: int
    height_px: int
    bits: int
    black_level: float | None = None


@dataclass(frozen=True)
class CameraSettings:
    """Camera settings, either requested from a driver or in force.

    None in a request leaves a setting unchanged. None in a setting in force means that the camera does not report it.
    """

    exposure_ms: float | None
    gain_db: float | None
    bits: int
    trigger: Trigger
    frame_rate_hz: float | None


@dataclass(frozen=True)
class Delivered:
    """Frame from a driver, with the metadata that the camera reports.

    ``image`` is (H, W), or None if the frame is incomplete.
    """

    image: np.ndarray | None
    frame_id: int
    time_s: float | None = None
    exposure_ms: float | None = None
    encoder: int | None = None


@dataclass(frozen=True)
class GrabbedFrame:
    """Complete frame: an image (H, W) of uint8 or uint16.

    ``time_s`` is the time stamp of the camera's clock, whose origin is arbitrary. ``exposure_ms`` and ``encoder``, the
    count of an encoder wired to the camera, are None if the camera does not report them. ``status`` is OK, or DROPPED
    or LATE if the camera was started with ``faults="skip"``.
    """

    image: np.ndarray
    time_s: float
    frame_id: int
    exposure_ms: float | None
    status: FrameStatus
    encoder: int | None = None


class CameraDevice(ABC):
    """A camera: ``open``, ``configure``, ``start``, then ``grab``, preceded by ``trigger`` for triggered cameras.

    The context manager opens the camera if needed and always closes it. All methods raise HardwareError if the camera
    does not answer, answers incorrectly, or cannot do what is requested.
    """

    def __init__(self, address: str):
        self.address = address
        self._info: CameraInfo | None = None
        self._settings: CameraSettings | None = None
        self._started = False
        self._check = FrameCheck()
        self._skip = self._renumbering_said = False

    @property
    def info(self) -> CameraInfo:
        """Identity of the camera, available once the camera is open."""
        if self._info is None:
            raise HardwareError(f"the camera {self.address} is not open: call open() first")
        return self._info

    @property
    def settings(self) -> CameraSettings:
        """Settings in force, available once the camera is configured."""
        if self._settings is None:
            raise HardwareError(f"the camera {self.address} is not configured: call configure() first")
        return self._settings

    @property
    def counts(self) -> FrameCounts:
        """Numbers of good and faulty frames since ``start``."""
        return self._check.counts

    @property
    def running(self) -> bool:
        """True if the camera is acquiring; False after an error that means that the camera is gone."""
        return self._started

    def open(self) -> None:
        """Connect to the camera for exclusive use, unless it is open."""
        if self._info is None:
            self._info = self._open()

    def close(self) -> None:
        """Stop and release the camera, unless it is closed or gone."""
        if self._info is None:
            return
        try:
            with suppress(HardwareError):
                self.stop()
        finally:
            self._info = self._settings = None
            self._close()

    def configure(
        self,
        *,
        exposure_ms: float | None = None,
        gain_db: float | None = None,
        bits: int | None = None,
        trigger: Trigger = "free",
        frame_rate_hz: float | None = None,
    ) -> CameraSettings:
        """Configure the camera and return the settings in force, which may be rounded or limited.

        Parameters
        ----------
        exposure_ms, gain_db, bits : optional
            Exposure time, gain and bit depth; None leaves the setting unchanged.
        trigger : {"free", "software"}
            Free running, or one frame for each call of ``trigger``.
        frame_rate_hz : float, optional
            Frame rate of a free-running camera; None leaves it unchanged.
        """
        info = self.info
        if self._started:
            raise HardwareError(f"the camera {self.address} is running: call stop() before configure()")
        for name, value in (("exposure_ms", exposure_ms), ("frame_rate_hz", frame_rate_hz)):
            if value is not None and not (np.isfinite(value) and value > 0):
                raise HardwareError(f"{name} is {value}: expected a positive number")
        if gain_db is not None and not np.isfinite(gain_db):
            raise HardwareError(f"gain_db is {gain_db}: expected a finite number")
        if bits is None:
            bits = info.bits if self._settings is None else self._settings.bits
        settings = self._configure(CameraSettings(exposure_ms, gain_db, bits, trigger, frame_rate_hz))
        self._settings = settings if trigger == "free" else replace(settings, frame_rate_hz=None)
        return self._settings

    def start(self, *, faults: Literal["raise", "skip"] = "raise") -> None:
        """Start the acquisition.

        With ``faults="raise"`` every faulty frame raises HardwareError. With ``faults="skip"`` faults are only counted:
        short and duplicated frames are discarded, and dropped and late ones are returned with their status.
        """
        settings = self.settings
        if self._started:
            raise HardwareError(f"the camera {self.address} is running already")
        period_s = 1.0 / settings.frame_rate_hz if settings.frame_rate_hz else None
        self._check = FrameCheck(period_s=period_s, triggered=settings.trigger == "software")
        self._skip = faults == "skip"
        self._start()
        self._started = True

    def stop(self) -> None:
        """Stop the acquisition, if it is running."""
        if self._started:
            self._started = False
            self._stop()

    def trigger(self) -> None:
        """Trigger one frame, which the next ``grab`` returns; frames still in the queue are discarded."""
        self._require_running()
        if self.settings.trigger != "software":
            raise HardwareError(
                f"the camera {self.address} is configured for trigger '{self.settings.trigger}', not 'software'"
            )
        while self._take_next(0.0) is not None:
            self._check.restart_comparison("late")
        self._trigger()

    def grab(self, timeout_s: float, *, waiting: Callable[[], None] = lambda: None) -> GrabbedFrame:
        """Return the next frame, waiting up to ``timeout_s``; ``waiting`` is called about every 0.1 s meanwhile.

        Raises HardwareError if no frame arrives in time, the camera is gone, or the frame is faulty (see ``start``). An
        unanswered trigger restarts the acquisition, so that its frame cannot be mistaken for the answer to a later one.
        """
        self._require_running()
        deadline = time.monotonic() + timeout_s
        while True:
            left_s = max(deadline - time.monotonic(), 0.0)
            frame = self._take_next(min(left_s, _WAIT_S))
            if frame is None:
                if left_s > _WAIT_S:
                    waiting()
                    continue
                raise self._explain_no_frame(timeout_s)
            status = self._check.judge(frame_id=frame.frame_id, time_s=frame.time_s, complete=frame.image is not None)
            if self.counts.renumbered and not self._renumbering_said:
                self._renumbering_said = True
                log_warnings(self.address, ["its frame numbers jump: time stamps or triggers show which are lost"])
            usable = status is FrameStatus.OK or (self._skip and status is not FrameStatus.DUPLICATED)
            if frame.image is not None and usable:
                return self._make_grabbed_frame(frame, status)
            if not self._skip:
                raise HardwareError(f"frame {frame.frame_id} of the camera {self.address} is {_MEANING[status]}")

    def _make_grabbed_frame(self, frame: Delivered, status: FrameStatus) -> GrabbedFrame:
        image, info = frame.image, self.info
        assert image is not None
        if image.shape != (info.height_px, info.width_px):
            raise HardwareError(
                f"frame {frame.frame_id} of the camera {self.address} has {image.shape[1]} x {image.shape[0]} px, "
                f"expected {info.width_px} x {info.height_px} px"
            )
        time_s = time.monotonic() if frame.time_s is None else frame.time_s
        exposure_ms = self.settings.exposure_ms if frame.exposure_ms is None else frame.exposure_ms
        return GrabbedFrame(image, time_s, frame.frame_id, exposure_ms, status, frame.encoder)

    def _explain_no_frame(self, timeout_s: float) -> HardwareError:
        """Return the error for a missing frame; raises another HardwareError if the camera is gone."""
        # If the camera is gone, there is nothing left to stop.
        self._started = False
        if self.settings.trigger == "software":
            self._check.restart_comparison("unanswered")
            self._stop()
            self._start()
            self._started = True
            return HardwareError(
                f"the camera {self.address} did not answer a trigger within {timeout_s:g} s; its exposure is "
                f"{self.settings.exposure_ms} ms. It still answers commands: the frame or the trigger was lost"
            )
        self._check_answer()
        self._started = True
        return HardwareError(
            f"the camera {self.address} gave no frame within {timeout_s:g} s though it answers commands: its frames "
            "are lost"
        )

    def _require_running(self) -> None:
        if not self._started:
            raise HardwareError(f"the camera {self.address} does not run: call start() first")

    def __enter__(self) -> Self:
        self.open()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @abstractmethod
    def _open(self) -> CameraInfo:
        """Connect to the camera; release everything acquired if that fails."""

    @abstractmethod
    def _close(self) -> None:
        """Release everything that ``_open`` acquired, even if the camera is gone."""

    @abstractmethod
    def _configure(self, wanted: CameraSettings) -> CameraSettings:
        """Apply the settings and return those in force."""

    @abstractmethod
    def _start(self) -> None:
        """Start the acquisition with an empty queue."""

    @abstractmethod
    def _stop(self) -> None:
        """Stop the acquisition; raises HardwareError if the camera is gone."""

    @abstractmethod
    def _trigger(self) -> None:
        """Trigger one frame."""

    @abstractmethod
    def _take_next(self, timeout_s: float) -> Delivered | None:
        """Return the next frame, or None if none arrives within ``timeout_s`` (at most 0.1 s)."""

    @abstractmethod
    def _check_answer(self) -> None:
        """Raise HardwareError if the camera is gone."""


class ReplayCamera(CameraDevice):
    """Images of a folder in natural order of their names, or of a capture.

    Each trigger, or each request of a free-running replay, delivers the next image at once. Exposures are those of the
    capture; for a folder, the configured one. A ``grab`` after the last image raises HardwareError.
    """

    def __init__(self, path: str | Path, *, address: str | None = None):
        super().__init__(address or f"replay:{path}")
        self._path = Path(path)
        self._files: list[Path] = []
        self._capture: Capture | None = None
        self._shown = 0
        self._triggered = False

    def _open(self) -> CameraInfo:
        self._shown = 0
        if self._path.is_dir():
            images = (path for path in self._path.iterdir() if path.suffix.lower() in SUFFIXES)
            self._files = sorted(images, key=lambda path: natural_key(path.name))
            if not self._files:
                raise HardwareError(f"the folder {self._path} contains no image ({', '.join(SUFFIXES)})")
            first = _read_image(self._files[0])
            (height, width), bits = first.shape, 8 * first.itemsize
        elif is_regular_file(self._path):
            self._capture = Capture(self._path)
            if len(self._capture) == 0:
                self._close()
                raise HardwareError(f"the capture {self._path} contains no frame")
            sensor = self._capture.header.sensor
            height, width, bits = sensor.camera.height_px, sensor.camera.width_px, sensor.detector.bits
        else:
            raise HardwareError(f"{self._path} is neither a folder of images nor a capture")
        return CameraInfo(f"replay of {self._path.name}", self._path.name, width, height, bits)

    def _close(self) -> None:
        capture, self._capture, self._files = self._capture, None, []
        if capture is not None:
            capture.close()

    def _configure(self, wanted: CameraSettings) -> CameraSettings:
        if wanted.bits != self.info.bits:
            raise HardwareError(f"{self.address} has images of {self.info.bits} bits, not {wanted.bits}")
        if wanted.gain_db is not None:
            raise HardwareError(f"{self.address} has no gain setting: leave gain_db out")
        exposure_ms = wanted.exposure_ms if self._capture is None else float(self._capture.exposure_ms[0])
        return replace(wanted, exposure_ms=exposure_ms, frame_rate_hz=None)

    def _start(self) -> None:
        self._triggered = False

    def _stop(self) -> None:
        self._triggered = False

    def _trigger(self) -> None:
        self._triggered = True

    def _take_next(self, timeout_s: float) -> Delivered | None:
        if self.settings.trigger == "software":
            if not self._triggered:
                time.sleep(timeout_s)
                return None
            self._triggered = False
        self._shown += 1
        return self._deliver(self._shown - 1)

    def _deliver(self, shown: int) -> Delivered:
        capture, info, stamp_s = self._capture, self.info, time.monotonic()
        count = len(self._files) if capture is None else len(capture)
        if shown >= count:
            raise HardwareError(f"all {count} images of {self._path} have been shown")
        image = _read_image(self._files[shown]) if capture is None else capture.image(shown)
        exposure_ms = None if capture is None else float(capture.exposure_ms[shown])
        if image.shape != (info.height_px, info.width_px) or image.dtype.itemsize != (1 if info.bits == 8 else 2):
            raise ImageError(
                f"image {shown} of {self._path} has {image.shape[1]} x {image.shape[0]} px of {image.dtype}, "
                f"the first one {info.width_px} x {info.height_px} px of {info.bits} bits: give one camera's images"
            )
        return Delivered(image, shown + 1, stamp_s, exposure_ms)

    def _check_answer(self) -> None:
        """Files need no check: reading a missing one raises an error."""


def _read_image(path: Path) -> np.ndarray:
    """Read a grey image (H, W) of uint8 or uint16; raises ImageError for any other image."""
    image = read_image(path)
    if image.ndim != 2:
        raise ImageError(
            f"{path} is a colour image, expected a grey image of 8 or 16 bit: "
            "`uwlts import` converts colour images to a capture, which can be replayed"
        )
    return image
