"""Charts of a study: figures over what is free, the Pareto front, all designs at once, rendering against formulas."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from html import escape

import matplotlib
import numpy as np
import plotly.graph_objects as go
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm, Normalize, to_rgba
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from scipy.interpolate import LinearNDInterpolator
from scipy.spatial import Delaunay, KDTree, QhullError

from twin.design.choice import Judged, pareto
from twin.design.designs import Marked
from twin.design.figures_of_merit import CLASS_NAMES
from twin.design.report import study_tables as tables
from twin.design.study import Variable
from twin.design.verification import Agreement
from uwlts.pages.toolkit import BLUE, COLOURS, FAINT, INK, legend_below, new_figure

Static = tuple[Figure, str]
Interactive = tuple[go.Figure, str]
"""A figure for a page, and its caption."""

RED, GREEN, PALE = "#c22f2f", "#2e8b57", "#c3cad2"
_LIMITS = ("#d9480f", "#862e9c", "#0b7285", "#e67700", "#364fc7")
"""Colours of the lines on which constraints are just met."""
_SYMBOLS = (("diamond", "D"), ("circle", "o"), ("star", "*"), ("square", "s"), ("cross", "P"))
"""Symbols of marked designs, of plotly and of matplotlib."""
_AWAY = (-26, 26, -54, 54, -82, 82)
"""Distances of labels from marked designs in px; the designs in turn."""
_SHOWN = (
    "sigma_z_rms_mm",
    "sigma_z_mm",
    "depth_per_px_mm",
    "line_mm",
    "standoff_mm",
    "required_ms",
    "occlusion_deg",
    "coverage",
    "section_cm2",
    "sigma_y_mm",
    "speckle_limit_mm",
)
"""Figures shown besides objectives and constraints, the most informative first."""
_MOST_PANELS, _PANEL_COLUMNS, _PANEL_INCHES, _BAR_INCHES = 9, 3, (4.0, 3.1), 0.17
MOST_POINTS, MOST_LINES = 20_000, 5_000
_MOST_DOTS, _MOST_OF_CURVE, _MOST_BARS, _MOST_DIMENSIONS = 2000, 500, 40, 12
"""More designs, points of a curve, bars and axes would hide each other."""
_FEW, _IN_SVG = 300, 2500
"""More points are drawn smaller; more than the second number with WebGL, which does not slow the page down."""
_LAYOUT = {"template": "none", "font": {"color": INK}, "paper_bgcolor": "white"}
_WIDE_RANGE = 30.0
"""A figure whose largest value is so many times the least gets a logarithmic axis."""
_DASHED = "Dashed: bounds."
_INTERVALS = 100
_MOST_STEPS, _NODES = 100, 60
_PER_CELL, _CELLS = 8, (4, 40)
_LEVELS, _WIDE, _MARGIN = 12, 15.0, 0.02
_BESIDE = 1e-4
"""Part of a bound by which its line is drawn on the side that misses it: a figure in steps may equal the bound."""

_plain_text = matplotlib.rc_context({"text.parse_math": False})
"""Names given by users hold no formulas, whatever dollar signs they have."""
_escaped = partial(escape, quote=False)
"""Text in which plotly finds no tags."""


def shown_figures(judged: Judged) -> list[str]:
    """Figures to show: objectives, constraints, then the most informative others; those that are known."""
    names = dict.fromkeys([*judged.study.wanted(), *_SHOWN])
    return [name for name in names if np.isfinite(judged.figure(name)[judged.works]).any()]


# --- panels of static figures -----------------------------------------------------------------------------------------


def _panels(names: Sequence[str], *, height: float = _PANEL_INCHES[1]) -> tuple[Figure, list[tuple[Axes, str]]]:
    """A figure with axes for each of the first figures of merit, with their names, which are the titles."""
    names = names[:_MOST_PANELS]
    columns = min(_PANEL_COLUMNS, len(names))
    rows = -(-len(names) // columns)
    figure, axes = new_figure(_PANEL_INCHES[0] * columns, height * rows, rows=rows, columns=columns)
    for unused in axes[len(names) :]:
        unused.remove()
    for one, name in zip(axes, names, strict=False):
        one.set_title(tables.label_of(name))
    return figure, list(zip(axes, names, strict=False))


def _mark(axes: Axes, marked: Sequence[Marked], x: str, y: str) -> None:
    """Draw marked designs as symbols, the chosen one in red."""
    for number, one in enumerate(marked):
        at, (colour, size) = (
            (one.design.number_of(x), one.design.number_of(y)),
            (RED, 10) if one is marked[-1] else (INK, 8),
        )
        if all(map(math.isfinite, at)):
            style = {"color": colour, "markersize": size, "markeredgecolor": "white", "zorder": 6}
            axes.plot(*at, _SYMBOLS[number % len(_SYMBOLS)][1], label=one.label, **style)


def _draw_bounds(draw: Callable[..., object], judged: Judged, name: str) -> None:
    for bounded, _, bound in judged.study.bounds():
        if bounded == name:
            draw(bound, color=RED, linewidth=1.2, linestyle="--")


# --- curves and bars --------------------------------------------------------------------------------------------------


@_plain_text
def curves(judged: Judged, marked: Sequence[Marked], x: str) -> Static:
    """Figures over one variable: a curve for every combination of what else is free, or the best of all."""
    others = [name for name in judged.study.free() if name != x]
    groups: dict[str, list[int]] = {}
    for place in np.flatnonzero(judged.works):
        groups.setdefault(_combination(judged, others, int(place)), []).append(int(place))
    caption = ""
    if len(groups) > len(COLOURS):
        groups = {"best": judged.best_first.tolist()}
        varying = tables.listed([tables.words_of(name) for name in others]).capitalize()
        caption = f"{varying} also vary: the best design of every place. "
    at, found = np.asarray(judged.columns[x], dtype=float), {}
    for name, members in groups.items():
        places = np.array(members)
        if caption:
            # The best come first: one per interval.
            share = share_of(judged.study.variables[x], at[places])
            places = places[np.unique((share * (_INTERVALS - 1)).round(), return_index=True)[1]]
        places = places[np.argsort(at[places], kind="stable")]
        thinned = np.linspace(0, len(places) - 1, min(len(places), _MOST_OF_CURVE)).round().astype(int)
        found[name] = places[np.unique(thinned)]
    figure, panels = _panels(shown_figures(judged))
    for axes, name in panels:
        for colour, (group, places) in zip(COLOURS, found.items(), strict=False):
            values, meets = (judged.columns[x][places], judged.figure(name)[places]), judged.feasible[places]
            axes.plot(*values, color=colour, linewidth=1.3, label=group or "designs")
            axes.scatter(*values, s=16, color=np.where(meets, colour, "white"), edgecolors=colour, zorder=3)
        _draw_bounds(axes.axhline, judged, name)
        _mark(axes, marked, x, name)
        axes.set(xlabel=tables.label_of(x), xscale=judged.study.variables[x].scale)
    legend_below(figure)
    missed = "Hollow: misses a constraint. " if (judged.works & ~judged.feasible).any() else ""
    return figure, f"{caption}{missed}{_DASHED if judged.study.bounds() else ''}".strip()


def _combination(judged: Judged, names: Sequence[str], place: int) -> str:
    return ", ".join(tables.text_at(judged, name, place) for name in names)


@_plain_text
def bars(judged: Judged) -> Static:
    """Figures of every combination of choices, the best first."""
    places = judged.best_first[:_MOST_BARS]
    labels = [_combination(judged, list(judged.study.free()), place) for place in places]
    figure, panels = _panels(shown_figures(judged), height=max(_PANEL_INCHES[1], _BAR_INCHES * len(places)))
    for number, (axes, name) in enumerate(panels):
        axes.barh(range(len(places)), judged.figure(name)[places], color=np.where(judged.feasible[places], BLUE, PALE))
        # Long names stand at the left only.
        axes.set_yticks(range(len(places)), labels if number % _PANEL_COLUMNS == 0 else [""] * len(places))
        axes.invert_yaxis()
        _draw_bounds(axes.axvline, judged, name)
    count = f"The best {len(places)} of {int(judged.works.sum()):,} designs." if len(places) == _MOST_BARS else ""
    grey = " Grey: misses a constraint." if not judged.feasible[places].all() else ""
    return figure, f"{count}{grey} {_DASHED if judged.study.bounds() else ''}".strip()


def share_of(variable: Variable, values: np.ndarray) -> np.ndarray:
    """Shares from 0 to 1 of a variable's range."""
    values, (least, most) = np.asarray(values, dtype=float), variable.ends()
    if variable.scale == "log":
        return np.log(values / least) / math.log(most / least)
    return (values - least) / (most - least)


# --- maps over two variables ------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Map:
    """Figures over two variables: values (ny, nx) by name at x (nx,) and y (ny,), NaN where no design works.

    ``reasons`` (ny, nx) says where and why designs there do not do, "" where they do or nothing is known. ``smooth``
    says whether neighbours are of one kind, so that contours make sense, ``dots`` whether designs are shown as well.
    """

    x: np.ndarray
    y: np.ndarray
    values: dict[str, np.ndarray]
    reasons: np.ndarray
    smooth: bool
    dots: bool
    caption: str


def map_of(judged: Judged, x: str, y: str, figures: Sequence[str]) -> Map | None:
    """The map of figures over two variables; None where the designs span no area. A grid shows its designs, others are
    interpolated linearly. Where more is free, every cell shows its best design."""
    names, free = (x, y), judged.study.free()
    variables = [judged.study.variables[name] for name in names]
    columns = [np.asarray(judged.columns[name], dtype=float) for name in names]
    axes, caption = [np.unique(column) for column in columns], ""
    scattered = len(axes[0]) * len(axes[1]) > 2 * len(judged)
    if alone := scattered and len(free) == 2:
        shares = [share_of(variable, column) for variable, column in zip(variables, columns, strict=True)]
        found = _interpolated(judged, np.column_stack(shares), figures)
        if found is None:
            return None
        values, failures = found
        axes = [np.array([variable.at(share) for share in np.linspace(0, 1, _NODES)]) for variable in variables]
        caption = f"Interpolated linearly between {int(judged.works.sum()):,} designs (dots); white: too far from any."
    else:
        cells = int(np.clip(math.sqrt(len(judged) / _PER_CELL), *_CELLS)) if scattered else _MOST_STEPS
        for k, variable in enumerate(variables):
            if scattered or len(axes[k]) > cells:
                axes[k] = np.array([variable.at((cell + 0.5) / cells) for cell in range(cells)])
        # Every design belongs to the cell of the axes' nearest values.
        i, j = (np.searchsorted((a[1:] + a[:-1]) / 2, column) for a, column in zip(axes, columns, strict=True))
        best = np.full((len(axes[1]), len(axes[0])), -1)
        # Of several designs the last one written stays: failed ones first, then from the worst to the best.
        order = np.concatenate([np.flatnonzero(~judged.works), judged.best_first[::-1]])
        best[j[order], i[order]] = order
        works = (best >= 0) & judged.works[best]
        values = {name: np.where(works, judged.figure(name)[best], np.nan) for name in figures}
        failures = np.where(best >= 0, np.array(judged.failures, dtype=object)[best], "")
        if others := [tables.words_of(name) for name in free if name not in names]:
            caption = (
                f"{tables.listed(others).capitalize()} also vary: each place shows the design there that misses the "
                f"constraints least and then has the best {tables.words_of(judged.study.objectives[0].figure)}."
            )
    reasons, bounded = failures.astype(object), [name for name in judged.study.constraints if name in values]
    for place in map(tuple, np.argwhere(reasons == "")):
        row = {name: float(values[name][place]) for name in bounded}
        reasons[place] = "; ".join(text for text, _ in tables.misses(judged.study, row).values())
    return Map(axes[0], axes[1], values, reasons, smooth=alone or not scattered, dots=scattered, caption=caption)


def _interpolated(
    judged: Judged, places: np.ndarray, figures: Sequence[str]
) -> tuple[dict[str, np.ndarray], np.ndarray] | None:
    """Figures between designs at ``places`` (N, 2), shares of the ranges, and reasons why the nearest one fails."""
    shares = np.linspace(0, 1, _NODES)
    nodes = np.stack(np.meshgrid(shares, shares), axis=-1)
    try:
        mesh = Delaunay(places[judged.works])
    except (QhullError, ValueError):
        return None
    known = np.column_stack([judged.figure(name)[judged.works] for name in figures])
    found = LinearNDInterpolator(mesh, known)(nodes)
    # A node belongs to its nearest design: near one that fails nothing is known.
    nearest = KDTree(places).query(nodes)[1]
    found[~judged.works[nearest]] = np.nan
    if not np.isfinite(found[..., 0]).any():
        return None
    return dict(zip(figures, np.moveaxis(found, -1, 0), strict=True)), np.array(judged.failures, dtype=object)[nearest]


@_plain_text
def contours(judged: Judged, marked: Sequence[Marked], x: str, y: str) -> Static | None:
    """The figures over two variables beside each other; None where the designs span no area."""
    figures = shown_figures(judged)
    found = map_of(judged, x, y, figures)
    if found is None:
        return None
    figure, panels = _panels(figures)
    variables = [judged.study.variables[name] for name in (x, y)]
    dots = np.flatnonzero(sample(judged.works, np.zeros(len(judged), bool), _MOST_DOTS)) if found.dots else []
    missed, grey = found.reasons != "", np.zeros((*found.reasons.shape, 4))
    works = np.isfinite(np.stack(list(found.values.values()))).any(axis=0)
    grey[missed & works], grey[missed & ~works] = to_rgba("#e4e7eb", 0.72), to_rgba("#969ea8")
    # Lines on which constraints are just met.
    limits = []
    for (name, sign, bound), colour in zip(judged.study.bounds(), _LIMITS * 10, strict=False):
        values, level = found.values.get(name, np.empty(0)), bound + sign * _BESIDE * (abs(bound) or 1.0)
        crossed = min(values.shape) > 1 and (values < level).any() and (values > level).any()
        if crossed and len(judged.study.free()) == 2:
            limits.append((values, level, colour, tables.bound_text(name, sign, bound)))
    for number, (axes, name) in enumerate(panels):
        _fill(axes, found, name)
        if missed.any():
            axes.pcolormesh(found.x, found.y, grey, shading="nearest", rasterized=True, linewidth=0, antialiased=False)
        for values, level, colour, label in limits:
            axes.contour(found.x, found.y, values, levels=[level], colors=colour, linestyles="--")
            axes.plot([], [], color=colour, linestyle="--", label=label)
        if len(dots):
            at = [judged.columns[free][dots] for free in (x, y)]
            axes.plot(*at, ".", color=INK, markersize=1.0, alpha=0.5, rasterized=True)
        _mark(axes, marked, x, y)
        axes.grid(visible=False)
        axes.set(xlabel=tables.label_of(x), ylabel="" if number % _PANEL_COLUMNS else tables.label_of(y))
        axes.set(xscale=variables[0].scale, yscale=variables[1].scale)
        # Designs on the border of the range are seen wholly.
        xlim, ylim = ((float(v.at(-_MARGIN)), float(v.at(1 + _MARGIN))) for v in variables)
        axes.set(xlim=xlim, ylim=ylim)
    legend_below(figure)
    ends = {name: variable.ends() for name, variable in zip((x, y), variables, strict=True)}
    outside = [m.label for m in marked if not all(a <= m.design.number_of(n) <= b for n, (a, b) in ends.items())]
    parts = (
        found.caption,
        "Light grey: a constraint is missed; dark grey: designs cannot work; the table of reasons says why."
        if missed.any()
        else "",
        f"Outside the ranges: {tables.listed(outside)}." if outside else "",
    )
    return figure, " ".join(filter(None, parts))


def _fill(axes: Axes, found: Map, name: str) -> None:
    """Draw a figure as filled contours, or as cells where neighbours differ in kind; wide ranges in their logarithm."""
    values = found.values[name]
    good = values[(found.reasons == "") & np.isfinite(values)]
    known = values[np.isfinite(values)]
    if not len(known):
        return
    # Few extreme values must not take all the colours.
    low, high = float(np.quantile(known, 0.02)), float(np.quantile(good if len(good) > 10 else known, 0.98))
    high = max(high, low + 1e-12 + 1e-9 * abs(low))
    log = low > 0 and high > _WIDE * low
    norm = LogNorm(low, high) if log else Normalize(low, high)
    if found.smooth and min(values.shape) > 1:
        steps = np.geomspace(low, high, _LEVELS + 1) if log else MaxNLocator(_LEVELS).tick_values(low, high)
        drawn = axes.contourf(found.x, found.y, values, levels=steps, norm=norm, extend="both")
    else:
        drawn = axes.pcolormesh(found.x, found.y, values, norm=norm, shading="nearest", rasterized=True)
    ticks = np.geomspace(low, high, 5).tolist() if log else None
    bar = axes.figure.colorbar(drawn, ax=axes, ticks=ticks)
    if ticks:
        bar.set_ticks(ticks, labels=[tables.number_text(tick, 2) for tick in ticks], minor=False)
        bar.ax.minorticks_off()


# --- rendering --------------------------------------------------------------------------------------------------------


@_plain_text
def verification_chart(found: Agreement) -> Static | None:
    """Scatter as predicted and as rendered, and the systematic error, over Z."""
    if not found.z_mm:
        return None
    figure, (scatter, error) = new_figure(9.6, 3.2, columns=2)
    z, predicted, rendered, off = map(np.array, (found.z_mm, found.predicted_mm, found.rendered_mm, found.error_mm))
    scatter.plot(z, 1e3 * predicted, "o--", markersize=4, label="predicted by formulas")
    scatter.plot(z, 1e3 * rendered, "o-", color=RED, markersize=4, label="rendered and measured")
    error.plot(z, 1e3 * off, "o-", color=INK, markersize=4)
    error.axhline(0, color=INK, linewidth=0.8)
    scatter.set(xlabel="Z from the stand-off (mm)", ylabel="scatter along Z, σ (µm)")
    scatter.set_ylim(bottom=0)
    error.set(xlabel="Z from the stand-off (mm)", ylabel="systematic error (µm)")
    legend_below(figure)
    return figure, "Left: standard deviation of the points along Z. Right: their mean distance from the true plane."


# --- the Pareto front -------------------------------------------------------------------------------------------------


def trade_off(judged: Judged) -> tuple[tuple[str, int], tuple[str, int]]:
    """The two figures to weigh against each other, each with 1 to minimise or -1 to maximise.

    The study's first two objectives; of a study with one, also the first other figure with a constraint or, without
    any, the length of the line.
    """
    wanted = [(o.figure, 1 if o.goal == "minimise" else -1) for o in judged.study.objectives]
    wanted += [(name, 1 if c.least is None else -1) for name, c in judged.study.constraints.items()]
    wanted += [("line_mm", -1), ("depth_mm", -1)]
    second = wanted[-1]
    for name, sign in reversed(wanted[1:]):
        values = judged.figure(name)[judged.works & np.isfinite(judged.figure(name))]
        varies = len(values) > 1 and float(np.ptp(values)) > 1e-9 * float(np.abs(values).max())
        second = (name, sign) if varies and name != wanted[0][0] else second
    return wanted[0], second


def pareto_chart(judged: Judged, marked: Sequence[Marked]) -> Interactive | None:
    """All designs that work over two figures, and the front of those that meet the constraints."""
    (x, x_sign), (y, y_sign) = trade_off(judged)
    values = np.column_stack([judged.figure(x) * x_sign, judged.figure(y) * y_sign])
    known = judged.works & np.isfinite(values).all(axis=1)
    if not known.any():
        return None
    front = pareto(np.where((judged.of_interest & known)[:, None], values, np.nan))
    shown = sample(known, front, MOST_POINTS)
    figure = go.Figure()
    labels = [_escaped(tables.label_of(name)) for name in (x, y)]

    def at(places: np.ndarray) -> dict[str, object]:
        return {axis: tables.rounded(judged.figure(name)[places]) for axis, name in (("x", x), ("y", y))}

    for name, chosen, colour in (
        ("misses a constraint", shown & ~judged.feasible, "#b3bcc6"),
        ("meets all constraints", shown & judged.feasible & ~front, BLUE),
    ):
        if len(places := np.flatnonzero(chosen)):
            trace = (go.Scattergl if len(places) > _IN_SVG else go.Scatter)(
                **at(places),
                name=name,
                mode="markers",
                marker={"color": colour, "size": 4 if shown.sum() > _FEW else 7, "opacity": 0.55},
                customdata=judged.columns["design"][places].tolist(),
                hovertemplate=f"design %{{customdata}}<br>{labels[0]}: %{{x}}<br>{labels[1]}: %{{y}}"
                f"<extra>{name}</extra>",
            )
            figure.add_trace(trace)
    order = np.flatnonzero(front)[np.argsort(values[front, 0])]
    names = list(dict.fromkeys([*judged.study.free(), x, y]))
    figure.add_scatter(
        **at(order),
        name=f"Pareto front ({len(order):,} of the designs)",
        mode="lines+markers",
        line={"color": GREEN, "width": 2},
        marker={"size": 6, "color": GREEN},
        text=[
            "<br>".join(
                [f"design {judged.columns['design'][place]}"]
                + [_escaped(f"{tables.words_of(name)}: {tables.text_at(judged, name, place)}") for name in names]
            )
            for place in order
        ],
        hovertemplate="%{text}<extra></extra>",
    )
    axis = {"gridcolor": FAINT, "linecolor": INK, "ticks": "outside", "zeroline": False, "automargin": True}
    ends, axes = [], []
    for name, label, distance in zip((x, y), labels, (10, 12), strict=True):
        numbers = np.append(judged.figure(name)[known], [one.design.number_of(name) for one in marked])
        ends.append((float(np.nanmin(numbers)), float(np.nanmax(numbers))))
        log = {"type": "log", "dtick": "D2"} if 0 < ends[-1][0] * _WIDE_RANGE < ends[-1][1] else {}
        axes.append(axis | {"title": {"text": label, "standoff": distance}} | log)
    figure.update_layout(
        _LAYOUT,
        height=520,
        margin={"l": 70, "r": 20, "t": 30, "b": 56},
        font_size=13,
        xaxis=axes[0],
        yaxis=axes[1],
        legend={"orientation": "h", "y": -0.16, "yanchor": "top", "x": 0, "itemsizing": "constant"},
        hovermode="closest",
        hoverlabel={"namelength": -1, "bgcolor": "white", "font": {"color": INK}},
        separators=". ",
        plot_bgcolor="white",
    )
    logs = ["type" in axis for axis in axes]
    _add_marked(figure, marked, (x, y), logs, middle=sum(map(math.log10, ends[0]) if logs[0] else ends[0]) / 2)
    better = " and ".join(
        f"{'less' if sign > 0 else 'more'} {tables.words_of(name)}" for name, sign in ((x, x_sign), (y, y_sign))
    )
    thin = f" {int(shown.sum()):,} of {int(known.sum()):,} designs are drawn." if shown.sum() < known.sum() else ""
    none = "" if judged.feasible.any() else " None meets all constraints: the front is that of all that work."
    more = " Further objectives are left out here." if len(judged.study.objectives) > 2 else ""
    return figure, f"Better is {better}: nothing beats the designs on the green line in both.{more}{none}{thin}"


def _add_marked(
    figure: go.Figure, marked: Sequence[Marked], names: tuple[str, str], logs: Sequence[bool], *, middle: float
) -> None:
    """Add marked designs with their labels, which stand towards the ``middle`` of the x axis."""
    for number, one in enumerate(marked):
        colour, size = (RED, 15) if one is marked[-1] else (INK, 11)
        at, label = [one.design.number_of(name) for name in names], _escaped(one.label)
        if not all(map(math.isfinite, at)):
            continue
        places = [math.log10(value) if log else value for value, log in zip(at, logs, strict=True)]
        left = places[0] > middle
        marker = {"symbol": _SYMBOLS[number % len(_SYMBOLS)][0], "size": size}
        figure.add_scatter(
            x=tables.rounded(at[:1]),
            y=tables.rounded(at[1:]),
            mode="markers",
            showlegend=False,
            name=label,
            marker=marker | {"color": colour, "line": {"color": "white", "width": 1.5}},
            hovertemplate=f"<b>{label}</b><br>{_escaped(tables.label_of(names[0]))}: %{{x}}<br>%{{y}}<extra></extra>",
        )
        figure.add_annotation(
            {"x": places[0], "y": places[1], "ax": -30 if left else 30, "ay": _AWAY[number % len(_AWAY)]},
            text=f"<b>{label}</b>",
            xanchor="right" if left else "left",
            arrowcolor=colour,
            arrowwidth=1.2,
            arrowhead=0,
            standoff=7,
            bgcolor="rgba(255,255,255,0.88)",
            borderpad=2,
            font={"color": colour, "size": 12.5},
        )


def sample(candidates: np.ndarray, kept: np.ndarray, most: int) -> np.ndarray:
    """At most so many of the candidates (N,), drawn at random, all kept ones among them."""
    others = np.flatnonzero(candidates & ~kept)
    room = max(0, most - int(kept.sum()))
    if len(others) > room:
        others = np.random.default_rng(0).choice(others, room, replace=False)
    chosen = kept.copy()
    chosen[others] = True
    return chosen


def parallel_chart(judged: Judged) -> Interactive | None:
    """Every design that meets the constraints as a line over all that is free, wanted and bounded."""
    if not judged.feasible.any():
        return None
    places = np.flatnonzero(sample(judged.feasible, judged.front(judged.of_interest), MOST_LINES))
    names = list(dict.fromkeys([*judged.study.free(), *judged.study.wanted()]))[:_MOST_DIMENSIONS]
    objective = judged.study.objectives[0]
    colours = judged.figure(objective.figure)[places]
    low, high = float(colours.min()), float(np.quantile(colours, 0.95))
    figure = go.Figure(
        go.Parcoords(
            dimensions=[_dimension(judged, name, places) for name in names],
            labelangle=-12,
            labelside="top",
            labelfont={"size": 12},
            tickfont={"size": 11},
            rangefont={"size": 1, "color": "rgba(0,0,0,0)"},
            line={
                "color": tables.rounded(colours),
                "colorscale": "Viridis",
                "showscale": True,
                "cmin": low,
                "cmax": high if high > low else low + max(abs(low), 1e-9),
                "reversescale": objective.goal == "maximise",
                "colorbar": {
                    "title": {"text": _escaped(tables.label_of(objective.figure)), "side": "right"},
                    "thickness": 14,
                },
            },
        )
    )
    figure.update_layout(_LAYOUT, height=470, margin={"l": 80, "r": 40, "t": 110, "b": 30}, font_size=12)
    total = int(judged.feasible.sum())
    count = f"{len(places):,} of {total:,} designs" if len(places) < total else f"All {total:,} designs"
    return figure, (f"{count} that meet all constraints. Drag along an axis to keep only what passes there.")


def _dimension(judged: Judged, name: str, places: np.ndarray) -> dict[str, object]:
    """A parallel axis: choices and laser classes by name, else numbers."""
    values, variable = judged.columns[name][places], judged.study.free().get(name)
    label = _escaped(tables.label_of(name))
    if variable is not None and variable.values is not None:
        options = list(variable.values)
        # Ticks hold plain text, in which nothing is a tag.
        texts = [
            textwrap.shorten(tables.value_text(name, option, unit=False), 24, placeholder="…") for option in options
        ]
        ticks, codes = list(range(len(options))), [options.index(value) for value in values.tolist()]
    elif name == "laser_class":
        ticks, texts, codes = list(CLASS_NAMES), list(CLASS_NAMES.values()), tables.rounded(values)
    else:
        low, high = float(values.min()), float(values.max())
        margin = 0.0 if high > low else max(abs(low) * 0.05, 1e-6)
        return {"label": label, "values": tables.rounded(values), "range": [low - margin, high + margin]}
    ends = [ticks[0] - 0.3, ticks[-1] + 0.3]
    return {"label": label, "values": codes, "tickvals": ticks, "ticktext": texts, "range": ends}
