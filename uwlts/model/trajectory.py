"""Trajectory of a platform: poses at known times, and interpolation between them."""

from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import cached_property
from pathlib import Path

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

from uwlts.argument_types import check_arguments
from uwlts.errors import DescriptionError
from uwlts.files.writing import require_ending, write_atomically
from uwlts.model.sensor import is_rigid
from uwlts.model.short_text import Brief

_ROUNDED = 1e-6  # deviation of poses and correlations that files with six digits have
_LARGEST_DRIFT_PPM = 10_000.0  # a hundred times the drift of the worst quartz; larger values indicate a wrong unit
_CLOCKS_S = {18: "UTC and GNSS", 19: "GNSS and TAI", 37: "UTC and TAI"}
"""Whole seconds between time scales since 2017 (IERS Bulletin C)."""
_UNIX_S = 946_684_800.0, 4_102_444_800.0  # Unix times from 2000 to 2100
COVARIANCE_COLUMNS = {f"cov_{i}{j}": (i, j) for i in range(6) for j in range(i, 6)}
"""Names of a file's columns with the upper triangle of each covariance, and their row and column in it."""


@dataclass(frozen=True, eq=False, repr=False)
class Trajectory(Brief):
    """Poses of a platform at increasing times.

    Positions are interpolated by a cubic spline and rotations by a spline with continuous angular acceleration (SciPy's
    `CubicSpline` and `RotationSpline`). Velocity and angular velocity are therefore continuous.

    Attributes
    ----------
    times_s : (N,) float64
    poses : (N, 4, 4) float64
        ``T_base_platform``, mm.
    covariance : (N, 6, 6) float64, optional
        Of each pose: translation in mm, and small rotation in rad about the base's axes, R_true = exp(rotation) R.
    warnings : list of str
        Omissions by the reader of a file, for example of repeated poses.

    Raises
    ------
    DescriptionError
        Fewer than two poses, times that are not finite or do not increase, or matrices that are not rigid.
    """

    times_s: np.ndarray
    poses: np.ndarray
    covariance: np.ndarray | None = None
    warnings: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        times, poses = np.array(self.times_s, dtype=np.float64), np.array(self.poses, dtype=np.float64)
        if times.ndim != 1 or poses.shape != (len(times), 4, 4) or len(times) < 2:
            raise DescriptionError(
                f"a trajectory needs times (N,) and poses (N, 4, 4) with N >= 2; found {times.shape} and {poses.shape}"
            )
        if not np.isfinite(times).all() or not (np.diff(times) > 0).all():
            wrong = int(np.argmin(np.append(np.inf, np.diff(times)) > 0))
            before = f", pose {wrong} at {format_time(times[wrong - 1])}" if wrong else ""
            raise DescriptionError(
                "the times of a trajectory must be finite and increase: "
                f"pose {wrong + 1} is at {format_time(times[wrong])}{before}"
            )
        if not is_rigid(poses, within=_ROUNDED):
            raise DescriptionError("the poses of a trajectory must be rigid transforms with 0 0 0 1 as last row")
        known = {"times_s": times, "poses": poses}
        if self.covariance is not None:
            known["covariance"] = _check_covariances(self.covariance, len(times))
        for name, values in known.items():
            values.flags.writeable = False
            object.__setattr__(self, name, values)

    @check_arguments
    def save(self, path: str | Path, *, overwrite: bool = False) -> None:
        """Write the trajectory as CSV, format quaternion-xyzw, mm, with covariances; OutputError if that fails."""
        require_ending(Path(path), (".csv",))
        turns = Rotation.from_matrix(self.poses[:, :3, :3]).as_quat()
        table = np.column_stack([self.times_s, self.poses[:, :3, 3], turns])
        names = ["time_s", "x_mm", "y_mm", "z_mm", "qx", "qy", "qz", "qw"]
        if self.covariance is not None:
            names += COVARIANCE_COLUMNS
            table = np.column_stack([table, *(self.covariance[:, i, j] for i, j in COVARIANCE_COLUMNS.values())])
        with write_atomically(path, overwrite=overwrite) as aside:
            # Unix times need more digits than positions.
            formats = ["%.16g", *["%.12g"] * (len(names) - 1)]
            np.savetxt(aside, table, fmt=formats, delimiter=",", header=",".join(names), comments="")

    @cached_property
    def _positions(self) -> CubicSpline:
        return CubicSpline(self.times_s, self.poses[:, :3, 3])

    @cached_property
    def _rotations(self) -> RotationSpline:
        return RotationSpline(self.times_s, Rotation.from_matrix(self.poses[:, :3, :3]))

    def rates_at(self, times_s: np.ndarray) -> np.ndarray:
        """Return velocities in mm/s and angular velocities in rad/s (M, 6) in the base frame at times (M,)."""
        wanted = np.asarray(times_s, dtype=np.float64)
        # SciPy's angular velocities are in the moving frame.
        turns = self._rotations(wanted).apply(self._rotations(wanted, 1))
        return np.hstack([self._positions(wanted, 1), turns])

    def margins_s(self, times_s: np.ndarray) -> tuple[float, float]:
        """Return how long the trajectory starts before and ends after times (M,), s."""
        return float(times_s.min() - self.times_s[0]), float(self.times_s[-1] - times_s.max())

    def covariance_at(self, times_s: np.ndarray) -> np.ndarray | None:
        """Interpolate the covariances (M, 6, 6) linearly at times (M,); None if they are unknown."""
        if self.covariance is None:
            return None
        flat = self.covariance.reshape(len(self.times_s), 36)
        return np.stack([np.interp(times_s, self.times_s, column) for column in flat.T], axis=1).reshape(-1, 6, 6)

    def poses_at(self, times_s: np.ndarray) -> np.ndarray:
        """Interpolate ``T_base_platform`` (M, 4, 4), mm, at times (M,); DescriptionError outside the trajectory."""
        wanted = np.asarray(times_s, dtype=np.float64)
        first, last = self.times_s[[0, -1]]
        if outside := int(np.count_nonzero(~((wanted >= first) & (wanted <= last)))):
            raise DescriptionError(
                f"{outside} of {wanted.size} times, {format_time(wanted.min())} to {format_time(wanted.max())}, are "
                f"outside the trajectory from {format_time(first)} to {format_time(last)}: check the offset of the "
                f"clocks{_suggest_shift(first - wanted.min(), last - wanted.max())}"
            )
        poses = np.tile(np.eye(4), (len(wanted), 1, 1))
        poses[:, :3, :3] = self._rotations(wanted).as_matrix()
        poses[:, :3, 3] = self._positions(wanted)
        return poses


def _suggest_shift(least_s: float, most_s: float) -> str:
    """Return a difference of usual clocks within two limits as an ending of a message; empty without."""
    hours = round((least_s + most_s) / 7200)
    known = {sign * shift: name for shift, name in _CLOCKS_S.items() for sign in (1, -1)}
    known |= {3600 * hours: "time zones"} if hours else {}
    fitting = [shift for shift in known if least_s <= shift <= most_s]
    if not fitting:
        return ""
    shift = min(fitting, key=abs)
    return f". With `clock_offset_s` {shift}, as between {known[shift]}, all are inside"


def format_time(time_s: float) -> str:
    """Return a time in s for a message, with the date if it is a Unix time after 2000."""
    text = f"{time_s:.9f}".rstrip("0").rstrip(".") + " s"
    if not _UNIX_S[0] < time_s < _UNIX_S[1]:
        return text
    return f"{text} ({datetime.fromtimestamp(time_s, UTC):%Y-%m-%d %H:%M:%S.%f} UTC)"


def convert_to_platform_clock(times_s: np.ndarray, *, offset_s: float, drift_ppm: float) -> np.ndarray:
    """Convert times (N,) in s from the camera's clock to the platform's clock.

    The platform's clock is ahead by ``offset_s`` at the first time, and runs faster by ``drift_ppm``. Raises
    DescriptionError if a number is not finite, or the drift is larger than any clock's.
    """
    if not (np.isfinite(offset_s) and abs(drift_ppm) <= _LARGEST_DRIFT_PPM):
        raise DescriptionError(
            f"the platform's clock is ahead by {offset_s:g} s and drifts by {drift_ppm:g} ppm; expected finite "
            f"numbers, and a drift of up to {_LARGEST_DRIFT_PPM:g} ppm"
        )
    return times_s + offset_s + 1e-6 * drift_ppm * (times_s - np.min(times_s, initial=np.inf))


def _check_covariances(values: np.ndarray, count: int) -> np.ndarray:
    """Return covariances (N, 6, 6) of N poses as an array; DescriptionError if they are invalid."""
    covariances = np.array(values, dtype=np.float64)
    if covariances.shape != (count, 6, 6) or not np.isfinite(covariances).all():
        raise DescriptionError(
            f"the covariances of {count} poses must be finite numbers ({count}, 6, 6); found {covariances.shape}"
        )
    sizes = np.sqrt(np.maximum(np.einsum("nii->ni", covariances), 1e-30))
    with np.errstate(over="ignore", invalid="ignore"):
        scaled = covariances / (sizes[:, :, None] * sizes[:, None])
        lopsided = np.abs(scaled - np.swapaxes(scaled, 1, 2)).max(axis=(1, 2)) > _ROUNDED
    wrong = lopsided | (np.abs(scaled).max(axis=(1, 2)) > 1 + _ROUNDED)
    # Eigenvalues of other matrices may overflow.
    wrong[~wrong] = np.linalg.eigvalsh(scaled[~wrong])[:, 0] < -_ROUNDED
    if wrong.any():
        raise DescriptionError(
            f"the covariance of pose {int(np.argmax(wrong)) + 1} must be symmetric and without negative variances"
        )
    return covariances
