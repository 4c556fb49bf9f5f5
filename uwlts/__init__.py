"""Software of an underwater laser triangulation sensor: calibrate, reconstruct, evaluate.

Every name of the public interface is imported when it is first used, so that importing the package is fast.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from uwlts.capture import Capture, Frame, open_capture
    from uwlts.library import load_sensor
    from uwlts.sensor import Sensor

__version__ = "0.1.0"

__all__ = ["Capture", "Frame", "Sensor", "load_sensor", "open_capture"]

_MODULES = {
    "Capture": "uwlts.capture",
    "Frame": "uwlts.capture",
    "Sensor": "uwlts.sensor",
    "load_sensor": "uwlts.library",
    "open_capture": "uwlts.capture",
}


def __getattr__(name: str) -> object:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_MODULES[name]), name)
