"""Headers of image files, checked before a decoder allocates memory."""

import io
import warnings
from dataclasses import dataclass
from pathlib import Path

from PIL import Image
from PIL.TiffImagePlugin import ImageFileDirectory_v2

from uwlts.errors import ImageError
from uwlts.files.reading import read_bytes

SUFFIXES = (".png", ".tif", ".tiff", ".bmp", ".jpg", ".jpeg")

MOST_PIXELS = 150_000_000
"""Largest number of pixels of an image, that of the largest single image sensors."""
_MOST_BYTES = 2**27
"""Largest image file: 60 million uncompressed pixels of 16 bit."""
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


def read_image_file(path: str | Path) -> bytes:
    """Read an image file; raises ImageError if it is missing, not a regular file, or too large."""
    return read_bytes(path, most_bytes=_MOST_BYTES, error=ImageError, called="image")


def read_header(content: bytes, path: str | Path) -> ImageHeader:
    """Read the header of an image; raises ImageError if it is foreign, damaged, or declares too many pixels.

    The checksums of a PNG file are verified.
    """
    kind = next((kind for mark, kind in _SIGNATURES.items() if content.startswith(mark)), None)
    if kind is None:
        found = "it is empty" if not content else f"it begins with {content[:8]!r}"
        raise ImageError(f"{path} is no PNG, TIFF, BMP or JPEG image: {found}; leave it out or convert it")
    try:
        found = _tiff_header(content) if kind == "TIFF" else _open_header(content, kind)
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


def _open_header(content: bytes, kind: str) -> ImageHeader:
    with Image.open(io.BytesIO(content), formats=[kind, "MPO"]) as image:
        found = ImageHeader(kind, *image.size)
        if kind == "PNG":
            image.verify()
    return found


def _tiff_header(content: bytes) -> ImageHeader:
    """Read the first directory, also of images in modes that Pillow does not have."""
    big = content[2:4] in (b"+\0", b"\0+")
    directory = ImageFileDirectory_v2(content[: 16 if big else 8])
    file = io.BytesIO(content)
    file.seek(directory.next)
    directory.load(file)
    inverted_bits = directory.get(_BITS, (1,))[0] if directory.get(_PHOTOMETRIC) == 0 else 0
    return ImageHeader("TIFF", directory[_WIDTH], directory[_HEIGHT], directory.next != 0, inverted_bits)
