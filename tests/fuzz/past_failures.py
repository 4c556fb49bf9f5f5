"""Inputs that once made a reader fail, hang or use gigabytes, each built by a function."""

import json
import os
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import h5py

from tests.fuzz.readers import READERS, seed_of

Build = Callable[[Path], None]


def _with_dataset(change: Callable[[h5py.File], None], reader: str) -> Build:
    """Return a function that changes the reader's valid file with the HDF5 library."""

    def build(path: Path) -> None:
        path.write_bytes(seed_of(READERS[reader], path.parent))
        with h5py.File(path, "r+") as file:
            change(file)

    return build


def _huge(name: str) -> Callable[[h5py.File], None]:
    def change(file: h5py.File) -> None:
        shape, dtype = file[name].shape, file[name].dtype
        del file[name]
        file.create_dataset(name, (10**9, *shape[1:]), dtype, chunks=(1, *shape[1:]), compression="gzip")

    return change


def _external(name: str) -> Callable[[h5py.File], None]:
    def change(file: h5py.File) -> None:
        del file[name]
        file[name] = h5py.ExternalLink("/etc/hostname", "/x")

    return change


def _set(name: str, place: object, value: float) -> Callable[[h5py.File], None]:
    def change(file: h5py.File) -> None:
        file[name][place] = value

    return change


def _text(content: str) -> Build:
    return lambda path: _write(path, content.encode())


def _write(path: Path, content: bytes) -> None:
    path.write_bytes(content)


def _appended(reader: str, text: str) -> Build:
    return lambda path: _write(path, text.encode() + seed_of(READERS[reader], path.parent))


def _replaced(reader: str, old: str, new: str) -> Build:
    def build(path: Path) -> None:
        content = seed_of(READERS[reader], path.parent).decode()
        assert old in content
        path.write_text(content.replace(old, new, 1))

    return build


def _edited(reader: str, edit: Callable[[dict], None]) -> Build:
    def build(path: Path) -> None:
        content = json.loads(seed_of(READERS[reader], path.parent))
        content.pop("sha256", None)
        edit(content)
        path.write_text(json.dumps(content))

    return build


def _png(width: int, height: int) -> Build:
    """Return a function for a PNG header with a valid checksum, without pixels."""

    def build(path: Path) -> None:
        pieces = [(b"IHDR", struct.pack(">IIBBBBB", width, height, 16, 2, 0, 0, 0)), (b"IDAT", b"x"), (b"IEND", b"")]
        packed = (
            struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))
            for name, data in pieces
        )
        path.write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(packed))

    return build


def _deep_metadata(path: Path) -> None:
    text = '{"a":' + "[" * 100_000 + "]" * 100_000 + "}"
    pieces = [text[start : start + 900] for start in range(0, len(text), 900)]
    comments = "".join(
        f"comment uwlts-metadata {number}/{len(pieces)} {piece};\n" for number, piece in enumerate(pieces, start=1)
    )
    names = "".join(f"property float {axis}\n" for axis in "xyz")
    path.write_text(f"ply\nformat ascii 1.0\n{comments}element vertex 1\n{names}end_header\n1 2 3\n")


def _far_cloud(path: Path) -> None:
    names = "".join(f"property double {axis}\n" for axis in "xyz")
    path.write_text(f"ply\nformat ascii 1.0\nelement vertex 2\n{names}end_header\n1e305 2 3\n-1e305 5 6\n")


_BOMB = "a: &a [1,1,1,1,1,1,1,1,1]\n" + "".join(
    f"{b}: &{b} [{','.join(['*' + a] * 9)}]\n" for a, b in zip("abcdefghi", "bcdefghij", strict=True)
)
_DOTTED = ".".join(["a"] * 50_000) + " = 1\n"
_DIGITS = f"a = {'9' * 5000}\n"


def _scale_variance(content: dict) -> None:
    content["residuals"]["joint"]["covariance"][0][0] *= 1.5


def _scale_number(content: dict) -> None:
    content["parameters"][0]["value"] *= 1 + 1e-9


_TOMLS = ("sensor", "import", "plan", "scene", "campaign", "study", "artefact")

PAST: dict[str, tuple[str, Build]] = {
    "capture of a billion frames": ("capture", _with_dataset(_huge("frames"), "capture")),
    "capture of a billion positions, none of them stored": (
        "capture",
        _with_dataset(lambda file: [_huge(name)(file) for name in ("frames", "stage_mm")], "capture"),
    ),
    "cloud of a billion points": ("cloud-hdf5", _with_dataset(_huge("points_mm"), "cloud-hdf5")),
    "truth of a billion lines": ("truth", _with_dataset(_huge("centre_px"), "truth")),
    "capture with a link to another file": ("capture", _with_dataset(_external("frames"), "capture")),
    "cloud with a link to another file": ("cloud-hdf5", _with_dataset(_external("intensity"), "cloud-hdf5")),
    "negative exposure": ("capture", _with_dataset(_set("exposure_ms", 1, -2.0), "capture")),
    "time running backwards": ("capture", _with_dataset(_set("time_s", 1, -100.0), "capture")),
    "covariance whose eigenvalues overflow": ("covariances", _replaced("covariances", "0.25,0.25", "0.25,1.7e308")),
    "pose that is not rigid": ("capture", _with_dataset(_set("pose", 1, 1.0), "capture")),
    "PNG of 20000 x 20000 pixels without any": ("image-png", _png(20_000, 20_000)),
    "PNG of 2^31 x 2^31 pixels": ("image-png", _png(2**31 - 1, 2**31 - 1)),
    "PNG whose header's checksum does not fit": ("image-png", lambda path: _bad_checksum(path)),
    "YAML that doubles ten times": ("intrinsics-ros", _text(_BOMB)),
    "YAML nested in brackets": ("intrinsics-ros", _text("a: " + "[" * 100_000)),
    "YAML nested by dashes": ("intrinsics-opencv", _text("%YAML:1.0\n---\na: " + "- " * 100_000)),
    "XML nested": ("intrinsics-xml", _text('<?xml version="1.0"?>\n<opencv_storage>' + "<a>" * 100_000)),
    "intrinsics with k1 = 1e308": ("intrinsics-ros", _replaced("intrinsics-ros", "[-0.1,", "[1e308,")),
    **{f"{each} with a key of 50000 parts": (each, _appended(each, _DOTTED)) for each in _TOMLS},
    **{f"{each} with 5000 digits": (each, _appended(each, _DIGITS)) for each in _TOMLS},
    "absurd pixel size": ("sensor", _replaced("sensor", "pixel_size_um = ", "pixel_size_um = 1e-300 #")),
    "sensor with k1 = 1e308": ("sensor", _appended("sensor", "camera.distortion.k1 = 1e308\n")),
    "base whose name is too long": ("sensor", _text(f'base = "{"x" * 5000}"\n')),
    "base whose name holds NUL": ("sensor", _text('base = "a\\u0000b.toml"\n')),
    "PLY metadata nested 100000 deep": ("cloud-text", _deep_metadata),
    "PLY of a billion points": ("cloud-text", _replaced("cloud-text", "vertex 3", "vertex 1000000000")),
    "cloud at 1e305 m": ("export", _far_cloud),
    "joint calibration with NaN": (
        "joint",
        _edited("joint", lambda content: content["camera"].update(fx_px=float("nan"))),
    ),
    "joint calibration with an edited variance": ("joint", _edited("joint", _scale_variance)),
    "certificate with a key twice": ("certificate", _replaced("certificate", '"issued":', '"issued": "x", "issued":')),
    "certificate with 1e999": (
        "certificate",
        _replaced("certificate", '"wavelength_nm": 635.0', '"wavelength_nm": 1e999'),
    ),
    "calibration with a key twice": ("calibration", _replaced("calibration", '"camera":', '"camera": 1, "camera":')),
    "capture as a calibration": ("calibration", lambda path: _write(path, b"\x89HDF\r\n\x1a\n" + bytes(100))),
    "calibration nested 100000 deep": ("calibration", _text('{"a":' * 100_000)),
    "calibration of two million lists": ("calibration", _text("[" + "[]," * 2_000_000 + "[]]")),
    "calibration with 400000 wrong numbers": (
        "calibration",
        _edited("calibration", lambda content: content.update(camera_from_object=[None] * 400_000)),
    ),
    # A pipe in place of the record of a verification is ignored, as if there were no record.
    **{f"pipe as {each}": (each, lambda path: os.mkfifo(path)) for each in READERS if each != "verification"},
    **{
        f"device as {each}": (each, lambda path: path.symlink_to("/dev/zero"))
        for each in ("sensor", "image-png", "joint")
    },
    **{f"folder as {each}": (each, lambda path: path.mkdir()) for each in ("sensor", "image-png", "joint", "table")},
    **{
        f"sparse file of 1 TB as {each}": (each, lambda path: _sparse(path))
        for each in ("sensor", "image-png", "joint", "table", "mesh")
    },
}
"""Description of an input: its reader and the function that builds it. All inputs must be rejected."""


def _bad_checksum(path: Path) -> None:
    content = bytearray(seed_of(READERS["image-png"], path.parent))
    content[18:20] = b"\x4e\x20"
    path.write_bytes(content)


def _sparse(path: Path) -> None:
    path.touch()
    os.truncate(path, 2**40)
