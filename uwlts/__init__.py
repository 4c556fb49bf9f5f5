"""Software of an underwater laser triangulation sensor: calibrate, reconstruct, evaluate.

Every name of the public interface is imported when it is first used, so that importing the package is fast.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from uwlts.measurement.evaluation import Evaluation, evaluate
    from uwlts.measurement.reconstruction import reconstruct
    from uwlts.measurement.verification import Verification, verify
    from uwlts.model.library import load_sensor
    from uwlts.model.sensor import Sensor
    from uwlts.storage.capture import Capture, Frame, open_capture
    from uwlts.storage.cloud import PointCloud, read_cloud

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
    "Evaluation": "uwlts.measurement.evaluation",
    "PointCloud": "uwlts.storage.cloud",
    "Verification": "uwlts.measurement.verification",
    "evaluate": "uwlts.measurement.evaluation",
    "read_cloud": "uwlts.storage.cloud",
    "reconstruct": "uwlts.measurement.reconstruction",
    "verify": "uwlts.measurement.verification",
    "Capture": "uwlts.storage.capture",
    "Frame": "uwlts.storage.capture",
    "Sensor": "uwlts.model.sensor",
    "load_sensor": "uwlts.model.library",
    "open_capture": "uwlts.storage.capture",
}


def __getattr__(name: str) -> object:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_MODULES[name]), name)
