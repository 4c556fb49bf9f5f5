"""Dialogue with the operator of a guided calibration: text, answers by Enter, words or buttons, and a screen."""

import os
import select
import sys
import time
from collections.abc import Callable
from typing import Protocol

import numpy as np

from uwlts.calibration.guidance.pose_advice import Coverage
from uwlts.hardware.rig import LaserStage

_LOOK_S = 0.1  # between looks at what is waited for
ANSWERS = ("take", "skip", "done")
"""Take the target as it is now; ask for another pose; end this phase with what is recorded."""


class Screen(Protocol):
    """Display of a guided calibration, with buttons for the answers."""

    def answer(self) -> str | None:
        """Return the answer given since the last call, one of `ANSWERS`, or None."""

    def request(self, text: str) -> None:
        """Show what the operator should do."""

    def live(
        self, image: np.ndarray, *, full_dn: int, points: np.ndarray | None, stripe: np.ndarray | None, remark: str
    ) -> None:
        """Show an image (H, W) with the points of the target and the pixels of the stripe found in it, (N, 2) in px.

        ``full_dn`` is the grey value of a saturated pixel; ``remark`` stands below the image.
        """

    def show_coverage(self, coverage: Coverage, pixels: list[np.ndarray]) -> None:
        """Show the coverage, with the points (N, 2) of each image."""

    def add(self, line: str) -> None:
        """Add a line to the list of images."""

    def set_stage(self, stage: LaserStage | None) -> None:
        """Set the stage that now switches the laser, or None once it is closed."""


class Operator:
    """Output of lines and input of answers without blocking.

    ``say`` is called with every line. Answers come from the ``screen`` and, one per line, from the file descriptor
    ``answers``, by default standard input: an empty line for "take", or one of `ANSWERS`.
    """

    def __init__(self, say: Callable[[str], None], screen: Screen, *, answers: int | None = None):
        self.say, self._screen = say, screen
        self._answers: int | None = sys.stdin.fileno() if answers is None else answers
        self._typed = b""
        self._last = ""

    def hint(self, line: str) -> None:
        """Output a line unless it repeats the previous hint."""
        if line != self._last:
            self._last = line
            self.say(line)

    def answer(self) -> str | None:
        """Return the answer given since the last call, one of `ANSWERS`, or None."""
        if (pressed := self._screen.answer()) is not None:
            return pressed
        # sys.stdin would block, and a blocked thread would keep the program from ending.
        while self._answers is not None and select.select([self._answers], [], [], 0)[0]:
            piece = os.read(self._answers, 4096)
            if not piece:
                # No terminal: only the buttons remain.
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
        """Output a request and wait for the answer."""
        self.say(f"{request}; then press Enter")
        while (answer := self.answer()) is None:
            meanwhile()
        return answer
