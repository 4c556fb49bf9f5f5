"""The operator of a guided calibration: lines of text, answers by Enter, words or buttons, and what is shown."""

import os
import select
import sys
import time
from collections.abc import Callable
from typing import Protocol

import numpy as np

from uwlts.calibration.guidance.pose_advice import Coverage
from uwlts.hardware.rig import LaserStage

_LOOK_S = 0.1
ANSWERS = ("take", "skip", "done")
"""Take what stands there now; ask for something else; end this part with what there is."""


class Screen(Protocol):
    """Where a guided calibration is shown, and where buttons answer."""

    def answer(self) -> str | None:
        """One of `ANSWERS` that was given since the last call; None where there is none."""

    def request(self, text: str) -> None:
        """Show what the operator is asked to do."""

    def live(
        self, image: np.ndarray, *, full_dn: int, points: np.ndarray | None, stripe: np.ndarray | None, remark: str
    ) -> None:
        """Show an image (H, W) with the points (N, 2) of the target and the stripe's pixels (N, 2) found in it."""

    def recorded(self, coverage: Coverage, pixels: list[np.ndarray]) -> None:
        """Show the coverage, with the points (N, 2) of every image."""

    def add(self, line: str) -> None:
        """Add a line to the list of images."""

    def connected(self, stage: LaserStage | None) -> None:
        """The stage that switches the laser from now on; None once it is closed."""


class Operator:
    """Says lines and reads answers, without stopping what goes on meanwhile.

    ``say`` is called with every line. Answers come from the ``screen`` and, a line each, from the file descriptor
    ``answers``, standard input unless given: Enter alone for "take", or one of `ANSWERS`.
    """

    def __init__(self, say: Callable[[str], None], screen: Screen, *, answers: int | None = None):
        self.say, self._screen = say, screen
        self._answers: int | None = sys.stdin.fileno() if answers is None else answers
        self._typed = b""
        self._last = ""

    def hint(self, line: str) -> None:
        """Say a line, unless it was the hint before."""
        if line != self._last:
            self._last = line
            self.say(line)

    def answer(self) -> str | None:
        """The answer given since the last call, one of `ANSWERS`; None where there is none."""
        if (pressed := self._screen.answer()) is not None:
            return pressed
        # Not sys.stdin's own reading: it would wait, and a waiting thread would keep the program from ending.
        while self._answers is not None and select.select([self._answers], [], [], 0)[0]:
            piece = os.read(self._answers, 4096)
            if not piece:
                # Nobody is at the terminal; the buttons are left.
                self._answers = None
            self._typed += piece
        line, end, rest = self._typed.partition(b"\n")
        if not end:
            return None
        self._typed = rest
        word = line.decode(errors="replace").strip().lower() or "take"
        if word not in ANSWERS:
            self.say(f"'{word}' is not understood: press Enter to take it, or type skip or done")
            return None
        return word

    def wait(self, request: str, meanwhile: Callable[[], None] = lambda: time.sleep(_LOOK_S)) -> str:
        """Say what is to be done and wait for the answer."""
        self.say(f"{request}; then press Enter")
        while (answer := self.answer()) is None:
            meanwhile()
        return answer
