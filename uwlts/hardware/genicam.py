"""Cameras with a GenTL producer, the driver library (.cti) of most machine-vision cameras, through harvesters.

Producers exist for XIMEA, the thesis's camera, and for Basler, Allied Vision, FLIR, IDS and others.
"""

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from uwlts.errors import HardwareError, SetupError
from uwlts.hardware.camera_interface import (
    BUFFERS,
    CENTRE_LINES,
    CHUNKS,
    COORDINATE_BITS,
    LINE_RATE,
    LINE_SELECTOR,
    MONO_BITS,
    CameraDevice,
    CameraInfo,
    CameraSettings,
    Delivered,
    Region,
)
from uwlts.runtime.optional_library import pip_install, read_requirements

# GenApi's access modes in order: not implemented, not available, write only, read only, read and write.
_WRITE_ONLY = 2
# Standard names, followed by older ones.
_EXPOSURE_US, _FRAME_RATE = ("ExposureTime", "ExposureTimeAbs"), ("AcquisitionFrameRate", "AcquisitionFrameRateAbs")
_GAIN = ("Gain",)


class GenicamCamera(CameraDevice):
    """A camera of a GenTL producer with a serial number; without a serial number, the only camera found."""

    def __init__(self, producer: str | Path, *, serial: str | None = None, address: str | None = None):
        super().__init__(address or f"genicam:{producer}" + (f":{serial}" if serial else ""))
        self._producer = Path(producer)
        self._serial = serial
        # harvesters has no type information.
        self._harvester: Any = None
        self._acquirer: Any = None
        self._faults: tuple[type[BaseException], ...] = ()
        self._timeout: type[BaseException] = BaseException

    def _open(self) -> CameraInfo:
        try:
            from genicam import genapi, gentl
            from harvesters import core
        except ImportError as error:
            raise SetupError(
                "a camera with a GenTL producer needs the libraries harvesters and genicam, which are not installed "
                f"({error}): {pip_install(read_requirements()[2]['genicam'])}"
            ) from error
        self._faults = (genapi.GenericException, gentl.GenericException)
        self._timeout = gentl.TimeoutException
        if not self._producer.is_file():
            raise HardwareError(
                f"there is no GenTL producer at {self._producer}; give the path of the camera maker's .cti file"
            )
        self._harvester = core.Harvester()
        try:
            return self._connect(self._harvester)
        except BaseException:
            self._close()
            raise

    def _connect(self, harvester: Any) -> CameraInfo:
        harvester.add_file(str(self._producer))
        with self._reporting("opening it"):
            harvester.update()
            found = list(harvester.device_info_list)
            fitting = [each for each in found if self._serial in (None, each.serial_number)]
            if len(fitting) != 1:
                listed = "".join(f"\n  genicam:{self._producer}:{each.serial_number} ({each.model})" for each in found)
                raise HardwareError(
                    f"{len(fitting)} of the cameras at {self._producer} fit {self.address}, expected one. "
                    f"Found:{listed or ' none; check power, cable, and that the file is a producer for this machine'}"
                )
            with _keep_interrupt_handler():
                self._acquirer = harvester.create(found.index(fitting[0]))
            self._acquirer.num_buffers = BUFFERS
            width, height = (self._whole(side) for side in ("Width", "Height"))
            pixels = self._node("PixelFormat").value
            coordinates = self._coordinates() if pixels == CENTRE_LINES else None
            bits = MONO_BITS.get(pixels, 8) if coordinates is None else COORDINATE_BITS
        name = f"{fitting[0].vendor} {fitting[0].model}"
        return CameraInfo(name, fitting[0].serial_number, width, height, bits, coordinates)

    def _feature(self, name: str, kind: type[str] | type[float] | type[bool]) -> Any:
        return kind(self._node(name).value) if self._has(name) else None

    @contextmanager
    def _reporting(self, doing: str) -> Iterator[None]:
        """Convert the errors of the libraries to HardwareError."""
        try:
            yield
        except self._faults as error:
            raise self._make_error(doing, error) from error

    def _close(self) -> None:
        acquirer, self._acquirer = self._acquirer, None
        harvester, self._harvester = self._harvester, None
        if acquirer is not None:
            acquirer.destroy()
        if harvester is not None:
            harvester.reset()

    def _configure(self, wanted: CameraSettings) -> CameraSettings:
        with self._reporting("configuring it"):
            self._set_if_there("AcquisitionMode", "Continuous")
            self._set_if_there("TriggerMode", "Off")
            if self.info.coordinates is None:
                offered = self._node("PixelFormat").symbolics
                self._set_if_there("PixelFormat", self._grey_format(wanted.bits, offered))
            if self._has("ChunkModeActive"):
                self._set_chunks()
            self._set_region(wanted.region)
            self._set_number(_EXPOSURE_US, wanted.exposure_ms, "exposure", factor=1e3, automatic="ExposureAuto")
            self._set_number(_GAIN, wanted.gain_db, "gain", automatic="GainAuto")
            of_rate = _FRAME_RATE if self.info.coordinates is None else (LINE_RATE, *_FRAME_RATE)
            if wanted.frame_rate_hz is not None:
                self._set_if_there("AcquisitionFrameRateEnable", True)
            self._set_number(of_rate, wanted.frame_rate_hz, "frame rate")
            if wanted.trigger != "free":
                source = "Software" if wanted.trigger == "software" else "Line0"
                for name, value in (("Selector", "FrameStart"), ("Mode", "On"), ("Source", source)):
                    self._set_if_there(f"Trigger{name}", value)
                if not self._has("TriggerMode") or (source == "Software" and not self._has("TriggerSoftware")):
                    raise HardwareError(
                        f"the camera {self.address} cannot be triggered by {source}: use trigger 'free'"
                    )
            exposure_us, gain, rate = (self._number(names) for names in (_EXPOSURE_US, _GAIN, of_rate))
            x, y = (int(self._feature(name, float) or 0) for name in ("OffsetX", "OffsetY"))
            width, height = (int(self._node(name).value) for name in ("Width", "Height"))
            return CameraSettings(
                exposure_ms=None if exposure_us is None else 1e-3 * exposure_us,
                gain_db=gain,
                region=Region(x, y, width, height),
                bits=MONO_BITS.get(self._node("PixelFormat").value, COORDINATE_BITS),
                trigger=wanted.trigger,
                frame_rate_hz=rate,
            )

    def _set_chunks(self) -> None:
        """Request the chunk data of each frame, or of each of its profiles."""
        self._node("ChunkModeActive").value = True
        offered = self._node("ChunkSelector").symbolics if self._has("ChunkSelector") else ()
        for each in set(CHUNKS).intersection(offered):
            self._node("ChunkSelector").value = each
            self._set_if_there("ChunkEnable", True)

    def _set_region(self, wanted: Region) -> None:
        # Move to the corner first: a camera rejects a width that does not fit beside the offset.
        for name in ("OffsetX", "OffsetY"):
            self._set_if_there(name, 0)
        for name, size in (("Width", wanted.width_px), ("Height", wanted.height_px)):
            node = self._node(name)
            node.value = max(node.min, size // node.inc * node.inc)
        for name, offset in (("OffsetX", wanted.x_px), ("OffsetY", wanted.y_px)):
            if offset and not self._has(name):
                raise HardwareError(f"the camera {self.address} cannot move its region: it has no {name}")
            if offset:
                node = self._node(name)
                node.value = offset // node.inc * node.inc

    def _set_number(
        self, names: tuple[str, ...], value: float | None, what: str, *, factor: float = 1, automatic: str | None = None
    ) -> None:
        if value is None:
            return
        if (name := next(filter(self._has, names), None)) is None:
            raise HardwareError(f"the camera {self.address} has no setting for {what} ({' or '.join(names)})")
        if automatic is not None:
            self._set_if_there(automatic, "Off")
        node = self._node(name)
        node.value = min(max(factor * value, node.min), node.max)

    def _number(self, names: tuple[str, ...]) -> float | None:
        return next((self._feature(name, float) for name in names if self._has(name)), None)

    def _set_if_there(self, name: str, value: object) -> None:
        # Cameras with only one possible value reject its setting.
        if self._has(name) and self._node(name).value != value:
            self._node(name).value = value

    def _has(self, name: str) -> bool:
        nodes = self._acquirer.remote_device.node_map
        return nodes.has_node(name) and nodes.get_node(name).get_access_mode() >= _WRITE_ONLY

    def _node(self, name: str) -> Any:
        return self._acquirer.remote_device.node_map.get_node(name)

    def _whole(self, side: str) -> int:
        """Return the size in px of the whole image sensor along its width or height."""
        for name in (f"Sensor{side}", f"{side}Max"):
            if self._has(name):
                return int(self._node(name).value)
        return int(self._node(side).max)

    def _start(self) -> None:
        with self._reporting("starting it"):
            self._acquirer.start()

    def _stop(self) -> None:
        self._acquirer.stop()

    def _trigger(self) -> None:
        with self._reporting("triggering it"):
            self._node("TriggerSoftware").execute()

    def _next(self, timeout_s: float) -> Delivered | None:
        with self._reporting("waiting for a frame"):
            try:
                buffer = self._acquirer.fetch(timeout=timeout_s)
            except self._timeout:
                return None
        try:
            return self._read_buffer(buffer)
        finally:
            buffer.queue()

    def _read_buffer(self, buffer: Any) -> Delivered:
        raw = buffer.module
        try:
            time_s = 1e-9 * raw.timestamp_ns
        except self._faults:
            time_s = None
        frame = Delivered(None, raw.frame_id, time_s)
        if not raw.is_complete() or not buffer.payload.components:
            return frame
        part = buffer.payload.components[0]
        kind = np.uint8 if self.settings.bits == 8 else np.uint16
        image = part.data.reshape(part.height, part.width).astype(kind)
        if self.info.coordinates is None:
            return replace(frame, seen=image, encoder=self._chunk("ChunkEncoderValue", 0))
        return self._profiles(image, frame, self._chunk)

    def _chunk(self, feature: str, row: int) -> int | None:
        """Return the chunk value of the latest frame, or of one of its profiles, or None."""
        with suppress(*self._faults):
            if self._has(feature):
                if self._has(LINE_SELECTOR):
                    self._node(LINE_SELECTOR).value = row
                return int(self._node(feature).value)
        return None

    def _answers(self) -> None:
        with self._reporting("asking it"):
            self._whole("Width")


@contextmanager
def _keep_interrupt_handler() -> Iterator[None]:
    """Restore the handler of Ctrl-C, which harvesters replaces, so that Ctrl-C still ends a scan."""
    before = signal.getsignal(signal.SIGINT)
    yield
    if before is not None and threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGINT, before)
