"""Decodes an image file, and hears when the decoder finds it damaged.

libpng, libjpeg and libtiff make up what they cannot decode, and say so on the process's standard error only. So that is
listened to meanwhile: what tells of damage is returned, and what anybody else writes is passed on.
"""

import os
import re
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager

import cv2
import numpy as np

_STANDARD_ERROR = 2
_DAMAGE = re.compile(rb"libpng error|Corrupt JPEG data|Premature end of JPEG|\[ERROR:")
# Such as of tags that nobody knows.
_WARNING = b"[ WARN:"
# OpenCV puts time, file, line and function around what the decoder said.
_AROUND = re.compile(r"^libpng error: |^\[ERROR:\S+ global \S+ (TIFF_Error |.*error: \([^)]*\) )|in function '\w+'$")


def decode(content: bytes) -> tuple[np.ndarray | None, str]:
    """Image as OpenCV decodes it unchanged, None where it cannot, and what tells of damage, empty if nothing does.

    Raises
    ------
    cv2.error
        The content cannot be decoded at all.
    """
    with _heard() as said:
        image = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)
    return image, " ".join(_AROUND.sub("", said[0].strip()).split()) if said else ""


def pages(path: str) -> int:
    """Number of images in a file."""
    with _heard():
        return cv2.imcount(path)


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
