"""Finds and loads shared libraries, also from a folder of the user's own; Aravis, which sensor and twin both use."""

import ctypes
import os
import re
from functools import cache
from pathlib import Path

from uwlts.errors import SetupError

ARAVIS_VARIABLE = "UWLTS_LIBARAVIS"
ARAVIS = "libaravis-0.8.so.0"
HOW_TO_INSTALL = """\
Install it:
  Debian, Ubuntu:  apt-get install libaravis-0.8-0   (as root)
  Fedora:          dnf install aravis   (as root)
  Arch:            pacman -S aravis   (as root)
  without root:    python -m twin.devices.aravis_install"""


def own_folders(name: str) -> list[Path]:
    """Folders into which a library can be unpacked without administrator rights, the preferred one first."""
    root = Path(__file__).parents[2]
    folders = [root / f".{name}"] if (root / "pyproject.toml").is_file() else []
    cache_folder = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    return [*folders, Path(cache_folder, "uwlts", name)] if os.path.isabs(cache_folder) else folders


def load_with_companions(library: str) -> tuple[ctypes.CDLL, list[str]]:
    """Load a library by its path, or by its name from wherever the system has it; OSError if it cannot be loaded.

    Returned with it, in loading order, are the paths of the libraries that it needs and the system lacks, which were
    taken from its own folder.
    """
    companions: list[str] = []
    asked: set[str] = set()
    while True:
        try:
            return ctypes.CDLL(library), companions
        except OSError as error:
            missing = re.match(r"([^\s/]+): cannot open shared object file", str(error))
            # A library that is asked for again although it is loaded will never be accepted.
            if missing is None or "/" not in library or missing[1] in asked:
                raise
            asked.add(missing[1])
            found = file_of(missing[1], Path(library).parent)
            if found is None:
                raise
            companions += [*load_with_companions(str(found))[1], str(found)]


def file_of(name: str, folder: Path) -> Path | None:
    """File of a library in a folder, where the link by which it is called may be missing."""
    return next((path for path in [folder / name, *sorted(folder.glob(f"{name}.*"))] if path.is_file()), None)


@cache
def load_aravis() -> ctypes.CDLL:
    """Aravis 0.8: the library named by the variable UWLTS_LIBARAVIS, else the system's, else one in an own folder.

    Raises SetupError: it is not there or does not load; the message says how to install it.
    """
    if chosen := os.environ.get(ARAVIS_VARIABLE):
        try:
            return _aravis(chosen)
        except SetupError as error:
            raise SetupError(f"the environment variable {ARAVIS_VARIABLE} names {error}\n{HOW_TO_INSTALL}") from error
    own = (file_of(ARAVIS, folder) for folder in own_folders("aravis"))
    faults = []
    for place in [ARAVIS, *(str(path) for path in own if path is not None)]:
        try:
            return _aravis(place)
        except SetupError as error:
            faults.append(f"\n  {error}")
    raise SetupError(f"the library of Aravis cannot be used:{''.join(faults)}\n{HOW_TO_INSTALL}")


def _aravis(place: str) -> ctypes.CDLL:
    try:
        library, _ = load_with_companions(place)
    except OSError as error:
        raise SetupError(f"{place}: {error}") from error
    if not hasattr(library, "arv_camera_new"):
        raise SetupError(f"{place}: it is not Aravis, it lacks arv_camera_new")
    return library
