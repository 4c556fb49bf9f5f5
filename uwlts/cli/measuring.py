"""Commands from captures to evaluated point clouds."""

from pathlib import Path
from typing import Literal

from uwlts.cli.options import Flag, Method, app
from uwlts.model.errors import OutputError
from uwlts.runtime.console import progress_bar
from uwlts.storage.files import refuse_unsuitable


@app.command
def reconstruct(
    capture: Path,
    *,
    calibration: Path,
    out: Path,
    index: float | None = None,
    method: Method | None = None,
    peak: Literal["strongest", "first", "last"] = "strongest",
    overwrite: Flag = False,
) -> None:
    """Turn a capture into a point cloud.

    Example: uwlts reconstruct scan.h5 --calibration calibration.json --out scan.ply

    Parameters
    ----------
    capture
        Capture of a scan.
    calibration
        Calibration of the sensor, or one by polynomials.
    out
        Cloud to write, PLY or by its ending HDF5 (.h5), with intensity, frame and line of every point, and by a joint
        calibration its uncertainty.
    index
        Refractive index of the medium, in place of the one that follows from the capture.
    method
        How the stripe's centre is found.
    peak
        Which of several stripes on a line counts.
    overwrite
        Replace an existing file.
    """
    from uwlts.measurement.reconstruction import reconstruct as reconstructed
    from uwlts.storage.calibration_file import read_any_calibration
    from uwlts.storage.capture import Capture
    from uwlts.storage.cloud import write_cloud
    from uwlts.stripe import PeakRule, StripeOptions

    refuse_unsuitable(out, overwrite=overwrite)
    options = StripeOptions(method=method or StripeOptions.method, peak=PeakRule(peak))
    known = read_any_calibration(calibration)
    with Capture(capture) as opened, progress_bar(f"reconstructing {capture.name}") as progress:
        cloud = reconstructed(opened, known, options=options, index=index, progress=progress)
        lit = int(opened.laser_on.sum())
    write_cloud(out, cloud, overwrite=overwrite)
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
    overwrite: Flag = False,
) -> None:
    """Compare a cloud with its artefact's calibrated values, and point by point with a truth file.

    Example: uwlts evaluate spheres.ply --truth spheres.truth.h5 --out spheres.evaluation.json

    Parameters
    ----------
    cloud
        Point cloud (.ply or .h5).
    out
        Evaluation to write (JSON).
    artefact
        TOML file with the artefact's kind and calibrated values, in place of what the capture says.
    truth
        Ground truth of the capture, if it was rendered.
    coloured
        Also write the cloud with the deviation of every point to this file.
    overwrite
        Replace existing files.
    """
    from uwlts.measurement.evaluation import evaluate as evaluated
    from uwlts.measurement.evaluation import write_evaluation
    from uwlts.report.inventory import evaluation_lines
    from uwlts.storage.cloud import write_cloud

    for path in (out, coloured):
        if path:
            refuse_unsuitable(path, overwrite=overwrite)
    evaluation = evaluated(cloud, artefact, truth)
    write_evaluation(out, evaluation, overwrite=overwrite)
    if coloured:
        write_cloud(coloured, evaluation.cloud, overwrite=overwrite)
    print("\n".join(evaluation_lines(evaluation.record())))
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

    Parameters
    ----------
    folder
        Folder of the campaign.
    reference
        Published values to set beside the measured ones: name (thesis) or path of a TOML file.
    out
        Page to write; FOLDER/report.html unless given. The summary goes beside it, to summary.json.
    pictures
        Also write every measurement's stripe and cloud as PNG files into this folder.
    overwrite
        Replace an existing report, summary and pictures.
    """
    from uwlts.report.campaign_page import write_report
    from uwlts.report.gather import gather_campaign, load_reference
    from uwlts.report.pictures import write_pictures
    from uwlts.report.summary_file import write_summary
    from uwlts.report.tables import print_table, summary_table

    campaign = gather_campaign(folder)
    published = load_reference(reference) if reference else None
    page = out or folder / "report.html"
    write_summary(page.with_name("summary.json"), campaign, published, overwrite=overwrite)
    write_report(page, campaign, published, overwrite=overwrite)
    if pictures:
        try:
            pictures.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise OutputError(f"cannot make the folder {pictures}: {error.strerror}") from error
        write_pictures(pictures, campaign, overwrite=overwrite)
    print_table(summary_table(campaign, published))
    print(f"wrote {page} and {page.with_name('summary.json')}")
