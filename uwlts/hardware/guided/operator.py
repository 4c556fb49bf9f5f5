"""Whoever stands at the tank: told by lines of text, answers by Enter in the terminal or by the button of the page."""

import os
import select
import sys
import time
from collections.abc import Callable

_LOOK_S = 0.1


class Operator:
    """Says lines and reads answers, without stopping what goes on meanwhile.

    Parameters
    ----------
    say : callable
        Called with every line.
    button : callable
        Whether the page's button was pressed since it was last asked.
    answers : file descriptor or None
        Where lines come from; standard input unless given.
    """

    def __init__(self, say: Callable[[str], None], *, button: Callable[[], bool], answers: int | None = None):
        self.say, self._button = say, button
        self._answers: int | None = sys.stdin.fileno() if answers is None else answers
        self._typed = b""
        self._last = ""

    def hint(self, line: str) -> None:
        """Say a line, unless it was the hint before."""
        if line != self._last:
            self._last = line
            self.say(line)

    def answer(self) -> str | None:
        """A line typed since, without its end: "" for Enter alone or the button; None where there is none."""
        if self._button():
            return ""
        # Not sys.stdin's own reading: it would wait, and a waiting thread would keep the program from ending.
        while self._answers is not None and select.select([self._answers], [], [], 0)[0]:
            piece = os.read(self._answers, 4096)
            if not piece:
                # Nobody is at the terminal; the button is left.
                self._answers = None
            self._typed += piece
        line, end, rest = self._typed.partition(b"\n")
        if not end:
            return None
        self._typed = rest
        return line.decode(errors="replace").strip().lower()

    def wait(self, request: str, meanwhile: Callable[[], None] = lambda: time.sleep(_LOOK_S)) -> str:
        """Say what is to be done and wait for the answer."""
        self.say(f"{request}; then press Enter")
        while (answer := self.answer()) is None:
            meanwhile()
        return answer


class HandSwitchedLaser:
    """In place of a stage where there is none: the operator switches the laser, and nothing moves."""

    limits_mm = (-float("inf"), float("inf"))
    version = "none"

    def __init__(self, operator: Operator):
        self._operator = operator
        self.laser_power = 0.0

    def position_mm(self) -> float:
        """Nothing moves."""
        return 0.0

    def move_to(self, position_mm: float, *, feed_mm_per_min: float) -> float:
        """Nothing moves."""
        return 0.0

    def laser(self, on: bool, *, power: float = 1.0) -> None:
        """Ask for it."""
        request = "switch the laser on and the lamp off" if on else "switch the laser off and the lamp on"
        self._operator.wait(request)
        self.laser_power = power if on else 0.0
