"""Tables of a campaign: results of its measurements, and parameters and residuals of its calibrations."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np
from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from uwlts.errors import make_printable
from uwlts.model.calibration import Calibration
from uwlts.optics.nominal import nominal_calibration
from uwlts.pages.numbers import entries_of, format_fixed, format_number, is_number, split_name, unit_of
from uwlts.pages.toolkit import MISSING, ComparisonTable
from uwlts.report.gather import CALIBRATION, GatheredCalibration, GatheredCampaign, GatheredMeasurement, Reference
from uwlts.report.parameters import parameter_rows
from uwlts.report.plot import SHORT_LIST
from uwlts.runtime.console import table_console

_QUANTITIES = {"PE": "probing error PE", "RE": "range error RE", "STD": "deviations STD", "range": "deviations range"}
_ORDER = ("sphere spacing", "step height", "pipe diameter", "diameter", "probing", "range", "deviations", "ovality")


@dataclass(frozen=True)
class Row:
    """One quantity, in mm or as a fraction.

    ``true`` is the calibrated value (for a twin: the set value) with its ``uncertainty``. ``stated`` is the expanded
    uncertainty (k = 2) of the measured value. ``published`` are errors of quantities with a true value, else values of
    the quantity itself.
    """

    measurement: str
    quantity: str
    true: float | None = None
    measured: float | None = None
    error: float | None = None
    stated: float | None = None
    published: tuple[float, ...] = ()
    uncertainty: float | None = None
    unit: Literal["mm", "share"] = "mm"

    def texts(self) -> tuple[str, str, str, str, str, str, str]:
        """Return the row as text: measurement, quantity, true, measured, error, stated, published."""
        if self.unit == "share":
            measured = MISSING if self.measured is None else f"{format_fixed(100 * self.measured, 2)} %"
        else:
            measured = format_fixed(self.measured)
        # Published values below 1 mm keep two decimals: 0.10 states more than 0.1.
        published = [format_fixed(v, 2) if abs(v) < 1 and round(v, 2) == v else f"{v:g}" for v in self.published]
        error, stated = format_fixed(self.error, signed=True), format_fixed(self.stated)
        known = format_fixed(self.true), measured, error, stated
        return self.measurement, self.quantity, *known, ", ".join(published) or MISSING


def summary_table(campaign: GatheredCampaign, reference: Reference | None = None) -> list[Row]:
    """Return rows for all measurements, then for the window distance of every calibration."""
    rows = [row for measurement in campaign.measurements for row in _measurement_rows(measurement, reference)]
    return rows + _window_rows(campaign, reference)


def print_table(rows: list[Row], *, console: Console | None = None) -> None:
    """Print rows on a terminal of any kind or to a file."""
    console = console or table_console()
    table = Table(box=box.SIMPLE_HEAD, title="lengths in mm", title_justify="left", pad_edge=False)
    for number, heading in enumerate(("measurement", "quantity", "true", "measured", "error", "U (k = 2)", "thesis")):
        table.add_column(heading, justify="left" if number < 2 else "right", no_wrap=number >= 2)
    last = None
    for row in rows:
        name, *others = map(make_printable, row.texts())
        if last not in (None, name):
            table.add_section()
        # Text, so that names from files are not interpreted as markup.
        table.add_row(*(Text(text) for text in ("" if name == last else name, *others)))
        last = name
    console.print(table)


def _measurement_rows(measurement: GatheredMeasurement, reference: Reference | None) -> list[Row]:
    judged = measurement.judged
    if judged is None:
        return []
    rows, keys = [], judged.figure_keys()
    for figure, value in ({} if judged.evaluation is None else judged.evaluation.figures_mm).items():
        key = keys.get(figure)
        if key is not None and key.is_detail:
            continue
        published = () if reference is None else reference.values(measurement.known_as, figure)
        stated = judged.uncertainty[figure].expanded_mm if figure in judged.uncertainty else None
        if key is None or key.calibrated is None:
            name = _QUANTITIES.get(figure, figure)
            rows.append(Row(measurement.name, name, measured=value, stated=stated, published=published))
        else:
            name, true, std = key.calibrated.name, key.calibrated.value_mm, key.calibrated.uncertainty_mm
            rows.append(Row(measurement.name, name, true, true + value, value, stated, published, std))
    rows.sort(key=lambda row: [*map(row.quantity.startswith, _ORDER), True].index(True))
    if judged.truth is not None:
        truth, fitted = judged.truth, judged.truth.after_best_fit
        rows.append(Row(measurement.name, "rms distance to truth", measured=truth.rms_mm))
        if fitted is not None:
            rows.append(Row(measurement.name, "rms distance after best fit", measured=fitted.rms_mm))
        best, name = (truth, "of truth") if fitted is None else (fitted, "after best fit")
        within = f"within {best.tolerance_mm:.3f} {name}"
        rows.append(Row(measurement.name, within, measured=best.share_within_tolerance, unit="share"))
    return rows


def _window_rows(campaign: GatheredCampaign, reference: Reference | None) -> list[Row]:
    rows = []
    for found in campaign.calibrations:
        window = found.calibration.window
        if window is None:
            continue
        # A single interface represents the whole window: no true value of its distance exists.
        pane = window.refractions == 2
        true = campaign.true_window_mm if pane else None
        published = reference.values((CALIBRATION,), "window_distance_mm") if reference is not None and pane else ()
        error = None if true is None else window.distance_mm - true
        quantity = "window distance" if pane else "interface distance (1 refraction)"
        rows.append(Row(found.name, quantity, true, window.distance_mm, error, published=published))
    return rows


def parameter_table(campaign: GatheredCampaign) -> ComparisonTable:
    """Return all parameters with units and known standard deviations; the last column shows a twin's true values."""
    columns = [(found.name, _parameters(found.calibration)) for found in campaign.calibrations]
    if campaign.true_sensor is not None:
        columns.append(("true", _parameters(nominal_calibration(campaign.true_sensor))))
    return _combine_columns(columns)


def residual_table(calibrations: tuple[GatheredCalibration, ...]) -> ComparisonTable:
    """Return all scalar residual figures of the calibrations by name."""
    return _combine_columns([(found.name, dict(_figures(found.calibration))) for found in calibrations])


def _combine_columns(columns: list[tuple[str, dict[tuple[str, str], str]]]) -> ComparisonTable:
    """Combine columns given by heading, each a table of texts by words and unit."""
    rows = dict.fromkeys(row for _, table in columns for row in table)
    return ComparisonTable(
        tuple(heading for heading, _ in columns),
        tuple((*row, tuple(table.get(row, MISSING) for _, table in columns)) for row in rows),
    )


def _parameters(calibration: Calibration) -> dict[tuple[str, str], str]:
    """Return texts of the parameters, with known standard uncertainties, and of derived quantities."""
    table = {}
    for row in parameter_rows(calibration):
        value, std = row.texts()
        table[row.words, row.unit] = value if std == MISSING else f"{value} ± {std}"
    sheet, window = calibration.sheet, calibration.window
    table["stand-off: sheet on the camera's axis", "mm"] = format_fixed(calibration.object_transform()[2, 3])
    table["angle between camera and sheet", "°"] = format_fixed(
        math.degrees(math.asin(min(1, abs(sheet.normal[2])))), 4
    )
    table["sheet's distance from the camera", "mm"] = format_fixed(sheet.offset_mm)
    if window is not None:
        table["refractions", ""] = str(window.refractions)
        cosine = float(window.normal[2] / np.linalg.norm(window.normal))
        table["window tilt", "°"] = format_fixed(math.degrees(math.acos(min(1, cosine))), 3)
    return table


def _figures(calibration: Calibration) -> Iterator[tuple[tuple[str, str], str]]:
    """Yield name with unit, and text, of every scalar residual figure."""
    for group, name, value in entries_of(calibration.residuals_in_file()):
        words = f"{group}: {split_name(name)}" if group else split_name(name)
        if group == "camera std":
            # Standard deviations of the camera are shown with its parameters.
            continue
        if is_number(value):
            yield (words, unit_of(name)), format_number(value)
        elif isinstance(value, bool):
            yield (words, unit_of(name)), "yes" if value else "no"
        elif isinstance(value, str):
            yield (words, ""), value
        elif isinstance(value, list) and 0 < len(value) <= SHORT_LIST and all(map(is_number, value)):
            yield (words, unit_of(name)), ", ".join(map(format_number, value))
