"""Page of a recalibration by passes: what they determined, where they overlap, and how they disagree."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from uwlts.files.json_files import json_text
from uwlts.pages.toolkit import Tile, render_page, write_page
from uwlts.recalibration.recalibrate import ParameterChange, Recalibrated, SurfaceParts
from uwlts.report.change_page import draw_views
from uwlts.report.plot import surface_limit_mm

RECALIBRATION = "recalibration"
"""Kind of the page, in the name of its JSON file."""


def write_recalibration(
    path: str | Path, found: Recalibrated, *, title: str = "Recalibration by passes", overwrite: bool = False
) -> None:
    """Write the page of a recalibration, and its figures, advice and doubts as JSON beside it.

    Parameters
    ----------
    path : str or Path
        Page to write; for pipe.html, the figures go into pipe.recalibration.json.
    found : Recalibrated
        Result of `uwlts.recalibrate`.
    title : str
        Title of the page.
    overwrite : bool
        Replace existing files.

    Raises
    ------
    OutputError
        A file exists and ``overwrite`` is not given, or cannot be written.
    """
    count, most = len(found.passes), surface_limit_mm(found.parts_before.apart_mm)
    text = render_page(
        "uwlts.report",
        "recalibration.html.j2",
        title=title,
        passes=", ".join(found.passes),
        lengths=[
            Tile(f"100 mm along {each.axis}", f"+-{each.after_mm:.3f} mm", f"before: +-{each.before_mm:.3f} mm")
            for each in found.lengths
        ],
        doubts=found.doubts,
        warnings=found.warnings,
        parameters=[_row(each) for each in sorted(found.parameters, key=lambda each: each.std / each.std_before)],
        mount=found.mount.lines() if found.mount else [],
        next_passes=[
            (each.candidate.words, f"{each.before:.3f}", f"{each.after:.3f}")
            for each in found.next_passes[:6]
            if each.after < each.before
        ],
        overlap=_draw(found.parts, found.parts.passes, "passes", most=count, ticks=range(1, count + 1)),
        before=_draw(found.parts_before, found.parts_before.apart_mm, "distance / mm", most=most),
        after=_draw(found.parts, found.parts.apart_mm, "distance / mm", most=most),
        spread=f"{found.spread:.2f}",
    )
    write_page(path, text, beside=json_text(found.record()), kind=RECALIBRATION, overwrite=overwrite)


def _row(change: ParameterChange) -> tuple[str, ...]:
    label = change.key.quantity
    after = label.format_with_std(change.after, change.std) if change.determined else "not determined"
    left = f"{100 * change.std / change.std_before:.0f} %"
    return label.words, label.format_with_std(change.before, change.std_before), after, left


def _draw(
    parts: SurfaceParts, values: np.ndarray, label: str, *, most: float, ticks: Sequence[int] | None = None
) -> str:
    """Draw values (C,) of the parts in three views, with colours up to ``most``."""
    known: dict[str, Any] = {"c": values, "cmap": "viridis", "vmin": 0.0, "vmax": most, "linewidths": 0}

    def draw(axes: Any, first: int, second: int) -> Any:
        return axes.scatter(parts.middle_mm[:, first], parts.middle_mm[:, second], s=14, **known)

    return draw_views(draw, label=label, ticks=ticks)
