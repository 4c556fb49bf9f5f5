"""Charts of a study: figures over free variables, Pareto front, parallel coordinates, rendering against formulas."""

from __future__ import annotations

import itertools
import math
import textwrap
from collections.abc import Callable, Sequence
from functools import partial
from html import escape

import matplotlib
import numpy as np
import plotly.graph_objects as go
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from matplotlib.tri import Triangulation

from twin.design.choice import StudyResults, find_pareto_front
from twin.design.designs import HighlightedDesign
from twin.design.figures_of_merit import CLASS_NAMES, RENDERED_SCATTERING_DEPTH
from twin.design.report import study_tables as tables
from twin.design.study import Variable
from twin.design.verification import Agreement
from uwlts.pages.toolkit import BLUE, COLOURS, FAINT, INK, RED, legend_below, new_figure

Static = tuple[Figure, str]
Interactive = tuple[go.Figure, str]
"""Figure for a page, and its caption."""

_FRONT = COLOURS[2]
"""Colour of the Pareto front."""
_PALE = "#c3cad2"
"""Colour of bars of designs that violate a constraint."""
_LIMITS = ("#d9480f", "#862e9c", "#0b7285", "#e67700", "#364fc7")
"""Colours of the contour lines at the constraints' bounds."""
_SYMBOLS = (("diamond", "D"), ("circle", "o"), ("star", "*"), ("square", "s"), ("cross", "P"))
"""Symbols of highlighted designs, in plotly and in matplotlib."""
_TEXT_HEIGHTS = ("top", "bottom", "middle")
"""Heights of labels of highlighted designs, in turn; labels point to the middle of the chart."""
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
"""Figures shown in addition to objectives and constraints, the most informative first."""
_MOST_PANELS = 9  # of a figure, so that it fits on a page
_PANEL_COLUMNS = 3  # of a page's width
_PANEL_INCHES = (4.0, 3.1)  # width and height
_BAR_INCHES = 0.17  # height of a bar with its label
# Limits: more points and lines make a page slow; more dots, curve points, bars and axes would overlap.
MOST_POINTS = 20_000
MOST_LINES = 5_000
_MOST_DOTS = 2000
_MOST_OF_CURVE = 500
_MOST_BARS = 40
_MOST_DIMENSIONS = 12
_FEW = 300
"""Above this number, points are drawn smaller."""
_IN_SVG = 2500
"""Above this number, points are drawn with WebGL, which is faster."""
_LAYOUT = {"template": "none", "font": {"color": INK}, "paper_bgcolor": "white"}
_WIDE_RANGE = 30.0
"""Ratio of the largest to the smallest value above which a figure has a logarithmic axis."""
_DASHED = "Dashed: bounds."
_INTERVALS = 100
"""Intervals of a curve with one best design each, if further variables are free."""
_CELLS = 40
"""Cells along each side of a map with one best design each, if further variables are free."""
_FLAT = 1e-6
"""Tolerance, relative to the ranges, for designs on a line, which do not span a map."""
_LEVELS = 12  # contour levels that the eye still separates
_WIDE = 15.0
"""Ratio of a figure's values above which a map has logarithmic colours."""
_MARGIN = 0.02
"""Margin of the axes relative to the ranges."""
_BESIDE = 1e-4
"""Relative offset of a bound's contour into the violated side, because a discrete figure can equal the bound."""

_plain_text = matplotlib.rc_context({"text.parse_math": False})
"""Dollar signs in users' names are not formulas."""
_escaped = partial(escape, quote=False)
"""Escape text for plotly."""


def shown_figures(judged: StudyResults) -> list[str]:
    """Return the known figures to show: objectives, constraints, then the most informative others."""
    names = dict.fromkeys([*judged.study.figures(), *_SHOWN])
    return [name for name in names if np.isfinite(judged.figure(name)[judged.works]).any()]


# --- panels of static figures -----------------------------------------------------------------------------------------


def _panels(names: Sequence[str], *, height: float = _PANEL_INCHES[1]) -> tuple[Figure, list[tuple[Axes, str]]]:
    """Make a Matplotlib figure with axes for the first figures of merit; their labels are the titles."""
    names = names[:_MOST_PANELS]
    columns = min(_PANEL_COLUMNS, len(names))
    rows = -(-len(names) // columns)
    figure, axes = new_figure(_PANEL_INCHES[0] * columns, height * rows, rows=rows, columns=columns)
    for unused in axes[len(names) :]:
        unused.remove()
    for one, name in zip(axes, names, strict=False):
        one.set_title(tables.label_of(name))
    return figure, list(zip(axes, names, strict=False))


def _mark(axes: Axes, marked: Sequence[HighlightedDesign], x: str, y: str) -> None:
    """Draw highlighted designs as symbols, the chosen one in red."""
    for number, one in enumerate(marked):
        at, (colour, size) = (
            (one.design.number_of(x), one.design.number_of(y)),
            (RED, 10) if one is marked[-1] else (INK, 8),
        )
        if all(map(math.isfinite, at)):
            style = {"color": colour, "markersize": size, "markeredgecolor": "white", "zorder": 6}
            axes.plot(*at, _SYMBOLS[number % len(_SYMBOLS)][1], label=one.label, **style)


def _draw_bounds(draw: Callable[..., object], judged: StudyResults, name: str) -> None:
    for bounded, _, bound in judged.study.bounds():
        if bounded == name:
            draw(bound, color=RED, linewidth=1.2, linestyle="--")


# --- curves and bars --------------------------------------------------------------------------------------------------


@_plain_text
def curves(judged: StudyResults, marked: Sequence[HighlightedDesign], x: str) -> Static:
    """Draw figures over one variable: a curve for each combination of the other variables, or the best of all."""
    others = [name for name in judged.study.free() if name != x]
    groups: dict[str, list[int]] = {}
    for place in np.flatnonzero(judged.works):
        groups.setdefault(_combination(judged, others, int(place)), []).append(int(place))
    caption = ""
    if len(groups) > len(COLOURS):
        groups = {"best": judged.best_first.tolist()}
        varying = tables.join_words([tables.words_of(name) for name in others]).capitalize()
        caption = f"{varying} also vary: each point is the best design of its interval. "
    at, found = np.asarray(judged.columns[x], dtype=float), {}
    for name, members in groups.items():
        places = np.array(members)
        if caption:
            # Designs are sorted by merit: the first of each interval is the best.
            share = normalise(judged.study.variables[x], at[places])
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
    missed = "Hollow: a constraint is missed. " if (judged.works & ~judged.feasible).any() else ""
    return figure, f"{caption}{missed}{_DASHED if judged.study.bounds() else ''}".strip()


def _combination(judged: StudyResults, names: Sequence[str], place: int) -> str:
    return ", ".join(tables.format_design_value(judged, name, place) for name in names)


@_plain_text
def bars(judged: StudyResults) -> Static:
    """Draw the figures of all combinations of choices as bars, the best first."""
    places = judged.best_first[:_MOST_BARS]
    labels = [_combination(judged, list(judged.study.free()), place) for place in places]
    figure, panels = _panels(shown_figures(judged), height=max(_PANEL_INCHES[1], _BAR_INCHES * len(places)))
    for number, (axes, name) in enumerate(panels):
        axes.barh(range(len(places)), judged.figure(name)[places], color=np.where(judged.feasible[places], BLUE, _PALE))
        # Labels are long: only the left panels have them.
        axes.set_yticks(range(len(places)), labels if number % _PANEL_COLUMNS == 0 else [""] * len(places))
        axes.invert_yaxis()
        _draw_bounds(axes.axvline, judged, name)
    count = f"The best {len(places)} of {int(judged.works.sum()):,} designs." if len(places) == _MOST_BARS else ""
    grey = " Grey: a constraint is missed." if not judged.feasible[places].all() else ""
    return figure, f"{count}{grey} {_DASHED if judged.study.bounds() else ''}".strip()


def normalise(variable: Variable, values: np.ndarray) -> np.ndarray:
    """Normalise values to a variable's range (0 to 1), on its scale."""
    values, (least, most) = np.asarray(values, dtype=float), variable.ends()
    if variable.scale == "log":
        return np.log(values / least) / math.log(most / least)
    return (values - least) / (most - least)


# --- maps over two variables ------------------------------------------------------------------------------------------


def map_places(judged: StudyResults, x: str, y: str) -> np.ndarray:
    """Return the indices of designs to show over two variables: all, or the best of each cell if more are free."""
    if len(judged.study.free()) == 2:
        return np.arange(len(judged))
    cells = [np.rint(_CELLS * normalise(judged.study.variables[name], judged.columns[name])) for name in (x, y)]
    order = np.concatenate([judged.best_first, np.flatnonzero(~judged.works)])
    return order[np.unique(np.stack(cells)[:, order], axis=1, return_index=True)[1]]


def mesh_between(judged: StudyResults, places: np.ndarray, x: str, y: str) -> Triangulation | None:
    """Triangulate designs over two variables; triangles with a failed design are masked.

    Return None if the designs are on a line.
    """
    shares = np.column_stack([normalise(judged.study.variables[name], judged.columns[name][places]) for name in (x, y)])
    if np.linalg.matrix_rank(shares - shares.mean(axis=0), tol=_FLAT) < 2:
        return None
    triangles = Triangulation(shares[:, 0], shares[:, 1]).triangles
    at_x, at_y = (np.asarray(judged.columns[name][places], dtype=float) for name in (x, y))
    return Triangulation(at_x, at_y, triangles, mask=~judged.works[places][triangles].all(axis=1))


@_plain_text
def contours(judged: StudyResults, marked: Sequence[HighlightedDesign], x: str, y: str) -> Static | None:
    """Draw maps of the figures over two variables; None if the designs are on a line."""
    study, places = judged.study, map_places(judged, x, y)
    mesh = mesh_between(judged, places, x, y)
    if mesh is None or mesh.mask is None or mesh.mask.all():
        return None
    works = judged.works[places]

    def over(name: str) -> np.ndarray:
        return np.where(works, judged.figure(name)[places], np.nan)

    # Violation of each bound relative to it; a discrete figure can equal the bound.
    missed = [(sign * (over(name) - bound) / (abs(bound) or 1.0) - _BESIDE) for name, sign, bound in study.bounds()]
    limits = list(zip(missed, itertools.cycle(_LIMITS), (tables.bound_text(*each) for each in study.bounds())))
    fails = np.max(missed, axis=0, initial=-1.0)
    beyond, misses = np.where(works, fails, 0.0), bool((fails[works] > 0).any())
    dots = [
        (np.flatnonzero(sample(chosen, np.zeros(len(places), bool), _MOST_DOTS)), style, size)
        for chosen, style, size in ((works, ".", 1.5), (~works, "x", 3.0))
    ]
    variables = [study.variables[name] for name in (x, y)]
    figure, panels = _panels(shown_figures(judged))
    for number, (axes, name) in enumerate(panels):
        _fill(axes, mesh, over(name), good=fails <= 0)
        if misses:
            axes.tricontourf(mesh, beyond, levels=[0.0, 1.01 * beyond.max()], colors="#e4e7eb", alpha=0.72)
        for values, colour, label in limits if len(study.free()) == 2 else ():
            if values[works].min() < 0 < values[works].max():
                axes.tricontour(mesh, np.where(works, values, 0.0), levels=[0.0], colors=colour, linestyles="--")
                axes.plot([], [], color=colour, linestyle="--", label=label)
        for shown, style, size in dots:
            axes.plot(mesh.x[shown], mesh.y[shown], style, color=INK, markersize=size, alpha=0.5, rasterized=True)
        _mark(axes, marked, x, y)
        axes.grid(visible=False)
        axes.set(xlabel=tables.label_of(x), ylabel="" if number % _PANEL_COLUMNS else tables.label_of(y))
        axes.set(xscale=variables[0].scale, yscale=variables[1].scale)
        # Margin for symbols at the border of the range.
        xlim, ylim = ((float(v.value_at(-_MARGIN)), float(v.value_at(1 + _MARGIN))) for v in variables)
        axes.set(xlim=xlim, ylim=ylim)
    legend_below(figure)
    others = [tables.words_of(name) for name in study.free() if name not in (x, y)]
    ends = {name: variable.ends() for name, variable in zip((x, y), variables, strict=True)}
    outside = [m.label for m in marked if not all(a <= m.design.number_of(n) <= b for n, (a, b) in ends.items())]
    parts = (
        f"{tables.join_words(others).capitalize()} also vary: each point is the design of its cell with the smallest "
        f"constraint violation, then with the best {tables.words_of(study.objectives[0].figure)}."
        if others
        else "",
        "Interpolated linearly between designs (dots).",
        "Grey: a constraint is missed." if misses else "",
        "Crosses: designs that cannot work; see the table of reasons." if not works.all() else "",
        f"Outside the ranges: {tables.join_words(outside)}." if outside else "",
    )
    return figure, " ".join(filter(None, parts))


def _fill(axes: Axes, mesh: Triangulation, values: np.ndarray, *, good: np.ndarray) -> None:
    """Draw a figure as filled contours, with a logarithmic scale for wide ranges."""
    known = np.isfinite(values)
    mesh = Triangulation(mesh.x, mesh.y, mesh.triangles, mask=~known[mesh.triangles].all(axis=1))
    if mesh.mask is None or mesh.mask.all():
        return
    # The colour scale excludes a few extreme values.
    best = values[good & known]
    low, high = np.quantile(values[known], 0.02), np.quantile(best if len(best) > 10 else values[known], 0.98)
    high = max(high, low + 1e-12 + 1e-9 * abs(low))
    log = low > 0 and high > _WIDE * low
    norm = LogNorm(low, high) if log else Normalize(low, high)
    steps = np.geomspace(low, high, _LEVELS + 1) if log else MaxNLocator(_LEVELS).tick_values(low, high)
    drawn = axes.tricontourf(mesh, np.where(known, values, low), levels=steps, norm=norm, extend="both")
    ticks = np.geomspace(low, high, 5).tolist() if log else None
    bar = axes.figure.colorbar(drawn, ax=axes, ticks=ticks)
    if ticks:
        bar.set_ticks(ticks, labels=[tables.number_text(tick, 2) for tick in ticks], minor=False)
        bar.ax.minorticks_off()


# --- rendering --------------------------------------------------------------------------------------------------------


@_plain_text
def verification_chart(found: Agreement) -> Static | None:
    """Draw predicted and rendered scatter, and the systematic error, over Z."""
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


def choose_pareto_axes(judged: StudyResults) -> tuple[tuple[str, int], tuple[str, int]]:
    """Return the two figures of the Pareto chart, each with 1 to minimise or -1 to maximise.

    They are the study's first two objectives. With one objective, the second figure is the first constrained one, or
    the line length without constraints.
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


def pareto_chart(judged: StudyResults, marked: Sequence[HighlightedDesign]) -> Interactive | None:
    """Draw all working designs over two figures, and the Pareto front of those that meet the constraints."""
    (x, x_sign), (y, y_sign) = choose_pareto_axes(judged)
    values = np.column_stack([judged.figure(x) * x_sign, judged.figure(y) * y_sign])
    known = judged.works & np.isfinite(values).all(axis=1)
    if not known.any():
        return None
    front = find_pareto_front(np.where((judged.of_interest & known)[:, None], values, np.nan))
    shown = sample(known, front, MOST_POINTS)
    figure = go.Figure()
    labels = [_escaped(tables.label_of(name)) for name in (x, y)]

    def select_points(places: np.ndarray) -> dict[str, object]:
        return {axis: tables.round_for_json(judged.figure(name)[places]) for axis, name in (("x", x), ("y", y))}

    for name, chosen, colour in (
        ("misses a constraint", shown & ~judged.feasible, "#b3bcc6"),
        ("meets all constraints", shown & judged.feasible & ~front, BLUE),
    ):
        if len(places := np.flatnonzero(chosen)):
            trace = (go.Scattergl if len(places) > _IN_SVG else go.Scatter)(
                **select_points(places),
                name=name,
                mode="markers",
                marker={"color": colour, "size": 4 if shown.sum() > _FEW else 7, "opacity": 0.55},
                customdata=judged.columns["design"][places].tolist(),
                hovertemplate=f"design %{{customdata}}<br>{labels[0]}: %{{x}}<br>{labels[1]}: %{{y}}"
                f"<extra>{name}</extra>",
            )
            figure.add_trace(trace)
    order = np.flatnonzero(front)[np.argsort(values[front, 0])]
    names = list(dict.fromkeys([*judged.study.free(), x, y, "scattering_depth"]))
    names = [name for name in names if name in judged.columns]
    figure.add_scatter(
        **select_points(order),
        name=f"Pareto front ({len(order):,} of the designs)",
        mode="lines+markers",
        line={"color": _FRONT, "width": 2},
        marker={"size": 6, "color": _FRONT},
        text=[
            "<br>".join(
                [f"design {judged.columns['design'][place]}"]
                + [
                    _escaped(f"{tables.words_of(name)}: {tables.format_design_value(judged, name, place)}")
                    for name in names
                ]
            )
            for place in order
        ],
        hovertemplate="%{text}<extra></extra>",
    )
    axis = {"gridcolor": FAINT, "linecolor": INK, "ticks": "outside", "zeroline": False, "automargin": True}
    axes = []
    for name, label in zip((x, y), labels, strict=True):
        numbers = np.append(judged.figure(name)[known], [one.design.number_of(name) for one in marked])
        wide = 0 < np.nanmin(numbers) * _WIDE_RANGE < np.nanmax(numbers)
        axes.append(
            axis | {"title": {"text": label, "standoff": 12}} | ({"type": "log", "dtick": "D2"} if wide else {})
        )
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
    across = judged.figure(x)[known]
    least, most = float(across.min()), float(across.max())
    middle = math.sqrt(least * most) if axes[0].get("type") == "log" else 0.5 * (least + most)
    for number, one in enumerate(marked):
        place, colour = [one.design.number_of(name) for name in (x, y)], RED if one is marked[-1] else INK
        if all(map(math.isfinite, place)):
            figure.add_scatter(
                x=tables.round_for_json(place[:1]),
                y=tables.round_for_json(place[1:]),
                mode="markers+text",
                showlegend=False,
                cliponaxis=False,
                text=[f"<b>{_escaped(one.label)}</b>"],
                textposition=f"{_TEXT_HEIGHTS[number % len(_TEXT_HEIGHTS)]} {'left' if place[0] > middle else 'right'}",
                textfont={"color": colour, "size": 12.5},
                marker={"symbol": _SYMBOLS[number % len(_SYMBOLS)][0], "size": 13, "color": colour},
                hovertemplate=f"%{{text}}<br>{labels[0]}: %{{x}}<br>{labels[1]}: %{{y}}<extra></extra>",
            )
    better = " and ".join(
        f"{'less' if sign > 0 else 'more'} {tables.words_of(name)}" for name, sign in ((x, x_sign), (y, y_sign))
    )
    thin = f" {int(shown.sum()):,} of {int(known.sum()):,} designs are drawn." if shown.sum() < known.sum() else ""
    none = (
        "" if judged.feasible.any() else " No design meets all constraints: the front is that of all working designs."
    )
    turbid = int((judged.figure("scattering_depth")[known] > RENDERED_SCATTERING_DEPTH).sum())
    deep = (
        f" {turbid:,} of the designs are beyond the optical depth of scattering, {RENDERED_SCATTERING_DEPTH:g}, up to "
        "which formulas and rendering were compared."
        if turbid
        else ""
    )
    more = " Further objectives are not shown." if len(judged.study.objectives) > 2 else ""
    return (
        figure,
        f"Better is {better}. No design is better in both than a design on the green line.{more}{none}{thin}{deep}",
    )


def sample(candidates: np.ndarray, kept: np.ndarray, most: int) -> np.ndarray:
    """Select at most ``most`` of the candidates (N,): all ``kept`` ones, and others at random."""
    others = np.flatnonzero(candidates & ~kept)
    room = max(0, most - int(kept.sum()))
    if len(others) > room:
        others = np.random.default_rng(0).choice(others, room, replace=False)
    chosen = kept.copy()
    chosen[others] = True
    return chosen


def parallel_chart(judged: StudyResults) -> Interactive | None:
    """Draw each design that meets the constraints as a line over free variables, objectives and constraints."""
    if not judged.feasible.any():
        return None
    places = np.flatnonzero(sample(judged.feasible, judged.front(judged.of_interest), MOST_LINES))
    names = list(dict.fromkeys([*judged.study.free(), *judged.study.figures()]))[:_MOST_DIMENSIONS]
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
                "color": tables.round_for_json(colours),
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
    return figure, f"{count} that meet all constraints. Drag along an axis to select designs by their values."


def _dimension(judged: StudyResults, name: str, places: np.ndarray) -> dict[str, object]:
    """Return a parallel axis: choices and laser classes by name, else numbers."""
    values, variable = judged.columns[name][places], judged.study.free().get(name)
    label = _escaped(tables.label_of(name))
    if variable is not None and variable.values is not None:
        options = list(variable.values)
        # Tick labels are plain text and need no escaping.
        texts = [
            textwrap.shorten(tables.value_text(name, option, unit=False), 24, placeholder="…") for option in options
        ]
        ticks, codes = list(range(len(options))), [options.index(value) for value in values.tolist()]
    elif name == "laser_class":
        ticks, texts, codes = list(CLASS_NAMES), list(CLASS_NAMES.values()), tables.round_for_json(values)
    else:
        low, high = float(values.min()), float(values.max())
        margin = 0.0 if high > low else max(abs(low) * 0.05, 1e-6)
        return {"label": label, "values": tables.round_for_json(values), "range": [low - margin, high + margin]}
    ends = [ticks[0] - 0.3, ticks[-1] + 0.3]
    return {"label": label, "values": codes, "tickvals": ticks, "ticktext": texts, "range": ends}
