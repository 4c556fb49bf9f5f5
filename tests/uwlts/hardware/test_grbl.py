"""The Grbl driver and the twin's controller over a pseudo terminal: functions, faults, and switching the laser off."""

import errno
import os
import pty
import select
import signal
import subprocess
import sys
import termios
import textwrap
import threading
import time
import tty
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.waiting import within
from twin.devices.grbl_controller import GrblController
from twin.devices.grbl_firmware import GrblError, parse_block
from twin.devices.grbl_motion import Axis, Ramp
from uwlts.errors import HardwareError, RangeError
from uwlts.hardware.grbl import GrblStage, StageReport
from uwlts.hardware.grbl_line import Reply, Status, code_text, parse_reply, parse_settings

ROOT = Path(__file__).resolve().parents[3]
FAST = {"speed_up": 100.0, "boot_s": 1.0, "position_mm": 30.0}
STEP_MM = 0.0125


def wait_for(condition: Callable[[], bool], seconds: float = 3.0) -> bool:
    return within(seconds, condition)


@pytest.fixture
def controller() -> Iterator[GrblController]:
    with GrblController(**FAST) as running:
        yield running


@pytest.fixture
def stage(controller: GrblController) -> Iterator[GrblStage]:
    """Yield a homed stage. Tests may cause faults; at the end the laser is off."""
    with GrblStage(controller.port) as opened:
        opened.home()
        yield opened
        opened.fault = opened.fault or "test over"


REAL = {"boot_s": 0.2, "position_mm": 30.0, "settings": {24: 2400, 25: 7200, 110: 7200, 120: 2000}}
"""Settings for light in motion, whose parts the driver sends in real time: 120 mm/s, reached after 0.06 s."""
SWEEP = 4800.0


@pytest.fixture
def real() -> Iterator[GrblController]:
    with GrblController(**REAL) as running:
        yield running


@pytest.fixture
def sweeping(real: GrblController) -> Iterator[GrblStage]:
    """A homed stage that moves in real time."""
    with GrblStage(real.port) as opened:
        opened.home()
        yield opened
        opened.fault = opened.fault or "test over"


# Messages


@pytest.mark.parametrize(
    ("line", "meaning"),
    [
        ("ok", Reply("ok")),
        ("error:9", Reply("error", 9)),
        ("ALARM:1", Reply("ALARM", 1)),
        ("Grbl 1.1h ['$' for help]", Reply("banner", text="1.1h")),
        ("\\xffGrbl 1.1f ['$' for help]", Reply("banner", text="1.1f")),
        ("$100=80.000", Reply("setting", 100, 80.0)),
        ("$13=0 (report inches, bool)", Reply("setting", 13, 0.0)),
        ("[MSG:'$H'|'$X' to unlock]", Reply("message", text="MSG:'$H'|'$X' to unlock")),
        (">G54G20:ok", Reply("message", text=">G54G20:ok")),
        (
            "<Hold:0|MPos:-5.000,1.000,0.000|Bf:15,128|FS:0,1000|Pn:XZ|WCO:1.500,0.000,0.000>",
            Status("Hold", machine_mm=-5.0, offset_mm=1.5, spindle=1000.0, pins="XZ"),
        ),
        ("<Idle|WPos:2.000,0.000,0.000|F:0>", Status("Idle", work_mm=2.0)),
    ],
)
def test_replies_are_understood(line, meaning):
    assert parse_reply(line) == meaning


@pytest.mark.parametrize(
    "line",
    [
        "okk",
        "error:",
        "ALARM:x",
        "Grbl 0.9j ['$' for help]",
        "$100=",
        "$100=nan",
        "<Idle>",
        "<Idle|MPos:1.0,inf>",
        "<Run|MPos:1.000|WPos:1.000>",
        "<Fly|MPos:1.000>",
        "<Idle|MPos:1..0>",
        "[unended",
        "\\xff\\x80",
        "<Idle|MPos:--1>",
    ],
)
def test_what_grbl_never_says_is_garbage(line):
    assert parse_reply(line) == Reply("garbage", text=line)


def test_every_documented_alarm_and_error_has_its_meaning():
    # doc/csv of Grbl 1.1: alarms 1 to 9, errors 1 to 17 and 20 to 38.
    assert all("unknown" not in code_text("ALARM", code) for code in range(1, 10))
    assert all("unknown to" not in code_text("error", code) for code in [*range(1, 18), *range(20, 39)])
    assert "unknown" in code_text("ALARM", 10) and "unknown to" in code_text("error", 18)


def test_settings_that_cannot_work_are_refused():
    good = dict.fromkeys((13, 20, 21, 22, 23, 24, 25, 26, 27, 30, 31, 32, 100, 110, 120, 130), 1.0) | {13: 0.0}
    assert parse_settings(good).steps_per_mm == 1
    with pytest.raises(HardwareError, match=r"lacks \$100, \$130"):
        parse_settings({n: v for n, v in good.items() if n not in (100, 130)})
    with pytest.raises(HardwareError, match=r"inches .*send \$13=0"):
        parse_settings(good | {13: 1.0})
    with pytest.raises(HardwareError, match=r"\$100 \(steps/mm\) is 0"):
        parse_settings(good | {100: 0.0})


# Motion of the twin's axis


@pytest.mark.parametrize("way_mm", [-200.0, 30.0, 0.5, STEP_MM])
def test_a_movement_keeps_to_speed_and_acceleration_and_arrives(way_mm):
    ramp = Ramp(5.0, (5.0 + way_mm,), speed=10.0, acceleration=50.0, start_s=2.0)
    times = np.linspace(2.0, ramp.end_s, 20001)
    positions, speeds = np.array([ramp.state_at(time_s) for time_s in times]).T
    assert (positions[0], positions[-1]) == (5.0, 5.0 + way_mm)
    assert np.abs(speeds).max() <= 10 * (1 + 1e-12)
    assert np.abs(np.diff(speeds)).max() <= 50 * np.diff(times).max() * (1 + 1e-6)
    # The error of the trapezoidal rule is at most a dt^2 / 2 at each of the two kinks of the speed.
    way = np.sum((speeds[1:] + speeds[:-1]) / 2 * np.diff(times))
    assert way == pytest.approx(way_mm, abs=50 * np.diff(times).max() ** 2)


def test_a_hold_brakes_and_a_resumption_arrives():
    axis = Axis(acceleration=50.0)
    axis.add(100.0, speed=10.0, time_s=0.0)
    axis.hold(3.0)
    # v^2 / 2a beyond the position at the command.
    held_mm = Ramp(0.0, (100.0,), 10.0, 50.0, 0.0).state_at(3.0)[0] + 10**2 / (2 * 50)
    assert axis.braking(3.1) and not axis.braking(3.3)
    assert axis.state_at(9.0) == (pytest.approx(held_mm), 0.0)
    axis.resume(10.0)
    axis.advance(100.0)
    assert axis.state_at(100.0) == (100.0, 0.0) and not axis.pending


def test_blocks_of_one_direction_are_one_movement():
    """Several blocks move like one, if each arrives before the axis must brake for the end of the previous one."""
    axis, whole = Axis(acceleration=50.0), Ramp(0.0, (100.0,), 10.0, 50.0, 0.0)
    axis.add(10.0, speed=10.0, time_s=0.0)
    for number in range(2, 11):
        # 9 mm of the previous block are left, and braking takes 1 mm.
        axis.add(10.0 * number, speed=10.0, time_s=number - 1.8)
        assert axis.pending == 2
    for time_s in np.linspace(8.3, whole.end_s, 50).tolist():
        assert axis.state_at(time_s) == pytest.approx(whole.state_at(time_s))
    # Rounding of the times.
    axis.advance(whole.end_s + 1e-9)
    assert not axis.pending and axis.state_at(20.0) == (100.0, 0.0)
    # A block that arrives during braking accelerates the axis again, and the positions follow from its speed.
    axis.add(110.0, speed=10.0, time_s=20.0)
    late_s = 20.0 + 1.1
    assert axis.state_at(late_s)[1] == pytest.approx(5.0)
    axis.add(120.0, speed=10.0, time_s=late_s)
    times = np.linspace(late_s, 24.0, 20001)
    places, speeds = np.array([axis.state_at(time_s) for time_s in times]).T
    assert speeds[0] == pytest.approx(5.0) and speeds.max() == 10.0 and (places[-1], speeds[-1]) == (120.0, 0.0)
    assert np.abs(np.diff(speeds)).max() <= 50 * np.diff(times).max() * (1 + 1e-6)
    way = np.sum((speeds[1:] + speeds[:-1]) / 2 * np.diff(times))
    assert way == pytest.approx(120 - places[0], abs=50 * np.diff(times).max() ** 2)


# The twin's controller, addressed directly


class Terminal:
    """A program on the port that is no driver."""

    def __init__(self, port: str):
        self.descriptor = os.open(port, os.O_RDWR | os.O_NOCTTY)

    def read(self, quiet_s: float = 0.05, last: str = "") -> list[str]:
        """Lines until one ends with ``last`` and no other follows for a while."""
        data = b""
        while select.select([self.descriptor], [], [], quiet_s if data.endswith(last.encode() + b"\r\n") else 3.0)[0]:
            data += os.read(self.descriptor, 4096)
        return data.decode("ascii").split("\r\n")[:-1]

    def say(self, text: str, quiet_s: float = 0.05, last: str = "") -> list[str]:
        os.write(self.descriptor, text.encode("ascii"))
        return self.read(quiet_s, last)


@pytest.fixture
def terminal(controller: GrblController) -> Iterator[Terminal]:
    opened = Terminal(controller.port)
    assert opened.read(last="unlock]") == ["", "Grbl 1.1h ['$' for help]", "[MSG:'$H'|'$X' to unlock]"]
    yield opened
    os.close(opened.descriptor)


def test_the_controller_is_locked_until_homed_or_unlocked(terminal):
    assert terminal.say("G1X1F100\n") == ["error:9"]
    assert terminal.say("?")[0].startswith("<Alarm|MPos:0.000,0.000,0.000|FS:0,0|WCO:0.000,0.000,0.000>")
    assert terminal.say("$X\n") == ["[MSG:Caution: Unlocked]", "ok"]
    assert terminal.say("G90\r\n") == ["ok", "ok"]
    assert terminal.say("?") == ["<Idle|MPos:0.000,0.000,0.000|FS:0,0>"]
    assert terminal.say("$G\n") == ["[GC:G0 G54 G17 G21 G90 G94 M5 M9 T0 F0 S0]", "ok"]
    assert terminal.say("$I\n") == ["[VER:1.1h.20190825:]", "[OPT:V,15,128]", "ok"]


def test_the_controller_refuses_as_grbl_does(terminal):
    terminal.say("$X\n")
    refusals = {
        "G1X-1": 22,
        "G5X1": 20,
        "X": 2,
        "1": 1,
        "G0G1X1": 21,
        "X1X2": 25,
        "S-1": 4,
        "G4": 28,
        "$Q": 3,
        "$100=-1": 4,
        "Y1": 20,
        "G0 X-1 P1": 36,
        "G" + "0" * 90: 11,
        "$22=x": 2,
    }
    for line, code in refusals.items():
        assert terminal.say(f"{line}\n", 0.03) == [f"error:{code}"], line
    terminal.say("$22=0\n")
    assert terminal.say("$20=1\n") == ["error:10"]
    assert terminal.say("$H\n") == ["error:5"]


def test_laser_mode_keeps_the_pin_off_under_g0_and_at_rest_under_m4(controller, terminal):
    terminal.say("$X\nM3S500\n")
    assert not controller.state().laser_on
    terminal.say("G1F100\n")
    assert controller.state().power == 0.5
    terminal.say("M4\n")
    assert not controller.state().laser_on
    terminal.say("$32=0\nG0\nM3\n")
    assert controller.state().laser_on
    assert "FS:0,500" in terminal.say("?")[0]
    terminal.say("M5\n")
    assert not controller.state().laser_on


def test_the_planner_takes_fifteen_movements_and_then_waits(terminal):
    terminal.say("$H\n", last="ok")
    lines = terminal.say("G91G1F30\n" + "X0.5\n" * 15, 0.03)
    assert lines == ["ok"] * 16
    assert "Run" in terminal.say("?")[0]
    assert terminal.say("X0.5\nG4P0.01\n", 0.4) == ["ok", "ok"]
    assert terminal.say("?")[0].startswith("<Idle|MPos:-740.000")


def test_soft_limits_and_a_reset_while_moving_end_in_an_alarm(terminal):
    terminal.say("$H\n", last="ok")
    assert terminal.say("G0X1\n") == ["ALARM:2", "[MSG:Reset to continue]"]
    os.write(terminal.descriptor, b"?$X\n")
    assert not select.select([terminal.descriptor], [], [], 0.1)[0]
    locked = ["", "Grbl 1.1h ['$' for help]", "[MSG:'$H'|'$X' to unlock]"]
    assert terminal.say("\x18") == locked
    terminal.say("$X\nG1X-700F60\n", last="ok")
    assert terminal.say("\x18") == ["ALARM:3", *locked]


def test_blocks_hold_words_and_commands_apart():
    block = parse_block("G21G90G94G53G1X-12.5F600")
    assert block.machine_coordinates and block.values == {"X": -12.5, "F": 600.0}
    assert block.commands == {"units": "G21", "distance": "G90", "feed": "G94", "motion": "G1"}
    with pytest.raises(GrblError, match="error:26"):
        parse_block("G92")


# Opening


def test_opening_reads_version_settings_and_state(controller):
    with GrblStage(controller.port) as stage:
        assert stage.version == "1.1h"
        assert (1 / stage.settings.steps_per_mm, stage.settings.travel_mm) == (STEP_MM, 750.0)
        assert stage.limits_mm == (0.0, 750.0)
        assert not stage.position_known
        with pytest.raises(HardwareError, match="home it first"):
            stage.move_to(10.0, feed_mm_per_min=100.0)
        # With this flag DTR drops when any process closes the port.
        assert termios.tcgetattr(stage._serial.fd)[2] & termios.HUPCL


def test_resets_of_the_program_before_are_no_fault(controller, monkeypatch):
    """A program and its guard end with Ctrl-X; on a busy machine the greeting follows the next opening."""
    say, greeted = controller._say, []

    def again(data: bytes) -> None:
        say(data)
        if data.lstrip().startswith(b"Grbl") and not greeted:
            greeted.append(True)
            threading.Timer(0.05, controller.inject, ("restart",)).start()

    monkeypatch.setattr(controller._firmware, "_say", again)
    with GrblStage(controller.port) as stage:
        assert greeted and stage.home() == pytest.approx(2.0, abs=STEP_MM)


def test_a_board_that_does_not_reset_is_woken_and_keeps_its_position():
    with GrblController(**FAST, resets_when_opened=False) as controller:
        for known in (False, True):
            with GrblStage(controller.port, boot_s=0.3) as stage:
                assert stage.position_known is known
                if not known:
                    assert stage.home() == 2.0
                assert stage.position_mm() == 2.0


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"version": "0.9j"}, r"is not Grbl 1\.1, it answers .*0\.9j"),
        ({"version": "3.7 [FluidNC"}, r"is not Grbl 1\.1"),
        ({"options": "MZ"}, "without V: the laser needs"),
        ({"settings": {13: 1}}, r"inches"),
    ],
)
def test_a_controller_that_cannot_do_it_is_refused(options, message):
    with GrblController(**FAST, **options) as controller:
        with pytest.raises(HardwareError, match=message):
            GrblStage(controller.port, boot_s=0.3)
        assert wait_for(lambda: not controller.state().port_open)


def test_a_silent_port_and_a_foreign_device_are_distinguished():
    master, slave = pty.openpty()
    tty.setraw(slave)
    try:
        with pytest.raises(HardwareError, match="nothing answers"):
            GrblStage(os.ttyname(slave), boot_s=0.1)
        threading.Timer(0.05, os.write, (master, b"\x80\xff\x00~~")).start()
        with pytest.raises(HardwareError, match="does not speak Grbl, it answers .*baud"):
            GrblStage(os.ttyname(slave), boot_s=0.1)
    finally:
        os.close(master)
        os.close(slave)


def test_a_port_that_is_missing_or_in_use_is_named(controller):
    with pytest.raises(HardwareError, match="there is no such port; ports found"):
        GrblStage("/dev/ttyACM987")
    with GrblStage(controller.port), pytest.raises(HardwareError, match="another program uses it"):
        GrblStage(controller.port)


# Moving


@pytest.mark.parametrize(
    ("settings", "options", "home_mm"),
    [({23: 1}, "V", 2.0), ({23: 0}, "V", 748.0), ({23: 1}, "VZ", 0.0), ({23: 0}, "VZ", 750.0), ({10: 0}, "V", 2.0)],
)
def test_positions_count_from_the_lower_end_whatever_grbl_calls_them(settings, options, home_mm):
    with (
        GrblController(**FAST | {"position_mm": abs(home_mm - 20)}, settings=settings, options=options) as controller,
        GrblStage(controller.port) as stage,
    ):
        assert stage.home() == pytest.approx(home_mm, abs=1e-9)
        # Homing sets the zero after the pull-off, so the controller's zero is beside the switch.
        offset_mm = {"VZ": 2.0 if settings.get(23) else -2.0}.get(options, 0.0)
        stage.command("G92X5")
        for target_mm in (410.0, 400.0125):
            assert stage.move_to(target_mm, feed_mm_per_min=900.0) == pytest.approx(target_mm, abs=1e-9)
            assert controller.state().position_mm == pytest.approx(target_mm + offset_mm, abs=1e-9)


def test_a_movement_ends_on_the_nearest_step_and_not_before_its_time():
    speed_up = 5.0
    with (
        GrblController(speed_up=speed_up, boot_s=0.1, resets_when_opened=False, settings={22: 0, 20: 0}) as controller,
        GrblStage(controller.port, boot_s=0.1) as stage,
    ):
        begun = time.monotonic()
        reached_mm = stage.move_to(20.004, feed_mm_per_min=600.0)
        took_s = (time.monotonic() - begun) * speed_up
        assert reached_mm == pytest.approx(20.0, abs=1e-9)
        assert not controller.state().moving
    # 20 mm at 10 mm/s and one ramp of 0.2 s; at the end a dwell of 10 ms, a few ticks, and 0.2 s of real time.
    expected_s = 20 / 10 + 10 / 50
    assert expected_s <= took_s < expected_s + 0.2 * speed_up


@pytest.mark.parametrize(
    ("target_mm", "feed"), [(-0.1, 100.0), (750.1, 100.0), (float("nan"), 100.0), (9, 0), (9, 901)]
)
def test_nothing_is_sent_for_a_target_outside(controller, stage, target_mm, feed):
    with pytest.raises(RangeError, match="travel|feed"):
        stage.move_to(target_mm, feed_mm_per_min=feed)
    assert controller.state().position_mm == 2.0
    assert stage.move_to(9.0, feed_mm_per_min=900.0) == 9.0


def test_without_homing_positions_count_from_the_start():
    with GrblController(**FAST, settings={22: 0, 20: 0}) as controller, GrblStage(controller.port) as stage:
        with pytest.raises(HardwareError, match=r"\$22=0"):
            stage.home()
        assert stage.move_to(-20.0, feed_mm_per_min=900.0) == -20.0
        assert controller.state().position_mm == 10.0


def test_the_laser_follows_and_its_power_is_a_share(controller, stage):
    for power in (1.0, 0.25):
        stage.laser(True, power=power)
        assert controller.state().power == power == stage.laser_power
    with pytest.raises(HardwareError, match="switch it off before moving"):
        stage.move_to(5.0, feed_mm_per_min=900.0)
    stage.laser(False)
    assert not controller.state().laser_on and stage.laser_power == 0.0
    assert stage.move_to(5.0, feed_mm_per_min=900.0) == 5.0
    with pytest.raises(RangeError, match="power is 1.5"):
        stage.laser(True, power=1.5)


def test_light_that_is_kept_lasts_and_its_controller_never_has_much_of_it(controller, stage):
    stage.laser(True)
    began_s = time.monotonic()
    while time.monotonic() - began_s < 3.0:
        time.sleep(0.3)
        stage.keep_lit()
    stage.keep_lit()
    kept_s = time.monotonic()
    assert controller.state().laser_on
    assert wait_for(lambda: not controller.state().laser_on, 1.0)
    lit_s = sum(light.duration_s for light in controller.lights)
    # At most two dwells remained, in 8 steps of the controller's 0.05 s each; between them it is dark for some ms.
    assert kept_s - began_s - 0.1 < lit_s < kept_s - began_s + 1.0


def test_the_laser_is_lit_on_the_way_alone(real, sweeping):
    seen, reports = [], []

    def report(report: StageReport) -> None:
        reports.append(report)
        seen.append(real.state())

    assert sweeping.sweep(160.0, feed_mm_per_min=SWEEP, power=0.5, reported=report) == 160.0
    assert real.state().position_mm == 160.0 and not real.state().laser_on and sweeping.laser_power == 0.0
    assert sum(state.power == 0.5 and state.speed_mm_per_s == 80.0 for state in seen) > 10
    (light,) = real.lights
    assert light.duration_s == pytest.approx(158 / 80, abs=0.3)
    # At a constant speed, except for the ramps of 1.6 mm.
    fast = [each for each in reports if 10 < each.position_mm < 150]
    speeds = [
        (b.position_mm - a.position_mm) / (b.answered_s - a.answered_s)
        for a, b in zip(fast, fast[3:], strict=False)
        if b.answered_s - b.asked_s < 0.02 and a.answered_s - a.asked_s < 0.02
    ]
    assert np.median(speeds) == pytest.approx(80.0, rel=0.02)
    # Back, over a distance shorter than the part that is sent at once.
    assert sweeping.sweep(150.0, feed_mm_per_min=SWEEP) == 150.0
    with pytest.raises(RangeError, match="too fast for a moving stage with the laser on: at most"):
        sweeping.command("$120=100")
        sweeping.settings = replace(sweeping.settings, acceleration_mm_per_s2=100.0)
        sweeping.sweep(200.0, feed_mm_per_min=SWEEP)


def test_what_is_raised_on_the_way_brakes_the_stage_in_the_dark(real, sweeping):
    def report(report: StageReport) -> None:
        if report.position_mm > 60:
            raise OSError(errno.ENOSPC, "disk full")

    with pytest.raises(OSError, match="disk full"):
        sweeping.sweep(700.0, feed_mm_per_min=SWEEP, reported=report)
    assert wait_for(lambda: not real.state().laser_on and not real.state().moving, 0.3)
    with pytest.raises(HardwareError, match="held"):
        sweeping.move_to(20.0, feed_mm_per_min=SWEEP)
    assert sweeping.unlock() == pytest.approx(real.state().position_mm, abs=STEP_MM)


def test_a_computer_that_is_too_late_for_a_constant_speed_is_an_error(real, sweeping):
    with pytest.raises(HardwareError, match="slowed down near .* the computer is too busy"):
        sweeping.sweep(700.0, feed_mm_per_min=SWEEP, reported=lambda report: time.sleep(0.7))
    assert wait_for(lambda: not real.state().laser_on, 0.3)


def test_without_laser_mode_the_laser_is_not_lit():
    """Without laser mode a hold keeps the laser on."""
    with GrblController(**FAST, settings={32: 0}) as controller, GrblStage(controller.port) as stage:
        stage.home()
        with pytest.raises(HardwareError, match=r"laser mode is off .* send \$32=1"):
            stage.laser(True, at_most_s=0.5)
        with pytest.raises(HardwareError, match=r"send \$32=1"):
            stage.sweep(50.0, feed_mm_per_min=900.0)
        assert not controller.lights


def test_a_laser_that_gives_no_light_is_seen_by_the_twin_alone(controller, stage):
    controller.inject("break-laser")
    stage.laser(True)
    assert not controller.state().laser_on and stage.laser_power == 1.0


# Faults


@pytest.mark.parametrize(
    ("fault", "message", "recovers"),
    [
        (lambda c: c.disconnect(), "connection is lost.*CANNOT be switched", False),
        (lambda c: c.inject("stall"), "stall: the stage has been at", True),
        (lambda c: c.inject("alarm", 1), "ALARM:1, hard limit.*home", True),
        (lambda c: c.inject("alarm", 3), "ALARM:3, reset while moving", True),
        (lambda c: c.inject("garbage"), "garbage on the line", True),
        (lambda c: c.inject("garbage", noise=b"x" * 300), "garbage on the line", True),
        (lambda c: c.inject("garbage", noise=b"ok\r\nok\r\n"), "was received although nothing was sent", True),
        (lambda c: c.inject("restart"), "restarted by itself", True),
        (lambda c: c.inject("mute"), "silence: 3 status queries", False),
        (lambda c: c.inject("hold"), "feed hold", True),
        (lambda c: c.inject("lose-steps", -80 * 160), "missed steps: the limit switch at 0 mm is pressed", True),
    ],
)
def test_a_fault_while_moving_is_named_and_the_laser_is_off(real, sweeping, fault, message, recovers):
    controller, stage = real, sweeping
    stage.move_to(20.0, feed_mm_per_min=SWEEP)
    timer = threading.Timer(0.3, fault, (controller,))
    timer.start()
    with pytest.raises(HardwareError, match=message):
        stage.sweep(140.0, feed_mm_per_min=SWEEP)
    assert controller.lights
    assert wait_for(lambda: not controller.state().laser_on, 0.2)
    assert stage.laser_power == 0.0 and not stage.position_known
    with pytest.raises(HardwareError, match="has stopped after a fault"):
        stage.move_to(60.0, feed_mm_per_min=900.0)
    stage.laser(False)
    if recovers:
        assert stage.home() == 2.0
        assert stage.move_to(20.0, feed_mm_per_min=SWEEP) == 20.0
        assert controller.state().position_mm == 20.0


@pytest.mark.parametrize(("fault", "message"), [("restart", r"restarted by itself: home"), ("alarm", "ALARM:1, hard")])
def test_a_fault_at_the_moment_of_a_reset_is_named(controller, stage, monkeypatch, fault, message):
    """A light ends by a reset; the greeting after a restart just before it looks like the answer."""
    stage.laser(True, at_most_s=5.0)
    end = stage.end
    monkeypatch.setattr(stage, "end", lambda: (controller.inject(fault), end()))
    with pytest.raises(HardwareError, match=message):
        stage.laser(False)
    assert not controller.state().laser_on


def test_a_movement_that_ends_short_by_more_than_a_step_is_named(controller, stage):
    controller.inject("stop-short", 1)
    assert stage.move_to(10.0, feed_mm_per_min=900.0) == pytest.approx(10.0 - STEP_MM, abs=1e-9)
    controller.inject("stop-short", 3)
    with pytest.raises(HardwareError, match=r"missed steps: the position is 19\.962 mm where 20\.000 mm .* -3 steps"):
        stage.move_to(20.0, feed_mm_per_min=900.0)
    assert not controller.state().laser_on


def test_noise_at_rest_leaves_the_position_to_be_unlocked(controller, stage):
    controller.inject("garbage")
    with pytest.raises(HardwareError, match="garbage"):
        stage.position_mm()
    assert stage.unlock() == 2.0
    assert stage.move_to(4.0, feed_mm_per_min=900.0) == 4.0


def test_homing_that_fails_says_so():
    # The switch is 1400 mm away and Grbl seeks over 1.5 times the 750 mm of travel.
    with GrblController(**FAST | {"position_mm": 1400.0}) as controller, GrblStage(controller.port) as stage:
        with pytest.raises(HardwareError, match=r"ALARM:9, homing: no limit switch"):
            stage.home()
        assert not stage.position_known


# Laser off by hand, from another thread


def darkened(controller: GrblController, stage: GrblStage) -> None:
    """Press the button and check that the laser is off within 0.2 s."""
    stage.darken()
    assert wait_for(lambda: not controller.state().laser_on, 0.2)


def later(seconds: float, work: Callable[[], None]) -> threading.Thread:
    """Thread that acts after a delay."""

    def run() -> None:
        time.sleep(seconds)
        work()

    thread = threading.Thread(target=run)
    thread.start()
    return thread


BY_HAND = "the laser was switched off by hand: unlock the stage if it stood still, else home it"


def test_the_laser_goes_off_by_hand_while_the_stage_moves(real, sweeping):
    controller, stage = real, sweeping
    dark = []

    def press() -> None:
        assert controller.state().moving and controller.state().laser_on
        stage.darken()
        dark.append(wait_for(lambda: not controller.state().laser_on, 0.2))

    pressing = later(0.5, press)
    with pytest.raises(HardwareError, match=BY_HAND):
        stage.sweep(700.0, feed_mm_per_min=SWEEP)
    pressing.join()
    assert dark == [True] and not controller.state().moving
    assert stage.faulty and stage.laser_power == 0.0 and not stage.position_known
    with pytest.raises(HardwareError, match=f"has stopped after a fault: {BY_HAND}"):
        stage.laser(True)
    assert not controller.state().laser_on
    assert stage.home() == 2.0
    assert stage.move_to(20.0, feed_mm_per_min=SWEEP) == 20.0 == controller.state().position_mm


def test_homing_ends_by_hand(controller, stage):
    stage.move_to(700.0, feed_mm_per_min=900.0)
    pressing = later(0.1, stage.darken)
    with pytest.raises(HardwareError, match=BY_HAND):
        stage.home()
    pressing.join()
    assert not stage.position_known and not controller.state().moving
    assert stage.home() == 2.0


@pytest.mark.parametrize("at_most_s", [None, 5.0])
def test_a_laser_that_is_lit_at_rest_goes_off_by_hand(controller, stage, at_most_s):
    stage.move_to(60.0, feed_mm_per_min=900.0)
    stage.laser(True, at_most_s=at_most_s)
    assert controller.state().laser_on
    later(0.0, lambda: darkened(controller, stage)).join()
    assert not controller.state().laser_on
    with pytest.raises(HardwareError, match=BY_HAND):
        stage.laser(False)
    assert stage.faulty and stage.laser_power == 0.0
    # Nothing moved: the position is still valid.
    assert stage.unlock() == 60.0
    stage.laser(True, at_most_s=at_most_s)
    assert controller.state().laser_on
    stage.laser(False)
    assert stage.move_to(61.0, feed_mm_per_min=900.0) == 61.0


@pytest.mark.parametrize(
    "exchange",
    [
        lambda stage: stage.position_mm(),
        lambda stage: stage.laser(True),
        lambda stage: stage.move_to(5.0, feed_mm_per_min=900.0),
    ],
)
def test_darkness_by_hand_is_met_at_the_next_exchange(controller, stage, exchange):
    stage.darken()
    time.sleep(0.1)
    # A second press does not change anything.
    stage.darken()
    # The laser is off, so nothing is exchanged.
    stage.keep_lit()
    assert not stage.faulty
    with pytest.raises(HardwareError, match=BY_HAND):
        exchange(stage)
    assert stage.faulty and not controller.state().laser_on
    assert stage.unlock() == 2.0
    assert stage.move_to(4.0, feed_mm_per_min=900.0) == 4.0


def test_after_darkness_by_hand_the_stage_is_unlocked_or_homed_at_once(controller, stage):
    for recover in (stage.unlock, stage.home):
        stage.darken()
        assert recover() == 2.0 and stage.position_known
        assert stage.move_to(4.0, feed_mm_per_min=900.0) == 4.0
        stage.move_to(2.0, feed_mm_per_min=900.0)


@pytest.mark.parametrize("at_most_s", [None, 5.0])
def test_whenever_darkness_is_asked_for_the_laser_is_off_and_stays_off(controller, stage, at_most_s):
    """Also while it is being switched on, when the command is already in transmission."""
    stage.move_to(60.0, feed_mm_per_min=900.0)
    rng = np.random.default_rng(11)

    def flash() -> None:
        while True:
            stage.laser(True, at_most_s=at_most_s)
            stage.laser(False)

    seen = []

    def press() -> None:
        stage.darken()
        # Lines sent before are done by then, also on a busy machine.
        time.sleep(0.25)
        for _ in range(40):
            seen.append(controller.state().laser_on)
            time.sleep(0.002)

    for wait_s in rng.uniform(0, 0.1, 12).tolist():
        pressing = later(wait_s, press)
        with pytest.raises(HardwareError, match=BY_HAND):
            flash()
        pressing.join()
        assert stage.faulty and not controller.state().laser_on
        assert stage.unlock() == 60.0
    assert len(seen) == 480 and not any(seen)


def test_a_stage_that_was_darkened_by_hand_closes_as_any_other(controller):
    with GrblStage(controller.port) as stage:
        stage.home()
        stage.laser(True)
        stage.darken()
    assert wait_for(lambda: not controller.state().port_open)
    stage.darken()
    assert not controller.state().laser_on


# Laser off, however the program ends


LIT = """
    import sys
    from uwlts.hardware.grbl import GrblStage
    with GrblStage(sys.argv[1]) as stage:
        stage.home()
        stage.laser(True)
        print(stage._guard.pid, flush=True)
        {then}
"""
MOVES = """stage.laser(False)
        stage.sweep(740.0, feed_mm_per_min=1200.0)"""


def lit_program(controller: GrblController, then: str = MOVES) -> tuple[subprocess.Popen[str], int]:
    program = subprocess.Popen(
        [sys.executable, "-c", textwrap.dedent(LIT.format(then=then)), controller.port],
        cwd=ROOT,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    )
    assert program.stdout is not None
    guard = int(program.stdout.readline())
    # A program that moves switches the laser off first, and on again with the movement.
    assert wait_for(lambda: controller.state().laser_on)
    return program, guard


@pytest.mark.parametrize("ending", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL, signal.SIGSEGV])
def test_the_laser_goes_off_when_the_program_is_ended_while_moving(real, ending):
    controller = real
    program, _ = lit_program(controller)
    assert wait_for(lambda: controller.state().moving and controller.state().laser_on)
    program.send_signal(ending)
    # The guard wakes at once when its pipe ends; 0.5 s is far beyond its 0.2 s of polling.
    assert wait_for(lambda: not controller.state().laser_on, 0.5)
    program.communicate(timeout=10)
    assert program.returncode != 0
    assert wait_for(lambda: not controller.state().port_open)
    assert not controller.state().moving


@pytest.mark.parametrize("then", ["pass", "raise ValueError", "import os; os._exit(3)", "sys.exit(1)"])
def test_the_laser_goes_off_however_the_program_leaves(controller, then):
    program, _ = lit_program(controller, then=f"sys.stdin.readline()\n        {then}")
    program.communicate("\n", timeout=10)
    assert wait_for(lambda: not controller.state().laser_on, 0.5)


@pytest.mark.parametrize("gated", [True, False])
def test_without_the_guard_the_interlock_and_else_the_controller_end_the_light(gated):
    with GrblController(**FAST, gated=gated) as controller:
        program, guard = lit_program(controller, then="sys.stdin.readline()")
        os.kill(guard, signal.SIGKILL)
        program.kill()
        program.communicate(timeout=10)
        assert wait_for(lambda: not controller.state().port_open)
        assert wait_for(lambda: not controller.state().laser_on, 0.0 if gated else 1.0)


def test_the_laser_is_not_lit_without_its_guard(controller, stage):
    os.kill(stage._guard.pid, signal.SIGKILL)
    with pytest.raises(HardwareError, match="switches the laser off after a crash, is gone"):
        stage.laser(True)
    assert not controller.state().laser_on


def test_a_program_that_stands_still_loses_its_laser_and_can_go_on_after_homing(controller, stage):
    stage.laser(True, at_most_s=5.0)
    stage.keep_lit(0.6)
    time.sleep(1.2)
    assert controller.state().laser_on
    assert wait_for(lambda: not controller.state().laser_on, 1.0)
    with pytest.raises(HardwareError, match="guard switched the laser off.*stood still"):
        stage.laser(False)
    assert stage.faulty and stage.laser_power == 0.0
    stage.home()
    stage.laser(True)
    stage.laser(False)
    assert not controller.state().laser_on


def test_the_controller_ends_a_laser_with_a_time_by_itself(controller, stage):
    stage.move_to(60.0, feed_mm_per_min=900.0)
    stage.laser(True, at_most_s=5.0)
    assert controller.state().laser_on
    stage.laser(False)
    assert not controller.state().laser_on
    assert stage.position_known and stage.move_to(61.0, feed_mm_per_min=900.0) == 61.0
    stage.laser(True, at_most_s=0.3)
    stage.keep_lit(2.0)
    lit_until_s = stage.lit_until_s
    assert wait_for(lambda: not controller.state().laser_on, 0.5) and time.monotonic() > lit_until_s
    stage.laser(False)
    assert stage.position_known and stage.move_to(60.0, feed_mm_per_min=900.0) == 60.0
    # Light that ends early is an error: images exposed meanwhile may be dark.
    stage.laser(True, at_most_s=5.0)
    os.write(stage._serial.fileno(), b"\x18")
    with pytest.raises(HardwareError, match="does not follow|restarted"):
        stage.laser(False)


def test_a_computer_that_asks_after_a_timed_light_takes_the_darkness_for_no_fault(controller, stage, monkeypatch):
    begin = stage.begin

    def begin_and_be_late(*lines):
        begin(*lines)
        time.sleep(0.3)

    monkeypatch.setattr(stage, "begin", begin_and_be_late)
    stage.laser(True, at_most_s=0.05)
    assert not controller.state().laser_on
    stage.laser(False)
    assert not stage.faulty and stage.position_known


def test_a_hold_while_the_laser_is_on_is_not_hidden_by_switching_it_off(controller, stage):
    stage.laser(True, at_most_s=5.0)
    controller.inject("hold")
    with pytest.raises(HardwareError, match="feed hold"):
        stage.laser(False)


def test_closing_is_confirmed_or_an_error(controller):
    with GrblStage(controller.port) as stage:
        stage.home()
        stage.laser(True)
    assert not controller.state().laser_on
    with pytest.raises(HardwareError, match="closed"):
        stage.position_mm()
    # A controller whose port is closed and opened within 2 ms does not notice and must be woken, which takes 2.5 s.
    assert wait_for(lambda: not controller.state().port_open)
    with pytest.raises(HardwareError, match="does not restart on Ctrl-X"), GrblStage(controller.port):
        controller.inject("mute")


def test_an_error_in_the_body_is_not_hidden_by_closing(controller):
    with pytest.raises(OSError, match="disk full"), GrblStage(controller.port) as stage:
        stage.home()
        stage.laser(True)
        controller.inject("mute")
        raise OSError(errno.ENOSPC, "disk full")
    assert wait_for(lambda: not controller.state().laser_on, 0.5)
