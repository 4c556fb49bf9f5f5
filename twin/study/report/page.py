"""The page of a study: what was asked, and which design to build; one HTML file that asks nothing of the network."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Environment
from markupsafe import Markup
from plotly.offline import get_plotlyjs

import uwlts
from twin.study.description import Study
from twin.study.designs import Marked
from twin.study.report.charts import (
    Drawn,
    Point,
    bars,
    contours,
    curves,
    parallel_chart,
    pareto_chart,
    verification_chart,
)
from twin.study.report.drawing import Drawing, draw, views_of
from twin.study.report.tables import (
    Judged,
    Tile,
    agreement,
    introduction,
    label_of,
    tiles,
    value_text,
    verification_rows,
    words_of,
)
from uwlts.errors import UwltsError
from uwlts.files import written_aside

_BEST = 20
_DRAWN = (
    "Lengths in mm, both views at one scale. Left: along the sheet; the camera's view in blue, the sheet in red, thick "
    "where the camera sees it within the measuring volume (tinted). Right: onto the sheet; the laser's fan, the "
    "image's border in blue, and the line's length. Windows and rays are to scale, the housings only hint at where "
    "they are."
)


def write_page(
    path: Path,
    study: Study,
    columns: Mapping[str, np.ndarray],
    *,
    marked: Sequence[Marked],
    verified: Sequence[Mapping[str, Any]],
    notes: Sequence[str] = (),
) -> None:
    """Write the page of a study, whole or not at all, replacing an older one.

    Parameters
    ----------
    path
        The file.
    study
        The study.
    columns
        All judged designs, as `twin.study.results.read_parts` gives them; empty where there are none.
    marked
        Designs to point out, the chosen one last.
    verified
        Rows of what was rendered, as `twin.study.agreement.verified` gives them.
    notes
        Sentences for the page's head.

    Raises
    ------
    EvaluationError
        The columns are of another study.
    OutputError
        The file cannot be written.
    """
    text = page_text(study, columns, marked=marked, verified=verified, notes=notes)
    with written_aside(path, overwrite=True) as aside:
        aside.write_text(text, encoding="utf-8", errors="replace")


def page_text(
    study: Study,
    columns: Mapping[str, np.ndarray],
    *,
    marked: Sequence[Marked],
    verified: Sequence[Mapping[str, Any]],
    notes: Sequence[str] = (),
) -> str:
    """The page as text; arguments and errors as `write_page`."""
    judged, collected = Judged(study, columns), _Figures()
    points = [Point(one.label, one.row, number, one is marked[-1]) for number, one in enumerate(marked)]
    environment = Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True)
    template = environment.from_string(
        files("twin.study.report").joinpath("template.html.j2").read_text(encoding="utf-8")
    )
    return template.render(
        title=study.title,
        introduction=introduction(judged),
        notes=list(notes),
        chosen=_chosen(study, marked),
        drawing=_drawing(study, marked),
        over_free=collected.add(_over_what_is_free(judged, points)),
        over_free_title=_over_free_title(study),
        pareto=collected.add(pareto_chart(judged, points)),
        parallel=collected.add(parallel_chart(judged)),
        nothing=_nothing(judged),
        verified=verification_rows(verified),
        verdicts=[(row, agreement(study, row), collected.add(verification_chart(row))) for row in verified],
        best=_best(judged),
        failures=judged.failure_counts(),
        misses=judged.miss_counts() if len(judged) else [],
        working=int(judged.works.sum()),
        version=uwlts.__version__,
        figures=collected.scripts,
        plotly=Markup(get_plotlyjs().replace("</script", "<\\/script")),
    )


@dataclass(frozen=True)
class _Shown:
    """A figure's place in the page."""

    number: int
    caption: str
    height: int


class _Figures:
    """Hands out numbers to figures and keeps their JSON for the end of the page."""

    def __init__(self) -> None:
        self.scripts: list[Markup] = []

    def add(self, drawn: Drawn | None) -> _Shown | None:
        if drawn is None:
            return None
        # Within a script element nothing is escaped, and nothing may look like its end.
        self.scripts.append(Markup(drawn.figure.to_json(validate=False).replace("<", "\\u003c")))
        return _Shown(len(self.scripts) - 1, drawn.caption, int(drawn.figure.layout.height))


@dataclass(frozen=True)
class _Chosen:
    """The chosen design's head: what it is called, and its tiles."""

    label: str
    tiles: list[Tile]


def _chosen(study: Study, marked: Sequence[Marked]) -> _Chosen | None:
    if not marked:
        return None
    chosen, base = marked[-1], marked[0]
    compared = None if base is chosen else (base.label, base.row)
    return _Chosen(chosen.label, tiles(study, chosen.sensor, chosen.row, compared=compared))


def _drawing(study: Study, marked: Sequence[Marked]) -> tuple[Drawing | None, str]:
    """The chosen design's drawing and what it shows, or why there is none."""
    if not marked:
        return None, "There is no design to draw."
    chosen, base = marked[-1], marked[0]
    try:
        views = views_of(chosen.sensor, study.medium_of(chosen.sensor))
    except UwltsError as error:
        return None, f"The design cannot be drawn: {error}."
    other = None
    if base is not chosen:
        try:
            other = views_of(base.sensor, study.medium_of(base.sensor))
        except UwltsError:
            other = None
    drawing = draw(*views, other)
    behind = f" Dashed grey behind: {base.label}." if drawing.with_other else ""
    return drawing, _DRAWN + behind


def _over_what_is_free(judged: Judged, points: Sequence[Point]) -> Drawn | None:
    """The chart that suits what is free; None where no design works."""
    if not judged.works.any():
        return None
    ranges = _ranges(judged.study)
    if len(ranges) >= 2:
        return contours(judged, points, ranges[0], ranges[1])
    return curves(judged, points, ranges[0]) if ranges else bars(judged)


def _ranges(study: Study) -> list[str]:
    return [name for name, variable in study.variables.items() if variable.values is None]


def _over_free_title(study: Study) -> str:
    ranges = _ranges(study)
    if len(ranges) >= 2:
        return f"Figures over {words_of(ranges[0])} and {words_of(ranges[1])}"
    return f"Figures over {words_of(ranges[0])}" if ranges else "Figures of the choices"


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
        + [value_text(name, judged.columns[name][place], unit=False) for name in names]
        + ([f"{judged.figure('violation')[place]:.3g}"] if missed else [])
        for place in (judged.best_first[:_BEST] if len(judged) else [])
    ]
    return ["design", *map(label_of, names), *(["constraints missed by"] if missed else [])], rows
