"""The mount that belongs to a recalibrated sensor: moved and better known by the passes."""

from dataclasses import dataclass

import numpy as np

from uwlts.model.calibration import Calibration, calibration_digest
from uwlts.model.mount import Mount, SensorShare
from uwlts.recalibration.pass_estimate import PassProblem, PassSolution

_NEGLIGIBLE = 1e-12
"""Smallest eigenvalue of the parameters' correlations that is no rounding error."""


@dataclass(frozen=True, eq=False)
class MovedMount:
    """Mount after the passes, and its change (7,) with standard uncertainties before and after: mm, rad, s."""

    mount: Mount
    change: np.ndarray
    before: np.ndarray
    after: np.ndarray

    def lines(self) -> list[str]:
        """Describe the change."""
        rows = [("position", "mm", slice(0, 3), 1.0), ("direction", "deg", slice(3, 6), float(np.degrees(1.0)))]
        rows += [("clock offset", "ms", slice(6, 7), 1e3)] if self.before[6] > 0 else []
        lines = []
        for name, unit, part, factor in rows:
            values = (factor * each[part] for each in (self.change, self.before, self.after))
            moved, before, after = (", ".join(f"{value:.3f}" for value in each) for each in values)
            lines.append(f"mount, {name}: changed by {moved} {unit}; standard uncertainty {before} before, {after} now")
        return lines


def move_mount(mount: Mount, problem: PassProblem, solution: PassSolution, calibration: Calibration) -> MovedMount:
    """Return the mount for the OCS of the new calibration, with their correlation."""
    assert problem.mount is not None
    by, count = problem.mount.by, problem.root.shape[1]
    components, covariance = solution.amplitudes[:count], solution.covariance[:count, :count]
    moved = problem.moved(solution.amplitudes)
    # The sheet defines the OCS, which moves with it; the mount's change belongs to the OCS of the earlier calibration.
    corrected = problem.mount.correction(components) @ problem.earlier_from_moved(moved)
    transform = problem.mount.transform @ corrected
    lever = problem.mount.transform[:3, :3] @ corrected[:3, 3]
    in_place = by.copy()
    in_place[:3] += np.cross(by[3:6].T, lever).T
    of_mount = in_place @ covariance @ in_place.T
    shared, of_parameters = in_place @ covariance @ problem.root.T, problem.root @ covariance @ problem.root.T
    std = np.sqrt(np.diag(of_parameters))
    inverse = np.linalg.pinv(of_parameters / np.outer(std, std), rcond=_NEGLIGIBLE, hermitian=True)
    by_parameters = shared[:6] @ (inverse / np.outer(std, std))
    apart = of_mount[:6, :6] - by_parameters @ shared[:6].T
    changes = {
        "T_platform_sensor": transform,
        "covariance": 0.5 * (of_mount + of_mount.T)[:6, :6],
        "sensor": SensorShare(
            calibration=calibration_digest(calibration),
            by_parameters=tuple(map(tuple, by_parameters.tolist())),
            covariance_apart=tuple(map(tuple, (0.5 * (apart + apart.T)).tolist())),
        ),
    }
    change = by @ components
    if mount.time_offset_std_s:
        changes["time_offset_s"] = (mount.time_offset_s or 0.0) + float(change[6])
        changes["time_offset_std_s"] = float(np.sqrt(of_mount[6, 6]))
    if mount.robot_scale is not None:
        scale = problem.motion.pose_scale
        changes["robot_scale"] = mount.robot_scale * (1.0 + scale * float(solution.amplitudes[count]))
        changes["robot_scale_std"] = scale * float(np.sqrt(solution.covariance[count, count]))
    for name in ("T_platform_sensor", "covariance"):
        changes[name] = tuple(map(tuple, np.asarray(changes[name]).tolist()))
    before, after = np.linalg.norm(by, axis=1), np.sqrt(np.einsum("iu,uv,iv->i", by, covariance, by))
    return MovedMount(mount.model_copy(update=changes), change, before, after)
