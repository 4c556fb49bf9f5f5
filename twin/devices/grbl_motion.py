"""Motion of one axis in closed form: movements with limited acceleration that end at rest.

Times are in s of the simulated controller, positions in mm, speeds in mm/s. As in Grbl's planner, a movement with the
same direction and speed as the previous one continues it without a stop. Between all other movements the axis stops,
whereas Grbl stops only between opposite directions.
"""

import math
from collections import deque
from dataclasses import dataclass, field, replace


@dataclass(frozen=True)
class Ramp:
    """Movement from ``start_speed`` at ``start_mm`` to rest at ``end_mm``, starting at ``start_s``.

    ``blocks`` are the end positions of the planner's blocks in this movement; the last one is ``end_mm``.
    """

    start_mm: float
    blocks: tuple[float, ...]
    speed: float
    acceleration: float
    start_s: float
    start_speed: float = 0.0

    @property
    def end_mm(self) -> float:
        """Final position."""
        return self.blocks[-1]

    @property
    def peak(self) -> float:
        """Highest speed; a short movement does not reach ``speed``."""
        way = abs(self.end_mm - self.start_mm)
        return min(self.speed, math.sqrt(self.start_speed**2 / 2 + self.acceleration * way))

    @property
    def end_s(self) -> float:
        """Time of the end."""
        if self.peak == 0:
            return self.start_s
        # Time at peak speed over the whole distance, plus the additional time of both ramps.
        late_s = ((self.peak - self.start_speed) ** 2 + self.peak**2) / (2 * self.acceleration * self.peak)
        return self.start_s + abs(self.end_mm - self.start_mm) / self.peak + late_s

    def state_at(self, time_s: float) -> tuple[float, float]:
        """Return position and signed speed."""
        way, sign = abs(self.end_mm - self.start_mm), math.copysign(1.0, self.end_mm - self.start_mm)
        if time_s <= self.start_s:
            return self.start_mm, sign * self.start_speed
        if time_s >= self.end_s:
            return self.end_mm, 0.0
        since, left = time_s - self.start_s, self.end_s - time_s
        up_s = (self.peak - self.start_speed) / self.acceleration
        if since < up_s:
            speed = self.start_speed + self.acceleration * since
            gone = (self.start_speed + speed) / 2 * since
        elif left < self.peak / self.acceleration:
            gone, speed = way - self.acceleration * left**2 / 2, self.acceleration * left
        else:
            gone, speed = self.peak * since - self.acceleration * up_s**2 / 2, self.peak
        return self.start_mm + sign * gone, sign * speed


@dataclass
class Axis:
    """Queue of movements that can be held and resumed; times of successive calls must not decrease."""

    acceleration: float
    rest_mm: float = 0.0
    _moves: deque[Ramp] = field(default_factory=deque)
    _brake: Ramp | None = None
    _stuck_s: float | None = None

    @property
    def pending(self) -> int:
        """Number of unfinished blocks."""
        return sum(len(move.blocks) for move in self._moves)

    @property
    def planned_mm(self) -> float:
        """End of the last queued movement."""
        return self._moves[-1].end_mm if self._moves else self.rest_mm

    @property
    def held(self) -> bool:
        """True if the axis is held."""
        return self._brake is not None

    def braking(self, time_s: float) -> bool:
        """Return whether the axis is decelerating for a hold."""
        return self._brake is not None and self._read_clock(time_s) < self._brake.end_s

    def add(self, end_mm: float, *, speed: float, time_s: float) -> None:
        """Queue a block; it starts after the queued ones, and continues a movement of equal direction and speed."""
        self.advance(time_s)
        start_mm, start_s = self.planned_mm, self._moves[-1].end_s if self._moves else time_s
        if end_mm == start_mm:
            return
        last = self._moves[-1] if self._moves else None
        if last and last.speed == speed and (end_mm - start_mm) * (start_mm - last.start_mm) > 0:
            clock = max(self._read_clock(time_s), last.start_s)
            at_mm, at_speed = last.state_at(clock)
            blocks = (*last.blocks, end_mm)
            self._moves[-1] = Ramp(at_mm, blocks, speed, self.acceleration, clock, abs(at_speed))
        else:
            self._moves.append(Ramp(start_mm, (end_mm,), speed, self.acceleration, start_s))

    def advance(self, time_s: float) -> None:
        """Remove finished blocks."""
        if self._brake:
            return
        while self._moves and self._read_clock(time_s) >= self._moves[0].end_s:
            self.rest_mm = self._moves.popleft().end_mm
        if self._moves and len(self._moves[0].blocks) > 1:
            move, (at_mm, _) = self._moves[0], self.state_at(time_s)
            ahead = math.copysign(1.0, move.end_mm - move.start_mm)
            left = tuple(end_mm for end_mm in move.blocks if (end_mm - at_mm) * ahead > 0)
            self._moves[0] = replace(move, blocks=left or move.blocks[-1:])

    def commanded_speed(self, time_s: float) -> float:
        """Return the commanded speed of the present movement; 0 without one."""
        self.advance(time_s)
        return self._moves[0].speed if self._moves else 0.0

    def state_at(self, time_s: float) -> tuple[float, float]:
        """Return position and signed speed."""
        clock = self._read_clock(time_s)
        if self._brake:
            return self._brake.state_at(clock)
        for move in self._moves:
            if clock < move.end_s:
                return move.state_at(clock)
        return self.planned_mm, 0.0

    def hold(self, time_s: float) -> None:
        """Brake and keep the remaining movements."""
        self.advance(time_s)
        if not self._brake:
            position, speed = self.state_at(time_s)
            end_mm, fast = position + speed * abs(speed) / (2 * self.acceleration), abs(speed)
            self._brake = Ramp(position, (end_mm,), fast, self.acceleration, self._read_clock(time_s), fast)

    def resume(self, time_s: float) -> None:
        """Continue the remaining movements from rest."""
        if not self._brake or self.braking(time_s):
            return
        ends = [(end_mm, move.speed) for move in self._moves for end_mm in move.blocks]
        self.rest_mm, _ = self.state_at(time_s)
        self._brake = None
        self._moves.clear()
        for end_mm, speed in ends:
            self.add(end_mm, speed=speed, time_s=time_s)

    def stick(self, time_s: float) -> None:
        """Block the present movement, or the next one."""
        self._stuck_s = time_s

    def stop(self, time_s: float) -> None:
        """Stop immediately and discard the movements; a blocked movement is released."""
        stuck_s = None if self._moves else self._stuck_s
        self.place(self.state_at(time_s)[0])
        self._stuck_s = stuck_s

    def place(self, position_mm: float) -> None:
        """Set the position at rest and discard the movements."""
        self.rest_mm, self._brake, self._stuck_s = position_mm, None, None
        self._moves.clear()

    def _read_clock(self, time_s: float) -> float:
        return time_s if self._stuck_s is None else min(time_s, self._stuck_s)
