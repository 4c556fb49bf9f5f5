"""Tables of a campaign: results of its measurements, and parameters and residuals of its calibrations."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from uwlts.metrology.evaluation import FigureKey
from uwlts.model.calibration import Calibration
from uwlts.optics.nominal import nominal_calibration
from uwlts.report.gather import CALIBRATION, Campaign, GatheredCalibration, Measurement, Reference
from uwlts.report.numbers import fixed, is_number, plain, unit_of, words_of
from uwlts.report.page_toolkit import MISSING, Comparison
from uwlts.report.plot import SHORT_LIST

_QUANTITIES = {"PE": "probing error PE", "RE": "range error RE", "STD": "deviations STD", "range": "deviations range"}
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
        keys = judged.figure_keys()
        for figure, value in judged.evaluation.figures_mm.items():
            key = keys.get(figure)
            if key is None or not key.is_detail:
                published = () if reference is None else reference.values(measurement.known_as, figure)
                rows.append(_figure_row(measurement.name, figure, value, key, published))
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


def _figure_row(name: str, figure: str, value: float, key: FigureKey | None, published: tuple[float, ...]) -> Row:
    known = None if key is None else key.calibrated
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


_STD_NAMES = {"fx_px": ("fx", "f"), "fy_px": ("fy", "f"), "cx_px": ("cx",), "cy_px": ("cy",)}


def parameter_table(campaign: Campaign) -> Comparison:
    """All parameters with their units and, where known, standard deviations; a last column of a twin's true values."""
    columns = [found.name for found in campaign.calibrations]
    parameters = [_parameters(found.calibration) for found in campaign.calibrations]
    if campaign.true_sensor is not None:
        columns.append("true")
        parameters.append(_parameters(nominal_calibration(campaign.true_sensor)))
    names = dict.fromkeys(name for table in parameters for name in table)
    return Comparison(
        tuple(columns), tuple((*name, tuple(table.get(name, MISSING) for table in parameters)) for name in names)
    )


def residual_table(calibrations: tuple[GatheredCalibration, ...]) -> Comparison:
    """Every single figure that the residuals of the calibrations hold, by its name."""
    tables = [dict(_figures(found.calibration.residuals_in_file(), "")) for found in calibrations]
    names = dict.fromkeys(name for table in tables for name in table)
    return Comparison(
        tuple(found.name for found in calibrations),
        tuple((*name, tuple(table.get(name, MISSING) for table in tables)) for name in names),
    )


def _parameters(calibration: Calibration) -> dict[tuple[str, str], str]:
    camera, window, sheet = calibration.camera, calibration.window, calibration.sheet
    std = _camera_std(calibration)
    table = {}
    for key, words in {
        "fx_px": "focal length, x",
        "fy_px": "focal length, y",
        "cx_px": "principal point, x",
        "cy_px": "principal point, y",
    }.items():
        known = next((std[name] for name in _STD_NAMES[key] if name in std), None)
        table[words, "px"] = _with_std(getattr(camera, key), known, 3)
    for name in ("k1", "k2", "k3", "p1", "p2"):
        table[f"distortion {name}", ""] = _with_std(getattr(camera.distortion, name), std.get(name), 6)
    pose = calibration.object_transform()
    table["stand-off: sheet on the camera's axis", "mm"] = fixed(pose[2, 3])
    table["angle between camera and sheet", "°"] = fixed(math.degrees(math.asin(min(1, abs(sheet.normal[2])))), 4)
    table["sheet's distance from the camera", "mm"] = fixed(sheet.offset_mm)
    if window is not None:
        table["refractions", ""] = str(window.refractions)
        known = calibration.figures("window").get("std_mm")
        table["window distance d", "mm"] = _with_std(window.distance_mm, known if is_number(known) else None, 3)
        cosine = float(window.normal[2] / np.linalg.norm(window.normal))
        table["window tilt", "°"] = fixed(math.degrees(math.acos(min(1, cosine))), 3)
        if window.refractions == 2:
            table["glass thickness", "mm"] = fixed(window.thickness_mm)
            table["index of the glass", ""] = fixed(window.glass_index, 4)
    return table


def _camera_std(calibration: Calibration) -> dict[str, float]:
    std = calibration.figures("camera").get("std")
    return {key: each for key, each in std.items() if is_number(each)} if isinstance(std, dict) else {}


def _with_std(value: float, std: float | None, decimals: int) -> str:
    """A value, and its standard deviation with two significant digits; both with the same decimals."""
    if std is None or not std > 0:
        return fixed(value, decimals)
    decimals = max(0, 1 - math.floor(math.log10(std)))
    return f"{fixed(value, decimals)} ± {fixed(std, decimals)}"


def _figures(table: dict[str, Any], group: str) -> Iterator[tuple[tuple[str, str], str]]:
    for name, value in table.items():
        words = f"{group}: {words_of(name)}" if group else words_of(name)
        if isinstance(value, dict):
            # Standard deviations of the camera stand beside its parameters.
            if (group, name) != ("camera", "std"):
                yield from _figures(value, f"{group} {name}".strip())
        elif isinstance(value, bool) or is_number(value):
            yield (words, unit_of(name)), plain(value) if is_number(value) else ("yes" if value else "no")
        elif isinstance(value, str):
            yield (words, ""), value
        elif isinstance(value, list) and 0 < len(value) <= SHORT_LIST and all(map(is_number, value)):
            yield (words, unit_of(name)), ", ".join(map(plain, value))
