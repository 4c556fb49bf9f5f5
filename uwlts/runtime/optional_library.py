"""Libraries that only some features need, by extras; the message for a missing one is a command that installs it.

The project is not published: advice names the libraries themselves, which works in a checkout and with a wheel.
`python -m uwlts.runtime.optional_library` prints the Aravis library in use, and exits with status 1 if there is none.
"""

import ctypes
import os
import shlex
import sys
from collections.abc import Iterable
from functools import cache
from importlib import import_module
from pathlib import Path
from types import ModuleType

from uwlts.errors import SetupError

PROJECT = "uwlts"
EXTRAS = {
    "clouds": "clouds as LAZ, LAS and E57",
    "cluster": "sweeps on several machines",
    "frames": "results as tables of pandas",
    "registration": "the search for initial poses by shape",
    "ros": "ROS bags, and clouds as MCAP",
}
"""Features that need optional libraries, by the extra of this project that lists them."""


def optional_library(module: str, *, needed_by: str, extra: str, instead: str = "") -> ModuleType:
    """Import a library, or a module of it; raises SetupError, ending with ``instead``, if it is not installed."""
    library = module.partition(".")[0]
    try:
        import_module(library)
        return import_module(module)
    except ImportError as error:
        raise SetupError(
            f"{needed_by} needs the library {library.replace('_', '-')}, which is not installed: "
            f"{pip_install(read_requirements()[2][extra])}{instead}"
        ) from error


def pip_install(requirements: Iterable[str]) -> str:
    """Return the command that installs libraries into the environment of this Python, or that there are none for it.

    Requirements may be options of pip, too.
    """
    from packaging.markers import Marker

    wanted = []
    for line in requirements:
        name, _, marker = line.partition(";")
        if not marker or Marker(marker).evaluate({"extra": ""}):
            wanted.append(shlex.quote(name.strip()))
    if not wanted:
        return f"there is none for Python {sys.version_info.major}.{sys.version_info.minor}"
    return f"{shlex.quote(sys.executable)} -m pip install {' '.join(wanted)}"


def read_requirements() -> tuple[str, list[str], dict[str, list[str]]]:
    """Return versions of Python, required libraries, and those of each extra, as this project's description lists them.

    In a checkout its pyproject.toml counts: the description that an editable installation keeps grows old.
    """
    # Only advice needs these modules, and all readers of clouds import this one.
    import tomllib
    from importlib import metadata

    file = Path(__file__).parents[2] / "pyproject.toml"
    if file.is_file():
        project = tomllib.loads(file.read_text(encoding="utf-8"))["project"]
        return project["requires-python"], project["dependencies"], project["optional-dependencies"]
    from packaging.requirements import Requirement

    installed = metadata.distribution(PROJECT)
    required, extras = [], {name: [] for name in EXTRAS}
    for line in installed.requires or ():
        marker = Requirement(line).marker
        if marker is None or marker.evaluate({"extra": ""}):
            required.append(line)
        for name in EXTRAS:
            if marker is not None and "extra" in str(marker) and marker.evaluate({"extra": name}):
                extras[name].append(line.partition(";")[0].strip())
    return installed.metadata["Requires-Python"], required, extras


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
