"""Grbl 1.1h controller with one axis and a laser, on a pseudo terminal: the twin's stage.

Its answers are identical to those of the firmware on an Arduino Uno: greeting, ``$`` commands, settings, status
reports, real-time characters, G-code with modal state, planner and receive buffers, soft limits, homing, alarms.
Programs open `GrblController.port` like /dev/ttyACM0. As on the Uno, opening the port restarts the controller, and
closing it does not. ``gated`` adds a hardware interlock: the laser has power only while the port is open.

Not implemented: Y and Z axes (error:20), arcs, probing, jogging, overrides, hard limits, parking, check mode.

The stage's position is in mm from the lower end of travel, the position of the limit switch if $23 is 1.
"""

import errno
import os
import select
import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from twin.devices.grbl_firmware import GrblFirmware

# The thesis's bench, as docs/how-to/hardware-stage.md sets it up.
# fmt: off
BENCH_SETTINGS: dict[int, float] = {
    0: 10, 1: 255, 2: 0, 3: 0, 4: 0, 5: 0, 6: 0, 10: 1, 11: 0.01, 12: 0.002, 13: 0,
    20: 1, 21: 0, 22: 1, 23: 1, 24: 60, 25: 600, 26: 25, 27: 2, 30: 1000, 31: 0, 32: 1,
    100: 80, 101: 250, 102: 250, 110: 900, 111: 500, 112: 500, 120: 50, 121: 10, 122: 10, 130: 750, 131: 200, 132: 200,
}
# fmt: on
# Intervals of polling the line.
_BUSY_MS = 2
_IDLE_MS = 20


@dataclass(frozen=True)
class StageState:
    """True state of stage and laser at ``time_s`` of the monotonic clock; ``power`` is 0 without light."""

    time_s: float
    position_mm: float
    speed_mm_per_s: float
    laser_on: bool
    power: float
    port_open: bool

    @property
    def moving(self) -> bool:
        """True if the stage moves."""
        return self.speed_mm_per_s != 0


@dataclass(frozen=True)
class LitTime:
    """Period of laser light in s of the monotonic clock; ``off_s`` is None while the laser is on."""

    on_s: float
    off_s: float | None = None

    @property
    def duration_s(self) -> float:
        """Duration until the end or until now."""
        return (time.monotonic() if self.off_s is None else self.off_s) - self.on_s


class GrblController:
    """Controller as a context manager, with its own thread; all methods are thread-safe.

    ``settings`` by number replace those in `BENCH_SETTINGS`. ``position_mm``, ``speed_up`` and ``build`` (version,
    options and boot time) are those of `GrblFirmware`. With ``resets_when_opened`` the controller restarts when the
    port is opened, as the Uno does through DTR. With ``gated`` the laser's supply is off while the port is closed.
    """

    def __init__(
        self,
        *,
        settings: Mapping[int, float] | None = None,
        position_mm: float = 100.0,
        speed_up: float = 1.0,
        resets_when_opened: bool = True,
        gated: bool = False,
        **build: Any,
    ):
        self._speed_up, self._origin = speed_up, time.monotonic()
        self._lock, self._ending = threading.RLock(), threading.Event()
        self._resets_when_opened, self._gated, self._port_open = resets_when_opened, gated, False
        self._powered, self._muted, self._cut, self._laser_broken = True, False, False, False
        self._lights: list[LitTime] = []
        all_settings = {**BENCH_SETTINGS, **(settings or {})}
        self._firmware = GrblFirmware(
            all_settings, position_mm=position_mm, clock=self._read_clock, say=self._say, speed_up=speed_up, **build
        )

    def __enter__(self) -> "GrblController":
        self._master, slave = os.openpty()
        # Raw mode from the start; otherwise the terminal would echo the greeting as a command.
        import tty  # pseudo terminals exist only on POSIX systems

        tty.setraw(slave)
        self.port = os.ttyname(slave)
        os.close(slave)
        os.set_blocking(self._master, False)
        self._thread = threading.Thread(target=self._run, name="grbl", daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ending.set()
        self._thread.join()
        self.disconnect()

    def state(self) -> StageState:
        """Return the true state, for rendering."""
        with self._lock:
            lit = self._powered and not self._laser_broken and (self._port_open or not self._gated)
            power = self._firmware.laser_power() if lit else 0.0
            time_s = time.monotonic()
            at_mm, speed = self._firmware.axis.state_at((time_s - self._origin) * self._speed_up)
            at_mm += self._firmware.shift_mm
            return StageState(time_s, at_mm, speed * self._speed_up, power > 0, power, self._port_open)

    @property
    def lights(self) -> tuple[LitTime, ...]:
        """Periods of light so far, accurate to a few ms."""
        with self._lock:
            return tuple(self._lights)

    def _log_light(self) -> None:
        state, lit = self.state(), bool(self._lights) and self._lights[-1].off_s is None
        if state.laser_on and not lit:
            self._lights.append(LitTime(state.time_s))
        elif lit and not state.laser_on:
            self._lights[-1] = LitTime(self._lights[-1].on_s, state.time_s)

    def steps(self, state: StageState | None = None) -> int:
        """Return the count of an encoder on the axis, one per step, in a state (default: now)."""
        return round((state or self.state()).position_mm / self._firmware.step_mm)

    def disconnect(self) -> None:
        """Pull the cable, which also cuts the controller's power."""
        with self._lock:
            if self._powered:
                self._firmware.axis.stop(self._read_clock())
                self._powered = False
                os.close(self._master)
                self._log_light()

    def inject(self, fault: str, value: float = 1, *, noise: bytes = b"\xff\xfe<Id|MPos:1#\x80,0\r\n") -> None:
        """Inject a fault of ``twin serve --fault``; ``value`` is its number or number of steps.

        The value 0 repairs "mute", "cut-line" and "break-laser". ``noise`` is sent by "garbage".
        """
        firmware = self._firmware
        with self._lock:
            match fault:
                case "stage-disconnect":
                    self.disconnect()
                case "mute":  # the controller's transmit line breaks; it still receives
                    self._muted = bool(value)
                case "cut-line":  # both data lines break; the controller keeps its power
                    self._muted = self._cut = bool(value)
                case "stall":  # blocked until a reset, while the controller reports "Run"
                    firmware.axis.stick(self._read_clock())
                case "stop-short":  # commands or pulses lost in the controller
                    firmware.short_steps = int(value)
                case "lose-steps":  # the motor slips, which the controller cannot detect
                    firmware.shift_mm += int(value) * firmware.step_mm
                case "alarm":
                    firmware.raise_alarm(int(value))
                case "garbage":
                    self._say(noise)
                case "restart":  # as after a dip of the supply
                    firmware.restart()
                case "hold":  # feed-hold button, or noise on its line
                    firmware.hear(b"!")
                case "break-laser":  # no light, whatever the state of the pin
                    self._laser_broken = bool(value)
                case _:
                    raise ValueError(f"unknown fault '{fault}' of the stage")

    # The line

    def _run(self) -> None:
        poll = select.poll()
        poll.register(self._master, select.POLLIN)
        # A pseudo terminal reports that it is closed only after it has been opened once.
        os.close(os.open(self.port, os.O_RDWR | os.O_NOCTTY))
        while not self._ending.is_set():
            patience_ms = _BUSY_MS if self._firmware.busy else _IDLE_MS
            events = dict(poll.poll(patience_ms)).get(self._master, 0)
            with self._lock:
                if not self._powered:
                    return
                was_open = self._port_open
                self._port_open = not (events & select.POLLHUP and not events & select.POLLIN)
                if self._port_open and not was_open and self._resets_when_opened:
                    self._firmware.restart()
                if events & select.POLLIN:
                    try:
                        heard = os.read(self._master, 4096)
                        self._firmware.hear(b"" if self._cut else heard)
                    except OSError as error:
                        if error.errno != errno.EIO:  # the last program has closed the port
                            raise
                self._firmware.work()
                self._log_light()
            if events & select.POLLHUP:
                # Polling a closed port returns immediately.
                time.sleep(_BUSY_MS / 1000)

    def _say(self, data: bytes) -> None:
        # Bytes to a closed port are lost; the pseudo terminal would keep them for the next program.
        if self._muted or not (self._powered and self._port_open):
            return
        try:
            os.write(self._master, data)
        except OSError as error:
            # No program reads, or the port is closed: a serial line ignores both.
            if error.errno not in (errno.EAGAIN, errno.EIO):
                raise

    def _read_clock(self) -> float:
        return (time.monotonic() - self._origin) * self._speed_up
