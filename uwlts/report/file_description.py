"""Reading of any file of the program, and descriptions of files and sensors for the terminal."""

import math
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path

import numpy as np
from pydantic import JsonValue
from scipy.spatial.transform import Rotation

from uwlts.errors import CaptureError, Error
from uwlts.evaluation.evaluate import FORMAT as EVALUATION, Evaluation, read_evaluation
from uwlts.files.json_files import numbers_in, read_json
from uwlts.files.reading import MOST_TOML_BYTES, is_regular_file, parse_toml, read_text, require_regular_file
from uwlts.model.calibration import AnyCalibration, Calibration, PolynomialCalibration
from uwlts.model.library import load_sensor
from uwlts.model.mount import FORMAT as MOUNT, BoardFound, Mount, SphereFound
from uwlts.model.placement import check_design, view_of_sheet
from uwlts.model.sensor import Medium, Sensor
from uwlts.model.trajectory import Trajectory, format_time
from uwlts.report.certificate import parameter_rows
from uwlts.storage.calibration_file import FORMAT as CALIBRATION, POLYNOMIALS_FORMAT, load_calibration
from uwlts.storage.capture import FORMAT as CAPTURE, Capture
from uwlts.storage.cloud import PointCloud
from uwlts.storage.cloud_files import CLOUD_ENDINGS, is_readable_cloud, read_cloud
from uwlts.storage.figure_table import FORMAT as FIGURES, FigureTable, read_figures
from uwlts.storage.hdf5_file import read_format
from uwlts.storage.mount_files import read_mount
from uwlts.storage.number_tables import Unit
from uwlts.storage.pose_files import SAVED_FORMAT, PoseFormat, holds_trajectory, read_trajectory
from uwlts.storage.truth import FORMAT as TRUTH, Truth, TruthHeader, TruthStatus, read_truth

_TABLES = (".csv", ".txt", ".asc")  # endings of text with a cloud or a trajectory
_Stored = AnyCalibration | Mount | Evaluation | FigureTable
_Readable = Capture | PointCloud | Truth | Trajectory | _Stored
_JSON_READERS: dict[str, Callable[[Path], _Stored]] = {
    CALIBRATION: load_calibration,
    POLYNOMIALS_FORMAT: load_calibration,
    MOUNT: read_mount,
    EVALUATION: read_evaluation,
    FIGURES: read_figures,
}
_READABLE = (
    f"captures and ground truth (.h5), clouds ({', '.join(CLOUD_ENDINGS)}), "
    "calibrations, mounts, figures and evaluations (.json), trajectories (.csv, .tum, ROS bags)"
)


def read(
    path: str | Path, *, pose_format: PoseFormat = SAVED_FORMAT, pose_unit: Unit | None = None, unit: Unit | None = None
) -> _Readable:
    """Read a file of the program, whose content determines the type of the result.

    Text with times and rotations is a trajectory. The metadata of a capture's frames are read at once, and images on
    demand: ``capture[12]`` is a `Frame`. A recording in progress can be opened by its name ``NAME.part``.

    Parameters
    ----------
    path : str or Path
        The file.
    pose_format : str
        Format of a trajectory, as for `reconstruct`; by default that of `Trajectory.save`.
    pose_unit : {"mm", "m"}, optional
        Unit of a trajectory's positions; by default that in the names of its columns, else mm.
    unit : {"mm", "m"}, optional
        As for `export`.

    Returns
    -------
    Capture, PointCloud, Truth, Mount, Evaluation, FigureTable, Trajectory or a calibration
        An opened capture must be closed, or used in a ``with`` statement.

    Raises
    ------
    CaptureError
        The file is missing, damaged, of a newer version, or of an unknown kind.
    DescriptionError
        A trajectory does not have the format.

    Examples
    --------
    >>> uwlts.read("spheres.ply").points_mm.shape
    >>> with uwlts.read("spheres.h5") as capture:
    ...     images = [frame.image for frame in capture if frame.laser_on]
    """
    path = Path(path)
    pose_format = "tum" if path.suffix.lower() == ".tum" else pose_format
    if pose_format.partition(":")[0] in ("ros", "tum"):
        return read_trajectory(path, pose_format=pose_format, unit=pose_unit)
    require_regular_file(path)
    ending = next((each for each in reversed(path.suffixes) if each != ".part"), "")
    if ending == ".json":
        found = read_json(path, called="file of this program", check_seal=False).get("format")
        if (reader := _JSON_READERS.get(str(found))) is None:
            raise CaptureError(f"{path} is JSON of the format {found!r}; this reads {_READABLE}")
        return reader(path)
    if ending.lower() in _TABLES and (pose_format != SAVED_FORMAT or holds_trajectory(path)):
        return read_trajectory(path, pose_format=pose_format, unit=pose_unit)
    if is_readable_cloud(path):
        return read_cloud(path, unit=unit)
    if ending == ".h5":
        found = read_format(path)
        if found == TRUTH:
            return read_truth(path)[1]
        if found in (CAPTURE, None):
            return Capture(path)
        raise CaptureError(f"{path} is HDF5 of the format {found!r}; this reads {_READABLE}")
    raise CaptureError(f"{path} ends with {path.suffix or 'no ending'}; this reads {_READABLE}")


_DESCRIPTIONS = (
    ("campaign", ({"recordings"},), "twin predict --campaign, twin experiment --campaign"),
    ("data set", ({"vary"},), "twin dataset"),
    ("design study", ({"variables", "title"}, {"choices", "title"}), "twin sweep"),
    ("scene", ({"objects"}, {"motion"}), "twin simulate"),
    ("plan of a scan", ({"title", "stage", "sensor"},), "uwlts scan"),
    ("description of a folder of images", ({"stage", "sensor"},), "uwlts import"),
    ("target", ({"kind", "columns", "rows"},), "uwlts import and uwlts camera --target"),
    ("order of a report", ({"datum"}, {"client"}, {"limits"}), "uwlts findings-report --order"),
)
"""Kinds of descriptions in the order of recognition, alternative keys, and the command that uses them."""
_RESULTS = {  # JSON without a reader by its format; a plan has none
    "twin-experiment": "result of an experiment",
    "uwlts-verification": "result of a verification",
    "uwlts-dataset": "card of a data set",
    "uwlts-measured-values": "measured values of a report",
    "plan": "plan of recordings",
}


def describe(path: str | Path, *, unit: Unit | None = None, pose_format: PoseFormat = SAVED_FORMAT) -> str:
    """Describe a file that `read` reads, a sensor (by name or path), or a plan.

    Parameters
    ----------
    path : str or Path
        File, folder, or name of a shipped sensor such as thesis.
    unit : {"mm", "m"}, optional
        As for `export`.
    pose_format : str
        Format of a trajectory, such as euler-ZYX-deg, tum or ros, as for `reconstruct`.

    Returns
    -------
    str
        Several lines of text.

    Raises
    ------
    CaptureError, DescriptionError
        The file is missing, damaged, or of another kind.
    """
    name, path = str(path), Path(path)
    endings = [each for each in path.suffixes if each != ".part"]
    if path.is_dir() and pose_format == SAVED_FORMAT:
        lines = [f"{each.name}: {_summarise(each)}" for each in sorted(path.iterdir())]
    elif (not endings and not path.is_dir()) or endings[-1:] == [".toml"]:
        lines = _name_description(path) or sensor_lines(load_sensor(name))
    elif endings[-2:] == [".truth", ".h5"] or (endings[-1:] == [".h5"] and read_format(path) == TRUTH):
        lines = truth_lines(*read_truth(path))
    else:
        try:
            lines = _describe_content(read(path, unit=unit, pose_format=pose_format))
        except CaptureError:
            if not (lines := _name_result(path)):
                raise
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise CaptureError(f"{path} is damaged: a value is missing or not a number ({error})") from error
    return "\n".join(lines)


def _summarise(path: Path) -> str:
    """Return the first line of a file's description."""
    with suppress(Error):
        return "folder" if path.is_dir() else describe(path).partition("\n")[0]
    return "not a file that `uwlts info` describes"


def _name_description(path: Path) -> list[str]:
    """Return what a description other than a sensor's is, by its keys; empty for a sensor or none of them."""
    table: dict[str, JsonValue] = {}
    if path.suffix == ".toml" and is_regular_file(path):
        with suppress(ValueError):
            table = parse_toml(read_text(path, most_bytes=MOST_TOML_BYTES, called="description"))
    for kind, some, command in _DESCRIPTIONS:
        if any(table.keys() >= keys for keys in some):
            title = table.get("title") or table.get("name")
            return [kind + (f": {title}" if title else ""), f"with {', '.join(table)}", f"used by {command}"]
    return []


def _name_result(path: Path) -> list[str]:
    """Return what JSON without a reader is; empty for other files."""
    table = read_json(path, called="file of this program", check_seal=False) if path.suffix == ".json" else {}
    kind = _RESULTS.get(str(table.get("format", "plan" if "variant" in table else None)))
    title = f": {table['title']}" if "title" in table else ""
    return [f"{kind}{title}", f"with {', '.join(table)}"] if kind else []


def _describe_content(found: object) -> list[str]:
    if isinstance(found, Capture):
        with found:
            return capture_lines(found)
    return _LINES.get(type(found), lambda other: repr(other).splitlines())(found)


def capture_lines(capture: Capture) -> list[str]:
    """Describe the content of a capture."""
    header, camera = capture.header, capture.header.sensor.camera
    laser = int(capture.laser_on.sum())
    lines = [
        f"capture of the sensor '{header.sensor.name}' in {header.medium_name} "
        f"({_describe(header.medium, header.sensor)})",
        f"{len(capture)} frames of {camera.width_px} x {camera.height_px} pixels, {laser} with the laser on"
        + ("" if capture.finished else "; the recording was interrupted"),
    ]
    if len(capture):
        exposures = ", ".join(f"{value:.3g}" for value in np.unique(capture.exposure_ms))
        lines.append(
            f"stage from {capture.stage_mm.min():.3f} to {capture.stage_mm.max():.3f} mm along OCS "
            f"{tuple(round(x, 4) for x in header.stage_direction)}; exposure {exposures} ms"
        )
    origin = header.provenance or {"unknown": ""}
    for name, table in {"target": header.target, "artefact": header.artefact, "recorded by": origin}.items():
        if table:
            lines.append(f"{name}: {', '.join(f'{key} {value}'.rstrip() for key, value in table.items())}")
    return lines


def truth_lines(header: TruthHeader, truth: Truth) -> list[str]:
    """Describe the content of a ground-truth file."""
    frames, lines = truth.status.shape
    visible = int(np.count_nonzero(truth.status == TruthStatus.VISIBLE))
    return [
        f"ground truth of the sensor '{header.sensor.name}' ({_describe(header.medium, header.sensor)})",
        f"{frames} frames of {lines} profile lines, {visible} of them show the stripe",
    ]


def cloud_lines(cloud: PointCloud) -> list[str]:
    """Describe the content of a cloud."""
    if len(cloud) == 0:
        return ["cloud without points", *(f"{key}: {value}" for key, value in cloud.metadata.items())]
    low, high = cloud.points_mm.min(axis=0), cloud.points_mm.max(axis=0)
    lines = [f"cloud of {len(cloud):,} points from {len(np.unique(cloud.frame))} frames"]
    lines += [f"{axis}: {a:.3f} to {b:.3f} mm" for axis, a, b in zip("XYZ", low, high, strict=True)]
    if cloud.deviation_mm is not None and np.isfinite(cloud.deviation_mm).any():
        lines.append(f"deviation: standard deviation {np.nanstd(cloud.deviation_mm):.4f} mm")
    return lines + [
        f"{key}: {value:.4g}" if isinstance(value, float) else f"{key}: {value}"
        for key, value in cloud.metadata.items()
    ]


def trajectory_lines(path: Trajectory) -> list[str]:
    """Describe times, positions and the axes of the first and last pose of a trajectory."""
    ends = [format_time(path.times_s[place]) for place in (0, -1)]
    low, high = path.poses[:, :3, 3].min(axis=0), path.poses[:, :3, 3].max(axis=0)
    lines = [f"trajectory of {len(path.times_s)} poses from {ends[0]} to {ends[1]}"]
    lines += [f"{axis}: {a:.3f} to {b:.3f} mm" for axis, a, b in zip("XYZ", low, high, strict=True)]
    for which, pose in (("first", path.poses[0]), ("last", path.poses[-1])):
        axes = (f"{axis} along {_describe_direction(pose[:3, k])}" for k, axis in enumerate("xyz"))
        lines.append(f"axes of the platform in the {which} pose: {', '.join(axes)}")
    return lines


def _describe_direction(vector: np.ndarray) -> str:
    """Return a unit vector as the base's axis that is nearest, with the angle from it."""
    nearest = int(np.argmax(np.abs(vector)))
    angle = np.degrees(np.arccos(min(1.0, abs(vector[nearest]))))
    return f"{'-' if vector[nearest] < 0 else '+'}{'XYZ'[nearest]}" + (f" ({angle:.0f} deg off)" if angle >= 1 else "")


_MEDIA = {"air": "air", "fresh": "fresh water", "sea": "sea water", "custom": "the medium of its images"}


def calibration_lines(calibration: Calibration) -> list[str]:
    """Describe parameters and residuals of a calibration."""
    camera, window, sheet = calibration.camera, calibration.window, calibration.sheet
    lines = [
        f"calibration of the sensor '{calibration.sensor_name}' "
        f"({calibration.provenance.get('source', 'unknown source')})",
        f"camera: f {camera.fx_px:.2f} x {camera.fy_px:.2f} px, centre {camera.cx_px:.2f}, {camera.cy_px:.2f} px, "
        + ", ".join(f"{name} {value:.5f}" for name, value in camera.distortion.used_coefficients().items()),
        f"sheet: normal {', '.join(f'{x:.6f}' for x in sheet.normal)}, offset {sheet.offset_mm:.4f} mm",
    ]
    if window is None:
        kind = _MEDIA[calibration.medium_kind]
        view = "" if calibration.medium_kind == "air" else ", as seen from a single viewpoint"
        lines.append(f"window: none; for use in {kind} only{view}")
    else:
        glass = (
            f", glass {window.thickness_mm:g} mm of index {window.glass_index:.4f}" if window.refractions == 2 else ""
        )
        lines.append(
            f"window: {window.refractions} refraction(s), {window.distance_mm:.3f} mm from the entrance pupil{glass}"
        )
    lines += _list_figures(
        calibration, camera=("rms_px", "camera residual: {:.4f} px"), sheet=("rms_mm", "sheet residual: {:.4f} mm")
    )
    lines += _list_images(calibration.figures("camera"), calibration.figures("sheet"))
    lines += _list_parameters(calibration)
    if (joint := calibration.joint) is not None:
        scatter = ", ".join(f"{kind} {value:.3f} px" for kind, value in joint.scatter_px.items())
        lines.append(f"scatter: {scatter}; {joint.outlier_count} of {joint.residual_count} residuals left out")
    return lines


def _list_images(camera: Mapping[str, JsonValue], sheet: Mapping[str, JsonValue]) -> list[str]:
    """Describe the lens model and the result of each target image; empty if the calibration does not contain them."""
    table = camera.get("image_table")
    if not isinstance(table, list):
        return []
    tried, share = camera.get("models_tried"), camera.get("rejected_share")
    best = f", the best of {len(tried)} models" if isinstance(tried, list) and tried else ""
    lines = [
        f"lens: {camera.get('lens_model')}{best}",
        f"images of the target: {len(table)} used, {camera.get('images_left_out')} left out, and "
        f"{100 * share if isinstance(share, float) else math.nan:.1f} % of the points of those used",
        "  points  misses/px  moves/sigma  stripe  outliers  image",
    ]
    for row in table:
        if isinstance(row, dict):
            points, rms, moves, stripe, outliers, name = (
                row.get(key) for key in ("points", "rms_px", "moves", "stripe_points", "stripe_outliers", "image")
            )
            moved = f"{moves:11.2f}" if isinstance(moves, float) else f"{'-':>11}"
            lines.append(f"  {points:6}  {rms:9.3f}  {moved}  {stripe:6}  {outliers:8}  {name}")
    halves, difference_deg = camera.get("halves"), sheet.get("halves_apart_deg")
    one, two = map(numbers_in, halves) if isinstance(halves, list) and len(halves) == 2 else ({}, {})
    by_half = [f"{name} {one[name]:.6g} and {two[name]:.6g}" for name in one if name in two]
    by_half += [f"sheets {difference_deg:.3f} deg apart"] if isinstance(difference_deg, float) else []
    return lines + ([f"by every second image and by the others: {', '.join(by_half)}"] if by_half else [])


def _list_parameters(calibration: Calibration) -> list[str]:
    """List the parameters if any uncertainty is known."""
    rows, direction_deg = parameter_rows(calibration), calibration.std().sheet_normal_deg
    if direction_deg is None and all(row.std is None for row in rows):
        return []
    lines = ["standard uncertainties after calibration, and in brackets before:"]
    for row in rows:
        std = "" if row.std is None else f" ± {row.std:.2g}"
        before = "" if row.std_before is None else f" ({row.std_before:.2g})"
        lines.append(f"  {row.words}: {row.value:.6g}{std}{before} {row.unit}".rstrip())
    return lines if direction_deg is None else [*lines, f"  direction of the sheet's normal: ± {direction_deg:.2g} °"]


def _list_figures(calibration: Calibration | PolynomialCalibration, **shown: tuple[str, str]) -> list[str]:
    """Format figures of calibration steps, each given by name and text."""
    found = ((calibration.figures(step).get(name), text) for step, (name, text) in shown.items())
    return [text.format(value) for value, text in found if value is not None]


def mount_lines(mount: Mount) -> list[str]:
    """Describe the transform with 95 % intervals, the artefact, the scatter, rejected poses and the next pose."""

    def within(std: float | None) -> str:
        return "given" if std is None else f"+-{mount.coverage_factor * std:.3f}"

    half = mount.coverage_factor * mount.std()
    transform = mount.transform()
    rotation = Rotation.from_matrix(transform[:3, :3])
    used = [pose for pose in mount.poses if pose.reason is None]
    lines = ["T_platform_sensor (x y z of the sensor -> platform, mm):"]
    lines += ["  " + " ".join(f"{value:12.6f}" for value in row) for row in transform]
    lines += [
        f"  quaternion x y z w      {' '.join(f'{value:10.7f}' for value in rotation.as_quat())}",
        f"  Euler angles ZYX deg    {' '.join(f'{value:10.4f}' for value in rotation.as_euler('ZYX', degrees=True))}",
        f"translation, 95 % mm      {' '.join(f'+-{value:.3f}' for value in half[:3])}",
        f"rotation, 95 % deg        {' '.join(f'+-{value:.4f}' for value in np.degrees(half[3:]))}",
    ]
    found = mount.artefact
    if isinstance(found, BoardFound):
        x, y, z = (row[3] for row in found.T_base_target[:3])
        lines.append(f"target, mm                origin at {_format((x, y, z))}")
    elif isinstance(found, SphereFound):
        known = within(found.radius_std_mm)
        lines.append(f"sphere, mm                at {_format(found.centre_mm)}, radius {found.radius_mm:.3f} ({known})")
    else:
        lines.append(f"plane                     normal {_format(found.normal)}, distance {found.distance_mm:.3f} mm")
    if mount.robot_scale is not None and mount.robot_scale_std is not None:
        half_scale = mount.coverage_factor * mount.robot_scale_std
        lines.append(f"robot's scale             {mount.robot_scale:.6f} +-{half_scale:.6f}")
    if mount.time_offset_s is not None and mount.time_offset_std_s is not None:
        half_time = mount.coverage_factor * mount.time_offset_std_s
        lines.append(f"time offset, s            {mount.time_offset_s:.5f} +-{half_time:.5f}")
    lines += [
        f"scatter found, mm         points {mount.point_std_mm:.4f}, positions of the platform {mount.pose_std_mm:.4f}",
        f"distances rms, mm         {mount.rms_mm:.4f}; of poses held out {mount.held_out_rms_mm:.4f}",
        f"poses used                {len(used)} of {len(mount.poses)}",
    ]
    lines += [f"  left out {pose.name}: {pose.reason}" for pose in mount.poses if pose.reason is not None]
    if (advised := mount.next_pose) is not None:
        lines.append(
            f"next pose                 {advised.words}: points known to {advised.after_mm:.4f} mm in place of "
            f"{advised.before_mm:.4f} mm"
        )
    return lines


def _format(values: tuple[float, float, float]) -> str:
    return f"({', '.join(f'{value:.3f}' for value in values)})"


def polynomial_lines(calibration: PolynomialCalibration) -> list[str]:
    """Describe range and residuals of a polynomial calibration."""
    last = calibration.first_line + len(calibration.domains_px) - 1
    reached = sum(domain is not None for domain in calibration.domains_px)
    low, high = calibration.depth_range_mm
    lines = [
        f"polynomials of the sensor '{calibration.sensor_name}' in {calibration.medium_name} "
        f"({calibration.provenance.get('source', 'unknown source')})",
        f"degree {calibration.degree}, for {reached} of the lines {calibration.first_line} to {last}, Z from {low:.1f} "
        f"to {high:.1f} mm",
    ]
    return lines + _list_figures(
        calibration,
        depth=("rms_mm", "Z(position): residual {:.4f} mm (rms)"),
        along=("rms_mm", "Y(Z): residual {:.4f} mm (rms)"),
        map=("rms_mm", "target's points on the plate: residual {:.4f} mm (rms)"),
    )


def evaluation_lines(record: Evaluation) -> list[str]:
    """Describe the figures of an evaluation."""
    lines = [f"evaluation of {record.source}"]
    if evaluation := record.evaluation:
        for name, value in evaluation.figures_mm.items():
            known = record.uncertainty.get(name)
            expanded = " mm" if known is None else f" ± {known.expanded_mm:.4f} mm (k = 2)"
            lines.append(f"  {name}: {value:+.4f}{expanded}")
        used, rejected, total = evaluation.points_used, evaluation.points_rejected, evaluation.points_total
        strange = f"{total - used - rejected} ({100 * evaluation.strange_share:.1f} %) on no artefact"
        lines.append(f"  points: {used} used, {rejected} rejected, {strange}")
    if truth := record.truth:
        for name, part in (("against truth", truth), ("the same after a best-fit motion", truth.after_best_fit)):
            if part is not None:
                lines.append(
                    f"  {name}: rms {part.rms_mm:.4f} mm, 99 % within {part.p99_mm:.4f} mm, "
                    f"{100 * part.share_within_tolerance:.1f} % within {part.tolerance_mm:g} mm"
                )
        if truth.shift_mm is not None:
            stated = [f" ± {each:.4f}" for each in truth.shift_expanded_mm or ()] or [""] * 3
            shift = (f"{axis} {value:+.4f}{u} mm" for axis, value, u in zip("XYZ", truth.shift_mm, stated, strict=True))
            lines.append(f"  shift of all points: {', '.join(shift)}{' (k = 2)' if truth.shift_expanded_mm else ''}")
        lines.append(f"  {truth.missed} stripe points missed, {truth.false_points} false")
    return lines


def sensor_lines(sensor: Sensor) -> list[str]:
    """Describe the views of a sensor in each of its media."""
    laser = sensor.laser
    lines = [f"sensor '{sensor.name}': {sensor.notes}", f"image {sensor.camera.width_px} x {sensor.camera.height_px}"]
    if laser.baseline_mm is not None:
        lines.append(f"baseline {laser.baseline_mm:g} mm, triangulation angle {laser.triangulation_angle_deg:g} deg")
    for name, medium in sensor.media.items():
        view = check_design(sensor, medium)
        lines.append(
            f"{name} ({_describe(medium, sensor)}): stand-off {view.standoff_mm:.1f} mm outside the window, sheet in "
            f"view from {view.nearest_mm:.1f} to {view.farthest_mm:.1f} mm"
        )
        length, along = view_of_sheet(sensor, medium).line_length_mm, sensor.camera.stripe_along
        lines.append(f"  line length at the stand-off, stripe along the {along} side: {length:.1f} mm")
    return lines


def _describe(medium: Medium, sensor: Sensor) -> str:
    index = medium.refractive_index(sensor.laser.wavelength_nm)
    water = f", {medium.temperature_c:g} degC, {medium.salinity_g_kg:g} g/kg" if medium.kind in ("fresh", "sea") else ""
    return f"{medium.kind}, n {index:.5f}{water}"


_LINES: dict[type, Callable[..., list[str]]] = {
    Calibration: calibration_lines,
    PolynomialCalibration: polynomial_lines,
    Evaluation: evaluation_lines,
    Mount: mount_lines,
    PointCloud: cloud_lines,
    Trajectory: trajectory_lines,
}
