"""Reading of image files as grey values, with detection of damaged files.

libpng, libjpeg and libtiff fill in what they cannot decode, and report it only on the process's standard error.
Therefore standard error is captured during decoding: lines about damage are returned, all others are passed on.
"""

import os
import re
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np

from uwlts.errors import ImageError
from uwlts.storage.image_header import ImageHeader, read_header, read_image_file

_STANDARD_ERROR = 2  # its file descriptor
_DAMAGE = re.compile(rb"libpng error|Corrupt JPEG data|Premature end of JPEG|\[ERROR:")
# For example about unknown tags.
_WARNING = b"[ WARN:"
# OpenCV surrounds the decoder's message with time, file, line and function.
_AROUND = re.compile(r"^libpng error: |^\[ERROR:\S+ global \S+ (TIFF_Error |.*error: \([^)]*\) )|in function '\w+'$")


@contextmanager
def _capture_damage() -> Iterator[list[str]]:
    """Collect the lines about damage that are written to standard error within the context; complete at its end."""
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
    """Read an image (H, W), or (H, W, 3) in blue, green, red, of uint8 or uint16, without the rotation given by EXIF.

    ``accept`` may reject the declared header before the image is decoded. Raises ImageError if the file is missing,
    foreign or truncated, or has an alpha channel, several pages, or values other than integers of 8 or 16 bit.
    """
    content = read_image_file(path)
    declared = read_header(content, path)
    accept(declared)
    kind = declared.kind
    try:
        with _capture_damage() as said:
            image = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        raise ImageError(f"{path} cannot be read: {' '.join(str(error).split())}") from error
    damage = " ".join(_AROUND.sub("", said[0].strip()).split()) if said else ""
    if image is None or damage:
        found = f"{len(content)} bytes" + (f", its decoder says: {damage}" if damage else "")
        raise ImageError(f"{path} is a {kind} file that is truncated or damaged ({found}); copy it again")
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
