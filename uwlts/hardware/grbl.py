"""The stage and the laser: a Grbl 1.1 controller that moves one axis and switches the laser by its spindle pin.

Positions are in mm from the lower end of travel in machine coordinates, so that 0 <= position <= travel once the stage
is homed; the limit switch is at 0 if $23 is 1, else at the other end. Moves are given in machine coordinates (G53), so
that work offsets left in the controller change nothing. Without homing ($22=0) positions count from where the
controller was started.

Grbl counts the pulses that it sends to the motor; it measures nothing. A position that differs from the target means
that a command or pulses were lost before the motor. Steps that the motor itself loses show only when the limit switch
is found pressed away from its place, which every move checks, or in the pictures: return to the first position and
compare.

When the laser goes off:

- the ``with`` ends, normally or by an exception, Ctrl-C included: Ctrl-X, whose answer is awaited. Grbl's receiving
  interrupt obeys it, so it works while the controller moves, waits or is locked;
- a fault is found: Ctrl-X before the error is raised;
- the program is killed (SIGTERM, SIGKILL), crashes or ends without closing, is suspended or hangs: `laser_guard`, a
  process of its own, sends the Ctrl-X. It expects to hear of the program while the laser is on: every exchange with the
  controller is heard, and longer waits are announced by `GrblStage.keep_lit`;
- program and guard are killed, or the computer freezes, during an image of a scan: the controller comes to the M5 that
  it has been sent with the M3, behind a dwell (``at_most_s``);
- the guard is gone: the driver finds out at the next exchange, or `keep_lit`, and sends the Ctrl-X;
- the cable is pulled out: the Uno, fed by it, loses its power and the pull-down at the laser's transistor does the
  rest. Grbl has no watchdog and no setting replaces one; an Uno with a supply of its own keeps the laser lit;
- the controller itself hangs: only hardware helps, see docs/how-to/hardware-stage.md;
- program and guard are killed while the laser is on without ``at_most_s``: only hardware helps. The Uno's reset through
  DTR does not: it comes when the port is *opened*, not closed;
- the controller restarts for any reason, the next opening of the port included: Grbl starts with the pin off.
"""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Self

from uwlts.errors import HardwareError, RangeError
from uwlts.hardware.grbl_line import FEED_HOLD, POLL_S, GrblLine, Status, parse_settings

# A stage that moves by less than a step in this time, and in that of some steps, stands still.
_STALL_S, _STALL_STEPS = 1.0, 5
# Time allowed for a movement: this factor of the computed time, plus the time to answer.
_MARGIN, _MARGIN_S = 1.5, 2.0
# The offset comes with every 10th report at rest and every 30th in motion.
_REPORTS_TO_OFFSET = 31
# A limit switch opens this far from where it closes.
_PIN_MARGIN_MM = 0.5


@dataclass(frozen=True)
class StageReport:
    """Position in mm that a controller reported between two moments, in s by the clock of `time.monotonic`."""

    asked_s: float
    answered_s: float
    position_mm: float


class GrblStage:
    """A stage, open from construction on; a context manager that leaves the laser off. Not safe between threads.

    ``port`` is a serial port such as /dev/ttyACM0; ``boot_s`` is how long a controller that restarts when the port is
    opened may take. Attributes are the ``settings`` as ``$$`` reports them, Grbl's ``version``, and ``limits_mm``, the
    lowest and the highest position. HardwareError where the port cannot be opened, nothing answers, or not a Grbl 1.1
    that can do this.
    """

    def __init__(self, port: str, *, baud: int = 115200, boot_s: float = 2.5):
        self._line = GrblLine(port, baud=baud, boot_s=boot_s)
        self._power, self._timed_speed, self._held = 0.0, 0.0, False
        try:
            self.port, self.version = port, self._line.version
            self.settings = parse_settings(self._line.settings())
            options, travel = self._line.options(), self.settings.travel_mm
            if "V" not in options:
                raise HardwareError(
                    f"this Grbl's options are {options!r}, without V: the laser needs a firmware with variable spindle"
                )
            zero_at_low_end = "Z" in options and self.settings.homes_to_negative
            self._origin_mm = -travel if self.settings.homing and not zero_at_low_end else 0.0
            self.limits_mm = (0.0, travel) if self.settings.homing else (-travel, travel)
            # Locked at the start: homing is enabled and has not been done. A board whose reset is disabled keeps it.
            self._position_known = self._line.status().state != "Alarm"
        except BaseException as error:
            self._line.close(error)
            raise

    @property
    def position_known(self) -> bool:
        """Whether the stage may move: it is homed or unlocked, and no fault came since."""
        return self._position_known and self._line.fault is None

    @property
    def faulty(self) -> bool:
        """Whether a fault has ended all movements, and switched the laser off, until `home` or `unlock`."""
        return self._line.fault is not None

    @property
    def laser_power(self) -> float:
        """Power last set, 0 when off."""
        return 0.0 if self._line.fault else self._power

    def home(self) -> float:
        """Find the limit switch and return the position read back in mm; ends a fault. The laser goes off.

        HardwareError where homing is disabled, fails, or takes too long, and for every other fault.
        """
        settings = self.settings
        if not settings.homing:
            raise HardwareError("homing is disabled ($22=0): wire the limit switch and send $22=1, or use unlock")
        self._recover()
        if self._power:
            self.laser(False)
        seek, feed = settings.homing_seek_mm_per_min / 60, settings.homing_feed_mm_per_min / 60
        pull_off = settings.homing_pull_off_mm
        # Grbl seeks over 1.5 times the travel and then, twice the pull-off at the seek rate, 5 times it at the feed.
        longest_s = (1.5 * settings.travel_mm + 2 * pull_off) / seek + 5 * pull_off / feed
        longest_s += 4 * (settings.homing_debounce_ms / 1000 + seek / settings.acceleration_mm_per_s2)
        self._position_known = False
        # No status queries: Grbl does not answer them while it homes.
        self._line.command("$H", timeout_s=_MARGIN * longest_s + _MARGIN_S)
        self._position_known = True
        return self.position_mm()

    def unlock(self) -> float:
        """End an alarm, a hold or a fault, taking the controller's position for true, and return that in mm.

        Right where nothing moved (noise on the line at rest, a soft limit) or where there is no limit switch.
        """
        self._recover()
        self._line.command("$X")
        self._position_known = True
        return self.position_mm()

    def _recover(self) -> None:
        line = self._line
        if line.fault is None and not self._held and not line.darkened_by_hand:
            return
        self._position_known = self._position_known and line.fault is None and not line.darkened_by_hand
        self._power, self._timed_speed, self._held = 0.0, 0.0, False
        self._line.restart()
        # A reset that met a movement leaves an alarm behind.
        self._position_known = self._position_known and self._line.status().state != "Alarm"

    def move_to(
        self,
        position_mm: float,
        *,
        feed_mm_per_min: float,
        reported: Callable[[StageReport], None] = lambda report: None,
    ) -> float:
        """Move, wait until the stage rests, and return the position read back in mm.

        ``reported`` is called with every position that the controller reports meanwhile, about ten times a second.

        RangeError where the target lies outside the travel, or the feed outside what the stage can do; nothing has
        moved then. HardwareError where the position is not known, and for every fault: alarm, stall, hold, lost steps,
        restart, silence, noise, lost line.
        """
        low, high = self.limits_mm
        if not low <= position_mm <= high:
            raise RangeError(f"{position_mm:g} mm is outside the stage's travel of {low:g} to {high:g} mm")
        fastest = self.settings.max_feed_mm_per_min
        if not 0 < feed_mm_per_min <= fastest:
            raise RangeError(f"the feed {feed_mm_per_min:g} mm/min is not above 0 and up to {fastest:g} mm/min ($110)")
        if self._held:
            raise HardwareError("the stage is held since it was stopped: unlock or home it")
        if not self._position_known and self._line.fault is None:
            raise HardwareError("the stage does not know where it is: home it first")
        start_mm = self.position_mm()
        feed_mm_s = feed_mm_per_min / 60
        # Distance at full speed plus a ramp up and one down: never less than the real time, however short the way.
        expected_s = abs(position_mm - start_mm) / feed_mm_s + feed_mm_s / self.settings.acceleration_mm_per_s2
        self._line.command(f"G21G90G94G53G1X{self._origin_mm + position_mm:.4f}F{feed_mm_per_min:.2f}")
        in_motion = self._motion_watch(start_mm, feed_mm_s)

        def watch(report: Status) -> None:
            in_motion(report)
            if report.machine_mm is not None or report.work_mm is not None:
                line = self._line
                reported(StageReport(line.asked_s, line.answered_s, self._position_of(report)))

        # A dwell is acknowledged when all movements before it are done.
        self._line.command("G4P0.01", timeout_s=_MARGIN * expected_s + _MARGIN_S, watch=watch)
        reached_mm = self._rest()
        missing = round((reached_mm - position_mm) * self.settings.steps_per_mm)
        if abs(missing) > 1:
            raise self._line.failed(
                f"missed steps: {reached_mm:.3f} mm read back where {position_mm:.3f} mm was asked for, {missing:+d} "
                "steps; a command or pulses were lost: check the wiring for interference, then home"
            )
        return reached_mm

    def _motion_watch(self, start_mm: float, feed_mm_s: float) -> Callable[[Status], None]:
        """Check of a movement's status reports for a stall and for states in which it will not end."""
        last_mm, since = start_mm, time.monotonic()
        patience_s = _STALL_S + _STALL_STEPS * self.settings.step_mm / feed_mm_s

        def check(report: Status) -> None:
            nonlocal last_mm, since
            self._refuse_stop(report)
            position_mm, now = self._position_of(report), time.monotonic()
            if report.state != "Run" or not math.isclose(position_mm, last_mm, abs_tol=1e-9):
                last_mm, since = position_mm, now
            elif now - since > patience_s:
                raise self._line.failed(
                    f"stall: the stage has stood at {position_mm:.3f} mm for {now - since:.1f} s although the "
                    "controller says it runs: restart the controller, then home"
                )

        return check

    def _rest(self) -> float:
        """Wait until the controller says Idle and return the position."""
        deadline = time.monotonic() + _MARGIN_S
        while (report := self._line.status()).state != "Idle":
            self._refuse_stop(report)
            if time.monotonic() > deadline:
                raise self._line.failed(
                    f"the controller is in the state {report.state} although its movements are done"
                )
            time.sleep(POLL_S / 5)
        return self._position_of(report)

    def position_mm(self) -> float:
        """Position in mm as the controller counts it."""
        return self._position_of(self._line.status())

    def _position_of(self, report: Status) -> float:
        for _ in range(_REPORTS_TO_OFFSET):
            machine_mm = report.machine_mm
            if machine_mm is None and report.work_mm is not None and self._line.offset_mm is not None:
                machine_mm = report.work_mm + self._line.offset_mm
            if machine_mm is not None:
                # The report is rounded to 1 um; what the controller counts is steps.
                return round(machine_mm * self.settings.steps_per_mm) / self.settings.steps_per_mm - self._origin_mm
            report = self._line.status()
        raise self._line.failed("work positions without their offset (WCO) are reported: send $10=1")

    def _refuse_stop(self, report: Status) -> None:
        """Raise for a state in which a movement will not end, and for a switch pressed where it should not be."""
        advice = {
            "Hold": "feed hold: its button was pressed, or noise on the line or on A1 was taken for it; home or unlock",
            "Door": "the safety door is open: close it, then home or unlock",
            "Alarm": "locked by an alarm: home",
            "Sleep": "asleep: home",
            "Check": "in check mode, in which nothing moves: send $C",
            "Jog": "jogging",
        }
        if report.state in advice:
            raise self._line.failed(f"the controller has stopped: {advice[report.state]}")
        if not self.settings.homing or "X" not in report.pins:
            return
        position_mm = self._position_of(report)
        switch_mm = 0.0 if self.settings.homes_to_negative else self.settings.travel_mm
        if abs(position_mm - switch_mm) > self.settings.homing_pull_off_mm + _PIN_MARGIN_MM:
            raise self._line.failed(
                f"missed steps: the limit switch at {switch_mm:g} mm is pressed where {position_mm:.3f} mm is counted: "
                "the motor lost steps (feed or acceleration too high, or something is in the way); home"
            )

    def laser(self, on: bool, *, power: float = 1.0, at_most_s: float | None = None) -> None:
        """Switch the laser at once and see that the controller says so; only the camera can show whether it is lit.

        ``power``, 0 < power <= 1, is the share of the time in which the pin is on: below 1 it is pulsed at some kHz.
        RangeError where it is outside this range; HardwareError where the controller is locked or does not follow, the
        guard process is gone or has switched the laser off, and for every other fault.

        With ``at_most_s`` the controller itself switches it off after this time, even if nothing is left that could
        tell it to: the lines that do so are with it before the laser is lit. It does nothing else until the laser is
        switched off.

        While it is on, call something of the stage at least every half second, or `keep_lit` before: the guard switches
        the laser off otherwise.
        """
        if not 0 < power <= 1:
            raise RangeError(f"the laser's power {power:g} is not above 0 and up to 1")
        if not on:
            # The fault has switched it off already.
            if self._line.fault is not None:
                return
            if self._timed_speed:
                # Sees that it was on all the time; the reset would hide a hold, or that the time was over.
                self._line.keep_lit()
                self._see_spindle(self._timed_speed)
                self._line.end()
            else:
                self._line.command("M5")
            self._power = self._timed_speed = 0.0
            self._see_spindle(0.0)
            self._line.darkened()
            return
        self._line.keep_lit()
        speed = max(1, round(power * self.settings.spindle_max))
        # In laser mode ($32=1) the pin stays off under G0, the mode after every reset; G1 needs a feed to be accepted.
        self._line.command(f"G21G90G94G1F{min(100.0, self.settings.max_feed_mm_per_min):.2f}")
        self._power = power
        if at_most_s is None:
            self._line.command(f"M3S{speed}")
        else:
            self._timed_speed = float(speed)
            self._line.begin(f"M3S{speed}", f"G4P{at_most_s:.2f}", "M5")
        self._see_spindle(float(speed))

    def keep_lit(self, wait_s: float = 0.0) -> None:
        """Announce that ``wait_s`` may pass without a call while the laser is on; then the guard switches it off.

        To be called again and again while something is waited for. HardwareError where the guard is gone, or has
        switched the laser off already.
        """
        if self.laser_power:
            self._line.keep_lit(wait_s)

    def _see_spindle(self, expected: float) -> None:
        report = self._line.status()
        self._refuse_stop(report)
        if report.spindle is not None and abs(report.spindle - expected) > 1:
            raise self._line.failed(
                f"the laser's pin does not follow: S{report.spindle:g} is reported where S{expected:g} was sent "
                f"(state {report.state}): a hold, an override of the spindle, $31 above it, or its time is over"
            )

    def stop(self, *, reset: bool = False) -> float:
        """Brake to a rest by a feed hold and return the position in mm.

        Without ``reset`` the controller stays held until `unlock` or `home`, and the laser stays as it is unless $32=1,
        with which Grbl switches it off. With ``reset`` the laser goes off and the stage can move again. The position
        is kept, because nothing moves at the reset.
        """
        self._line.realtime(FEED_HOLD)
        braking_s = self.settings.max_feed_mm_per_min / 60 / self.settings.acceleration_mm_per_s2
        deadline = time.monotonic() + _MARGIN * braking_s + _MARGIN_S
        # Hold:1 brakes, Hold:0 has come to rest.
        while (report := self._line.status()).state in ("Run", "Hold", "Jog") and report.substate != 0:
            if time.monotonic() > deadline:
                raise self._line.failed(f"the stage does not stop on a feed hold, its state is {report.state}")
            time.sleep(POLL_S / 5)
        self._held = True
        if reset:
            self._recover()
        return self.position_mm()

    @property
    def descriptor(self) -> int:
        """The open serial port, to lend it to another process that switches the laser off by Ctrl-X."""
        return self._line.descriptor

    @property
    def laser_unreachable(self) -> bool:
        """Whether the last command to switch the laser off could not be sent."""
        return self._line.unreachable

    def darken(self) -> bool:
        """Switch the laser off from any thread, whatever the stage does: by Ctrl-X, which also stops a movement.

        Returns whether the command could be sent. What is under way fails at its next exchange with the controller;
        then `unlock` where nothing moved, or `home`.
        """
        return self._line.darken()

    def close(self, error: BaseException | None = None) -> None:
        """Switch the laser off and close the port; HardwareError where the controller does not confirm."""
        self._line.close(error)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        self.close(error)
