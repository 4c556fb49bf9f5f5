"""Import of images in ROS bags, written by the usual library."""

import errno
from pathlib import Path

import cv2
import numpy as np
import pytest
import tomli_w
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from tests.uwlts.storage.test_import import GIVEN, HEIGHT, SHAPE, WIDTH, lamp_image, stripe_image
from uwlts.errors import DescriptionError, ImageError, OutputError
from uwlts.storage.capture import Capture
from uwlts.storage.import_.folder import import_images

TIMES_S = 1.7e9 + np.array([0.0, 0.1, 0.2, 0.45])
STRIPES = [stripe_image(20.3 + 5 * n, seed=n) for n in range(4)]
BY_TOPIC = GIVEN | {"laser": "laser/*"}


def message(types, image, encoding, time_s, *, padding=0, big=False):
    """An image message, whose rows end with some bytes of padding."""
    held, kind = types.types, "sensor_msgs/msg/Image"
    stamp = held["builtin_interfaces/msg/Time"](sec=int(time_s), nanosec=round(time_s % 1 * 1e9))
    more = {"seq": 0} if "seq" in held["std_msgs/msg/Header"].__dataclass_fields__ else {}
    header = held["std_msgs/msg/Header"](stamp=stamp, frame_id="camera", **more)
    if encoding in ("jpeg", "png"):
        data = cv2.imencode(f".{encoding}", image)[1].ravel()
        return held["sensor_msgs/msg/CompressedImage"](header=header, format=encoding, data=data)
    rows = image.astype(image.dtype.newbyteorder(">" if big else "<")).reshape(len(image), -1).view(np.uint8)
    rows = np.pad(rows, ((0, 0), (0, padding)), constant_values=255)
    known = {"height": HEIGHT, "width": WIDTH, "encoding": encoding, "is_bigendian": int(big), "step": rows.shape[1]}
    return held[kind](header=header, data=rows.ravel(), **known)


def write_bag(path, topics, *, ros1=False, storage=StoragePlugin.MCAP, **more):
    """Write images with their encodings by topic."""
    types = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
    with Writer1(path) if ros1 else Writer(path, version=9, storage_plugin=storage) as bag:
        for topic, (images, encoding) in topics.items():
            kind = f"sensor_msgs/msg/{'CompressedImage' if encoding in ('jpeg', 'png') else 'Image'}"
            connection = bag.add_connection(topic, kind, typestore=types)
            for image, time_s in zip(images, TIMES_S, strict=True):
                written = message(types, image, encoding, time_s, **more)
                raw = types.serialize_ros1(written, kind) if ros1 else types.serialize_cdr(written, kind)
                bag.write(connection, int(time_s * 1e9), raw)
    return path


def imported(bag, given):
    description = bag.parent / "given.toml"
    description.write_text(tomli_w.dumps(given))
    result = import_images(bag, bag.parent / "out.h5", description=description)
    with Capture(bag.parent / "out.h5") as capture:
        return result, [frame.image for frame in capture], capture.stage_mm, capture.time_s, capture.header


@pytest.mark.parametrize("storage", list(StoragePlugin))
@pytest.mark.parametrize("more", [{}, {"padding": 5}])
def test_images_keep_their_values_and_times(tmp_path, storage, more):
    topics = {"/laser": (STRIPES, "mono8"), "/other/camera": ([lamp_image(n) for n in range(4)], "mono8")}
    bag = write_bag(tmp_path / "bag", topics, storage=storage, **more)
    result, images, stage_mm, time_s, header = imported(bag, BY_TOPIC)
    assert (result.laser, result.lamp) == (4, 0)
    assert np.array_equal(images, STRIPES)
    assert stage_mm == pytest.approx(5.0 + 0.5 * np.arange(4))
    assert time_s - time_s[0] == pytest.approx(TIMES_S - TIMES_S[0], abs=1e-6)
    assert header.name == "bag"
    assert [each.name for each in tmp_path.iterdir() if each.name.startswith(".")] == []


def test_a_ros_1_bag_of_two_lights(tmp_path):
    lamps = [lamp_image(n) for n in range(4)]
    bag = write_bag(tmp_path / "a.bag", {"/laser": (STRIPES, "mono8"), "/lamp": (lamps, "png")}, ros1=True)
    result, images, *_ = imported(bag, BY_TOPIC | {"lamp": "lamp/*"})
    assert (result.laser, result.lamp) == (4, 4)
    of_light = [image.mean() > 40 for image in images]
    assert np.array_equal([image for image, lit in zip(images, of_light, strict=True) if not lit], STRIPES)
    assert np.array_equal([image for image, lit in zip(images, of_light, strict=True) if lit], lamps)


@pytest.mark.parametrize("big", [False, True])
def test_sixteen_bits_of_both_byte_orders(tmp_path, big):
    wide = [16 * image.astype(np.uint16) for image in STRIPES]
    bag = write_bag(tmp_path / "bag", {"/laser": (wide, "mono16")}, big=big)
    assert np.array_equal(imported(bag, BY_TOPIC | {"bits": 12})[1], wide)


@pytest.mark.parametrize(("encoding", "channel"), [("rgb8", 0), ("bgr8", 2)])
def test_colours_are_those_of_the_encoding(tmp_path, encoding, channel):
    coloured = [np.full((*SHAPE, 3), 9, np.uint8) for _ in STRIPES]
    for image, stripe in zip(coloured, STRIPES, strict=True):
        image[:, :, channel] = stripe
    bag = write_bag(tmp_path / "bag", {"/laser": (coloured, encoding)})
    assert np.array_equal(imported(bag, BY_TOPIC | {"channel": "red"})[1], STRIPES)


def test_the_pattern_of_raw_images_is_that_of_the_encoding(tmp_path):
    mosaics = [np.full(SHAPE, 9, np.uint8) for _ in STRIPES]
    for mosaic, stripe in zip(mosaics, STRIPES, strict=True):
        mosaic[1::2, 1::2] = stripe[1::2, 1::2]
    bag = write_bag(tmp_path / "bag", {"/laser": (mosaics, "bayer_bggr8")})
    _, images, *_, header = imported(bag, BY_TOPIC | {"channel": "red"})
    # Other pixels, and the border, are interpolated.
    red = np.s_[:, 1:-2:2, 1:-2:2]
    assert np.array_equal(np.array(images)[red], np.array(STRIPES)[red])
    assert header.provenance["bayer"] == "BGGR"


@pytest.mark.parametrize(
    ("encoding", "given", "words"),
    [
        ("mono8", GIVEN | {"laser": "front/*"}, r"topics laser \(Image\).*TOPIC"),
        ("yuv422", BY_TOPIC, r"laser, image 1 has the encoding 'yuv422'"),
    ],
)
def test_what_cannot_be_read_is_named(tmp_path, encoding, given, words):
    bag = write_bag(tmp_path / "bag", {"laser": (STRIPES, encoding)})
    with pytest.raises(ImageError, match=words):
        imported(bag, given)
    assert not (tmp_path / "out.h5").exists()


def test_damaged_bags_and_bags_without_a_description_are_refused(tmp_path):
    damaged = tmp_path / "a.mcap"
    damaged.write_bytes(b"\x89MCAP0\r\n" + bytes(50))
    with pytest.raises(ImageError, match="damaged"):
        imported(damaged, BY_TOPIC)
    with pytest.raises(DescriptionError, match="no description"):
        import_images(damaged, tmp_path / "out.h5")


def test_a_full_disk_is_not_called_a_damaged_bag(tmp_path, monkeypatch):
    bag = write_bag(tmp_path / "bag", {"/laser": (STRIPES, "mono8")})

    def fail(path, content):
        raise OSError(errno.ENOSPC, "x")

    monkeypatch.setattr(Path, "write_bytes", fail)
    with pytest.raises(OutputError, match="out.h5: the disk is full"):
        imported(bag, BY_TOPIC)
    assert sorted(each.name for each in tmp_path.iterdir()) == ["bag", "given.toml"]
