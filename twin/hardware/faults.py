"""Faults of the served twin, named as on the command line: NAME[:ARGUMENT][@FRAME]."""

import math
import re
from collections.abc import Callable
from dataclasses import dataclass

from twin.hardware.gige_camera import GigeCamera
from twin.hardware.grbl_controller import GrblController
from uwlts.errors import DescriptionError

_FORM = re.compile(r"(?P<name>[a-z-]+)(:(?P<argument>[^@]+))?(@(?P<frame>[1-9]\d*))?")


@dataclass(frozen=True)
class _Kind:
    """A fault's effect, and its argument unless given; None where it takes none.

    ``ahead`` is for what has to be known before the camera begins with a frame.
    """

    inject: Callable[[GrblController, GigeCamera, float], None]
    argument: float | None = None
    whole: bool = True
    signed: bool = False
    ahead: bool = False


_KINDS = {
    "drop": _Kind(lambda stage, camera, frames: camera.drop(int(frames)), 1),
    "repeat": _Kind(lambda stage, camera, frames: camera.repeat(int(frames)), 1),
    "cut": _Kind(lambda stage, camera, frames: camera.cut(int(frames)), 1),
    "delay": _Kind(lambda stage, camera, seconds: camera.delay(seconds), 1.0, whole=False, ahead=True),
    "camera-disconnect": _Kind(lambda stage, camera, _: camera.disconnect()),
    "stage-disconnect": _Kind(lambda stage, camera, _: stage.disconnect()),
    "mute": _Kind(lambda stage, camera, _: stage.mute()),
    "stall": _Kind(lambda stage, camera, _: stage.stall()),
    "stop-short": _Kind(lambda stage, camera, steps: stage.stop_short(int(steps)), 40),
    "lose-steps": _Kind(lambda stage, camera, steps: stage.lose_steps(int(steps)), 40, signed=True),
    "alarm": _Kind(lambda stage, camera, code: stage.alarm(int(code)), 1),
    "hold": _Kind(lambda stage, camera, _: stage.hold()),
    "restart": _Kind(lambda stage, camera, _: stage.restart()),
    "garbage": _Kind(lambda stage, camera, _: stage.garbage()),
    "break-laser": _Kind(lambda stage, camera, _: stage.break_laser()),
}
NAMES = tuple(_KINDS)


@dataclass(frozen=True)
class Fault:
    """A fault that comes with a frame, counted from 1 as the camera is asked for them."""

    name: str
    argument: float | None
    frame: int

    @property
    def ahead(self) -> bool:
        """Whether it has to be injected before its frame is begun, which is when the one before is done."""
        return _KINDS[self.name].ahead

    def inject(self, stage: GrblController, camera: GigeCamera) -> None:
        """Let it happen."""
        _KINDS[self.name].inject(stage, camera, self.argument)

    def __str__(self) -> str:
        return f"{self.name}{'' if self.argument is None else f':{self.argument:g}'} at frame {self.frame}"


def parse_fault(text: str) -> Fault:
    """A fault from NAME[:ARGUMENT][@FRAME]; the first frame and the kind's own argument unless given.

    Raises
    ------
    DescriptionError
        There is no such fault, or its argument is none.
    """
    found = _FORM.fullmatch(text)
    if not found or found["name"] not in _KINDS:
        raise DescriptionError(f"'{text}' is no fault: write NAME[:ARGUMENT][@FRAME] with one of {', '.join(NAMES)}")
    kind, argument = _KINDS[found["name"]], found["argument"]
    if argument is not None and kind.argument is None:
        raise DescriptionError(f"the fault {found['name']} takes no argument, '{argument}' was given")
    value = kind.argument
    if argument is not None:
        try:
            value = int(argument) if kind.whole else float(argument)
        except ValueError as error:
            wanted = "a whole number" if kind.whole else "a number of seconds"
            raise DescriptionError(f"the argument of {found['name']} is '{argument}', not {wanted}") from error
        if not math.isfinite(value) or (value <= 0 and not kind.signed):
            raise DescriptionError(f"the argument of {found['name']} is '{argument}'; it must be positive")
    return Fault(found["name"], value, int(found["frame"] or 1))
