"""Mounts of the sets of `tests.oracles.profilers`, their errors and scatter, and plain least squares beside them."""

from typing import Any

import numpy as np
from scipy.optimize import least_squares

import uwlts
from tests.oracles.profilers import ProfilerSet, pose_of, scatter_mm, turn_between, turn_by
from uwlts.model.mount import Mount, PlaneFound, SphereFound

SHORT_ARCS: dict[str, Any] = {
    "points": 2000,
    "noise_mm": 0.009,
    "smooth_mm": 0.07,
    "robot_mm": 0.05,
    "scattered": 0.15,
    "background": False,
    "steepest": np.radians(32),
}
"""Options of a sphere with a visible arc of 60 deg, scattered points around and within it, and a smooth error."""


def mount_of(given: ProfilerSet, *, size_known: bool = True) -> Mount:
    """Calibrate the mount of a set."""
    radius_mm = given.size_mm if size_known and given.kind == "sphere" else None
    return uwlts.calibrate_mount(given.profiles, given.poses, artefact_kind=given.kind, radius_mm=radius_mm)


def rms_mm(given: ProfilerSet, mount: Mount) -> float:
    """Root mean square distance of all true points of the artefact, of all poses, from the artefact as found."""
    found = mount.artefact
    if isinstance(found, SphereFound):
        place, axis, size = np.array(found.centre_mm), np.zeros(3), found.radius_mm
    else:
        assert isinstance(found, PlaneFound)
        axis = np.array(found.normal)
        place, size = axis * found.distance_mm, 0.0
    return float(np.sqrt(np.mean(scatter_mm(given, mount.transform(), place, axis, size) ** 2)))


def differences(mount: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Differences (6,) of two mounts (4, 4): shift, mm, and rotation about the platform's axes, rad."""
    return np.append(mount[:3, 3] - other[:3, 3], turn_between(other[:3, :3], mount[:3, :3]))


def least_squares_mount(given: ProfilerSet, *, size_known: bool) -> tuple[np.ndarray, float]:
    """Return the mount (4, 4) by plain least squares from the true values, and the rms distance of the points, mm."""
    axes = given.artefact[:3, :3]
    # Along a plane nothing changes: these steps are not parameters.
    free = {"sphere": (0, 1, 2), "plane": (2, 3, 4)}[given.kind]
    sized = given.kind == "sphere" and not size_known

    def moved(values: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
        step = np.zeros(5)
        step[list(free)] = values[6 : 6 + len(free)]
        mount = given.mount @ pose_of(turn_by(values[3:6]), values[:3])
        axis = axes @ turn_by(np.array([step[3], step[4], 0.0])) @ [0, 0, 1]
        return mount, given.artefact[:3, 3] + axes @ step[:3], axis, given.size_mm + (values[-1] if sized else 0.0)

    solution = least_squares(
        lambda values: scatter_mm(given, *moved(values)), np.zeros(6 + len(free) + sized), x_scale="jac"
    )
    return moved(solution.x)[0], float(np.sqrt(np.mean(solution.fun**2)))
