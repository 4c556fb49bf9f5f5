"""Interactive charts of a study: the Pareto front, everything at once, and rendering against formulas."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import plotly.graph_objects as go
from plotly.subplots import make_subplots

from twin.study.pareto import pareto
from twin.study.report.names import label_of, rounded, value_text, words_of
from twin.study.report.table import Judged
from twin.study.safety import CLASS_NAMES

INK, FAINT, SOFT, BLUE, RED, GREEN = "#2b3440", "#dde2e8", "#8a96a3", "#3573b1", "#c22f2f", "#2e8b57"
MOST_POINTS, MOST_LINES = 20_000, 5_000
_SYMBOLS = ("diamond", "circle", "star", "square", "cross")
_AWAY = (-26, 26, -54, 54, -82, 82)
"""How far from a marked design its label stands, in px; the designs in turn."""
_SEED = 0
_FEW, _IN_SVG = 300, 2500
"""More points are drawn smaller; more than the second number with WebGL, which does not slow the page down."""
LOG_AXIS = {"type": "log", "dtick": "D2"}
_WIDE_RANGE = 30.0
_MOST_DIMENSIONS = 12


@dataclass(frozen=True, eq=False)
class Drawn:
    """A figure for a page, and what it shows, in a sentence."""

    figure: go.Figure
    caption: str


@dataclass(frozen=True)
class Point:
    """A marked design: its label, its values by name, its number among the marked ones, and whether it is chosen."""

    label: str
    row: Mapping[str, Any]
    number: int
    chosen: bool

    def value(self, name: str) -> float:
        """A number of the row, NaN where there is none."""
        value = self.row.get(name)
        return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else math.nan


def styled(figure: go.Figure, *, x: str, y: str, height: int = 460) -> go.Figure:
    """Put on axes with titles and the page's plain look."""
    axis = {"gridcolor": FAINT, "linecolor": INK, "ticks": "outside", "zeroline": False, "automargin": True}
    return figure.update_layout(
        template="none", height=height, margin={"l": 70, "r": 20, "t": 30, "b": 56}, font={"size": 13, "color": INK},
        xaxis=axis | {"title": {"text": escaped(x), "standoff": 10}},
        yaxis=axis | {"title": {"text": escaped(y), "standoff": 12}},
        legend={"orientation": "h", "y": -0.16, "yanchor": "top", "x": 0},
        hovermode="closest", hoverlabel={"namelength": -1, "bgcolor": "white", "font": {"color": INK}}, separators=". ",
        paper_bgcolor="white", plot_bgcolor="white",
    )  # fmt: skip


def escaped(text: str) -> str:
    """Text in which plotly finds no tags."""
    return text.replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")


def marked_trace(point: Point, x: str, y: str) -> go.Scatter:
    """A marked design as a symbol, the chosen one in red."""
    at, label = rounded([point.value(x), point.value(y)]), escaped(point.label)
    return go.Scatter(
        x=at[:1], y=at[1:], mode="markers", showlegend=False, name=label,
        marker={
            "symbol": _SYMBOLS[point.number % len(_SYMBOLS)], "size": 15 if point.chosen else 11,
            "color": RED if point.chosen else INK, "line": {"color": "white", "width": 1.5},
        },
        hovertemplate=f"<b>{label}</b><br>{escaped(label_of(x))}: %{{x}}<br>%{{y}}<extra></extra>",
    )  # fmt: skip


def label_box(point: Point, x: float, y: float, *, left: bool) -> dict[str, Any]:
    """The label of a marked design at coordinates of the axes, in a box at a little distance on its left or right."""
    colour = RED if point.chosen else INK
    return {
        "x": x, "y": y, "text": f"<b>{escaped(point.label)}</b>", "ax": -30 if left else 30,
        "ay": _AWAY[point.number % len(_AWAY)], "xanchor": "right" if left else "left", "arrowcolor": colour,
        "arrowwidth": 1.2, "arrowhead": 0, "standoff": 7, "bgcolor": "rgba(255,255,255,0.88)", "borderpad": 2,
        "font": {"color": colour, "size": 12.5},
    }  # fmt: skip


def add_marked(
    figure: go.Figure, points: Sequence[Point], x: str, y: str, *, ends: Sequence[tuple[float, float]]
) -> None:
    """Add marked designs with their labels on axes that have their types already.

    ``ends`` are the ends of both axes; the labels stand towards the middle. Designs outside are left out.
    """
    logs = [figure.layout[axis].type == "log" for axis in ("xaxis", "yaxis")]
    low, high = (math.log10(end) if logs[0] else end for end in ends[0])
    for point in points:
        at = [point.value(x), point.value(y)]
        if all(first <= value <= last for value, (first, last) in zip(at, ends, strict=True)):
            places = [math.log10(value) if log else value for value, log in zip(at, logs, strict=True)]
            figure.add_trace(marked_trace(point, x, y))
            figure.add_annotation(label_box(point, *places, left=places[0] > (low + high) / 2))


# --- the Pareto front -------------------------------------------------------------------------------------------------


def trade_off(judged: Judged) -> tuple[tuple[str, int], tuple[str, int]]:
    """The two figures to weigh against each other, each with 1 to minimise or -1 to maximise.

    The study's first two objectives; of a study with one, also the first other figure with a constraint or, without
    any, the length of the line.
    """
    wanted = [(o.figure, 1 if o.goal == "minimise" else -1) for o in judged.study.objectives]
    wanted += [(name, 1 if c.least is None else -1) for name, c in judged.study.constraints.items()]
    wanted += [("line_mm", -1), ("depth_mm", -1)]
    second = next((one for one in wanted[1:] if one[0] != wanted[0][0] and _varies(judged, one[0])), wanted[-1])
    return wanted[0], second


def _varies(judged: Judged, name: str) -> bool:
    values = judged.figure(name)[judged.works]
    values = values[np.isfinite(values)]
    return len(values) > 1 and float(np.ptp(values)) > 1e-9 * float(np.abs(values).max())


def pareto_chart(judged: Judged, marked: Sequence[Point]) -> Drawn | None:
    """All designs that work over two figures, and the front of those that meet the constraints."""
    (x, x_sign), (y, y_sign) = trade_off(judged)
    values = np.column_stack([judged.figure(x) * x_sign, judged.figure(y) * y_sign])
    known = judged.works & np.isfinite(values).all(axis=1)
    if not known.any():
        return None
    front = pareto(np.where((judged.of_interest & known)[:, None], values, np.nan))
    shown = sample(known, front, MOST_POINTS)
    figure = go.Figure()
    layers = (
        ("misses a constraint", shown & ~judged.feasible, "#b3bcc6"),
        ("meets all constraints", shown & judged.feasible & ~front, BLUE),
    )
    size = 4 if shown.sum() > _FEW else 7
    for name, chosen, colour in layers:
        if chosen.any():
            marker = {"color": colour, "size": size, "opacity": 0.55}
            _add_designs(figure, judged, np.flatnonzero(chosen), x, y, name=name, marker=marker)
    order = np.flatnonzero(front)[np.argsort(values[front, 0])]
    figure.add_scatter(
        x=rounded(judged.figure(x)[order]), y=rounded(judged.figure(y)[order]), mode="lines+markers",
        name=f"Pareto front ({len(order):,} of the designs)",
        line={"color": GREEN, "width": 2}, marker={"size": 6, "color": GREEN},
        text=hover_texts(judged, order, x, y), hovertemplate="%{text}<extra></extra>",
    )  # fmt: skip
    styled(figure, x=label_of(x), y=label_of(y), height=520)
    ends = []
    for axis, name in (("xaxis", x), ("yaxis", y)):
        numbers = np.append(judged.figure(name)[known], [point.value(name) for point in marked])
        ends.append((float(np.nanmin(numbers)), float(np.nanmax(numbers))))
        if ends[-1][0] > 0 and ends[-1][1] > _WIDE_RANGE * ends[-1][0]:
            figure.update_layout({axis: LOG_AXIS})
    add_marked(figure, marked, x, y, ends=ends)
    figure.update_layout(legend={"itemsizing": "constant"})
    better = " and ".join(
        f"{'less' if sign > 0 else 'more'} {words_of(name)}" for name, sign in ((x, x_sign), (y, y_sign))
    )
    thin = f" {int(shown.sum()):,} of {int(known.sum()):,} designs are drawn." if shown.sum() < known.sum() else ""
    none = "" if judged.feasible.any() else " None meets all constraints: the front is that of all that work."
    more = " Further objectives are left out here." if len(judged.study.objectives) > 2 else ""
    return Drawn(figure, f"Better is {better}: nothing beats the designs on the green line in both.{more}{none}{thin}")


def _add_designs(
    figure: go.Figure, judged: Judged, places: np.ndarray, x: str, y: str, *, name: str, marker: dict[str, Any]
) -> None:  # fmt: skip
    kind = go.Scattergl if len(places) > _IN_SVG else go.Scatter
    figure.add_trace(
        kind(
            x=rounded(judged.figure(x)[places]), y=rounded(judged.figure(y)[places]), mode="markers", name=name,
            marker=marker, customdata=judged.columns["design"][places].tolist(),
            hovertemplate=f"design %{{customdata}}<br>{escaped(label_of(x))}: %{{x}}<br>{escaped(label_of(y))}: %{{y}}"
            f"<extra>{name}</extra>",
        )
    )  # fmt: skip


def sample(candidates: np.ndarray, kept: np.ndarray, most: int) -> np.ndarray:
    """At most so many of the candidates (N,), drawn at random, all kept ones among them."""
    others = np.flatnonzero(candidates & ~kept)
    room = max(0, most - int(kept.sum()))
    if len(others) > room:
        others = np.random.default_rng(_SEED).choice(others, room, replace=False)
    chosen = kept.copy()
    chosen[others] = True
    return chosen


def hover_texts(judged: Judged, places: np.ndarray, *figures: str) -> list[str]:
    """What is said of designs on hover: number, values of what is free, and figures."""
    names = list(dict.fromkeys([*judged.study.free(), *figures]))
    return [
        "<br>".join(
            [f"design {judged.columns['design'][place]}"]
            + [escaped(f"{words_of(name)}: {judged.text(name, place)}") for name in names]
        )
        for place in places
    ]


# --- all at once ------------------------------------------------------------------------------------------------------


def parallel_chart(judged: Judged) -> Drawn | None:
    """Every design that meets the constraints as a line over all that is free, wanted and bounded."""
    if not judged.feasible.any():
        return None
    chosen = sample(judged.feasible, judged.front, MOST_LINES)
    places = np.flatnonzero(chosen)
    figures = [o.figure for o in judged.study.objectives] + list(judged.study.constraints)
    names = list(dict.fromkeys([*judged.study.free(), *figures]))[:_MOST_DIMENSIONS]
    dimensions = [_dimension(judged, name, places) for name in names]
    objective = judged.study.objectives[0]
    colours = judged.figure(objective.figure)[places]
    low, high = float(colours.min()), float(np.quantile(colours, 0.95))
    figure = go.Figure(
        go.Parcoords(
            dimensions=dimensions, labelangle=-12, labelside="top", labelfont={"size": 12}, tickfont={"size": 11},
            rangefont={"size": 1, "color": "rgba(0,0,0,0)"},
            line={
                "color": rounded(colours), "colorscale": "Viridis", "showscale": True, "cmin": low,
                "cmax": high if high > low else low + max(abs(low), 1e-9), "reversescale": objective.goal == "maximise",
                "colorbar": {"title": {"text": escaped(label_of(objective.figure)), "side": "right"}, "thickness": 14},
            },
        )
    )  # fmt: skip
    figure.update_layout(
        template="none", height=470, margin={"l": 80, "r": 40, "t": 110, "b": 30}, font={"size": 12, "color": INK},
        paper_bgcolor="white",
    )  # fmt: skip
    total = int(judged.feasible.sum())
    count = f"{len(places):,} of {total:,} designs" if len(places) < total else f"All {total:,} designs"
    return Drawn(figure, f"{count} that meet all constraints. Drag along an axis to keep only what passes there.")


def _dimension(judged: Judged, name: str, places: np.ndarray) -> dict[str, Any]:
    values = judged.columns[name][places]
    label = escaped(label_of(name))
    variable = judged.study.free().get(name)
    if variable is not None and variable.values is not None:
        options = list(variable.values)
        codes = [options.index(value) for value in values.tolist()]
        # Ticks hold plain text, in which nothing is a tag.
        texts = [textwrap.shorten(value_text(name, option, unit=False), 24, placeholder="…") for option in options]
        return {"label": label, "values": codes, "tickvals": list(range(len(options))), "ticktext": texts,
                "range": [-0.3, len(options) - 0.7]}  # fmt: skip
    if name == "laser_class":
        classes = sorted(CLASS_NAMES)
        return {"label": label, "values": rounded(values), "tickvals": classes,
                "ticktext": [CLASS_NAMES[one] for one in classes],
                "range": [classes[0] - 0.3, classes[-1] + 0.3]}  # fmt: skip
    low, high = float(values.min()), float(values.max())
    margin = 0.0 if high > low else max(abs(low) * 0.05, 1e-6)
    return {"label": label, "values": rounded(values), "range": [low - margin, high + margin]}


# --- rendering --------------------------------------------------------------------------------------------------------


def verification_chart(row: Mapping[str, Any]) -> Drawn | None:
    """Scatter as predicted and as rendered, and the systematic error, over Z."""
    z = rounded(row["z_mm"])
    if not z:
        return None
    figure = make_subplots(rows=1, cols=2, horizontal_spacing=0.14)
    curves = (
        ("predicted by formulas", "predicted_mm", 1, BLUE, "dash"),
        ("rendered and measured", "rendered_mm", 1, RED, "solid"),
        ("systematic error", "error_mm", 2, INK, "solid"),
    )  # fmt: skip
    for name, column, place, colour, dash in curves:
        figure.add_scatter(
            x=z, y=rounded([math.nan if v is None else 1e3 * v for v in row[column]]), mode="lines+markers", name=name,
            line={"color": colour, "dash": dash, "width": 1.8}, marker={"size": 6}, row=1, col=place,
            hovertemplate="Z %{x} mm: %{y} µm<extra>" + name + "</extra>",
        )  # fmt: skip
    styled(figure, x="Z from the stand-off (mm)", y="scatter along Z, σ (µm)", height=330)
    axis = {"gridcolor": FAINT, "linecolor": INK, "ticks": "outside", "zeroline": False, "automargin": True}
    figure.update_layout(
        xaxis2=axis | {"title": {"text": "Z from the stand-off (mm)", "standoff": 10}},
        yaxis={"rangemode": "tozero"}, yaxis2=axis | {"title": {"text": "systematic error (µm)"}, "zeroline": True},
        legend={"y": 1.02, "yanchor": "bottom"},
    )  # fmt: skip
    caption = "Left: standard deviation of the points along Z. Right: their mean distance from the true plane."
    return Drawn(figure, caption)
