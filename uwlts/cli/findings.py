"""Commands that judge measured objects: what changed, features, the gauge, and reports."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import uwlts
from uwlts.cli.options import JSON, Files, Flag, Overwrite, Workers, app, refuse_unsuitable_cloud, show
from uwlts.files.writing import refuse_unsuitable
from uwlts.runtime.console import progress_bar

if TYPE_CHECKING:
    import numpy as np

    from uwlts.storage.cloud import PointCloud


@app.command
def evaluate(
    cloud: Path,
    *,
    out: Path,
    artefact: Path | None = None,
    truth: Path | None = None,
    coloured: Path | None = None,
    overwrite: Overwrite = False,
) -> None:
    """Compare a cloud with its artefact's calibrated values, and point by point with a truth file.

    Example: uwlts evaluate spheres.ply --truth spheres.truth.h5 --out spheres.evaluation.json

    Args:
        cloud: Point cloud (.ply or .h5).
        out: Evaluation to write (JSON).
        artefact: TOML file with the artefact's kind and calibrated values, in place of those in the capture.
        truth: Ground truth of the capture, if it was rendered.
        coloured: Also write the cloud coloured by the deviation of every point, with these in mm, to this PLY, LAZ,
            LAS, E57 or HDF5 file.
    """
    from uwlts.report.inventory import evaluation_lines
    from uwlts.report.plot import colour_limit_mm

    refuse_unsuitable(out, overwrite=overwrite, endings=JSON)
    if coloured:
        refuse_unsuitable_cloud(coloured, overwrite=overwrite, coloured=True)
    evaluation = uwlts.evaluate(cloud, artefact, truth)
    uwlts.write_evaluation(out, evaluation, overwrite=overwrite)
    if coloured:
        _write_coloured(coloured, evaluation.cloud, colour_limit_mm, overwrite=overwrite)
    show(evaluation_lines(evaluation.record()))
    print(f"wrote {out}")


def _write_coloured(
    path: Path, cloud: "PointCloud", limit_mm: "Callable[[np.ndarray], float]", *, overwrite: bool
) -> None:
    """Write a cloud with its deviations in the colours of the pages, which end at a limit."""
    import numpy as np

    from uwlts.report.plot import deviation_colours

    deviation = np.full(len(cloud), np.nan) if cloud.deviation_mm is None else cloud.deviation_mm
    limit = limit_mm(deviation) if np.isfinite(deviation).any() else 1.0
    uwlts.write_cloud(path, cloud, overwrite=overwrite, colours=deviation_colours(deviation, limit))


@app.command
def compare(
    cloud: Path,
    reference: str,
    *,
    out: Path,
    coloured: Path | None = None,
    register: Flag = False,
    datums: Path | None = None,
    disc_mm: float | None = None,
    deep_mm: float | None = None,
    same_water: Flag = False,
    unit: Literal["mm", "m"] = "mm",
    overwrite: Overwrite = False,
) -> None:
    """Find where a surface differs from an earlier cloud, a mesh or an ideal shape by more than the uncertainty.

    Example: uwlts compare after.ply before.ply --out change.html

    Args:
        cloud: Cloud of the surface (.ply, .h5, .copc.laz; of other programs .las, .e57, and text in mm).
        reference: Earlier cloud; a mesh (.stl, .obj, .off, or .ply with faces); or an ideal shape: plane, sphere or
            cylinder to fit one, or a TOML file with its kind and what is known of it (docs/how-to/compare-scans.md).
        out: Page to write, with the figures as JSON beside it.
        coloured: Also write the places in the colours of the map, with distance, level of detection and significance,
            to this PLY, LAZ or LAS file.
        register: Move the cloud onto the reference first; else both have one frame.
        datums: TOML file with spheres that hold what has not changed; only points in them count for the registration.
        disc_mm: Diameter over which points are averaged; about 30 points unless given.
        deep_mm: Largest distance that is looked for; three diameters unless given.
        same_water: Both clouds were scanned in water of the same temperature and salinity.
        unit: Unit of the reference.
    """
    from uwlts.pages.toolkit import refuse_unsuitable_page
    from uwlts.report.change_page import PLACES_FORMATS

    refuse_unsuitable_page(out, overwrite=overwrite)
    if coloured:
        refuse_unsuitable(coloured, overwrite=overwrite, endings=PLACES_FORMATS)
    change = uwlts.compare_clouds(
        cloud,
        reference,
        register=register,
        datums=datums,
        disc_mm=disc_mm,
        deep_mm=deep_mm,
        same_water=same_water,
        unit=unit,
    )
    show(change.lines())
    title = f"{cloud.name} against {Path(reference).name}"
    uwlts.write_change(out, change, title=title, coloured=coloured, overwrite=overwrite)
    print(f"wrote {out} and {out.with_suffix('.json').name}")


@app.command
def inspect(
    cloud: Path,
    kind: Literal["pipe", "weld", "step", "flange", "gap"] = "pipe",
    *,
    out: Path | None = None,
    coloured: Path | None = None,
    section_mm: float | None = None,
    wall_mm: float | None = None,
    false_alarm: float = 0.05,
    largest_ovality: float = 0.02,
    datum: Path | None = None,
    overwrite: Overwrite = False,
) -> None:
    """Find the features of a pipe, weld, step, flange or gap in a cloud and measure them, with uncertainty.

    Example: uwlts inspect pipe.ply --wall-mm 9.5 --out pipe.json

    Args:
        cloud: Cloud of the object (.ply, .h5, .copc.laz; of other programs .las, .e57, and text in mm).
        kind: What the cloud shows.
        out: Findings to write (JSON), each value with its definition and its source.
        coloured: Also write the cloud coloured by each point's distance from the undamaged surface, with these in
            mm, to this PLY, LAZ, LAS, E57 or HDF5 file.
        section_mm: Length of a section along a pipe (up to twelve unless given) or a weld.
        wall_mm: Thickness of a pipe's undamaged wall, for the wall that remains.
        false_alarm: Probability that anything is found on the whole of a pipe's surface where nothing is.
        largest_ovality: Ovality over the diameter that a pipe may have where less than half of it was seen.
        datum: Cloud of another face in the same frame, to which a flange's face is to be parallel.
    """
    from uwlts.files.json_files import write_record
    from uwlts.report.plot import surface_limit_mm

    if out:
        refuse_unsuitable(out, overwrite=overwrite, endings=JSON)
    if coloured:
        refuse_unsuitable_cloud(coloured, overwrite=overwrite, coloured=True)
    measured = uwlts.read_cloud(cloud)
    found = uwlts.inspect(
        measured,
        kind,
        section_mm=section_mm,
        wall_mm=wall_mm,
        false_alarm=false_alarm,
        largest_ovality=largest_ovality,
        datum=datum,
    )
    show(found.lines())
    if coloured:
        shown = replace(measured, deviation_mm=found.deviation_mm)
        _write_coloured(coloured, shown, surface_limit_mm, overwrite=overwrite)
        print(f"wrote {coloured}")
    if out:
        write_record(out, found.record(), overwrite=overwrite)
        print(f"wrote {out}")


@app.command
def gauge(
    table: Path,
    *,
    out: Path | None = None,
    tolerance: float | None = None,
    reference: float | None = None,
    overwrite: Overwrite = False,
) -> None:
    """Judge the gauge by repeated measurements of a figure: repeatability, reproducibility, share of a tolerance.

    Example: uwlts gauge diameters.csv --tolerance 0.2 --out gauge.json

    Args:
        table: CSV file with the columns part, operator and value, one measurement a line.
        out: Study to write (JSON).
        tolerance: Width of the tolerance.
        reference: True value of the only part: a type-1 study with Cg and Cgk.
    """
    from uwlts.files.json_files import write_record

    if out:
        refuse_unsuitable(out, overwrite=overwrite, endings=JSON)
    study = uwlts.gauge_study(table, tolerance=tolerance, reference=reference)
    show(study.lines())
    if out:
        write_record(out, study.record(), overwrite=overwrite)
        print(f"wrote {out}")


@app.command
def findings_report(
    cloud: Path,
    kind: Literal["pipe", "weld", "step", "flange", "gap"] = "pipe",
    *,
    out: Path,
    pdf: Flag = False,
    title: str | None = None,
    captures: Files = (),
    calibration: Path | None = None,
    certificate: Path | None = None,
    verification: Files = (),
    section_mm: float | None = None,
    wall_mm: float | None = None,
    false_alarm: float = 0.05,
    largest_ovality: float = 0.02,
    datum: Path | None = None,
    overwrite: Overwrite = False,
) -> None:
    """Inspect a cloud and write the report for the object's owner: a page, the same as JSON, and as PDF.

    Example: uwlts findings-report pipe.ply --wall-mm 9.5 --calibration water.json --out pipe.html --pdf

    Args:
        cloud: Cloud of the object.
        kind: What the cloud shows.
        out: Page to write, with the findings as JSON beside it: of pipe.html, pipe.findings.json.
        pdf: Also print the page to a PDF beside it, with the Chromium or Chrome that is installed.
        title: Title of the report.
        captures: Captures that the cloud was reconstructed from, for the traceability.
        calibration: Calibration of the sensor, the one that the cloud names.
        certificate: Its certificate (JSON), whose seal is checked.
        verification: Evaluations (JSON of uwlts evaluate) of artefacts measured by the same calibration.
        section_mm: Length of a section along a pipe (up to twelve unless given) or a weld.
        wall_mm: Thickness of a pipe's undamaged wall, for the wall that remains.
        false_alarm: Probability that anything is found on the whole of a pipe's surface where nothing is.
        largest_ovality: Ovality over the diameter that a pipe may have where less than half of it was seen.
        datum: Cloud of another face in the same frame, to which a flange's face is to be parallel.
    """
    from uwlts.pages.toolkit import json_beside
    from uwlts.report.findings_page import FINDINGS

    found = uwlts.write_findings(
        cloud,
        kind,
        out=out,
        pdf=pdf,
        title=title,
        captures=captures,
        calibration=calibration,
        certificate=certificate,
        verification=verification,
        section_mm=section_mm,
        wall_mm=wall_mm,
        false_alarm=false_alarm,
        largest_ovality=largest_ovality,
        datum=datum,
        overwrite=overwrite,
    )
    show(found.lines())
    beside = [json_beside(out, FINDINGS), *([out.with_suffix(".pdf")] if pdf else [])]
    print(f"wrote {out}, {', '.join(each.name for each in beside)}")


@app.command
def report(
    folder: Path,
    *,
    reference: str | None = None,
    out: Path | None = None,
    pictures: Path | None = None,
    workers: int = 1,
    overwrite: Flag = False,
) -> None:
    """Gather a campaign's files into one page with pictures, a summary and a table on the terminal.

    The folder holds captures NAME.h5, coloured clouds NAME.ply (or .h5), evaluations NAME.evaluation.json and
    calibrations.

    Example: uwlts report runs/demo --reference thesis

    Args:
        folder: Folder of the campaign.
        reference: Published values to set beside the measured ones: name (thesis) or path of a TOML file.
        out: Page to write; FOLDER/report.html unless given. The summary goes beside it, to summary.json.
        pictures: Also write every measurement's stripe and cloud as PNG files into this folder.
        workers: Number of processes that draw.
        overwrite: Replace an existing report, summary and pictures.
    """
    from uwlts.report.campaign_tables import print_table

    written = uwlts.write_report(
        folder, reference=reference, out=out, pictures=pictures, workers=workers, overwrite=overwrite
    )
    print_table(written.rows())
    print(f"wrote {written.page} and {written.summary}")


@app.command
def thesis(
    folder: Path,
    *,
    published: str = "thesis-tables",
    trials: int = 100,
    workers: Workers = None,
    joint: Flag = False,
    again: Flag = False,
    overwrite: Flag = False,
) -> None:
    """Evaluate campaigns as the thesis does, by all its methods, and set its tables beside the results.

    The folder holds campaign-0, campaign-1, ..., each with the recordings of the whole evaluation; `twin reproduce`
    renders such. Writes report.html, summary.json, tables.csv and summary.md into it.

    Example: uwlts thesis runs/thesis

    Args:
        folder: Folder of the campaigns.
        published: Published tables: name or path of a TOML file.
        trials: Trials of the Monte-Carlo propagation, at least 20, or 0 for none.
        joint: Compare the joint calibration with the thesis's two ways instead, several campaigns at a time and without
            Monte Carlo; writes report.html and summary.json.
        again: Evaluate campaigns anew that have results already.
        overwrite: Replace an existing report.
    """
    with progress_bar(f"evaluating {folder.name}") as progress:
        written = uwlts.evaluate_thesis(
            folder,
            published=published,
            trials=trials,
            workers=workers,
            joint=joint,
            again=again,
            overwrite=overwrite,
            progress=progress,
        )
    print(written.headline.rstrip())
    page, *others = written.files
    print(f"wrote {page}, {', '.join(file.name for file in others)}")
