"""The campaign's figures as rows: calibrated value, measured value, error, and what was published."""

import re
from dataclasses import dataclass
from typing import Literal

from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from uwlts.metrology.artefact_descriptions import Artefact
from uwlts.metrology.calibrated import calibrated_quantity
from uwlts.report.gather import Campaign, Measurement
from uwlts.report.numbers import fixed
from uwlts.report.page_toolkit import MISSING
from uwlts.report.published import CALIBRATION, Reference

_QUANTITIES = {
    "PE": "probing error PE",
    "RE": "range error RE",
    "STD": "deviations STD",
    "range": "deviations range",
}
_DETAILS = re.compile(r"(PE|STD) sphere \d+|SSE.* known radius|profile height error")
_ORDER = ("sphere spacing", "step height", "pipe diameter", "diameter", "probing", "range", "deviations", "ovality")
_WIDTH = 110


@dataclass(frozen=True)
class Row:
    """One quantity, in mm or as a share.

    ``true`` is the calibrated (or, for a twin, set) value with its ``uncertainty``; ``published`` are errors for
    quantities that have a true value of their own, else values of the quantity itself.
    """

    measurement: str
    quantity: str
    true: float | None = None
    measured: float | None = None
    error: float | None = None
    published: tuple[float, ...] = ()
    uncertainty: float | None = None
    unit: Literal["mm", "share"] = "mm"

    def texts(self) -> tuple[str, str, str, str, str, str]:
        """The row as text: measurement, quantity, true, measured, error, published."""
        if self.unit == "share":
            measured = MISSING if self.measured is None else f"{fixed(100 * self.measured, 2)} %"
        else:
            measured = fixed(self.measured)
        published = ", ".join(_as_published(value) for value in self.published) or MISSING
        error = fixed(self.error, signed=True)
        return self.measurement, self.quantity, fixed(self.true), measured, error, published


def _as_published(value: float) -> str:
    """Two decimals below a millimetre where more were not printed: 0.10 is not the same claim as 0.1."""
    return fixed(value, 2) if abs(value) < 1 and round(value, 2) == value else f"{value:g}"


def summary_table(campaign: Campaign, reference: Reference | None = None) -> list[Row]:
    """Rows of all measurements, then the window's distance of every calibration."""
    rows = [row for measurement in campaign.measurements for row in _measurement_rows(measurement, reference)]
    return rows + _window_rows(campaign, reference)


def print_table(rows: list[Row], *, published: str = "thesis", console: Console | None = None) -> None:
    """Print rows on a terminal of any kind, a dumb one included, or to a file; ``published`` heads the last column."""
    if console is None:
        usual = Console()
        console = usual if usual.is_terminal and not usual.is_dumb_terminal else Console(width=_WIDTH)
    table = Table(box=box.SIMPLE_HEAD, title="lengths in mm", title_justify="left", pad_edge=False)
    for number, heading in enumerate(("measurement", "quantity", "true", "measured", "error", published)):
        table.add_column(heading, justify="left" if number < 2 else "right", no_wrap=number >= 2)
    last = None
    for row in rows:
        name, *others = row.texts()
        if last not in (None, name):
            table.add_section()
        # Text, so that names from files are never taken for markup.
        table.add_row(*(Text(text) for text in ("" if name == last else name, *others)))
        last = name
    console.print(table)


def _measurement_rows(measurement: Measurement, reference: Reference | None) -> list[Row]:
    judged = measurement.judged
    if judged is None:
        return []
    rows = []
    if judged.evaluation is not None:
        for figure, value in judged.evaluation.figures_mm.items():
            if not _DETAILS.fullmatch(figure):
                published = () if reference is None else reference.values(measurement.known_as, figure)
                rows.append(_figure_row(measurement.name, figure, value, judged.artefact, published))
    rows.sort(key=_place)
    if judged.truth is not None:
        truth, fitted = judged.truth, judged.truth.after_best_fit
        rows.append(Row(measurement.name, "rms distance to truth", measured=truth.rms_mm))
        if fitted is not None:
            rows.append(Row(measurement.name, "rms distance after best fit", measured=fitted.rms_mm))
        best, name = (truth, "of truth") if fitted is None else (fitted, "after best fit")
        within = f"within {best.tolerance_mm:.3f} {name}"
        rows.append(Row(measurement.name, within, measured=best.share_within_tolerance, unit="share"))
    return rows


def _place(row: Row) -> int:
    return next((place for place, start in enumerate(_ORDER) if row.quantity.startswith(start)), len(_ORDER))


def _figure_row(name: str, figure: str, value: float, artefact: Artefact | None, published: tuple[float, ...]) -> Row:
    known = calibrated_quantity(figure, artefact)
    if known is None:
        return Row(name, _QUANTITIES.get(figure, figure), measured=value, published=published)
    true = known.value_mm
    return Row(name, known.name, true, true + value, value, published, known.uncertainty_mm)


def _window_rows(campaign: Campaign, reference: Reference | None) -> list[Row]:
    rows = []
    for found in campaign.calibrations:
        window = found.calibration.window
        if window is None:
            continue
        # A single interface stands for the whole window: its distance has no true value.
        plate = window.refractions == 2
        true = true_window_distance(campaign) if plate else None
        published = reference.values((CALIBRATION,), "window_distance_mm") if reference is not None and plate else ()
        error = None if true is None else window.distance_mm - true
        quantity = "window distance" if plate else "interface distance (1 refraction)"
        rows.append(Row(found.name, quantity, true, window.distance_mm, error, published))
    return rows


def true_window_distance(campaign: Campaign) -> float | None:
    """Distance of the camera's window as set in the twin; None without truth files, or where they disagree."""
    sensor = campaign.true_sensor
    return None if sensor is None else sensor.camera.window.distance_mm
