"""Commands that evaluate measured objects: changes, features and figures of the thesis."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

import uwlts
import uwlts.thesis
from uwlts.cli.command_options import (
    STRIPE,
    ColouredOut,
    Overwrite,
    a_file,
    a_page,
    app,
    write_coloured,
    wrote,
    wrote_files,
    wrote_page,
)
from uwlts.runtime.command_line import Call, command_from, say, show

_INSPECTIONS = [(uwlts, f"inspect_{kind}") for kind in ("pipe", "weld", "flange")]
"""Functions that provide the options of an inspection."""


@command_from(app, uwlts, "evaluate", job="Inspect")
def evaluate(
    call: Call,
    *,
    out: Annotated[Path, a_file(".json"), Parameter(help="Evaluation to write (JSON).")],
    coloured: ColouredOut = None,
    overwrite: Overwrite = False,
) -> None:
    """Example: uwlts evaluate spheres.cloud.h5 --truth spheres.truth.h5 --out spheres.evaluation.json"""
    from uwlts.pages.cloud_figure import colour_limit_mm
    from uwlts.report.file_description import evaluation_lines

    evaluation = call()
    evaluation.save(out, overwrite=overwrite)
    if coloured and evaluation.cloud is not None:
        write_coloured(coloured, evaluation.cloud, colour_limit_mm, overwrite=overwrite)
    doubts = [] if evaluation.evaluation is None else evaluation.evaluation.doubts()
    wrote(evaluation_lines(evaluation), doubts, out)


@command_from(app, uwlts, "compare_clouds", job="Inspect", also=[(uwlts.report, "write_change")])
def compare(
    call: Call,
    *,
    out: Annotated[Path, a_page(), Parameter(help="Page to write, with the figures as JSON beside it.")],
    coloured: Annotated[
        Path | None,
        a_file(".ply", ".laz", ".las"),
        Parameter(
            help="Also write the points in the colours of the map, with distance, level of detection and significance, "
            "to this PLY, LAZ or LAS file."
        ),
    ] = None,
    pdf=False,
    overwrite: Overwrite = False,
) -> None:
    """Example: uwlts compare after.cloud.h5 before.cloud.h5 --out change.html"""
    change = call()
    title = f"{Path(call.given['cloud']).name} against {Path(call.given['reference']).name}"
    uwlts.report.write_change(out, change, title=title, coloured=coloured, pdf=pdf, overwrite=overwrite)
    show(change.lines())
    wrote_page(out)
    if pdf:
        wrote_files(out.with_suffix(".pdf"))


@command_from(
    app,
    uwlts,
    "inspect_pipe",
    job="Inspect",
    also=[*_INSPECTIONS, (uwlts, "export")],
    summary="Find the features of a pipe, weld, step, flange or gap in a cloud and measure them, with uncertainty.",
)
def inspect(
    call: Call,
    kind: Annotated[
        Literal["pipe", "weld", "step", "flange", "gap"], Parameter(help="Kind of the object in the cloud.")
    ] = "pipe",
    *,
    out: Annotated[
        Path | None,
        a_file(".json"),
        Parameter(help="Findings to write (JSON), each value with its definition and its source."),
    ] = None,
    coloured: ColouredOut = None,
    datum=None,
    unit=None,
    overwrite: Overwrite = False,
) -> None:
    """Example: uwlts inspect pipe.cloud.h5 --wall-mm 9.5 --out pipe.json"""
    from uwlts.inspection.inspect import inspect_cloud
    from uwlts.report.plot import surface_limit_mm
    from uwlts.storage.cloud_files import load_cloud

    measured = load_cloud(call.given.pop("cloud"), unit=unit)
    options = call.given if datum is None else call.given | {"datum": load_cloud(datum, unit=unit)}
    found = inspect_cloud(measured, kind, **options)
    show(found.lines())
    if coloured:
        write_coloured(
            coloured, replace(measured, deviation_mm=found.deviation_mm), surface_limit_mm, overwrite=overwrite
        )
    if out:
        found.save(out, overwrite=overwrite)
    if out or coloured:
        wrote_files(coloured, out)


@command_from(app, uwlts.report, "write_findings", job="Inspect", also=_INSPECTIONS)
def findings_report(
    call: Call, *, section_mm=None, wall_mm=None, false_alarm=None, largest_ovality=None, datum=None
) -> None:
    """Example: uwlts findings-report pipe.cloud.h5 --wall-mm 9.5 --calibration water.json --out pipe.html --pdf"""
    from uwlts.pages.toolkit import json_beside

    found = call()
    out = Path(call.given["out"])
    beside = [json_beside(out, "findings"), *([out.with_suffix(".pdf")] if call.given.get("pdf") else [])]
    show(found.lines())
    say(f"wrote {out}, {', '.join(each.name for each in beside)}")


@command_from(app, uwlts.thesis, "evaluate_thesis", job="Inspect")
def thesis(
    call: Call,
    *,
    out: Annotated[Path, a_file(".json"), Parameter(help="Figures to write (JSON).")],
    overwrite: Overwrite = False,
) -> None:
    """Example: uwlts thesis calibration.json --step step.h5 --spheres near.h5 far.h5 --out thesis.json"""
    found = call()
    found.save(out, overwrite=overwrite)
    wrote([f"{row.scan}, {row.figure}: {row.measured_mm:.4f}" for row in found.rows], (), out)


@command_from(app, uwlts.report, "write_domain_gap", job="Inspect", shortcuts=STRIPE)
def domain_gap(call: Call) -> None:
    """Example: uwlts domain-gap runs/clean runs/turbid --real photographs bust/laser.png --out gap.html"""
    found = call()
    show(found.lines())
    wrote_page(Path(call.given["out"]))
