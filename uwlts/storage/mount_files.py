"""Files of a mount's calibration: profiles of scanners of any make, and `mount.json`."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import model_validator
from scipy.spatial.transform import Rotation

from uwlts.errors import DescriptionError
from uwlts.files.json_files import read_model
from uwlts.files.reading import log_warnings, natural_key
from uwlts.files.writing import hash_file
from uwlts.model.library import validate_description
from uwlts.model.mount import FORMAT, VERSION, Mount
from uwlts.model.sensor import Description, Positive, Table
from uwlts.storage.cloud_files import is_cloud, read_cloud
from uwlts.storage.number_tables import NumberTable, Unit, read_number_table
from uwlts.storage.numbering import count_names, name_gaps
from uwlts.storage.pose_files import FARTHEST_MM, check_matrices, read_poses

Artefact = Literal["sphere", "plane"]
SensorAxis = Literal["x", "-x", "y", "-y", "z", "-z"]
SENSOR_AXES: dict[SensorAxis, np.ndarray] = {
    sign + name: (-1.0 if sign else 1.0) * direction  # pyright: ignore[reportAssignmentType]
    for sign in ("", "-")
    for name, direction in zip("xyz", np.eye(3), strict=True)
}
_ON_AXIS = 1e-6
"""Tolerance for rotations about a table's axis, in mm and as a ratio, for numbers printed with six decimals."""

_NARROWEST_MM = 1.0
"""Profiles of profilers are several millimetres to metres long; in metres, those of up to a metre are shorter."""
_NEAREST_MM, _TURNED = 10.0, np.radians(5)
"""A platform whose positions are all this near to its base's origin does not keep an artefact in view while it turns;
positions in metres of robots of up to ten metres are nearer."""


class MountOptions(Description):
    """Artefact, formats of files, and unknowns of a mount's calibration.

    Units are for files without a unit in the names of their columns. ``axis`` is the direction of the sensor's frame
    nearest to the axis of a rotary table. ``scale`` and ``time`` ask for the scale of the robot's lengths and the
    offset of its clock.
    """

    artefact: Artefact = "sphere"
    radius_mm: Positive | None = None
    pose_format: str = "matrix"
    profile_unit: Unit | None = None
    pose_unit: Unit | None = None
    axis: SensorAxis | None = None
    scale: bool = False
    time: bool = False

    @model_validator(mode="after")
    def _check_artefact(self) -> "MountOptions":
        if self.radius_mm is not None and self.artefact != "sphere":
            raise ValueError(f"a {self.artefact} has no radius: leave radius_mm out")
        return self


@dataclass(frozen=True, eq=False, kw_only=True)
class MountEvidence:
    """Profiles in mm, NaN for missing points, and the platform's poses (M, 4, 4): one per profile, or a trajectory."""

    profiles: list[np.ndarray]
    poses: np.ndarray
    options: MountOptions
    names: list[str]
    profile_times_s: np.ndarray | None = None
    pose_times_s: np.ndarray | None = None
    digests: dict[str, str] = field(default_factory=dict)


def read_mount_evidence(
    profiles: str | Path | Sequence[np.ndarray],
    poses: str | Path | np.ndarray | None,
    options: Table,
    *,
    profile_times_s: np.ndarray | None,
    pose_times_s: np.ndarray | None,
) -> MountEvidence:
    """Read and check profiles and poses from arrays or files.

    ``options`` are the given ones of `MountOptions`. Times (N,) belong to arrays. Raises DescriptionError if profiles
    and poses do not match, or one of them is not valid.
    """
    given = [Path(each) for each in (profiles, poses) if isinstance(each, str | Path)]
    names: list[str] | None = None
    chosen = validate_description(MountOptions, options, "what is given")
    if poses is None:
        raise DescriptionError("the poses are missing: give T_base_platform of every profile")
    if isinstance(profiles, str | Path):
        names, profiles, times = read_profiles(profiles, unit=chosen.profile_unit)
        profile_times_s = times if profile_times_s is None else profile_times_s
    if isinstance(poses, str | Path):
        poses, times = read_poses(poses, pose_format=chosen.pose_format, unit=chosen.pose_unit)
        pose_times_s = times if pose_times_s is None else pose_times_s
    checked = [_check_profile(profile, number) for number, profile in enumerate(profiles)]
    matrices = check_matrices(np.asarray(poses, dtype=np.float64), "poses")
    if chosen.axis is not None:
        if chosen.artefact != "sphere" or chosen.scale:
            raise DescriptionError(
                "from profiles, the axis of a rotary table is found with a sphere on it, without a scale"
            )
        require_table(matrices)
    if chosen.time and (profile_times_s is None or pose_times_s is None):
        raise DescriptionError("a time offset needs the times of profiles and poses: give both a column time_s")
    if profile_times_s is not None and pose_times_s is not None and (chosen.time or len(matrices) != len(checked)):
        profile_times_s, pose_times_s = _check_times(profile_times_s, pose_times_s, len(checked), len(matrices))
    else:
        profile_times_s = pose_times_s = None
        if len(matrices) != len(checked):
            raise DescriptionError(
                f"there are {len(checked)} profiles and {len(matrices)} poses; expected one pose for each profile"
            )
    if not checked:
        raise DescriptionError("there are no profiles")
    _refuse_metres(checked, matrices)
    return MountEvidence(
        profiles=checked,
        poses=matrices,
        options=chosen,
        names=names or [str(number + 1) for number in range(len(checked))],
        profile_times_s=profile_times_s,
        pose_times_s=pose_times_s,
        digests={file.name: hash_file(file) for each in given for file in _list_files(each)},
    )


def _refuse_metres(profiles: list[np.ndarray], poses: np.ndarray) -> None:
    """Raise DescriptionError for profiles or positions (P, 4, 4) that are too small to be in mm."""
    seen = [np.ptp(known, axis=0).max() for points in profiles if len(known := points[np.isfinite(points).all(axis=1)])]
    if seen and np.median(seen) < _NARROWEST_MM:
        raise DescriptionError(
            f"the profiles are only {np.median(seen):.3g} mm long: if they are in metres, give `profile_unit` m"
        )
    farthest = np.abs(poses[:, :3, 3]).max()
    turned = Rotation.from_matrix(poses[0, :3, :3].T @ poses[:, :3, :3]).magnitude().max()
    if 0 < farthest < _NEAREST_MM and turned > _TURNED:
        raise DescriptionError(
            f"the platform turns by {np.degrees(turned):.3g} deg and stays within {farthest:.3g} mm of its base: if "
            "its positions are in metres, give `pose_unit` m"
        )


def require_table(poses: np.ndarray) -> None:
    """Raise DescriptionError if poses (P, 4, 4) are not rotations about a table's z axis."""
    turns = np.linalg.inv(poses[0]) @ poses
    if max(np.abs(turns[:, 2] - (0, 0, 1, 0)).max(), np.abs(turns[:, :2, 3]).max()) > _ON_AXIS:
        raise DescriptionError(
            "the poses are not rotations about one z axis: give the angles of the rotary table (pose format angle-deg)"
        )


def _check_profile(profile: np.ndarray, number: int) -> np.ndarray:
    points = np.asarray(profile, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] not in (2, 3):
        raise DescriptionError(
            f"profile {number + 1} has the shape {points.shape}; expected (N, 2) with x and z or (N, 3) with x, y and z"
        )
    points = np.where(np.isfinite(points), points, np.nan)
    if np.any(np.abs(points) > FARTHEST_MM):
        raise DescriptionError(f"profile {number + 1} has points beyond {FARTHEST_MM:g} mm: is its unit right?")
    return points


def _check_times(
    profile_times_s: np.ndarray, pose_times_s: np.ndarray, profiles: int, poses: int
) -> tuple[np.ndarray, np.ndarray]:
    wanted, times = np.asarray(profile_times_s, dtype=np.float64), np.asarray(pose_times_s, dtype=np.float64)
    if wanted.shape != (profiles,) or times.shape != (poses,):
        raise DescriptionError(
            f"there are {wanted.size} times of {profiles} profiles and {times.size} of {poses} poses"
        )
    if not (np.isfinite(wanted).all() and np.isfinite(times).all() and (np.diff(times) > 0).all() and poses > 1):
        raise DescriptionError("times must be finite, and those of the poses must increase")
    outside = int(np.count_nonzero((wanted < times[0]) | (wanted > times[-1])))
    if outside:
        raise DescriptionError(f"{outside} of {profiles} profiles were taken before the first or after the last pose")
    return wanted, times


def _list_files(path: Path) -> list[Path]:
    """Return the CSV files of a folder, in the order of the numbers in their names, or a file alone."""
    if not path.is_dir():
        return [path]
    return sorted((each for each in path.iterdir() if each.suffix.lower() == ".csv"), key=lambda p: natural_key(p.name))


def read_profiles(
    path: str | Path, *, unit: Unit | None = None
) -> tuple[list[str], list[np.ndarray], np.ndarray | None]:
    """Read names, profiles (N, 2) or (N, 3) in mm, and times of profiles (or None) from files.

    A folder contains one CSV file for each pose, in the order of the numbers in their names. A single CSV file contains
    all profiles, with a column ``pose``. Columns are x and z, y for 3D points, and ``time_s``; two columns without
    names are x and z. Empty or NaN cells are missing points. In a cloud of the program, the points of pose n are in
    frame n. Raises DescriptionError for anything else.
    """
    path = Path(path)
    if path.is_dir():
        if not (files := _list_files(path)):
            raise DescriptionError(f"{path} holds no CSV files: expected one for each pose")
        listed = [file.name for file in files]
        log_warnings(path, name_gaps(listed, count_names(listed, series=True)))
        names, profiles, times = [], [], []
        for file in files:
            table = read_number_table(file)
            names.append(file.stem)
            profiles.append(_read_points(table, unit))
            times.append(float(next(iter(table.columns.get("time_s", ())), np.nan)))
    elif path.suffix.lower() in (".ply", ".h5") and is_cloud(path):
        cloud = read_cloud(path)
        frames = np.unique(cloud.frame)
        return [str(frame) for frame in frames], [cloud.points_mm[cloud.frame == frame] for frame in frames], None
    else:
        table = read_number_table(path)
        columns = table.columns
        if "pose" not in columns:
            raise DescriptionError(f"{path} has no column 'pose', the pose to which each point belongs")
        poses, points = columns["pose"], _read_points(table, unit)
        if not np.isfinite(poses).all():
            raise DescriptionError(f"{path}: some cells of the column 'pose' are empty or not a number")
        labels = list(dict.fromkeys(poses.tolist()))
        names = [f"{label:g}" for label in labels]
        profiles = [points[poses == label] for label in labels]
        each = columns.get("time_s", np.full(len(poses), np.nan))
        times = [float(each[poses == label][0]) for label in labels]
    known = np.array(times)
    return names, profiles, known if np.isfinite(known).all() else None


def _read_points(table: NumberTable, unit: Unit | None) -> np.ndarray:
    """Return the points (N, 2) or (N, 3) of a table in mm."""
    columns = table.columns
    if not {"x", "z"} <= columns.keys():
        raise DescriptionError(f"{table.path} has the columns {table.titles}; expected x and z, and y for 3D points")
    return np.column_stack([columns[name] for name in "xyz" if name in columns]) * table.mm_per_unit(unit=unit)


def read_mount(path: str | Path) -> Mount:
    """Read a mount; raises CaptureError if the file is missing, foreign, newer or damaged."""
    return read_model(path, Mount, file_format=FORMAT, version=VERSION, called="mount")
