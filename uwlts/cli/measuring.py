"""Commands that record and measure, from scans to evaluated point clouds, and commands about sensors and files."""

import sys
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

import uwlts
from uwlts.cli.options import (
    CalibrationOut,
    Files,
    Flag,
    Index,
    Method,
    Overwrite,
    Stripe,
    Workers,
    app,
    say,
    show,
    stripe_settings,
    warn,
)
from uwlts.model.errors import OutputError
from uwlts.runtime.console import progress_bar
from uwlts.storage.files import refuse_unsuitable, written_aside

Direction = tuple[float, float, float]
Box = tuple[Direction, Direction]


@app.command
def scan(
    plan: Path,
    *,
    out: Path,
    camera: str | None = None,
    stage: str | None = None,
    home: Flag = False,
    unlock: Flag = False,
    watch: Flag = False,
    calibration: Path | None = None,
    port: int = 8080,
    resume: Flag = False,
    overwrite: Flag = False,
) -> None:
    """Record a scan with a camera and a stage into a capture.

    Moves, lets the stage settle, switches the laser, takes an image and stores it with the position read back. The plan
    is checked against travel and volume before anything moves; the laser goes off however the scan ends.

    Example: uwlts scan plan.toml --camera gige:192.168.1.10 --stage /dev/ttyACM0 --home --out scan.h5

    Args:
        plan: TOML file with sensor, medium, positions, lights and exposures (docs/how-to/scan.md).
        out: Capture to write.
        camera: Address of the camera, in place of the plan's: gige:NAME, genicam:PRODUCER.cti, replay:PATH.
        stage: Serial port of the stage, in place of the plan's.
        home: Find the limit switch first.
        unlock: Take the stage's position as it is, without homing.
        watch: Show the recording in a browser meanwhile, as uwlts watch does.
        calibration: Watched: calibration of the sensor, or one by polynomials, for the cloud.
        port: Watched: port of the page; the next free one is taken if it is in use.
        resume: Continue an interrupted scan; refused where the plan is another than the one it began with.
        overwrite: Replace an existing capture.
    """
    with progress_bar(f"scanning {plan.stem}") as progress:
        seen = uwlts.scan(
            plan,
            out,
            camera=camera,
            stage=stage,
            home=home,
            unlock=unlock,
            watch=watch,
            calibration=calibration,
            port=port,
            resume=resume,
            overwrite=overwrite,
            progress=progress,
            report=say,
            warn=warn,
        )
    warn(*seen.warnings())
    exposures = ", ".join(f"{light} {value:.3g} ms" for light, value in seen.exposure_ms.items())
    print(f"wrote {out}, {seen.found} of {seen.lines} profile lines with a stripe; exposure {exposures or 'as before'}")


@app.command
def watch(capture: Path, *, calibration: Path | None = None, host: str = "127.0.0.1", port: int = 8080) -> None:
    """Show a recording while it grows, in a browser: the latest image with its stripe, and the cloud so far.

    Example: uwlts watch scan.h5 --calibration calibration.json

    Args:
        capture: Capture that is being recorded, or is to be.
        calibration: Calibration of the sensor, or one by polynomials, for the cloud.
        host: Address at which the page is served; the default can be reached from this machine only.
        port: Port of the page; the next free one is taken if it is in use.
    """
    uwlts.watch(capture, calibration=calibration, host=host, port=port, report=say)


@app.command
def desk(folder: Path = Path(), *, plan: Path | None = None, host: str = "127.0.0.1", port: int = 8080) -> None:
    """Serve the operator's page: connect, look, move, calibrate, scan, reconstruct and measure in a browser.

    The address with the token is the operator's; at the other one everybody who reaches it may look. Results are
    written to the folder. The page works without internet.

    Example: uwlts desk tank --plan plan.toml

    Args:
        folder: Folder with plans, calibrations, captures and clouds; the present one unless given.
        plan: Plan of a scan (docs/how-to/scan.md) to begin with; others can be chosen on the page.
        host: Address at which the page is served; the default can be reached from this machine only.
        port: Port of the page; the next free one is taken if it is in use.
    """
    uwlts.serve_desk(folder, plan=plan, host=host, port=port, report=say)


@app.command
def doctor(*, folder: Path = Path(), camera: str | None = None, stage: str | None = None) -> None:
    """Examine libraries, libLLVM, cameras, serial ports, permissions and speed of this machine, with advice.

    Ends with exit code 1 if something required, or something named here, is missing or does not work.

    Example: uwlts doctor --camera gige: --stage /dev/ttyACM0

    Args:
        folder: Where captures are to be written; 64 MB are, and removed.
        camera: Address of a camera to take ten frames with: gige:NAME, genicam:PRODUCER.cti or replay:PATH.
        stage: Serial port of a stage to ask for its version, settings and state. It is not moved and the laser stays
            off, but an Arduino Uno restarts: home before the next scan.
    """
    from uwlts.doctor import print_findings

    with progress_bar("examining") as progress:
        findings = uwlts.examine(folder, camera=camera, stage=stage, progress=progress)
    print_findings(findings)
    if any(each.status == "missing" for each in findings):
        sys.exit(1)


@app.command
def reconstruct(
    capture: Path,
    *,
    calibration: Path,
    out: Path,
    mount: Path | None = None,
    trajectory: Path | None = None,
    pose_format: str = "matrix",
    pose_unit: Literal["mm", "m"] = "mm",
    clock_offset_s: float | None = None,
    pose_correlation_s: float | None = None,
    index: Index = None,
    method: Method = None,
    stripe: Stripe = (),
    peak: Literal["direct", "strongest", "first", "last"] | None = None,
    overwrite: Overwrite = False,
) -> None:
    """Turn a capture into a point cloud.

    Example: uwlts reconstruct scan.h5 --calibration calibration.json --out scan.ply

    Args:
        capture: Capture of a scan.
        calibration: Calibration of the sensor, or one by polynomials.
        out: Cloud to write, PLY or by its ending HDF5 (.h5), with intensity, frame and line of every point, and from a
            joint calibration its uncertainty.
        mount: Where the sensor is on its platform (uwlts mount), in place of what the capture states. Poses are the
            platform's then, and points are given in the frame of the poses.
        trajectory: CSV file or ROS bag with times and poses of the platform (of the sensor without a mount), which
            replace poses in the capture and the stage.
        pose_format: Format of the trajectory: matrix, quaternion-xyzw, quaternion-wxyz, rotvec-rad, rotvec-deg,
            euler-ZYX-deg (about the moved axes), euler-zyx-deg (about the fixed axes) or another order, -rad; tum; or
            of a ROS bag ros, ros:/TOPIC, ros:PARENT>CHILD (frames).
        pose_unit: Unit of the trajectory's positions.
        clock_offset_s: What to add to the times of the images for those of the trajectory; as the mount says unless
            given.
        pose_correlation_s: Time over which errors of poses stay alike, inf where all err together. Unless given, poses
            in the capture err each by itself, and those of a trajectory as a navigation filter's of its covariances.
        peak: Which of several stripes on a line counts; the direct one, or as the sensor's table [stripe] says.
    """
    refuse_unsuitable(out, overwrite=overwrite)
    known = uwlts.load_calibration(calibration)
    path = None if trajectory is None else uwlts.read_trajectory(trajectory, pose_format=pose_format, unit=pose_unit)
    with uwlts.open_capture(capture) as opened, progress_bar(f"reconstructing {capture.name}") as progress:
        cloud = uwlts.reconstruct(
            opened,
            known,
            mount=mount,
            trajectory=path,
            clock_offset_s=clock_offset_s,
            pose_correlation_s=pose_correlation_s,
            stripe=stripe_settings(stripe, method, peak),
            index=index,
            progress=progress,
        )
        lit = int(opened.laser_on.sum())
    uwlts.write_cloud(out, cloud, overwrite=overwrite)
    warn(*cloud.warnings)
    print(f"laser images with a point: {len(set(cloud.frame.tolist()))} of {lit}")
    print(f"profile lines: {_counts(cloud.lines_by_status)}")
    if lost := _counts({name: count for name, count in cloud.rays_by_status.items() if name != "ok"}):
        print(f"stripe centres without a point: {lost}")
    print(f"wrote {out} with {len(cloud)} points")


def _counts(by_status: dict[str, int]) -> str:
    return ", ".join(f"{count} {name.replace('_', ' ')}" for name, count in by_status.items() if count)


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
        coloured: Also write the cloud with the deviation of every point to this file.
    """
    from uwlts.report.inventory import evaluation_lines

    for path in (out, coloured):
        if path:
            refuse_unsuitable(path, overwrite=overwrite)
    evaluation = uwlts.evaluate(cloud, artefact, truth)
    uwlts.write_evaluation(out, evaluation, overwrite=overwrite)
    if coloured:
        uwlts.write_cloud(coloured, evaluation.cloud, overwrite=overwrite)
    show(evaluation_lines(evaluation.record()))
    print(f"wrote {out}")


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
        cloud: Cloud of the surface (.ply or .h5).
        reference: Earlier cloud; a mesh (.stl, .obj, .off, or .ply with faces); or an ideal shape: plane, sphere or
            cylinder to fit one, or a TOML file with its kind and what is known of it (docs/how-to/compare-scans.md).
        out: Page to write, with the figures as JSON beside it.
        coloured: Also write the places with distance, level of detection and significance to this PLY or LAZ file.
        register: Move the cloud onto the reference first; else both have one frame.
        datums: TOML file with spheres that hold what has not changed; only points in them count for the registration.
        disc_mm: Diameter over which points are averaged; about 30 points unless given.
        deep_mm: Largest distance that is looked for; three diameters unless given.
        same_water: Both clouds were scanned in water of the same temperature and salinity.
        unit: Unit of the reference.
    """
    from uwlts.report.page_toolkit import refuse_unsuitable_page

    refuse_unsuitable_page(out, example="change.html", overwrite=overwrite)
    if coloured:
        refuse_unsuitable(coloured, overwrite=overwrite)
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
def mesh(
    *clouds: Path,
    out: Path,
    cube_mm: float | None = None,
    radius_mm: float | None = None,
    towards: Annotated[tuple[Direction, ...] | None, Parameter(negative="")] = None,
    overwrite: Overwrite = False,
) -> None:
    """Make a mesh from one or several clouds of one frame, open where nothing was seen, with uncertainty.

    Example: uwlts mesh left.ply right.ply --out pipe.glb

    Args:
        clouds: Clouds (.ply or .h5); the scans of a merged cloud count on their own.
        out: Mesh to write: .ply (with the uncertainty of every vertex), .glb (glTF, m) or .stl.
        cube_mm: Edge of the cubes; walls need to be thicker. A third of the radius, or two thirds of the thinnest wall,
            unless given.
        radius_mm: Radius over which points are averaged; holes that are much smaller are closed. For some thirty points
            and three images unless given.
        towards: Direction x y z from the surface to the sensor, once for each cloud; -Z of its scan unless given.
    """
    from uwlts.storage.mesh_file import MESH_FORMATS

    if out.suffix.lower() not in MESH_FORMATS:
        raise OutputError(f"{out} ends with none of {', '.join(MESH_FORMATS)}, which name the format of a mesh")
    refuse_unsuitable(out, overwrite=overwrite)
    with progress_bar("meshing") as progress:
        surface = uwlts.mesh(*clouds, cube_mm=cube_mm, radius_mm=radius_mm, towards=towards, progress=progress)
    show(surface.lines())
    uwlts.write_mesh(out, surface, overwrite=overwrite)
    print(f"wrote {out}")


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
    datum: Path | None = None,
    overwrite: Overwrite = False,
) -> None:
    """Find the features of a pipe, weld, step, flange or gap in a cloud and measure them, with uncertainty.

    Example: uwlts inspect pipe.ply --wall-mm 9.5 --out pipe.json

    Args:
        cloud: Cloud of the object (.ply or .h5).
        kind: What the cloud shows.
        out: Findings to write (JSON), each value with its definition and its source.
        coloured: Also write the cloud with each point's distance from the undamaged surface to this file.
        section_mm: Length of a section along a pipe (up to twelve unless given) or a weld.
        wall_mm: Thickness of a pipe's undamaged wall, for the wall that remains.
        false_alarm: Probability that anything is found on the whole of a pipe's surface where nothing is.
        datum: Cloud of another face in the same frame, to which a flange's face is to be parallel.
    """
    from uwlts.storage.json_files import json_text

    for path in (out, coloured):
        if path:
            refuse_unsuitable(path, overwrite=overwrite)
    measured = uwlts.read_cloud(cloud)
    found = uwlts.inspect(measured, kind, section_mm=section_mm, wall_mm=wall_mm, false_alarm=false_alarm, datum=datum)
    show(found.lines())
    if coloured:
        uwlts.write_cloud(coloured, replace(measured, deviation_mm=found.deviation_mm), overwrite=overwrite)
        print(f"wrote {coloured}")
    if out:
        with written_aside(out, overwrite=overwrite) as aside:
            aside.write_text(json_text(found.record(), indent=1), encoding="utf-8")
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
    datum: Path | None = None,
    overwrite: Overwrite = False,
) -> None:
    """Inspect a cloud and write the report for the object's owner: a page, the same as JSON, and as PDF.

    Example: uwlts findings-report pipe.ply --wall-mm 9.5 --calibration water.json --out pipe.html --pdf

    Args:
        cloud: Cloud of the object.
        kind: What the cloud shows.
        out: Page to write, with the findings as JSON beside it.
        pdf: Also print the page to a PDF beside it, with the Chromium or Chrome that is installed.
        title: Title of the report.
        captures: Captures that the cloud was reconstructed from, for the traceability.
        calibration: Calibration of the sensor, the one that the cloud names.
        certificate: Its certificate (JSON), whose seal is checked.
        verification: Evaluations (JSON of uwlts evaluate) of artefacts measured by the same calibration.
        section_mm: Length of a section along a pipe (up to twelve unless given) or a weld.
        wall_mm: Thickness of a pipe's undamaged wall, for the wall that remains.
        false_alarm: Probability that anything is found on the whole of a pipe's surface where nothing is.
        datum: Cloud of another face in the same frame, to which a flange's face is to be parallel.
    """
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
        datum=datum,
        overwrite=overwrite,
    )
    show(found.lines())
    beside = [out.with_suffix(suffix).name for suffix in ((".json", ".pdf") if pdf else (".json",))]
    print(f"wrote {out}, {', '.join(beside)}")


@app.command
def register(
    *clouds: Path,
    out: Path,
    page: Path | None = None,
    poses_out: Path | None = None,
    poses: Path | None = None,
    pose_format: str = "matrix",
    pose_unit: Literal["mm", "m"] = "mm",
    start_std_mm: float | None = None,
    start_std_deg: float | None = None,
    search: Flag = False,
    sphere_mm: float | None = None,
    reach_mm: float | None = None,
    overwrite: Overwrite = False,
) -> None:
    """Bring scans that overlap into the frame of the first, and merge them into one cloud with its uncertainty.

    Example: uwlts register top.ply left.ply right.ply --out pipe.ply --page pipe.html

    Args:
        clouds: Two or more clouds (.ply or .h5), in any order.
        out: Merged cloud to write (.ply or .h5).
        page: Page to write, with all figures, poses and their covariance as JSON beside it.
        poses_out: Poses of the scans to write (CSV, matrix, mm).
        poses: CSV file with the pose of every scan at the start, in the order of the clouds; the scans' frames are
            taken as one unless given.
        pose_format: Format of the poses: matrix, quaternion-xyzw, euler-ZYX-deg and others, as for uwlts reconstruct.
        pose_unit: Unit of the poses' positions.
        start_std_mm: Standard uncertainty of the start along each axis: it counts as evidence then.
        start_std_deg: The same of its turns.
        search: Search the start by the shape of the surfaces, or by spheres.
        sphere_mm: Diameter of spheres in the scene that tie scans together.
        reach_mm: How far overlapping surfaces lie apart at the start, at most; a 20th of a scan's size unless given.
    """
    from uwlts.report.page_toolkit import refuse_unsuitable_page

    for path in (out, poses_out):
        if path:
            refuse_unsuitable(path, overwrite=overwrite)
    if page:
        refuse_unsuitable_page(page, example="registration.html", overwrite=overwrite)
    start = None if poses is None else uwlts.read_poses(poses, pose_format=pose_format, unit=pose_unit)[0]
    with progress_bar(f"registering {len(clouds)} scans") as progress:
        found = uwlts.register(
            clouds,
            poses=start,
            start_std_mm=start_std_mm,
            start_std_deg=start_std_deg,
            search=search,
            sphere_mm=sphere_mm,
            reach_mm=reach_mm,
            progress=progress,
        )
    show(found.lines())
    uwlts.write_cloud(out, found.cloud, overwrite=overwrite)
    if poses_out:
        uwlts.write_poses(poses_out, found.poses, overwrite=overwrite)
    if page:
        uwlts.write_registration(page, found, overwrite=overwrite)
    written = [str(path) for path in (out, poses_out, page) if path]
    print(f"wrote {', '.join(written)}")


@app.command
def align(
    cloud: Path,
    *,
    trajectory: Path,
    out: Path,
    aligned: Path | None = None,
    pose_format: str = "quaternion-xyzw",
    pose_unit: Literal["mm", "m"] = "mm",
    clock_offset_s: float = 0.0,
    drift_mm: float | None = None,
    drift_deg: float | None = None,
    overwrite: Overwrite = False,
) -> None:
    """Correct a trajectory so that surfaces which the scan shows twice agree.

    Reconstruct the scan along the corrected trajectory afterwards: its points then have the uncertainty that is left.

    Example: uwlts align pass.ply --trajectory pass.trajectory.csv --drift-mm 300 --drift-deg 1 --out corrected.csv

    Args:
        cloud: Cloud along the trajectory with the times of its points (uwlts reconstruct --trajectory).
        trajectory: CSV file or ROS bag with times and poses, as the cloud was reconstructed with.
        out: Corrected trajectory to write, with the covariance of each pose (CSV), and the crossings as JSON beside it.
        aligned: Also write the cloud along the corrected trajectory.
        pose_format: Format of the trajectory, as for uwlts reconstruct.
        pose_unit: Unit of the trajectory's positions.
        clock_offset_s: What to add to the times of the points for those of the trajectory.
        drift_mm: Standard uncertainty of the navigation at the end, along each axis; as the trajectory's covariance
            says unless given.
        drift_deg: The same of its turns.
    """
    from uwlts.storage.json_files import json_text

    beside = out.with_suffix(".json")
    for path in (out, beside, aligned):
        if path:
            refuse_unsuitable(path, overwrite=overwrite)
    path = uwlts.read_trajectory(trajectory, pose_format=pose_format, unit=pose_unit)
    with progress_bar(f"aligning {cloud.name}") as progress:
        found = uwlts.align_trajectory(
            cloud, path, clock_offset_s=clock_offset_s, drift_mm=drift_mm, drift_deg=drift_deg, progress=progress
        )
    show(found.lines())
    uwlts.write_trajectory(out, found.trajectory, overwrite=overwrite)
    with written_aside(beside, overwrite=overwrite) as aside:
        aside.write_text(json_text(found.record(), indent=1), encoding="utf-8")
    if aligned:
        uwlts.write_cloud(aligned, found.cloud, overwrite=overwrite)
    print(f"wrote {out} and {beside.name}" + (f", {aligned}" if aligned else ""))


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
    from uwlts.storage.json_files import json_text

    if out:
        refuse_unsuitable(out, overwrite=overwrite)
    study = uwlts.gauge_study(table, tolerance=tolerance, reference=reference)
    show(study.lines())
    if out:
        with written_aside(out, overwrite=overwrite) as aside:
            aside.write_text(json_text(study.record(), indent=1), encoding="utf-8")
        print(f"wrote {out}")


@app.command
def report(
    folder: Path,
    *,
    reference: str | None = None,
    out: Path | None = None,
    pictures: Path | None = None,
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
        overwrite: Replace an existing report, summary and pictures.
    """
    from uwlts.report.tables import print_table

    written = uwlts.write_report(folder, reference=reference, out=out, pictures=pictures, overwrite=overwrite)
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


@app.command
def design(sensor: str, *, medium: str) -> None:
    """Print what a sensor can do by the design formulas: resolution, line length, depth range, speckle limit.

    Example: uwlts design thesis --medium water

    Args:
        sensor: Name or path of a sensor description.
        medium: One of the sensor's media.
    """
    from uwlts.report.inventory import table_lines

    show(table_lines(uwlts.design(sensor, medium=medium)))


@app.command
def nominal(sensor: str, *, medium: str, out: CalibrationOut, overwrite: Overwrite = False) -> None:
    """Write the calibration that a sensor would have if it were built exactly as described.

    Example: uwlts nominal thesis --medium water --out nominal.json

    Args:
        sensor: Name or path of a sensor description.
        medium: One of the sensor's media; the laser's window may turn the sheet in it.
    """
    uwlts.write_calibration(out, uwlts.nominal(sensor, medium=medium), overwrite=overwrite)
    print(f"wrote {out}")


@app.command
def info(path: str) -> None:
    """Describe a file: a capture, cloud, calibration, evaluation, or a sensor description (by name or path).

    Example: uwlts info capture.h5

    Args:
        path: File, or name of a shipped sensor such as thesis.
    """
    print(uwlts.describe(path))


@app.command(name="import")
def import_images(folder: Path, *, out: Path, description: Path | None = None, overwrite: Overwrite = False) -> None:
    """Turn a folder of images of any camera into a capture.

    Example: uwlts import photographs --out target.h5

    Args:
        folder: Folder of PNG, TIFF, BMP or JPEG images.
        out: Capture to write.
        description: TOML file with sensor, medium, positions, and which image is what; import.toml in the folder unless
            given.
    """
    with progress_bar(f"importing {folder.name}") as progress:
        imported = uwlts.import_images(folder, out, description=description, overwrite=overwrite, progress=progress)
    warn(*imported.warnings)
    print(f"wrote {out} with {imported.laser} laser and {imported.lamp} lamp images")


@app.command
def export(
    file: Path,
    *,
    out: Path,
    images: Literal["png", "tiff"] = "png",
    region_mm: Box | None = None,
    at_most: int | None = None,
    overwrite: Flag = False,
) -> None:
    """Write a capture as a folder of images that `uwlts import` reads back, or a cloud in another format.

    Example: uwlts export scan.ply --out scan.laz

    Args:
        file: Capture (.h5) or cloud (.ply, .h5 or .copc.laz).
        out: New folder for a capture; for a cloud a file whose ending names the format: .ply, .h5, .xyz (text), .laz,
            .e57, .mcap (ROS 2), .foxglove.mcap, or .copc.laz (an octree for viewers, written a part at a time).
        images: Format of a capture's images; both keep all bits.
        region_mm: Only the points in a box: x y z of one corner, x y z of the other.
        at_most: Only an even sample of about so many points.
        overwrite: Replace an existing cloud.
    """
    with progress_bar(f"exporting {file.name}") as progress:
        written = uwlts.export(
            file, out, images=images, region_mm=region_mm, at_most=at_most, overwrite=overwrite, progress=progress
        )
    print(f"wrote {written} images and import.toml to {out}" if out.is_dir() else f"wrote {out} with {written} points")
