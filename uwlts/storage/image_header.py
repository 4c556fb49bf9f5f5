"""Headers of image files, checked before a decoder allocates memory."""

import math
import struct
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from uwlts.errors import ImageError
from uwlts.files.reading import read_bytes

SUFFIXES = (".png", ".tif", ".tiff", ".bmp", ".jpg", ".jpeg")

MOST_PIXELS = 150_000_000
"""Largest number of pixels of an image, that of the largest single image sensors."""
_MOST_BYTES = 2**27
"""Largest image file: 60 million uncompressed pixels of 16 bit."""
_MOST_SHRINKING = {"PNG": 1100}
"""Largest compression ratio by format: deflate reaches 1032 (zlib.net/zlib_tech.html), others are unlimited."""
_MOST_TAGS = 4096  # of a TIFF directory; more only occur in damaged files

_SIGNATURES = {b"\x89PNG\r\n\x1a\n": "PNG", b"BM": "BMP", b"\xff\xd8\xff": "JPEG"}
_SIGNATURES |= dict.fromkeys((b"II*\0", b"MM\0*", b"II+\0", b"MM\0+"), "TIFF")


@dataclass(frozen=True)
class ImageHeader:
    """Declared properties of an image file, before its pixels are decoded.

    ``white_is_zero`` is the photometric interpretation of TIFF in which large values are dark.
    """

    kind: Literal["PNG", "BMP", "JPEG", "TIFF"]
    width_px: int
    height_px: int
    bits_per_pixel: int
    packed: bool
    white_is_zero: bool = False

    def least_bytes(self) -> float:
        """Return the smallest possible file size in bytes."""
        row = -(-self.width_px * self.bits_per_pixel // 8)
        return row * self.height_px / (_MOST_SHRINKING.get(self.kind, math.inf) if self.packed else 1)


def read_image_file(path: str | Path) -> bytes:
    """Read an image file; raises ImageError if it is missing, not a regular file, or too large."""
    return read_bytes(path, most_bytes=_MOST_BYTES, error=ImageError, called="image")


def _kind_of(content: bytes, path: str | Path) -> str:
    kind = next((kind for mark, kind in _SIGNATURES.items() if content.startswith(mark)), None)
    if kind is None:
        found = "it is empty" if not content else f"it begins with {content[:8]!r}"
        raise ImageError(f"{path} is no PNG, TIFF, BMP or JPEG image: {found}; leave it out or convert it")
    return kind


def read_header(content: bytes, path: str | Path) -> ImageHeader:
    """Read the header of an image; raises ImageError if it is foreign, damaged, or declares too many pixels."""
    kind = _kind_of(content, path)
    readers = {"PNG": _png_header, "BMP": _bmp_header, "JPEG": _jpeg_header, "TIFF": _tiff_header}
    try:
        found = readers[kind](content)
    except (struct.error, IndexError, KeyError, ValueError, OverflowError) as error:
        raise ImageError(
            f"{path} is a {kind} file that is truncated or damaged ({len(content)} bytes, its header cannot be read); "
            "copy it again"
        ) from error
    if found.width_px * found.height_px > MOST_PIXELS:
        raise ImageError(
            f"{path} declares {found.width_px} x {found.height_px} pixels; this program reads images of up to "
            f"{MOST_PIXELS / 1e6:g} million"
        )
    return found


def _png_header(content: bytes) -> ImageHeader:
    """Read a PNG header: Portable Network Graphics (PNG) Specification, 11.2.1."""
    width, height, bits, colours = struct.unpack_from(">IIBB", content, 16)
    return ImageHeader("PNG", width, height, bits * {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}[colours], packed=True)


def png_damage(content: bytes) -> str | None:
    """Return the fault in a PNG's chunks, which have lengths and checksums, or None."""
    view, place = memoryview(content), 8
    while place + 12 <= len(content):
        (length,) = struct.unpack_from(">I", content, place)
        end = place + 12 + length
        if end > len(content):
            break
        if zlib.crc32(view[place + 4 : end - 4]) != struct.unpack_from(">I", content, end - 4)[0]:
            return f"a checksum does not fit near byte {place}"
        if content[place + 4 : place + 8] == b"IEND":
            return None
        place = end
    return f"{len(content)} bytes, its end is missing"


def _bmp_header(content: bytes) -> ImageHeader:
    """Read a header: BITMAPINFOHEADER and its successors, or BITMAPCOREHEADER, recognised by its 12 bytes."""
    if struct.unpack_from("<I", content, 14)[0] == 12:
        width, height, _, bits = struct.unpack_from("<HHHH", content, 18)
        return ImageHeader("BMP", width, height, bits, packed=False)
    width, height, _, bits, packing = struct.unpack_from("<iiHHI", content, 18)
    # 1 and 2 are run-length encodings; negative heights count from the top.
    return ImageHeader("BMP", abs(width), abs(height), bits, packed=packing in (1, 2))


def _jpeg_header(content: bytes) -> ImageHeader:
    """Read the frame header, ITU-T T.81, B.2.2, which follows markers with their lengths."""
    place = 2
    while True:
        marker = content[place + 1]
        if content[place] != 0xFF:
            raise ValueError("expected a marker")
        if marker == 0xFF:
            place += 1
        elif 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
            bits, height, width, components = struct.unpack_from(">BHHB", content, place + 4)
            return ImageHeader("JPEG", width, height, bits * components, packed=True)
        else:
            place += 2 + struct.unpack_from(">H", content, place + 2)[0]


_WIDTH, _HEIGHT, _BITS, _PACKING, _PHOTOMETRIC, _SAMPLES = 256, 257, 258, 259, 262, 277
_TAGS = (_WIDTH, _HEIGHT, _BITS, _PACKING, _PHOTOMETRIC, _SAMPLES)
_WHITE_IS_ZERO, _BLACK_IS_ZERO = 0, 1


def _tiff_header(content: bytes) -> ImageHeader:
    """Read the first directory of TIFF 6.0, section 2, or of BigTIFF: entries of tag, type, count and value."""
    order = "<" if content.startswith(b"II") else ">"
    big = struct.unpack_from(order + "H", content, 2)[0] == 43
    (place,) = struct.unpack_from(order + ("Q" if big else "I"), content, 8 if big else 4)
    (count,) = struct.unpack_from(order + ("Q" if big else "H"), content, place)
    place, step, at = place + (8 if big else 2), 20 if big else 12, 12 if big else 8
    known = {_BITS: 1, _PACKING: 1, _SAMPLES: 1, _PHOTOMETRIC: _BLACK_IS_ZERO}
    for entry in range(place, place + step * min(count, _MOST_TAGS), step):
        tag, kind = struct.unpack_from(order + "HH", content, entry)
        if tag in _TAGS:
            # Several values, such as the bits of each colour, are stored elsewhere; the first applies to all.
            (several,) = struct.unpack_from(order + ("Q" if big else "I"), content, entry + 4)
            where, letter = entry + at, {1: "B", 3: "H", 4: "I", 16: "Q"}[kind]
            if several * struct.calcsize(order + letter) > (8 if big else 4):
                (where,) = struct.unpack_from(order + ("Q" if big else "I"), content, where)
            (known[tag],) = struct.unpack_from(order + letter, content, where)
    bits = known[_BITS] * known[_SAMPLES]
    return ImageHeader(
        "TIFF",
        known[_WIDTH],
        known[_HEIGHT],
        bits,
        packed=known[_PACKING] != 1,
        white_is_zero=known[_PHOTOMETRIC] == _WHITE_IS_ZERO,
    )
