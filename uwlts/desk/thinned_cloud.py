"""Cloud of bounded size for the view: every n-th point, where n doubles when there are too many."""

import threading

import numpy as np

from uwlts.pages.cloud_figure import CloudField

FIELDS: tuple[CloudField, ...] = ("intensity", "deviation", "random", "common")
"""Fields for colouring points besides depth: in grey values, then mm."""
_COLUMNS = 3 + len(FIELDS)  # coordinates first


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
        self._clear()
        self.version = 0

    def _clear(self) -> None:
        self._table = np.empty((self._at_most, _COLUMNS))
        self._count, self._added, self._stride, self.total = 0, 0, 1, 0

    def clear(self) -> None:
        """Remove all points."""
        with self._lock:
            self._clear()
            self.version += 1

    def add(self, points_mm: np.ndarray, of: int | None = None, **fields: np.ndarray | None) -> None:
        """Add points (N, 3), a sample ``of`` that many, with fields (N,) by the names in `FIELDS`."""
        with self._lock:
            first = -self._added % self._stride
            self._added += len(points_mm)
            self.total += len(points_mm) if of is None else of
            kept = slice(first, None, self._stride)
            known = {name: values for name, values in fields.items() if values is not None}
            table = point_table(points_mm[kept], **{name: values[kept] for name, values in known.items()})
            while len(table):
                fitting, table = np.split(table, [self._at_most - self._count])
                self._table[self._count : self._count + len(fitting)] = fitting
                self._count += len(fitting)
                if self._count == self._at_most:
                    # Keep every second point of both parts, because one stride separates the kept points.
                    self._stride *= 2
                    halved = self._table[::2].copy()
                    self._table[: len(halved)], self._count = halved, len(halved)
                    table = table[self._at_most % 2 :: 2]
            self.version += 1

    def points(self) -> np.ndarray:
        """Return the kept points (N, 7): coordinates in mm, then the fields."""
        with self._lock:
            return self._table[: self._count].copy()
