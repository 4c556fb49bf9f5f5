"""Reconstruction of captures: point clouds from the stripes of all laser images by a calibration of any kind."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from uwlts.errors import CalibrationError, DescriptionError
from uwlts.model.any_calibration import AnyCalibration, calibration_digest
from uwlts.model.calibration import Calibration
from uwlts.model.mount import Mount
from uwlts.model.polynomial_calibration import PolynomialCalibration
from uwlts.model.sensor import Table
from uwlts.model.stripe import CaptureStripes
from uwlts.model.trajectory import Trajectory
from uwlts.optics.brightness import LitSheet, footprint_std, sharp_lines, slopes_of_brightness
from uwlts.optics.fitness import check_fits
from uwlts.optics.triangulation import MeasuredPoints, reconstruct_by_polynomials, reconstruct_profile, stage_travel
from uwlts.optics.window import RayStatus, require_index
from uwlts.reconstruction.moving import carried, platform_ride, with_platform
from uwlts.reconstruction.point_uncertainty import point_uncertainty
from uwlts.runtime.compiled import compiled
from uwlts.runtime.progress import ProgressListener, unheard
from uwlts.storage.calibration_file import loaded_calibration
from uwlts.storage.capture import Capture, FrameTable, opened_capture, sensor_poses
from uwlts.storage.cloud import FOOTPRINT, FOOTPRINT_STD, PointCloud
from uwlts.storage.mount_files import read_mount
from uwlts.storage.pose_files import PoseFormat, Unit, read_trajectory
from uwlts.stripe import StripeSettings, find_stripes


def reconstruct(
    capture: Capture | str | Path,
    calibration: AnyCalibration | str | Path,
    *,
    mount: Mount | str | Path | None = None,
    trajectory: Trajectory | str | Path | None = None,
    pose_format: PoseFormat = "matrix",
    pose_unit: Unit = "mm",
    clock_offset_s: float | None = None,
    clock_drift_ppm: float = 0.0,
    pose_correlation_s: float | None = None,
    stripe: StripeSettings = None,
    index: float | None = None,
    with_uncertainty: bool | None = None,
    progress: ProgressListener = unheard,
) -> PointCloud:
    """Turn a capture into a point cloud: find the stripes of all laser images and triangulate them.

    Parameters
    ----------
    capture : Capture or path
        Capture of a scan.
    calibration : Calibration, PolynomialCalibration or path
        Calibration of the sensor, or one by polynomials.
    mount : Mount or path, optional
        Where the sensor is on its platform (uwlts mount), in place of what the capture states. Poses are the platform's
        then, and points are given in the frame of the poses.
    trajectory : Trajectory or path, optional
        CSV file or ROS bag with times and poses of the platform (of the sensor without a mount), which replace poses in
        the capture and the stage.
    pose_format : str
        Format of the trajectory: matrix, quaternion-xyzw, quaternion-wxyz, rotvec-rad, rotvec-deg, euler-ZYX-deg (about
        the moved axes), euler-zyx-deg (about the fixed axes) or another order, -rad for radians; tum; or of a ROS bag
        ros, ros:/TOPIC, ros:PARENT>CHILD (frames).
    pose_unit : {"mm", "m"}
        Unit of the trajectory's positions.
    clock_offset_s : float, optional
        What to add to the times of the images for those of the trajectory; as the mount says unless given.
    clock_drift_ppm : float, optional
        By how many parts in a million the trajectory's clock runs faster than the camera's, from the first laser image
        on.
    pose_correlation_s : float, optional
        Time over which errors of poses stay alike: 0 if each pose errs by itself, inf if all err together. Unless given
        it is 0 for poses in the capture; errors of a trajectory are those of a navigation filter of its covariances.
    stripe : StripeOptions or dict, optional
        How stripes are found: all options, or settings such as half_window_px=32 threshold_sigmas=4, in place of those
        in the sensor's table [stripe] (docs: StripeOptions).
    index : float, optional
        Refractive index of the medium relative to air, in place of the one that follows from the capture.
    with_uncertainty : bool, optional
        Calculate the uncertainty of the points, by default with a joint calibration, which alone holds one. Files with
        it are more than ten times as large.
    progress : callable, optional
        Called after each image with the number of images done and the number in all.

    Returns
    -------
    PointCloud
        ``points_mm`` (N, 3) in the object coordinate system, or in the frame in which poses or trajectory are given;
        ``covariance_mm2`` (N, 3, 3) or None, to which mount, time offset and poses of known covariance add theirs.
        ``time_s`` (N,) is each point's time of scans by a platform.

    Raises
    ------
    CaptureError, CalibrationError, RangeError
        As `find_stripes` and `reconstruct_stripes`; a file cannot be read; or images have no pose where one is needed.
    DescriptionError
        Images were taken before or after the trajectory.
    """
    if pose_correlation_s is not None and not pose_correlation_s >= 0:
        raise DescriptionError(f"pose_correlation_s is {pose_correlation_s:g}; it must not be negative")
    calibration = loaded_calibration(calibration)
    with opened_capture(capture) as scan:
        check_fits(scan.header, calibration, source=scan.path.name)
        known = calibration.joint is not None if with_uncertainty is None else with_uncertainty
        alone = scan.header.T_platform_sensor is None and scan.pose_covariance is None
        if alone and mount is None and trajectory is None and clock_offset_s is None and not clock_drift_ppm:
            stripes = find_stripes(scan, options=stripe, progress=progress)
            return reconstruct_stripes(scan, stripes, calibration, index=index, with_uncertainty=known)
        mount = read_mount(mount) if isinstance(mount, str | Path) else mount
        if isinstance(trajectory, str | Path):
            trajectory = read_trajectory(trajectory, pose_format=pose_format, unit=pose_unit)
        ride = platform_ride(
            scan, trajectory, mount=mount, clock_offset_s=clock_offset_s, clock_drift_ppm=clock_drift_ppm
        )
        stripes = find_stripes(scan, options=stripe, progress=progress)
        table = carried(scan, ride, mount)
        apart, common = (None, None) if mount is None else mount.apart_from(calibration_digest(calibration))
        cloud = reconstruct_stripes(
            table, stripes, calibration, index=index, with_uncertainty=known, mount_by=common if known else None
        )
        warnings = cloud.warnings
        if mount is None and scan.header.T_platform_sensor is not None:
            warnings = [*warnings, "the mount is that of the drawing: calibrate it (uwlts mount) and give `mount`"]
        own = cloud.uncertainty
        if own is not None:
            where = cloud.points_mm, cloud.frame, ride
            own = with_platform(own, *where, mount, mount_covariance=apart, correlation_s=pose_correlation_s)
        return replace(cloud, uncertainty=own, warnings=warnings, time_s=scan.time_s[cloud.frame])


def reconstruct_stripes(
    capture: Capture | FrameTable,
    stripes: CaptureStripes,
    calibration: AnyCalibration,
    *,
    index: float | None = None,
    with_uncertainty: bool = False,
    mount_by: np.ndarray | None = None,
) -> PointCloud:
    """Point cloud of a capture in the OCS, with the stage's motion added (or the pose, where a frame has one).

    ``index`` replaces the refractive index that follows from the capture's medium. ``with_uncertainty`` adds the
    uncertainty of the points by a joint calibration, ``mount_by`` as in `point_uncertainty`. Without a mounted window
    the calibration's is left out. Points that a calibration by polynomials does not reach are left out and counted in
    ``rays_by_status``.

    By a joint calibration points are taken where the light comes from, beside the sheet's middle where the surface
    shines brighter there (`uwlts.optics.brightness`), and lines are left out, counted as ``blurred``, where blur may
    move the stripe's centre more than noise does.

    Raises
    ------
    CalibrationError
        The calibration does not fit the capture, or an index is given for a calibration by polynomials.
    RangeError
        The refractive index is none of a medium.
    """
    doubts = check_fits(capture.header, calibration, source=capture.path.name)
    if index is not None and isinstance(calibration, PolynomialCalibration):
        raise CalibrationError(
            "polynomials hold the refraction of the medium they were made in: a refractive index cannot replace it"
        )
    index = calibration.index_of(capture.header.medium) if index is None else index
    require_index(index)
    lines = stripes.lines_by_status
    sharp, blur = np.arange(len(stripes.line)), np.zeros(len(stripes.line))
    exact = calibration if isinstance(calibration, Calibration) and calibration.joint is not None else None
    if exact is not None:
        sharp, blur = sharp_lines(stripes)
        blurred = len(stripes.line) - len(sharp)
        lines = lines | {"ok": lines.get("ok", 0) - blurred, "blurred": blurred}
        stripes = stripes[sharp]
    digest = calibration_digest(calibration)
    sheet = _lit_sheet(capture, calibration, stripes, index, digest)
    found = _points(capture, calibration, stripes, index, sheet)
    beside, points = np.zeros((len(sharp), 3)), found.points_mm
    if exact is not None and sheet is not None:
        beside = _beside(capture, sheet, stripes)
        points = points + beside
    points = _posed(points, capture, stripes.frame)
    there = found.status == RayStatus.OK
    good = slice(None) if there.all() else np.flatnonzero(there)
    kept, known = stripes[good], None
    if with_uncertainty:
        if exact is None:
            raise CalibrationError("the calibration holds no uncertainty: calibrate jointly (`water` or `joint`)")
        where = kept.frame, kept.line, kept.centre_px
        moved = {"blur_px": blur[good], "beside_mm": beside[good], "mount_by": mount_by}
        known = point_uncertainty(capture, exact, *where, **moved, digest=digest)
    rays = np.bincount(found.status, minlength=len(RayStatus))
    return PointCloud(
        points_mm=points[good],
        intensity=kept.amplitude,
        frame=kept.frame,
        line=kept.line,
        uncertainty=known,
        metadata={
            "capture": capture.path.name,
            "sensor": calibration.sensor_name,
            "medium": capture.header.medium_name,
            "medium_index": index,
            "artefact": capture.header.artefact,
            "calibration": digest,
            **({} if sheet is None else _footprint(capture, sheet, stripes)),
        },
        lines_by_status=lines,
        rays_by_status={status.name.lower(): int(rays[status]) for status in RayStatus},
        warnings=doubts,
    )


def _lit_sheet(
    capture: Capture | FrameTable, calibration: AnyCalibration, stripes: CaptureStripes, index: float, digest: str
) -> LitSheet | None:
    """What stripe centres see of the sheet; none with poses, or by polynomials."""
    if isinstance(calibration, PolynomialCalibration) or np.isfinite(capture.pose).any():
        return None
    sensor = capture.header.sensor
    return LitSheet.of(calibration, sensor, stripes.line, stripes.centre_px, medium_index=index, digest=digest)


def _points(
    capture: Capture | FrameTable,
    calibration: AnyCalibration,
    stripes: CaptureStripes,
    index: float,
    sheet: LitSheet | None,
) -> MeasuredPoints:
    """Points in the OCS of stripe centres, by whichever kind of calibration, with the stage's motion added."""
    direction = np.array(capture.header.stage_direction)
    # A rolling shutter exposes each row at its own time, and so at its own place of a stage that moves.
    stage = capture.stage_mm[stripes.frame] + capture.speed_mm_per_s[stripes.frame] * _row_delay_s(capture, stripes)
    line, centre = stripes.line, stripes.centre_px
    if isinstance(calibration, PolynomialCalibration):
        return reconstruct_by_polynomials(calibration, line, centre, stage_mm=stage, stage_direction=direction)
    direction = np.array(calibration.stage_direction_of(capture.header.stage_direction))
    if sheet is not None:
        return replace(sheet.found, points_mm=sheet.found.points_mm + stage_travel(stage, direction).T)
    if not capture.header.sensor.camera.window.mounted:
        calibration = calibration.model_copy(update={"window": None})
    return reconstruct_profile(calibration, line, centre, medium_index=index, stage_mm=stage, stage_direction=direction)


def _row_delay_s(capture: Capture | FrameTable, stripes: CaptureStripes) -> np.ndarray | float:
    """Time (N,) by which the rows of stripe centres are exposed after the middle row."""
    camera, detector = capture.header.sensor.camera, capture.header.sensor.detector
    if detector.shutter == "global":
        return 0.0
    row = stripes.centre_px if camera.stripe_along == "width" else stripes.line
    return 1e-6 * detector.line_time_us * (row - (camera.height_px - 1) / 2)


def _beside(capture: Capture | FrameTable, sheet: LitSheet, stripes: CaptureStripes) -> np.ndarray:
    """From points on the sheet's middle to where their light comes from (N, 3), OCS."""
    slopes = slopes_of_brightness(stripes.frame, stripes.line, stripes.amplitude, capture.stage_mm, capture.exposure_ms)
    return sheet.beside(stripes.width_px, slopes, stage_direction=capture.header.stage_direction)


def _footprint(capture: Capture | FrameTable, sheet: LitSheet, stripes: CaptureStripes) -> Table:
    """Metadata of how much of the surface a point is the mean of; none where that is not known."""
    if not np.isfinite(stripes.width_px[sheet.found.status == RayStatus.OK]).any():
        return {}
    std = footprint_std(capture.header.sensor.uncertainty)
    return {FOOTPRINT: list(sheet.footprint_mm(stripes.width_px)), FOOTPRINT_STD: std}


def _posed(points: np.ndarray, capture: Capture | FrameTable, frame: np.ndarray) -> np.ndarray:
    """Points of frames that carry a full pose ``T_scene_object`` are placed by it instead of by the stage."""
    poses = sensor_poses(capture)
    posed = np.asarray(np.isfinite(poses).all(axis=(1, 2)))
    if not posed.any():
        return points
    own = slice(None) if posed[frame].all() else posed[frame]
    at, direction = frame[own], np.array(capture.header.stage_direction)
    by_sensor = points[own] - capture.stage_mm[at, None] * direction
    placed = np.empty_like(by_sensor)
    _place(poses, at, by_sensor, placed)
    points = points.copy()
    points[own] = placed
    return points


@compiled
def _place(poses: np.ndarray, image: np.ndarray, by_sensor: np.ndarray, placed: np.ndarray) -> None:
    """Fill the places (N, 3) of points of the sensor's frame (N, 3) by the poses (F, 4, 4) of their images (N,)."""
    for n in range(image.size):
        pose, x, y, z = poses[image[n]], by_sensor[n, 0], by_sensor[n, 1], by_sensor[n, 2]
        for axis in range(3):
            placed[n, axis] = pose[axis, 0] * x + pose[axis, 1] * y + pose[axis, 2] * z + pose[axis, 3]
