"""Times of the laser guard, with a simulated clock: the tests of the system run it as a process."""

import math
from collections.abc import Callable

import pytest

from uwlts.hardware import heartbeat, laser_guard

PARENT, PORT = 4711, 9
WRITING_S = 1e-4
"""Time that the simulated port needs for a reset."""


class Simulated:
    """Clock, pipe, port and parent of the guard; ``beats`` are pairs of arrival and allowed time."""

    def __init__(self, *beats: tuple[float, float], parent_until: float = math.inf, port_free_at: float = 0.0):
        self.now, self.beats, self.parent_until, self.port_free_at = 0.0, list(beats), parent_until, port_free_at
        self.resets: list[float] = []
        self.waits: list[float] = []

    def monotonic(self) -> float:
        return self.now

    def select(self, reading: list[int], writing: list[int], _: list[int], timeout: float) -> tuple[list[int], ...]:
        self.waits.append(timeout)
        assert timeout >= 0
        next_beat = self.beats[0][0] if reading and self.beats else math.inf
        woken = max(self.now, self.port_free_at if writing else next_beat)
        came = woken <= self.now + timeout
        self.now = woken if came else self.now + timeout
        return (reading if came else [], writing if came else [], [])

    def read(self, *_: int) -> bytes:
        return laser_guard.BEAT.pack(self.beats.pop(0)[1])

    def write(self, descriptor: int, text: bytes) -> int:
        if descriptor == PORT:
            if self.now < self.port_free_at:
                raise BlockingIOError
            self.now += WRITING_S
            self.resets.append(self.now)
        return len(text)

    def getppid(self) -> int:
        return PARENT if self.now < self.parent_until else 1

    def tcdrain(self, _: int) -> None:
        """Transmit at once."""


@pytest.fixture
def simulate(monkeypatch: pytest.MonkeyPatch) -> Callable[[Simulated], Simulated]:
    def replace(world: Simulated) -> Simulated:
        monkeypatch.setattr(laser_guard, "time", world)
        monkeypatch.setattr(laser_guard, "select", world)
        monkeypatch.setattr(laser_guard.os, "read", world.read)
        monkeypatch.setattr(laser_guard.os, "write", world.write)
        monkeypatch.setattr(laser_guard.os, "getppid", world.getppid)
        monkeypatch.setattr(laser_guard.termios, "tcdrain", world.tcdrain)
        return world

    return replace


@pytest.mark.parametrize("ends_s", [0.05, 3.33, 10.19])
def test_the_end_of_the_program_is_noticed_within_a_fifth_of_a_second(simulate, ends_s: float):
    """Also while a forked child keeps the pipe open, and without waking up more often than five times a second."""
    world = simulate(Simulated(parent_until=ends_s))
    laser_guard.watch(PARENT, PORT)
    assert ends_s <= world.now <= ends_s + 0.2
    assert len(world.waits) <= ends_s / 0.2 + 1


@pytest.mark.parametrize("allowed_s", [0.3, 0.8, 5.0])
def test_a_late_beat_switches_off_at_once_and_again_every_half_second(simulate, allowed_s: float):
    world = simulate(Simulated((0.0, allowed_s), parent_until=allowed_s + 1.9))
    laser_guard.watch(PARENT, PORT)
    expected = [allowed_s + number * (0.5 + WRITING_S) for number in range(4)]
    assert world.resets == pytest.approx([each + WRITING_S for each in expected], abs=1e-9)


def test_beats_in_time_do_not_switch_off(simulate):
    world = simulate(Simulated(*((0.7 * n, 0.7 * n + 0.8) for n in range(10)), (7.0, math.inf), parent_until=60.0))
    laser_guard.watch(PARENT, PORT)
    assert world.resets == []


@pytest.mark.parametrize(("free_s", "sent"), [(0.0, True), (0.5, True), (1.9, True), (2.5, False), (math.inf, False)])
def test_a_blocked_port_is_tried_for_two_seconds(simulate, free_s: float, sent: bool):
    world = simulate(Simulated(port_free_at=free_s))
    laser_guard.switch_off(PORT)
    assert bool(world.resets) == sent
    if sent:
        assert world.resets[0] == pytest.approx(free_s, abs=2 * WRITING_S)
    else:
        assert 2.0 <= world.now <= 2.2


def test_a_hung_program_leaves_a_fifth_of_a_second_to_the_guard():
    """The laser must be off within 1 s; a busy machine delays beats by some tens of milliseconds."""
    assert heartbeat.GRACE_S <= 0.8
    assert heartbeat.GRACE_S >= 5 * heartbeat.BEAT_S
