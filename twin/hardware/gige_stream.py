"""Sends images after GigE Vision's stream protocol, at the speed of a real cable."""

import socket
import struct
import time

import numpy as np

# What 1 Gbit/s carries, and how many packets go out together, as sleeps are not exact.
_BYTES_PER_S, _TOGETHER = 125e6, 8
# Headers of IP, UDP and GVSP are counted in the size of a packet.
_OVERHEAD_BYTES = 36
_LEADER, _TRAILER, _PAYLOAD, _IMAGE, _MONO8 = 1, 2, 3, 1, 0x01080001


def image_packets(
    image: np.ndarray, *, time_ns: int, number: int, region: tuple[int, int, int, int], packet_bytes: int
) -> list[bytes]:
    """Leader, parts of the region, and trailer of an image.

    Parameters
    ----------
    image : (H, W) uint8
        The whole image.
    time_ns, number
        Its time stamp in ns, and its number of 16 bits.
    region
        Left, top, width and height in px; what lies beyond the image is dark.
    packet_bytes
        Size of a packet with all its headers.
    """
    x, y, width, height = region
    seen = np.zeros((height, width), np.uint8)
    part = image[y : y + height, x : x + width]
    seen[: part.shape[0], : part.shape[1]] = part
    pixels, room = seen.tobytes(), packet_bytes - _OVERHEAD_BYTES
    leader = struct.pack(">HHQIIIIIHH", 0, _IMAGE, time_ns, _MONO8, width, height, x, y, 0, 0)
    parts = [pixels[start : start + room] for start in range(0, len(pixels), room)]
    bodies = [(_LEADER, leader), *((_PAYLOAD, each) for each in parts), (_TRAILER, struct.pack(">II", _IMAGE, height))]
    return [struct.pack(">HHI", 0, number, kind << 24 | index) + body for index, (kind, body) in enumerate(bodies)]


def send_paced(stream: socket.socket, packets: list[bytes], to: tuple[str, int]) -> None:
    """Send packets one after the other, no faster than the cable would; hosts lose what comes much faster."""
    began, sent_bytes = time.perf_counter(), 0
    for index, packet in enumerate(packets):
        stream.sendto(packet, to)
        sent_bytes += len(packet)
        ahead_s = sent_bytes / _BYTES_PER_S - (time.perf_counter() - began)
        if index % _TOGETHER == _TOGETHER - 1 and ahead_s > 0:
            time.sleep(ahead_s)
