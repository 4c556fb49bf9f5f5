"""What a Grbl 1.1 controller says, and what it means: replies, status reports, alarms, errors and settings.

Source: ``doc/markdown/interface.md``, ``doc/csv`` and the C code of https://github.com/gnea/grbl, version 1.1h.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass

from uwlts.errors import HardwareError

_NUMBER = r"-?\d+(?:\.\d+)?"
_BANNER = re.compile(r"Grbl (1\.1[a-z]?) \['\$' for help\]$")
_STATE = re.compile(r"(Idle|Run|Hold|Jog|Alarm|Door|Check|Home|Sleep)(?::(\d+))?$")
_COORDINATES = re.compile(rf"{_NUMBER}(?:,{_NUMBER})*$")
_SETTING = re.compile(rf"\$(\d+)=({_NUMBER})(?: \(.*\))?$")


@dataclass(frozen=True)
class Ok:
    """A line was accepted."""


@dataclass(frozen=True)
class Refusal:
    """``error:N``: a line was not executed."""

    code: int


@dataclass(frozen=True)
class Alarm:
    """``ALARM:N``: the controller has stopped everything."""

    code: int


@dataclass(frozen=True)
class Banner:
    """The greeting after every start and reset."""

    version: str


@dataclass(frozen=True)
class Setting:
    """One line of the answer to ``$$``."""

    number: int
    value: float


@dataclass(frozen=True)
class Message:
    """A line in brackets, without them, or the report of a startup line."""

    text: str


@dataclass(frozen=True)
class Garbage:
    """Anything that Grbl does not say."""

    text: str


@dataclass(frozen=True)
class Status:
    """Answer to ``?``. Positions are of the X axis in mm, as the controller counts its step pulses.

    Either ``machine_mm`` or ``work_mm`` is given; ``offset_mm`` (machine minus work) comes only now and then.
    ``spindle`` is the S word in force, 0 when the laser's pin is off, or None where the firmware does not say.
    ``pins`` names the inputs that are active, X being the limit switch.
    """

    state: str
    substate: int | None = None
    machine_mm: float | None = None
    work_mm: float | None = None
    offset_mm: float | None = None
    spindle: float | None = None
    pins: str = ""


Reply = Ok | Refusal | Alarm | Banner | Setting | Message | Status | Garbage


def parse_reply(line: str) -> Reply:
    """One line from the controller, without its end. What Grbl 1.1 does not say becomes `Garbage`."""
    if line == "ok":
        return Ok()
    if found := re.fullmatch(r"(error|ALARM):(\d{1,3})", line):
        return (Refusal if found[1] == "error" else Alarm)(int(found[2]))
    # Noise may stand before the first character that a starting controller sends.
    if found := _BANNER.search(line):
        return Banner(found[1])
    if found := _SETTING.fullmatch(line):
        return Setting(int(found[1]), float(found[2]))
    if line.startswith("[") and line.endswith("]") and line.isascii() and line.isprintable():
        return Message(line[1:-1])
    if re.fullmatch(r">[ -~]*:(ok|error:\d+)", line) or re.fullmatch(r"\$N\d=[ -~]*", line):
        return Message(line)
    if line.startswith("<") and line.endswith(">"):
        return _parse_status(line[1:-1]) or Garbage(line)
    return Garbage(line)


def _parse_status(body: str) -> Status | None:
    first, *rest = body.split("|")
    state = _STATE.match(first)
    fields = dict(field.partition(":")[::2] for field in rest)
    positions = {name: fields[name] for name in ("MPos", "WPos", "WCO", "FS") if name in fields}
    if not state or ("MPos" in fields) == ("WPos" in fields):
        return None
    if not all(_COORDINATES.match(values) for values in positions.values()):
        return None
    x = {name: float(values.split(",")[0]) for name, values in positions.items()}
    return Status(
        state=state[1], substate=int(state[2]) if state[2] else None, machine_mm=x.get("MPos"), work_mm=x.get("WPos"),
        offset_mm=x.get("WCO"), spindle=float(fields["FS"].split(",")[-1]) if "FS" in fields else None,
        pins=fields.get("Pn", ""),
    )  # fmt: skip


@dataclass(frozen=True)
class GrblSettings:
    """The settings that the stage depends on; X axis only.

    ``homes_to_negative`` says that the limit switch is at the lower end of travel ($23, bit 0).
    """

    steps_per_mm: float
    max_feed_mm_per_min: float
    acceleration_mm_per_s2: float
    travel_mm: float
    soft_limits: bool
    hard_limits: bool
    homing: bool
    homes_to_negative: bool
    homing_feed_mm_per_min: float
    homing_seek_mm_per_min: float
    homing_debounce_ms: float
    homing_pull_off_mm: float
    spindle_max: float
    spindle_min: float
    laser_mode: bool

    @property
    def step_mm(self) -> float:
        """Smallest movement."""
        return 1 / self.steps_per_mm


def parse_settings(values: Mapping[int, float]) -> GrblSettings:
    """Settings of the X axis from the answer to ``$$``; HardwareError where they cannot move a stage."""
    needed = (13, 20, 21, 22, 23, 24, 25, 26, 27, 30, 31, 32, 100, 110, 120, 130)
    if missing := [f"${number}" for number in needed if number not in values]:
        raise HardwareError(
            f"the controller's answer to $$ lacks {', '.join(missing)}: it is not a complete Grbl 1.1; "
            "flash Grbl 1.1h for the Arduino Uno"
        )
    for number, name in ((100, "steps/mm"), (110, "greatest feed"), (120, "acceleration"), (130, "travel"), (30, "S")):
        if not values[number] > 0:
            raise HardwareError(f"${number} ({name}) is {values[number]:g}; it must be positive: set it")
    if values[13] != 0:
        raise HardwareError("the controller reports inches ($13=1) where millimetres are expected: send $13=0")
    return GrblSettings(
        steps_per_mm=values[100], max_feed_mm_per_min=values[110], acceleration_mm_per_s2=values[120],
        travel_mm=values[130], soft_limits=values[20] != 0, hard_limits=values[21] != 0, homing=values[22] != 0,
        homes_to_negative=bool(int(values[23]) & 1), homing_feed_mm_per_min=values[24],
        homing_seek_mm_per_min=values[25], homing_debounce_ms=values[26], homing_pull_off_mm=values[27],
        spindle_max=values[30], spindle_min=values[31], laser_mode=values[32] != 0,
    )  # fmt: skip


def alarm_text(code: int) -> str:
    """What an alarm means and what to do."""
    meaning, advice = _ALARMS.get(code, ("unknown to Grbl 1.1", "reset the controller and home"))
    return f"ALARM:{code}, {meaning}; {advice}"


def refusal_text(code: int) -> str:
    """What an ``error:N`` means and, where the operator can do something, what."""
    meaning, advice = _ERRORS.get(code, "unknown to Grbl 1.1"), _ADVICE.get(code)
    return f"error:{code}, {meaning}" + (f"; {advice}" if advice else "")


_HOME = "the position is lost: see why it happened, then home"
_ALARMS = {
    1: ("hard limit: the limit switch was hit, or its line caught noise", _HOME),
    2: ("soft limit: the target lies outside the travel", "the position is kept: unlock, and stay within the travel"),
    3: ("reset while moving", "the position is lost: home"),
    4: ("probe: not in the expected state at the start", "check the wiring of A5, then unlock"),
    5: ("probe: no contact within the movement", "check the probe, then unlock"),
    6: ("homing: a reset stopped it", "home again"),
    7: ("homing: the safety door was opened", "close it and home again"),
    8: ("homing: the limit switch stayed pressed after the pull-off", "check its wiring, or enlarge the pull-off $27"),
    9: ("homing: no limit switch was found", "check the switch, its wiring, the direction $23 and the travel $130; "
        "a firmware that homes axes which are not there ends so too"),
}  # fmt: skip
_ERRORS = {
    1: "a word does not begin with a letter", 2: "a number is missing or malformed", 3: "unknown $ command",
    4: "negative value", 5: "homing is disabled", 6: "the step pulse must be longer than 3 us",
    7: "the EEPROM could not be read; its defaults are restored", 8: "this $ command needs an idle controller",
    9: "locked by an alarm", 10: "soft limits need homing", 11: "line too long",
    12: "the step rate would exceed 30 kHz", 13: "the safety door is open", 14: "line too long for the EEPROM",
    15: "the jog's target exceeds the travel", 16: "invalid jog command", 17: "laser mode needs a PWM output",
    20: "unsupported G-code", 21: "two commands of one modal group", 22: "no feed rate", 23: "a whole number is needed",
    24: "two commands use the axis words", 25: "a word is repeated", 26: "axis words are missing",
    27: "invalid line number", 28: "a value is missing", 29: "unsupported work coordinate system",
    30: "G53 needs G0 or G1", 31: "unused axis words", 32: "an arc lacks axis words", 33: "invalid target",
    34: "invalid arc radius", 35: "an arc lacks its offset", 36: "unused words", 37: "invalid axis for G43.1",
    38: "tool number too large",
}  # fmt: skip
_ADVICE = {
    5: "wire the limit switch and send $22=1", 7: "check every setting with $$: they may all have changed",
    8: "wait until it is at rest", 9: "home (or unlock where the position is known)", 10: "send $22=1 first",
    12: "lower the greatest feed $110", 13: "close it", 17: "flash a Grbl with variable spindle",
}  # fmt: skip
