"""Stage and laser: a Grbl 1.1 controller that moves one axis and switches the laser by its spindle pin.

Positions are in mm from the lower end of travel in machine coordinates, so that 0 <= position <= travel once the stage
is homed. The limit switch is at 0 if $23 is 1, else at the other end. Moves are given in machine coordinates (G53), so
that work offsets left in the controller have no effect. Without homing ($22=0) positions count from the place where the
controller was started.

Grbl counts the pulses that it sends to the motor; it measures nothing. If the position read back differs from the
target, a command or pulses were lost before the motor. Steps lost by the motor itself show in two ways: the limit
switch is pressed away from its place, which every move checks, or the image at the first position has changed.

The controller itself ends the light, even if the computer fails. At rest it receives the dwell and the M5 that end the
light together with the command that starts it; `GrblStage.keep_lit` renews a light that shall last. In motion
(`sweep`) the laser is on by M4, which Grbl's laser mode switches off at rest, and the controller knows only the next
part of the travel.

docs/explanation/laser-control.md lists what switches the laser off earlier: the end of the ``with`` block, every fault,
the guard process, and the controller itself.
"""

import math
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass

from uwlts.errors import HardwareError, RangeError
from uwlts.hardware.grbl_line import FEED_HOLD, POLL_S, GrblLine, Status, parse_settings

# A stage that moves by less than a step in this time, plus the time of some steps, is stalled.
_STALL_S, _STALL_STEPS = 1.0, 5
# Time limit of a movement: this factor of the computed time, plus the time to answer.
_MARGIN, _MARGIN_S = 1.5, 2.0
# The work offset is sent with every 10th report at rest and every 30th in motion.
_REPORTS_TO_OFFSET = 31
# Hysteresis of the limit switch.
_PIN_MARGIN_MM = 0.5
LIVE_S = 0.4
"""Dwell of a renewed light. The controller holds at most two, so that the light ends within 0.9 s. It holds at least
one after a call of `GrblStage.keep_lit`, whose interval may be half a second, as the guard allows 0.8 s."""
_LIGHTS_S = 0.3  # time limit of the controller to switch the laser, which takes a few ms
_SWEEP_S = 0.9
"""Time within which a stage that receives no further part of its travel comes to rest and switches the laser off."""
_LAG_S = 0.3  # travel time at full speed that remains if the next part is delayed by a report and a busy computer
_FULL = 0.9  # fraction of the set power that counts as reached, because the reported speed is rounded


@dataclass(frozen=True)
class StageReport:
    """Position reported by the controller between two moments of the clock `time.monotonic`."""

    asked_s: float
    answered_s: float
    position_mm: float


class GrblAxis(GrblLine):
    """Movements of one axis: positions, limits, and checks of what the controller reports of axis and laser.

    ``settings`` are those reported by ``$$``, and ``limits_mm`` are the lowest and highest position. Raises
    HardwareError as `GrblLine`, or if the firmware has no variable spindle.
    """

    def __init__(self, port: str, *, boot_s: float = 2.5):
        super().__init__(port, boot_s=boot_s)
        try:
            self.settings = parse_settings(self.read_settings())
            options, travel = self.options(), self.settings.travel_mm
            if "V" not in options:
                raise HardwareError(
                    f"this Grbl's options are {options!r}, without V: the laser needs a firmware with variable spindle"
                )
            zero_at_low_end = "Z" in options and self.settings.homes_to_negative
            self._origin_mm = -travel if self.settings.homing and not zero_at_low_end else 0.0
            self.limits_mm = (0.0, travel) if self.settings.homing else (-travel, travel)
            # A controller with homing is locked until it is homed. A board whose reset is disabled keeps its position.
            self._position_known = self.status().state != "Alarm"
        except BaseException as error:
            self.close(error)
            raise

    @property
    def position_known(self) -> bool:
        """True if the stage may move: it was homed or unlocked, and no fault occurred since."""
        return self._position_known and self.fault is None

    @property
    def faulty(self) -> bool:
        """True if a fault has stopped all movements and switched the laser off, until `GrblStage.home` or `unlock`."""
        return self.fault is not None

    @property
    def fastest_sweep_mm_per_s(self) -> float:
        """Highest speed of `GrblStage.sweep`: at a higher one the stage takes too long to stop by itself."""
        # Including the ramps the stage stops within _SWEEP_S from a distance that suffices to brake, plus _LAG_S.
        return (_SWEEP_S - _LAG_S) / 1.5 * self.settings.acceleration_mm_per_s2

    def position_mm(self) -> float:
        """Position in mm as the controller counts it."""
        return self._read_position(self.status())

    def _go(self, position_mm: float, feed_mm_per_min: float) -> None:
        self.command(f"G21G90G94G53G1X{self._origin_mm + position_mm:.4f}F{feed_mm_per_min:.2f}")

    def _arrive(
        self, position_mm: float, way_mm: float, feed_mm_per_min: float, watch: Callable[[Status], None]
    ) -> float:
        """Wait until the stage is at rest at the end of its travel, and return the position read back in mm."""
        feed_mm_s = feed_mm_per_min / 60
        # Distance at full speed plus two ramps: never less than the real time, however short the distance.
        expected_s = abs(way_mm) / feed_mm_s + feed_mm_s / self.settings.acceleration_mm_per_s2
        # Grbl acknowledges a dwell when all earlier movements are done.
        self.command("G4P0.01", timeout_s=_MARGIN * expected_s + _MARGIN_S, watch=watch)
        reached_mm = self._await_rest()
        missing = round((reached_mm - position_mm) * self.settings.steps_per_mm)
        if abs(missing) > 1:
            raise self.stop_and_make_error(
                f"missed steps: the position is {reached_mm:.3f} mm where {position_mm:.3f} mm was requested, "
                f"{missing:+d} steps; a command or pulses were lost: check the wiring for interference, then home"
            )
        return reached_mm

    def _make_motion_watch(self, start_mm: float, feed_mm_s: float) -> Callable[[Status], None]:
        """Return a check of status reports during a movement, for a stall and for states that never end."""
        last_mm, since = start_mm, time.monotonic()
        patience_s = _STALL_S + _STALL_STEPS / self.settings.steps_per_mm / feed_mm_s

        def check(report: Status) -> None:
            nonlocal last_mm, since
            self._refuse_stop(report)
            position_mm, now = self._read_position(report), time.monotonic()
            if report.state != "Run" or not math.isclose(position_mm, last_mm, abs_tol=1e-9):
                last_mm, since = position_mm, now
            elif now - since > patience_s:
                raise self.stop_and_make_error(
                    f"stall: the stage has been at {position_mm:.3f} mm for {now - since:.1f} s although the "
                    "controller reports that it runs: restart the controller, then home"
                )

        return check

    def _await_rest(self) -> float:
        """Wait until the controller reports Idle, and return the position in mm."""
        deadline = time.monotonic() + _MARGIN_S
        while (report := self.status()).state != "Idle":
            self._refuse_stop(report)
            if time.monotonic() > deadline:
                raise self.stop_and_make_error(
                    f"the controller is in the state {report.state} although its movements are done"
                )
            time.sleep(POLL_S / 5)
        return self._read_position(report)

    def _read_position(self, report: Status) -> float:
        for _ in range(_REPORTS_TO_OFFSET):
            machine_mm = report.machine_mm
            if machine_mm is None and report.work_mm is not None and self.offset_mm is not None:
                machine_mm = report.work_mm + self.offset_mm
            if machine_mm is not None:
                # The report is rounded to 1 um; the controller counts steps.
                return round(machine_mm * self.settings.steps_per_mm) / self.settings.steps_per_mm - self._origin_mm
            report = self.status()
        raise self.stop_and_make_error("work positions are reported without their offset (WCO): send $10=1")

    def _refuse_stop(self, report: Status) -> None:
        """Raise HardwareError if the movement cannot end in this state, or the limit switch is pressed elsewhere."""
        advice = {
            "Hold": "feed hold: its button was pressed, or there was noise on the line or on A1; home or unlock",
            "Door": "the safety door is open: close it, then home or unlock",
            # The greeting after a restart is taken for the answer to a reset that was sent at the same moment.
            "Alarm": "locked by an alarm, or because it restarted by itself: home",
            "Sleep": "asleep: home",
            "Check": "in check mode, without movements: send $C",
            "Jog": "jogging",
        }
        if report.state in advice:
            raise self.stop_and_make_error(f"the controller has stopped: {advice[report.state]}")
        if not self.settings.homing or "X" not in report.pins:
            return
        position_mm = self._read_position(report)
        switch_mm = 0.0 if self.settings.homes_to_negative else self.settings.travel_mm
        if abs(position_mm - switch_mm) > self.settings.homing_pull_off_mm + _PIN_MARGIN_MM:
            raise self.stop_and_make_error(
                f"missed steps: the limit switch at {switch_mm:g} mm is pressed at the position {position_mm:.3f} mm: "
                "the motor lost steps (feed or acceleration too high, or an obstacle); home"
            )

    def _convert_power(self, power: float) -> int:
        """Return the S word for a power; raises RangeError or HardwareError if it cannot be set."""
        if not 0 < power <= 1:
            raise RangeError(f"the laser's power is {power:g}; expected above 0 and up to 1")
        if not self.settings.laser_mode:
            raise HardwareError("laser mode is off ($32=0), so that a hold would keep the laser on: send $32=1")
        return max(1, round(power * self.settings.spindle_max))

    def _follows(self, report: Status, power: float) -> bool:
        return report.spindle is None or abs(report.spindle - power * self.settings.spindle_max) <= 1

    def _require_spindle(self, report: Status, power: float) -> None:
        self._refuse_stop(report)
        if not self._follows(report, power):
            raise self.stop_and_make_error(
                f"the laser's pin does not follow: S{report.spindle:g} is reported, "
                f"S{power * self.settings.spindle_max:g} was sent (state {report.state}): a hold, a spindle override, "
                "or $31 above it"
            )


class GrblStage(GrblAxis):
    """A stage that is open after construction; a context manager that leaves the laser off. Not thread-safe.

    Only `darken` may be called from other threads. ``boot_s`` is the longest start-up time of a controller that
    restarts when the port, such as /dev/ttyACM0, is opened. ``version`` is that of Grbl.

    Raises HardwareError if the port cannot be opened, nothing answers, or the controller is not a Grbl 1.1 with
    variable spindle.
    """

    def __init__(self, port: str, *, boot_s: float = 2.5):
        self._power, self._held = 0.0, False
        self._lighting: tuple[str, ...] = ()
        self.lit_until_s = -math.inf
        super().__init__(port, boot_s=boot_s)

    @property
    def laser_power(self) -> float:
        """Power set last; 0 if the laser is off."""
        return 0.0 if self.fault else self._power

    def home(self) -> float:
        """Home the stage and return its position in mm; clears a fault and switches the laser off.

        Raises HardwareError if homing is disabled, fails or takes too long, and for all other faults.
        """
        settings = self.settings
        if not settings.homing:
            raise HardwareError("homing is disabled ($22=0): wire the limit switch and send $22=1, or use unlock")
        self._recover()
        if self._power:
            self.laser(False)
        seek, feed = settings.homing_seek_mm_per_min / 60, settings.homing_feed_mm_per_min / 60
        pull_off = settings.homing_pull_off_mm
        # Grbl seeks over 1.5 times the travel, then over twice the pull-off at the seek rate and 5 times at the feed
        # rate.
        longest_s = (1.5 * settings.travel_mm + 2 * pull_off) / seek + 5 * pull_off / feed
        longest_s += 4 * (settings.homing_debounce_ms / 1000 + seek / settings.acceleration_mm_per_s2)
        self._position_known = False
        # No status queries: Grbl does not answer them during homing.
        self.command("$H", timeout_s=_MARGIN * longest_s + _MARGIN_S)
        self._position_known = True
        return self.position_mm()

    def unlock(self) -> float:
        """Clear an alarm, a hold or a fault, accept the controller's position, and return it in mm.

        Use it if nothing moved (noise on the line at rest, a soft limit) or if there is no limit switch.
        """
        self._recover()
        self.command("$X")
        self._position_known = True
        return self.position_mm()

    def _recover(self) -> None:
        if self.fault is None and not self._held and not self.darkened_by_hand:
            return
        self._position_known = self._position_known and self.fault is None and not self.darkened_by_hand
        self._forget_light()
        self._held = False
        self.restart()
        # A reset during a movement leaves an alarm.
        self._position_known = self._position_known and self.status().state != "Alarm"

    def move_to(self, position_mm: float, *, feed_mm_per_min: float) -> float:
        """Move, wait until the stage is at rest, and return the position read back in mm.

        The target is within ``limits_mm``, and the speed at most that of the stage ($110).

        Raises RangeError if the target is outside the travel, or the feed outside the stage's range; nothing has moved.
        Raises HardwareError if the position is unknown, or a fault occurred: alarm, stall, hold, lost steps, restart,
        silence, noise, lost connection.
        """
        start_mm = self._start_of(position_mm, feed_mm_per_min)
        self._go(position_mm, feed_mm_per_min)
        watch = self._make_motion_watch(start_mm, feed_mm_per_min / 60)
        return self._arrive(position_mm, position_mm - start_mm, feed_mm_per_min, watch)

    def sweep(
        self,
        position_mm: float,
        *,
        feed_mm_per_min: float,
        power: float = 1.0,
        reported: Callable[[StageReport], None] = lambda report: None,
    ) -> float:
        """Move like `move_to`, with the laser on during the movement; on the ramps the light is weaker.

        The controller receives the travel part by part. If this program stops, the stage comes to rest and the laser
        goes off within a second. ``reported`` is called with every `StageReport`; an exception from it brakes the
        stage, which is then held until `unlock` or `home`.

        Raises RangeError and HardwareError like `move_to` and `laser`. Also raises HardwareError if the next part was
        sent too late for a constant speed.
        """
        speed = self._convert_power(power)
        start_mm, feed_mm_s = self._start_of(position_mm, feed_mm_per_min), feed_mm_per_min / 60
        if feed_mm_s > (fastest := self.fastest_sweep_mm_per_s):
            raise RangeError(
                f"{feed_mm_s:g} mm/s is too fast for a moving stage with the laser on: at most {fastest:.3g} mm/s, "
                "so that the stage stops by itself in time ($120)"
            )
        ramp_s = feed_mm_s / self.settings.acceleration_mm_per_s2
        ahead_mm = math.copysign(feed_mm_s * (_SWEEP_S - ramp_s), position_mm - start_mm)
        at_mm = sent_mm = start_mm
        brightest = 0.0
        in_motion = self._make_motion_watch(start_mm, feed_mm_s)

        def hear(report: Status) -> None:
            nonlocal at_mm, brightest
            in_motion(report)
            at_mm = self._read_position(report)
            brightest = max(brightest, speed if report.spindle is None else report.spindle)
            reported(StageReport(self.asked_s, self.answered_s, at_mm))

        self.announce_light()
        self._power = power
        try:
            # The laser stays off until the stage moves. Grbl rejects G1 without a feed.
            self.command(f"G21G90G94G1F{feed_mm_per_min:.2f}M4S{speed}")
            while sent_mm != position_mm:
                to_mm = at_mm + ahead_mm
                if abs(to_mm - start_mm) >= abs(position_mm - start_mm):
                    to_mm = position_mm
                if abs(to_mm - start_mm) > abs(sent_mm - start_mm):
                    self._go(to_mm, feed_mm_per_min)
                    since_s = time.monotonic() - self.asked_s
                    if sent_mm != start_mm and abs(sent_mm - at_mm) < feed_mm_s * (since_s + ramp_s / 2):
                        raise self.stop_and_make_error(
                            f"the stage slowed down near {sent_mm:.2f} mm because this program sent the next part of "
                            "its travel too late: the computer is too busy"
                        )
                    sent_mm = to_mm
                time.sleep(POLL_S)
                hear(self.status())
            reached_mm = self._arrive(position_mm, position_mm - at_mm, feed_mm_per_min, hear)
        except BaseException:
            with suppress(HardwareError):
                self.realtime(FEED_HOLD)
            # After a fault the stage has been stopped by a reset.
            self._held = not self.faulty
            raise
        reaches_speed = abs(position_mm - start_mm) > feed_mm_s * (ramp_s + 3 * POLL_S)
        if reaches_speed and brightest < _FULL * speed:
            raise self.stop_and_make_error(
                f"the laser's pin does not follow: at most S{brightest:g} is reported, S{speed} was sent: a spindle "
                "override, or $31 above it"
            )
        self.laser(False)
        return reached_mm

    def _start_of(self, position_mm: float, feed_mm_per_min: float) -> float:
        """Return the start position of a movement in mm; raises the errors of `move_to`."""
        low, high = self.limits_mm
        if not low <= position_mm <= high:
            raise RangeError(f"{position_mm:g} mm is outside the stage's travel from {low:g} to {high:g} mm")
        fastest = self.settings.max_feed_mm_per_min
        if not 0 < feed_mm_per_min <= fastest:
            raise RangeError(
                f"the feed is {feed_mm_per_min:g} mm/min; expected above 0 and up to {fastest:g} mm/min ($110)"
            )
        if self._held:
            raise HardwareError("the stage is held after a stop: unlock or home it")
        if not self._position_known and self.fault is None:
            raise HardwareError("the stage does not know where it is: home it first")
        if self.laser_power:
            raise HardwareError("the laser is on: switch it off before moving, or use sweep")
        return self.position_mm()

    def laser(self, on: bool, *, power: float = 1.0, at_most_s: float | None = None) -> None:
        """Switch the laser at rest and check the reported state; only the camera can show whether it emits light.

        Until the laser is switched off the stage cannot move. The guard also switches it off if no method of the stage
        is called for more than half a second, unless `keep_lit` has announced it. ``power`` is the duty cycle of the
        pin, 0 < power <= 1; below 1 it is pulsed at some kHz.

        After ``at_most_s``, rounded to 0.05 s, the controller itself switches the laser off. The controller holds the
        commands for that before the laser is on, so it does not depend on the computer. By default that time is 0.9 s
        after the last call of `keep_lit`, which is needed every half second.

        Raises RangeError if the power is out of range. Raises HardwareError if the controller is locked or does not
        follow, the guard process is gone or has switched the laser off, or another fault occurred.
        """
        speed = self._convert_power(power)
        # A fault has already switched it off.
        if self.fault is not None and not on:
            return
        if self._lighting:
            self.announce_light()
            report = self.status()
            self._refuse_stop(report)
            # The reset would hide a hold, or a light that ended too early. A renewed light blinks.
            if self.answered_s < self.lit_until_s < math.inf:
                self._require_spindle(report, self._power)
            self.end()
        elif not on:
            self.command("M5")
        if not on or self._lighting:
            self._forget_light()
            self._check_spindle(0.0)
            self.report_dark()
        if not on:
            return
        self.announce_light()
        # In laser mode the pin stays off under G0, the mode after every reset. Grbl rejects G1 without a feed.
        self.command(f"G21G90G94G1F{min(100.0, self.settings.max_feed_mm_per_min):.2f}")
        self._power = power
        dwell_s = LIVE_S if at_most_s is None else at_most_s
        # Two lines, not three: if the third were cut off, the laser would stay on.
        self._lighting = f"M3S{speed}G4P{dwell_s:.3f}", "M5"
        self.lit_until_s = time.monotonic() + dwell_s
        self.begin(*self._lighting)
        self._check_spindle(power)
        if at_most_s is None:
            self.lit_until_s = math.inf
            self.keep_lit()

    def _forget_light(self) -> None:
        self._power, self._lighting, self.lit_until_s = 0.0, (), -math.inf

    def keep_lit(self, wait_s: float = 0.0) -> None:
        """Announce that up to ``wait_s`` may pass without a call while the laser is on; afterwards the guard acts.

        Call it repeatedly during a wait. A laser switched on without ``at_most_s`` needs it every half second, because
        it renews the light. Raises HardwareError if the guard is gone or has switched the laser off, or if the
        controller does not answer.
        """
        if not self.laser_power:
            return
        self.announce_light(wait_s)
        if self.lit_until_s == math.inf:
            self._refuse_stop(self.status())
            # The last light has started.
            if self.unacknowledged <= len(self._lighting):
                self.begin(*self._lighting)

    def _check_spindle(self, power: float) -> None:
        """Check that the pin gets into the expected state, which may take the controller a few ms.

        An answer that comes after a timed light has ended does not show whether it shone.
        """
        deadline = time.monotonic() + _LIGHTS_S
        if power:
            deadline = min(deadline, self.lit_until_s)
        while not self._follows(report := self.status(), power) and time.monotonic() < deadline:
            time.sleep(POLL_S / 20)
        if power and self.answered_s >= self.lit_until_s:
            self._refuse_stop(report)
        else:
            self._require_spindle(report, power)
