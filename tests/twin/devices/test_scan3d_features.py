"""Read the served 3D camera's features and chunk data with GenApi, the standard's reference implementation.

`harvesters` reads cameras through GenApi. No free GenTL producer supports GigE Vision cameras. Therefore the transport
of frames by a producer is tested with images only (`tests/uwlts/hardware/test_cameras.py`).
"""

import struct
from types import SimpleNamespace

import numpy as np
import pytest
from genicam import genapi

from twin.devices.gige_camera import ENCODER_CHUNK, TIME_CHUNK, GigeCamera, image_packets
from twin.sensor.peak_finder import INVALID, PeakFinder
from uwlts.hardware.camera_interface import CameraInfo, CameraSettings, Delivered, Region
from uwlts.hardware.genicam import GenicamCamera
from uwlts.model.library import load_sensor
from uwlts.model.stripe import Coordinates

WIDTH, ROWS, PACKET_BYTES = 96, 8, 1500
SENSOR_HEIGHT, SENSOR_WIDTH, SCALE = 0x118, 0x11C, 0x1000


class Registers(genapi.AbstractPort):
    """The registers of a camera, all of them memory."""

    def __init__(self) -> None:
        super().__init__()
        self.memory: dict[int, int] = {}

    def get_access_mode(self) -> int:
        return genapi.EAccessMode.RW

    def is_open(self) -> bool:
        return True

    def read(self, address: int, length: int) -> bytes:
        return bytes(self.memory.get(address + k, 0) for k in range(length))

    def write(self, address: int, value: bytes) -> None:
        self.memory |= {address + k: byte for k, byte in enumerate(value)}


@pytest.fixture
def camera() -> GenicamCamera:
    """Return a `GenicamCamera` on the nodes of the twin's description, instead of nodes read by a producer."""
    finder = PeakFinder(load_sensor("thesis").camera, 255, 16)
    served = GigeCamera(lambda exposure_ms: np.zeros((1024, 1280), np.uint8), scan3d=finder, encoder=lambda: 0)
    registers, nodes = Registers(), genapi.NodeMap()
    registers.write(SENSOR_WIDTH, struct.pack(">I", 1280))
    registers.write(SENSOR_HEIGHT, struct.pack(">I", 1024))
    registers.write(SCALE, struct.pack(">d", finder.scale_px()))
    nodes.load_xml_from_string(served._features().decode())
    nodes.connect(registers, "Device")
    opened = GenicamCamera("twin")
    opened._faults = (genapi.GenericException,)
    opened._acquirer = SimpleNamespace(remote_device=SimpleNamespace(node_map=nodes), registers=registers)
    return opened


def test_genapi_reads_the_description_and_the_numbers_of_each_profile(camera):
    assert camera._coordinates() == Coordinates(1 / 16, 0.0, INVALID)
    camera._set_chunks()
    camera._set_region(Region(0, 0, WIDTH, ROWS))
    camera._node("PixelFormat").value = "Coord3D_C16"
    places = 16 * (100 + np.arange(ROWS)[:, None] + np.zeros(WIDTH))
    counts, times_ns = [5 - 3 * k for k in range(ROWS)], [10**15 + 7_000_000 * k for k in range(ROWS)]
    packets = image_packets(
        places.astype(np.uint16),
        times_ns[0],
        number=1,
        region=(0, 0, WIDTH, ROWS),
        packet_bytes=PACKET_BYTES,
        chunks={ENCODER_CHUNK: counts, TIME_CHUNK: times_ns},
    )
    payload = b"".join(packet[8:] for packet in packets[1:-1])
    assert len(payload) == camera._node("PayloadSize").value
    chunks = genapi.ChunkAdapterGEV()
    chunks.attach_node_map(camera._acquirer.remote_device.node_map)
    assert chunks.check_buffer_layout(payload, len(payload))
    chunks.attach_buffer(payload, len(payload))

    camera._info = CameraInfo("twin", "1", 1280, 1024, 16, camera._coordinates())
    camera._settings = CameraSettings(1.0, None, Region(0, 0, WIDTH, ROWS), 16, "free", None)
    numbers = np.frombuffer(payload[: 2 * WIDTH * ROWS], "<u2").reshape(ROWS, WIDTH)
    first = camera._profiles(numbers, Delivered(None, 1, 50.0), camera._chunk)
    for row, profile in enumerate((first, *first.later)):
        assert profile.encoder == counts[row]
        assert profile.time_s == pytest.approx(50.0 + 0.007 * row, abs=1e-9)
        assert (profile.seen.centre_px == 100 + row).all()
