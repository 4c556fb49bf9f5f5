"""Grbl 1.1 for one axis: answers, states, alarms, and parser of G-code blocks."""

import math
import re
from collections.abc import Callable, Generator, Mapping
from dataclasses import dataclass

from twin.devices.grbl_motion import Axis

_WORD = re.compile(r"([A-Z])([+-]?(?:\d+\.?\d*|\.\d+))")
# Commands by modal group; the axis commands of group 0 also exclude each other.
_COMMANDS = {
    "once": ("G4", "G53", "G92", "G92.1"),
    "motion": ("G0", "G1", "G80"),
    "plane": ("G17",),
    "distance": ("G90", "G91"),
    "feed": ("G94",),
    "units": ("G20", "G21"),
    "cutter": ("G40",),
    "length": ("G49",),
    "system": ("G54",),
    "control": ("G61",),
    "stop": ("M0", "M2", "M30"),
    "spindle": ("M3", "M4", "M5"),
    "coolant": ("M7", "M8", "M9"),
}
_GROUPS = {command: group for group, commands in _COMMANDS.items() for command in commands}
_VALUES = "XFSPNT"


class GrblError(Exception):
    """Error in a line, which Grbl answers with ``error:code``."""

    def __init__(self, code: int):
        super().__init__(f"error:{code}")
        self.code = code


@dataclass(frozen=True)
class CommandBlock:
    """Commands of a line by modal group, its values by letter, and whether it contains G53."""

    commands: dict[str, str]
    values: dict[str, float]
    machine_coordinates: bool


def parse_block(line: str) -> CommandBlock:
    """Parse a line in capitals, without spaces and comments; GrblError with Grbl's error number."""
    commands: dict[str, str] = {}
    values: dict[str, float] = {}
    machine_coordinates, position = False, 0
    while position < len(line):
        found = _WORD.match(line, position)
        if not found:
            raise GrblError(2 if line[position].isalpha() else 1)
        position, letter, number = found.end(), found[1], float(found[2])
        if letter in "GM":
            command = f"{letter}{number:g}"
            if command not in _GROUPS:
                raise GrblError(20)
            if command == "G53":
                machine_coordinates = True
            elif commands.setdefault(_GROUPS[command], command) != command:
                raise GrblError(21)
        elif letter not in _VALUES:
            raise GrblError(20)
        elif letter in values:
            raise GrblError(25)
        elif letter in "FSPNT" and number < 0:
            raise GrblError(4)
        else:
            values[letter] = number
    _refuse_incomplete(commands, values, machine_coordinates)
    return CommandBlock(commands, values, machine_coordinates)


def _refuse_incomplete(commands: dict[str, str], values: dict[str, float], machine_coordinates: bool) -> None:
    once, motion = commands.get("once"), commands.get("motion")
    refused = {
        28: once == "G4" and "P" not in values,
        36: once != "G4" and "P" in values,
        26: once == "G92" and "X" not in values,
        24: once == "G92" and motion is not None,
        30: machine_coordinates and motion == "G80",
        31: once == "G4" and "X" in values,
    }
    for code, wrong in refused.items():
        if wrong:
            raise GrblError(code)


_DECIMALS = {11, 12, 24, 25, 27, *range(100, 133)}
# Grbl 1.1h's config.h: BLOCK_BUFFER_SIZE and RX_BUFFER_SIZE less one, LINE_BUFFER_SIZE, REPORT_WCO_REFRESH_*_COUNT.
_PLANNER_BLOCKS = 15
_RECEIVE_BYTES = 127
_LONGEST_LINE = 79
_WCO_IDLE = 10
_WCO_BUSY = 30
_DWELL_STEP_S = 0.05
"""DWELL_TIME_STEP: dwells are rounded up to whole steps."""


class GrblFirmware:
    """Firmware of one controller; not thread-safe.

    ``settings`` are all settings by number, and ``position_mm`` is the position of the stage when the power is switched
    on. ``clock`` returns the controller's time in s, and ``say`` receives the bytes for the computer. ``version`` is
    that of the greeting, ``options`` are the code letters of the build in ``$I``. ``boot_s`` is the time from a restart
    to the greeting, by default that of the Uno's boot loader. ``speed_up`` is the factor between the controller's time
    and real time. Dwells are longer by it, because exposures during a dwell take real time.
    """

    def __init__(
        self,
        settings: Mapping[int, float],
        *,
        position_mm: float,
        clock: Callable[[], float],
        say: Callable[[bytes], None],
        version: str = "1.1h",
        options: str = "V",
        boot_s: float = 1.6,
        speed_up: float = 1.0,
    ):
        self._settings, self._version, self._options, self._boot_s = dict(settings), version, options, boot_s
        self._now, self._say, self._speed_up = clock, say, speed_up
        self.axis = Axis(self._settings[120])
        self.shift_mm, self.short_steps, self._starts = position_mm, 0, 0
        self.restart()

    @property
    def step_mm(self) -> float:
        """Length of one step."""
        return 1 / self._settings[100]

    @property
    def busy(self) -> bool:
        """True if the controller is active without further input."""
        return self._booted_s is not None or self._job is not None or self.axis.pending > 0

    def laser_power(self) -> float:
        """Return the duty cycle of the laser's pin."""
        return self._compute_spindle(self._now()) / self._settings[30]

    def hear(self, data: bytes) -> None:
        """Receive characters from the computer; they are lost during the start."""
        for byte in data if self._booted_s is None else b"":
            if byte == 0x18:
                self._reset_softly()
            elif byte == ord("?"):
                if self._mode != "Home" and not self._critical:
                    self._send(self._report(self._now()))
            elif byte == ord("!"):
                if self._mode == "Idle":
                    self.axis.hold(self._now())
            elif byte == ord("~"):
                self.axis.resume(self._now())
            elif byte < 0x80 and len(self._input) < _RECEIVE_BYTES:
                self._input.append(byte)

    def _send(self, text: str) -> None:
        self._say(f"{text}\r\n".encode("ascii"))

    def restart(self) -> None:
        """Restart: switch the laser off, and discard position and queue."""
        now = self._now()
        self.shift_mm += self.axis.state_at(now)[0]
        self.axis.place(0.0)
        self._mode = "Alarm" if self._settings[22] else "Idle"
        self._clear(booted_s=now + self._boot_s)

    def _clear(self, *, booted_s: float | None) -> None:
        self._booted_s = booted_s
        self._starts += 1
        self._input = bytearray()
        self._job: Generator[None, None, None] | None = None
        self._critical, self._reports_to_offset = False, 0
        self._modal = {"motion": "G0", "distance": "G90", "units": "G21", "spindle": "M5"}
        self._feed_mm_min, self._s, self._offset_mm = 0.0, 0.0, 0.0

    def _reset_softly(self) -> None:
        now = self._now()
        self.axis.advance(now)
        if self._mode == "Home" or (self.axis.pending and (not self.axis.held or self.axis.braking(now))):
            self._send(f"ALARM:{6 if self._mode == 'Home' else 3}")
            self._mode = "Alarm"
        self.axis.stop(now)
        if self._mode != "Alarm":
            self._mode = "Idle"
        self._clear(booted_s=None)
        self._greet()

    def _greet(self) -> None:
        self._send(f"\r\nGrbl {self._version} ['$' for help]")
        if self._mode == "Alarm":
            self._send("[MSG:'$H'|'$X' to unlock]")

    def raise_alarm(self, code: int) -> None:
        """Stop all motion and report an alarm."""
        self.axis.stop(self._now())
        self._mode, self._job, self._modal["spindle"] = "Alarm", None, "M5"
        self._send(f"ALARM:{code}")
        if code in (1, 2):
            self._critical = True
            self._send("[MSG:Reset to continue]")
        else:
            self._clear(booted_s=None)
            self._greet()

    def work(self) -> None:
        """Run the main loop once."""
        now = self._now()
        self.axis.advance(now)
        if self._booted_s is not None:
            if now < self._booted_s:
                return
            self._booted_s = None
            self._greet()
        while not self._critical:
            if self._job is None:
                line = None if self.axis.held else self._read_line()
                if line is None:
                    return
                self._job = self._answer(line)
            job = self._job
            try:
                next(job)
                return
            except StopIteration:
                # An alarm or a reset within the job has already discarded it.
                self._job = None if self._job is job else self._job

    def _read_line(self) -> str | None:
        """Return the next complete line, without spaces and comments; None if there is none."""
        ends = [at for at in (self._input.find(b"\n"), self._input.find(b"\r")) if at >= 0]
        if not ends:
            return None
        line = self._input[: min(ends)].decode("ascii")
        del self._input[: min(ends) + 1]
        return "".join(line.split(";")[0].split()).upper()

    def _answer(self, line: str) -> Generator[None, None, None]:
        starts = self._starts
        try:
            if len(line) > _LONGEST_LINE:
                raise GrblError(11)
            if line.startswith("$"):
                yield from self._run_system_command(line)
            elif line and self._mode == "Alarm":
                raise GrblError(9)
            elif line:
                yield from self._execute(parse_block(line))
        except GrblError as error:
            self._send(f"error:{error.code}")
        else:
            # A line that an alarm has discarded is not acknowledged.
            if not self._critical and self._starts == starts:
                self._send("ok")

    def _report(self, now: float) -> str:
        self.axis.advance(now)
        position, speed = self.axis.state_at(now)
        steps = round(position * self._settings[100]) / self._settings[100]
        if self.axis.held:
            state = f"Hold:{int(self.axis.braking(now))}"
        else:
            state = "Run" if self._mode == "Idle" and self.axis.pending else self._mode
        machine = int(self._settings[10]) & 1
        x = steps if machine else steps - self._offset_mm
        fields = [state, f"{'MPos' if machine else 'WPos'}:{x:.3f},0.000,0.000"]
        if int(self._settings[10]) & 2:
            fields.append(f"Bf:{_PLANNER_BLOCKS - self.axis.pending},{_RECEIVE_BYTES - len(self._input)}")
        fields.append(f"FS:{abs(speed) * 60:.0f},{self._compute_spindle(now):.0f}")
        # Tolerance of half a step, so that rounding does not trigger the limit switch.
        stage_mm, slack = position + self.shift_mm, 0.5 / self._settings[100]
        if stage_mm < -slack if int(self._settings[23]) & 1 else stage_mm > self._settings[130] + slack:
            fields.append("Pn:X")
        if self._reports_to_offset == 0:
            self._reports_to_offset = _WCO_IDLE if state == "Idle" else _WCO_BUSY
            fields.append(f"WCO:{self._offset_mm:.3f},0.000,0.000")
        self._reports_to_offset -= 1
        return f"<{'|'.join(fields)}>"

    def _compute_spindle(self, now: float) -> float:
        """Return the effective S; laser mode switches off during G0 and holds, and scales M4 with the speed."""
        if self._modal["spindle"] == "M5" or self._mode == "Alarm":
            return 0.0
        s = min(self._s, self._settings[30])
        if not self._settings[32]:
            return s
        if self._modal["motion"] == "G0" or (self.axis.held and not self.axis.braking(now)):
            return 0.0
        if self._modal["spindle"] == "M3":
            return s
        speed = abs(self.axis.state_at(now)[1])
        return s * min(speed / self.axis.commanded_speed(now), 1.0) if speed else 0.0

    def _wait_until_done(self) -> Generator[None, None, None]:
        while self.axis.pending or self.axis.held:
            yield

    def _pause(self, seconds: float) -> Generator[None, None, None]:
        end_s = self._now() + seconds
        while self._now() < end_s:
            yield

    def _dwell(self, seconds: float) -> Generator[None, None, None]:
        """Dwell in the controller's time steps; a hold pauses the dwell."""
        left, last = math.ceil(round(seconds / _DWELL_STEP_S, 6)) * _DWELL_STEP_S * self._speed_up, self._now()
        while left > 0:
            yield
            now = self._now()
            left, last = left if self.axis.held else left - (now - last), now

    def _run_system_command(self, line: str) -> Generator[None, None, None]:
        idle = self._mode == "Alarm" or not self.axis.pending
        if line == "$G":
            modes = " ".join((self._modal["motion"], "G54 G17", self._modal["units"], self._modal["distance"], "G94"))
            self._send(f"[GC:{modes} {self._modal['spindle']} M9 T0 F{self._feed_mm_min:.0f} S{self._s:.0f}]")
        elif line == "$X":
            if self._mode == "Alarm":
                self._mode = "Idle"
                self._send("[MSG:Caution: Unlocked]")
        elif not idle:
            raise GrblError(8)
        elif line == "$$":
            for number, value in sorted(self._settings.items()):
                self._send(f"${number}={value:.3f}" if number in _DECIMALS else f"${number}={value:.0f}")
        elif line == "$I":
            self._send(f"[VER:{self._version}.20190825:]")
            self._send(f"[OPT:{self._options},{_PLANNER_BLOCKS},{_RECEIVE_BYTES + 1}]")
        elif line == "$":
            self._send("[HLP:$$ $# $G $I $N $x=val $Nx=line $J=line $SLP $C $X $H ~ ! ? ctrl-x]")
        elif line == "$H":
            yield from self._home()
        else:
            self._change_setting(line)

    def _change_setting(self, line: str) -> None:
        number, equals, value = line[1:].partition("=")
        if not equals or not number.isdigit() or int(number) not in self._settings:
            raise GrblError(3)
        try:
            wanted = float(value)
        except ValueError:
            raise GrblError(2) from None
        if wanted < 0:
            raise GrblError(4)
        if number == "20" and wanted and not self._settings[22]:
            raise GrblError(10)
        self._settings[int(number)] = wanted
        if number == "22" and not wanted:
            self._settings[20] = 0
        self.axis.acceleration = self._settings[120]

    def _home(self) -> Generator[None, None, None]:
        """Home the axis: seek the switch, pull off, approach it slowly, pull off, and set the position."""
        if not self._settings[22]:
            raise GrblError(5)
        self._mode, low, travel = "Home", bool(int(self._settings[23]) & 1), self._settings[130]
        self._modal["spindle"] = "M5" if self._settings[32] else self._modal["spindle"]
        pull_off = self._settings[27]
        switch = 0.0 if low else travel
        clear = switch + (pull_off if low else -pull_off)
        if abs(switch - self.shift_mm - self.axis.state_at(self._now())[0]) > 1.5 * travel:
            self.raise_alarm(9)
            return
        for place_mm, feed in ((switch, 25), (clear, 25), (switch, 24), (clear, 25)):
            self.axis.add(place_mm - self.shift_mm, speed=self._settings[feed] / 60, time_s=self._now())
            yield from self._wait_until_done()
            yield from self._pause(self._settings[26] / 1000)
        at_the_switch = pull_off - travel if low else -pull_off
        counted = 0.0 if "Z" in self._options else at_the_switch
        self.axis.place(counted)
        self.shift_mm, self._mode = clear - counted, "Idle"

    def _execute(self, block: CommandBlock) -> Generator[None, None, None]:
        values, modal = block.values, {**self._modal, **block.commands}
        moves = "X" in values and block.commands.get("once") != "G92"
        if moves and modal["motion"] == "G80":
            raise GrblError(31)
        scale = 25.4 if modal["units"] == "G20" else 1.0
        feed = values["F"] * scale if "F" in values else self._feed_mm_min
        if feed == 0 and (modal["motion"] == "G1") and (moves or block.commands.get("motion") == "G1"):
            raise GrblError(22)
        self._feed_mm_min = feed
        if "S" in values or "spindle" in block.commands:
            yield from self._wait_until_done()
            self._s = values.get("S", self._s)
        if block.commands.get("stop") in ("M2", "M30"):
            modal |= {"motion": "G1", "distance": "G90", "spindle": "M5"}
        if block.commands.get("motion", self._modal["motion"]) != self._modal["motion"]:
            yield from self._wait_until_done()
        self._modal = {name: modal[name] for name in self._modal}
        if block.commands.get("once") == "G4":
            yield from self._wait_until_done()
            yield from self._dwell(values["P"])
        elif block.commands.get("once") in ("G92", "G92.1"):
            yield from self._wait_until_done()
            machine = self.axis.state_at(self._now())[0]
            self._offset_mm = machine - values["X"] * scale if block.commands["once"] == "G92" else 0.0
            self._reports_to_offset = 0
        elif moves:
            yield from self._move(values["X"] * scale, block.machine_coordinates, feed)

    def _move(self, x: float, machine_coordinates: bool, feed: float) -> Generator[None, None, None]:
        while self.axis.pending >= _PLANNER_BLOCKS:
            yield
        if machine_coordinates:
            target = x
        elif self._modal["distance"] == "G91":
            target = self.axis.planned_mm + x
        else:
            target = x + self._offset_mm
        low = 0 if "Z" in self._options and int(self._settings[23]) & 1 else -self._settings[130]
        if self._settings[20] and not low <= target <= low + self._settings[130]:
            yield from self._wait_until_done()
            self.raise_alarm(2)
            return
        fastest = self._settings[110] if self._modal["motion"] == "G0" else min(feed, self._settings[110])
        target = round(target * self._settings[100]) / self._settings[100]
        if self.short_steps:
            way = target - self.axis.planned_mm
            target -= (1 if way > 0 else -1) * self.short_steps / self._settings[100]
            self.short_steps = 0
        self.axis.add(target, speed=fastest / 60, time_s=self._now())
