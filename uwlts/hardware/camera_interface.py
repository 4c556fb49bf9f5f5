"""Interface of all cameras: settings, frames, and the check of every frame, whatever the camera is connected by.

A driver implements the methods with an underscore; `CameraDevice` keeps the order of the calls, checks every frame and
reports what went wrong. `uwlts.hardware.camera_addresses.open_camera` opens a camera by its address. One thread uses a
camera.

Cameras count their frames and stamp them with their own clock. What a driver delivers can still lack packets, come
twice, come late, or leave out frames that were lost in transfer.
"""

import time
from abc import ABC, abstractmethod
from collections import Counter, deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Any, Literal, Self

import numpy as np

from uwlts.errors import HardwareError, ImageError
from uwlts.model.stripe import Coordinates, Stripe

Trigger = Literal["free", "software", "line"]

CENTRE_LINES = "Coord3D_C16"
"""Pixel format of a 3D camera that finds the stripe itself (GenICam Pixel Format Naming Convention 2.4)."""

LINE_RATE, LINE_SELECTOR = "AcquisitionLineRate", "ChunkScanLineSelector"
"""Features of 3D cameras: profiles per second; and of which profile of a frame the chunk data are read."""

CHUNKS = ("EncoderValue", "Timestamp")
"""Chunk data that are asked for: Chunk... is the feature's name."""

BUFFERS = 32
"""Frames that may wait in a driver to be fetched; at 60 frames/s half a second. Later ones are lost."""
MONO_BITS = {"Mono8": 8, "Mono10": 10, "Mono12": 12, "Mono14": 14, "Mono16": 16}
"""Bits of the grey formats. Packed ones are left out: hardly any camera offers them alone, harvesters unpacks none."""
COORDINATE_BITS = 16
"""Of the numbers of `CENTRE_LINES`."""
_WAIT_S = 0.1
"""A wait in a driver's library holds up Ctrl-C, so it lasts no longer."""
# GigE Vision 1.x counts frames in 16 bits and leaves out 0.
_COUNTER_16_BIT = 2**16 - 1


class FrameStatus(StrEnum):
    """Fault of a frame, the worst first where several things are.

    SHORT: parts of the image are missing. DUPLICATED: the previous frame once more, by its number or its time stamp.
    DROPPED: good, but frames before it are lost. LATE: good, but its time stamp is over a period later than its number
    says, or it came after a later frame, or after nobody waited for it any more.
    """

    SHORT = "short"
    DUPLICATED = "duplicated"
    DROPPED = "dropped"
    LATE = "late"
    OK = "ok"


@dataclass(frozen=True)
class FrameCounts:
    """Numbers of frames that were ok, short, duplicated, lost or late, and of unanswered triggers."""

    ok: int = 0
    short: int = 0
    duplicated: int = 0
    dropped: int = 0
    late: int = 0
    unanswered: int = 0


class FrameCheck:
    """Compares each frame with the one before.

    ``period_s`` is the time between frames of a free-running camera in s; without it no frame is late by its time
    stamp.
    """

    def __init__(self, *, period_s: float | None = None):
        self._period_s = period_s
        self._last_id: int | None = None
        self._last_time_s: float | None = None
        self._counts: Counter[str] = Counter()

    @property
    def counts(self) -> FrameCounts:
        """Numbers of good and faulty frames so far."""
        return FrameCounts(**self._counts)

    def judge(self, *, frame_id: int, time_s: float | None, complete: bool) -> FrameStatus:
        """Status of the next frame: its number, its time stamp in s (None: it has none), whether nothing is missing."""
        advance = 1 if self._last_id is None else _advance(self._last_id, frame_id)
        since_s = None if time_s is None or self._last_time_s is None else time_s - self._last_time_s
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
        # Frames that were lost are counted above, one by one.
        if status is not FrameStatus.DROPPED:
            self._counts[status.value] += 1
        if advance >= 0:
            self._last_id, self._last_time_s = frame_id, time_s
        return status

    def begin_anew(self, counted: Literal["unanswered", "late"]) -> None:
        """Count a trigger that was not answered, or a frame thrown away as nobody waited for it any more.

        The next frame is not compared with those before: the camera may count afresh.
        """
        self._counts[counted] += 1
        self._last_id = self._last_time_s = None


def _advance(last: int, now: int) -> int:
    """Difference of a frame's number to that of the frame before: 1 is the next, 0 the same, negative an older one."""
    wrapped = last <= _COUNTER_16_BIT and last - now > _COUNTER_16_BIT // 2
    # A counter that does not leave out 0 would seem to stand still there.
    return max(now - last + _COUNTER_16_BIT, 1) if wrapped else now - last


_MEANING = {
    FrameStatus.SHORT: "short: parts of it were lost on the way; check cable, network load and packet size",
    FrameStatus.DUPLICATED: "duplicated: it is the previous frame once more",
    FrameStatus.DROPPED: "not the next one: frames before it were dropped; lower the frame rate or the load",
    FrameStatus.LATE: "late: more than a frame's period after the one before",
}


@dataclass(frozen=True)
class Region:
    """Part of the image sensor that is read out, in px, from its upper left pixel."""

    x_px: int
    y_px: int
    width_px: int
    height_px: int


@dataclass(frozen=True)
class CameraInfo:
    """Which camera it is: name, serial number, pixels of the whole image sensor, and bits of a grey value.

    ``coordinates`` say what the numbers of a 3D camera mean, which gives centre lines; None where it gives images.
    """

    name: str
    serial: str
    width_px: int
    height_px: int
    bits: int
    coordinates: Coordinates | None = None


@dataclass(frozen=True)
class CameraSettings:
    """Settings in force, None where the camera has no such setting, or does not report it.

    Settings that a driver is asked for, None leaving a setting as it is.
    """

    exposure_ms: float | None
    gain_db: float | None
    region: Region
    bits: int
    trigger: Trigger
    frame_rate_hz: float | None


@dataclass(frozen=True)
class Delivered:
    """A frame from a driver: image (H, W) or centre line, None if incomplete, with what the camera reports about it.

    ``later`` are the other centre lines of a frame that holds several, in their order.
    """

    seen: np.ndarray | Stripe | None
    frame_id: int
    time_s: float | None = None
    exposure_ms: float | None = None
    encoder: int | None = None
    later: tuple["Delivered", ...] = ()


@dataclass(frozen=True)
class GrabbedFrame:
    """An image (H, W) of uint8 or uint16 or a centre line, complete, with its number and the camera's time stamp in s.

    The camera's clock has an origin of its own. ``exposure_ms`` is None where the camera does not report it, and so is
    ``encoder``, the count of an encoder that is wired to it. ``status`` is OK, or DROPPED or LATE where such frames are
    wanted.
    """

    seen: np.ndarray | Stripe
    time_s: float
    frame_id: int
    exposure_ms: float | None
    status: FrameStatus
    encoder: int | None = None

    @property
    def image(self) -> np.ndarray:
        """The image (H, W); HardwareError where it is a centre line."""
        if isinstance(self.seen, Stripe):
            raise HardwareError(
                "the camera gives centre lines (Coord3D_C16) where an image is needed: set its PixelFormat to Mono8 "
                "for targets and exposures"
            )
        return self.seen


class CameraDevice(ABC):
    """A camera: ``open``, ``configure``, ``start``, then ``grab``, with ``trigger`` before it where that is wanted.

    A context manager, which opens the camera if it is not open and closes it whatever happens. All methods raise
    HardwareError where the camera does not answer, answers wrongly, or cannot do what is asked.
    """

    def __init__(self, address: str):
        self.address = address
        self._info: CameraInfo | None = None
        self._settings: CameraSettings | None = None
        self._started = False
        self._check = FrameCheck()
        self._skip = False
        self._later: deque[GrabbedFrame] = deque()

    @property
    def info(self) -> CameraInfo:
        """Which camera it is; known once it is open."""
        if self._info is None:
            raise HardwareError(f"the camera {self.address} is not open: call open() first")
        return self._info

    @property
    def settings(self) -> CameraSettings:
        """Settings that the camera reports; known once it is configured."""
        if self._settings is None:
            raise HardwareError(f"the camera {self.address} is not configured: call configure() first")
        return self._settings

    @property
    def counts(self) -> FrameCounts:
        """Numbers of frames since ``start`` that were good, and of each fault."""
        return self._check.counts

    @property
    def running(self) -> bool:
        """Whether it takes frames; no longer so after an error that says that it is gone."""
        return self._started

    def open(self) -> None:
        """Connect to the camera, alone; opening an open camera does nothing."""
        if self._info is None:
            self._info = self._open()

    def close(self) -> None:
        """Stop, let go of the camera; closing one that is closed, or gone, is no error."""
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
        region: Region | None = None,
        bits: int | None = None,
        trigger: Trigger = "free",
        frame_rate_hz: float | None = None,
        profiles: int = 1,
    ) -> CameraSettings:
        """Set up the camera, and return what it really set, which may be rounded or limited.

        Exposure, gain, bits of a grey value, and frames per second of a free-running camera: None leaves what is set.
        ``region`` is the part of the image sensor to read out; None for all of it. ``trigger`` is "free": one frame
        after the other; "software": one for each call of ``trigger``; or "line": one for each pulse at the camera's
        trigger input.

        A 3D camera sends so many ``profiles`` in a frame, each with a time stamp and an encoder's count of its own
        (``ChunkScanLineSelector``); ``grab`` returns them one by one. ``frame_rate_hz`` is that of profiles, and
        ``bits`` are its own. A triggered one sends one profile.
        """
        info = self.info
        if self._started:
            raise HardwareError(f"the camera {self.address} is running: call stop() before configure()")
        for name, value in (("exposure_ms", exposure_ms), ("frame_rate_hz", frame_rate_hz)):
            if value is not None and not (np.isfinite(value) and value > 0):
                raise HardwareError(f"{name} is {value}: it must be positive")
        if gain_db is not None and not np.isfinite(gain_db):
            raise HardwareError(f"gain_db is {gain_db}: it must be finite")
        region = region or Region(0, 0, info.width_px, info.height_px)
        right, below = region.x_px + region.width_px, region.y_px + region.height_px
        inside = min(region.x_px, region.y_px) >= 0 and min(region.width_px, region.height_px) > 0
        if not inside or right > info.width_px or below > info.height_px:
            raise HardwareError(f"{region} is not within the image sensor of {info.width_px} x {info.height_px} px")
        if profiles < 1 or (profiles > 1 and (info.coordinates is None or trigger != "free")):
            raise HardwareError(
                f"profiles is {profiles}: a free-running 3D camera sends 1 or more in a frame, any other camera 1"
            )
        if info.coordinates is not None:
            region = replace(region, y_px=0, height_px=profiles)
        if bits is None:
            bits = info.bits if self._settings is None else self._settings.bits
        settings = self._configure(CameraSettings(exposure_ms, gain_db, region, bits, trigger, frame_rate_hz))
        self._settings = settings if trigger == "free" else replace(settings, frame_rate_hz=None)
        return self._settings

    def start(self, *, faults: Literal["raise", "skip"] = "raise") -> None:
        """Begin to take frames.

        With ``faults`` "raise" every fault of a frame is a HardwareError. With "skip" they are only counted: short and
        duplicated frames are passed over, frames after a gap and late ones are returned with their status.
        """
        settings = self.settings
        if self._started:
            raise HardwareError(f"the camera {self.address} is running already")
        together = 1 if self.info.coordinates is None else settings.region.height_px
        self._check = FrameCheck(period_s=together / settings.frame_rate_hz if settings.frame_rate_hz else None)
        self._later.clear()
        self._skip = faults == "skip"
        self._start()
        self._started = True

    def stop(self) -> None:
        """Take no more frames; stopping a camera that does not run does nothing."""
        if self._started:
            self._started = False
            self._stop()

    def trigger(self) -> None:
        """Have one frame taken; the next ``grab`` returns it. Frames that still wait are thrown away."""
        self._require_running()
        if self.settings.trigger != "software":
            raise HardwareError(
                f"the camera {self.address} is configured for trigger '{self.settings.trigger}', not 'software'"
            )
        self._later.clear()
        while self._next(0.0) is not None:
            self._check.begin_anew("late")
        self._trigger()

    def grab(self, timeout_s: float, *, waiting: Callable[[], None] = lambda: None) -> GrabbedFrame:
        """Wait for the next frame, at most so many seconds; ``waiting`` is called about every 0.1 s meanwhile.

        HardwareError where no frame came in time, the camera is gone, or the frame has a fault (see ``start``). After a
        trigger that was not answered in time the acquisition is restarted, so that its frame cannot be taken for the
        answer to a later one.
        """
        self._require_running()
        if self._later:
            return self._later.popleft()
        deadline = time.monotonic() + timeout_s
        while True:
            left_s = max(deadline - time.monotonic(), 0.0)
            frame = self._next(min(left_s, _WAIT_S))
            if frame is None:
                if left_s > _WAIT_S:
                    waiting()
                    continue
                raise self._no_frame(timeout_s)
            status = self._check.judge(frame_id=frame.frame_id, time_s=frame.time_s, complete=frame.seen is not None)
            usable = status is FrameStatus.OK or (self._skip and status is not FrameStatus.DUPLICATED)
            if frame.seen is not None and usable:
                self._later.extend(self._grabbed(each, FrameStatus.OK) for each in frame.later)
                return self._grabbed(frame, status)
            if not self._skip:
                raise HardwareError(f"frame {frame.frame_id} of the camera {self.address} is {_MEANING[status]}")

    def _grabbed(self, frame: Delivered, status: FrameStatus) -> GrabbedFrame:
        settings, seen = self.settings, frame.seen
        assert seen is not None
        shape = settings.region.height_px, settings.region.width_px
        if isinstance(seen, np.ndarray) and seen.shape != shape:
            raise HardwareError(
                f"frame {frame.frame_id} of the camera {self.address} has {seen.shape[1]} x {seen.shape[0]} px, "
                f"expected {settings.region.width_px} x {settings.region.height_px} px"
            )
        time_s = time.monotonic() if frame.time_s is None else frame.time_s
        exposure_ms = settings.exposure_ms if frame.exposure_ms is None else frame.exposure_ms
        return GrabbedFrame(seen, time_s, frame.frame_id, exposure_ms, status, frame.encoder)

    def _no_frame(self, timeout_s: float) -> HardwareError:
        """The error of a frame that did not come; another HardwareError where the camera is gone altogether."""
        # Should the camera be gone, nothing is left to be stopped.
        self._started = False
        if self.settings.trigger == "software":
            self._check.begin_anew("unanswered")
            self._stop()
            self._start()
            self._started = True
            return HardwareError(
                f"the camera {self.address} did not answer a trigger within {timeout_s:g} s; its exposure is "
                f"{self.settings.exposure_ms} ms. It still answers commands: the frame or the trigger was lost"
            )
        self._answers()
        self._started = True
        advice = "pulses at its trigger input are missing" if self.settings.trigger == "line" else "its frames are lost"
        return HardwareError(
            f"the camera {self.address} gave no frame within {timeout_s:g} s though it answers commands: {advice}"
        )

    def _failed(self, doing: str, error: object) -> HardwareError:
        """The error of a driver's library."""
        return HardwareError(
            f"the camera {self.address} failed at {doing}: {error}. If it does not answer, check power and cable, and "
            "whether another program uses it"
        )

    def _grey_format(self, bits: int, offered: Sequence[str]) -> str:
        """The pixel format for so many bits."""
        wanted = f"Mono{bits}"
        if wanted not in offered or wanted not in MONO_BITS:
            raise HardwareError(f"the camera {self.address} does not give {wanted}, only {', '.join(offered)}")
        return wanted

    def _profiles(self, numbers: np.ndarray, frame: Delivered, chunk: Callable[[str, int], int | None]) -> Delivered:
        """The frame of a 3D camera with the centre lines of the rows of its numbers (N, W).

        ``chunk(feature, row)`` is the number that came with a row, None where none did. HardwareError where places lie
        beyond the profile lines, or the time of a row is not known.
        """
        meant, rows = self.info.coordinates or Coordinates(), range(len(numbers))
        try:
            lines = [meant.stripe(each, stripe_along="width", length_px=self.info.height_px) for each in numbers]
        except ImageError as error:
            raise HardwareError(f"the 3D camera {self.address}: {error}") from error
        times_s: list[float | None] = [frame.time_s]
        if len(lines) > 1:
            times_s = [None if frame.time_s is None else frame.time_s + each for each in self._since_first(rows, chunk)]
        delivered = [
            replace(frame, seen=line, time_s=time_s, encoder=chunk("ChunkEncoderValue", row))
            for row, line, time_s in zip(rows, lines, times_s, strict=True)
        ]
        return replace(delivered[0], later=tuple(delivered[1:]))

    def _since_first(self, rows: range, chunk: Callable[[str, int], int | None]) -> list[float]:
        """Times of a frame's profiles since the first one in s, by their own time stamps or the rate of profiles."""
        stamps = [each for row in rows if (each := chunk("ChunkTimestamp", row)) is not None]
        # Some cameras have one time stamp a frame alone.
        if len(stamps) == len(rows) and stamps[-1] > stamps[0]:
            return [1e-9 * (each - stamps[0]) for each in stamps]
        if (rate_hz := self.settings.frame_rate_hz) is None:
            raise HardwareError(
                f"the 3D camera {self.address} gives neither a ChunkTimestamp for each profile nor its "
                "AcquisitionLineRate: when its profiles were taken is not known; have it send 1 profile in a frame"
            )
        return [row / rate_hz for row in rows]

    def _coordinates(self) -> Coordinates:
        """What the numbers of a 3D camera mean; HardwareError where they are no places on its image sensor, in px."""
        mode = self._feature("Scan3dOutputMode", str)
        if mode is not None and not mode.startswith("Uncalibrated"):
            raise HardwareError(
                f"the 3D camera {self.address} gives {mode}, which is not in pixels of its image sensor: set its "
                "Scan3dOutputMode to UncalibratedC; the calibration is made here"
            )
        scale, offset = (self._feature(f"Scan3dCoordinate{name}", float) for name in ("Scale", "Offset"))
        marked = self._feature("Scan3dInvalidDataFlag", bool)
        invalid = self._feature("Scan3dInvalidDataValue", float) if marked else None
        return Coordinates(1.0 if scale is None else scale, offset or 0.0, invalid)

    def _feature(self, name: str, kind: type[str] | type[float] | type[bool]) -> Any:
        """Value of a feature of the camera, None where it has none of this name."""
        return None

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
        """Connect; whatever was acquired is let go if this fails."""

    @abstractmethod
    def _close(self) -> None:
        """Let go of everything that ``_open`` acquired, even if the camera is gone."""

    @abstractmethod
    def _configure(self, wanted: CameraSettings) -> CameraSettings:
        """Set what is asked for, and read back what came of it."""

    @abstractmethod
    def _start(self) -> None:
        """Begin to take frames, with none from before."""

    @abstractmethod
    def _stop(self) -> None:
        """End it; HardwareError where the camera is gone."""

    @abstractmethod
    def _trigger(self) -> None:
        """Have one frame taken."""

    @abstractmethod
    def _next(self, timeout_s: float) -> Delivered | None:
        """The next frame, None after so many seconds, at most 0.1, without one."""

    @abstractmethod
    def _answers(self) -> None:
        """HardwareError where the camera is gone."""
