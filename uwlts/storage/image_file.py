"""Reading of image files as grey values: headers are checked before a decoder allocates memory, damage is detected.

libpng, libjpeg and libtiff fill in what they cannot decode, and report it only on the process's standard error.
Therefore standard error is captured during decoding: lines about damage are returned, all others are passed on.
"""

import io
import os
import re
import tempfile
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from PIL import Image
from PIL.TiffImagePlugin import ImageFileDirectory_v2

from uwlts.errors import ImageError
from uwlts.files.reading import read_bytes

SUFFIXES = (".png", ".tif", ".tiff", ".bmp", ".jpg", ".jpeg")

MOST_PIXELS = 150_000_000  # largest number of pixels of an image, that of the largest single image sensors
_MOST_BYTES = 2**27  # largest image file: 60 million uncompressed pixels of 16 bit
Image.MAX_IMAGE_PIXELS = MOST_PIXELS
# The warnings are about files that are refused, or about tags that are not read.
warnings.filterwarnings("ignore", module="PIL")

_SIGNATURES = {b"\x89PNG\r\n\x1a\n": "PNG", b"BM": "BMP", b"\xff\xd8\xff": "JPEG"}
_SIGNATURES |= dict.fromkeys((b"II*\0", b"MM\0*", b"II+\0", b"MM\0+"), "TIFF")
_WIDTH, _HEIGHT, _BITS, _PHOTOMETRIC = 256, 257, 258, 262
"""Tags of TIFF 6.0, section 8."""


@dataclass(frozen=True)
class ImageHeader:
    """Declared properties of an image file, before its pixels are decoded.

    ``inverted_bits`` is the number of bits of a TIFF in which large values are dark, and 0 of all other images.
    """

    kind: str
    width_px: int
    height_px: int
    several_pages: bool = False
    inverted_bits: int = 0


def read_header(content: bytes, path: str | Path) -> ImageHeader:
    """Read the header of an image; raises ImageError if it is foreign, damaged, or declares too many pixels.

    The checksums of a PNG file are verified.
    """
    kind = next((kind for mark, kind in _SIGNATURES.items() if content.startswith(mark)), None)
    if kind is None:
        found = "it is empty" if not content else f"it begins with {content[:8]!r}"
        raise ImageError(f"{path} is no PNG, TIFF, BMP or JPEG image: {found}; leave it out or convert it")
    try:
        if kind == "TIFF":
            found = _read_tiff_header(content)
        else:
            with Image.open(io.BytesIO(content), formats=[kind, "MPO"]) as image:
                found = ImageHeader(kind, *image.size)
                if kind == "PNG":
                    image.verify()
    except Image.DecompressionBombError as error:
        raise ImageError(f"{path}: {error}") from error
    except Exception as error:  # Pillow raises exceptions of many types for damaged files.
        raise ImageError(
            f"{path} is a {kind} file that is truncated or damaged ({len(content)} bytes, its decoder says: {error}); "
            "copy it again"
        ) from error
    if found.width_px * found.height_px > MOST_PIXELS:
        raise ImageError(
            f"{path} declares {found.width_px} x {found.height_px} pixels; this program reads images of up to "
            f"{MOST_PIXELS / 1e6:g} million"
        )
    return found


def _read_tiff_header(content: bytes) -> ImageHeader:
    """Read the first directory, also of images in modes that Pillow does not have."""
    big = content[2:4] in (b"+\0", b"\0+")
    directory = ImageFileDirectory_v2(content[: 16 if big else 8])
    file = io.BytesIO(content)
    file.seek(directory.next)
    directory.load(file)
    inverted_bits = directory.get(_BITS, (1,))[0] if directory.get(_PHOTOMETRIC) == 0 else 0
    return ImageHeader("TIFF", directory[_WIDTH], directory[_HEIGHT], directory.next != 0, inverted_bits)


_STANDARD_ERROR = 2  # its file descriptor
_DAMAGE = re.compile(rb"libpng error|Corrupt JPEG data|Premature end of JPEG|\[ERROR:")
# For example about unknown tags.
_WARNING = b"[ WARN:"
# OpenCV surrounds the decoder's message with time, file, line and function.
_AROUND = re.compile(r"^libpng error: |^\[ERROR:\S+ global \S+ (TIFF_Error |.*error: \([^)]*\) )|in function '\w+'$")


@contextmanager
def _capture_damage() -> Iterator[list[str]]:
    """Collect the lines about damage that are written to standard error within the context; complete at its end."""
    messages: list[str] = []
    usual = os.dup(_STANDARD_ERROR)
    with tempfile.TemporaryFile() as listener:
        os.dup2(listener.fileno(), _STANDARD_ERROR)
        try:
            yield messages
        finally:
            os.dup2(usual, _STANDARD_ERROR)
            os.close(usual)
            listener.seek(0)
            for line in listener:
                if _DAMAGE.search(line):
                    messages.append(line.decode(errors="replace"))
                elif line.strip() and not line.startswith(_WARNING):
                    os.write(_STANDARD_ERROR, line)


def read_image(path: Path, *, accept: Callable[[ImageHeader], None] = lambda declared: None) -> np.ndarray:
    """Read an image (H, W), or (H, W, 3) in blue, green, red, of uint8 or uint16, without the rotation given by EXIF.

    ``accept`` may reject the declared header before the image is decoded. Raises ImageError if the file is missing,
    foreign or truncated, or has an alpha channel, several pages, or values other than integers of 8 or 16 bit.
    """
    content = read_bytes(path, most_bytes=_MOST_BYTES, error=ImageError, called="image")
    declared = read_header(content, path)
    accept(declared)
    try:
        with _capture_damage() as messages:
            image = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        raise ImageError(f"{path} cannot be read: {' '.join(str(error).split())}") from error
    damage = " ".join(_AROUND.sub("", messages[0].strip()).split()) if messages else ""
    if image is None or damage:
        found = f"{len(content)} bytes" + (f", its decoder says: {damage}" if damage else "")
        raise ImageError(f"{path} is a {declared.kind} file that is truncated or damaged ({found}); copy it again")
    if declared.several_pages:
        raise ImageError(f"{path} holds several pages; expected one image per file: split it")
    if image.dtype not in (np.uint8, np.uint16):
        raise ImageError(f"{path} holds values of {image.dtype}; expected whole numbers of 8 or 16 bit")
    if image.ndim == 3 and image.shape[2] not in (1, 3):
        raise ImageError(
            f"{path} has {image.shape[2]} channels, including an alpha channel: grey values under transparency are "
            "undefined; save it without transparency"
        )
    image = image[:, :, 0] if image.ndim == 3 and image.shape[2] == 1 else image
    # OpenCV inverts such images of 8 bit only.
    if declared.inverted_bits and image.dtype == np.uint16:
        if declared.inverted_bits != 16:
            raise ImageError(
                f"{path} is a TIFF file of {declared.inverted_bits} bit in which zero is white; save it with zero as "
                "black (photometric interpretation BlackIsZero)"
            )
        image = np.invert(image)
    return image
