"""Cameras with GigE Vision or USB3 Vision, through the library Aravis 0.8 and its C functions."""

import ctypes
import os
import socket
import stat
import threading
from collections.abc import Callable
from contextlib import suppress
from ctypes import POINTER, byref, c_char_p, c_double, c_int, c_size_t, c_uint, c_uint16, c_uint64, c_void_p
from dataclasses import dataclass
from ipaddress import ip_address
from pathlib import Path
from typing import Any

import numpy as np

from uwlts.hardware.camera import (
    BUFFERS,
    MONO_BITS,
    Camera,
    CameraInfo,
    CameraSettings,
    Delivered,
    Region,
    RequestedSettings,
)
from uwlts.model.errors import HardwareError
from uwlts.runtime.shared_library import load_aravis

BUFFER_COMPLETE = 0

_DOUBLES = [POINTER(c_double)] * 2
_INTEGERS = [POINTER(c_int)] * 4
# Result and arguments; a last argument for the error is added to all of them.
_OF_CAMERA: dict[str, tuple[Any, list[Any]]] = {
    "new": (c_void_p, [c_char_p]),
    "get_sensor_size": (None, [c_void_p, *_INTEGERS[:2]]),
    "get_vendor_name": (c_char_p, [c_void_p]),
    "get_model_name": (c_char_p, [c_void_p]),
    "get_device_serial_number": (c_char_p, [c_void_p]),
    "set_acquisition_mode": (None, [c_void_p, c_int]),
    "clear_triggers": (None, [c_void_p]),
    "set_trigger": (None, [c_void_p, c_char_p]),
    "software_trigger": (None, [c_void_p]),
    "set_region": (None, [c_void_p, c_int, c_int, c_int, c_int]),
    "get_region": (None, [c_void_p, *_INTEGERS]),
    "is_feature_available": (c_int, [c_void_p, c_char_p]),
    "is_exposure_auto_available": (c_int, [c_void_p]),
    "is_gain_auto_available": (c_int, [c_void_p]),
    "set_exposure_time_auto": (None, [c_void_p, c_int]),
    "set_gain_auto": (None, [c_void_p, c_int]),
    "dup_available_pixel_formats_as_strings": (POINTER(c_char_p), [c_void_p, POINTER(c_uint)]),
    "get_pixel_format_as_string": (c_char_p, [c_void_p]),
    "set_pixel_format_from_string": (None, [c_void_p, c_char_p]),
    "create_stream": (c_void_p, [c_void_p, c_void_p, c_void_p]),
    "get_payload": (c_uint, [c_void_p]),
    "start_acquisition": (None, [c_void_p]),
    "stop_acquisition": (None, [c_void_p]),
}
for _feature in ("exposure_time", "gain", "frame_rate"):
    _OF_CAMERA |= {
        f"is_{_feature}_available": (c_int, [c_void_p]),
        f"get_{_feature}_bounds": (None, [c_void_p, *_DOUBLES]),
        f"get_{_feature}": (c_double, [c_void_p]),
        f"set_{_feature}": (None, [c_void_p, c_double]),
    }
_OTHERS: dict[str, tuple[Any, list[Any]]] = {
    "arv_update_device_list": (None, []),
    "arv_get_n_devices": (c_uint, []),
    "arv_get_device_id": (c_char_p, [c_uint]),
    "arv_get_device_serial_nbr": (c_char_p, [c_uint]),
    "arv_get_device_address": (c_char_p, [c_uint]),
    "arv_get_device_protocol": (c_char_p, [c_uint]),
    "arv_camera_is_gv_device": (c_int, [c_void_p]),
    "arv_camera_get_device": (c_void_p, [c_void_p]),
    "arv_gv_device_is_controller": (c_int, [c_void_p]),
    "arv_gv_stream_get_port": (c_uint16, [c_void_p]),
    "arv_stream_push_buffer": (None, [c_void_p, c_void_p]),
    "arv_stream_timeout_pop_buffer": (c_void_p, [c_void_p, c_uint64]),
    "arv_buffer_new": (c_void_p, [c_size_t, c_void_p]),
    "arv_buffer_get_status": (c_int, [c_void_p]),
    "arv_buffer_get_data": (c_void_p, [c_void_p, POINTER(c_size_t)]),
    "arv_buffer_get_frame_id": (c_uint64, [c_void_p]),
    "arv_buffer_get_timestamp": (c_uint64, [c_void_p]),
    "arv_buffer_get_image_width": (c_int, [c_void_p]),
    "arv_buffer_get_image_height": (c_int, [c_void_p]),
    "g_object_unref": (None, [c_void_p]),
    "g_free": (None, [c_void_p]),
}


class _GError(ctypes.Structure):
    _fields_ = (("domain", ctypes.c_uint32), ("code", c_int), ("message", c_char_p))


class AravisFunctions:
    """The library's functions as attributes, ready to be called."""

    def __init__(self, library: ctypes.CDLL):
        self._functions: dict[str, Callable[..., Any]] = {}
        table: dict[str, tuple[Any, list[Any]]] = dict(_OTHERS)
        for name, (result, arguments) in _OF_CAMERA.items():
            table[f"arv_camera_{name}"] = (result, [*arguments, POINTER(POINTER(_GError))])
        for name, (result, arguments) in table.items():
            function = library[name]
            function.restype, function.argtypes = result, arguments
            self._functions[name] = function
        self._free_error = library["g_error_free"]
        self._free_error.restype, self._free_error.argtypes = None, [c_void_p]

    def __getattr__(self, name: str) -> Callable[..., Any]:
        return self._functions[name]

    def checked(self, name: str, *arguments: object) -> tuple[Any, str | None]:
        """Call a function of a camera; its result, and the error message if there is one."""
        error = POINTER(_GError)()
        result = self._functions[name](*arguments, byref(error))
        if not error:
            return result, None
        message = self.text(error.contents.message)
        self._free_error(error)
        return result, message

    @staticmethod
    def text(value: bytes | None) -> str:
        """A C string as text; empty if there is none."""
        return "" if value is None else value.decode(errors="replace")


_ANSWER_S = 0.1
"""A camera on this machine answers a search within some ms."""
_SOCKET_BYTES = 2**23
"""Room for the packets of some frames of 1280 x 1024 px."""
# GigE Vision's discovery command: key, acknowledge, command 2, no content, request 1.
_DISCOVERY = b"\x42\x01\x00\x02\x00\x00\x00\x01"
_LOOPBACK, _CONTROL_PORT = "127.0.0.1", 3956


@dataclass(frozen=True)
class FoundCamera:
    """A camera that answered: identifier, network address or bus position, protocol."""

    identifier: str
    serial: str
    address: str
    protocol: str

    def __str__(self) -> str:
        return f"aravis:{self.identifier} ({self.protocol}, {self.address})"


def list_aravis_cameras() -> list[FoundCamera]:
    """Ask for all cameras on the networks and USB ports of this machine; takes about a second.

    Raises
    ------
    SetupError
        Aravis is not installed.
    """
    functions = AravisFunctions(load_aravis())
    functions.arv_update_device_list()
    parts = ("id", "serial_nbr", "address", "protocol")
    found = _served_on_loopback()
    for index in range(functions.arv_get_n_devices()):
        identifier, serial, address, protocol = (
            functions.text(getattr(functions, f"arv_get_device_{part}")(index)) for part in parts
        )
        found.append(FoundCamera(identifier, serial, address, protocol))
    return found


def _served_on_loopback() -> list[FoundCamera]:
    """The camera that a program on this machine plays, which a search by broadcast does not reach."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as asking:
        asking.settimeout(_ANSWER_S)
        try:
            asking.connect((_LOOPBACK, _CONTROL_PORT))
            asking.send(_DISCOVERY)
            answer = asking.recv(1024)
        except OSError:
            # Nobody listens there, or not to this.
            return []
    if len(answer) != 8 + 248 or answer[:4] != b"\0\0\0\x03":
        return []
    maker, model, serial = (
        answer[8 + start : 8 + start + room].partition(b"\0")[0].decode(errors="replace")
        for start, room in ((0x48, 32), (0x68, 32), (0xD8, 16))
    )
    return [FoundCamera(f"{maker}-{model}-{serial}", serial, _LOOPBACK, "GigEVision")]


class AravisCamera(Camera):
    """A camera by its identifier, serial number or IP address; the only one there is if the name is empty."""

    def __init__(self, name: str, *, address: str | None = None):
        super().__init__(address or f"aravis:{name}")
        self._name = name
        self._functions: AravisFunctions
        self._camera: int | None = None
        self._stream: int | None = None
        self._gone = False

    def _open(self) -> CameraInfo:
        self._functions = AravisFunctions(load_aravis())
        self._gone = False
        self._camera = self._call("new", self._identifier(), of=None)
        try:
            self._require_control()
            width, height = self._numbers("get_sensor_size", 2)
            maker, model, serial = (
                self._functions.text(self._call(f"get_{part}")) or "?"
                for part in ("vendor_name", "model_name", "device_serial_number")
            )
            bits = MONO_BITS.get(self._pixel_format(), 8)
        except BaseException:
            self._close()
            raise
        return CameraInfo(f"{maker} {model}", serial, width, height, bits)

    def _identifier(self) -> bytes:
        """How Aravis calls the camera: an IP address as it is, for everything else there is a search."""
        if _is_ip_address(self._name):
            return self._name.encode()
        found = list_aravis_cameras()
        fitting = [each for each in found if self._name in ("", each.identifier, each.serial, each.address)]
        if len(fitting) != 1:
            listed = "".join(f"\n  {each}" for each in found) or "\n  none"
            how_many = "no camera is" if not fitting else f"{len(fitting)} cameras are"
            raise HardwareError(
                f"{how_many} called '{self._name}'. Found:{listed}\n"
                "Check power, cable and network settings; a GigE camera must be in the network of the computer"
            )
        # An address is asked directly, which also reaches the loopback interface.
        return (fitting[0].address if fitting[0].protocol == "GigEVision" else fitting[0].identifier).encode()

    def _require_control(self) -> None:
        """A GigE camera obeys one program at a time; Aravis opens it for reading where that is another one."""
        functions = self._functions
        if functions.arv_camera_is_gv_device(self._camera):
            device = functions.arv_camera_get_device(self._camera)
            if not functions.arv_gv_device_is_controller(device):
                raise HardwareError(f"the camera {self.address} is used by another program: end that one first")

    def _close(self) -> None:
        things = [thing for thing in (self._stream, self._camera) if thing is not None]
        self._stream = self._camera = None
        if self._gone:
            # Aravis asks it again and again to let go, for 10 s, in which a laser may have to be switched off.
            threading.Thread(target=self._let_go, args=(things,), name="aravis-let-go").start()
        else:
            self._let_go(things)

    def _let_go(self, things: list[int]) -> None:
        for thing in things:
            self._functions.g_object_unref(thing)

    def _configure(self, requested: RequestedSettings) -> CameraSettings:
        info = self.info
        self._call("set_acquisition_mode", 0)
        self._call("clear_triggers")
        self._set_pixel_format(requested.bits)
        region = requested.region or Region(0, 0, info.width_px, info.height_px)
        self._call("set_region", region.x_px, region.y_px, region.width_px, region.height_px)
        for feature, value in (("exposure_time", requested.exposure_ms), ("gain", requested.gain_db)):
            if value is not None:
                self._set_number(feature, 1e3 * value if feature == "exposure_time" else value)
        if requested.frame_rate_hz is not None:
            self._set_number("frame_rate", requested.frame_rate_hz)
        if requested.trigger != "free":
            self._call("set_trigger", b"Software" if requested.trigger == "software" else b"Line0")
        exposure_us, gain, rate = (self._get_number(feature) for feature in ("exposure_time", "gain", "frame_rate"))
        return CameraSettings(
            exposure_ms=None if exposure_us is None else 1e-3 * exposure_us,
            gain_db=gain,
            region=Region(*self._numbers("get_region", 4)),
            bits=MONO_BITS[self._pixel_format()],
            trigger=requested.trigger,
            frame_rate_hz=rate if requested.trigger == "free" else None,
        )

    def _set_number(self, feature: str, value: float) -> None:
        if not self._has(feature):
            raise HardwareError(f"the camera {self.address} has no setting for {feature.replace('_', ' ')}")
        automatic = feature.replace("_time", "")
        if feature != "frame_rate" and self._call(f"is_{automatic}_auto_available"):
            self._call(f"set_{feature}_auto", 0)
        low, high = (ctypes.c_double() for _ in range(2))
        self._call(f"get_{feature}_bounds", ctypes.byref(low), ctypes.byref(high))
        # Some cameras refuse what is out of range, others stop answering.
        self._call(f"set_{feature}", min(max(value, low.value), high.value))

    def _get_number(self, feature: str) -> float | None:
        return self._call(f"get_{feature}") if self._has(feature) else None

    def _has(self, feature: str) -> bool:
        # A gain that is called otherwise is not in dB.
        if feature == "gain":
            return bool(self._call("is_feature_available", b"Gain"))
        return bool(self._call(f"is_{feature}_available"))

    def _set_pixel_format(self, bits: int | None) -> None:
        count = ctypes.c_uint()
        names = self._call("dup_available_pixel_formats_as_strings", ctypes.byref(count))
        offered = [names[index].decode() for index in range(count.value)]
        self._functions.g_free(names)
        wanted = self._grey_format(bits, self._pixel_format(), offered)
        self._call("set_pixel_format_from_string", wanted.encode())

    def _pixel_format(self) -> str:
        return self._functions.text(self._call("get_pixel_format_as_string"))

    def _start(self) -> None:
        functions = self._functions
        self._stream = self._call("create_stream", None, None)
        payload = self._call("get_payload")
        if functions.arv_camera_is_gv_device(self._camera):
            _widen(functions.arv_gv_stream_get_port(self._stream))
        for _ in range(BUFFERS):
            functions.arv_stream_push_buffer(self._stream, functions.arv_buffer_new(payload, None))
        self._call("start_acquisition")

    def _stop(self) -> None:
        if self._gone:
            raise HardwareError(f"the camera {self.address} does not answer any more and cannot be stopped")
        self._call("stop_acquisition")
        stream, self._stream = self._stream, None
        if stream is not None:
            self._let_go([stream])

    def _trigger(self) -> None:
        self._call("software_trigger")

    def _next(self, timeout_s: float) -> Delivered | None:
        functions, stream = self._functions, self._stream
        buffer = functions.arv_stream_timeout_pop_buffer(stream, int(1e6 * timeout_s))
        if buffer is None:
            return None
        try:
            return self._delivered(buffer)
        finally:
            functions.arv_stream_push_buffer(stream, buffer)

    def _delivered(self, buffer: int) -> Delivered:
        functions = self._functions
        stamp_ns = functions.arv_buffer_get_timestamp(buffer)
        number, time_s = functions.arv_buffer_get_frame_id(buffer), 1e-9 * stamp_ns if stamp_ns else None
        if functions.arv_buffer_get_status(buffer) != BUFFER_COMPLETE:
            return Delivered(None, number, time_s)
        size = ctypes.c_size_t()
        start = functions.arv_buffer_get_data(buffer, ctypes.byref(size))
        width, height = functions.arv_buffer_get_image_width(buffer), functions.arv_buffer_get_image_height(buffer)
        kind = np.dtype(np.uint8 if self.settings.bits == 8 else "<u2")
        if size.value < width * height * kind.itemsize:
            return Delivered(None, number, time_s)
        pixels = (ctypes.c_ubyte * (width * height * kind.itemsize)).from_address(start)
        image = np.frombuffer(pixels, kind).reshape(height, width).astype(kind.newbyteorder("="))
        return Delivered(image, number, time_s)

    def _answers(self) -> None:
        self._numbers("get_region", 4)

    def _numbers(self, name: str, count: int) -> list[int]:
        numbers = [ctypes.c_int() for _ in range(count)]
        self._call(name, *map(ctypes.byref, numbers))
        return [number.value for number in numbers]

    def _call(self, name: str, *arguments: object, of: str | None = "camera") -> Any:
        """Call ``arv_camera_NAME``; the library's complaint becomes a HardwareError."""
        receiver = () if of is None else (self._camera,)
        result, complaint = self._functions.checked(f"arv_camera_{name}", *receiver, *arguments)
        if complaint is not None:
            self._gone = self._gone or "timeout" in complaint
            raise self._failed(f"'{name.replace('_', ' ')}'", complaint)
        return result


def _widen(port: int) -> None:
    """Make room in the system for the packets of whole frames; net.core.rmem_max limits it.

    Aravis does so only once the first frame has come, too late for it and for all others if its first packet was lost.
    Aravis gives the port of its socket, but not the socket.
    """
    folder = Path("/proc/self/fd")
    for number in [int(entry.name) for entry in folder.iterdir()] if folder.is_dir() else []:
        # The folder's own number is gone by now.
        with suppress(OSError):
            if not stat.S_ISSOCK(os.fstat(number).st_mode):
                continue
            with socket.socket(fileno=os.dup(number)) as same:
                if same.family == socket.AF_INET and same.getsockname()[1] == port:
                    same.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _SOCKET_BYTES)


def _is_ip_address(name: str) -> bool:
    try:
        ip_address(name)
    except ValueError:
        return False
    return True
