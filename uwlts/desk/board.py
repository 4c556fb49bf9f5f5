"""State shown on the page: written by worker threads, read by the page of every browser."""

import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal

import cv2
import numpy as np

from uwlts.desk.thinned_cloud import ThinnedCloud

Kind = Literal["note", "warning", "error"]
LaserState = Literal["none", "off", "flashing", "on", "unknown"]
"""None is connected; off; lit while images are exposed; lit; its controller cannot be reached."""
_LONGEST_SIDE_PX = 1000
_BINS = 64
KEPT_LINES = 1000
_FOUND, _STRIPE = (0, 140, 0), (40, 60, 255)


@dataclass(frozen=True, eq=False)
class Picture:
    """An image (H, W) to be shown, with the pixels (N, 2) of the stripe and (M, 2) of a target's points marked in it.

    ``full_dn`` is the full scale, ``saturated`` the share of profile lines there, where that is known. What is shown is
    made when somebody looks at it first: a recording has more images than a page shows.
    """

    image: np.ndarray
    caption: str
    full_dn: int
    stripe: np.ndarray | None = None
    points: np.ndarray | None = None
    saturated: float | None = None

    @cached_property
    def jpeg(self) -> bytes:
        """The image as a JPEG with its dark parts raised."""
        grey = np.minimum(255 * np.sqrt(self.image.astype(np.float32) / self.full_dn), 255).astype(np.uint8)
        scale = min(1.0, _LONGEST_SIDE_PX / max(grey.shape))
        size = (max(1, round(grey.shape[1] * scale)), max(1, round(grey.shape[0] * scale)))
        shown = cv2.cvtColor(cv2.resize(grey, size, interpolation=cv2.INTER_AREA), cv2.COLOR_GRAY2BGR)
        if self.stripe is not None:
            column, row = np.clip(np.rint(self.stripe * scale).astype(int), 0, np.array(size) - 1).T
            shown[row, column] = _STRIPE
        for u, v in np.rint((np.empty((0, 2)) if self.points is None else self.points) * scale).astype(int).tolist():
            cv2.circle(shown, (u, v), 3, _FOUND, 2, cv2.LINE_AA)
        return _encoded(shown, ".jpg")

    @cached_property
    def histogram(self) -> np.ndarray:
        """Shares of the pixels in equal steps of grey value."""
        return np.histogram(self.image, _BINS, (0, self.full_dn + 1))[0] / self.image.size


def png_of(picture: np.ndarray) -> bytes:
    """A picture (H, W, 3) of uint8 in red, green, blue as a PNG file."""
    return _encoded(cv2.cvtColor(picture, cv2.COLOR_RGB2BGR), ".png")


def _encoded(picture: np.ndarray, suffix: str) -> bytes:
    done, data = cv2.imencode(suffix, picture)
    if not done:
        raise ValueError(f"a picture of the shape {picture.shape} cannot be encoded as {suffix}")
    return data.tobytes()


@dataclass(frozen=True)
class Line:
    """A line of the page's log."""

    number: int
    time_s: float
    kind: Kind
    text: str


@dataclass(frozen=True)
class Progress:
    """How far the work is: ``phase`` in words, images ``done`` of a ``total``, and the time left in s.

    ``busy`` is whether something is being done.
    """

    phase: str = "not connected"
    done: int = 0
    total: int | None = None
    left_s: float | None = None
    busy: bool = False


@dataclass
class Board:
    """The content of the page. Its attributes are replaced as wholes, never changed in place; the log is kept by `say`.

    ``request`` is what the operator is asked to do, and
    ``answers`` what the buttons for it are called. ``coverage`` is a PNG of what a guided calibration has seen.
    ``detail`` gives, of a cloud of more points than are shown, those in a box from low to high (3,), mm, as `table_of`.
    """

    title: str
    progress: Progress = Progress()
    laser: LaserState = "none"
    position_mm: float | None = None
    picture: Picture | None = None
    pictures: int = 0
    request: str = ""
    answers: tuple[str, ...] = ()
    coverage: bytes | None = None
    cloud: ThinnedCloud = field(default_factory=ThinnedCloud)
    cloud_name: str = ""
    detail: Callable[[np.ndarray, np.ndarray], np.ndarray] | None = None

    def __post_init__(self) -> None:
        self._lines: deque[Line] = deque(maxlen=KEPT_LINES)
        self._lock, self._began_s = threading.Lock(), 0.0

    def say(self, text: str, kind: Kind = "note") -> None:
        """Add a line to the log."""
        with self._lock:
            number = self._lines[-1].number + 1 if self._lines else 0
            self._lines.append(Line(number, time.time(), kind, text))

    def lines(self, after: int = -1) -> list[Line]:
        """The log's lines with higher numbers."""
        with self._lock:
            return [line for line in self._lines if line.number > after]

    def phase(self, name: str, *, busy: bool = True) -> None:
        """Begin another phase of the work, or of waiting for the operator."""
        self._began_s = time.monotonic()
        self.progress = Progress(name, busy=busy)

    def count(self, done: int, total: int, *, before: int = 0) -> None:
        """So much of the phase is done, ``before`` of it when it began; the time left follows."""
        taken, since = done - before, time.monotonic() - self._began_s
        left_s = since / taken * (total - done) if taken > 0 else None
        self.progress = replace(self.progress, done=done, total=total, left_s=left_s)

    def show(self, picture: Picture) -> None:
        """Show another picture."""
        self.picture = picture
        self.pictures += 1
