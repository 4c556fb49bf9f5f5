"""State shown on the page, written by worker threads and read by the page of every browser; profiles of its images."""

import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal

import cv2
import numpy as np

from uwlts.inspection.picking import Section, order_profile
from uwlts.model.calibration import AnyCalibration, Calibration
from uwlts.pages.cloud_figure import CloudField
from uwlts.reconstruction.reconstruct import reconstruct_stripes
from uwlts.storage.capture import CaptureHeader, Frame, FrameTable
from uwlts.storage.cloud import PointCloud
from uwlts.stripe import CaptureStripes, Stripe

FIELDS: tuple[CloudField, ...] = ("intensity", "deviation", "random", "common")
"""Fields for colouring points besides depth: in grey values, then mm."""
_COLUMNS = 3 + len(FIELDS)  # coordinates first


class Ended(Exception):
    """Raised when the operator has ended the recording."""


def point_table(points_mm: np.ndarray, **fields: np.ndarray | None) -> np.ndarray:
    """Return points (N, 7): coordinates in mm, then fields (N,) by the names in `FIELDS`, NaN if unknown."""
    table = np.full((len(points_mm), _COLUMNS), np.nan)
    table[:, :3] = points_mm
    for column, name in enumerate(FIELDS, 3):
        if (values := fields.get(name)) is not None:
            table[:, column] = values
    return table


def pack(table: np.ndarray) -> tuple[np.ndarray, bytes]:
    """Return an origin (3,) in mm, and points (N, 7) relative to it with fields as float32, for the browser."""
    origin = np.round(np.median(table[:, :3], axis=0)) if len(table) else np.zeros(3)
    return origin, (table - np.append(origin, np.zeros(len(FIELDS)))).astype("<f4").tobytes()


class ThinnedCloud:
    """Points in mm with their fields, NaN if unknown; at most ``at_most`` are kept. Thread-safe.

    ``version`` increases with every change, ``total`` counts all points that were added.
    """

    def __init__(self, at_most: int = 300_000):
        self._lock, self._at_most = threading.Lock(), at_most
        self.version = -1
        self.clear()

    def clear(self) -> None:
        """Remove all points."""
        with self._lock:
            self._parts, self._kept, self._added, self._stride, self.total = [np.empty((0, _COLUMNS))], 0, 0, 1, 0
            self.version += 1

    def add(self, points_mm: np.ndarray, of: int | None = None, **fields: np.ndarray | None) -> None:
        """Add points (N, 3), a sample ``of`` that many, with fields (N,) by the names in `FIELDS`."""
        with self._lock:
            kept = slice(-self._added % self._stride, None, self._stride)
            known = {name: values[kept] for name, values in fields.items() if values is not None}
            self._parts.append(point_table(points_mm[kept], **known))
            self._kept += len(self._parts[-1])
            self._added += len(points_mm)
            self.total += len(points_mm) if of is None else of
            while self._kept > self._at_most:
                self._stride *= 2
                self._parts = [np.concatenate(self._parts)[::2].copy()]
                self._kept = len(self._parts[0])
            self.version += 1

    def points(self) -> np.ndarray:
        """Return the kept points (N, 7): coordinates in mm, then the fields."""
        with self._lock:
            return np.concatenate(self._parts)


@dataclass(frozen=True, eq=False)
class FrameProfile:
    """Stripe of a laser image, and the calibration that gives its points; errors are those of `reconstruct_stripes`.

    Uncertainties take several times as long as the points: displays that show every image use ``points``.
    """

    frame: Frame
    stripe: Stripe
    header: CaptureHeader
    calibration: AnyCalibration

    @cached_property
    def points(self) -> PointCloud:
        """Points (N,) of the stripe, without uncertainty."""
        return self._reconstruct(with_uncertainty=False)

    @cached_property
    def section(self) -> Section:
        """Points in their order along the stripe, with uncertainty if the calibration states it."""
        return order_profile(self.measured())

    def measured(self) -> PointCloud:
        """Return the points (N,) of the stripe, with uncertainty if the calibration states it."""
        known = isinstance(self.calibration, Calibration) and self.calibration.joint is not None
        return self._reconstruct(with_uncertainty=known)

    def _reconstruct(self, *, with_uncertainty: bool) -> PointCloud:
        stripe, line = self.stripe, self.stripe.lines
        first, centre = np.zeros(len(line), dtype=int), stripe.centre_px[line]
        stripes = CaptureStripes(first, line, centre, stripe.amplitude[line], stripe.width_px[line], {})
        table = FrameTable.from_frames(self.header, [self.frame])
        return reconstruct_stripes(table, stripes, self.calibration, with_uncertainty=with_uncertainty)


Kind = Literal["note", "warning", "error"]
LaserState = Literal["none", "off", "flashing", "on", "unknown"]
"""No laser connected; off; on while images are exposed; on; controller unreachable."""
_LONGEST_SIDE_PX = 1000  # of displayed images: a screen shows no more
_BINS = 64  # of the displayed histogram
KEPT_LINES = 1000  # of messages
_FOUND, _STRIPE = (0, 140, 0), (40, 60, 255)


@dataclass(frozen=True, eq=False)
class Picture:
    """An image (H, W) to be shown, with the pixels (N, 2) of the stripe and the points (M, 2) of a target.

    ``full_dn`` is full scale, and ``saturated`` the fraction of saturated profile lines, if known. The encoded image is
    made on first use, because a recording has more images than a page shows.
    """

    image: np.ndarray
    caption: str
    full_dn: int
    stripe: np.ndarray | None = None
    points: np.ndarray | None = None
    saturated: float | None = None

    @cached_property
    def jpeg(self) -> bytes:
        """The image as a JPEG with its dark parts brightened."""
        grey = np.minimum(255 * np.sqrt(self.image.astype(np.float32) / self.full_dn), 255).astype(np.uint8)
        scale = min(1.0, _LONGEST_SIDE_PX / max(grey.shape))
        size = (max(1, round(grey.shape[1] * scale)), max(1, round(grey.shape[0] * scale)))
        shown = cv2.cvtColor(cv2.resize(grey, size, interpolation=cv2.INTER_AREA), cv2.COLOR_GRAY2BGR)
        if self.stripe is not None:
            column, row = np.clip(np.rint(self.stripe * scale).astype(int), 0, np.array(size) - 1).T
            shown[row, column] = _STRIPE
        for u, v in np.rint((np.empty((0, 2)) if self.points is None else self.points) * scale).astype(int).tolist():
            cv2.circle(shown, (u, v), 3, _FOUND, 2, cv2.LINE_AA)
        return cv2.imencode(".jpg", shown)[1].tobytes()

    @cached_property
    def histogram(self) -> np.ndarray:
        """Fractions of the pixels in equal intervals of grey value."""
        return np.histogram(self.image, _BINS, (0, self.full_dn + 1))[0] / self.image.size


@dataclass(frozen=True)
class ShownLine:
    """A line of the page's log."""

    number: int
    time_s: float
    kind: Kind
    text: str


@dataclass(frozen=True)
class Progress:
    """Progress of the work: name of the ``phase``, images ``done`` of a ``total``, and remaining time in s.

    ``busy``: work is in progress.
    """

    phase: str = "not connected"
    done: int = 0
    total: int | None = None
    left_s: float | None = None
    busy: bool = False


@dataclass
class Board:
    """Content of the page; attributes are replaced, never changed in place, and `say` appends to the log.

    ``request`` is what the operator should do; its buttons are shown with it. ``coverage`` is a PNG of the image area
    covered in a guided calibration. ``detail`` returns, for a cloud that is shown thinned, the points in a box from low
    to high (3,) in mm, in the form of `point_table`. ``profile`` is that of the latest laser image, if a calibration is
    chosen.
    """

    title: str
    progress: Progress = Progress()
    laser: LaserState = "none"
    position_mm: float | None = None
    picture: Picture | None = None
    pictures: int = 0
    request: str = ""
    coverage: bytes | None = None
    cloud: ThinnedCloud = field(default_factory=ThinnedCloud)
    cloud_name: str = ""
    deviates: bool = False  # whether the named cloud has deviations
    detail: Callable[[np.ndarray, np.ndarray], np.ndarray] | None = None
    profile: FrameProfile | None = None

    def __post_init__(self) -> None:
        self._lines: deque[ShownLine] = deque(maxlen=KEPT_LINES)
        self._lock, self._began_s = threading.Lock(), 0.0

    def say(self, text: str, kind: Kind = "note") -> None:
        """Add a line to the log."""
        with self._lock:
            number = self._lines[-1].number + 1 if self._lines else 0
            self._lines.append(ShownLine(number, time.time(), kind, text))

    def lines(self, after: int = -1) -> list[ShownLine]:
        """Return the log's lines with higher numbers."""
        with self._lock:
            return [line for line in self._lines if line.number > after]

    def phase(self, name: str, *, busy: bool = True) -> None:
        """Begin another phase of work, or of waiting for the operator."""
        self._began_s = time.monotonic()
        self.progress = Progress(name, busy=busy)

    def count(self, done: int, total: int, *, before: int = 0) -> None:
        """Set the progress of the phase and the remaining time; ``before`` was done when the phase began."""
        taken, since = done - before, time.monotonic() - self._began_s
        left_s = since / taken * (total - done) if taken > 0 else None
        self.progress = replace(self.progress, done=done, total=total, left_s=left_s)

    def show(self, picture: Picture) -> None:
        """Show another picture."""
        self.picture = picture
        self.pictures += 1
