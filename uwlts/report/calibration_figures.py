"""Figures of calibrations: the valley of the window's distance, and every list of residuals that their files hold."""

import html
from collections.abc import Iterator
from typing import Any

import numpy as np
import plotly.graph_objects as go

from uwlts.report.calibration_table import SHORT_LIST
from uwlts.report.figures import BLUE, INK, RED, Drawn, layout
from uwlts.report.gather import GatheredCalibration
from uwlts.report.numbers import is_number, unit_of, words_of

_FLAT = 1.2
_CAPTIONS = {
    "camera image_rms_px": "Root mean square distance between found and calculated target points of each image.",
    "window heights_mm": "Height of the step in each image, with the estimated window distance.",
    "window errors_mm": "Error of the step's height in each image, with the estimated window distance.",
    "window height_std_mm": "Standard deviation of each height from the scatter of the stripe's points.",
    "window image_distances_mm": "Window distance that each image alone would give.",
}
_COLOURS = (BLUE, "#c9772b", "#4f8f5b", "#7a5aa6")


def window_curve_figure(calibrations: tuple[GatheredCalibration, ...], true_mm: float | None) -> Drawn | None:
    """Step height error against the tried window distance, of all calibrations that hold it; None if none does."""
    figure = go.Figure()
    for number, found in enumerate(calibrations):
        window = found.calibration.residuals.get("window")
        curve = _pairs(window.get("curve_mm") if isinstance(window, dict) else None)
        if curve is None:
            continue
        model, colour = found.calibration.window, _COLOURS[number % len(_COLOURS)]
        name, errors = plain_text(found.name), window.get("errors_mm")
        least = None
        if model is not None and isinstance(errors, list) and errors and all(map(is_number, errors)):
            # The tried distances are too coarse to meet the bottom of the valley.
            least = model.distance_mm, float(np.sqrt(np.mean(np.square(errors))))
            curve = np.vstack([curve, least])
            curve = curve[np.argsort(curve[:, 0])]
        figure.add_scatter(x=curve[:, 0], y=curve[:, 1], mode="lines", line={"color": colour}, name=name)
        if least is not None:
            figure.add_scatter(
                x=least[:1], y=least[1:], mode="markers", marker={"color": colour, "size": 11, "symbol": "diamond"},
                name=f"{name}: {least[0]:.3f} mm, error {least[1]:.4f} mm",
            )  # fmt: skip
    if not figure.data:
        return None
    caption = "Root mean square error of the step heights at every distance tried; a diamond marks the estimate."
    if true_mm is not None:
        figure.add_vline(x=true_mm, line={"color": RED, "dash": "dash"}, annotation_text=f"true {true_mm:.3f} mm")
        caption += " The dashed line is the distance set in the twin, which one with two refractions should find."
    layout(figure, x="window distance d / mm", y="step height error (rms) / mm", height=380)
    return Drawn(figure, caption)


def residual_figures(found: GatheredCalibration) -> list[Drawn]:
    """Bars for every list of numbers in the residuals; matrices and short lists are left out."""
    drawn = []
    for group, name, values in _lists(found.calibration.residuals_in_file(), ""):
        if len(values) <= SHORT_LIST or not any(is_number(value) for value in values):
            continue
        labels = _labels(found.calibration.residuals, group, len(values))
        heights = [value if is_number(value) else None for value in values]
        known = [value for value in heights if value is not None]
        words, unit = words_of(name), unit_of(name)
        figure, places = go.Figure(), labels or list(range(1, len(values) + 1))
        if min(known) > 0 and max(known) < _FLAT * min(known):
            # Bars must start at zero, where such values would all look the same.
            figure.add_scatter(x=places, y=heights, mode="markers", marker={"color": BLUE, "size": 9})
        else:
            figure.add_bar(x=places, y=heights, marker={"color": "#7fa6cc"})
            figure.add_hline(y=0, line={"color": INK, "width": 1})
        across = "image" if labels or "image" in name else "number"
        layout(figure, x=across, y=f"{words} / {unit}" if unit else words, height=400 if labels else 300)
        if labels:
            figure.update_xaxes(type="category", tickangle=-40)
        name_in_full = f"{group} {name}".strip()
        drawn.append(Drawn(figure, _CAPTIONS.get(name_in_full, f"{group}: {words}." if group else f"{words}.")))
    return drawn


def seconds_figure(seconds: dict[str, float]) -> Drawn | None:
    """Time per stage; None without any."""
    if not seconds:
        return None
    names = [plain_text(name) for name in reversed(seconds)]
    values = [seconds[name] for name in reversed(seconds)]
    figure = go.Figure(go.Bar(x=values, y=names, orientation="h", marker={"color": "#7fa6cc"},
                              text=[f"{value:.3g} s" for value in values], textposition="auto"))  # fmt: skip
    layout(figure, x="time / s", y="", height=90 + 30 * len(names)).update_yaxes(type="category")
    return Drawn(figure, f"{sum(values):.3g} s in all.")


def plain_text(text: str) -> str:
    """Text in which plotly finds no markup."""
    return html.escape(text, quote=False)


def _pairs(values: Any) -> np.ndarray | None:
    """Rows of two numbers as an array (C, 2), None for missing ones as NaN; None if it is anything else."""
    rows = values if isinstance(values, list) else []
    if not rows or not all(isinstance(row, list) and len(row) == 2 for row in rows):
        return None
    if not all(value is None or is_number(value) for row in rows for value in row):
        return None
    return np.array(rows, dtype=float)


def _lists(table: dict[str, Any], group: str) -> Iterator[tuple[str, str, list[Any]]]:
    for name, value in table.items():
        if isinstance(value, dict):
            yield from _lists(value, f"{group} {name}".strip())
        elif isinstance(value, list) and all(item is None or is_number(item) for item in value):
            yield group, name, value


def _labels(residuals: dict[str, Any], group: str, count: int) -> list[str]:
    """The images that the values of a group belong to, if it names as many."""
    table = residuals.get(group)
    images = table.get("images") if isinstance(table, dict) else None
    if not isinstance(images, list) or len(images) != count or not all(isinstance(name, str) for name in images):
        return []
    return [plain_text(name) for name in images]
