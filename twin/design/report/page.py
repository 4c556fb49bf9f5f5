"""Page of a study: what was asked, and which design to build; one HTML file that loads nothing from the network."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress

import plotly.graph_objects as go
from markupsafe import Markup
from matplotlib.figure import Figure

import uwlts
from twin.design.description import Study
from twin.design.designs import Columns, Marked
from twin.design.report.charts import (
    Chart,
    Point,
    bars,
    contours,
    curves,
    parallel_chart,
    pareto_chart,
    verification_chart,
)
from twin.design.report.drawing import draw, views_of
from twin.design.report.tables import (
    Judged,
    agreement_rows,
    agreement_text,
    introduction,
    label_of,
    tiles,
    value_text,
    words_of,
)
from twin.design.verification import Agreement
from uwlts.model.errors import Error
from uwlts.report.page_toolkit import FigureCollector, InteractiveFigure, render_page, svg_of

_BEST = 20
"""Designs in the table of the best."""
_DRAWN = (
    "Lengths in mm, both views at one scale. Left: along the sheet; the camera's view in blue, the sheet in red, thick "
    "where the camera sees it within the measuring volume (tinted). Right: onto the sheet; the laser's fan, the "
    "image's border in blue, and the line's length. Windows and rays are to scale, the housings only hint at where "
    "they are."
)


def page_text(
    study: Study,
    columns: Columns,
    *,
    marked: Sequence[Marked],
    agreements: Sequence[Agreement],
    notes: Sequence[str] = (),
) -> str:
    """The page of a study as HTML.

    Parameters
    ----------
    study
        The study.
    columns
        All judged designs, as `twin.design.screening.read_parts` gives them; empty where there are none.
    marked
        Designs to point out, the chosen one last.
    agreements
        Comparison of formulas and rendering of each rendered design.
    notes
        Sentences for the page's head.

    Raises
    ------
    EvaluationError
        The columns are of another study.
    """
    judged, collected = Judged(study, columns), FigureCollector()
    points = [Point(one.label, one.design.table(), number, one is marked[-1]) for number, one in enumerate(marked)]
    over_free_title, over_free = _over_what_is_free(judged, points)
    chosen = None
    if marked:
        compared = None if len(marked) == 1 else (marked[0].label, marked[0].design.table())
        chosen = tiles(study, marked[-1].sensor, marked[-1].design.table(), compared=compared)
    return render_page(
        "twin.design.report",
        "template.html.j2",
        interactive=collected,
        title=study.title,
        introduction=introduction(judged),
        notes=list(notes),
        label=marked[-1].label if marked else "",
        chosen=chosen,
        drawing=_drawing(study, marked),
        over_free=over_free,
        over_free_title=over_free_title,
        pareto=_interactive(collected, pareto_chart(judged, points)),
        parallel=_interactive(collected, parallel_chart(judged)),
        nothing=_nothing(judged),
        rendered=agreement_rows(agreements),
        verdicts=[(found, agreement_text(study, found), _shown(verification_chart(found))) for found in agreements],
        best=_best(judged),
        failures=[(name, f"{count:,}") for name, count in judged.failure_counts()],
        misses=[(name, f"{count:,}") for name, count in judged.miss_counts()] if len(judged) else [],
        working=int(judged.works.sum()),
        version=uwlts.__version__,
    )


def _interactive(collected: FigureCollector, drawn: Chart[go.Figure] | None) -> InteractiveFigure | None:
    return None if drawn is None else collected.add(drawn.figure, drawn.caption)


def _shown(drawn: Chart[Figure] | None) -> tuple[Markup, str] | None:
    return None if drawn is None else (svg_of(drawn.figure), drawn.caption)


def _drawing(study: Study, marked: Sequence[Marked]) -> tuple[Markup | None, str]:
    """The chosen design's drawing and what it shows, or why there is none."""
    if not marked:
        return None, "There is no design to draw."
    chosen, base = marked[-1], marked[0]
    try:
        views = views_of(chosen.sensor, study.medium_of(chosen.sensor))
    except Error as error:
        return None, f"The design cannot be drawn: {error}."
    other = None
    if base is not chosen:
        with suppress(Error):
            other = views_of(base.sensor, study.medium_of(base.sensor))
    drawing = draw(*views, other)
    behind = f" Dashed grey behind: {base.label}." if drawing.with_other else ""
    return svg_of(drawing.figure), _DRAWN + behind


def _over_what_is_free(judged: Judged, points: Sequence[Point]) -> tuple[str, tuple[Markup, str] | None]:
    """Title of the chart that suits what is free, and the chart; None where no design works."""
    ranges = [name for name, variable in judged.study.variables.items() if variable.values is None]
    works = judged.works.any()
    if len(ranges) >= 2:
        title = f"Figures over {words_of(ranges[0])} and {words_of(ranges[1])}"
        return title, _shown(contours(judged, points, ranges[0], ranges[1]) if works else None)
    if ranges:
        return f"Figures over {words_of(ranges[0])}", _shown(curves(judged, points, ranges[0]) if works else None)
    return "Figures of the choices", _shown(bars(judged) if works else None)


def _nothing(judged: Judged) -> str:
    """Why there are no charts, "" where there are."""
    if not len(judged):
        return "No design has been judged."
    return "" if judged.works.any() else "None of the designs works: see the reasons below."


def _best(judged: Judged) -> tuple[list[str], list[list[str]]]:
    """Head and rows of the table of the best designs."""
    study = judged.study
    figures = [o.figure for o in study.objectives] + list(study.constraints)
    figures += ["sigma_z_rms_mm", "line_mm", "depth_mm", "standoff_mm", "required_ms", "laser_class"]
    names = list(dict.fromkeys([*study.free(), *(name for name in figures if name in judged.columns)]))
    missed = not judged.feasible.any()
    rows = [
        [str(judged.columns["design"][place])]
        + [value_text(name, judged.columns[name][place : place + 1].tolist()[0], unit=False) for name in names]
        + ([f"{judged.figure('violation')[place]:.3g}"] if missed else [])
        for place in (judged.best_first[:_BEST] if len(judged) else [])
    ]
    return ["design", *map(label_of, names), *(["constraints missed by"] if missed else [])], rows
