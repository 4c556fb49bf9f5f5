"""Reconstruction of point clouds from the stripes of all laser images, with any kind of calibration."""

import math
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from copy import copy
from dataclasses import replace
from pathlib import Path

import numpy as np

from uwlts.errors import CalibrationError, CaptureError, DescriptionError
from uwlts.files.json_files import EDITED
from uwlts.fitting.least_squares import robust_std
from uwlts.model.calibration import AnyCalibration, Calibration, PolynomialCalibration, calibration_digest
from uwlts.model.mount import Mount
from uwlts.model.sensor import Table
from uwlts.model.stripe import CaptureStripes
from uwlts.model.trajectory import Trajectory
from uwlts.optics.brightness import IlluminatedPoints, fit_brightness_slopes, footprint_std, select_sharp_lines
from uwlts.optics.fitness import check_fits
from uwlts.optics.triangulation import MeasuredPoints, reconstruct_by_polynomials, reconstruct_profile, stage_travel
from uwlts.optics.window import RayStatus, require_index
from uwlts.reconstruction.moving import ErrorPatterns, add_platform_poses, add_platform_uncertainty, find_platform_poses
from uwlts.reconstruction.point_uncertainty import MOST_CORRELATED, measure_correlation, point_uncertainty
from uwlts.runtime.compiled import compiled
from uwlts.runtime.progress import ProgressListener, ignore_progress
from uwlts.storage.calibration_file import describe_verification, resolve_calibration
from uwlts.storage.capture import NO_STAGE, Capture, FrameTable, open_capture, sensor_poses
from uwlts.storage.cloud import FOOTPRINT, FOOTPRINT_STD, VERIFIED, PointCloud, concatenate_clouds
from uwlts.storage.mount_files import read_mount
from uwlts.storage.number_tables import Unit
from uwlts.storage.pose_files import PoseFormat, read_trajectory
from uwlts.stripe import StripeSettings, find_stripes
from uwlts.stripe.capture_stripes import FEWEST_LINES, find_stripes_in_parts

_OTHER_WATER = 1e-3
"""Difference of refractive indices beyond 10 K of temperature or 5 g/kg of salinity; it changes lengths by 0.07 %."""
_NOISE_SAMPLED = 100_000
"""Number of stripe centres that show whether their noise is correlated."""
_PART = 500_000
"""Least number of points in a part of a long scan: with their uncertainty they take 1 kB each while they are found."""
_SAMPLED_IMAGES, _SAMPLED_LINES = 400, 4
"""Images that determine the patterns of a long scan, as many as the temporal modes of a path. Of its sample of points,
every fourth line is kept, which the check of overlaps uses."""
_KEPT_IMAGES = 3000
"""Images of that sample: 150 points of each, with their uncertainty, take some 200 MB."""
_BESIDE_NOISE, _BESIDE_OTHERS, _USUAL = 2.0, (5.0, 20.0), (0.9, 0.75)
"""Strange distance of a stripe from where its neighbours let expect it, in standard deviations of centres, and in the
largest of the usual fractions of images. Chosen on ten scans of thesis-small, at most 0.4 of the noise, and on
exchanged images of spheres, from 2.4. Of 300 drawn surfaces that are rough along the stage alone, 5 are reported. The
second pair notices a fifth of the images from another scan on 73 to 100 % of drawn surfaces, the first one on 0 to
35 %. It also reports 6 to 9 % of the surfaces that have waves or ribs along the stage alone."""


def reconstruct(
    capture: Capture | str | Path,
    calibration: AnyCalibration | str | Path,
    *,
    mount: Mount | str | Path | None = None,
    trajectory: Trajectory | str | Path | None = None,
    pose_format: PoseFormat = "matrix",
    pose_unit: Unit | None = None,
    clock_offset_s: float | None = None,
    clock_drift_ppm: float = 0.0,
    pose_correlation_s: float | None = None,
    stripe: StripeSettings = None,
    index: float | None = None,
    with_uncertainty: bool | None = None,
    take: Callable[[PointCloud], object] | None = None,
    progress: ProgressListener = ignore_progress,
) -> PointCloud:
    """Turn a capture into a point cloud: find the stripes of all laser images and triangulate them.

    Parameters
    ----------
    capture : Capture or path
        Capture of a scan.
    calibration : Calibration, PolynomialCalibration or path
        Calibration of the sensor, or one by polynomials.
    mount : Mount or path, optional
        Pose of the sensor on its platform (uwlts mount); by default that in the capture. Poses are then those of the
        platform, and points are in the frame of the poses.
    trajectory : Trajectory or path, optional
        CSV file or ROS bag with times and poses of the platform, or of the sensor without a mount. They replace the
        poses in the capture and the stage.
    pose_format : str
        Format of the trajectory: matrix, quaternion-xyzw, quaternion-wxyz, rotvec-rad, rotvec-deg, euler-ZYX-deg
        (intrinsic axes), euler-zyx-deg (extrinsic axes) or another order, -rad for radians; tum; or for a ROS bag ros,
        ros:/TOPIC, ros:PARENT>CHILD (frames).
    pose_unit : {"mm", "m"}, optional
        Unit of the trajectory's positions; by default that in the names of its columns, else mm.
    clock_offset_s : float, optional
        Offset from the times of the images to those of the trajectory; by default that of the mount.
    clock_drift_ppm : float, optional
        Rate difference between the clocks of trajectory and camera from the first laser image on, parts per million;
        positive if that of the trajectory runs faster.
    pose_correlation_s : float, optional
        Correlation time of pose errors: 0 for independent errors, inf for a common error. The default is 0 for poses in
        the capture. For a trajectory, the correlation of a navigation filter follows from its covariances.
    stripe : StripeOptions or dict, optional
        Options of the stripe detection, or settings such as half_window_px=32 threshold_sigmas=4, in place of those in
        the sensor's table [stripe] (docs: StripeOptions).
    index : float, optional
        Refractive index of the medium relative to air; by default that of the capture's medium.
    with_uncertainty : bool, optional
        Calculate the uncertainty of the points, which requires a joint calibration; by default if it is joint. Files
        are then more than ten times larger.
    take : callable, optional
        Called with the cloud, or with parts of half a million points or more if all images have a pose. The result of
        parts is a sample of their points, with the counts of all.
    progress : callable, optional
        Called after each image with the number of images done and the total number.

    Returns
    -------
    PointCloud
        ``points_mm`` (N, 3) in the object coordinate system, or in the frame of the poses or trajectory.
        ``covariance_mm2`` (N, 3, 3) or None, including that of mount, time offset and poses if known. ``time_s`` (N,)
        is the time of each point, for scans from a platform.

    Raises
    ------
    CaptureError, CalibrationError, RangeError
        As for `find_stripes` and `reconstruct_stripes`; a file cannot be read; or images lack a required pose.
    DescriptionError
        Images were taken before or after the trajectory.
    """
    if pose_correlation_s is not None and not pose_correlation_s >= 0:
        raise DescriptionError(f"pose_correlation_s is {pose_correlation_s:g}; expected zero or a positive number")
    file, calibration = calibration, resolve_calibration(calibration)
    until, doubts = describe_verification(file, calibration) if isinstance(file, str | Path) else (None, [])
    if until is not None and index is not None:
        until, doubts = None, [*doubts, f"the verification does not apply: it had no `index` of {index:g}"]

    with open_capture(capture) as scan:
        check_fits(scan.header, calibration, source=scan.path.name)
        known = calibration.joint is not None if with_uncertainty is None else with_uncertainty
        alone = scan.header.T_platform_sensor is None and scan.pose_covariance is None
        plain = alone and mount is None and trajectory is None and clock_offset_s is None and not clock_drift_ppm
        if plain:
            _refuse_free_poses(scan)
        mount = read_mount(mount) if isinstance(mount, str | Path) else mount
        if isinstance(trajectory, str | Path):
            trajectory = read_trajectory(trajectory, pose_format=pose_format, unit=pose_unit)
        clock = {"clock_offset_s": clock_offset_s, "clock_drift_ppm": clock_drift_ppm}
        ride = None if plain else find_platform_poses(scan, trajectory, mount=mount, **clock)
        table, independent, common = scan if ride is None else add_platform_poses(scan, ride, mount), None, None
        if mount is not None:
            independent, common = mount.independent_covariance(calibration_digest(calibration))
            # The covariance of the mount of another calibration contains the errors of the OCS.
            common = np.zeros((6, 0)) if common is None else common
        chosen = ErrorPatterns()

        def measure(stripes: CaptureStripes) -> PointCloud:
            uncertain = {"with_uncertainty": known, "mount_by": common if known else None, "chosen": chosen}
            cloud = reconstruct_stripes(table, stripes, calibration, index=index, **uncertain)
            warnings, stated = cloud.warnings, cloud.uncertainty
            metadata = cloud.metadata | ({} if until is None else {VERIFIED: until})
            if ride is None:
                return replace(cloud, warnings=[*doubts, *warnings], metadata=metadata)
            if mount is None and scan.header.T_platform_sensor is not None:
                warnings = [*warnings, "the mount has its design values: calibrate it (uwlts mount) and give `mount`"]
            if stated is not None:
                both = {"mount_covariance": independent, "correlation_s": pose_correlation_s, "chosen": chosen}
                stated = add_platform_uncertainty(stated, cloud.points_mm, cloud.frame, ride, mount, **both)
            metadata |= {EDITED: "mount"} if mount is not None and mount.edited else {}
            metadata |= {} if ride.margins_s is None else {"trajectory_margins_s": [*ride.margins_s]}
            new = {"uncertainty": stated, "metadata": metadata, "time_s": scan.time_s[cloud.frame]}
            return replace(cloud, warnings=[*doubts, *ride.doubts, *warnings], **new)

        images, most = np.flatnonzero(scan.laser_on), math.inf
        large = len(images) * scan.header.sensor.camera.lines() >= 2 * _PART
        if take is not None and large and np.isfinite(table.pose[images]).all():
            most, some = _PART, copy(scan)
            # Parts of a cloud share their error patterns, which are those of the whole scan.
            some.laser_on = np.isin(np.arange(len(scan)), images[:: max(1, len(images) // _SAMPLED_IMAGES)])
            with suppress(CaptureError, CalibrationError):  # too few stripes in these: the first part determines them
                measure(find_stripes(some, options=stripe))
        kept, lines, rays = list[PointCloud](), Counter[str](), Counter[str]()
        for stripes in find_stripes_in_parts(scan, most, options=stripe, progress=progress):
            part = measure(stripes)
            if take is not None:
                take(part)
            lines.update(part.lines_by_status)
            rays.update(part.rays_by_status)
            few = part.frame % max(1, len(images) // _KEPT_IMAGES) + part.line % _SAMPLED_LINES == 0
            kept.append(part if most == math.inf else part.select(np.flatnonzero(few)))
        whole = kept[0] if len(kept) == 1 else concatenate_clouds(kept)
        return replace(whole, lines_by_status=dict(lines), rays_by_status=dict(rays))


def _refuse_free_poses(scan: Capture) -> None:
    """Raise CalibrationError if several laser images have neither a position of the stage nor a pose."""
    unplaced = np.count_nonzero(scan.laser_on & ~np.isfinite(scan.pose).all(axis=(1, 2)))
    if scan.header.provenance.get("stage") == NO_STAGE and unplaced and np.count_nonzero(scan.laser_on) > 1:
        raise CalibrationError(
            f"{unplaced} laser images of {scan.path.name} have free poses, which are unknown: their stage_mm is only a "
            "number. Import them with positions of the stage or with poses, or give a trajectory; a capture of a "
            "target with free poses is for `uwlts calibrate --target-poses free`"
        )


def reconstruct_stripes(
    capture: Capture | FrameTable,
    stripes: CaptureStripes,
    calibration: AnyCalibration,
    *,
    index: float | None = None,
    with_uncertainty: bool = False,
    mount_by: np.ndarray | None = None,
    chosen: ErrorPatterns | None = None,
) -> PointCloud:
    """Triangulate the stripes of a capture to a point cloud.

    Points are in the OCS, moved by the stage or by the pose of their frame. Points outside the range of a polynomial
    calibration are omitted and counted in ``rays_by_status``. The window of the calibration is ignored for a capture
    without a mounted window.

    A joint calibration moves points from the centre of the sheet to the origin of their light, which depends on
    brightness gradients (`uwlts.optics.brightness`). It also omits lines whose stripe centre may be shifted more by
    blur than by noise, counted as ``blurred``.

    ``index`` is the refractive index, by default that of the capture's medium. The uncertainty of the points needs a
    joint calibration; ``mount_by`` and ``chosen`` as for `point_uncertainty`.

    Raises CalibrationError if the calibration does not fit the capture, or an index is given for a polynomial one;
    RangeError if the index is outside the range of media.
    """
    doubts = check_fits(capture.header, calibration, source=capture.path.name)
    by_stage = not np.isfinite(capture.pose).any()
    doubts += _doubt_images(stripes, by_stage=by_stage) + _warn_of_smoothing(stripes)
    if index is not None and isinstance(calibration, PolynomialCalibration):
        raise CalibrationError(
            "a polynomial calibration is valid only for its own medium, so a refractive index cannot be given; omit it"
        )
    calibrated = calibration.medium_index(capture.header.medium)
    if index is not None and abs(index - calibrated) > _OTHER_WATER:
        doubts.append(f"the given `index` {index:g} is not that of the medium, {calibrated:.5g}: is it other water?")
    index = calibrated if index is None else index
    require_index(index)
    lines = stripes.lines_by_status
    sharp, blur = np.arange(len(stripes.line)), np.zeros(len(stripes.line))
    exact = calibration if isinstance(calibration, Calibration) and calibration.joint is not None else None
    if exact is not None:
        sharp, blur = select_sharp_lines(stripes)
        blurred = len(stripes.line) - len(sharp)
        lines = lines | {"ok": lines.get("ok", 0) - blurred, "blurred": blurred}
        stripes = stripes[sharp]
    sheet = None  # with poses or a polynomial calibration
    if by_stage and isinstance(calibration, Calibration):
        seen = capture.header.sensor, stripes.line, stripes.centre_px
        sheet = IlluminatedPoints.from_calibration(calibration, *seen, medium_index=index)
    found = _triangulate(capture, calibration, stripes, index, sheet)
    beside, points = np.zeros((len(sharp), 3)), found.points_mm
    if exact is not None and sheet is not None:
        lit = stripes.frame, stripes.line, stripes.amplitude
        slopes = fit_brightness_slopes(*lit, capture.stage_mm, capture.exposure_ms)
        beside = sheet.brightness_shift(stripes.width_px, slopes, stage_direction=capture.header.stage_direction)
        points = points + beside
    points = _apply_poses(points, capture, stripes.frame)
    there = found.status == RayStatus.OK
    good = slice(None) if there.all() else np.flatnonzero(there)
    kept, known = stripes[good], None
    if with_uncertainty:
        if exact is None:
            raise CalibrationError("the calibration states no uncertainty: calibrate jointly (`water` or `joint`)")
        centres = kept.frame, kept.line, kept.centre_px
        moved = {"width_px": kept.width_px, "blur_px": blur[good], "beside_mm": beside[good]}
        known = point_uncertainty(capture, exact, centres, **moved, mount_by=mount_by, chosen=chosen)
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
            "calibration": calibration_digest(calibration),
            "images": len(capture.stage_mm),
            **{key: value for key, value in capture.header.provenance.items() if key == "scene"},
            **({EDITED: "calibration"} if EDITED in calibration.provenance else {}),
            **({} if sheet is None else _describe_footprint(capture, sheet, stripes)),
        },
        lines_by_status=lines,
        rays_by_status={status.name.lower(): int(rays[status]) for status in RayStatus},
        warnings=doubts,
    )


def _doubt_images(stripes: CaptureStripes, *, by_stage: bool) -> list[str]:
    """Return warnings of images with exactly the stripe of the one before, and of those out of place if ``by_stage``.

    On most lines, their stripe is neither between those of its neighbours nor on the straight line through the two
    images before or after, as at a ridge.
    """
    first = np.flatnonzero(np.diff(stripes.frame)) + 1
    frames = stripes.frame[np.append(0, first)]
    repeated, beside = np.zeros(len(frames), bool), np.zeros(len(frames))
    rows = np.full((5, int(stripes.line.max()) + 1), np.nan)
    images = zip(np.split(stripes.line, first), np.split(stripes.centre_px, first), strict=True)
    for n, (line, centre) in enumerate(images):
        rows[:4], rows[4] = rows[1:], np.nan
        rows[4, line] = centre
        repeated[n] = len(line) >= FEWEST_LINES and np.array_equal(rows[3], rows[4], equal_nan=True)
        expected = np.median(rows[1:4], axis=0), 2 * rows[1] - rows[0], 2 * rows[3] - rows[4]
        deviation = np.abs(rows[2] - expected).min(axis=0)
        if np.count_nonzero(known := np.isfinite(deviation)) >= FEWEST_LINES:
            beside[n - 2] = np.median(deviation[known])
    bend = np.diff(stripes.centre_px, 2)[(np.diff(stripes.line, 2) == 0) & (np.diff(stripes.frame, 2) == 0)]
    noise = robust_std(np.append(bend, 0.0)) / math.sqrt(6)
    usual = np.quantile(beside[2:-2], _USUAL, method="lower") if len(frames) > 4 else np.zeros(2)
    strange = by_stage & (beside > max(_BESIDE_NOISE * noise, (usual * _BESIDE_OTHERS).min()))
    doubts = (
        (repeated, repeated, "is exactly that in the image before", "a repeated image, or images without noise"),
        (strange, beside, "is not between those of its neighbours", "exchanged images, some of another scan, or ribs"),
    )
    return [
        f"the stripe in {np.count_nonzero(found)} of {len(frames)} images {what}, such as in image "
        f"{frames[np.argmax(most)]}: {why}; check their positions"
        for found, most, what, why in doubts
        if found.any()
    ]


def _warn_of_smoothing(stripes: CaptureStripes) -> list[str]:
    """Return a warning if centres scatter over several lines by far more than from line to line."""
    some = stripes[:_NOISE_SAMPLED]
    try:
        ratio = measure_correlation(some.frame, some.line, some.centre_px)
    except CalibrationError:  # too few centres
        return []
    if ratio <= MOST_CORRELATED:
        return []
    return [
        f"means of four neighbouring stripe centres scatter {ratio:.1f} times as much as their noise from line to line "
        "allows: the surface is wavy over a few lines, or the camera smooths or compresses its images, and the "
        "uncertainty of points is stated too small; record raw images without noise reduction"
    ]


def _triangulate(
    capture: Capture | FrameTable,
    calibration: AnyCalibration,
    stripes: CaptureStripes,
    index: float,
    sheet: IlluminatedPoints | None,
) -> MeasuredPoints:
    """Triangulate stripe centres with any kind of calibration to points in the OCS, moved by the stage."""
    direction = np.array(capture.header.stage_direction)
    # A rolling shutter exposes each row at its own time, and hence at its own position of a moving stage.
    stage = capture.stage_mm[stripes.frame] + capture.speed_mm_per_s[stripes.frame] * _time_rows_s(capture, stripes)
    line, centre = stripes.line, stripes.centre_px
    if isinstance(calibration, PolynomialCalibration):
        return reconstruct_by_polynomials(calibration, line, centre, stage_mm=stage, stage_direction=direction)
    direction = np.array(calibration.stage_direction_of(capture.header.stage_direction))
    if sheet is not None:
        return replace(sheet.found, points_mm=sheet.found.points_mm + stage_travel(stage, direction).T)
    if not capture.header.sensor.camera.window.mounted:
        calibration = calibration.model_copy(update={"window": None})
    return reconstruct_profile(calibration, line, centre, medium_index=index, stage_mm=stage, stage_direction=direction)


def _time_rows_s(capture: Capture | FrameTable, stripes: CaptureStripes) -> np.ndarray | float:
    """Return the exposure delay (N,), s, of the rows of stripe centres relative to the central row."""
    camera, detector = capture.header.sensor.camera, capture.header.sensor.detector
    if detector.shutter == "global":
        return 0.0
    row = stripes.centre_px if camera.stripe_along == "width" else stripes.line
    return 1e-6 * detector.line_time_us * (row - (camera.height_px - 1) / 2)


def _describe_footprint(capture: Capture | FrameTable, sheet: IlluminatedPoints, stripes: CaptureStripes) -> Table:
    """Return metadata on the footprint of a point on the surface; empty without a point."""
    if not (sheet.found.status == RayStatus.OK).any():
        return {}
    std = footprint_std(capture.header.sensor.uncertainty)
    return {FOOTPRINT: list(sheet.footprint_mm(stripes.width_px)), FOOTPRINT_STD: std}


def _apply_poses(points: np.ndarray, capture: Capture | FrameTable, frame: np.ndarray) -> np.ndarray:
    """Apply full poses ``T_scene_object`` in place of the stage motion, for frames that have them."""
    poses = sensor_poses(capture)
    posed = np.asarray(np.isfinite(poses).all(axis=(1, 2)))
    if not posed.any():
        return points
    with_pose = slice(None) if posed[frame].all() else posed[frame]
    at, direction = frame[with_pose], np.array(capture.header.stage_direction)
    by_sensor = points[with_pose] - capture.stage_mm[at, None] * direction
    placed = np.empty_like(by_sensor)
    _place(poses, at, by_sensor, placed)
    points = points.copy()
    points[with_pose] = placed
    return points


@compiled
def _place(poses: np.ndarray, image: np.ndarray, by_sensor: np.ndarray, placed: np.ndarray) -> None:
    """Fill ``placed`` (N, 3) with points (N, 3) of the sensor's frame, transformed by poses of their images."""
    for n in range(image.size):
        pose, x, y, z = poses[image[n]], by_sensor[n, 0], by_sensor[n, 1], by_sensor[n, 2]
        for axis in range(3):
            placed[n, axis] = pose[axis, 0] * x + pose[axis, 1] * y + pose[axis, 2] * z + pose[axis, 3]
