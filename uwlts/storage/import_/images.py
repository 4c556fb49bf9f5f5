"""Reads image files as grey values and finds those that are damaged.

libpng, libjpeg and libtiff fill in what they cannot decode, and report it on the process's standard error only. So that
is read meanwhile: lines about damage are returned, everything else is passed on.
"""

import os
import re
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np

from uwlts.model.errors import ImageError
from uwlts.storage.image_header import ImageHeader, png_damage, read_header, read_image_file

_STANDARD_ERROR = 2
_DAMAGE = re.compile(rb"libpng error|Corrupt JPEG data|Premature end of JPEG|\[ERROR:")
# Such as of tags that nobody knows.
_WARNING = b"[ WARN:"
# OpenCV puts time, file, line and function around what the decoder said.
_AROUND = re.compile(r"^libpng error: |^\[ERROR:\S+ global \S+ (TIFF_Error |.*error: \([^)]*\) )|in function '\w+'$")


@contextmanager
def _heard() -> Iterator[list[str]]:
    """The lines about damage that are written to the standard error inside the ``with``, there after its end."""
    said: list[str] = []
    usual = os.dup(_STANDARD_ERROR)
    with tempfile.TemporaryFile() as listener:
        os.dup2(listener.fileno(), _STANDARD_ERROR)
        try:
            yield said
        finally:
            os.dup2(usual, _STANDARD_ERROR)
            os.close(usual)
            listener.seek(0)
            for line in listener:
                if _DAMAGE.search(line):
                    said.append(line.decode(errors="replace"))
                elif line.strip() and not line.startswith(_WARNING):
                    os.write(_STANDARD_ERROR, line)


def read_image(path: Path, *, accept: Callable[[ImageHeader], None] = lambda declared: None) -> np.ndarray:
    """Image (H, W) or (H, W, 3) in blue, green, red, of uint8 or uint16, as stored: not turned by what EXIF says.

    ``accept`` may refuse what the file says of itself, before it is decoded. ImageError where the file is missing,
    foreign, truncated, has an alpha channel, several pages, or other than whole numbers of 8 or 16 bit.
    """
    content = read_image_file(path)
    declared = read_header(content, path)
    accept(declared)
    kind = declared.kind
    if kind == "PNG" and (damage := png_damage(content)):
        raise ImageError(f"{path} is a PNG file that is truncated or damaged ({damage}); copy it again")
    if declared.least_bytes() > len(content):
        raise ImageError(
            f"{path} is a {kind} file that is truncated or damaged ({len(content)} bytes cannot hold "
            f"{declared.width_px} x {declared.height_px} pixels); copy it again"
        )
    try:
        with _heard() as said:
            image = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        raise ImageError(f"{path} cannot be read: {' '.join(str(error).split())}") from error
    damage = " ".join(_AROUND.sub("", said[0].strip()).split()) if said else ""
    if image is None or damage:
        found = f"{len(content)} bytes" + (f", its decoder says: {damage}" if damage else "")
        raise ImageError(f"{path} is a {kind} file that is truncated or damaged ({found}); copy it again")
    with _heard():
        count = cv2.imcount(str(path)) if kind == "TIFF" else 1
    if count > 1:
        raise ImageError(f"{path} holds {count} pages; expected one image per file: split it")
    if image.dtype not in (np.uint8, np.uint16):
        raise ImageError(f"{path} holds values of {image.dtype}; expected whole numbers of 8 or 16 bit")
    if image.ndim == 3 and image.shape[2] not in (1, 3):
        raise ImageError(
            f"{path} has {image.shape[2]} channels, that is with an alpha channel: grey values behind it have no "
            "certain meaning; save it without transparency"
        )
    return image[:, :, 0] if image.ndim == 3 and image.shape[2] == 1 else image


def bits_of(image: np.ndarray, bits: int | None, *, name: str) -> int:
    """Bits of the grey values: 8 for a file of 8 bit, else as given; ImageError where that is contradictory or open."""
    if image.dtype == np.uint8:
        if bits not in (None, 8):
            raise ImageError(f"{name} is a file of 8 bit, but bits = {bits}: save it with 16 bit, or leave out bits")
        return 8
    if bits is None:
        raise ImageError(f"{name} is a file of 16 bit: say how many the camera used, bits = 10, 12 or 16")
    return bits


def grey_values(image: np.ndarray, *, bits: int, aligned: str, name: str) -> np.ndarray:
    """Values from 0 to 2^bits - 1 of an image whose camera put them into the lower or upper bits.

    ImageError where there are larger values, or bits below the upper ones are used.
    """
    if image.dtype == np.uint8:
        return image
    if aligned == "high":
        spare = 16 - bits
        if (image & np.uint16(2**spare - 1)).any():
            raise ImageError(f"{name} uses more than its upper {bits} bits: check bits and aligned")
        return image >> np.uint16(spare)
    largest = int(image.max())
    if largest >= 2**bits:
        raise ImageError(
            f"{name} holds the grey value {largest}, more than {bits} bits have: check bits, or give aligned = 'high' "
            "if the camera uses the upper bits"
        )
    return image


def without_background(image: np.ndarray, background: np.ndarray, *, zero_dn: int) -> np.ndarray:
    """Image minus background (H, W) of one type, as uint16: ``zero_dn`` stands for no difference; saturates."""
    return cv2.addWeighted(image, 1.0, background, -1.0, zero_dn, dtype=cv2.CV_16U)
