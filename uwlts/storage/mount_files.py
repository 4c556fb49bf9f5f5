"""Files of a mount's calibration: profiles of any maker's scanner, poses of any platform, and `mount.json`."""

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import Literal, get_args

import numpy as np
import pyarrow as pa
from pyarrow import csv
from scipy.spatial.transform import Rotation

from uwlts.model.calibration import is_rigid
from uwlts.model.errors import DescriptionError
from uwlts.model.input_file import read_bytes
from uwlts.model.library import read_table, validated
from uwlts.model.mount import Mount
from uwlts.model.sensor import Description, Positive
from uwlts.storage.cloud import is_cloud, read_cloud
from uwlts.storage.files import sha256_of
from uwlts.storage.import_.matching import natural_key
from uwlts.storage.json_files import read_model, write_model

FORMAT, VERSION = "uwlts-mount", 1
Unit = Literal["mm", "m"]
PoseFormat = str
"""matrix, quaternion-xyzw, quaternion-wxyz, rotvec-rad, rotvec-deg, or euler-ORDER-deg, euler-ORDER-rad."""

_MOST_BYTES = 512 * 2**20
_ROUNDED = 2e-3
"""Departure from a rigid matrix or a unit quaternion by three printed decimals."""
_EULER = re.compile(r"euler-([xyz]{3}|[XYZ]{3})-(deg|rad)")
_FORMATS = "matrix, quaternion-xyzw, quaternion-wxyz, rotvec-rad, rotvec-deg, euler-zyx-deg (fixed axes), euler-ZYX-deg"
_MOST_POSES = 20_000
_FARTHEST_MM = 1e7
"""Ten kilometres: no platform reaches farther, and squares of larger numbers would lose the noise."""
_OFTEN_MEANT = (
    "quaternion-xyzw",
    "quaternion-wxyz",
    "euler-ZYX-deg",
    "euler-zyx-deg",
    "euler-XYZ-deg",
    "euler-xyz-deg",
)
_OFTEN_MEANT += ("euler-ZYZ-deg", "rotvec-deg", "rotvec-rad", "euler-ZYX-rad", "euler-xyz-rad", "euler-XYZ-rad")
_MM = {"mm": 1.0, "m": 1000.0}


class MountDescription(Description):
    """Everything about a mount's calibration in a TOML file; files are sought beside it."""

    profiles: str
    poses: str
    artefact: Literal["sphere", "plane"] = "sphere"
    radius_mm: Positive | None = None
    pose_format: str = "matrix"
    profile_unit: Unit = "mm"
    pose_unit: Unit = "mm"
    scale: bool = False
    time: bool = False


@dataclass(frozen=True, eq=False, kw_only=True)
class MountEvidence:
    """Profiles with NaN where nothing was seen, mm, and the platform's poses (M, 4, 4): one each, or a trajectory."""

    profiles: list[np.ndarray]
    poses: np.ndarray
    artefact: Literal["sphere", "plane"]
    radius_mm: float | None = None
    names: list[str]
    scale: bool = False
    time: bool = False
    profile_times_s: np.ndarray | None = None
    pose_times_s: np.ndarray | None = None
    pose_format: str = "matrix"
    rows: np.ndarray | None = None
    digests: dict[str, str] = field(default_factory=dict)

    def other_readings(self) -> Iterator[tuple[str, np.ndarray]]:
        """The same numbers as poses of other formats, by which they are often meant."""
        if self.rows is None:
            return
        for name in _OFTEN_MEANT:
            if name != self.pose_format and self.rows.shape[1] == (7 if name.startswith("quaternion") else 6):
                try:
                    matrices = _matrices_of(self.rows, name, Path())
                except DescriptionError:
                    continue
                matrices[:, :3, 3] = self.poses[:, :3, 3]
                yield name, matrices


def read_mount_evidence(
    profiles: str | Path | Sequence[np.ndarray],
    poses: str | Path | np.ndarray | None,
    *,
    artefact: Literal["sphere", "plane"],
    radius_mm: float | None,
    pose_format: str,
    profile_unit: Unit,
    pose_unit: Unit,
    scale: bool,
    time: bool,
    profile_times_s: np.ndarray | None,
    pose_times_s: np.ndarray | None,
) -> MountEvidence:
    """Profiles and poses from arrays or files, checked; DescriptionError where they do not go together."""
    digests: dict[str, str] = {}
    names: list[str] | None = None
    rows: np.ndarray | None = None
    if isinstance(profiles, str | Path) and Path(profiles).suffix == ".toml":
        path = Path(profiles)
        if poses is not None:
            raise DescriptionError(f"{path} names the poses already: leave the other ones out")
        given = validated(MountDescription, read_table(path), path)
        profiles, poses = path.parent / given.profiles, path.parent / given.poses
        artefact, radius_mm, pose_format = given.artefact, given.radius_mm, given.pose_format
        profile_unit, pose_unit, scale, time = given.profile_unit, given.pose_unit, given.scale, given.time
    if artefact not in ("sphere", "plane"):
        raise DescriptionError(f"the artefact is {artefact!r}; expected sphere or plane")
    if radius_mm is not None and not (np.isfinite(radius_mm) and radius_mm > 0 and artefact == "sphere"):
        raise DescriptionError(f"radius_mm is {radius_mm:g} of a {artefact}; expected the positive radius of a sphere")
    if poses is None:
        raise DescriptionError("the poses are missing: give T_base_platform of every profile")
    if isinstance(profiles, str | Path):
        names, profiles, times = read_profiles(profiles, unit=profile_unit, digests=digests)
        profile_times_s = times if profile_times_s is None else profile_times_s
    if isinstance(poses, str | Path):
        rows, times = _pose_rows(Path(poses), digests)
        poses = _scaled(_matrices_of(rows, pose_format, Path(poses)), pose_unit)
        pose_times_s = times if pose_times_s is None else pose_times_s
    checked = [_checked_profile(profile, number) for number, profile in enumerate(profiles)]
    matrices = _checked_matrices(np.asarray(poses, dtype=np.float64), "poses")
    if time and (profile_times_s is None or pose_times_s is None):
        raise DescriptionError("a time offset needs the times of profiles and poses: give both a column time_s")
    if profile_times_s is not None and pose_times_s is not None and (time or len(matrices) != len(checked)):
        profile_times_s, pose_times_s = _checked_times(profile_times_s, pose_times_s, len(checked), len(matrices))
    else:
        profile_times_s = pose_times_s = None
        if len(matrices) != len(checked):
            raise DescriptionError(
                f"there are {len(checked)} profiles and {len(matrices)} poses; expected one pose for each profile"
            )
    if not checked:
        raise DescriptionError("there are no profiles")
    return MountEvidence(
        profiles=checked,
        poses=matrices,
        artefact=artefact,
        radius_mm=radius_mm,
        names=names or [str(number + 1) for number in range(len(checked))],
        scale=scale,
        time=time,
        profile_times_s=profile_times_s,
        pose_times_s=pose_times_s,
        pose_format=pose_format,
        rows=rows,
        digests=digests,
    )


def _checked_profile(profile: np.ndarray, number: int) -> np.ndarray:
    points = np.asarray(profile, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] not in (2, 3):
        raise DescriptionError(
            f"profile {number + 1} has the shape {points.shape}; expected (N, 2) with x and z or (N, 3) with x, y and z"
        )
    points = np.where(np.isfinite(points), points, np.nan)
    if np.any(np.abs(points) > _FARTHEST_MM):
        raise DescriptionError(f"profile {number + 1} has points beyond {_FARTHEST_MM:g} mm: is its unit right?")
    return points


def _checked_times(
    profile_times_s: np.ndarray, pose_times_s: np.ndarray, profiles: int, poses: int
) -> tuple[np.ndarray, np.ndarray]:
    wanted, times = np.asarray(profile_times_s, dtype=np.float64), np.asarray(pose_times_s, dtype=np.float64)
    if wanted.shape != (profiles,) or times.shape != (poses,):
        raise DescriptionError(
            f"there are {wanted.size} times of {profiles} profiles and {times.size} of {poses} poses"
        )
    if not (np.isfinite(wanted).all() and np.isfinite(times).all() and (np.diff(times) > 0).all() and poses > 1):
        raise DescriptionError("times must be finite, and those of the poses must grow")
    outside = int(np.count_nonzero((wanted < times[0]) | (wanted > times[-1])))
    if outside:
        raise DescriptionError(f"{outside} of {profiles} profiles were taken before the first or after the last pose")
    return wanted, times


def read_profiles(
    path: str | Path, *, unit: Unit = "mm", digests: dict[str, str] | None = None
) -> tuple[list[str], list[np.ndarray], np.ndarray | None]:
    """Names, profiles (N, 2) or (N, 3) and times of profiles (or None) from files, mm.

    A folder holds one CSV file for each pose, in the order of the numbers in their names. One CSV file holds all
    profiles, with a column ``pose``. Columns are x and z, y where the points have it, and ``time_s``; without a line of
    names two columns are x and z. Cells that are empty or NaN were not seen. A cloud of the project's own has the
    points of pose n in frame n. DescriptionError for anything else.
    """
    path, digests = Path(path), {} if digests is None else digests
    scale = _MM[_checked_unit(unit)]
    if path.is_dir():
        files = sorted(
            (each for each in path.iterdir() if each.suffix.lower() == ".csv"), key=lambda p: natural_key(p.name)
        )
        if not files:
            raise DescriptionError(f"{path} holds no CSV files: expected one for each pose")
        names, profiles, times = [], [], []
        for file in files:
            columns = _read_columns(file, digests)
            names.append(file.stem)
            profiles.append(_points_of(columns, file) * scale)
            times.append(_one_time(columns))
    elif path.suffix.lower() in (".ply", ".h5") and is_cloud(path):
        digests[path.name] = sha256_of(path)
        cloud = read_cloud(path)
        frames = np.unique(cloud.frame)
        return [str(frame) for frame in frames], [cloud.points_mm[cloud.frame == frame] for frame in frames], None
    else:
        columns = _read_columns(path, digests)
        if "pose" not in columns:
            raise DescriptionError(f"{path} has no column 'pose', which says to which pose each of its points belongs")
        poses, points = columns["pose"], _points_of(columns, path) * scale
        if not np.isfinite(poses).all():
            raise DescriptionError(f"{path}: some cells of the column 'pose' are empty or no number")
        labels = list(dict.fromkeys(poses.tolist()))
        names = [f"{label:g}" for label in labels]
        profiles = [points[poses == label] for label in labels]
        each = columns.get("time_s", np.full(len(poses), np.nan))
        times = [float(each[poses == label][0]) for label in labels]
    known = np.array(times)
    return names, profiles, known if np.isfinite(known).all() else None


def _one_time(columns: dict[str, np.ndarray]) -> float:
    times = columns.get("time_s")
    return float(times[0]) if times is not None and len(times) else np.nan


def _points_of(columns: dict[str, np.ndarray], path: Path) -> np.ndarray:
    if not {"x", "z"} <= columns.keys():
        raise DescriptionError(
            f"{path} has the columns {', '.join(columns)}; expected x and z, and y where there is one"
        )
    return np.column_stack([columns[name] for name in ("x", "y", "z") if name in columns])


def _checked_unit(unit: Unit) -> Unit:
    if unit not in get_args(Unit):
        raise DescriptionError(f"the unit is {unit!r}; expected mm or m")
    return unit


_COLUMN_NAMES = re.compile(r"(?:_| *[\[(])(?:mm|m)[\])]?$")


def _read_columns(path: Path, digests: dict[str, str], *, named: bool = True) -> dict[str, np.ndarray]:
    """Columns of a CSV file, with commas, semicolons (then decimal commas), tabs or blanks; without lines of #.

    Names are as in the first line, in lower case and without unit, or x and z, or numbers where the file has no names.
    """
    content = read_bytes(path, most_bytes=_MOST_BYTES, error=DescriptionError, called="table")
    digests[path.name] = sha256_of(path)
    lines = content.removeprefix(b"\xef\xbb\xbf").replace(b"\r\n", b"\n").split(b"\n")
    lines = [line.strip() for line in lines if line.strip() and not line.lstrip().startswith(b"#")]
    if not lines:
        raise DescriptionError(f"{path} is empty: expected a table of numbers")
    first = lines[0]
    delimiter = next((mark for mark in (b";", b"\t", b",") if mark in first), b" ")
    if delimiter == b" ":
        lines = [b" ".join(line.split()) for line in lines]
    cells = [cell.strip().strip('"') for cell in lines[0].decode("utf-8", "replace").split(delimiter.decode())]
    has_names = not any(_is_number(cell) for cell in cells)
    if has_names:
        names = [_COLUMN_NAMES.sub("", cell.lower()) if cell.lower() != "time_s" else "time_s" for cell in cells]
        lines = lines[1:]
    else:
        names = ["x", "z"] if named and len(cells) == 2 else [str(number) for number in range(len(cells))]
    if len(set(names)) < len(names):
        raise DescriptionError(f"{path} has the columns {', '.join(names)}: expected each name once")
    try:
        table = csv.read_csv(
            BytesIO(b"\n".join(lines) + b"\n"),
            read_options=csv.ReadOptions(column_names=names, use_threads=False),
            parse_options=csv.ParseOptions(delimiter=delimiter.decode()),
            convert_options=csv.ConvertOptions(
                column_types=dict.fromkeys(names, pa.float64()),
                null_values=["", "NaN", "nan", "NAN", "-nan", "null", "None"],
                decimal_point="," if delimiter == b";" and b"," in b"".join(lines[:100]) else ".",
            ),
        )
    except (pa.ArrowInvalid, pa.ArrowException) as error:
        raise DescriptionError(f"{path} is no table of numbers: {str(error).splitlines()[0]}") from error
    return {name: table[name].to_numpy(zero_copy_only=False).astype(np.float64) for name in names}


def _is_number(text: str) -> bool:
    try:
        float(text.replace(",", ".") or "nan")
    except ValueError:
        return False
    return True


def read_poses(path: str | Path, *, pose_format: PoseFormat, unit: Unit = "mm") -> tuple[np.ndarray, np.ndarray | None]:
    """``T_base_platform`` (P, 4, 4), mm, and their times (P,) or None, from a CSV file with one pose a line.

    Columns ``pose`` and ``time_s``, recognised by name, come in addition. The others are, in this order, 12 or 16
    elements of the matrix row by row; or the translation, then a quaternion (``quaternion-xyzw``, ``quaternion-wxyz``),
    a rotation vector (``rotvec-rad``, ``rotvec-deg``) or three Euler angles: ``euler-ZYX-deg`` turns about the moved
    axes (intrinsic), the first letter first; ``euler-zyx-deg`` about the fixed axes (extrinsic), as SciPy's
    `Rotation.from_euler`. DescriptionError for a wrong count, numbers that are not finite, matrices that are not rigid,
    quaternions without unit length and angles that look like degrees where radians are stated.
    """
    path = Path(path)
    rows, times = _pose_rows(path, {})
    return _scaled(_matrices_of(rows, pose_format, path), unit), times


def _pose_rows(path: Path, digests: dict[str, str]) -> tuple[np.ndarray, np.ndarray | None]:
    """Numbers (P, K) of the poses in a file, and their times (P,) or None."""
    columns = _read_columns(path, digests, named=False)
    times = columns.pop("time_s", None)
    columns.pop("pose", None)
    rows = np.column_stack(list(columns.values())) if columns else np.empty((0, 0))
    if len(rows) > _MOST_POSES:
        raise DescriptionError(f"{path} has {len(rows):,} poses; this program reads up to {_MOST_POSES:,}")
    wrong = np.flatnonzero(~np.isfinite(rows).all(axis=1))
    if len(wrong):
        raise DescriptionError(f"{path}: pose {wrong[0] + 1} has a number that is missing or not finite")
    return rows, times


def _scaled(matrices: np.ndarray, unit: Unit) -> np.ndarray:
    matrices[:, :3, 3] *= _MM[_checked_unit(unit)]
    return matrices


def _matrices_of(rows: np.ndarray, pose_format: str, path: Path) -> np.ndarray:
    euler = _EULER.fullmatch(pose_format)
    counts = {
        "matrix": (12, 16),
        "quaternion-xyzw": (7,),
        "quaternion-wxyz": (7,),
        "rotvec-rad": (6,),
        "rotvec-deg": (6,),
    }
    expected = (6,) if euler else counts.get(pose_format)
    if expected is None:
        raise DescriptionError(f"the format of the poses is {pose_format!r}; expected {_FORMATS}, or another order")
    if rows.shape[1] not in expected:
        raise DescriptionError(
            f"{path} has {rows.shape[1]} columns of numbers; a pose as {pose_format} has "
            f"{' or '.join(map(str, expected))} (columns 'pose' and 'time_s' are recognised by their names)"
        )
    result = np.tile(np.eye(4), (len(rows), 1, 1))
    if pose_format == "matrix":
        result[:, : rows.shape[1] // 4] = rows.reshape(len(rows), -1, 4)
        return _checked_matrices(result, path)
    result[:, :3, 3] = rows[:, :3]
    turns = rows[:, 3:]
    if pose_format.startswith("quaternion"):
        lengths = np.linalg.norm(turns, axis=1)
        wrong = np.flatnonzero(np.abs(lengths - 1) > _ROUNDED)
        if len(wrong):
            raise DescriptionError(
                f"{path}: the quaternion of pose {wrong[0] + 1} has the length {lengths[wrong[0]]:.4g}; expected 1. "
                "Come x, y, z of the position first, then the quaternion?"
            )
        rotations = Rotation.from_quat(turns, scalar_first=pose_format == "quaternion-wxyz")
    else:
        if pose_format.endswith("-rad") and np.abs(turns).max() > 2 * np.pi + 0.01:
            raise DescriptionError(f"{path} has angles up to {np.abs(turns).max():g} rad: are they degrees (-deg)?")
        angles = np.radians(turns) if pose_format.endswith("-deg") else turns
        rotations = Rotation.from_euler(euler[1], angles) if euler else Rotation.from_rotvec(angles)
    result[:, :3, :3] = rotations.as_matrix()
    return result


def _checked_matrices(matrices: np.ndarray, source: object) -> np.ndarray:
    """Rigid matrices (P, 4, 4), their rotations freed from rounding; DescriptionError where they are not."""
    if matrices.ndim != 3 or matrices.shape[1:] != (4, 4):
        raise DescriptionError(f"{source}: the poses have the shape {matrices.shape}; expected (P, 4, 4)")
    for number, matrix in enumerate(matrices):
        if not np.isfinite(matrix).all():
            raise DescriptionError(f"{source}: pose {number + 1} has a number that is not finite")
        if np.abs(matrix[:3, 3]).max() > _FARTHEST_MM:
            raise DescriptionError(f"{source}: pose {number + 1} lies beyond {_FARTHEST_MM:g} mm: is its unit right?")
        if not is_rigid(matrix, within=_ROUNDED):
            hint = ""
            if is_rigid(matrix.T, within=_ROUNDED):
                hint = " It is given column by column: expected row by row"
            elif np.linalg.det(matrix[:3, :3]) < 0:
                hint = " It mirrors"
            raise DescriptionError(
                f"{source}: pose {number + 1} is not a rotation and a shift (with 0 0 0 1 as last row).{hint}"
            )
    result = np.array(matrices)
    left, _, right = np.linalg.svd(matrices[:, :3, :3])
    result[:, :3, :3], result[:, 3] = left @ right, (0, 0, 0, 1)
    return result


def write_mount(path: str | Path, mount: Mount, *, overwrite: bool = False) -> None:
    """Write a mount as JSON, completely or not at all; OutputError if that fails."""
    write_model(path, mount, format=FORMAT, version=VERSION, overwrite=overwrite)


def read_mount(path: str | Path) -> Mount:
    """Read a mount; CaptureError where the file is missing, foreign, newer or damaged."""
    return read_model(path, Mount, format=FORMAT, version=VERSION, called="mount")
