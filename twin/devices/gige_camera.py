"""GigE Vision camera on the loopback interface that sends images at the speed of a real cable."""

import ctypes
import socket
import struct
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor, wait
from ctypes import c_char_p, c_double, c_int, c_size_t, c_uint32, c_uint64, c_void_p
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Literal, Self
from xml.etree import ElementTree

import numpy as np

from uwlts.errors import HardwareError, ImageError
from uwlts.runtime.optional_library import load_aravis

# Data rate of 1 Gbit/s.
_BYTES_PER_S = 125e6
# Packets per burst, because sleeps are not exact.
_TOGETHER = 8
# Headers of IP, UDP and GVSP, which the packet size includes.
_OVERHEAD_BYTES = 36
# Kinds of packets and payload, and the pixel format (GigE Vision 2.0; GenICam Pixel Format Naming Convention).
_LEADER = 1
_TRAILER = 2
_PAYLOAD = 3
_IMAGE = 1
_WITH_CHUNKS = 0x4000
_MONO8 = 0x01080001
# Chunk identifiers, defined by the camera.
_IMAGE_CHUNK = 0x45430000
_ENCODER_CHUNK = 0x45430001
_CHUNK_BYTES = 3 * 8
"""Size of the encoder count, and of the identifiers and lengths of image and count, after an image."""


def image_packets(
    image: np.ndarray, time_ns: int, *, number: int, packet_bytes: int, count: int | None = None
) -> list[bytes]:
    """Return the packets of an image (H, W), uint8: leader, payload, and trailer.

    ``number`` is that of the frame, 16 bits. ``packet_bytes`` is the size of a packet including all headers. ``count``
    is that of the encoder, sent after the image (GigE Vision 2.0, extended chunk mode).
    """
    height, width = image.shape
    pixels, room, kind = image.tobytes(), packet_bytes - _OVERHEAD_BYTES, _IMAGE
    if count is not None:
        kind |= _WITH_CHUNKS
        pixels += struct.pack(">IIqII", _IMAGE_CHUNK, len(pixels), count, _ENCODER_CHUNK, 8)
    leader = struct.pack(">HHQIIIIIHH", 0, kind, time_ns, _MONO8, width, height, 0, 0, 0, 0)
    parts = [pixels[start : start + room] for start in range(0, len(pixels), room)]
    bodies = [(_LEADER, leader), *((_PAYLOAD, each) for each in parts), (_TRAILER, struct.pack(">II", kind, height))]
    return [struct.pack(">HHI", 0, number, kind << 24 | index) + body for index, (kind, body) in enumerate(bodies)]


def send_paced(stream: socket.socket, packets: list[bytes], to: tuple[str, int]) -> None:
    """Send packets no faster than a real cable, because hosts lose packets at much higher rates."""
    began, sent_bytes = time.perf_counter(), 0
    for index, packet in enumerate(packets):
        stream.sendto(packet, to)
        sent_bytes += len(packet)
        ahead_s = sent_bytes / _BYTES_PER_S - (time.perf_counter() - began)
        if index % _TOGETHER == _TOGETHER - 1 and ahead_s > 0:
            time.sleep(ahead_s)


_GENAPI = "http://www.genicam.org/GenApi/Version_1_0"
LOOPBACK = "127.0.0.1"
PORT = 3956  # GigE Vision's control port
# Jumbo packets, as on a bench. With Aravis's 2000 bytes, an image has 670 packets.
_PACKET_BYTES = 9000
# Rate of checks for a trigger; commands are answered in between. At 1000 per s the thread would never sleep.
_LOOKS_FOR_TRIGGER_HZ = 200.0
# Hosts repeat a command without an answer after 500 ms.
_LONGEST_WAIT_S = 0.1
_NAME_BYTES = 32
_SERIAL, _SERIAL_BYTES = b"1", 16
# Frame numbers have 16 bits and skip 0.
_LAST_NUMBER = 2**16 - 1
# In a "cut" frame, every tenth packet is lost, at least one, but not the first, which announces the frame.
_CUT_EVERY = 10
# GLib's type number of double.
_DOUBLE_TYPE = 15 << 2

_FILL = ctypes.CFUNCTYPE(None, c_void_p, c_void_p, c_uint32, c_uint32, c_uint32)


class _Register:
    """Addresses of the fake camera's registers."""

    MAKER, MODEL, STREAM_PORT, PACKET_SIZE, STREAM_IP = 0x48, 0x68, 0xD00, 0xD04, 0xD18
    WIDTH, HEIGHT, SENSOR_HEIGHT, SENSOR_WIDTH = 0x100, 0x104, 0x118, 0x11C
    ACQUISITION, TRIGGER_SOFTWARE, DEVICE_ID = 0x124, 0x30C, 0xD8
    CHUNKS, ENCODER_CHUNK = 0x1020, 0x1024


_FUNCTIONS = {
    "arv_gv_fake_camera_new_full": (c_void_p, [c_char_p, c_char_p, c_char_p]),
    "arv_fake_camera_new": (c_void_p, [c_char_p]),
    "arv_fake_camera_get_genicam_xml": (c_void_p, [c_void_p, ctypes.POINTER(c_size_t)]),
    "arv_gv_fake_camera_get_fake_camera": (c_void_p, [c_void_p]),
    "arv_gv_fake_camera_is_running": (c_int, [c_void_p]),
    "arv_fake_camera_set_fill_pattern": (None, [c_void_p, _FILL, c_void_p]),
    "arv_fake_camera_set_trigger_frequency": (None, [c_void_p, c_double]),
    "arv_fake_camera_write_memory": (c_int, [c_void_p, c_uint32, c_uint32, c_char_p]),
    "arv_fake_camera_write_register": (c_int, [c_void_p, c_uint32, c_uint32]),
    "arv_fake_camera_read_register": (c_int, [c_void_p, c_uint32, ctypes.POINTER(c_uint32)]),
    "arv_fake_camera_is_in_software_trigger_mode": (c_int, [c_void_p]),
    "g_value_init": (c_void_p, [c_void_p, c_size_t]),
    "g_value_set_double": (None, [c_void_p, c_double]),
    "g_object_set_property": (None, [c_void_p, c_char_p, c_void_p]),
    "g_object_unref": (None, [c_void_p]),
}


@dataclass(frozen=True)
class _Shot:
    """Image (H, W), the start of its exposure in ns, and the encoder count if there is an encoder."""

    image: np.ndarray
    time_ns: int
    count: int | None


@dataclass(frozen=True)
class ExposedFrame:
    """Exposure: its middle in s of the monotonic clock, the encoder count at that time, and its image.

    ``image(exposure_ms)`` returns the whole image (H, W), uint8.
    """

    middle_s: float
    encoder: int | None
    image: Callable[[float], np.ndarray]


class GigeCamera:
    """Server of an 8-bit camera, as a context manager.

    ``frame(exposure_ms)`` returns the whole image (height_px, width_px), uint8; all calls are in the same thread. If it
    raises an exception, the frame is lost and the exception is kept in ``failure``. A trigger that arrives during the
    making of an image replaces the previous trigger, which is not answered.

    Frames contain the whole image, also if a program sets a region.

    ``encoder`` returns the count of an encoder that is wired to the camera. It is sent as chunk data on request.

    ``expose`` is called in the middle of each exposure of a free-running camera, at its frame rate and with true time
    stamps. Images are made later and wait in the camera's memory. They are lost at the end of the acquisition.

    HardwareError if another camera is served on this machine; SetupError if Aravis is not installed.
    """

    def __init__(
        self,
        frame: Callable[[float], np.ndarray],
        *,
        width_px: int = 1280,
        height_px: int = 1024,
        encoder: Callable[[], int] | None = None,
        expose: Callable[[], ExposedFrame] | None = None,
    ):
        self.failure: BaseException | None = None
        self._frame, self._encoder, self._expose = frame, encoder, expose
        self._size = (height_px, width_px)
        self._library = _load_functions()
        # The library does not keep a reference to the callback.
        self._callback = _FILL(self._fill)
        self._server: int | None = None
        self._lock = threading.Lock()
        self._faults: Counter[str] = Counter()
        self._delay_s = 0.0
        self._number = 0
        self._making: Future[_Shot] | None = None
        self._answer: _Shot | None = None
        self._last: _Shot | None = None
        self._maker_thread = ThreadPoolExecutor(max_workers=1, thread_name_prefix="gige-camera")
        self._stopping = threading.Event()

    @property
    def address(self) -> str:
        """Address of this camera for `uwlts`."""
        return f"gige:{LOOPBACK}"

    def inject(
        self, fault: Literal["drop", "repeat", "cut", "delay"], frames: int = 1, *, delay_s: float = 0.0
    ) -> None:
        """Inject a fault into each of the next frames.

        "drop" loses the frame. "repeat" sends the previous frame again, with its time stamp. "cut" loses a tenth of the
        packets. "delay" starts the exposure ``delay_s`` later.
        """
        with self._lock:
            self._faults[fault] = frames
            self._delay_s = delay_s if fault == "delay" else self._delay_s

    def _apply_fault(self, fault: str) -> bool:
        """Return whether a fault applies to the present frame, and count it; call only with the lock held."""
        met = self._faults[fault] > 0
        self._faults[fault] -= met
        return met

    def disconnect(self) -> None:
        """Disconnect as if the cable were pulled: send nothing and answer no command."""
        with self._lock:
            server, self._server = self._server, None
            self._making = self._answer = None
        if server is not None:
            # This waits for the library's thread. The object must not be used afterwards.
            self._library.g_object_unref(server)
            self._stream.close()

    def connect(self) -> None:
        """Connect as if the cable were plugged in and the camera switched on."""
        if self._server is not None:
            return
        library = self._library
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as trial:
            try:
                trial.bind((LOOPBACK, PORT))
            except OSError as error:  # Aravis does not report it
                raise HardwareError(
                    f"UDP port {PORT} of {LOOPBACK} cannot be used ({error.strerror}): another camera is served there; "
                    "stop that program first"
                ) from error
        self._stream = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._stream.bind((LOOPBACK, 0))
        # Occupy the broadcast address during the start, so that Aravis does not listen on all networks.
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as guard:
            guard.bind(("255.255.255.255", PORT))
            with tempfile.NamedTemporaryFile(suffix=".xml") as features:
                features.write(self._describe_features())
                features.flush()
                interface, name = LOOPBACK.encode(), features.name.encode()
                self._server = library.arv_gv_fake_camera_new_full(interface, _SERIAL, name)
        if not library.arv_gv_fake_camera_is_running(self._server):
            self.disconnect()
            raise HardwareError(
                f"Aravis's camera does not start on {LOOPBACK}: check that the loopback interface is up"
            )
        # The library's own packets are all dropped.
        every = (c_uint64 * 3)()
        library.g_value_init(every, _DOUBLE_TYPE)
        library.g_value_set_double(every, 1.0)
        library.g_object_set_property(self._server, b"gvsp-lost-ratio", every)
        self._camera = library.arv_gv_fake_camera_get_fake_camera(self._server)
        height, width = self._size
        memory = {
            _Register.MAKER: b"UWLTS".ljust(_NAME_BYTES, b"\0"),
            _Register.MODEL: b"Twin".ljust(_NAME_BYTES, b"\0"),
            _Register.DEVICE_ID: _SERIAL.ljust(_SERIAL_BYTES, b"\0"),
        }
        numbers = {
            _Register.SENSOR_WIDTH: width,
            _Register.WIDTH: width,
            _Register.SENSOR_HEIGHT: height,
            _Register.HEIGHT: height,
            _Register.PACKET_SIZE: _PACKET_BYTES,
        }
        for register, data in memory.items():
            library.arv_fake_camera_write_memory(self._camera, register, len(data), data)
        for register, number in numbers.items():
            library.arv_fake_camera_write_register(self._camera, register, number)
        library.arv_fake_camera_set_trigger_frequency(self._camera, _LOOKS_FOR_TRIGGER_HZ)
        library.arv_fake_camera_set_fill_pattern(self._camera, self._callback, None)

    def _describe_features(self) -> bytes:
        """Return the XML of the camera's features: Aravis's fake camera, with those of an encoder if it has one."""
        library, size = self._library, c_size_t()
        usual = library.arv_fake_camera_new(_SERIAL)
        described = ctypes.string_at(library.arv_fake_camera_get_genicam_xml(usual, ctypes.byref(size)), size.value)
        library.g_object_unref(usual)
        # The standard's name of the exposure (GenICam SFNC 2.7).
        root = ElementTree.fromstring(described.replace(b"ExposureTimeAbs", b"ExposureTime"))
        root.attrib |= {"VendorName": "UWLTS", "ModelName": "Twin", "ToolTip": "digital twin of a camera"}
        if self._encoder is not None:
            root.extend(ElementTree.fromstring((Path(__file__).parent / "encoder_features.xml").read_bytes()))
            payload = root.find(f"{{{_GENAPI}}}IntSwissKnife[@Name='PayloadSize']/{{{_GENAPI}}}Formula")
            assert payload is not None and payload.text is not None
            payload.text += f" + {_CHUNK_BYTES}"
        ElementTree.register_namespace("", _GENAPI)
        return ElementTree.tostring(root, encoding="utf-8", xml_declaration=True)

    def _fill(self, _buffer: int, _data: None, exposure_us: int, _gain: int, _pixel_format: int) -> None:
        """Send a frame; the library calls this when a frame is due, and its own packets are dropped."""
        if self._expose is not None and not self._is_triggered():
            self._stopping.wait(0.5e-6 * exposure_us)
            self._maker_thread.submit(self._develop, self._expose(), 1e-3 * exposure_us)
        elif (shot := self._choose_image(1e-3 * exposure_us)) is not None:
            self._send(shot)

    def _develop(self, exposed: ExposedFrame, exposure_ms: float) -> None:
        """Make the image of an exposure and send it, unless triggers follow by then; called in the second thread."""
        with self._lock:
            if self._server is None or not self._read_register(_Register.ACQUISITION) or self._is_triggered():
                return
        try:
            image = exposed.image(exposure_ms)
        except BaseException as error:
            self.failure = error
            raise
        self._send(_Shot(image, round(1e9 * exposed.middle_s - 0.5e6 * exposure_ms), exposed.encoder), free=True)

    def _send(self, shot: _Shot, *, free: bool = False) -> None:
        with self._lock:
            if self._server is None or (free and self._is_triggered()):
                return
            if self._last is not None and self._apply_fault("repeat"):
                shot = self._last
            self._last = shot
            self._number = self._number % _LAST_NUMBER + 1
            dropped, shortened = self._apply_fault("drop"), self._apply_fault("cut")
            names = (_Register.STREAM_IP, _Register.STREAM_PORT, _Register.PACKET_SIZE)
            host, port, packet_bytes = map(self._read_register, names)
            counted = self._read_register(_Register.CHUNKS) and self._read_register(_Register.ENCODER_CHUNK)
        if not dropped:
            size, count = packet_bytes & 0xFFFF, shot.count if counted else None
            packets = image_packets(shot.image, shot.time_ns, number=self._number, packet_bytes=size, count=count)
            if shortened:
                lost = range(_CUT_EVERY - 1, len(packets), _CUT_EVERY) or (len(packets) - 2,)
                packets = [packet for index, packet in enumerate(packets) if index not in lost]
            send_paced(self._stream, packets, (socket.inet_ntoa(struct.pack(">I", host)), port & 0xFFFF))

    def _choose_image(self, exposure_ms: float) -> _Shot | None:
        """Return the image to send now; None while it is being made."""
        triggered = self._is_triggered()
        with self._lock:
            answer, self._answer = self._answer, None
            if answer is not None or self._server is None:
                return answer
            before = self._making
            making = self._maker_thread.submit(self._make, exposure_ms) if before is None or triggered else before
            self._making = making
        if before is not None and before is not making:
            before.cancel()
        if not wait([making], timeout=_LONGEST_WAIT_S).done:
            if triggered:
                making.add_done_callback(self._send_when_ready)
            return None
        with self._lock:
            return self._take(making)

    def _send_when_ready(self, made: Future[_Shot]) -> None:
        """Keep a finished image and trigger the library to ask for it; called in the second thread."""
        with self._lock:
            if self._server is None or not self._read_register(_Register.ACQUISITION):
                return
            self._answer = self._take(made)
            if self._answer is not None:
                self._library.arv_fake_camera_write_register(self._camera, _Register.TRIGGER_SOFTWARE, 1)

    def _take(self, made: Future[_Shot]) -> _Shot | None:
        """Return the image of the latest trigger; None if it failed or belongs to an earlier trigger."""
        if made is not self._making:
            return None
        self._making = None
        self.failure = made.exception() or self.failure
        return None if made.exception() else made.result()

    def _make(self, exposure_ms: float) -> _Shot:
        with self._lock:
            delay_s = self._delay_s if self._apply_fault("delay") else 0.0
        self._stopping.wait(delay_s)
        began_ns = time.monotonic_ns()
        image = self._frame(exposure_ms)
        if image.shape != self._size or image.dtype != np.uint8:
            raise ImageError(f"the image is {image.shape} {image.dtype}; expected {self._size} uint8")
        return _Shot(image, began_ns, None if self._encoder is None else self._encoder())

    def _is_triggered(self) -> bool:
        return bool(self._library.arv_fake_camera_is_in_software_trigger_mode(self._camera))

    def _read_register(self, register: int) -> int:
        number = c_uint32()
        self._library.arv_fake_camera_read_register(self._camera, register, ctypes.byref(number))
        return number.value

    def __enter__(self) -> Self:
        self.connect()
        return self

    def __exit__(self, *_: object) -> None:
        self._stopping.set()
        self.disconnect()
        self._maker_thread.shutdown(cancel_futures=True)


def _load_functions() -> SimpleNamespace:
    """Return the library's functions with their types, for this module only."""
    library, functions = load_aravis(), SimpleNamespace()
    for name, (result, arguments) in _FUNCTIONS.items():
        function = library[name]
        function.restype, function.argtypes = result, arguments
        setattr(functions, name, function)
    return functions
