"""Files of platform poses: matrices, quaternions, rotation vectors and Euler angles, in tables of numbers."""

import re
from io import BytesIO
from pathlib import Path
from typing import Literal, get_args

import numpy as np
import pyarrow as pa
from pyarrow import csv
from scipy.spatial.transform import Rotation

from uwlts.errors import DescriptionError
from uwlts.files.reading import read_bytes
from uwlts.files.writing import hash_file, write_atomically
from uwlts.model.calibration import is_rigid
from uwlts.model.trajectory import COVARIANCE_COLUMNS, Trajectory
from uwlts.storage.ros_bags import read_bag_poses

Unit = Literal["mm", "m"]
PoseFormat = str
"""matrix, quaternion-xyzw, quaternion-wxyz, rotvec-rad, rotvec-deg, euler-ORDER-deg or -rad, angle-deg, angle-rad."""
MM_PER_UNIT: dict[Unit, float] = {"mm": 1.0, "m": 1000.0}
FARTHEST_MM = 1e7
"""Ten kilometres: no platform reaches farther, and squares of larger numbers would lose the noise."""

_MOST_BYTES = 512 * 2**20
_ROUNDED = 2e-3
"""Deviation from a rigid matrix or a unit quaternion when numbers have three decimals."""
_EULER = re.compile(r"euler-([xyz]{3}|[XYZ]{3})-(deg|rad)")
_FORMATS = "matrix, quaternion-xyzw, quaternion-wxyz, rotvec-rad, rotvec-deg, euler-zyx-deg (fixed axes), euler-ZYX-deg"
_MOST_POSES = 20_000


def check_unit(unit: Unit) -> Unit:
    if unit not in get_args(Unit):
        raise DescriptionError(f"the unit is {unit!r}; expected mm or m")
    return unit


_COLUMN_NAMES = re.compile(r"(?:_| *[\[(])(?:mm|m)[\])]?$")


def read_columns(path: Path, digests: dict[str, str], *, named: bool = True) -> dict[str, np.ndarray]:
    """Read the columns of a CSV file with commas, semicolons (then decimal commas), tabs or blanks.

    Lines that begin with # are skipped. Names are those of the first line, in lower case and without unit. Without
    names, two columns are x and z, and others are numbered.
    """
    content = read_bytes(path, most_bytes=_MOST_BYTES, error=DescriptionError, called="table")
    digests[path.name] = hash_file(path)
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
                decimal_point="," if delimiter == b";" and any(b"," in line for line in lines) else ".",
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


def read_poses(
    path: str | Path, *, pose_format: PoseFormat = "matrix", unit: Unit = "mm"
) -> tuple[np.ndarray, np.ndarray | None]:
    """Read ``T_base_platform`` (P, 4, 4) in mm, and times (P,) or None, from a CSV file with one pose per line.

    Columns ``pose`` and ``time_s`` are recognised by name. The others are, in this order, 12 or 16 elements of the
    matrix row by row; or the translation, then a quaternion (``quaternion-xyzw``, ``quaternion-wxyz``), a rotation
    vector (``rotvec-rad``, ``rotvec-deg``) or three Euler angles as in SciPy's `Rotation.from_euler`. ``euler-ZYX-deg``
    rotates about the moved axes (intrinsic), first letter first; ``euler-zyx-deg`` about the fixed axes (extrinsic). A
    single column ``angle-deg`` or ``angle-rad`` is the angle of a rotary table that turns the object about its z axis:
    the poses are those of the sensor's side relative to the object.

    Raises DescriptionError for a wrong number of columns, numbers that are not finite, matrices that are not rigid,
    quaternions that are not of unit length, and angles in rad that look like degrees.
    """
    path = Path(path)
    rows, times = pose_rows(path, {})
    return scale_positions(poses_from_rows(rows, pose_format, path), unit), times


def read_trajectory(path: str | Path, *, pose_format: PoseFormat = "matrix", unit: Unit = "mm") -> Trajectory:
    """Read the trajectory of a platform from a file like that of `read_poses`, with a column ``time_s``.

    With the format ``tum``, of the RGB-D benchmark of TU Munich, each line has the time in s, the position in m and the
    quaternion x y z w, separated by blanks and without names. Columns named ``cov_00`` to ``cov_55`` are the upper
    triangles of the covariances (`Trajectory`), in the unit of the positions and rad. With the format ``ros`` the file
    is a bag of ROS 1 or ROS 2; ``ros:/TOPIC`` or ``ros:PARENT>CHILD`` names the poses or transforms in it
    (`uwlts.storage.ros_bags`).

    Raises the errors of `read_poses` and `Trajectory`, DescriptionError if there are no times, and SetupError if the
    library for bags is not installed.
    """
    path = Path(path)
    if pose_format == "ros" or pose_format.startswith("ros:"):
        times, rows, covariance = read_bag_poses(path, pose_format.removeprefix("ros").removeprefix(":"))
        if covariance is not None:
            units = np.array([1e3] * 3 + [1.0] * 3)
            covariance = covariance * units[:, None] * units
        return _trajectory(
            path, times, scale_positions(poses_from_rows(rows, "quaternion-xyzw", path), "m"), covariance
        )
    columns = read_columns(path, {}, named=False)
    covariance = _covariances(columns, path, MM_PER_UNIT[check_unit(unit)])
    rows, times = _rows_of(columns, path)
    if pose_format == "tum":
        if rows.shape[1] != 8:
            raise DescriptionError(f"{path} has {rows.shape[1]} columns; expected time, x, y, z and a quaternion (tum)")
        times, rows, pose_format, unit = rows[:, 0], rows[:, 1:], "quaternion-xyzw", "m"
    if times is None:
        raise DescriptionError(f"{path} has no column time_s: a trajectory needs the time of each pose")
    return _trajectory(path, times, scale_positions(poses_from_rows(rows, pose_format, path), unit), covariance)


def write_poses(path: str | Path, poses: np.ndarray, *, overwrite: bool = False) -> None:
    """Write poses (P, 4, 4) in mm as CSV with 12 elements of the matrix per line.

    `read_poses` reads them with the format ``matrix``. Raises OutputError if the file exists and ``overwrite`` is not
    set, or cannot be written.
    """
    names = [f"m{row}{column}" for row in range(3) for column in range(4)]
    rows = np.asarray(poses, dtype=np.float64)[:, :3].reshape(-1, 12)
    with write_atomically(path, overwrite=overwrite) as aside:
        lines = [",".join(names), *(",".join(map(repr, row)) for row in rows.tolist())]
        aside.write_text("\n".join(lines) + "\n", encoding="ascii")


def _covariances(columns: dict[str, np.ndarray], path: Path, mm_per_unit: float) -> np.ndarray | None:
    """Remove the covariances (N, 6, 6) in mm and rad from the columns of a file, and return them; None without any."""
    found = {name: columns.pop(name) for name in [*columns] if name in COVARIANCE_COLUMNS}
    if not found:
        return None
    if missing := sorted(COVARIANCE_COLUMNS.keys() - found.keys()):
        raise DescriptionError(f"{path} has columns of covariances, but not {', '.join(missing)}")
    units = np.array([mm_per_unit] * 3 + [1.0] * 3)
    covariances = np.empty((len(next(iter(found.values()))), 6, 6))
    for name, (i, j) in COVARIANCE_COLUMNS.items():
        covariances[:, i, j] = covariances[:, j, i] = found[name] * units[i] * units[j]
    return covariances


def trajectory_path(capture: str | Path) -> Path:
    """Return the path of the platform's reported trajectory, beside the capture."""
    path = Path(capture)
    return path.with_name(path.name.removesuffix(".h5") + ".trajectory.csv")


def _trajectory(path: Path, times: np.ndarray, poses: np.ndarray, covariance: np.ndarray | None) -> Trajectory:
    try:
        return Trajectory(times, poses, covariance)
    except DescriptionError as error:
        raise DescriptionError(f"{path}: {error}") from error


def pose_rows(path: Path, digests: dict[str, str]) -> tuple[np.ndarray, np.ndarray | None]:
    """Read the numbers (P, K) of the poses in a file, and their times (P,) or None."""
    return _rows_of(read_columns(path, digests, named=False), path)


def _rows_of(columns: dict[str, np.ndarray], path: Path) -> tuple[np.ndarray, np.ndarray | None]:
    columns = {name: values for name, values in columns.items() if name not in COVARIANCE_COLUMNS}
    times = columns.pop("time_s", None)
    columns.pop("pose", None)
    rows = np.column_stack(list(columns.values())) if columns else np.empty((0, 0))
    if len(rows) > _MOST_POSES:
        raise DescriptionError(f"{path} has {len(rows):,} poses; this program reads up to {_MOST_POSES:,}")
    wrong = np.flatnonzero(~np.isfinite(rows).all(axis=1))
    if len(wrong):
        raise DescriptionError(f"{path}: pose {wrong[0] + 1} has a number that is missing or not finite")
    return rows, times


def scale_positions(matrices: np.ndarray, unit: Unit) -> np.ndarray:
    matrices[:, :3, 3] *= MM_PER_UNIT[check_unit(unit)]
    return matrices


def poses_from_rows(rows: np.ndarray, pose_format: str, path: Path) -> np.ndarray:
    euler = _EULER.fullmatch(pose_format)
    counts = {
        "matrix": (12, 16),
        "quaternion-xyzw": (7,),
        "quaternion-wxyz": (7,),
        "rotvec-rad": (6,),
        "rotvec-deg": (6,),
        "angle-deg": (1,),
        "angle-rad": (1,),
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
        return check_matrices(result, path)
    if pose_format.startswith("angle"):
        # The object turns with the table; relative to it, the sensor turns in the opposite direction.
        angles = rows[:, 0] if pose_format.endswith("rad") else np.radians(rows[:, 0])
        result[:, :3, :3] = Rotation.from_rotvec(np.outer(-angles, (0, 0, 1))).as_matrix()
        return result
    result[:, :3, 3] = rows[:, :3]
    turns = rows[:, 3:]
    if pose_format.startswith("quaternion"):
        lengths = np.linalg.norm(turns, axis=1)
        wrong = np.flatnonzero(np.abs(lengths - 1) > _ROUNDED)
        if len(wrong):
            raise DescriptionError(
                f"{path}: the quaternion of pose {wrong[0] + 1} has the length {lengths[wrong[0]]:.4g}; expected 1. "
                "Are x, y, z of the position first, then the quaternion?"
            )
        rotations = Rotation.from_quat(turns, scalar_first=pose_format == "quaternion-wxyz")
    else:
        if pose_format.endswith("-rad") and np.abs(turns).max() > 2 * np.pi + 0.01:
            raise DescriptionError(f"{path} has angles up to {np.abs(turns).max():g} rad: are they degrees (-deg)?")
        angles = np.radians(turns) if pose_format.endswith("-deg") else turns
        rotations = Rotation.from_euler(euler[1], angles) if euler else Rotation.from_rotvec(angles)
    result[:, :3, :3] = rotations.as_matrix()
    return result


def check_matrices(matrices: np.ndarray, source: object) -> np.ndarray:
    """Return rigid matrices (P, 4, 4) with exact rotations; raises DescriptionError if they are not rigid."""
    if matrices.ndim != 3 or matrices.shape[1:] != (4, 4):
        raise DescriptionError(f"{source}: the poses have the shape {matrices.shape}; expected (P, 4, 4)")
    for number, matrix in enumerate(matrices):
        if not np.isfinite(matrix).all():
            raise DescriptionError(f"{source}: pose {number + 1} has a number that is not finite")
        if np.abs(matrix[:3, 3]).max() > FARTHEST_MM:
            raise DescriptionError(f"{source}: pose {number + 1} is beyond {FARTHEST_MM:g} mm: is its unit right?")
        if not is_rigid(matrix, within=_ROUNDED):
            hint = ""
            if is_rigid(matrix.T, within=_ROUNDED):
                hint = " It is given column by column: expected row by row"
            elif np.linalg.det(matrix[:3, :3]) < 0:
                hint = " It is a reflection"
            raise DescriptionError(
                f"{source}: pose {number + 1} is not a rotation and a shift (with 0 0 0 1 as last row).{hint}"
            )
    result = np.array(matrices)
    left, _, right = np.linalg.svd(matrices[:, :3, :3])
    result[:, :3, :3], result[:, 3] = left @ right, (0, 0, 0, 1)
    return result
