"""Serial line to a Grbl 1.1 controller, and parsing of its replies, status reports and settings.

Source: ``doc/markdown/interface.md``, ``doc/csv`` and the C code of https://github.com/gnea/grbl, version 1.1h.
"""

import errno
import math
import re
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import Literal, Self, assert_never

import serial
from serial.tools.list_ports import comports

from uwlts.errors import HardwareError
from uwlts.hardware.heartbeat import BEAT_S, GRACE_S, Heartbeat

try:
    import termios
except ImportError:
    termios = None  # Windows, where no stage can be used

_NUMBER = r"-?\d+(?:\.\d+)?"
_STATE = re.compile(r"(Idle|Run|Hold|Jog|Alarm|Door|Check|Home|Sleep)(?::\d+)?")
_COORDINATES = re.compile(rf"{_NUMBER}(?:,{_NUMBER})*")

ReplyKind = Literal["ok", "error", "ALARM", "banner", "setting", "message", "garbage"]
_PATTERNS: tuple[tuple[ReplyKind, str], ...] = (
    ("ok", "ok"),
    ("error", r"error:(?P<number>\d{1,3})"),
    ("ALARM", r"ALARM:(?P<number>\d{1,3})"),
    # Noise may precede the first character of a starting controller.
    ("banner", r".*Grbl (?P<text>1\.1[a-z]?) \['\$' for help\]"),
    ("setting", rf"\$(?P<number>\d+)=(?P<value>{_NUMBER})(?: \(.*\))?"),
    ("message", r"\[(?P<text>[ -~]*)\]"),
    ("message", r"(?P<text>>[ -~]*:(?:ok|error:\d+)|\$N\d=[ -~]*)"),
)


@dataclass(frozen=True)
class Reply:
    """A line from the controller other than a status report.

    "ok": a line was accepted; "error": a line was rejected; "ALARM": the controller has stopped; "banner": the greeting
    after every start and reset, with the version as ``text``; "setting": one line of the answer to ``$$``; "message":
    the content of a line in brackets, or the report of a startup line; "garbage": anything else.
    """

    kind: ReplyKind
    number: int = 0
    value: float = 0.0
    text: str = ""


@dataclass(frozen=True)
class Status:
    """Answer to ``?``; positions are those of the X axis in mm, from the controller's count of step pulses.

    Either ``machine_mm`` or ``work_mm`` is given. ``offset_mm`` (machine minus work) is sent only occasionally.
    ``spindle`` is the S word in force, 0 if the laser's pin is off, or None if the firmware does not report it.
    ``pins`` names the active inputs; X is the limit switch.
    """

    state: str
    machine_mm: float | None = None
    work_mm: float | None = None
    offset_mm: float | None = None
    spindle: float | None = None
    pins: str = ""


def parse_reply(line: str) -> Reply | Status:
    """Parse one line from the controller, without its end; a line unknown to Grbl 1.1 becomes "garbage"."""
    for kind, pattern in _PATTERNS:
        if found := re.fullmatch(pattern, line):
            part = found.groupdict()
            return Reply(kind, int(part.get("number", 0)), float(part.get("value", 0)), part.get("text", ""))
    status = _parse_status(line[1:-1]) if line.startswith("<") and line.endswith(">") else None
    return status or Reply("garbage", text=line)


def _parse_status(body: str) -> Status | None:
    first, *rest = body.split("|")
    state = _STATE.fullmatch(first)
    fields = {name: values for name, _, values in (field.partition(":") for field in rest)}
    numbers = {name: fields[name] for name in ("MPos", "WPos", "WCO", "FS") if name in fields}
    if not state or ("MPos" in fields) == ("WPos" in fields) or not all(map(_COORDINATES.fullmatch, numbers.values())):
        return None
    x = {name: float(values.split(",")[0]) for name, values in numbers.items()}
    return Status(
        state=state[1],
        machine_mm=x.get("MPos"),
        work_mm=x.get("WPos"),
        offset_mm=x.get("WCO"),
        spindle=float(fields["FS"].split(",")[-1]) if "FS" in fields else None,
        pins=fields.get("Pn", ""),
    )


@dataclass(frozen=True)
class GrblSettings:
    """Settings of the X axis that the stage depends on.

    ``homes_to_negative``: the limit switch is at the lower end of travel ($23, bit 0).
    """

    steps_per_mm: float
    max_feed_mm_per_min: float
    acceleration_mm_per_s2: float
    travel_mm: float
    homing: bool
    homes_to_negative: bool
    homing_feed_mm_per_min: float
    homing_seek_mm_per_min: float
    homing_debounce_ms: float
    homing_pull_off_mm: float
    spindle_max: float
    laser_mode: bool


def parse_settings(values: Mapping[int, float]) -> GrblSettings:
    """Parse the answer to ``$$``; raises HardwareError if the settings cannot move a stage."""
    needed = (13, 20, 21, 22, 23, 24, 25, 26, 27, 30, 31, 32, 100, 110, 120, 130)
    if missing := [f"${number}" for number in needed if number not in values]:
        raise HardwareError(
            f"the controller's answer to $$ lacks {', '.join(missing)}: it is not a complete Grbl 1.1; "
            "flash Grbl 1.1h for the Arduino Uno"
        )
    for number, name in ((100, "steps/mm"), (110, "greatest feed"), (120, "acceleration"), (130, "travel"), (30, "S")):
        if not values[number] > 0:
            raise HardwareError(f"${number} ({name}) is {values[number]:g}; expected a positive value: set it")
    if values[13] != 0:
        raise HardwareError("the controller reports inches ($13=1), expected millimetres: send $13=0")
    return GrblSettings(
        steps_per_mm=values[100],
        max_feed_mm_per_min=values[110],
        acceleration_mm_per_s2=values[120],
        travel_mm=values[130],
        homing=values[22] != 0,
        homes_to_negative=bool(int(values[23]) & 1),
        homing_feed_mm_per_min=values[24],
        homing_seek_mm_per_min=values[25],
        homing_debounce_ms=values[26],
        homing_pull_off_mm=values[27],
        spindle_max=values[30],
        laser_mode=values[32] != 0,
    )


def code_text(kind: Literal["error", "ALARM"], number: int) -> str:
    """Return the meaning of an ``error:N`` or ``ALARM:N``, with advice if the operator can do something."""
    known, advice = (_ERRORS, "") if kind == "error" else (_ALARMS, "; reset the controller and home")
    return f"{kind}:{number}, {known.get(number, f'unknown to Grbl 1.1{advice}')}"


_ALARMS = {
    1: "hard limit: the limit switch was hit, or there was noise on its line; the position is lost: find the cause, "
    "then home",
    2: "soft limit: the target is outside the travel; the position is kept: unlock, and stay within the travel",
    3: "reset while moving; the position is lost: home",
    4: "probe: not in the expected state at the start; check the wiring of A5, then unlock",
    5: "probe: no contact within the movement; check the probe, then unlock",
    6: "homing: a reset stopped it; home again",
    7: "homing: the safety door was opened; close it and home again",
    8: "homing: the limit switch stayed pressed after the pull-off; check its wiring, or enlarge the pull-off $27",
    9: "homing: no limit switch was found; check the switch, its wiring, the direction $23 and the travel $130; "
    "a firmware that homes axes which do not exist fails in the same way",
}
_ERRORS = {
    1: "a word does not begin with a letter",
    2: "a number is missing or malformed",
    3: "unknown $ command",
    4: "negative value",
    5: "homing is disabled; wire the limit switch and send $22=1",
    6: "the step pulse must be longer than 3 us",
    7: "the EEPROM could not be read; its defaults are restored; check all settings with $$: any may have changed",
    8: "this $ command needs an idle controller; wait until it is at rest",
    9: "locked by an alarm; home (or unlock where the position is known)",
    10: "soft limits need homing; send $22=1 first",
    11: "line too long",
    12: "the step rate would exceed 30 kHz; lower the greatest feed $110",
    13: "the safety door is open; close it",
    14: "line too long for the EEPROM",
    15: "the jog's target exceeds the travel",
    16: "invalid jog command",
    17: "laser mode needs a PWM output; flash a Grbl with variable spindle",
    20: "unsupported G-code",
    21: "two commands of one modal group",
    22: "no feed rate",
    23: "a whole number is needed",
    24: "two commands use the axis words",
    25: "a word is repeated",
    26: "axis words are missing",
    27: "invalid line number",
    28: "a value is missing",
    29: "unsupported work coordinate system",
    30: "G53 needs G0 or G1",
    31: "unused axis words",
    32: "an arc lacks axis words",
    33: "invalid target",
    34: "invalid arc radius",
    35: "an arc lacks its offset",
    36: "unused words",
    37: "invalid axis for G43.1",
    38: "tool number too large",
}

SOFT_RESET, STATUS_QUERY, FEED_HOLD = b"\x18", b"?", b"!"
_BAUD = 115200  # of Grbl 1.1
ANSWER_S = 2.0  # of the controller; it answers within milliseconds
# Grbl's documentation recommends at most 5 to 10 status queries a second during a movement.
POLL_S = 0.1
# Grbl's own lines are shorter than 130 characters.
_LONGEST_LINE = 200
# Longest blocking read; deadlines and Ctrl-C are handled in between.
_READ_S = 0.05
# After a restart the controller has sent everything when it is silent for this long.
_QUIET_S = 0.2
# Time limit of the greeting after Ctrl-X, which takes a few ms.
_WAKE_S = 1.0
# Status queries are answered within a few ms; a lost one is repeated.
_QUERY_S = 0.7
_QUERIES = 3
_STOOD_STILL = (
    f"the guard switched the laser off because this program stood still for over {GRACE_S:g} s while it was on: "
    "suspended (Ctrl-Z), hung in a driver, or the computer is too busy; recorded data are kept"
)
_HUNG_WRITE_S = 0.2
_ASKED_TO_DARKEN = "the laser was switched off by hand: unlock the stage if it stood still, else home it"


class GrblLine:
    """Open line to a controller of version 1.1, which has just restarted. Not thread-safe, apart from `darken`.

    The ``with`` ends with the laser off. ``laser_unreachable``: the last command to switch it off could not be sent.

    ``port`` is a serial port such as /dev/ttyACM0. ``boot_s`` is the longest time to the greeting of a controller that
    restarts when the port is opened; after that Ctrl-X requests the greeting. Raises HardwareError if the port is
    missing, forbidden or in use, nothing answers, or the answer is not that of Grbl 1.1.
    """

    def __init__(self, port: str, *, boot_s: float = 2.5):
        self.port = port
        self.fault: str | None = None
        self.offset_mm: float | None = None
        self.asked_s = self.answered_s = -math.inf
        self._received, self.unacknowledged = bytearray(), 0
        self._serial = _open_port(port)
        self._guard: Heartbeat | None = None
        self._lit, self._beaten_s = False, -math.inf
        self.darkened_by_hand, self._writing, self.laser_unreachable = False, threading.Lock(), False
        try:
            self._hang_up_on_close()
            self._guard = Heartbeat(self._serial.fileno())
            self.version = self._await_greeting(boot_s)
            self._discard_replies()
        except BaseException as error:
            self.close(error)
            raise

    def _hang_up_on_close(self) -> None:
        """Make DTR drop when any process closes the port; docs/how-to/hardware-stage.md explains why."""
        if termios is None:
            raise HardwareError(
                "a stage with a laser needs Linux or macOS: the laser guard does not work on this system"
            )
        try:
            attributes = termios.tcgetattr(self._serial.fileno())
            attributes[2] |= termios.HUPCL
            termios.tcsetattr(self._serial.fileno(), termios.TCSANOW, attributes)
        except termios.error as error:
            raise HardwareError(f"the serial port cannot be set up: {error}") from error

    def announce_light(self, wait_s: float = 0.0) -> None:
        """Tell the guard that the laser is on, or about to be, and that the next beat may take ``wait_s``.

        Every exchange with the controller sends a beat. Raises HardwareError if the guard process is gone, or has
        switched the laser off because the program stood still.
        """
        self._refuse_after_fault()
        self._lit = True
        self._beat(wait_s + GRACE_S)

    def report_dark(self) -> None:
        """Tell the guard that the laser is off; raises HardwareError like `announce_light` if it was on before."""
        if self._lit:
            self._beat(math.inf)
            self._lit = False

    def _beat(self, allowed_s: float) -> None:
        match "gone" if self._guard is None else self._guard.beat(allowed_s):
            case "watching":
                self._beaten_s = time.monotonic()
            case "switched off":
                raise self.stop_and_make_error(_STOOD_STILL)
            case "gone":
                raise self.stop_and_make_error(
                    "the guard process, which switches the laser off after a crash, is gone or suspended: open the "
                    "stage again"
                )

    def _await_greeting(self, boot_s: float) -> str:
        heard = ""
        for wait_s, wake in ((boot_s, b""), (_WAKE_S, SOFT_RESET)):
            if wake:
                self._write(wake)
            deadline = time.monotonic() + wait_s
            while (line := self._read_line(deadline)) is not None:
                reply = parse_reply(line)
                if isinstance(reply, Reply) and reply.kind == "banner":
                    return reply.text
                heard = line
                if "Grbl" in line or "FluidNC" in line:
                    raise HardwareError(f"{self.port} is not Grbl 1.1, it answers {heard!r}: flash Grbl 1.1h")
        if heard := heard or _decode_readably(self._received[:60]):
            raise HardwareError(
                f"{self.port} does not speak Grbl, it answers {heard!r}: wrong port, or not {_BAUD} baud"
            )
        raise HardwareError(
            f"nothing answers on {self.port} within {boot_s + _WAKE_S:g} s: is it the controller's port, is the "
            "controller powered, does it run Grbl 1.1?"
        )

    def command(
        self, line: str, *, timeout_s: float = ANSWER_S, watch: Callable[[Status], None] | None = None
    ) -> list[Reply]:
        """Send one line, wait until it and all earlier ones are acknowledged, and return the other replies before that.

        ``watch`` is called with every status report while waiting; without it the status is not queried. Raises
        HardwareError if the line is rejected or not done within ``timeout_s``, and for every fault.
        """
        self._refuse_after_fault()
        # Only a line feed: Grbl acknowledges a carriage return with a line feed twice.
        self._write(line.encode("ascii") + b"\n")
        self.unacknowledged += 1
        deadline, answers = time.monotonic() + timeout_s, []
        while self.unacknowledged:
            if watch is not None and time.monotonic() < deadline:
                watch(self.status())
                reply = self._read_reply(min(deadline, time.monotonic() + POLL_S)) if self.unacknowledged else None
            else:
                reply = self._read_reply(deadline)
                if reply is None:
                    raise self.stop_and_make_error(
                        f"{line!r} was not done in {timeout_s:.1f} s: the controller hangs or is held"
                    )
            if isinstance(reply, Reply):
                answers.append(reply)
        return answers

    def begin(self, *lines: str) -> None:
        """Send lines without waiting for their acknowledgement; `end` aborts them.

        The controller executes them even if the computer fails. Raises HardwareError like `command`.
        """
        self._refuse_after_fault()
        self.unacknowledged += len(lines)
        self._write("".join(f"{line}\n" for line in lines).encode("ascii"))

    def end(self) -> None:
        """Abort the lines of `begin` by Ctrl-X, which also switches the laser off; the position is kept at rest."""
        self._refuse_after_fault()
        if (alarm := self._reset()) is not None:
            raise self.stop_and_make_error(code_text("ALARM", alarm))

    def read_settings(self) -> dict[int, float]:
        """Return the answer to ``$$``: values by number."""
        return {each.number: each.value for each in self.command("$$") if each.kind == "setting"}

    def options(self) -> str:
        """Return the letters of the firmware's options in the answer to ``$I``; empty without options."""
        texts = [each.text for each in self.command("$I")]
        return next((text.removeprefix("OPT:").split(",")[0] for text in texts if text.startswith("OPT:")), "")

    def status(self) -> Status:
        """Query the status; raises HardwareError if no report arrives, and for every fault.

        ``asked_s`` and ``answered_s`` are the times of query and answer by the clock `time.monotonic`.
        """
        for _ in range(_QUERIES):
            self.asked_s = time.monotonic()
            self.realtime(STATUS_QUERY)
            deadline = time.monotonic() + _QUERY_S
            while (reply := self._read_reply(deadline)) is not None:
                if isinstance(reply, Status):
                    self.answered_s = time.monotonic()
                    return reply
        raise self.stop_and_make_error(
            f"silence: {_QUERIES} status queries were not answered: the cable is loose or the controller hangs"
        )

    def realtime(self, byte: bytes) -> None:
        """Send a real-time character, which Grbl obeys at once and does not acknowledge."""
        self._refuse_after_fault()
        self._write(byte)

    @property
    def descriptor(self) -> int:
        """File descriptor of the open port, for another process that switches the laser off by Ctrl-X."""
        return self._serial.fileno()

    def darken(self) -> bool:
        """Switch the laser off by Ctrl-X, from any thread and in any state, which also stops a movement.

        Returns whether the command could be sent, without waiting for an answer. Until `restart` nothing else is sent:
        a call in progress fails at its next exchange. Afterwards unlock a stage if nothing moved, or home it.
        """
        self.darkened_by_hand = True
        # Only for a short time: a write that hangs must not delay the reset.
        held = self._writing.acquire(timeout=_HUNG_WRITE_S)
        try:
            return self._send_reset()
        finally:
            if held:
                self._writing.release()

    def _send_reset(self) -> bool:
        self.laser_unreachable = True
        with suppress(OSError):
            self._serial.write(SOFT_RESET)
            self.laser_unreachable = False
        return not self.laser_unreachable

    def restart(self) -> None:
        """Reset by Ctrl-X: the laser goes off and a fault is cleared; the position is kept only if nothing moved."""
        self.darkened_by_hand = False
        self._reset()
        self._discard_replies()

    def _discard_replies(self) -> None:
        """Discard further replies after a restart: a second greeting must not be mistaken for a spontaneous restart.

        A second greeting follows an alarm, or resets that an earlier program sent before it ended.
        """
        while self._read_line(time.monotonic() + _QUIET_S) is not None:
            pass

    def _reset(self) -> int | None:
        """Reset by Ctrl-X; return the number of an alarm that came before the greeting."""
        alarm = None
        self.fault, self.unacknowledged = None, 0
        self._received.clear()
        self._write(SOFT_RESET)
        self._tell_guard_dark()
        deadline = time.monotonic() + ANSWER_S
        while (line := self._read_line(deadline)) is not None:
            reply = parse_reply(line)
            if isinstance(reply, Reply) and reply.kind == "banner":
                return alarm
            if isinstance(reply, Reply) and reply.kind == "ALARM":
                alarm = reply.number
        raise self.stop_and_make_error("the controller does not restart on Ctrl-X: switch its power off and on")

    def stop_and_make_error(self, what: str) -> HardwareError:
        """Switch the laser off after a fault, and return the error to raise."""
        laser = "the laser CANNOT be switched off: switch its power off before going near"
        if self._send_reset():
            laser = "the command to switch the laser off was sent"
        # The controller's greeting after the guard's reset would look like a fault of the controller.
        if self._tell_guard_dark():
            what = _STOOD_STILL
        elif self.darkened_by_hand:
            what = _ASKED_TO_DARKEN
        self.fault = what
        return HardwareError(f"stage on {self.port}: {what} ({laser})")

    def _tell_guard_dark(self) -> bool:
        """Tell the guard that the laser is off; return whether the guard had switched it off before."""
        lit, self._lit = self._lit, False
        return lit and self._guard is not None and self._guard.beat(math.inf) == "switched off"

    def close(self, error: BaseException | None = None) -> None:
        """Switch the laser off and close the port; after an ``error`` without waiting for the confirmation.

        Raises HardwareError if the controller does not confirm and there was no error before.
        """
        if not self._serial.is_open:
            return
        try:
            if error is None and self.fault is None and self._guard is not None:
                self.report_dark()
                self._reset()
            else:
                self._send_reset()
        finally:
            if self._guard is not None:
                self._guard.end()
            self._serial.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        self.close(error)

    def _refuse_after_fault(self) -> None:
        if not self._serial.is_open:
            raise HardwareError(f"the stage on {self.port} is closed: open it again")
        if self.fault is not None:
            raise HardwareError(f"the stage on {self.port} has stopped after a fault: {self.fault}; home or unlock it")
        if self.darkened_by_hand:
            raise self.stop_and_make_error(_ASKED_TO_DARKEN)

    def _write(self, data: bytes) -> None:
        try:
            with self._writing:
                # After the Ctrl-X of another thread a command would switch the laser on again.
                if self.darkened_by_hand and data != SOFT_RESET:
                    raise self.stop_and_make_error(_ASKED_TO_DARKEN)
                self._serial.write(data)
        except OSError as error:
            raise self.stop_and_make_error(f"the connection is lost: {error}; is the cable plugged in?") from error

    def _read_reply(self, deadline: float) -> Reply | Status | None:
        """Return the next reply that is not a fault, or None at the deadline."""
        line = self._read_line(deadline)
        if line is None:
            return None
        reply = parse_reply(line)
        if isinstance(reply, Status):
            self.offset_mm = self.offset_mm if reply.offset_mm is None else reply.offset_mm
            return reply
        match reply.kind:
            case "ok" | "error" if self.unacknowledged == 0:
                raise self.stop_and_make_error(
                    f"{line!r} was received although nothing was sent: does another program use the port?"
                )
            case "ok":
                self.unacknowledged -= 1
            case "error":
                self.unacknowledged -= 1
                raise HardwareError(f"the stage on {self.port} rejects: {code_text('error', reply.number)}")
            case "ALARM":
                raise self.stop_and_make_error(code_text("ALARM", reply.number))
            case "banner":
                raise self.stop_and_make_error(
                    "the controller restarted by itself: a dip of its supply, its reset button or interference; "
                    "its position is lost, home again"
                )
            case "garbage":
                raise self.stop_and_make_error(
                    f"garbage on the line, {line!r}: interference, or a cable that is too long or loose"
                )
            case "setting" | "message":
                pass
            case _:
                assert_never(reply.kind)
        return reply

    def _read_line(self, deadline: float) -> str | None:
        """Return the next line that is not empty, or None at the deadline."""
        while True:
            while (end := self._received.find(b"\n")) >= 0:
                line = _decode_readably(self._received[:end].strip(b"\r"))
                del self._received[: end + 1]
                if line:
                    return line
            if len(self._received) > _LONGEST_LINE:
                self._received.clear()
                raise self.stop_and_make_error(
                    f"garbage on the line, {_LONGEST_LINE} characters without an end: wrong baud rate or interference"
                )
            now = time.monotonic()
            if now >= deadline:
                return None
            if self._lit and now - self._beaten_s > BEAT_S:
                self._beat(GRACE_S)
            try:
                self._received += self._serial.read(max(1, self._serial.in_waiting))
            except OSError as error:
                raise self.stop_and_make_error(f"the connection is lost: {error}; is the cable plugged in?") from error


def _decode_readably(data: bytes | bytearray) -> str:
    return data.decode("ascii", errors="backslashreplace")


def _open_port(port: str) -> serial.Serial:
    try:
        return serial.Serial(port, _BAUD, timeout=_READ_S, write_timeout=ANSWER_S, exclusive=True)
    except OSError as error:
        found = ", ".join(sorted(entry.device for entry in comports())) or "none"
        busy = dict.fromkeys((errno.EBUSY, errno.EAGAIN), "another program uses it; close that program")
        advice = {
            errno.ENOENT: f"there is no such port; ports found: {found}",
            errno.ENODEV: f"the device is gone; ports found: {found}",
            errno.EACCES: "no permission; add yourself to the group dialout and log in again",
            **busy,
        }.get(error.errno or 0, str(error))
        raise HardwareError(f"cannot open {port}: {advice}") from error
