"""Digital twin of an underwater laser triangulation sensor: renders captures with Mitsuba 3.

`render` renders a scene into arrays, `simulate` into capture and truth files, `sweep` searches the design of a sensor,
and `demo` runs the whole chain of commands. Each is imported when it is first used, as Mitsuba must not be imported
before its libLLVM is chosen.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from twin.design.sweep import sweep
    from twin.recording.demonstration import demo
    from twin.recording.recording import Recording, render, simulate

__all__ = ["Recording", "demo", "render", "simulate", "sweep"]

_MODULES = {
    "Recording": "twin.recording.recording",
    "demo": "twin.recording.demonstration",
    "render": "twin.recording.recording",
    "simulate": "twin.recording.recording",
    "sweep": "twin.design.sweep",
}


def __getattr__(name: str) -> object:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_MODULES[name]), name)
