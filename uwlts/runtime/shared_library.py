"""Shared library of Aravis, for communication of sensor and twin with cameras.

`python -m uwlts.runtime.shared_library` prints the library in use. Exit status 0, or 1 if there is none.
"""

import ctypes
import os
import sys
from functools import cache

from uwlts.errors import SetupError

ARAVIS_VARIABLE = "UWLTS_LIBARAVIS"
ARAVIS = "libaravis-0.8.so.0"
HOW_TO_INSTALL = f"""\
Install it:
  Debian, Ubuntu:  apt-get install libaravis-0.8-0   (as root)
  Fedora:          dnf install aravis   (as root)
  Arch:            pacman -S aravis   (as root)
or let the environment variable {ARAVIS_VARIABLE} name the library."""


@cache
def load_aravis() -> ctypes.CDLL:
    """Load Aravis 0.8: the library named by the environment variable UWLTS_LIBARAVIS, otherwise the system's.

    Raises SetupError if the library is missing or does not load; the message says how to install it.
    """
    chosen = os.environ.get(ARAVIS_VARIABLE)
    called = f"the environment variable {ARAVIS_VARIABLE} names {chosen}" if chosen else ARAVIS
    try:
        library = ctypes.CDLL(chosen or ARAVIS)
    except OSError as error:
        raise SetupError(f"{called}: {error}\n{HOW_TO_INSTALL}") from error
    if not hasattr(library, "arv_camera_new"):
        raise SetupError(f"{called}: it is not Aravis, it lacks arv_camera_new\n{HOW_TO_INSTALL}")
    return library


if __name__ == "__main__":
    try:
        print(f"Aravis: {load_aravis()._name}")
    except SetupError as error:
        sys.exit(f"error: {error}")
