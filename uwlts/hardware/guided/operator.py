"""The operator of a guided calibration: lines of text, answers by Enter or the page's button, and the page."""

import os
import select
import sys
import threading
import time
from collections.abc import Callable

import cv2
import numpy as np

from uwlts.calibration.guidance.pose_advice import Coverage
from uwlts.hardware.live_view import LivePage, small_picture

_LOOK_S = 0.1


class Operator:
    """Says lines and reads answers, without stopping what goes on meanwhile.

    ``say`` is called with every line; ``button`` returns whether the page's button was pressed since the last call.
    ``answers`` is the file descriptor that lines are read from, standard input unless given.
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


_FOUND, _STRIPE = (0, 140, 0), (255, 60, 40)
_COVERED, _EMPTY, _DOT = (70, 140, 70), (120, 60, 60), (230, 230, 230)
_MAP_CELL_PX = 48
_SHOWN_LINES = 60


class GuidedPage(LivePage):
    """The page; its button, which only the operator has, answers like Enter in the terminal."""

    def __init__(self, title: str, *, host: str = "127.0.0.1", port: int = 8080):
        super().__init__(title, host=host, port=port)
        gui = self.server.gui
        self._request = gui.add_markdown("starting")
        self._pressed = threading.Event()
        self.operator_button("take it / go on", self._pressed.set, order=self._request.order + 0.5)
        self._remark = gui.add_markdown("")
        self._map = gui.add_image(np.zeros((2, 2, 3), np.uint8), label="seen so far", format="png")
        self._list = gui.add_markdown("no image yet")
        self._lines: list[str] = []

    def pressed(self) -> bool:
        """Whether the button was pressed since it was last asked."""
        was = self._pressed.is_set()
        self._pressed.clear()
        return was

    def request(self, text: str) -> None:
        """Show what the operator is asked to do."""
        if self._request.content != f"## {text}":
            self._request.content = f"## {text}"

    def live(
        self, image: np.ndarray, *, full_dn: int, points: np.ndarray | None, stripe: np.ndarray | None, remark: str
    ) -> None:
        """Show an image (H, W) with the points (N, 2) of the target and the stripe's pixels (N, 2) found in it."""
        picture, scale = small_picture(image, full_dn=full_dn)
        for pixels, colour, radius in ((points, _FOUND, 3), (stripe, _STRIPE, 1)):
            for u, v in np.rint((np.empty((0, 2)) if pixels is None else pixels) * scale).astype(int).tolist():
                cv2.circle(picture, (u, v), radius, colour, 2, cv2.LINE_AA)
        self.server.scene.set_background_image(picture, format="jpeg", jpeg_quality=80)
        if self._remark.content != remark:
            self._remark.content = remark

    def recorded(self, coverage: Coverage, pixels: list[np.ndarray]) -> None:
        """Show the coverage, with the points (N, 2) of every image."""
        self._map.image = coverage_picture(coverage, pixels)

    def add(self, line: str) -> None:
        """Add a line to the list of images, the latest on top."""
        self._lines.insert(0, f"- {line}")
        self._list.content = "\n".join(self._lines[:_SHOWN_LINES])


def coverage_picture(coverage: Coverage, pixels: list[np.ndarray]) -> np.ndarray:
    """Map (h, w, 3) of uint8: covered cells green, the others red, a dot for every point (N, 2) of every image."""
    cells = np.where(coverage.covered[..., None], _COVERED, _EMPTY).astype(np.uint8)
    picture = np.kron(cells, np.ones((_MAP_CELL_PX, _MAP_CELL_PX, 1), np.uint8))
    picture[::_MAP_CELL_PX] = picture[:, ::_MAP_CELL_PX] = 30
    size = np.array(picture.shape[1::-1])
    for points in pixels:
        place = ((points + 0.5) / [coverage.width_px, coverage.height_px] * size).astype(int)
        place = place[((place >= 0) & (place < size)).all(axis=1)]
        picture[place[:, 1], place[:, 0]] = _DOT
    return picture
