"""Finds and loads the shared library of Aravis 0.8, which speaks GigE Vision and USB3 Vision.

Sensor software and twin both use it: one as the host, the other as the camera.
"""

import ctypes
import os
import re
from functools import cache
from pathlib import Path

from uwlts.model.errors import SetupError

VARIABLE = "UWLTS_LIBARAVIS"
LIBRARY = "libaravis-0.8.so.0"
HOW_TO_INSTALL = """\
Install it:
  Debian, Ubuntu:  apt-get install libaravis-0.8-0   (as root)
  Fedora:          dnf install aravis   (as root)
  Arch:            pacman -S aravis   (as root)
  without root:    python -m twin.devices.aravis_install"""


@cache
def load_aravis() -> ctypes.CDLL:
    """The library named by the environment variable UWLTS_LIBARAVIS, else the system's, else one in an own folder.

    Raises
    ------
    SetupError
        It is not there or does not load; the message says how to install it.
    """
    chosen = os.environ.get(VARIABLE)
    if chosen:
        try:
            return _load(chosen)
        except SetupError as error:
            raise SetupError(f"the environment variable {VARIABLE} names {error}\n{HOW_TO_INSTALL}") from error
    own = (_file_of(LIBRARY, folder) for folder in own_folders())
    faults = []
    for place in [LIBRARY, *(str(path) for path in own if path is not None)]:
        try:
            return _load(place)
        except SetupError as error:
            faults.append(f"\n  {error}")
    raise SetupError(f"the library of Aravis cannot be used:{''.join(faults)}\n{HOW_TO_INSTALL}")


def own_folders() -> list[Path]:
    """Folders into which the library can be unpacked without administrator rights, the preferred one first."""
    folders = []
    root = Path(__file__).parents[2]
    if (root / "pyproject.toml").is_file():
        folders.append(root / ".aravis")
    cache_folder = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    if os.path.isabs(cache_folder):
        folders.append(Path(cache_folder, "uwlts", "aravis"))
    return folders


def _load(place: str) -> ctypes.CDLL:
    """Load Aravis from a file, or by name from wherever the system has it; SetupError where that is not possible."""
    try:
        library = _load_with_companions(place)
    except OSError as error:
        raise SetupError(f"{place}: {error}") from error
    if not hasattr(library, "arv_camera_new"):
        raise SetupError(f"{place}: it is not Aravis, it lacks arv_camera_new")
    return library


def _load_with_companions(place: str) -> ctypes.CDLL:
    """Load a library; what the system lacks of the libraries it needs is taken from its own folder."""
    asked = set()
    while True:
        try:
            return ctypes.CDLL(place)
        except OSError as error:
            missing = re.match(r"([^\s/]+): cannot open shared object file", str(error))
            name = missing[1] if missing and "/" in place else ""
            beside = _file_of(name, Path(place).parent) if name else None
            # A library that is asked for again although it is loaded will never be accepted.
            if beside is None or name in asked:
                raise
            asked.add(name)
            _load_with_companions(str(beside))


def _file_of(name: str, folder: Path) -> Path | None:
    """File of a library in a folder, where the link by which it is called may be missing."""
    return next((path for path in [folder / name, *sorted(folder.glob(f"{name}.*"))] if path.is_file()), None)
