"""Page of a study: the question and the design to build, as one HTML file without network resources."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress

from markupsafe import Markup

from twin.design.choice import StudyResults
from twin.design.designs import Columns, HighlightedDesign
from twin.design.report import charts, drawing, study_tables as tables
from twin.design.study import Study
from twin.design.verification import Agreement
from uwlts.errors import Error
from uwlts.pages.toolkit import FigureCollector, figure_svg, render_page

_BEST = 20
"""Designs in the table of the best."""
_DRAWN = (
    "Along the sheet, lengths in mm; near, far and stand-off are measured from the window. The camera's view is blue, "
    "the sheet red (thick: in the camera's view and in the tinted measuring volume). Windows and rays are to scale; "
    "the housings are only indicated."
)


def page_text(
    study: Study,
    columns: Columns,
    *,
    marked: Sequence[HighlightedDesign],
    agreements: Sequence[Agreement],
    notes: Sequence[str] = (),
) -> str:
    """Return the page of a study as HTML.

    Highlighted designs (``marked``) end with the chosen one; each rendered design has an agreement. Notes are sentences
    for the top of the page.

    Raises EvaluationError if the columns belong to another study.
    """
    judged, collected = StudyResults(study, columns), FigureCollector()
    nothing = "" if judged.works.any() else "None of the designs works: see the reasons below."
    over_free = charts.figures_chart(judged, marked)
    pareto = charts.pareto_chart(judged, marked)
    return render_page(
        "twin.design.report",
        "template.html.j2",
        interactive=collected,
        title=study.title,
        introduction=tables.introduction(judged),
        notes=list(notes),
        label=marked[-1].label if marked else "",
        chosen=tables.tiles(study, marked[-1], marked[0] if len(marked) > 1 else None) if marked else None,
        drawing=_drawing(study, marked),
        over_free=over_free and collected.add(*over_free),
        pareto=pareto and collected.add(*pareto),
        nothing=nothing if len(judged) else "No design has been evaluated.",
        number=tables.number_text,
        value=tables.value_text,
        verdicts=[
            (found, tables.agreement_text(study, found), drawn and (figure_svg(drawn[0]), drawn[1]))
            for found in agreements
            for drawn in [charts.verification_chart(found)]
        ],
        best=_best(judged),
        failures=tables.failure_counts(judged),
        misses=tables.miss_counts(judged),
        working=int(judged.works.sum()),
    )


def _drawing(study: Study, marked: Sequence[HighlightedDesign]) -> tuple[Markup | None, str]:
    """Return the drawing of the chosen design and its caption, or None and the reason."""
    if not marked:
        return None, "There is no design to draw."
    chosen, base = marked[-1], marked[0]
    try:
        view = drawing.make_view(chosen.sensor, study.medium_of(chosen.sensor))
    except Error as error:
        return None, f"The design cannot be drawn: {error}."
    other = None
    if base is not chosen:
        with suppress(Error):
            other = drawing.make_view(base.sensor, study.medium_of(base.sensor))
    behind = f" Dashed grey behind, as far as it fits in: {base.label}." if other else ""
    return figure_svg(drawing.draw(view, other)), _DRAWN + behind


def _best(judged: StudyResults) -> tuple[list[str], list[list[str]]]:
    """Return the head and rows of the table of the best designs."""
    study = judged.study
    more = ("sigma_z_rms_mm", "line_mm", "depth_mm", "standoff_mm", "required_ms", "laser_class", "scattering_depth")
    figures = dict.fromkeys([*study.figures(), *more])
    names = list(dict.fromkeys([*study.free(), *(name for name in figures if name in judged.columns)]))
    missed = not judged.feasible.any()
    rows = [
        [str(judged.columns["design"][place])]
        + [tables.format_design_value(judged, name, place, unit=False) for name in names]
        + ([f"{judged.figure('violation')[place]:.3g}"] if missed else [])
        for place in (judged.best_first[:_BEST] if len(judged) else [])
    ]
    return ["design", *map(tables.label_of, names), *(["constraints missed by"] if missed else [])], rows
