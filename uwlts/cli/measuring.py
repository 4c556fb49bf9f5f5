"""Commands from captures to clouds and surfaces: reconstruct, register, align, mesh."""

from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

import uwlts
from uwlts.cli.options import (
    Flag,
    Index,
    Method,
    Overwrite,
    Stripe,
    app,
    refuse_unsuitable_cloud,
    show,
    stripe_settings,
    warn,
)
from uwlts.files.writing import refuse_unsuitable
from uwlts.runtime.console import progress_bar

CSV = (".csv",)
Direction = tuple[float, float, float]


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
    clock_drift_ppm: float = 0.0,
    pose_correlation_s: float | None = None,
    index: Index = None,
    method: Method = None,
    stripe: Stripe = (),
    peak: Literal["direct", "strongest", "first", "last"] | None = None,
    with_uncertainty: bool | None = None,
    overwrite: Overwrite = False,
) -> None:
    """Turn a capture into a point cloud.

    Example: uwlts reconstruct scan.h5 --calibration calibration.json --out scan.ply

    Args:
        capture: Capture of a scan.
        calibration: Calibration of the sensor, or one by polynomials.
        out: Cloud to write, by its ending PLY, HDF5 (.h5) or another format of uwlts export, with intensity, frame and
            line of every point, and from a joint calibration its uncertainty.
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
        clock_drift_ppm: By how many parts in a million the trajectory's clock runs faster than the camera's, from the
            first laser image on.
        pose_correlation_s: Time over which errors of poses stay alike, inf where all err together. Unless given, poses
            in the capture err each by itself, and those of a trajectory as a navigation filter's of its covariances.
        peak: Which of several stripes on a line counts; the direct one, or as the sensor's table [stripe] says.
        with_uncertainty: Calculate and write the uncertainty of the points, by default from a joint calibration, with
            which files are more than ten times as large.
    """
    refuse_unsuitable_cloud(out, overwrite=overwrite)
    known = uwlts.load_calibration(calibration)
    path = None if trajectory is None else uwlts.read_trajectory(trajectory, pose_format=pose_format, unit=pose_unit)
    with uwlts.open_capture(capture) as opened, progress_bar(f"reconstructing {capture.name}") as progress:
        cloud = uwlts.reconstruct(
            opened,
            known,
            mount=mount,
            trajectory=path,
            clock_offset_s=clock_offset_s,
            clock_drift_ppm=clock_drift_ppm,
            pose_correlation_s=pose_correlation_s,
            stripe=stripe_settings(stripe, method, peak),
            index=index,
            with_uncertainty=with_uncertainty,
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
        out: Merged cloud to write, in the format that its ending names, as for uwlts export.
        page: Page to write, with all figures, poses and their covariance as JSON beside it: of pipe.html,
            pipe.registration.json.
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
    from uwlts.pages.toolkit import refuse_unsuitable_page
    from uwlts.report.registration_page import REGISTRATION

    refuse_unsuitable_cloud(out, overwrite=overwrite)
    if poses_out:
        refuse_unsuitable(poses_out, overwrite=overwrite, endings=CSV)
    if page:
        refuse_unsuitable_page(page, kind=REGISTRATION, overwrite=overwrite)
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
    clock_drift_ppm: float = 0.0,
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
        clock_drift_ppm: By how many parts in a million the trajectory's clock runs faster, as for uwlts reconstruct.
        drift_mm: Standard uncertainty of the navigation at the end, along each axis; as the trajectory's covariance
            says unless given.
        drift_deg: The same of its turns.
    """
    from uwlts.files.json_files import write_record

    beside = out.with_suffix(".json")
    refuse_unsuitable(out, overwrite=overwrite, endings=CSV)
    refuse_unsuitable(beside, overwrite=overwrite)
    if aligned:
        refuse_unsuitable_cloud(aligned, overwrite=overwrite)
    path = uwlts.read_trajectory(trajectory, pose_format=pose_format, unit=pose_unit)
    with progress_bar(f"aligning {cloud.name}") as progress:
        found = uwlts.align_trajectory(
            cloud,
            path,
            clock_offset_s=clock_offset_s,
            clock_drift_ppm=clock_drift_ppm,
            drift_mm=drift_mm,
            drift_deg=drift_deg,
            progress=progress,
        )
    show(found.lines())
    uwlts.write_trajectory(out, found.trajectory, overwrite=overwrite)
    write_record(beside, found.record(), overwrite=overwrite)
    if aligned:
        uwlts.write_cloud(aligned, found.cloud, overwrite=overwrite)
    print(f"wrote {out} and {beside.name}" + (f", {aligned}" if aligned else ""))


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

    refuse_unsuitable(out, overwrite=overwrite, endings=MESH_FORMATS)
    with progress_bar("meshing") as progress:
        surface = uwlts.mesh(*clouds, cube_mm=cube_mm, radius_mm=radius_mm, towards=towards, progress=progress)
    show(surface.lines())
    uwlts.write_mesh(out, surface, overwrite=overwrite)
    print(f"wrote {out}")
