"""Table of measured figures: campaign, scan, method, figure, true and measured value, and stated uncertainty.

A row is one measurement. Rows of the same scan, method and figure are repetitions: their errors are compared with their
stated uncertainties.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

import numpy as np
from pydantic import BaseModel

from uwlts.model.brief import Brief, align_columns
from uwlts.runtime.optional_library import optional_library

if TYPE_CHECKING:
    from pandas import DataFrame

_HEAD = "scan", "figure", "U / mm", "found", "within U"


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


class FigureErrors(BaseModel, frozen=True):
    """Errors of a figure in N measurements, with their stated uncertainties.

    Attributes
    ----------
    scan, method, name : str
        Recording, calibration and figure.
    expanded_mm : tuple of N float
        Stated expanded uncertainty (k = 2) of every measurement.
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
        """Return scan, figure, stated uncertainty, twice the rms error, and number of errors within the uncertainty."""
        covered = f"{self.covered} of {len(self.errors_mm)}"
        return self.scan, self.name, f"{self.stated_mm:.4f}", f"{self.found_mm:.4f}", covered


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
        """Columns by name; missing numbers are NaN. The error is the last one."""
        names = (*MeasuredFigure.model_fields, "error_mm")
        cells = {name: [getattr(row, name) for row in self.rows] for name in names}
        return {name: np.array(value, float) if name.endswith("_mm") else value for name, value in cells.items()}

    def to_frame(self) -> DataFrame:
        """Return the table as one of pandas; SetupError if this optional library is not installed."""
        return optional_library("pandas", needed_by="a table of results", extra="frames").DataFrame(self.columns)

    def select(
        self, *, campaign: str | None = None, scan: str | None = None, method: str | None = None, figure: str = ""
    ) -> FigureTable:
        """Return the rows with the given campaign, scan and method, whose figure's name begins with ``figure``."""
        wanted = {"campaign": campaign, "scan": scan, "method": method}
        given = {name: value for name, value in wanted.items() if value is not None}
        return FigureTable(
            rows=tuple(
                row
                for row in self.rows
                if row.figure.startswith(figure) and all(getattr(row, name) == given[name] for name in given)
            )
        )

    def errors(self) -> tuple[FigureErrors, ...]:
        """Return the errors with a stated uncertainty, by scan, method and figure in the order of the rows."""
        groups: dict[tuple[str, str, str], list[tuple[float, float]]] = {}
        for row in self.rows:
            if row.error_mm is not None and row.expanded_mm is not None:
                groups.setdefault((row.scan, row.method, row.figure), []).append((row.expanded_mm, row.error_mm))
        return tuple(
            FigureErrors(scan=scan, method=method, name=figure, expanded_mm=expanded, errors_mm=errors)
            for (scan, method, figure), pairs in groups.items()
            for expanded, errors in [tuple(zip(*pairs, strict=True))]
        )

    def covered_share(self) -> float:
        """Return the fraction of all errors within their stated uncertainty; NaN without any."""
        groups = self.errors()
        count = sum(len(each.errors_mm) for each in groups)
        return sum(each.covered for each in groups) / count if count else float("nan")

    def lines(self) -> list[str]:
        """Return the errors by scan and figure as lines of text."""
        return format_errors(self.errors())


def format_errors(groups: Iterable[FigureErrors]) -> list[str]:
    """Return errors as lines of text: stated uncertainty, twice the rms error, and the number within."""
    return align_columns([_HEAD, *(each.texts() for each in groups)], right=(2, 3))
