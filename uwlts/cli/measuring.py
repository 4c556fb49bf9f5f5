"""Commands that measure: clouds, surfaces and their registration, changes, features, and figures of the thesis."""

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
    a_cloud,
    a_file,
    a_page,
    app,
    cloud_written,
    note_lean,
    write_coloured,
    wrote,
    wrote_files,
    wrote_page,
)
from uwlts.runtime.command_line import Before, Call, command_from, say, show, warn


@command_from(app, uwlts, "reconstruct", job="Reconstruct", shortcuts=STRIPE)
def reconstruct(
    call: Call,
    *,
    out: Annotated[
        Path,
        Before(a_cloud),
        Parameter(
            help="Cloud to write: HDF5 (.h5), with the whole uncertainty if the calibration is a joint one; PLY for "
            "other programs, with the standard deviation along the normal; or another format of uwlts export."
        ),
    ],
    overwrite: Overwrite = False,
) -> None:
    """Example: uwlts reconstruct scan.h5 --calibration calibration.json --out scan.cloud.h5"""
    from uwlts.recalibration.pass_check import check_passes
    from uwlts.storage.capture import Capture
    from uwlts.storage.cloud import VERIFIED
    from uwlts.storage.cloud_files import write_cloud_in_parts

    with Capture(call.given["capture"]) as capture, write_cloud_in_parts(out, overwrite=overwrite) as write:
        seen, lit = set[int](), int(capture.laser_on.sum())
        cloud = call(capture=capture, take=lambda part: (seen.update(part.frame.tolist()), write(part)))
    warn(*cloud.warnings)
    if check := check_passes(cloud):
        (say if check.agree else warn)(check.text)
    if until := cloud.metadata.get(VERIFIED):
        say(f"calibration verified until {until}")
    say(f"laser images with a point: {len(seen)} of {lit}")
    say(f"profile lines: {_format_counts(cloud.lines_by_status)}")
    if lost := _format_counts({name: count for name, count in cloud.rays_by_status.items() if name != "ok"}):
        say(f"stripe centres without a point: {lost}")
    say(cloud_written(out, cloud.rays_by_status["ok"]))
    note_lean(out, cloud)


def _format_counts(by_status: dict[str, int]) -> str:
    return ", ".join(f"{count} {name.replace('_', ' ')}" for name, count in by_status.items() if count)


@command_from(app, uwlts, "register", job="Reconstruct")
def register(
    call: Call,
    *,
    out: Annotated[
        Path,
        Before(a_cloud),
        Parameter(help="Merged cloud to write, in the format of its ending, as for uwlts export."),
    ],
    page: Annotated[
        Path | None,
        a_page("registration"),
        Parameter(
            help="Page to write, with all figures, poses and their covariance as JSON beside it: for pipe.html, "
            "pipe.registration.json."
        ),
    ] = None,
    poses_out: Annotated[
        Path | None, a_file(".csv"), Parameter(help="Poses of the scans to write (CSV, matrix, mm).")
    ] = None,
    overwrite: Overwrite = False,
) -> None:
    """Example: uwlts register top.cloud.h5 left.cloud.h5 right.cloud.h5 --out pipe.cloud.h5 --page pipe.html"""
    found = call()
    show(found.lines())
    found.cloud.save(out, overwrite=overwrite)
    if poses_out:
        found.save_poses(poses_out, overwrite=overwrite)
    if page:
        uwlts.report.write_registration(page, found, overwrite=overwrite)
    wrote_files(out, poses_out, page)
    note_lean(out, found.cloud)


@command_from(app, uwlts, "align_trajectory", job="Reconstruct")
def align(
    call: Call,
    *,
    out: Annotated[
        Path,
        a_file(".csv", beside=".json"),
        Parameter(
            help="Corrected trajectory to write, with the covariance of each pose (CSV), and the crossings as JSON "
            "beside it."
        ),
    ],
    aligned: Annotated[
        Path | None, Before(a_cloud), Parameter(help="Also write the cloud along the corrected trajectory.")
    ] = None,
    overwrite: Overwrite = False,
) -> None:
    """Example: uwlts align pass.cloud.h5 --trajectory pass.csv --drift-mm 300 --drift-deg 1 --out path.csv"""
    found = call()
    show(found.lines())
    found.save(out, overwrite=overwrite)
    if aligned:
        found.cloud.save(aligned, overwrite=overwrite)
    say(f"wrote {out} and {out.with_suffix('.json').name}" + (f", {aligned}" if aligned else ""))
    if aligned:
        note_lean(aligned, found.cloud)


@command_from(app, uwlts, "fit_radiometry", job="Scan")
def radiometry(
    call: Call,
    *,
    out: Annotated[
        Path,
        a_file(".toml", beside=".json"),
        Parameter(help="Description of the sensor to write (TOML), with all estimates as JSON beside it."),
    ],
    overwrite: Overwrite = False,
) -> None:
    """Example: uwlts radiometry wall.h5 --calibration calibration.json --out followed.toml"""
    found = call()
    found.save(out, overwrite=overwrite)
    show(found.lines())
    say(f"wrote {out} and {out.with_suffix('.json').name}")


_INSPECTIONS = [(uwlts, f"inspect_{kind}") for kind in ("pipe", "weld")]
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
    summary="Find the features of a pipe or weld in a cloud and measure them, with uncertainty.",
)
def inspect(
    call: Call,
    kind: Annotated[Literal["pipe", "weld"], Parameter(help="Kind of the object in the cloud.")] = "pipe",
    *,
    out: Annotated[
        Path | None,
        a_file(".json"),
        Parameter(help="Findings to write (JSON), each value with its definition and its source."),
    ] = None,
    coloured: ColouredOut = None,
    unit=None,
    overwrite: Overwrite = False,
) -> None:
    """Example: uwlts inspect pipe.cloud.h5 --wall-mm 9.5 --out pipe.json"""
    from uwlts.report.findings_page import inspect_cloud
    from uwlts.report.plot import surface_limit_mm
    from uwlts.storage.cloud_files import load_cloud

    measured = load_cloud(call.given.pop("cloud"), unit=unit)
    found = inspect_cloud(measured, kind, **call.given)
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
def findings_report(call: Call, *, wall_mm=None, false_alarm=None, largest_ovality=None) -> None:
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
    show(call().lines())
    wrote_page(Path(call.given["out"]))
