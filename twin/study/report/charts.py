"""Charts of a study: figures over what is free, the Pareto front, all designs at once, rendering against formulas."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import plotly.graph_objects as go
from plotly.subplots import make_subplots
from scipy.interpolate import LinearNDInterpolator
from scipy.spatial import Delaunay, QhullError, cKDTree

from twin.study.choice import pareto
from twin.study.description import Variable
from twin.study.figures import CLASS_NAMES
from twin.study.report.tables import (
    Judged,
    bound_text,
    bounds_of,
    label_of,
    listed,
    misses,
    number_text,
    rounded,
    value_text,
    words_of,
)

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


_SHOWN = (
    "sigma_z_rms_mm", "sigma_z_mm", "depth_per_px_mm", "line_mm", "standoff_mm", "required_ms", "occlusion_deg",
    "coverage", "section_cm2", "sigma_y_mm", "speckle_limit_mm",
)  # fmt: skip
_COLOURS = ("#3573b1", "#d9822b", "#2e8b57", "#7b4fa3", "#12a3a8", "#a0722a", "#5b6770", "#b5303c")
_INTERVALS, _MOST_OF_CURVE, _MOST_BARS = 100, 500, 40


def shown_figures(judged: Judged) -> list[str]:
    """Figures to choose from: objectives, constraints, then the most telling others; those that are known."""
    names = [o.figure for o in judged.study.objectives] + list(judged.study.constraints) + list(_SHOWN)
    return [name for name in dict.fromkeys(names) if np.isfinite(judged.figure(name)[judged.works]).any()]


def with_menu(figure: go.Figure, buttons: list[dict[str, Any]]) -> None:
    """A menu above the chart that chooses the figure shown."""
    figure.update_layout(
        margin={"t": 62},
        updatemenus=[{"buttons": buttons, "x": 0.0, "xanchor": "left", "y": 1.02, "yanchor": "bottom", "active": 0,
                      "pad": {"l": 92}, "bgcolor": "white", "bordercolor": SOFT}],
    )  # fmt: skip
    figure.add_annotation(
        text="figure shown", x=0.0, xref="paper", xanchor="left", y=1.02, yref="paper", yanchor="bottom", yshift=8,
        showarrow=False,
    )  # fmt: skip


def curves(judged: Judged, marked: Sequence[Point], x: str) -> Drawn:
    """Figures over one variable: a curve for every combination of what else is free, or the best of all."""
    figures, others = shown_figures(judged), [name for name in judged.study.free() if name != x]
    groups: dict[str, list[int]] = {}
    for place in np.flatnonzero(judged.works):
        groups.setdefault(_combination(judged, others, place), []).append(int(place))
    caption = ""
    if len(groups) > len(_COLOURS):
        groups = {"best": judged.best_first.tolist()}
        caption = f"{listed([words_of(o) for o in others]).capitalize()} also vary: the best design of every place. "
    found = {name: _first_at(judged, x, np.array(places), best=bool(caption)) for name, places in groups.items()}
    figure = go.Figure()
    for number, (name, places) in enumerate(found.items()):
        colour = _COLOURS[number]
        faces = [colour if judged.feasible[place] else "white" for place in places]
        figure.add_scatter(
            x=rounded(judged.columns[x][places]), mode="lines+markers", name=escaped(name or "designs"),
            y=rounded(judged.figure(figures[0])[places]), showlegend=bool(name), line={"color": colour, "width": 1.6},
            marker={"color": faces, "size": 7, "line": {"color": colour, "width": 1.4}},
            text=hover_texts(judged, places, *figures[:6]), hovertemplate="%{text}<extra></extra>",
        )  # fmt: skip
    log, middle = judged.study.variables[x].scale == "log", judged.study.variables[x].at(0.5)
    placed = [point for point in marked if math.isfinite(point.value(x))]
    for point in placed:
        at = point.value(x)
        figure.add_trace(marked_trace(point, x, figures[0]))
        # Here one label goes with one marked design: the menu moves them together.
        figure.add_annotation(label_box(point, math.log10(at) if log else at, 0.0, left=at > middle))

    def drawn(name: str) -> list[list[float | None]]:
        return [rounded(judged.figure(name)[places]) for places in found.values()] + [
            rounded([point.value(name)]) for point in placed
        ]

    styled(figure, x=label_of(x), y=label_of(figures[0]), height=520)
    if log:
        figure.update_layout(xaxis=LOG_AXIS)
    figure.update_layout(shapes=_bound_lines(judged, figures[0]))
    labels = [_labels_at(placed, name) for name in figures]
    figure.update_layout(labels[0])
    with_menu(figure, [_restyled(judged, name, drawn(name), more) for name, more in zip(figures, labels, strict=True)])
    missed = "Hollow: misses a constraint. " if (judged.works & ~judged.feasible).any() else ""
    return Drawn(figure, f"{caption}{missed}{_dashed(judged)}".strip())


def _labels_at(points: Sequence[Point], name: str) -> dict[str, Any]:
    """Where the labels of marked designs go with a figure, as changes of the layout; those without it are hidden."""
    changes: dict[str, Any] = {}
    for number, (value,) in enumerate(rounded([point.value(name)]) for point in points):
        changes |= {f"annotations[{number}].y": value or 0.0, f"annotations[{number}].visible": value is not None}
    return changes


def _restyled(
    judged: Judged, name: str, y: list[list[float | None]], labels: dict[str, Any] | None = None
) -> dict[str, Any]:  # fmt: skip
    """A button of the menu that shows another figure in the same chart."""
    layout = {"yaxis.title.text": escaped(label_of(name)), "shapes": _bound_lines(judged, name)} | (labels or {})
    return {"label": escaped(label_of(name)), "method": "update", "args": [{"y": y}, layout]}


def _bound_lines(judged: Judged, name: str) -> list[dict[str, Any]]:
    return [
        {"type": "line", "xref": "paper", "x0": 0, "x1": 1, "y0": bound, "y1": bound,
         "line": {"color": RED, "width": 1.5, "dash": "dash"}}
        for bounded, _, bound in bounds_of(judged.study) if bounded == name
    ]  # fmt: skip


def _dashed(judged: Judged) -> str:
    return "Dashed: bounds of the figure shown, where it has any." if bounds_of(judged.study) else ""


def _combination(judged: Judged, names: Sequence[str], place: int) -> str:
    return ", ".join(judged.text(name, place) for name in names)


def _first_at(judged: Judged, x: str, places: np.ndarray, *, best: bool) -> np.ndarray:
    """Places by ascending x, thinned out where there are many; of the best, which come first, one per interval."""
    values = np.asarray(judged.columns[x], dtype=float)[places]
    if best:
        share = share_of(judged.study.variables[x], values)
        places = places[np.unique((share * (_INTERVALS - 1)).round(), return_index=True)[1]]
        values = np.asarray(judged.columns[x], dtype=float)[places]
    places = places[np.argsort(values, kind="stable")]
    return places[np.unique(np.linspace(0, len(places) - 1, min(len(places), _MOST_OF_CURVE)).round().astype(int))]


def bars(judged: Judged) -> Drawn:
    """Figures of every combination of choices, the best first."""
    figures, places = shown_figures(judged), judged.best_first[:_MOST_BARS]
    names = [escaped(_combination(judged, list(judged.study.free()), place)) for place in places]
    colours = [BLUE if judged.feasible[place] else "#c3cad2" for place in places]
    figure = go.Figure(
        go.Bar(
            x=names, y=rounded(judged.figure(figures[0])[places]), marker={"color": colours},
            customdata=judged.columns["design"][places].tolist(),
            hovertemplate="%{x}<br>%{y}<extra>design %{customdata}</extra>",
        )
    )  # fmt: skip
    styled(figure, x=", ".join(words_of(name) for name in judged.study.free()), y=label_of(figures[0]), height=480)
    # Names that are numbers are names all the same.
    figure.update_layout(shapes=_bound_lines(judged, figures[0]), xaxis={"type": "category"})
    with_menu(figure, [_restyled(judged, name, [rounded(judged.figure(name)[places])]) for name in figures])
    count = f"The best {len(places)} of {int(judged.works.sum()):,} designs." if len(places) == _MOST_BARS else ""
    grey = " Grey: misses a constraint." if not judged.feasible[places].all() else ""
    return Drawn(figure, f"{count}{grey} {_dashed(judged)}".strip())


def share_of(variable: Variable, values: np.ndarray) -> np.ndarray:
    """Shares from 0 to 1 of a variable's range."""
    values = np.asarray(values, dtype=float)
    if variable.scale == "log":
        return np.log(values / variable.least) / math.log(variable.most / variable.least)
    return (values - variable.least) / (variable.most - variable.least)


_MOST_STEPS, _NODES = 100, 60
_PER_CELL, _CELLS = 8, (4, 40)
_LEVELS, _WIDE = 12, 15.0
_MOST_POINTS = 2000
_BESIDE = 1e-4
_FAILS = 100.0
"""Grade of places where nothing works: so much that the darker grey begins right beside those where something does."""
_GREYS = [[0, "rgba(255,255,255,0)"], [0.5, "rgba(228,231,235,0.72)"], [1, "rgba(150,158,168,1)"]]


@dataclass(frozen=True, eq=False)
class Map:
    """Figures over two variables: values (ny, nx) by name at x (nx,) and y (ny,), NaN where no design works.

    ``reasons`` (ny, nx) says where and why designs there do not do, "" where they do or nothing is known. ``smooth``
    tells whether neighbours are of one kind, so that contours make sense, ``dots`` whether designs are shown as well.
    """

    x: np.ndarray
    y: np.ndarray
    values: dict[str, np.ndarray]
    reasons: np.ndarray
    smooth: bool
    dots: bool
    caption: str


def map_of(judged: Judged, x: str, y: str, figures: Sequence[str]) -> Map | None:
    """The map of figures over two variables; None where the designs span no area.

    A grid shows its designs, others are interpolated linearly. Where more is free, every cell shows its best design.
    """
    axes = [np.unique(np.asarray(judged.columns[name], dtype=float)) for name in (x, y)]
    alone = len(judged.study.free()) == 2
    scattered = len(axes[0]) * len(axes[1]) > 2 * len(judged)
    if scattered and alone:
        return _interpolated(judged, x, y, figures)
    variables = [judged.study.variables[name] for name in (x, y)]
    if scattered:
        cells = int(np.clip(math.sqrt(len(judged) / _PER_CELL), *_CELLS))
        axes = [_cell_middles(variable, cells) for variable in variables]
    else:
        axes = [
            found if len(found) <= _MOST_STEPS else _cell_middles(variable, _MOST_STEPS)
            for found, variable in zip(axes, variables, strict=True)
        ]
    return _best_of_cells(judged, (x, y), axes, figures, smooth=not scattered, alone=alone)


def _cell_middles(variable: Variable, count: int) -> np.ndarray:
    return np.array([variable.at((k + 0.5) / count) for k in range(count)])


def _best_of_cells(
    judged: Judged, names: tuple[str, str], axes: list[np.ndarray], figures: Sequence[str], *, smooth: bool, alone: bool
) -> Map:  # fmt: skip
    at = [_nearest(axis, judged.columns[name]) for axis, name in zip(axes, names, strict=True)]
    cell = at[1] * len(axes[0]) + at[0]
    best = np.full(len(axes[0]) * len(axes[1]), -1)
    # Of several designs the last one written stays: failed ones first, then from the worst to the best.
    order = np.concatenate([np.flatnonzero(~judged.works), judged.best_first[::-1]])
    best[cell[order]] = order
    shape = (len(axes[1]), len(axes[0]))
    used = np.where(best >= 0, best, 0)
    works = (best >= 0) & judged.works[used]
    values = {name: np.where(works, judged.figure(name)[used], np.nan).reshape(shape) for name in figures}
    texts = [judged.failures[k] if k >= 0 else "" for k in best]
    reasons = _reasons(judged, values, np.array(texts, dtype=object).reshape(shape))
    others = [words_of(name) for name in judged.study.free() if name not in names]
    caption = "" if alone else (
        f"{listed(others).capitalize()} also vary: each place shows the design there that misses the constraints least "
        f"and then has the best {words_of(judged.study.objectives[0].figure)}."
    )  # fmt: skip
    return Map(axes[0], axes[1], values, reasons, smooth=smooth, dots=not smooth, caption=caption)


def _nearest(axis: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Places of the axis's nearest values."""
    between = (axis[1:] + axis[:-1]) / 2
    return np.searchsorted(between, np.asarray(values, dtype=float))


def _interpolated(judged: Judged, x: str, y: str, figures: Sequence[str]) -> Map | None:
    variables = [judged.study.variables[name] for name in (x, y)]
    places = np.column_stack(
        [share_of(variable, judged.columns[name]) for variable, name in zip(variables, (x, y), strict=True)]
    )
    shares = np.linspace(0, 1, _NODES)
    nodes = np.stack(np.meshgrid(shares, shares), axis=-1)
    try:
        mesh = Delaunay(places[judged.works])
    except (QhullError, ValueError):
        return None
    known = np.column_stack([judged.figure(name)[judged.works] for name in figures])
    found = LinearNDInterpolator(mesh, known)(nodes)
    # A node belongs to its nearest design: near one that fails nothing is known.
    nearest = cKDTree(places).query(nodes)[1]
    found[~judged.works[nearest]] = np.nan
    if not np.isfinite(found[..., 0]).any():
        return None
    values = {name: found[..., k] for k, name in enumerate(figures)}
    texts = np.array(judged.failures, dtype=object)[nearest]
    axes = [np.array([variable.at(share) for share in shares]) for variable in variables]
    caption = f"Interpolated linearly between {int(judged.works.sum()):,} designs (dots); white: too far from any."
    return Map(axes[0], axes[1], values, _reasons(judged, values, texts), smooth=True, dots=True, caption=caption)


def _reasons(judged: Judged, values: dict[str, np.ndarray], failures: np.ndarray) -> np.ndarray:
    """What is said of places that do not do: why designs fail there, or which constraints they miss."""
    reasons = np.where(failures.astype(bool), failures, "").astype(object)
    bounded = [name for name in judged.study.constraints if name in values]
    for place in np.ndindex(reasons.shape):
        if not reasons[place] and bounded:
            reasons[place] = "; ".join(misses(judged.study, {name: values[name][place] for name in bounded}))
    return reasons


def contours(judged: Judged, marked: Sequence[Point], x: str, y: str) -> Drawn | None:
    """The figures over two variables, one at a time; None where the designs span no area."""
    figures = shown_figures(judged)
    found = map_of(judged, x, y, figures)
    if found is None:
        return None
    figure = go.Figure()
    for number, name in enumerate(figures):
        figure.add_trace(_filled(found, x, y, name, visible=number == 0))
    figure.add_traces(_overlay(found, x, y))
    alone = len(judged.study.free()) == 2
    if alone:
        for name, sign, bound in bounds_of(judged.study):
            values = found.values.get(name, np.empty(0))
            if (values < bound).any() and (values > bound).any():
                # A figure that goes in steps may equal its bound over an area: the line runs where the bound is missed.
                level = bound + sign * _BESIDE * (abs(bound) or 1.0)
                figure.add_trace(_limit(found, name, level, bound_text(name, sign, bound), len(figure.data)))
    if found.dots:
        dots = np.flatnonzero(sample(judged.works, np.zeros(len(judged), bool), _MOST_POINTS))
        figure.add_scatter(
            x=rounded(judged.columns[x][dots]), y=rounded(judged.columns[y][dots]), mode="markers", name="designs",
            marker={"size": 2.5, "color": INK, "opacity": 0.5}, hoverinfo="skip", showlegend=False,
        )  # fmt: skip
    styled(figure, x=label_of(x), y=label_of(y), height=620)
    ends = [_set_axis(figure, axis, judged.study.variables[name]) for axis, name in (("xaxis", x), ("yaxis", y))]
    add_marked(figure, marked, x, y, ends=ends)
    others = [True] * (len(figure.data) - len(figures))
    shown = {name: [other == name for other in figures] + others for name in figures}
    with_menu(
        figure,
        [
            {"label": escaped(label_of(name)), "method": "update", "args": [{"visible": visible}]}
            for name, visible in shown.items()
        ],
    )
    outside = [
        point.label for point in marked
        if not all(low <= point.value(name) <= high for name, (low, high) in zip((x, y), ends, strict=True))
    ]  # fmt: skip
    beyond = f" Outside the ranges: {listed(outside)}." if outside else ""
    grey = ""
    if (found.reasons != "").any():
        grey = " Light grey: a constraint is missed; dark grey: designs cannot work; point at it to see why."
    return Drawn(figure, (found.caption + grey + beyond).strip())


def _set_axis(figure: go.Figure, axis: str, variable: Variable) -> tuple[float, float]:
    """Give an axis a variable's scale and range; returns the range's ends."""
    log = variable.scale == "log"
    low, high = (math.log10(end) if log else end for end in (variable.least, variable.most))
    margin = 0.02 * (high - low)
    figure.update_layout(
        {axis: (LOG_AXIS if log else {}) | {"range": [low - margin, high + margin], "showgrid": False}}
    )
    return variable.least, variable.most


def _filled(found: Map, x: str, y: str, name: str, *, visible: bool) -> go.Contour | go.Heatmap:
    """A figure as filled contours, or as cells where neighbours differ in kind; wide ranges in their logarithm."""
    values = found.values[name]
    ok = found.reasons == ""
    known = values[np.isfinite(values)]
    telling = values[ok & np.isfinite(values)] if np.isfinite(values[ok]).sum() > 10 else known
    low, high = (np.quantile(known, 0.02), np.quantile(telling, 0.98)) if len(known) else (0.0, 1.0)
    high = max(high, low)
    log = bool(low > 0 and high > _WIDE * low)
    z = np.log10(np.where(values > 0, values, np.nan)) if log else values
    low, high = (math.log10(low), math.log10(high)) if log else (float(low), float(high))
    size = _step((high - low) / _LEVELS)
    bar: dict[str, Any] = {"title": {"text": escaped(label_of(name)), "side": "right"}, "thickness": 16}
    if log:
        marks = [m * 10.0**e for e in range(math.floor(low), math.ceil(high) + 1) for m in (1, 2, 5)]
        bar |= {"tickvals": [math.log10(mark) for mark in marks], "ticktext": [number_text(mark) for mark in marks]}
    said = [(x, "%{x:.5~g}"), (y, "%{y:.5~g}"), (name, "%{customdata}" if log else "%{z:.4~g}")]
    hover = "<br>".join(f"{escaped(label_of(what))}: {value}" for what, value in said) + "<extra></extra>"
    common = {
        "x": rounded(found.x), "y": rounded(found.y), "z": [rounded(row) for row in z], "visible": visible,
        "name": escaped(words_of(name)), "colorscale": "Viridis", "zmin": low, "zmax": max(high, low + 1e-12),
        "colorbar": bar, "hovertemplate": hover,
        "customdata": [rounded(row) for row in values] if log else None,
    }  # fmt: skip
    if not found.smooth:
        return go.Heatmap(**common, hoverongaps=False)
    levels = {"start": math.floor(low / size) * size, "end": math.ceil(high / size) * size, "size": size}
    labels = {"showlabels": not log, "labelfont": {"size": 10, "color": "white"}}
    return go.Contour(**common, contours=levels | labels, line={"width": 0.6, "color": "rgba(255,255,255,0.7)"})


def _step(wanted: float) -> float:
    """A round step near the wanted one."""
    if not wanted > 0:
        return 1.0
    decade = 10.0 ** math.floor(math.log10(wanted))
    return min((m * decade for m in (1, 2, 2.5, 5, 10)), key=lambda step: abs(math.log(step / wanted)))


def _overlay(found: Map, x: str, y: str) -> list[go.Contour | go.Heatmap]:
    """Grey over what does not do, darker where nothing works, and the reasons on hover.

    Heatmaps lie below contours whatever their order, so that what is seen is a contour, or a heatmap over others; and
    contours have no gaps for the pointer to fall through, so that the reasons belong to an invisible heatmap.
    """
    works = np.isfinite(np.stack(list(found.values.values()))).any(axis=0)
    bad = found.reasons != ""
    grade = np.where(bad, np.where(works, 1.0, _FAILS), np.where(works, 0.0, np.nan))
    axes = {"x": rounded(found.x), "y": rounded(found.y)}
    where = f"{escaped(label_of(x))}: %{{x:.5~g}}<br>{escaped(label_of(y))}: %{{y:.5~g}}"
    grades: go.Contour | go.Heatmap
    if found.smooth:
        grades = go.Contour(
            **axes, z=[rounded(row) for row in grade], contours={"start": 0.5, "end": 1.5, "size": 1.0}, zmin=0, zmax=2,
            colorscale=_GREYS, showscale=False, line={"width": 0}, hoverinfo="skip",
        )  # fmt: skip
    else:
        grades = go.Heatmap(
            **axes, z=[rounded(row) for row in grade], zmin=0, zmax=2, colorscale=_GREYS, showscale=False,
            hoverinfo="skip",
        )  # fmt: skip
    reasons = go.Heatmap(
        **axes, z=[rounded(row) for row in np.where(bad, 1.0, np.nan)], opacity=0, showscale=False, hoverongaps=False,
        text=[[_wrapped(escaped(text)) for text in row] for row in found.reasons.tolist()],
        hovertemplate=f"{where}<br><b>does not do:</b><br>%{{text}}<extra></extra>",
    )  # fmt: skip
    return [grades, reasons]


def _wrapped(text: str, width: int = 60) -> str:
    """Text in lines for a hover label."""
    lines = [""]
    for word in text.split():
        if lines[-1] and len(lines[-1]) + len(word) > width:
            lines.append("")
        lines[-1] = f"{lines[-1]} {word}".strip()
    return "<br>".join(lines)


_LIMITS = ("#d9480f", "#862e9c", "#0b7285", "#e67700", "#364fc7")


def _limit(found: Map, name: str, level: float, words: str, number: int) -> go.Contour:
    """The line on which a constraint is just met."""
    return go.Contour(
        x=rounded(found.x), y=rounded(found.y), z=[rounded(row) for row in found.values[name]], name=escaped(words),
        contours={"type": "levels", "coloring": "none", "start": level, "end": level, "size": 1.0}, showscale=False,
        line={"color": _LIMITS[number % len(_LIMITS)], "width": 3, "dash": "dash"}, showlegend=True, hoverinfo="skip",
    )  # fmt: skip
