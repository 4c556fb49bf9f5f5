"""Cameras with GigE Vision or USB3 Vision, through the library Aravis 0.8 and its C functions."""

import ctypes
import os
import socket
import stat
import threading
import time
from contextlib import suppress
from ctypes import POINTER, byref, c_char_p, c_double, c_int, c_int64, c_size_t, c_uint, c_uint16, c_uint64, c_void_p
from dataclasses import dataclass
from ipaddress import ip_address
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Literal

import numpy as np

from uwlts.errors import HardwareError
from uwlts.files.reading import log_warnings
from uwlts.hardware.camera_interface import CameraDevice, CameraInfo, CameraSettings, Delivered
from uwlts.runtime.optional_library import load_aravis

BUFFER_COMPLETE = 0  # ARV_BUFFER_STATUS_SUCCESS
_ENCODER = "EncoderValue"  # requested chunk data; the name of its feature is prefixed with ``Chunk``
_PLAIN: dict[str, float] = dict.fromkeys(["ReverseX", "ReverseY", "LUTEnable", "GammaEnable"], False)
_PLAIN |= dict.fromkeys(["BinningHorizontal", "BinningVertical", "DecimationHorizontal", "DecimationVertical"], 1)
_PLAIN |= {"Gamma": 1.0}
"""Features (GenICam SFNC 2.7) and their values for images as on the image sensor, with grey values linear in light."""
_BUFFERS = 32  # capacity of the queue of frames: half a second at 60 frames/s; further frames are lost
_MONO_BITS = {"Mono8": 8, "Mono10": 10, "Mono12": 12, "Mono14": 14, "Mono16": 16}
"""Bit depths of the grey formats. Packed formats are omitted: few cameras offer only them."""


class _GError(ctypes.Structure):
    _fields_ = (("domain", ctypes.c_uint32), ("code", c_int), ("message", c_char_p))


_INTEGER, _DOUBLE = POINTER(c_int), POINTER(c_double)
# Result type, names after arv_camera_, and the arguments between the camera and the error, which all functions have.
_OF_CAMERA: tuple[tuple[Any, str, list[Any]], ...] = (
    (None, "clear_triggers software_trigger start_acquisition stop_acquisition", []),
    (None, "set_acquisition_mode set_exposure_time_auto set_gain_auto", [c_int]),
    (None, "set_trigger set_pixel_format_from_string", [c_char_p]),
    (None, "set_region", [c_int] * 4),
    (None, "get_region", [_INTEGER] * 4),
    (None, "get_sensor_size", [_INTEGER] * 2),
    (c_char_p, "get_vendor_name get_model_name get_device_serial_number get_pixel_format_as_string", []),
    (POINTER(c_char_p), "dup_available_pixel_formats_as_strings", [POINTER(c_uint)]),
    (c_int, "is_feature_available", [c_char_p]),
    (c_int, "is_exposure_auto_available is_gain_auto_available", []),
    (c_int, "is_exposure_time_available is_frame_rate_available", []),
    (None, "get_exposure_time_bounds get_gain_bounds get_frame_rate_bounds", [_DOUBLE] * 2),
    (c_double, "get_exposure_time get_gain get_frame_rate", []),
    (None, "set_exposure_time set_gain set_frame_rate", [c_double]),
    (c_void_p, "create_stream", [c_void_p] * 2),
    (c_uint, "get_payload", []),
    (c_int64, "get_integer", [c_char_p]),
    (None, "set_integer", [c_char_p, c_int64]),
    (None, "set_float", [c_char_p, c_double]),
    (None, "set_chunk_mode", [c_int]),
    (None, "set_chunk_state", [c_char_p, c_int]),
    (c_double, "get_float", [c_char_p]),
    (c_int, "get_boolean", [c_char_p]),
    (None, "set_boolean", [c_char_p, c_int]),
)
# Result type, full names, and all arguments.
_OTHERS: tuple[tuple[Any, str, list[Any]], ...] = (
    (c_void_p, "arv_camera_new", [c_char_p, POINTER(POINTER(_GError))]),
    (None, "arv_update_device_list", []),
    (c_uint, "arv_get_n_devices", []),
    (c_char_p, "arv_get_device_id arv_get_device_serial_nbr arv_get_device_address", [c_uint]),
    (c_char_p, "arv_get_device_protocol", [c_uint]),
    (c_int, "arv_camera_is_gv_device arv_gv_device_is_controller arv_buffer_get_status", [c_void_p]),
    (c_int, "arv_gv_device_take_control", [c_void_p, POINTER(POINTER(_GError))]),
    (c_void_p, "arv_camera_get_device", [c_void_p]),
    (c_uint16, "arv_gv_stream_get_port", [c_void_p]),
    (None, "arv_stream_push_buffer", [c_void_p, c_void_p]),
    (c_void_p, "arv_stream_timeout_pop_buffer", [c_void_p, c_uint64]),
    (c_void_p, "arv_buffer_new", [c_size_t, c_void_p]),
    (c_void_p, "arv_buffer_get_data", [c_void_p, POINTER(c_size_t)]),
    (c_uint64, "arv_buffer_get_frame_id arv_buffer_get_timestamp", [c_void_p]),
    (c_int, "arv_buffer_get_image_width arv_buffer_get_image_height", [c_void_p]),
    (c_void_p, "arv_device_get_genicam", [c_void_p]),
    (None, "arv_gc_set_buffer", [c_void_p, c_void_p]),
    (c_int, "arv_buffer_has_chunks", [c_void_p]),
    (None, "g_object_unref g_free g_error_free", [c_void_p]),
)


_KINDS = ("float", "boolean", "integer")  # integers last: choices from a list have numbers, too


def _load_functions() -> SimpleNamespace:
    """Return the library's functions with types that apply in this module only."""
    library, functions = load_aravis(), SimpleNamespace()
    of_camera = (
        (result, f"arv_camera_{name}", [c_void_p, *arguments, POINTER(POINTER(_GError))])
        for result, names, arguments in _OF_CAMERA
        for name in names.split()
    )
    for result, names, arguments in (*of_camera, *_OTHERS):
        for name in names.split():
            function = library[name]
            function.restype, function.argtypes = result, arguments
            setattr(functions, name, function)
    return functions


def _decode(value: bytes | None) -> str:
    return "" if value is None else value.decode(errors="replace")


_ANSWER_S = 0.1  # time limit for the answer of a camera on this machine; it takes a few ms
_HEARTBEAT_S = 4.0  # the heartbeat timeout of GigE Vision is 3 s unless a program has changed it
_SOCKET_BYTES = 2**23  # capacity for the packets of several frames of 1280 x 1024 px
# GigE Vision's discovery command: key, acknowledge, command 2, no payload, request 1.
_DISCOVERY = b"\x42\x01\x00\x02\x00\x00\x00\x01"
_LOOPBACK, _CONTROL_PORT = "127.0.0.1", 3956


@dataclass(frozen=True)
class FoundCamera:
    """A discovered camera: identifier, serial number, network address or bus position, and protocol."""

    identifier: str
    serial: str
    address: str
    protocol: str

    def __str__(self) -> str:
        return f"aravis:{self.identifier} ({self.protocol}, {self.address})"


def list_aravis_cameras() -> list[FoundCamera]:
    """Search the networks and USB ports of this machine for cameras, for about a second.

    Raises SetupError if Aravis is not installed.
    """
    functions = _load_functions()
    functions.arv_update_device_list()
    asked = [getattr(functions, f"arv_get_device_{part}") for part in ("id", "serial_nbr", "address", "protocol")]
    count = functions.arv_get_n_devices()
    return _find_on_loopback() + [FoundCamera(*(_decode(ask(k)) for ask in asked)) for k in range(count)]


def _find_on_loopback() -> list[FoundCamera]:
    """Return the camera that a program on this machine serves, which a broadcast does not reach."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as asking:
        asking.settimeout(_ANSWER_S)
        try:
            asking.connect((_LOOPBACK, _CONTROL_PORT))
            asking.send(_DISCOVERY)
            answer = asking.recv(1024)
        except OSError:
            # Nothing listens there, or it does not answer.
            return []
    if len(answer) != 8 + 248 or answer[:4] != b"\0\0\0\x03":
        return []
    maker, model, serial = (
        answer[8 + start : 8 + start + room].partition(b"\0")[0].decode(errors="replace")
        for start, room in ((0x48, 32), (0x68, 32), (0xD8, 16))
    )
    return [FoundCamera(f"{maker}-{model}-{serial}", serial, _LOOPBACK, "GigEVision")]


class AravisCamera(CameraDevice):
    """A camera selected by identifier, serial number or IP address; with an empty name, the only camera found."""

    def __init__(self, name: str, *, address: str | None = None):
        super().__init__(address or f"aravis:{name}")
        self._name = name
        self._functions: SimpleNamespace
        self._camera: int | None = None
        self._stream: int | None = None
        self._has_encoder = False
        self._gone = False

    def _open(self) -> CameraInfo:
        self._functions = functions = _load_functions()
        self._gone = False
        self._camera = self._call("new", self._find_identifier())
        try:
            # A GigE camera obeys one program at a time; Aravis opens a camera of another program for reading.
            if functions.arv_camera_is_gv_device(self._camera) and not self._take_control():
                raise HardwareError(f"the camera {self.address} is used by another program: end that program first")
            width, height = self._read_numbers("get_sensor_size", 2)
            maker, model, serial = (
                _decode(self._call(f"get_{part}")) or "?"
                for part in ("vendor_name", "model_name", "device_serial_number")
            )
            bits = _MONO_BITS.get(self._read_pixel_format(), 8)
            black = self._access("get", "BlackLevel")
        except BaseException:
            self._close()
            raise
        return CameraInfo(f"{maker} {model}", serial, width, height, bits, black)

    def _access(self, verb: Literal["get", "set"], name: str, *value: float) -> Any:
        """Read or set a feature, whose type depends on the camera's maker; None if the camera does not have it."""
        for kind in _KINDS if self._offers(name) else ():
            try:
                return self._call(f"{verb}_{kind}", name.encode(), *value)
            except HardwareError:
                if self._gone or kind == _KINDS[-1]:
                    raise
        return None

    def _set_plain(self) -> None:
        """Switch off what mirrors, bins or bends the images; a calibration is for images without it."""
        found = {name: self._access("get", name) for name in _PLAIN}
        if found["GammaEnable"] is not None:
            # Then Gamma has no effect, and is often locked.
            found["Gamma"] = None
        elif isinstance(found["Gamma"], int):
            log_warnings(self.address, [f"Gamma is choice {found.pop('Gamma')}: check that images are linear in light"])
        # Binning by 0 is a choice from a list, too.
        changed = {name: value for name, value in found.items() if value not in (None, 0, _PLAIN[name])}
        for name, value in changed.items():
            plain = _PLAIN[name]
            with suppress(HardwareError):
                self._access("set", name, plain)
            if self._access("get", name) != plain:
                raise HardwareError(
                    f"the camera {self.address} has {name} = {value:g}, and does not accept {plain:g}: change it in "
                    "the camera's own program; images must be as on the image sensor, and linear in light"
                )
        if text := ", ".join(f"{name} was {value:g} and is now {_PLAIN[name]:g}" for name, value in changed.items()):
            log_warnings(self.address, [f"{text}: calibrations of images with the old value do not apply"])

    def _offers(self, name: str) -> bool:
        return bool(self._call("is_feature_available", name.encode()))

    def _take_control(self) -> bool:
        """Return whether this program controls the camera, after waiting for the heartbeat of a killed program."""
        device, deadline = self._functions.arv_camera_get_device(self._camera), time.monotonic() + _HEARTBEAT_S
        while not self._functions.arv_gv_device_is_controller(device):
            if time.monotonic() > deadline:
                return False
            time.sleep(_ANSWER_S)
            error = POINTER(_GError)()
            if not self._functions.arv_gv_device_take_control(device, byref(error)) and error:
                self._functions.g_error_free(error)
        return True

    def _find_identifier(self) -> bytes:
        """Return the name of the camera in Aravis: an IP address unchanged, or the result of a search."""
        with suppress(ValueError):
            ip_address(self._name)
            return self._name.encode()
        found = list_aravis_cameras()
        fitting = [each for each in found if self._name in ("", each.identifier, each.serial, each.address)]
        if len(fitting) != 1:
            listed = "".join(f"\n  {each}" for each in found) or "\n  none"
            how_many = "no camera is" if not fitting else f"{len(fitting)} cameras are"
            raise HardwareError(
                f"{how_many} called '{self._name}'. Found:{listed}\n"
                "Check power, cable and network settings; a GigE camera must be in the computer's network"
            )
        # An address is contacted directly, which also works on the loopback interface.
        return (fitting[0].address if fitting[0].protocol == "GigEVision" else fitting[0].identifier).encode()

    def _close(self) -> None:
        things = [thing for thing in (self._stream, self._camera) if thing is not None]
        self._stream = self._camera = None
        self._has_encoder = False
        if self._gone:
            # Aravis repeats the release command for 10 s, during which the laser may have to be switched off.
            threading.Thread(target=self._let_go, args=(things,), name="aravis-let-go").start()
        else:
            self._let_go(things)

    def _let_go(self, things: list[int]) -> None:
        for thing in things:
            self._functions.g_object_unref(thing)

    def _configure(self, wanted: CameraSettings) -> CameraSettings:
        self._call("set_acquisition_mode", 0)
        self._call("clear_triggers")
        self._set_plain()
        count = c_uint()
        names = self._call("dup_available_pixel_formats_as_strings", byref(count))
        offered = [names[index].decode() for index in range(count.value)]
        self._functions.g_free(names)
        name = f"Mono{wanted.bits}"
        if name not in offered or name not in _MONO_BITS:
            raise HardwareError(f"the camera {self.address} does not offer {name}, only {', '.join(offered)}")
        self._call("set_pixel_format_from_string", name.encode())
        self._request_counts()
        self._call("set_region", 0, 0, self.info.width_px, self.info.height_px)
        exposure_us = None if wanted.exposure_ms is None else 1e3 * wanted.exposure_ms
        self._set_number("exposure_time", exposure_us, automatic="exposure")
        self._set_number("gain", wanted.gain_db, automatic="gain")
        self._set_number("frame_rate", wanted.frame_rate_hz)
        if wanted.trigger == "software":
            self._call("set_trigger", b"Software")
        exposure_us, gain, rate = (
            self._call(f"get_{feature}") if self._has(feature) else None
            for feature in ("exposure_time", "gain", "frame_rate")
        )
        return CameraSettings(
            exposure_ms=None if exposure_us is None else 1e-3 * exposure_us,
            gain_db=gain,
            bits=_MONO_BITS[self._read_pixel_format()],
            trigger=wanted.trigger,
            frame_rate_hz=rate,
        )

    def _request_counts(self) -> None:
        """Request the encoder count of each frame, if the camera has an encoder."""
        self._has_encoder = self._offers("ChunkModeActive") and self._offers(f"Chunk{_ENCODER}")
        if self._has_encoder:
            self._call("set_chunk_mode", 1)
            self._call("set_chunk_state", _ENCODER.encode(), 1)

    def _set_number(self, feature: str, value: float | None, *, automatic: str | None = None) -> None:
        if automatic and self._call(f"is_{automatic}_auto_available"):
            self._call(f"set_{feature}_auto", 0)
        if value is None:
            return
        if not self._has(feature):
            raise HardwareError(f"the camera {self.address} has no setting for {feature.replace('_', ' ')}")
        low, high = c_double(), c_double()
        self._call(f"get_{feature}_bounds", byref(low), byref(high))
        # Some cameras reject values out of range, others stop answering.
        self._call(f"set_{feature}", min(max(value, low.value), high.value))

    def _has(self, feature: str) -> bool:
        # A gain feature with another name is not in dB.
        if feature == "gain":
            return bool(self._call("is_feature_available", b"Gain"))
        return bool(self._call(f"is_{feature}_available"))

    def _read_pixel_format(self) -> str:
        return _decode(self._call("get_pixel_format_as_string"))

    def _start(self) -> None:
        functions = self._functions
        self._stream = self._call("create_stream", None, None)
        payload = self._call("get_payload")
        if functions.arv_camera_is_gv_device(self._camera):
            _enlarge_buffer(functions.arv_gv_stream_get_port(self._stream))
        for _ in range(_BUFFERS):
            functions.arv_stream_push_buffer(self._stream, functions.arv_buffer_new(payload, None))
        self._call("start_acquisition")

    def _stop(self) -> None:
        if self._gone:
            raise HardwareError(f"the camera {self.address} does not answer any more: check power and cable")
        self._call("stop_acquisition")
        stream, self._stream = self._stream, None
        if stream is not None:
            self._let_go([stream])

    def _trigger(self) -> None:
        self._call("software_trigger")

    def _take_next(self, timeout_s: float) -> Delivered | None:
        functions, stream = self._functions, self._stream
        buffer = functions.arv_stream_timeout_pop_buffer(stream, int(1e6 * timeout_s))
        if buffer is None:
            return None
        try:
            return self._read_buffer(buffer)
        finally:
            functions.arv_stream_push_buffer(stream, buffer)

    def _read_buffer(self, buffer: int) -> Delivered:
        functions = self._functions
        stamp_ns = functions.arv_buffer_get_timestamp(buffer)
        number, time_s = functions.arv_buffer_get_frame_id(buffer), 1e-9 * stamp_ns if stamp_ns else None
        incomplete = Delivered(None, number, time_s)
        if functions.arv_buffer_get_status(buffer) != BUFFER_COMPLETE:
            return incomplete
        size = c_size_t()
        start = functions.arv_buffer_get_data(buffer, byref(size))
        width, height = functions.arv_buffer_get_image_width(buffer), functions.arv_buffer_get_image_height(buffer)
        kind = np.dtype(np.uint8 if self.settings.bits == 8 else "<u2")
        needed = width * height * kind.itemsize
        if size.value < needed:
            return incomplete
        pixels = (ctypes.c_ubyte * needed).from_address(start)
        image = np.frombuffer(pixels, kind).reshape(height, width).astype(kind.newbyteorder("="))
        return Delivered(image, number, time_s, encoder=self._read_encoder(buffer))

    def _read_encoder(self, buffer: int) -> int | None:
        """Return the encoder count that came with a frame, or None."""
        functions = self._functions
        if not self._has_encoder or not functions.arv_buffer_has_chunks(buffer):
            return None
        device = functions.arv_camera_get_device(self._camera)
        functions.arv_gc_set_buffer(functions.arv_device_get_genicam(device), buffer)
        with suppress(HardwareError):
            return self._call("get_integer", f"Chunk{_ENCODER}".encode())
        return None

    def _check_answer(self) -> None:
        self._read_numbers("get_region", 4)

    def _read_numbers(self, name: str, count: int) -> list[int]:
        numbers = [c_int() for _ in range(count)]
        self._call(name, *map(byref, numbers))
        return [number.value for number in numbers]

    def _call(self, name: str, *arguments: object) -> Any:
        """Call ``arv_camera_NAME`` for the camera, if it is open; raises HardwareError for the library's errors."""
        receiver, error = () if self._camera is None else (self._camera,), POINTER(_GError)()
        result = getattr(self._functions, f"arv_camera_{name}")(*receiver, *arguments, byref(error))
        if error:
            complaint = _decode(error.contents.message)
            self._functions.g_error_free(error)
            self._gone = self._gone or "timeout" in complaint
            raise HardwareError(
                f"the camera {self.address} failed at '{name.replace('_', ' ')}': {complaint}. If it does not answer, "
                "check power and cable, and whether another program uses it"
            )
        return result


def _enlarge_buffer(port: int) -> None:
    """Enlarge the system's buffer of the socket at a port to hold several frames; net.core.rmem_max limits it.

    Aravis does so only after the first frame, which is too late if the first packet of that frame was lost. Aravis
    reveals the port of its socket, but not the socket.
    """
    folder = Path("/proc/self/fd")
    for number in [int(entry.name) for entry in folder.iterdir()] if folder.is_dir() else []:
        # The descriptor of the folder itself is already closed.
        with suppress(OSError):
            if not stat.S_ISSOCK(os.fstat(number).st_mode):
                continue
            with socket.socket(fileno=os.dup(number)) as same:
                if same.family == socket.AF_INET and same.getsockname()[1] == port:
                    same.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _SOCKET_BYTES)
