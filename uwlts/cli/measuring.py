"""Commands from captures to clouds and surfaces: reconstruct, register, align, mesh."""

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

import uwlts
from uwlts.cli.command_options import (
    STRIPE,
    Overwrite,
    a_cloud,
    a_file,
    a_page,
    app,
    cloud_written,
    note_lean,
    wrote,
    wrote_files,
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

    with Capture(call.given["capture"]) as capture:
        cloud = call(capture=capture)
        lit = int(capture.laser_on.sum())
    cloud.save(out, overwrite=overwrite)
    warn(*cloud.warnings)
    if check := check_passes(cloud):
        (say if check.agree else warn)(check.text)
    if until := cloud.metadata.get(VERIFIED):
        say(f"calibration verified until {until}")
    say(f"laser images with a point: {len(set(cloud.frame.tolist()))} of {lit}")
    say(f"profile lines: {_counts(cloud.lines_by_status)}")
    if lost := _counts({name: count for name, count in cloud.rays_by_status.items() if name != "ok"}):
        say(f"stripe centres without a point: {lost}")
    say(cloud_written(out, len(cloud)))
    note_lean(out, cloud)


def _counts(by_status: dict[str, int]) -> str:
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


@command_from(app, uwlts, "mesh", job="Reconstruct")
def mesh(
    call: Call,
    *,
    out: Annotated[
        Path,
        a_file(".ply", ".glb", ".stl"),
        Parameter(help="Mesh to write: .ply (with the uncertainty of every vertex), .glb (glTF, m) or .stl."),
    ],
    overwrite: Overwrite = False,
) -> None:
    """Example: uwlts mesh left.cloud.h5 right.cloud.h5 --out pipe.glb"""
    surface = call()
    surface.save(out, overwrite=overwrite)
    wrote(surface.lines(), [], out)


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
