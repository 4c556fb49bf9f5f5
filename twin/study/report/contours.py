"""Contours of the figures over two variables: where designs do, where they do not, and why."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import plotly.graph_objects as go
from scipy.interpolate import LinearNDInterpolator
from scipy.spatial import Delaunay, QhullError, cKDTree

from twin.study.description import Variable
from twin.study.report.charts import INK, LOG_AXIS, Drawn, Point, add_marked, escaped, sample, styled
from twin.study.report.curves import share_of, shown_figures, with_menu
from twin.study.report.names import label_of, listed, number_text, rounded, words_of
from twin.study.report.table import Judged, bound_text, bounds_of, misses

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
