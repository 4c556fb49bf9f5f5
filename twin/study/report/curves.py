"""Curves of the figures over one variable, bars over choices, and the menu by which a chart changes its figure."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import plotly.graph_objects as go

from twin.study.description import Variable
from twin.study.report.charts import (
    BLUE,
    LOG_AXIS,
    RED,
    SOFT,
    Drawn,
    Point,
    escaped,
    hover_texts,
    label_box,
    marked_trace,
    styled,
)
from twin.study.report.names import label_of, listed, rounded, words_of
from twin.study.report.table import Judged, bounds_of

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
