"""Judges every frame a camera delivers: complete, the one expected, in time?

Cameras count their frames and stamp them with their own clock. What a driver delivers can still lack packets, come
twice, come late, or leave out frames that were lost on the way.
"""

from dataclasses import dataclass
from enum import StrEnum

# GigE Vision 1.x counts frames in 16 bits and leaves out 0.
_COUNTER_16_BIT = 2**16 - 1


class FrameStatus(StrEnum):
    """What is wrong with a frame, the worst first where several things are.

    SHORT: parts of the image are missing. DUPLICATED: the previous frame once more, by its number or its time stamp.
    DROPPED: good, but frames before it are lost. LATE: good, but its time stamp is over a period later than its number
    says, or it came after a later frame, or after nobody waited for it any more.
    """

    SHORT = "short"
    DUPLICATED = "duplicated"
    DROPPED = "dropped"
    LATE = "late"
    OK = "ok"


@dataclass(frozen=True)
class FrameCounts:
    """How many frames were ok, short, duplicated or late, how many were lost, and how many triggers unanswered."""

    ok: int = 0
    short: int = 0
    duplicated: int = 0
    dropped: int = 0
    late: int = 0
    unanswered: int = 0


class FrameCheck:
    """Compares each frame with the one before.

    Parameters
    ----------
    period_s : float, optional
        Time between frames of a free-running camera in s; without it no frame is late by its time stamp.
    """

    def __init__(self, *, period_s: float | None = None):
        self._period_s = period_s
        self._last_id: int | None = None
        self._last_time_s: float | None = None
        self._counts = dict.fromkeys(("ok", "short", "duplicated", "dropped", "late", "unanswered"), 0)

    @property
    def counts(self) -> FrameCounts:
        """What was found so far."""
        return FrameCounts(**self._counts)

    def judge(self, *, frame_id: int, time_s: float | None, complete: bool) -> FrameStatus:
        """Status of the next frame: its number, its time stamp in s (None: it has none), whether nothing is missing."""
        advance = 1 if self._last_id is None else _advance(self._last_id, frame_id)
        same_time = time_s is not None and time_s == self._last_time_s
        self._counts["dropped"] += max(advance - 1, 0)
        if not complete:
            status = FrameStatus.SHORT
        elif advance == 0 or same_time:
            status = FrameStatus.DUPLICATED
        elif advance > 1:
            status = FrameStatus.DROPPED
        elif advance < 0 or self._is_late(time_s):
            status = FrameStatus.LATE
        else:
            status = FrameStatus.OK
        # Frames that were lost are counted above, one by one.
        if status is not FrameStatus.DROPPED:
            self._counts[status.value] += 1
        if advance >= 0:
            self._last_id, self._last_time_s = frame_id, time_s
        return status

    def _is_late(self, time_s: float | None) -> bool:
        if self._period_s is None or time_s is None or self._last_time_s is None:
            return False
        return time_s - self._last_time_s > 2 * self._period_s

    def missed(self) -> None:
        """Take note that a trigger was not answered; the acquisition restarts, and the camera may count afresh."""
        self._counts["unanswered"] += 1
        self._last_id = self._last_time_s = None

    def unasked(self) -> None:
        """Take note of a frame that came when nobody waited for it any more, and was thrown away."""
        self._counts["late"] += 1
        self._last_id = self._last_time_s = None


def _advance(last: int, now: int) -> int:
    """How many numbers a frame is ahead of the one before: 1 is the next, 0 the same, negative an older one."""
    wrapped = last <= _COUNTER_16_BIT and last - now > _COUNTER_16_BIT // 2
    # A counter that does not leave out 0 would seem to stand still there.
    return max(now - last + _COUNTER_16_BIT, 1) if wrapped else now - last
