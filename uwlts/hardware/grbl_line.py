"""The serial line to a Grbl controller: lines and their acknowledgements, status reports, and what breaks a line.

Whatever the controller does that it should not is named, and answered by Ctrl-X, on which Grbl switches the laser's pin
off and stops the motor whatever else it is doing: an alarm, a restart of its own, silence, noise, a lost connection.
Afterwards nothing is sent any more until `restart`.
"""

import errno
import os
import subprocess
import sys
import termios
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import serial
from serial.tools.list_ports import comports

from uwlts.errors import HardwareError
from uwlts.hardware import laser_guard
from uwlts.hardware.grbl_protocol import (
    Alarm,
    Banner,
    Garbage,
    Message,
    Ok,
    Refusal,
    Reply,
    Setting,
    Status,
    alarm_text,
    parse_reply,
    refusal_text,
)

SOFT_RESET, STATUS_QUERY, FEED_HOLD = b"\x18", b"?", b"!"
ANSWER_S = 2.0
# Grbl's documentation asks for no more than 5 to 10 status queries a second while it moves.
POLL_S = 0.1
_LONGEST_LINE = 200
_READ_S, _QUIET_S, _WAKE_S = 0.05, 0.2, 1.0
_QUERY_S, _QUERIES = 0.7, 3


class GrblLine:
    """An open line to a controller of version 1.1, just restarted. Not safe between threads.

    Parameters
    ----------
    port : str
        Serial port, such as /dev/ttyACM0.
    baud : int
        Grbl 1.1 speaks 115200.
    boot_s : float
        How long the greeting of a controller that restarts when the port is opened may take; then Ctrl-X asks for it.

    Raises
    ------
    HardwareError
        The port is missing, forbidden or in use, nothing answers, or what answers is not Grbl 1.1.
    """

    def __init__(self, port: str, *, baud: int = 115200, boot_s: float = 2.5):
        self.port, self.fault = port, None
        self.messages: list[str] = []
        self.offset_mm: float | None = None
        self._received, self._unacknowledged = bytearray(), 0
        self._serial = _open(port, baud)
        self._guard: subprocess.Popen[bytes] | None = None
        self._alive: int | None = None
        try:
            _hang_up_on_close(self._serial.fd)
            self._start_guard()
            self.version = self._greeting(boot_s)
        except BaseException as error:
            self.close(error)
            raise

    def _start_guard(self) -> None:
        ending, self._alive = os.pipe()
        command = [sys.executable, "-I", "-S", str(Path(laser_guard.__file__)), str(os.getpid()), str(ending)]
        try:
            # In a session of its own the terminal's Ctrl-C does not reach it.
            self._guard = subprocess.Popen(
                [*command, str(self._serial.fd)], pass_fds=(ending, self._serial.fd), start_new_session=True,
                stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
            )  # fmt: skip
        except OSError as error:
            raise HardwareError(f"cannot start the guard that switches the laser off: {error.strerror}") from error
        finally:
            os.close(ending)

    @property
    def guarded(self) -> bool:
        """Whether the process that switches the laser off after a crash is alive."""
        return self._guard is not None and self._guard.poll() is None

    def _greeting(self, boot_s: float) -> str:
        heard = ""
        for wait_s, wake in ((boot_s, b""), (_WAKE_S, SOFT_RESET)):
            if wake:
                self._write(wake)
            deadline = time.monotonic() + wait_s
            while (line := self._read_line(deadline)) is not None:
                if isinstance(reply := parse_reply(line), Banner):
                    return reply.version
                heard = line or heard
                if "Grbl" in line or "FluidNC" in line:
                    raise HardwareError(f"{self.port} is not Grbl 1.1, it says {heard!r}: flash Grbl 1.1h")
        heard = heard or _readable(self._received[:60])
        if heard:
            raise HardwareError(
                f"{self.port} does not speak Grbl, it says {heard!r}: wrong port, or not {self._serial.baudrate} baud"
            )
        raise HardwareError(
            f"nothing answers on {self.port} within {boot_s + _WAKE_S:g} s: is it the controller's port, is the "
            "controller powered, does it run Grbl 1.1?"
        )

    def command(
        self, line: str, *, timeout_s: float = ANSWER_S, watch: Callable[[Status], None] | None = None
    ) -> list[Setting | Message]:
        """Send one line and wait until it, and all before it, are acknowledged.

        Parameters
        ----------
        line : str
            Without its end.
        timeout_s : float
            Longest time to the acknowledgement.
        watch : callable
            Given every status report while waiting; without it no status is asked for.

        Returns
        -------
        list
            The settings and messages that came before the acknowledgement.

        Raises
        ------
        HardwareError
            The line is refused, or a fault of the line or the controller.
        """
        self._refuse_after_fault()
        # A line feed alone: with a carriage return as well Grbl acknowledges twice.
        self._write(line.encode("ascii") + b"\n")
        self._unacknowledged += 1
        deadline, answers = time.monotonic() + timeout_s, []
        while self._unacknowledged:
            if watch is not None and time.monotonic() < deadline:
                watch(self.status())
                reply = self._next_reply(min(deadline, time.monotonic() + POLL_S)) if self._unacknowledged else None
            else:
                reply = self._next_reply(deadline)
                if reply is None:
                    raise self.failed(f"{line!r} was not done in {timeout_s:.1f} s: the controller hangs or is held")
            if isinstance(reply, Setting | Message):
                answers.append(reply)
        return answers

    def status(self) -> Status:
        """Ask for a status report; HardwareError where none comes, and for every fault."""
        self._refuse_after_fault()
        for _ in range(_QUERIES):
            self._write(STATUS_QUERY)
            deadline = time.monotonic() + _QUERY_S
            while (reply := self._next_reply(deadline)) is not None:
                if isinstance(reply, Status):
                    return reply
        raise self.failed(
            f"silence: {_QUERIES} status queries were not answered: the cable is loose or the controller hangs"
        )

    def realtime(self, byte: bytes) -> None:
        """Send a character that Grbl obeys at once and does not acknowledge."""
        self._refuse_after_fault()
        self._write(byte)

    def restart(self) -> None:
        """Reset by Ctrl-X: the laser goes off and a fault is over; the position is kept only if nothing moved."""
        self._reset()
        # After an alarm there may be a greeting more, which must not look like a restart of its own.
        while self._read_line(time.monotonic() + _QUIET_S) is not None:
            pass

    def _reset(self) -> None:
        self.fault, self._unacknowledged = None, 0
        self._received.clear()
        self._write(SOFT_RESET)
        deadline = time.monotonic() + ANSWER_S
        while (line := self._read_line(deadline)) is not None:
            if isinstance(parse_reply(line), Banner):
                return
        raise self.failed("the controller does not restart on Ctrl-X: switch its power off and on")

    def failed(self, what: str) -> HardwareError:
        """Make everything safe after a fault and return the error to raise."""
        self.fault = what
        sent = self._try_to_reset()
        laser = (
            "the laser was told to go off" if sent
            else "the laser CANNOT be told to go off: switch its power off before going near"
        )  # fmt: skip
        return HardwareError(f"stage on {self.port}: {what} ({laser})")

    def close(self, error: BaseException | None = None) -> None:
        """Switch the laser off and close; after an ``error`` without asking whether it worked.

        Raises
        ------
        HardwareError
            The controller did not confirm, and there was no error before.
        """
        if not self._serial.is_open:
            return
        try:
            if error is None and self.fault is None and self._guard is not None:
                self._reset()
            else:
                self._try_to_reset()
        finally:
            self._dismiss_guard()
            self._serial.close()

    def _dismiss_guard(self) -> None:
        if self._alive is not None:
            os.close(self._alive)
            self._alive = None
        if self._guard is not None:
            try:
                self._guard.wait(ANSWER_S + 1)
            except subprocess.TimeoutExpired:
                self._guard.kill()
                self._guard.wait()

    def _refuse_after_fault(self) -> None:
        if not self._serial.is_open:
            raise HardwareError(f"the stage on {self.port} is closed: open it again")
        if self.fault is not None:
            raise HardwareError(f"the stage on {self.port} has stopped after a fault: {self.fault}; home or unlock it")

    def _try_to_reset(self) -> bool:
        with suppress(OSError):
            self._serial.write(SOFT_RESET)
            return True
        return False

    def _write(self, data: bytes) -> None:
        try:
            self._serial.write(data)
        except OSError as error:
            raise self.failed(f"the connection is lost: {error}; is the cable plugged in?") from error

    def _next_reply(self, deadline: float) -> Reply | None:
        """The next reply that is no fault, or None at the deadline."""
        line = self._read_line(deadline)
        if line is None:
            return None
        match reply := parse_reply(line):
            case Ok() | Refusal() if self._unacknowledged == 0:
                raise self.failed(f"{line!r} came although nothing was sent: does another program use the port?")
            case Ok():
                self._unacknowledged -= 1
            case Refusal(code):
                self._unacknowledged -= 1
                raise HardwareError(f"the stage on {self.port} refuses: {refusal_text(code)}")
            case Alarm(code):
                raise self.failed(alarm_text(code))
            case Banner():
                raise self.failed(
                    "the controller restarted by itself: a dip of its supply, its reset button or interference; "
                    "its position is lost, home again"
                )
            case Garbage(text):
                raise self.failed(f"garbage on the line, {text!r}: interference, or a cable that is too long or loose")
            case Message(text):
                self.messages.append(text)
            case Status() if reply.offset_mm is not None:
                self.offset_mm = reply.offset_mm
        return reply

    def _read_line(self, deadline: float) -> str | None:
        """The next line that is not empty, or None at the deadline."""
        while True:
            while (end := self._received.find(b"\n")) >= 0:
                line = _readable(self._received[:end].strip(b"\r"))
                del self._received[: end + 1]
                if line:
                    return line
            if len(self._received) > _LONGEST_LINE:
                self._received.clear()
                raise self.failed(
                    f"garbage on the line, {_LONGEST_LINE} characters without an end: wrong baud rate or interference"
                )
            if time.monotonic() >= deadline:
                return None
            try:
                self._received += self._serial.read(max(1, self._serial.in_waiting))
            except OSError as error:
                raise self.failed(f"the connection is lost: {error}; is the cable plugged in?") from error


def _readable(data: bytes | bytearray) -> str:
    return data.decode("ascii", errors="backslashreplace")


def _open(port: str, baud: int) -> serial.Serial:
    try:
        return serial.Serial(port, baud, timeout=_READ_S, write_timeout=ANSWER_S, exclusive=True)
    except ValueError as error:
        raise HardwareError(f"cannot open {port} with {baud} baud: {error}") from error
    except OSError as error:
        found = ", ".join(sorted(entry.device for entry in comports())) or "none"
        advice = {
            errno.ENOENT: f"there is no such port; ports found: {found}",
            errno.ENODEV: f"the device is gone; ports found: {found}",
            errno.EACCES: "no permission; add yourself to the group dialout and log in again",
            errno.EBUSY: "another program uses it; close that program",
            errno.EAGAIN: "another program uses it; close that program",
        }.get(error.errno, str(error))
        raise HardwareError(f"cannot open {port}: {advice}") from error


def _hang_up_on_close(descriptor: int) -> None:
    """See that DTR drops when the port is closed, by whomever: see docs/hardware-stage.md for what hangs on it."""
    try:
        attributes = termios.tcgetattr(descriptor)
        attributes[2] |= termios.HUPCL
        termios.tcsetattr(descriptor, termios.TCSANOW, attributes)
    except termios.error as error:
        raise HardwareError(f"the serial port cannot be set up: {error}") from error
