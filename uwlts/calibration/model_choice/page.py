"""The comparison as a page to read, and its JSON."""

import json
from pathlib import Path
from typing import Any

from markupsafe import Markup

from uwlts.calibration.model_choice.held_out import INSIDE, OUTSIDE
from uwlts.errors import OutputError
from uwlts.files import refuse_unsuitable, written_aside
from uwlts.report.page_toolkit import render_page
from uwlts.report.svg_plot import COLOURS, Curve, Panel, svg


def refuse_unsuitable_outputs(page: Path, *, overwrite: bool) -> None:
    """OutputError where page or JSON cannot be written."""
    if page.suffix == ".json":
        raise OutputError(
            f"{page} is the page, which is HTML, and its JSON goes beside it; give a name like models.html"
        )
    for path in (page, page.with_suffix(".json")):
        refuse_unsuitable(path, overwrite=overwrite)


def write_models(page: Path, content: dict[str, Any], *, overwrite: bool = False) -> None:
    """Write the page, and the JSON beside it, each whole or not at all; OutputError where that fails."""
    with (
        written_aside(page.with_suffix(".json"), overwrite=overwrite) as beside,
        written_aside(page, overwrite=overwrite) as aside,
    ):
        beside.write_text(json.dumps(content, indent=2, ensure_ascii=False, allow_nan=False) + "\n", encoding="utf-8")
        aside.write_text(models_page(content), encoding="utf-8")


def models_page(content: dict[str, Any]) -> str:
    """The page as text."""
    return render_page(
        "uwlts.calibration.model_choice", "template.html.j2", c=content, ways=(INSIDE, OUTSIDE),
        picture=_picture(content),
    )  # fmt: skip


def _picture(content: dict[str, Any]) -> Markup | None:
    """What each model adds, by its number in the table; None where no model adds anything."""
    panels, numbers = [], range(1, len(content["models"]) + 1)
    name, colour = "adds to the misses of the best, with standard error", COLOURS[0]
    for where in (INSIDE, OUTSIDE):
        shown = [
            (number, 1e3 * row[where]["adds_mm"], 1e3 * row[where]["adds_std_mm"])
            for number, row in zip(numbers, content["models"], strict=True)
            if where in row and row[where]["adds_mm"] is not None
        ]
        if shown:
            x, y, error = zip(*shown, strict=True)
            # Both pictures number all models, those too that add nothing.
            frame = Curve(name, [numbers[0], numbers[-1]], [min(y)] * 2, colour, marked=False, joined=False)
            curve = Curve(name, x, y, colour, error, joined=False)
            panels.append(
                Panel(f"{where} the calibrated volume", "model", "adds / µm", [frame, curve], log_y=True,
                      x_ticks=list(numbers))
            )  # fmt: skip
    return Markup(svg(panels)) if panels else None
