"""The stage and the laser: a Grbl 1.1 controller that moves one axis and switches the laser by its spindle pin.

Positions are in mm from the lower end of travel in machine coordinates, so that 0 <= position <= travel once the stage
is homed; the limit switch is at 0 if $23 is 1, else at the other end. Moves are given in machine coordinates (G53), so
that work offsets left in the controller change nothing. Without homing ($22=0) positions count from where the
controller was started.

Grbl counts the pulses that it sends to the motor; it measures nothing. A position that differs from the target means
that a command or pulses were lost before the motor. Steps that the motor itself loses show only when the limit switch
is found pressed away from its place, which every move checks, or in the pictures: return to the first position and
compare.

The controller itself ends the light, whatever becomes of the computer. At rest it has the dwell and the M5 that end the
light before it lights the laser; light that shall last is renewed by `GrblStage.keep_lit`. On the way, in `sweep`, the
laser is lit by M4, which Grbl's laser mode darkens at rest, and the controller knows of the next part of the way alone.

The laser goes off sooner:

- the ``with`` ends, normally or by an exception, Ctrl-C included: Ctrl-X, whose answer is awaited. Grbl's receiving
  interrupt obeys it, so it works while the controller moves, waits or is locked;
- a fault is found: Ctrl-X before the error is raised;
- the program is killed (SIGTERM, SIGKILL), crashes or ends without closing, is suspended or hangs: `laser_guard`, a
  process of its own, sends the Ctrl-X. It expects to hear of the program while the laser is on: every exchange with the
  controller is heard, and longer waits are announced by `GrblStage.keep_lit`;
- the guard is gone: the driver finds out at the next exchange, or `keep_lit`, and sends the Ctrl-X;
- the cable is pulled out: the Uno, fed by it, loses its power and the pull-down at the laser's transistor does the
  rest;
- the controller restarts for any reason, the next opening of the port included: Grbl starts with the pin off.

Where the controller itself hangs only hardware helps, see docs/how-to/hardware-stage.md.
"""

import math
import time
from collections.abc import Callable
from contextlib import suppress
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
LIVE_S = 0.4
"""Dwell of a light that is renewed. Two are with the controller at most, so that the light ends within 0.9 s; and one
at least after a call of `GrblStage.keep_lit`, which may take half a second to come again, as the guard allows 0.8 s."""
_LIGHTS_S = 0.3
"""The controller lights the laser within some ms after it got the command."""
_SWEEP_S = 0.9
"""A stage that gets no further part of its way comes to rest, and darkens the laser, in this time."""
_LAG_S = 0.3
"""Way at full speed that is left to it where the next part comes as late as a report and a busy computer allow."""
_FULL = 0.9
"""Share of the power that shows that the laser follows, as the speed is reported rounded."""


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
        self._power, self._held = 0.0, False
        self._lighting: tuple[str, ...] = ()
        self.lit_until_s = -math.inf
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
        self._forget_light()
        self._held = False
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
        start_mm = self._start_of(position_mm, feed_mm_per_min)
        self._go(position_mm, feed_mm_per_min)
        in_motion = self._motion_watch(start_mm, feed_mm_per_min / 60)

        def watch(report: Status) -> None:
            in_motion(report)
            if report.machine_mm is not None or report.work_mm is not None:
                line = self._line
                reported(StageReport(line.asked_s, line.answered_s, self._position_of(report)))

        return self._arrive(position_mm, position_mm - start_mm, feed_mm_per_min, watch)

    @property
    def fastest_sweep_mm_per_s(self) -> float:
        """Highest speed of `sweep`: faster, the stage takes too long to come to rest by itself."""
        # With the ramps it rests in _SWEEP_S from a way that suffices to brake, and _LAG_S more.
        return (_SWEEP_S - _LAG_S) / 1.5 * self.settings.acceleration_mm_per_s2

    def sweep(
        self,
        position_mm: float,
        *,
        feed_mm_per_min: float,
        power: float = 1.0,
        reported: Callable[[StageReport], None] = lambda report: None,
    ) -> float:
        """Move as `move_to` does, with the laser on while the stage moves; below its full speed the light is weaker.

        The controller gets the way part by part: where this program stops, the stage comes to rest and the laser goes
        off within a second. Whatever ``reported`` raises brakes the stage, which is held then as by `stop`.

        RangeError, HardwareError as by `move_to` and `laser`. HardwareError also where the next part came too late for
        a constant speed.
        """
        speed = self._speed_of(power)
        start_mm, feed_mm_s = self._start_of(position_mm, feed_mm_per_min), feed_mm_per_min / 60
        if feed_mm_s > (fastest := self.fastest_sweep_mm_per_s):
            raise RangeError(
                f"{feed_mm_s:g} mm/s is too fast for a laser that is lit on the way: at most {fastest:.3g} mm/s, from "
                "which the stage comes to rest by itself in time ($120)"
            )
        ramp_s = feed_mm_s / self.settings.acceleration_mm_per_s2
        ahead_mm = math.copysign(feed_mm_s * (_SWEEP_S - ramp_s), position_mm - start_mm)
        at_mm = sent_mm = start_mm
        brightest = 0.0
        in_motion = self._motion_watch(start_mm, feed_mm_s)

        def hear(report: Status) -> None:
            nonlocal at_mm, brightest
            in_motion(report)
            at_mm = self._position_of(report)
            brightest = max(brightest, speed if report.spindle is None else report.spindle)
            reported(StageReport(self._line.asked_s, self._line.answered_s, at_mm))

        self._line.keep_lit()
        self._power = power
        try:
            # Dark until the stage moves; G1 needs a feed to be accepted.
            self._line.command(f"G21G90G94G1F{feed_mm_per_min:.2f}M4S{speed}")
            while sent_mm != position_mm:
                to_mm = at_mm + ahead_mm
                if abs(to_mm - start_mm) >= abs(position_mm - start_mm):
                    to_mm = position_mm
                if abs(to_mm - start_mm) > abs(sent_mm - start_mm):
                    self._go(to_mm, feed_mm_per_min)
                    since_s = time.monotonic() - self._line.asked_s
                    if sent_mm != start_mm and abs(sent_mm - at_mm) < feed_mm_s * (since_s + ramp_s / 2):
                        raise self._line.failed(
                            f"the stage slowed down near {sent_mm:.2f} mm, as this program was too late to send the "
                            "next part of its way: the computer is too busy"
                        )
                    sent_mm = to_mm
                time.sleep(POLL_S)
                hear(self._line.status())
            reached_mm = self._arrive(position_mm, position_mm - at_mm, feed_mm_per_min, hear)
        except BaseException:
            with suppress(HardwareError):
                self._line.realtime(FEED_HOLD)
            # A fault has stopped it otherwise.
            self._held = not self.faulty
            raise
        reaches_speed = abs(position_mm - start_mm) > feed_mm_s * (ramp_s + 3 * POLL_S)
        if reaches_speed and brightest < _FULL * speed:
            raise self._line.failed(
                f"the laser's pin does not follow: at most S{brightest:g} is reported where S{speed} was sent: an "
                "override of the spindle, or $31 above it"
            )
        self.laser(False)
        return reached_mm

    def _start_of(self, position_mm: float, feed_mm_per_min: float) -> float:
        """Position in mm from which a movement begins; its errors as of `move_to`."""
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
        if self.laser_power:
            raise HardwareError("the laser is on: switch it off before moving, or use sweep")
        return self.position_mm()

    def _go(self, position_mm: float, feed_mm_per_min: float) -> None:
        self._line.command(f"G21G90G94G53G1X{self._origin_mm + position_mm:.4f}F{feed_mm_per_min:.2f}")

    def _arrive(
        self, position_mm: float, way_mm: float, feed_mm_per_min: float, watch: Callable[[Status], None]
    ) -> float:
        """Wait until the stage rests at the end of a way, and return the position read back in mm."""
        feed_mm_s = feed_mm_per_min / 60
        # Distance at full speed plus a ramp up and one down: never less than the real time, however short the way.
        expected_s = abs(way_mm) / feed_mm_s + feed_mm_s / self.settings.acceleration_mm_per_s2
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
        """Switch the laser at rest and see that the controller says so; only the camera can show whether it is lit.

        ``power``, 0 < power <= 1, is the share of the time in which the pin is on: below 1 it is pulsed at some kHz.
        RangeError where it is outside this range; HardwareError where the controller is locked or does not follow, the
        guard process is gone or has switched the laser off, and for every other fault.

        The controller itself switches it off after ``at_most_s``, in whole steps of 0.05 s, even if nothing is left
        that could tell it to: the lines that do so are with it before the laser is lit. Without ``at_most_s`` it does
        so within 0.9 s after the last call of `keep_lit`, which has to come every half second.

        Until the laser is switched off the stage cannot move. The guard, too, switches it off if nothing of the stage
        is called for more than half a second, unless `keep_lit` was told so.
        """
        speed = self._speed_of(power)
        # A fault has switched it off already.
        if self._line.fault is not None and not on:
            return
        if self._lighting:
            self._line.keep_lit()
            report = self._line.status()
            self._refuse_stop(report)
            # Light that ended before its time, and a hold, would be hidden by the reset. One that is renewed blinks.
            if self._line.answered_s < self.lit_until_s < math.inf:
                self._require_spindle(report, self._power)
            self._line.end()
        elif not on:
            self._line.command("M5")
        if not on or self._lighting:
            self._forget_light()
            self._see_spindle(0.0)
            self._line.darkened()
        if not on:
            return
        self._line.keep_lit()
        # In laser mode the pin stays off under G0, the mode after every reset; G1 needs a feed to be accepted.
        self._line.command(f"G21G90G94G1F{min(100.0, self.settings.max_feed_mm_per_min):.2f}")
        self._power = power
        dwell_s = LIVE_S if at_most_s is None else at_most_s
        # Two lines, not three: a line that is cut off between them would keep the laser lit.
        self._lighting = f"M3S{speed}G4P{dwell_s:.3f}", "M5"
        self.lit_until_s = time.monotonic() + dwell_s
        self._line.begin(*self._lighting)
        self._see_spindle(power)
        if at_most_s is None:
            self.lit_until_s = math.inf
            self.keep_lit()

    def _speed_of(self, power: float) -> int:
        """The S word of a power; RangeError, HardwareError where it cannot be set."""
        if not 0 < power <= 1:
            raise RangeError(f"the laser's power {power:g} is not above 0 and up to 1")
        if not self.settings.laser_mode:
            raise HardwareError("laser mode is off ($32=0): a hold would keep the laser lit; send $32=1")
        return max(1, round(power * self.settings.spindle_max))

    def _forget_light(self) -> None:
        self._power, self._lighting, self.lit_until_s = 0.0, (), -math.inf

    def keep_lit(self, wait_s: float = 0.0) -> None:
        """Announce that ``wait_s`` may pass without a call while the laser is on; then the guard switches it off.

        To be called again and again while something is waited for, every half second for a laser that is lit without
        ``at_most_s``, as this renews its light. HardwareError where the guard is gone, or has switched the laser off
        already, or the controller does not answer.
        """
        if not self.laser_power:
            return
        self._line.keep_lit(wait_s)
        if self.lit_until_s == math.inf:
            self._refuse_stop(self._line.status())
            # The last light has begun.
            if self._line.unacknowledged <= len(self._lighting):
                self._line.begin(*self._lighting)

    def _see_spindle(self, power: float) -> None:
        """See that the pin is as expected, for which the controller may take some ms."""
        deadline = time.monotonic() + _LIGHTS_S
        while not self._follows(report := self._line.status(), power) and time.monotonic() < deadline:
            time.sleep(POLL_S / 20)
        self._require_spindle(report, power)

    def _follows(self, report: Status, power: float) -> bool:
        return report.spindle is None or abs(report.spindle - power * self.settings.spindle_max) <= 1

    def _require_spindle(self, report: Status, power: float) -> None:
        self._refuse_stop(report)
        if not self._follows(report, power):
            raise self._line.failed(
                f"the laser's pin does not follow: S{report.spindle:g} is reported where "
                f"S{power * self.settings.spindle_max:g} was sent (state {report.state}): a hold, an override of the "
                "spindle, or $31 above it"
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
