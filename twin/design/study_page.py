"""Page of a study: the question, the design to build, and charts, as one HTML file without network resources."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from html import escape
from typing import Any

import numpy as np
import plotly.graph_objects as go
from matplotlib.figure import Figure
from plotly.subplots import make_subplots

from twin.design import drawing, study_tables as tables
from twin.design.choice import StudyResults, find_pareto_front
from twin.design.designs import Columns, HighlightedDesign
from twin.design.study import Study
from twin.design.verification import Agreement
from uwlts.pages.toolkit import (
    BLUE,
    COLOURS,
    INK,
    RED,
    FigureCollector,
    figure_svg,
    legend_below,
    new_figure,
    render_page,
)

Interactive = tuple[go.Figure, str]  # figure for a page, and its caption

_SYMBOLS = ("diamond", "circle", "star", "square", "cross")  # symbols of highlighted designs
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
# Limits: more points make a page slow.
MOST_POINTS = 20_000
_MOST_IN_PANEL = 2_000
_IN_SVG = 2500
"""Above this number, points are drawn with WebGL, which is faster."""
_WIDE_RANGE = 30.0  # ratio of the largest to the smallest value above which a figure has a logarithmic axis or colours
_escaped = partial(escape, quote=False)  # escape text for plotly


def figures_chart(judged: StudyResults, marked: Sequence[HighlightedDesign]) -> Interactive:
    """Draw figures over the free ranges: over one, or by colour over two; over the rank if there are only choices.

    Each point is a working design, hollow if it misses a constraint.
    """
    # Objectives and constraints come first, then the most informative others.
    study, every = judged.study, dict.fromkeys([*judged.study.figures(), *_SHOWN])
    names = [name for name in every if np.isfinite(judged.figure(name)[judged.works]).any()][:_MOST_PANELS]
    ranges = [name for name, variable in study.variables.items() if variable.values is None][:2]
    front = judged.front(judged.of_interest)
    places = np.flatnonzero(sample(judged.works, front, _MOST_IN_PANEL))
    rows = -(-len(names) // _PANEL_COLUMNS)
    titles = [_escaped(tables.label_of(name)) for name in names]
    spacing: dict[str, Any] = {"horizontal_spacing": 0.12, "vertical_spacing": 0.3 / rows}
    figure = make_subplots(rows, _PANEL_COLUMNS, subplot_titles=titles, **spacing)
    for number, name in enumerate(names):
        at: dict[str, Any] = {"row": number // _PANEL_COLUMNS + 1, "col": number % _PANEL_COLUMNS + 1}
        _draw_panel(figure, judged, places, [*ranges, name], at)
        for place, one in enumerate(marked) if ranges else ():
            x, y = [*ranges, name][:2]
            figure.add_trace(_mark(one, place, x, y, chosen=one is marked[-1]), **at)
    figure.update_layout(template="plotly_white", height=120 + 280 * rows, showlegend=False)
    count = int(judged.works.sum())
    thin = f" {len(places):,} of {count:,} working designs are drawn." if len(places) < count else ""
    dashed = " Dashed: bounds." if len(ranges) < 2 and study.bounds() else ""
    return figure, f"Hollow: a constraint is missed.{dashed}{thin} Hover over a point for its design."


def _draw_panel(
    figure: go.Figure, judged: StudyResults, places: np.ndarray, names: Sequence[str], at: dict[str, Any]
) -> None:
    """Draw designs into a panel: the last one of the names is its figure, the others are free ranges."""
    study, name = judged.study, names[-1]
    found = judged.figure(name)[places]
    marker = {"symbol": np.where(judged.feasible[places], "circle", "circle-open"), "color": BLUE}
    shown = [judged.columns[each][places] for each in names[:2]]
    if len(names) == 1:
        rank = np.empty(len(judged))
        rank[judged.best_first] = np.arange(1, len(judged.best_first) + 1)
        shown = [rank[places], found]
        figure.update_xaxes(title_text="rank", **at)
    if len(names) == 3:
        marker |= {"color": tables.round_for_json(found), "colorscale": "Viridis", "showscale": True}
        marker["colorbar"] = _lay_out_colour_bar(figure, **at)
    figure.add_scatter(
        x=tables.round_for_json(shown[0]),
        y=tables.round_for_json(shown[-1]),
        mode="markers",
        marker=marker,
        text=[_describe(judged, [name, *study.free()], int(place)) for place in places],
        hovertemplate="%{text}<extra></extra>",
        **at,
    )
    axes = ((figure.update_xaxes, names[0]), (figure.update_yaxes, names[1])) if len(names) > 1 else ()
    for update, each in axes:
        if each in study.variables:
            update(title_text=_escaped(tables.label_of(each)), type=study.variables[each].scale, **at)
    for each, _, bound in study.bounds() if len(names) < 3 else ():
        if each == name:
            figure.add_hline(bound, line={"color": RED, "dash": "dash"}, **at)


def _lay_out_colour_bar(figure: go.Figure, *, row: int, col: int) -> dict[str, object]:
    """Return the layout of the colour bar beside a panel."""
    panel = next(figure.select_xaxes(row=row, col=col)), next(figure.select_yaxes(row=row, col=col))
    across, along = (axis.domain for axis in panel)
    return {"x": across[1], "y": sum(along) / 2, "len": along[1] - along[0], "thickness": 8, "xpad": 2}


def _mark(one: HighlightedDesign, number: int, x: str, y: str, *, chosen: bool) -> go.Scatter:
    """Return a highlighted design as a symbol, the chosen one in red."""
    colour = RED if chosen else INK
    return go.Scatter(
        x=tables.round_for_json([one.design.number_of(x)]),
        y=tables.round_for_json([one.design.number_of(y)]),
        mode="markers",
        showlegend=False,
        marker={"symbol": _SYMBOLS[number % len(_SYMBOLS)], "size": 12, "color": colour},
        text=[f"<b>{_escaped(one.label)}</b>"],
        hovertemplate="%{text}<extra></extra>",
    )


def verification_chart(found: Agreement) -> tuple[Figure, str] | None:
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


def pareto_chart(judged: StudyResults, marked: Sequence[HighlightedDesign]) -> Interactive:
    """Draw all working designs over two figures, and the Pareto front of those that meet the constraints."""
    (x, x_sign), (y, y_sign) = choose_pareto_axes(judged)
    values = np.column_stack([judged.figure(x) * x_sign, judged.figure(y) * y_sign])
    known = judged.works & np.isfinite(values).all(axis=1)
    front = find_pareto_front(np.where((judged.of_interest & known)[:, None], values, np.nan))
    shown = sample(known, front, MOST_POINTS)
    figure = go.Figure()

    def add(name: str, places: np.ndarray, **style: object) -> None:
        draw = go.Scattergl if len(places) > _IN_SVG else go.Scatter
        across, along = (tables.round_for_json(judged.figure(each)[places]) for each in (x, y))
        texts = [_describe(judged, [*judged.study.free(), x, y, "scattering_depth"], int(place)) for place in places]
        about = {"text": texts, "hovertemplate": "%{text}<extra></extra>", "name": name}
        figure.add_trace(draw(x=across, y=along, **about, **style))

    for name, chosen, colour in (
        ("misses a constraint", shown & ~judged.feasible & ~front, "#b3bcc6"),
        ("meets all constraints", shown & judged.feasible & ~front, BLUE),
    ):
        if len(places := np.flatnonzero(chosen)):
            add(name, places, mode="markers", marker={"color": colour, "opacity": 0.55})
    order = np.flatnonzero(front)[np.argsort(values[front, 0])]
    add(f"Pareto front ({len(order):,} of the designs)", order, mode="lines+markers", line={"color": COLOURS[2]})
    logarithmic = []
    for axis, name in ((figure.update_xaxes, x), (figure.update_yaxes, y)):
        numbers = np.append(judged.figure(name)[known], [one.design.number_of(name) for one in marked])
        wide = 0 < np.nanmin(numbers) * _WIDE_RANGE < np.nanmax(numbers)
        axis(title_text=_escaped(tables.label_of(name)), type="log" if wide else "linear")
        logarithmic.append(wide)
    for number, one in enumerate(marked):
        at = [one.design.number_of(name) for name in (x, y)]
        if all(map(math.isfinite, at)):
            figure.add_trace(_mark(one, number, x, y, chosen=one is marked[-1]))
            # Beside the points, and opaque before them; places on a logarithmic axis are exponents.
            across, along = (math.log10(value) if log else value for value, log in zip(at, logarithmic, strict=True))
            label = {"text": _escaped(one.label), "bgcolor": "rgba(255,255,255,0.9)", "bordercolor": INK}
            figure.add_annotation(x=across, y=along, ax=70, ay=-40 - 34 * number, **label)
    figure.update_layout(template="plotly_white", height=520, legend={"orientation": "h", "y": -0.16})
    better = " and ".join(
        f"{'less' if sign > 0 else 'more'} {tables.words_of(name)}" for name, sign in ((x, x_sign), (y, y_sign))
    )
    thin = f" {int(shown.sum()):,} of {int(known.sum()):,} designs are drawn." if shown.sum() < known.sum() else ""
    none = (
        "" if judged.feasible.any() else " No design meets all constraints: the front is that of all working designs."
    )
    more = " Further objectives are not shown." if len(judged.study.objectives) > 2 else ""
    return figure, f"Better is {better}. No design is better in both than a design on the line.{more}{none}{thin}"


def _describe(judged: StudyResults, names: Sequence[str], place: int) -> str:
    """Return the number and values of a design as lines of text."""
    lines = [f"design {judged.columns['design'][place]}"]
    for name in dict.fromkeys(names):
        if name in judged.columns:
            lines.append(_escaped(f"{tables.words_of(name)}: {tables.format_design_value(judged, name, place)}"))
    return "<br>".join(lines)


def sample(candidates: np.ndarray, kept: np.ndarray, most: int) -> np.ndarray:
    """Select at most ``most`` of the candidates (N,): all ``kept`` ones, and others at random."""
    others = np.flatnonzero(candidates & ~kept)
    room = max(0, most - int(kept.sum()))
    if len(others) > room:
        others = np.random.default_rng(0).choice(others, room, replace=False)
    chosen = kept.copy()
    chosen[others] = True
    return chosen


_BEST = 20  # designs in the table of the best


def page_text(
    study: Study,
    columns: Columns,
    *,
    marked: Sequence[HighlightedDesign],
    agreements: Sequence[Agreement],
    notes: Sequence[str] = (),
) -> str:
    """Return the page of a study as HTML.

    At least one design works. Highlighted designs (``marked``) end with the chosen one; each rendered design has an
    agreement. Notes are sentences for the top of the page.

    Raises EvaluationError if the columns belong to another study.
    """
    judged, collected = StudyResults(study, columns), FigureCollector()
    views = [drawing.make_view(one.sensor, study.medium_of(one.sensor)) for one in (marked[-1], *marked[:-1][:1])]
    return render_page(
        "twin.design",
        "study_page.html.j2",
        interactive=collected,
        title=study.title,
        judged=judged,
        bounds=[tables.bound_text(*bound) for bound in study.bounds()],
        free=[tables.range_text(name, variable) for name, variable in study.free().items()],
        words=tables.words_of,
        notes=list(notes),
        label=marked[-1].label,
        chosen=tables.tiles(study, marked[-1], marked[0] if len(marked) > 1 else None),
        drawing=figure_svg(drawing.draw(*views)),
        behind=marked[0].label if len(views) > 1 else "",
        over_free=collected.add(*figures_chart(judged, marked)),
        pareto=collected.add(*pareto_chart(judged, marked)),
        number=tables.number_text,
        value=tables.value_text,
        verdicts=[
            (found, tables.agreement_text(found), drawn and (figure_svg(drawn[0]), drawn[1]))
            for found in agreements
            for drawn in [verification_chart(found)]
        ],
        best=_list_designs(judged, judged.best_first[:_BEST]),
        best_of_each=best_of_each(judged),
        failures=tables.failure_counts(judged),
        misses=[
            (tables.bound_text(key, sign, bound), f"{(sign * (judged.figure(key)[judged.works] - bound) > 0).sum():,}")
            for key, sign, bound in study.bounds()
        ],
        working=int(judged.works.sum()),
    )


def best_of_each(judged: StudyResults) -> tuple[list[str], list[list[str]]] | None:
    """Return the best design for each combination of choices, such as camera, window and water; None without choices.

    Media come first: they are conditions of the use.
    """
    values = {name: one.values for name, one in judged.study.free().items() if one.values and len(one.values) > 1}
    chosen = sorted(values, key=lambda name: not name.startswith("media."))
    found: dict[tuple[int, ...], int] = {}
    for place in judged.best_first.tolist():
        found.setdefault(tuple(values[name].index(judged.columns[name][place]) for name in chosen), place)
    return _list_designs(judged, [found[each] for each in sorted(found)][: 3 * _BEST], first=chosen) if chosen else None


def _list_designs(
    judged: StudyResults, places: Sequence[int] | np.ndarray, *, first: Sequence[str] = ()
) -> tuple[list[str], list[list[str]]]:
    """Return the head and rows of a table of designs, with the ``first`` names in the first columns."""
    study = judged.study
    more = ("sigma_z_rms_mm", "line_mm", "depth_mm", "standoff_mm", "required_ms", "laser_class", "scattering_depth")
    figures = dict.fromkeys([*study.figures(), *more])
    names = list(dict.fromkeys([*first, *study.free(), *(name for name in figures if name in judged.columns)]))
    missed = not judged.feasible.any()
    rows = [
        [str(judged.columns["design"][place])]
        + [tables.format_design_value(judged, name, place, unit=False) for name in names]
        + ([f"{judged.figure('violation')[place]:.3g}"] if missed else [])
        for place in places
    ]
    return ["design", *map(tables.label_of, names), *(["constraints missed by"] if missed else [])], rows
