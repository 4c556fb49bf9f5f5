"""Digital twin of an underwater laser triangulation sensor: renders captures with Mitsuba 3.

`render` renders a scene into arrays, `simulate` into capture and truth files, `serve` plays it as camera and stage,
`record` renders a campaign of many captures, `dataset` a data set with labels, which `load_dataset` reads, `sweep`
searches the design of a sensor, `demo` runs the whole chain of commands, and `reproduce` the evaluation of the thesis.
Each is imported when it is first used, as Mitsuba must not be
imported before its libLLVM is chosen.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from twin.datasets.generation import dataset
    from twin.datasets.loading import DataSet, load_dataset
    from twin.design.sweep import SweepResult, sweep
    from twin.devices.serve import ServedTwin, serve
    from twin.recording.campaigns import record
    from twin.recording.demonstration import demo
    from twin.recording.render import Recording, render, simulate
    from twin.recording.reproduce import reproduce

__all__ = [
    "DataSet",
    "Recording",
    "ServedTwin",
    "SweepResult",
    "dataset",
    "demo",
    "load_dataset",
    "record",
    "render",
    "reproduce",
    "serve",
    "simulate",
    "sweep",
]

_MODULES = {
    "DataSet": "twin.datasets.loading",
    "Recording": "twin.recording.render",
    "ServedTwin": "twin.devices.serve",
    "SweepResult": "twin.design.sweep",
    "dataset": "twin.datasets.generation",
    "demo": "twin.recording.demonstration",
    "load_dataset": "twin.datasets.loading",
    "record": "twin.recording.campaigns",
    "render": "twin.recording.render",
    "reproduce": "twin.recording.reproduce",
    "serve": "twin.devices.serve",
    "simulate": "twin.recording.render",
    "sweep": "twin.design.sweep",
}


def __getattr__(name: str) -> object:
    if name == "datasets":
        return import_module("twin.datasets")
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    globals()[name] = value = getattr(import_module(_MODULES[name]), name)
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
