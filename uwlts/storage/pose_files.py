"""Files of platform poses: matrices, quaternions, rotation vectors and Euler angles, in tables of numbers."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.ndimage import median_filter
from scipy.spatial.transform import Rotation

from uwlts.errors import DescriptionError
from uwlts.files.reading import log_warnings
from uwlts.files.writing import write_atomically
from uwlts.model.sensor import is_rigid
from uwlts.model.trajectory import COVARIANCE_COLUMNS, Trajectory
from uwlts.storage.number_tables import ROTATION_NAMES, NumberTable, Unit, read_number_table
from uwlts.storage.ros_messages import read_bag_poses

PoseFormat = str
"""matrix, quaternion-xyzw, quaternion-wxyz, rotvec-rad, rotvec-deg, euler-ORDER-deg or -rad, angle-deg,
angle-rad."""
SAVED_FORMAT = "quaternion-xyzw"
"""Format of `Trajectory.save`."""
FARTHEST_MM = 1e7
"""Ten kilometres: no platform reaches farther, and squares of larger numbers would lose the noise."""

_COMPASS = ("north", "east", "down")
_SAME_ANGLES = (
    {"heading": "yaw"},
    {"phi": "roll", "theta": "pitch", "psi": "yaw"},
    {"omega": "roll", "phi": "pitch", "kappa": "yaw"},
)
"""Names of angles on compasses, in navigation and in photogrammetry."""
_ROUNDED = 2e-3
"""Deviation from a rigid matrix or a unit quaternion when numbers have three decimals."""
_FORMAT = re.compile(
    r"matrix|quaternion-(xyzw|wxyz)|(rotvec|angle)-(deg|rad)|euler-(?P<axes>[xyz]{3}|[XYZ]{3})-(deg|rad)"
)
_COLUMNS = {"matrix": (12, 16), "quaternion": (7,), "rotvec": (6,), "euler": (6,), "angle": (1,)}
"""Numbers of columns of a pose, by the first word of the format."""
_FORMATS = "matrix, quaternion-xyzw, quaternion-wxyz, rotvec-rad, rotvec-deg, euler-zyx-deg (fixed axes), euler-ZYX-deg"
_FEWEST_POSES, _ALTERNATING, _RETURNED, _LEAST_JUMP_MM, _REACH_MM = 10, 0.2, 0.3, 0.1, 300.0
"""Two sources: least number of poses, share that jumps, largest rest of a jump after it, smallest jump, and lever of
rotations. Of independent noise along one axis, 15 % jump, in a plane 5 %."""
_AROUND, _SAME, _LONG, _LIKE_LONGEST, _FEWEST_LONG, _OFTEN, _BACK = 9, 0.3, 6.0, 0.6, 4, 0.02, 0.8
"""Two sources in bursts: number of poses with a common motion, and quantile of the steps without it. Least jump
relative to this and to the longest steps, least number of jumps, and least shares of the poses and of jumps back."""
_NEAR_HALF_TURN = 3.0
"""Angles in rad reach pi, unless turns are small; the largest in deg is between 3 and pi by chance only."""
_METRES = np.array([1e3] * 3 + [1.0] * 3)
"""Units of shifts in m and rotations in rad, in mm and rad."""
_LATEST_S = 1e11  # Unix times in s reach it in the year 5138; larger numbers are in ms, us or ns


def read_poses(
    path: str | Path, *, pose_format: PoseFormat = "matrix", unit: Unit | None = None
) -> tuple[np.ndarray, np.ndarray | None]:
    """Read ``T_base_platform`` (P, 4, 4) in mm, and times (P,) or None, from a CSV file with one pose per line.

    Columns ``pose`` and ``time_s`` are recognised by name. The others are, in this order, 12 or 16 elements of the
    matrix row by row; or the translation, then a quaternion (``quaternion-xyzw``, ``quaternion-wxyz``), a rotation
    vector (``rotvec-rad``, ``rotvec-deg``) or three Euler angles as in SciPy's `Rotation.from_euler`. ``euler-ZYX-deg``
    rotates about the moved axes (intrinsic), first letter first; ``euler-zyx-deg`` about the fixed axes (extrinsic). A
    single column ``angle-deg`` or ``angle-rad`` is the angle of a rotary table that turns the object about its z axis:
    the poses are those of the sensor's side relative to the object.

    Names decide the order of columns where they say it: x, y, z; qw, qx, qy, qz; roll, pitch, yaw or rx, ry, rz. Units
    in names (``x_m``, ``yaw [deg]``) are obeyed; without them positions are in ``unit``, by default mm.

    Raises
    ------
    DescriptionError
        Names or their units contradict the format or ``unit``, or the number of columns is wrong. Numbers are not
        finite, matrices not rigid, quaternions not of unit length, or angles in rad look like degrees.
    """
    return _make_poses(read_number_table(Path(path), named=False), pose_format, unit)


def read_trajectory(path: str | Path, *, pose_format: PoseFormat = "matrix", unit: Unit | None = None) -> Trajectory:
    """Read the trajectory of a platform from a file like that of `read_poses`, with a column ``time_s``.

    The format ``tum`` is that of the RGB-D benchmark of TU Munich: each line has the time in s, the position in m and
    the quaternion x y z w, separated by blanks and without names. Columns named ``cov_00`` to ``cov_55`` are the upper
    triangles of the covariances (`Trajectory`), in the unit of the positions and rad. With the format ``ros`` the file
    is a bag of ROS 1 or ROS 2; ``ros:/TOPIC`` or ``ros:PARENT>CHILD`` names the poses or transforms in it
    (`uwlts.storage.ros_messages`).

    Raises the errors of `read_poses` and `Trajectory`, DescriptionError if there are no times, and SetupError if the
    library for bags is not installed.
    """
    path = Path(path)
    if pose_format == "ros" or pose_format.startswith("ros:"):
        times, rows, covariance = read_bag_poses(path, pose_format.removeprefix("ros").removeprefix(":"))
        covariance = None if covariance is None else covariance * np.outer(_METRES, _METRES)
        rows[:, :3] *= 1e3
        return _make_trajectory(path, times, poses_from_rows(rows, "quaternion-xyzw", path), covariance)
    table = read_number_table(path, named=False)
    if pose_format == "tum":
        if len(table.columns) != 8:
            raise DescriptionError(
                f"{path} has {len(table.columns)} columns; expected time, x, y, z and a quaternion (tum)"
            )
        if "time_s" not in table.columns:
            names = ["time_s", *[*table.columns][1:]]
            table = replace(table, columns=dict(zip(names, table.columns.values(), strict=True)))
        pose_format, unit = "quaternion-xyzw", "m"
    covariance = _take_covariances(table.columns, path, table.mm_per_unit(unit=unit))
    poses, times = _make_poses(table, pose_format, unit)
    if times is None:
        raise DescriptionError(f"{path} has no column time_s: a trajectory needs the time of each pose")
    if "time_s" not in table.units and np.abs(times).max(initial=0) > _LATEST_S:
        raise DescriptionError(
            f"{path} has times up to {times.max():.9g}: expected s, or a unit in the name, such as 'time [ns]'"
        )
    return _make_trajectory(path, times, poses, covariance)


def holds_trajectory(path: Path) -> bool:
    """Return whether a table has times and rotations of poses, or quaternions, rather than the points of a cloud."""
    columns = read_number_table(path, named=False).columns
    others = [values for name, values in columns.items() if name not in ("time_s", "x", "y", "z")]
    unit = len(others) == 4 and np.abs(np.square(others).sum(axis=0) - 1).max() < _ROUNDED
    rotates = unit or not columns.keys().isdisjoint(ROTATION_NAMES) or not {"x", "y", "z"} <= columns.keys()
    return {"qx", "qy", "qz", "qw"} <= columns.keys() or ("time_s" in columns and bool(rotates))


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


def _take_covariances(columns: dict[str, np.ndarray], path: Path, mm_per_unit: float) -> np.ndarray | None:
    """Remove the covariances (N, 6, 6) in mm and rad from the columns of a file, and return them; None without any."""
    found = {name: columns.pop(name) for name in [*columns] if name in COVARIANCE_COLUMNS}
    if not found:
        return None
    if missing := sorted(COVARIANCE_COLUMNS.keys() - found.keys()):
        raise DescriptionError(f"{path} has columns of covariances, but not {', '.join(missing)}")
    units = np.where(_METRES > 1, mm_per_unit, 1.0)
    covariances = np.empty((len(next(iter(found.values()))), 6, 6))
    for name, (i, j) in COVARIANCE_COLUMNS.items():
        covariances[:, i, j] = covariances[:, j, i] = found[name] * units[i] * units[j]
    return covariances


def trajectory_path(capture: str | Path) -> Path:
    """Return the path of the platform's reported trajectory, beside the capture."""
    path = Path(capture)
    return path.with_name(path.name.removesuffix(".h5") + ".trajectory.csv")


def _make_trajectory(path: Path, times: np.ndarray, poses: np.ndarray, covariance: np.ndarray | None) -> Trajectory:
    """Return a trajectory without the repetitions of a pose at the same time."""
    same = np.zeros(len(times), bool)
    same[1:] = (np.diff(times) == 0) & (poses[1:] == poses[:-1]).all(axis=(1, 2))
    warnings = _find_alternation(poses[~same])
    if count := int(np.count_nonzero(same)):
        warnings.append(f"{count} of {len(times)} poses repeat the previous one at the same time and are omitted")
    log_warnings(path, warnings)
    try:
        known = None if covariance is None else covariance[~same]
        return Trajectory(times[~same], poses[~same], known, warnings=warnings)
    except DescriptionError as error:
        raise DescriptionError(f"{path}: {error}") from error


def _find_alternation(poses: np.ndarray) -> list[str]:
    """Return a warning if many poses (N, 4, 4) jump away from their neighbours and back, as those of two sources."""
    if len(poses) < _FEWEST_POSES:
        return []
    axes = (poses[:, :3, 3] + _REACH_MM * poses[:, :3, axis] for axis in (0, 1))
    places = np.concatenate([poses[:, :3, 3], *axes], axis=1)
    # Every second pose lies on a smooth path of its own, also if the offset is along the path.
    smooth, near = (np.linalg.norm(places[2 * n :] - 2 * places[n:-n] + places[: -2 * n], axis=1) for n in (2, 1))
    jumps = np.pad((near[1:-1] > 2 * _LEAST_JUMP_MM) & (smooth < _RETURNED * near[1:-1]), 1)
    if np.mean(jumps) < _ALTERNATING:
        # Bursts of two sources: each long move, apart from the motion of all, is taken back by the next one.
        moves = np.diff(places, axis=0)
        moves -= median_filter(moves, (_AROUND, 1))
        sizes = np.linalg.norm(moves, axis=1)
        middle, longest = np.quantile(sizes, (_SAME, 1 - _OFTEN))
        long = np.flatnonzero(sizes > max(_LONG * middle, _LIKE_LONGEST * longest, _LEAST_JUMP_MM))
        back = np.linalg.norm(moves[long[1:]] + moves[long[:-1]], axis=1) < _RETURNED * sizes[long[1:]]
        if len(long) < max(_FEWEST_LONG, _OFTEN * len(poses)) or np.mean(back) < _BACK:
            return []
        jumps = np.isin(np.arange(len(poses) - 2), long)
    changes = (np.linalg.norm(np.diff(poses[:, :3, column], axis=0), axis=1)[:-1][jumps] for column in (0, 3))
    turned, moved = map(np.median, changes)
    return [
        f"{100 * np.mean(jumps):.0f} % of the poses jump away and back, by {moved:.3g} mm and "
        f"{np.degrees(turned):.2g} deg: are two sources or frames in one track? Keep one of them"
    ]


def _make_poses(table: NumberTable, pose_format: PoseFormat, unit: Unit | None) -> tuple[np.ndarray, np.ndarray | None]:
    """Return the poses (P, 4, 4) in mm of a table, and their times (P,) or None."""
    path = table.path
    columns = {name: values for name, values in table.columns.items() if name not in COVARIANCE_COLUMNS}
    times = columns.pop("time_s", None)
    if (numbers := columns.pop("pose", None)) is not None:
        log_warnings(path, _number_gaps(numbers, path))
    units = table.units
    if "heading" in columns and table.directions != _COMPASS:
        raise DescriptionError(
            f"{path} has a heading, clockwise from north, a yaw only for {', '.join(_COMPASS)} as x, y, z: "
            "name positions so, or convert it (for east, north, up: yaw = 90 deg - heading) and name it yaw"
        )
    axes = (known["axes"] or "") if (known := _FORMAT.fullmatch(pose_format)) else ""
    same = next((each for each in _SAME_ANGLES if each.keys() <= columns.keys()), {})
    if len(set(axes.lower())) != 2:  # proper Euler angles, such as ZXZ, have no roll
        columns, units = ({same.get(name, name): each for name, each in d.items()} for d in (columns, units))
    names = _order_names([*columns], pose_format, path)
    if axes and any(name not in ROTATION_NAMES and not name.isdigit() for name in names[3:]):
        log_warnings(path, [f"{', '.join(names[3:])} are read as angles about {', '.join(axes)}, in this order"])
    for name in names if axes else ROTATION_NAMES:
        stated = units.get(name, "")
        if name not in {*"xyz"} and stated and stated != pose_format.rpartition("-")[2]:
            raise DescriptionError(
                f"{path} has {name} in {stated}, but the format is {pose_format}: choose a format that ends "
                "with the angles' unit, -deg or -rad"
            )
    rows = np.column_stack([columns[name] for name in names]) if columns else np.empty((0, 0))
    wrong = np.flatnonzero(~np.isfinite(rows).all(axis=1))
    if len(wrong):
        raise DescriptionError(f"{path}: pose {wrong[0] + 1} has a number that is missing or not finite")
    poses = poses_from_rows(rows, pose_format, path)
    poses[:, :3, 3] *= table.mm_per_unit(unit=unit)
    return poses, times


def _number_gaps(numbers: np.ndarray, path: Path) -> list[str]:
    """Return a warning about numbers (P,) of poses that are left out; DescriptionError unless they increase."""
    steps = np.diff(numbers)
    if not (steps > 0).all():
        row = int(np.argmin(steps > 0)) + 1
        raise DescriptionError(
            f"{path}: pose {numbers[row]:g} follows pose {numbers[row - 1]:g}; expected each once, in order"
        )
    if len(steps) and steps.max() > (usual := steps.min()):
        row = int(np.argmax(steps > usual))
        return [
            f"there is no pose between {numbers[row]:g} and {numbers[row + 1]:g}: poses belong to images by their "
            "order, not by their numbers"
        ]
    return []


def _order_names(names: list[str], pose_format: PoseFormat, path: Path) -> list[str]:
    """Return the names of columns in the order of the format; raises DescriptionError if they contradict it."""
    kinds = (
        (("quaternion",), ("qw", "qx", "qy", "qz")),
        (("euler",), ("roll", "pitch", "yaw")),
        (("rotvec", "euler"), ("rx", "ry", "rz")),
        (("angle",), ("angle",)),
    )
    form, _, order = pose_format.partition("-")
    forms, turns = next((each for each in kinds if set(each[1]) <= set(names)), ((form,), ()))
    if form not in forms:
        raise DescriptionError(
            f"{path} has the columns {', '.join(names)}, but the format is {pose_format}: choose the format "
            "that the names describe"
        )
    found = [name for name in names if name not in turns]
    found = [*"xyz"] if {*"xyz"} == {*found} else found
    if any(name in {*"xyz"} and name != "xyz"[number : number + 1] for number, name in enumerate(found)):
        raise DescriptionError(
            f"{path} has the columns {', '.join(names)}: expected x, y and z first, or names of all columns, such as "
            "qw, qx, qy, qz"
        )
    if not turns or len(found) != (0 if form == "angle" else 3):
        return names
    if form == "quaternion":
        return [*found, *(f"q{axis}" for axis in order)]
    if form == "euler":
        axes = order[:3].lower()
        if len(set(axes)) < 3:
            raise DescriptionError(f"{path} names its angles by axis, but {pose_format} turns twice about one axis")
        return [*found, *(turns["xyz".index(axis)] for axis in axes)]
    return [*found, *turns]


def poses_from_rows(rows: np.ndarray, pose_format: str, path: Path) -> np.ndarray:
    if (known := _FORMAT.fullmatch(pose_format)) is None:
        raise DescriptionError(f"the format of the poses is {pose_format!r}; expected {_FORMATS}, or another order")
    expected = _COLUMNS[pose_format.partition("-")[0]]
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
        wrong = np.flatnonzero(~(np.abs(lengths - 1) <= _ROUNDED))  # not a number, too
        if len(wrong):
            raise DescriptionError(
                f"{path}: the quaternion of pose {wrong[0] + 1} has the length {lengths[wrong[0]]:.4g}; expected 1. "
                "Are x, y, z of the position first, then the quaternion?"
            )
        rotations = Rotation.from_quat(turns, scalar_first=pose_format == "quaternion-wxyz")
    else:
        if pose_format.endswith("-rad") and np.abs(turns).max() > 2 * np.pi + 0.01:
            raise DescriptionError(f"{path} has angles up to {np.abs(turns).max():g} rad: are they degrees (-deg)?")
        if pose_format.endswith("-deg") and _NEAR_HALF_TURN < np.abs(turns).max(initial=0) < np.pi + 0.01:
            log_warnings(path, [f"angles are at most {np.abs(turns).max():.4g} deg: are they radians (-rad)?"])
        angles = np.radians(turns) if pose_format.endswith("-deg") else turns
        axes = known["axes"]
        rotations = Rotation.from_euler(axes, angles) if axes else Rotation.from_rotvec(angles)
    result[:, :3, :3] = rotations.as_matrix()
    return result


def check_matrices(matrices: np.ndarray, source: object) -> np.ndarray:
    """Return rigid matrices (P, 4, 4) with exact rotations; raises DescriptionError if they are not rigid."""
    if matrices.ndim != 3 or matrices.shape[1:] != (4, 4):
        raise DescriptionError(f"{source}: the poses have the shape {matrices.shape}; expected (P, 4, 4)")
    for wrong, problem in (
        (~np.isfinite(matrices).all(axis=(1, 2)), "has a number that is not finite"),
        (np.abs(matrices[:, :3, 3]).max(axis=1) > FARTHEST_MM, f"is beyond {FARTHEST_MM:g} mm: is its unit right?"),
    ):
        if wrong.any():
            raise DescriptionError(f"{source}: pose {int(np.argmax(wrong)) + 1} {problem}")
    if not is_rigid(matrices, within=_ROUNDED):
        number = next(n for n, matrix in enumerate(matrices) if not is_rigid(matrix, within=_ROUNDED))
        matrix, hint = matrices[number], ""
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
