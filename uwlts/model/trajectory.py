"""The path of a platform: its poses at known times, and between them."""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

from uwlts.errors import DescriptionError
from uwlts.files.writing import written_aside
from uwlts.model.brief import Brief
from uwlts.model.calibration import is_rigid

_ROUNDED = 1e-6
_LARGEST_DRIFT_PPM = 10_000.0
"""A hundred times the worst quartz: more is a mistaken unit."""
COVARIANCE_COLUMNS = {f"cov_{i}{j}": (i, j) for i in range(6) for j in range(i, 6)}
"""Names of a file's columns with the upper triangle of each covariance, and their places in it."""


@dataclass(frozen=True, eq=False, repr=False)
class Trajectory(Brief):
    """Poses of a platform at growing times.

    Between them positions follow a cubic spline and rotations one with continuous angular acceleration (SciPy's
    `CubicSpline` and `RotationSpline`), so that velocity and rate of turn are continuous.

    Attributes
    ----------
    times_s : (N,) float64
    poses : (N, 4, 4) float64
        ``T_base_platform``, mm.
    covariance : (N, 6, 6) float64, optional
        Of each pose: the shift in mm, then a further rotation in rad about the base's axes, R_true = exp(rotation) R.

    Raises
    ------
    DescriptionError
        Fewer than two poses, times that are not finite or do not grow, or matrices that are not rigid.
    """

    times_s: np.ndarray
    poses: np.ndarray
    covariance: np.ndarray | None = None

    def __post_init__(self) -> None:
        times, poses = np.array(self.times_s, dtype=np.float64), np.array(self.poses, dtype=np.float64)
        if times.ndim != 1 or poses.shape != (len(times), 4, 4) or len(times) < 2:
            raise DescriptionError(
                f"a trajectory has times (N,) and poses (N, 4, 4) for two or more times; found {times.shape} and "
                f"{poses.shape}"
            )
        if not np.isfinite(times).all() or not (np.diff(times) > 0).all():
            wrong = int(np.argmin(np.append(np.inf, np.diff(times)) > 0))
            raise DescriptionError(
                f"the times of a trajectory must be finite and grow: pose {wrong + 1} is at {times[wrong]:g} s"
            )
        if not is_rigid(poses, within=_ROUNDED):
            raise DescriptionError("the poses of a trajectory must be rotations with a shift (0 0 0 1 as last row)")
        known = {"times_s": times, "poses": poses}
        if self.covariance is not None:
            known["covariance"] = _checked_covariances(self.covariance, len(times))
        for name, values in known.items():
            values.flags.writeable = False
            object.__setattr__(self, name, values)

    def save(self, path: str | Path, *, overwrite: bool = False) -> None:
        """Write the path as CSV of the format quaternion-xyzw, mm, with covariances; OutputError if that fails."""
        turns = Rotation.from_matrix(self.poses[:, :3, :3]).as_quat()
        table = np.column_stack([self.times_s, self.poses[:, :3, 3], turns])
        names = ["time_s", "x_mm", "y_mm", "z_mm", "qx", "qy", "qz", "qw"]
        if self.covariance is not None:
            names += COVARIANCE_COLUMNS
            table = np.column_stack([table, *(self.covariance[:, i, j] for i, j in COVARIANCE_COLUMNS.values())])
        with written_aside(path, overwrite=overwrite) as aside:
            np.savetxt(aside, table, fmt="%.12g", delimiter=",", header=",".join(names), comments="")

    @cached_property
    def _positions(self) -> CubicSpline:
        return CubicSpline(self.times_s, self.poses[:, :3, 3])

    @cached_property
    def _rotations(self) -> RotationSpline:
        return RotationSpline(self.times_s, Rotation.from_matrix(self.poses[:, :3, :3]))

    def rates_at(self, times_s: np.ndarray) -> np.ndarray:
        """Velocities in mm/s and turns in rad/s (M, 6) in the base frame at times (M,) within the path."""
        wanted = np.asarray(times_s, dtype=np.float64)
        # SciPy's rates are in the moving frame.
        turns = self._rotations(wanted).apply(self._rotations(wanted, 1))
        return np.hstack([self._positions(wanted, 1), turns])

    def covariance_at(self, times_s: np.ndarray) -> np.ndarray | None:
        """Covariances (M, 6, 6) at times (M,), linear between those of the poses; None where they are not known."""
        if self.covariance is None:
            return None
        flat = self.covariance.reshape(len(self.times_s), 36)
        at = np.stack([np.interp(times_s, self.times_s, column) for column in flat.T], axis=1)
        return at.reshape(-1, 6, 6)

    def poses_at(self, times_s: np.ndarray) -> np.ndarray:
        """``T_base_platform`` (M, 4, 4) at times (M,), mm; DescriptionError for times before or after the path."""
        wanted = np.asarray(times_s, dtype=np.float64)
        first, last = self.times_s[[0, -1]]
        if outside := int(np.count_nonzero(~((wanted >= first) & (wanted <= last)))):
            raise DescriptionError(
                f"{outside} of {wanted.size} times, {wanted.min():.3f} to {wanted.max():.3f} s, lie outside the "
                f"trajectory, which lasts from {first:.3f} to {last:.3f} s: is the offset of the clocks right?"
            )
        poses = np.tile(np.eye(4), (len(wanted), 1, 1))
        poses[:, :3, :3] = self._rotations(wanted).as_matrix()
        poses[:, :3, 3] = self._positions(wanted)
        return poses


def on_clock(times_s: np.ndarray, *, offset_s: float, drift_ppm: float) -> np.ndarray:
    """Times (N,) of a camera by the clock of its platform, s, which is ahead by ``offset_s`` at the first of them, and
    runs faster by ``drift_ppm`` parts in a million.

    DescriptionError where these are not finite, or the drift is larger than any clock's.
    """
    if not (np.isfinite(offset_s) and abs(drift_ppm) <= _LARGEST_DRIFT_PPM):
        raise DescriptionError(
            f"the platform's clock is ahead by {offset_s:g} s and drifts by {drift_ppm:g} ppm; expected finite "
            f"numbers, and a drift of up to {_LARGEST_DRIFT_PPM:g} ppm"
        )
    return times_s + offset_s + 1e-6 * drift_ppm * (times_s - np.min(times_s, initial=np.inf))


def _checked_covariances(values: np.ndarray, count: int) -> np.ndarray:
    """Covariances (N, 6, 6) of N poses; DescriptionError where they are none."""
    covariances = np.array(values, dtype=np.float64)
    if covariances.shape != (count, 6, 6) or not np.isfinite(covariances).all():
        raise DescriptionError(
            f"the covariances of {count} poses are finite numbers ({count}, 6, 6); found {covariances.shape}"
        )
    sizes = np.sqrt(np.maximum(np.einsum("nii->ni", covariances), 1e-30))
    scaled = covariances / (sizes[:, :, None] * sizes[:, None])
    lopsided = np.abs(scaled - np.swapaxes(scaled, 1, 2)).max(axis=(1, 2)) > _ROUNDED
    wrong = lopsided | (np.linalg.eigvalsh(scaled)[:, 0] < -_ROUNDED)
    if wrong.any():
        raise DescriptionError(
            f"the covariance of pose {int(np.argmax(wrong)) + 1} must be symmetric and without negative variances"
        )
    return covariances
