"""Motion of one axis in closed form: every movement from rest to rest under an acceleration limit, and braking.

Times are in s of the simulated controller, positions in mm, speeds in mm/s. Grbl's planner drives through the joint of
two movements of one direction; here each comes to rest, which is the same for a stage that measures at every stop.
"""

import math
from collections import deque
from dataclasses import dataclass, field


@dataclass(frozen=True)
class Ramp:
    """From rest at ``start_mm`` to rest at ``end_mm``, beginning at ``start_s``."""

    start_mm: float
    end_mm: float
    speed: float
    acceleration: float
    start_s: float

    @property
    def peak(self) -> float:
        """Highest speed: a short way never reaches the full one."""
        return min(self.speed, math.sqrt(self.acceleration * abs(self.end_mm - self.start_mm)))

    @property
    def end_s(self) -> float:
        """When it comes to rest."""
        if self.peak == 0:
            return self.start_s
        return self.start_s + abs(self.end_mm - self.start_mm) / self.peak + self.peak / self.acceleration

    def at(self, time_s: float) -> tuple[float, float]:
        """Position and signed speed."""
        if time_s <= self.start_s:
            return self.start_mm, 0.0
        if time_s >= self.end_s:
            return self.end_mm, 0.0
        way, sign = abs(self.end_mm - self.start_mm), math.copysign(1.0, self.end_mm - self.start_mm)
        since, left = time_s - self.start_s, self.end_s - time_s
        ramp_s = self.peak / self.acceleration
        if since < ramp_s:
            gone, speed = self.acceleration * since**2 / 2, self.acceleration * since
        elif left < ramp_s:
            gone, speed = way - self.acceleration * left**2 / 2, self.acceleration * left
        else:
            gone, speed = self.peak * (since - ramp_s / 2), self.peak
        return self.start_mm + sign * gone, sign * speed


@dataclass(frozen=True)
class Brake:
    """From a signed ``speed`` at ``start_mm`` to rest."""

    start_mm: float
    speed: float
    acceleration: float
    start_s: float

    @property
    def end_s(self) -> float:
        """When it comes to rest."""
        return self.start_s + abs(self.speed) / self.acceleration

    def at(self, time_s: float) -> tuple[float, float]:
        """Position and signed speed."""
        # Counted from the end, so that the rest is exact.
        left = self.end_s - min(max(time_s, self.start_s), self.end_s)
        slowing = math.copysign(self.acceleration, self.speed)
        way = self.speed * abs(self.speed) / (2 * self.acceleration)
        return self.start_mm + way - slowing * left**2 / 2, slowing * left


@dataclass
class Axis:
    """Movements one after the other, held and resumed; asked for any time that does not lie before the last one."""

    acceleration: float
    rest_mm: float = 0.0
    _moves: deque[Ramp] = field(default_factory=deque)
    _brake: Brake | None = None
    _stuck_s: float | None = None

    @property
    def pending(self) -> int:
        """Movements not yet done."""
        return len(self._moves)

    @property
    def planned_mm(self) -> float:
        """End of the last queued movement."""
        return self._moves[-1].end_mm if self._moves else self.rest_mm

    @property
    def held(self) -> bool:
        """Whether a hold was asked for and not ended."""
        return self._brake is not None

    def braking(self, time_s: float) -> bool:
        """Whether a hold is still slowing down."""
        return self._brake is not None and self._clock(time_s) < self._brake.end_s

    def add(self, end_mm: float, *, speed: float, time_s: float) -> None:
        """Queue a movement; it starts when those before it are done, or at once."""
        start_mm, start_s = self.planned_mm, self._moves[-1].end_s if self._moves else time_s
        if end_mm != start_mm:
            self._moves.append(Ramp(start_mm, end_mm, speed, self.acceleration, start_s))

    def advance(self, time_s: float) -> None:
        """Retire the movements that are done."""
        while self._moves and not self._brake and self._clock(time_s) >= self._moves[0].end_s:
            self.rest_mm = self._moves.popleft().end_mm

    def at(self, time_s: float) -> tuple[float, float]:
        """Position and signed speed."""
        clock = self._clock(time_s)
        if self._brake:
            return self._brake.at(clock)
        for move in self._moves:
            if clock < move.end_s:
                return move.at(clock)
        return self.planned_mm, 0.0

    def hold(self, time_s: float) -> None:
        """Brake and keep what is left of the movements."""
        self.advance(time_s)
        if not self._brake:
            position, speed = self.at(time_s)
            self._brake = Brake(position, speed, self.acceleration, self._clock(time_s))

    def resume(self, time_s: float) -> None:
        """Go on with what is left, from rest."""
        if not self._brake or self.braking(time_s):
            return
        ends, (self.rest_mm, _) = [(move.end_mm, move.speed) for move in self._moves], self.at(time_s)
        self._brake = None
        self._moves.clear()
        for end_mm, speed in ends:
            self.add(end_mm, speed=speed, time_s=time_s)

    def stick(self, time_s: float) -> None:
        """Let time stand still for the movement, or the next one."""
        self._stuck_s = time_s

    def stop(self, time_s: float) -> None:
        """Stop dead where it is and forget the movements, and what they are stuck at."""
        stuck_s = None if self._moves else self._stuck_s
        self.place(self.at(time_s)[0])
        self._stuck_s = stuck_s

    def place(self, position_mm: float) -> None:
        """Rest at a position."""
        self.rest_mm, self._brake, self._stuck_s = position_mm, None, None
        self._moves.clear()

    def _clock(self, time_s: float) -> float:
        return time_s if self._stuck_s is None else min(time_s, self._stuck_s)
