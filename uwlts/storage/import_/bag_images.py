"""Images in ROS recordings as a folder: a subfolder for each topic, and a table with the times of the images."""

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import cv2
import numpy as np

from uwlts.errors import ImageError
from uwlts.files.writing import name_write_errors
from uwlts.storage.image_file import SUFFIXES, read_header
from uwlts.storage.import_.folder_description import ImportDescription
from uwlts.storage.import_.matching import matches
from uwlts.storage.ros_messages import list_topics, open_bag, read_messages

_RAW, _COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
_ENCODINGS = {"mono8": (1, 1), "8UC1": (1, 1), "mono16": (2, 1), "16UC1": (2, 1), "bgr8": (1, 3), "rgb8": (1, 3)}
_ENCODINGS |= {
    f"bayer_{pattern}{8 * size}": (size, 1) for pattern in ("rggb", "grbg", "gbrg", "bggr") for size in (1, 2)
}
"""Bytes of a value, and channels, by the encoding of a message (sensor_msgs/image_encodings.h)."""


def is_bag(path: Path) -> bool:
    """Return whether a path is that of a bag of ROS, or of its folder."""
    return path.suffix.lower() in (".bag", ".mcap", ".db3") or (path / "metadata.yaml").is_file()


@contextmanager
def unpack_images(bag: Path, given: ImportDescription, out: Path) -> Iterator[tuple[Path, ImportDescription]]:
    """Write the images of a bag into a temporary folder beside ``out``; return it with the completed description.

    An image is TOPIC/NUMBER.png, or .jpg if it is compressed; topics without a described light are left out. The
    description gets the table of times and the Bayer pattern if it states none.

    ImageError if the bag is damaged, the description names no images in it, or an image has another encoding;
    OutputError if the folder of ``out`` is not writable, or the disk is full; SetupError without the library for bags.
    """
    rows, pattern = ["file,time_s"], given.bayer
    wanted = given.laser, given.lamp, given.background
    with ExitStack() as stack:
        with name_write_errors(out):
            folder = Path(stack.enter_context(TemporaryDirectory(dir=out.parent, prefix=".uwlts-")))
        with open_bag(bag, error=ImageError) as opened:
            topics = {each.topic for each in opened.connections if each.msgtype in (_RAW, _COMPRESSED)}
            used = {
                topic
                for topic in topics
                if given.table is not None
                or any(matches(_name(topic, 1, ending), some) for some in wanted for ending in SUFFIXES)
            }
            if not used:
                raise ImageError(
                    f"{bag} has the topics {list_topics(opened)}; found no images that the description names: give "
                    "patterns such as laser = 'TOPIC/*'"
                )
            counts = dict.fromkeys(used, 0)
            for connection, message in read_messages(opened, lambda each: each.topic in used):
                counts[connection.topic] += 1
                place = f"{bag}, {connection.topic}, image {counts[connection.topic]}"
                ending, content = _encode(message, connection.msgtype, place)
                name, stamp = _name(connection.topic, counts[connection.topic], ending), message.header.stamp
                with name_write_errors(out):
                    (folder / name).parent.mkdir(parents=True, exist_ok=True)
                    (folder / name).write_bytes(content)
                rows.append(f"{name},{stamp.sec}.{stamp.nanosec:09d}")
                if getattr(message, "encoding", "").startswith("bayer_"):
                    pattern = pattern or message.encoding[6:10].upper()
        table = folder / "times.csv"
        with name_write_errors(out):
            table.write_text("\n".join(rows) + "\n", encoding="utf-8")
        more = {"table": str(table)} if given.table is None else {}
        yield folder, given.model_copy(update={"bayer": pattern, **more})


def _name(topic: str, number: int, ending: str) -> str:
    return f"{topic.strip('/')}/{number:06d}{ending}"


def _encode(message: Any, kind: str, place: str) -> tuple[str, bytes]:
    """Return the ending and the content of an image file."""
    content = bytes(message.data)
    if kind == _COMPRESSED:
        return "." + {"JPEG": "jpg"}.get(found := read_header(content, place).kind, found.lower()), content
    if message.encoding not in _ENCODINGS:
        raise ImageError(
            f"{place} has the encoding '{message.encoding}'; this program reads {', '.join(_ENCODINGS)}: convert it"
        )
    size, channels = _ENCODINGS[message.encoding]
    width, height, step = message.width, message.height, message.step
    if not 0 < size * channels * width <= step or len(content) != step * height:
        raise ImageError(f"{place} has {len(content)} bytes for {height} rows of {step} bytes: it is damaged")
    rows = np.frombuffer(content, np.uint8).reshape(height, step)[:, : size * channels * width]
    order = ">" if message.is_bigendian else "<"
    image = np.ascontiguousarray(rows).view(f"{order}u{size}").reshape(height, width, channels)
    image = image[:, :, ::-1] if message.encoding == "rgb8" else image
    return ".png", cv2.imencode(".png", image.astype(f"u{size}"))[1].tobytes()
