"""Software of an underwater laser triangulation sensor: calibrate, reconstruct, evaluate.

Every name of the public interface is imported when it is first used, so that importing the package is fast.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from uwlts.capture import Capture, Frame, open_capture
    from uwlts.cloud import PointCloud, read_cloud
    from uwlts.evaluation import Evaluation, evaluate
    from uwlts.library import load_sensor
    from uwlts.scan import reconstruct
    from uwlts.sensor import Sensor
    from uwlts.verification import Verification, verify

__version__ = "0.1.0"

__all__ = [
    "Capture",
    "Evaluation",
    "Frame",
    "PointCloud",
    "Sensor",
    "Verification",
    "evaluate",
    "load_sensor",
    "open_capture",
    "read_cloud",
    "reconstruct",
    "verify",
]

_MODULES = {
    "Evaluation": "uwlts.evaluation",
    "PointCloud": "uwlts.cloud",
    "Verification": "uwlts.verification",
    "evaluate": "uwlts.evaluation",
    "read_cloud": "uwlts.cloud",
    "reconstruct": "uwlts.scan",
    "verify": "uwlts.verification",
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
