"""Table of measured figures: campaign, scan, method, figure, true and measured value, and stated uncertainty.

A row is one measurement. Rows of the same scan, method and figure are repetitions: their errors are compared with their
stated uncertainties.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from pydantic import BaseModel

from uwlts.files.json_files import read_model, write_model
from uwlts.model.short_text import Brief, align_columns

FORMAT = "uwlts-figures"
VERSION = 1  # of the file format
_NUMBER = re.compile(r" (sphere \d+|\d+-\d+|[XYZ])$")
"""Sphere, pair of spheres or axis at the end of a figure's name."""


class MeasuredFigure(BaseModel, frozen=True):
    """One figure of one scan.

    Attributes
    ----------
    campaign : str
        Campaign of the recording.
    scan : str
        Recording.
    method : str
        Calibration of the measurement.
    figure : str
        Name of the figure in an evaluation, such as "SSE" (sphere-spacing error), or a value of an inspection with
        "error", such as "ovality error".
    true_mm : float or None
        True value; None if it is unknown, or the figure is no error of a known value.
    measured_mm : float
        Measured value.
    expanded_mm : float or None
        Stated expanded uncertainty (k = 2). It includes that of a calibrated value.
    """

    campaign: str
    scan: str
    method: str
    figure: str
    true_mm: float | None = None
    measured_mm: float
    expanded_mm: float | None = None

    @property
    def error_mm(self) -> float | None:
        """Measured minus true value."""
        return None if self.true_mm is None else self.measured_mm - self.true_mm

    def pooled_key(self) -> tuple[str, str, str]:
        """Return object and medium, method, and figure without the number of a sphere or an axis.

        A scan's name is OBJECT-PLACEMENT, and ends with "-air" if the object is in air.
        """
        scan = self.scan.split("-")[0] + " in air" * self.scan.endswith("-air")
        return scan, self.method, _NUMBER.sub("", self.figure)


class FigureErrors(BaseModel, frozen=True):
    """Errors of a figure in N measurements, with their stated uncertainties.

    Attributes
    ----------
    scan, method, name : str
        Recording, calibration and figure.
    expanded_mm : tuple of N float
        Stated expanded uncertainty (k = 2) of every measurement; NaN if none is stated.
    errors_mm : tuple of N float
        Measured minus true value.
    """

    scan: str
    method: str
    name: str
    expanded_mm: tuple[float, ...]
    errors_mm: tuple[float, ...]

    @property
    def stated_mm(self) -> float:
        """Stated expanded uncertainty (k = 2): the root mean square of all measurements."""
        return float(np.sqrt(np.mean(np.square(self.expanded_mm))))

    @property
    def found_mm(self) -> float:
        """Twice the root mean square of the errors."""
        return 2.0 * float(np.sqrt(np.mean(np.square(self.errors_mm))))

    @property
    def covered(self) -> int:
        """Number of errors within their own expanded uncertainty."""
        return int(np.count_nonzero(np.abs(self.errors_mm) <= np.array(self.expanded_mm)))

    def texts(self) -> tuple[str, ...]:
        """Return scan, calibration, figure, stated uncertainty, twice the rms error, and number of errors within it."""
        known = not np.isnan(self.stated_mm)
        stated, covered = (f"{self.stated_mm:.4f}", f"{self.covered} of {len(self.errors_mm)}") if known else "--"
        return self.scan, self.method, self.name, stated, f"{self.found_mm:.4f}", covered


class FigureTable(Brief, BaseModel, frozen=True):
    """Table of measured figures.

    Attributes
    ----------
    rows : tuple of MeasuredFigure
        One row for each figure of each scan of each campaign by each method.
    """

    rows: tuple[MeasuredFigure, ...] = ()

    @property
    def columns(self) -> dict[str, list[str] | np.ndarray]:
        """Columns by name, for `uwlts.report.to_frame`; missing numbers are NaN. The error is the last one."""
        names = (*MeasuredFigure.model_fields, "error_mm")
        cells = {name: [getattr(row, name) for row in self.rows] for name in names}
        return {name: np.array(value, float) if name.endswith("_mm") else value for name, value in cells.items()}

    def select(
        self, *, campaign: str | None = None, scan: str | None = None, method: str | None = None, figure: str = ""
    ) -> FigureTable:
        """Return the rows with the given campaign, scan and method, whose figure's name begins with ``figure``."""
        rows = [row for row in self.rows if row.figure.startswith(figure)]
        for name, value in (("campaign", campaign), ("scan", scan), ("method", method)):
            rows = [row for row in rows if value in (None, getattr(row, name))]
        return FigureTable(rows=tuple(rows))

    def errors(self) -> tuple[FigureErrors, ...]:
        """Return the errors with a stated uncertainty, by scan, method and figure in the order of the rows."""
        stated = [row for row in self.rows if row.expanded_mm is not None]
        return _group_errors(stated, [(row.scan, row.method, row.figure) for row in stated])

    def pooled_errors(self) -> tuple[FigureErrors, ...]:
        """Return all errors by object and medium, figure and method: those of its scans, spheres or axes together."""
        groups = _group_errors(self.rows, [row.pooled_key() for row in self.rows])
        order = list(dict.fromkeys((each.scan, each.name) for each in groups))
        return tuple(sorted(groups, key=lambda each: order.index((each.scan, each.name))))

    def covered_share(self) -> float:
        """Return the fraction of all errors within their stated uncertainty; NaN without any."""
        groups = self.errors()
        count = sum(len(each.errors_mm) for each in groups)
        return sum(each.covered for each in groups) / count if count else float("nan")

    def save(self, path: str | Path, *, overwrite: bool = False) -> None:
        """Write the table as indented JSON, atomically; OutputError if writing fails."""
        write_model(path, self, file_format=FORMAT, version=VERSION, overwrite=overwrite)

    def lines(self) -> list[str]:
        """Return the errors by scan and figure as lines of text."""
        return format_errors(self.errors())


def read_figures(path: str | Path) -> FigureTable:
    """Read a table of figures; CaptureError if it is missing, newer, damaged, or of another format."""
    return read_model(path, FigureTable, file_format=FORMAT, version=VERSION, called="table of figures")


def _group_errors(rows: Sequence[MeasuredFigure], keys: Sequence[tuple[str, str, str]]) -> tuple[FigureErrors, ...]:
    """Group the errors of rows by their keys: scan, method and figure."""
    groups: dict[tuple[str, str, str], list[tuple[float, float]]] = {}
    for row, key in zip(rows, keys, strict=True):
        if row.error_mm is not None:
            stated = float("nan") if row.expanded_mm is None else row.expanded_mm
            groups.setdefault(key, []).append((stated, row.error_mm))
    return tuple(
        FigureErrors(scan=scan, method=method, name=figure, expanded_mm=expanded, errors_mm=errors)
        for (scan, method, figure), pairs in groups.items()
        for expanded, errors in [tuple(zip(*pairs, strict=True))]
    )


def format_errors(groups: Iterable[FigureErrors]) -> list[str]:
    """Return errors as lines of text: stated uncertainty, twice the rms error, and the number within."""
    head = "scan", "calibration", "figure", "U / mm", "found", "within U"
    return align_columns([head, *(each.texts() for each in groups)], right=(3, 4))
