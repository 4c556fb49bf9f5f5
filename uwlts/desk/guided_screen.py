"""Dialogue with the operator of a guided calibration: text and answers on the board."""

import queue
import time
from collections.abc import Callable

import cv2
import numpy as np

from uwlts.calibration.guidance import Coverage
from uwlts.desk.laser_switch import LaserSwitch
from uwlts.desk.shown_state import Board, Ended, Picture
from uwlts.errors import HardwareError
from uwlts.hardware.grbl import GrblStage
from uwlts.hardware.rig import LaserStage

_LOOK_S = 0.1  # between looks at what is waited for
ANSWERS = ("take", "skip", "done")
"""Take the target as it is now; ask for another pose; end this phase with what is recorded."""
_COVERED, _EMPTY, _DOT = (70, 140, 70), (120, 60, 60), (230, 230, 230)
_MAP_CELL_PX = 48  # size of a cell of the map on the screen


class BoardScreen:
    """Display of a guided calibration on a board, and the operator's answers by its buttons."""

    def __init__(self, board: Board, switch: LaserSwitch):
        self._board, self.switch, self.say = board, switch, board.say
        self._given: queue.SimpleQueue[str] = queue.SimpleQueue()
        self._hint = ""
        self._stage: LaserStage | None = None
        self._ending = self._darkened = False

    def press(self, answer: str) -> None:
        """Store a button's answer."""
        self._given.put(answer)

    def end(self) -> None:
        """End the recording at the next request for an answer; accepted images are kept."""
        self._ending = True

    def laser_off(self) -> None:
        """Switch the laser off at any time; the recording ends and accepted images are kept."""
        if isinstance(stage := self._stage, GrblStage):
            self._darkened = True
            darken(stage, self._board)
        else:
            self._board.say("no laser is connected to this program: switch it off by its own switch", "warning")

    def answer(self) -> str | None:
        """Return the oldest answer not yet returned, one of `ANSWERS`, or None.

        Raises Ended after `end`, and HardwareError after the laser was switched off.
        """
        if self._ending:
            raise Ended
        if self._darkened:
            # Images of a hand-held target do not need the stage, whose fault would end the recording later.
            raise HardwareError("the laser was switched off by hand, which ends the calibration: continue it later")
        return None if self._given.empty() else self._given.get()

    def wait(self, request: str, meanwhile: Callable[[], None] = lambda: time.sleep(_LOOK_S)) -> str:
        """Output a request and wait for the answer."""
        self.say(f"{request}; then press take")
        while (answer := self.answer()) is None:
            meanwhile()
        return answer

    def hint(self, line: str) -> None:
        """Output a line unless it repeats the previous hint."""
        if line != self._hint:
            self._hint = line
            self.say(line)

    def request(self, text: str) -> None:
        """Show what the operator should do."""
        self._board.request = text

    def show(self, picture: Picture) -> None:
        """Show an image."""
        self._board.show(picture)
        if isinstance(self._stage, GrblStage):
            self._board.laser = "on" if self._stage.laser_power > 0 else "flashing"

    def show_coverage(self, coverage: Coverage, pixels: list[np.ndarray]) -> None:
        """Show a map of the coverage: green and red cells, and a dot for each point (N, 2) of the images."""
        cells = np.where(coverage.covered[..., None], _COVERED, _EMPTY).astype(np.uint8)
        picture = np.kron(cells, np.ones((_MAP_CELL_PX, _MAP_CELL_PX, 1), np.uint8))
        picture[::_MAP_CELL_PX] = picture[:, ::_MAP_CELL_PX] = 30
        size = np.array(picture.shape[1::-1])
        for points in pixels:
            place = ((points + 0.5) / [coverage.width_px, coverage.height_px] * size).astype(int)
            place = place[((place >= 0) & (place < size)).all(axis=1)]
            picture[place[:, 1], place[:, 0]] = _DOT
        self._board.coverage = cv2.imencode(".png", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))[1].tobytes()

    def set_stage(self, stage: LaserStage | None) -> None:
        """Set the stage that now switches the laser, or None once it is closed."""
        self._stage = stage
        self.switch.lend(stage)
        self._board.laser = "flashing" if isinstance(stage, GrblStage) else "none"


def darken(stage: GrblStage, board: Board) -> None:
    """Switch the laser off at once, in any state of the stage, and report the result."""
    if stage.darken():
        board.say("laser switched off by hand: unlock the stage if it stood still, else home it", "warning")
    else:
        board.say("the laser CANNOT be switched off: switch its power off before going near", "error")
