"""The page of a guided calibration: the live image with what was found, what to do next, coverage and all images."""

import threading

import cv2
import numpy as np

from uwlts.calibration.guidance.coverage import Coverage
from uwlts.live_page import LivePage, small_picture

_FOUND, _STRIPE = (0, 140, 0), (255, 60, 40)
_COVERED, _EMPTY, _DOT = (70, 140, 70), (120, 60, 60), (230, 230, 230)
_MAP_CELL_PX = 48
_SHOWN_LINES = 60


class GuidedPage(LivePage):
    """The page; its button answers like Enter in the terminal."""

    def __init__(self, title: str, *, host: str = "127.0.0.1", port: int = 8080):
        super().__init__(title, host=host, port=port)
        gui = self.server.gui
        self._request = gui.add_markdown("starting")
        self._pressed = threading.Event()
        gui.add_button("take it / go on").on_click(lambda _: self._pressed.set())
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
        """What the operator shall do."""
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
