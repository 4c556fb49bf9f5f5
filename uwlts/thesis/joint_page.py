"""The joint comparison's files: a page to read, and its summary."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup

import uwlts
from uwlts.files import written_aside
from uwlts.report.page_toolkit import render_page
from uwlts.report.svg_plot import COLOURS, Curve, Panel, svg
from uwlts.thesis.joint_comparison import DIAMETERS, JOINT, ONE_REFRACTION, SPACING, TWO_REFRACTIONS, joint_summary

_WORDS = {ONE_REFRACTION: "one refraction", TWO_REFRACTIONS: "two refractions", JOINT: "joint"}
_QUANTITIES = {
    "spacing_error_mm": ("sphere spacing", (SPACING,)), "diameter_error_mm": ("sphere diameter", DIAMETERS),
}  # fmt: skip
# Side by side within each campaign.
_BESIDE = {ONE_REFRACTION: -0.2, TWO_REFRACTIONS: 0.0, JOINT: 0.2}


def write_joint_comparison(
    folder: Path, results: Sequence[dict[str, Any]], *, overwrite: bool = False
) -> dict[str, Any]:
    """Write report.html and summary.json into a folder, each whole or not at all; OutputError where that fails."""
    summary = joint_summary(results)
    with (
        written_aside(folder / "report.html", overwrite=overwrite) as page,
        written_aside(folder / "summary.json", overwrite=overwrite) as aside,
    ):
        page.write_text(joint_page(results, summary), encoding="utf-8")
        aside.write_text(json.dumps(summary, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    return summary


def joint_page(results: Sequence[dict[str, Any]], summary: dict[str, Any]) -> str:
    """The page as text, from the results of `compare_campaigns` and their `joint_summary`."""
    media = [medium for medium in ("water", "air") if any(summary[medium]["spacing_error_mm"].values())]
    return render_page(
        "uwlts.thesis", "joint.html.j2",
        software=f"uwlts {uwlts.__version__}", campaigns=summary["campaigns"], solve_s=max(summary["solve_s"]),
        media=[
            {
                "name": medium,
                "rows": _rows(summary[medium]),
                "over_limit": summary[medium]["plane_std_over_speckle_limit"],
                "coverage": summary[medium]["coverage_95"],
                "picture": Markup(svg(_panels(results, medium))),
            }
            for medium in media
        ],
    )  # fmt: skip


def _rows(part: dict[str, Any]) -> list[dict[str, Any]]:
    """Mean and largest error by quantity and way, and how many times the joint one's mean."""
    rows = []
    for name, (quantity, _) in _QUANTITIES.items():
        means = {way: float(np.mean(np.abs(errors))) for way, errors in part[name].items()}
        rows += [
            {
                "quantity": quantity, "way": _WORDS[way], "mean": mean,
                "largest": float(np.max(np.abs(part[name][way]))), "times": mean / means[JOINT],
                "number": len(part[name][way]),
            }
            for way, mean in means.items()
        ]  # fmt: skip
    return rows


def _panels(results: Sequence[dict[str, Any]], medium: str) -> list[Panel]:
    """Errors of all scans by campaign; the joint ones with their stated 95 % intervals."""
    panels = []
    for quantity, figures in _QUANTITIES.values():
        curves = []
        for colour, (way, words) in zip((COLOURS[5], COLOURS[1], COLOURS[0]), _WORDS.items(), strict=True):
            points = [
                (place + _BESIDE[way] + 0.03 * (number - 2.5), scan[way][figure], scan["std"][figure])
                for place, result in enumerate(results)
                for number, scan in enumerate(s for s in result["spheres"] if s["medium"] == medium and way in s)
                for figure in figures
            ]
            if points:
                x, y, std = np.array(points).T
                error = 1960 * std if way == JOINT else None
                name = words if error is None else f"{words}, with the stated 95 % intervals"
                curves.append(Curve(name, x, 1000 * y, colour, error, joined=False))
        panels.append(Panel(f"{quantity} in {medium}", "campaign", "error / µm", curves))
    return panels
