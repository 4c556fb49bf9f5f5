"""Profiles of a sphere by a sensor on a robot, with calibration errors drawn from the calibration's covariance.

Stripe centres are calculated with the true parameters, from rays that meet the sheet on the sphere. Profiles are
calculated from them with the calibration.
"""

import numpy as np
from scipy.spatial.transform import Rotation

from tests.uwlts.calibration_views import built_sensor
from tests.uwlts.joint_views import MEDIUM, Noise, gathered, target_series
from tests.uwlts.mount_views import MOUNT, SPHERE_MM
from uwlts.calibration.calibrate import solve_jointly
from uwlts.calibration.joint.stored_estimate import StoredEstimate, read_stored_estimate
from uwlts.calibration.mount.captured_profiles import CapturedProfiles
from uwlts.calibration.sequential.sequential_calibration import CalibrationOptions
from uwlts.calibration.sequential.sheet_fit import object_frame
from uwlts.fitting.next_observation import CovarianceRoot
from uwlts.model.sensor import Sensor
from uwlts.model.stripe import stack_pixels

RADIUS_MM = 19.05
LINES = np.arange(120, 1160, 8)


def joint_estimate(thesis: Sensor) -> StoredEstimate:
    """Return a joint estimate from a target in water; its sheet is known to some tenths of a millimetre."""
    noise = Noise(circles_px=0.03, stripe_px=0.1, stage_mm=0.003, rng=np.random.default_rng(4))
    series = target_series(built_sensor(), medium=0, positions=np.arange(6) * 36.0 - 120.0, noise=noise)
    options = CalibrationOptions(poses="stage", correct_circles=False)
    return read_stored_estimate(solve_jointly(gathered(thesis, [series]), options=options).calibration, thesis, MEDIUM)


def largest_parts(known, by, count=3):
    """Return the independent parts (count, P) of parameter errors with the largest effect on a mount."""
    root = CovarianceRoot.from_covariance(known.covariance).root
    return root[:, np.argsort(-np.linalg.norm(by @ root[: by.shape[1]] * 1e3, axis=0))[:count]].T


def half_way(first, second):
    """Return half of the difference between two mounts (6,): shift, mm, and rotation, rad."""
    turn = Rotation.from_matrix(first[:3, :3] @ second[:3, :3].T).as_rotvec()
    return np.append(first[:3, 3] - second[:3, 3], turn) / 2


def captured_by(
    known: StoredEstimate, values: np.ndarray, rng: np.random.Generator, *, poses: int = 15, noise_px: float = 0.1
) -> CapturedProfiles:
    """Return profiles by the calibration from images of a sensor with parameters ``values`` (P,), on an ideal robot."""
    stripes, platforms = [], []
    for number in range(poses):
        turned = Rotation.from_euler("x", np.pi) * Rotation.from_rotvec(rng.uniform(-1, 1, 3) * np.radians(25))
        side = (-1) ** number
        place = np.array([side * rng.uniform(0.3, 0.6) * RADIUS_MM, rng.uniform(-35, 35), rng.uniform(-30, 30)])
        base_sensor = np.eye(4)
        base_sensor[:3, :3] = turned.as_matrix()
        base_sensor[:3, 3] = SPHERE_MM - base_sensor[:3, :3] @ place
        found = stripe_of_sphere(known, values, place)
        stripes.append(found + np.column_stack([np.zeros(len(found)), noise_px * rng.standard_normal(len(found))]))
        platforms.append(base_sensor @ np.linalg.inv(MOUNT))
    profiles = [known.triangulate(*each.T)[0] for each in stripes]
    return CapturedProfiles(profiles, stripes, np.arange(poses, dtype=float), np.array(platforms), None, known)


def stripe_of_sphere(known: StoredEstimate, values: np.ndarray, centre_mm: np.ndarray) -> np.ndarray:
    """Return lines and stripe centres (n, 2) on a sphere, seen by the sensor with these parameters (centre in OCS)."""
    parameters = known.parameters
    frame = object_frame(parameters.sheet_model(values), laser_axis=parameters.sheet.axis)
    reach = np.arange(150.0, 900.0, 15.0)

    def points(line: np.ndarray, centre_px: np.ndarray) -> np.ndarray:
        pixels = stack_pixels(line, centre_px, stripe_along=known.calibration.stripe_along)
        seen = parameters.stripe_points(values, known.view, pixels, across=0)
        assert seen is not None
        return (seen.points.T - frame[:3, 3]) @ frame[:3, :3]

    line, at = (each.ravel() for each in np.meshgrid(LINES, reach, indexing="ij"))
    seen = points(line, at)
    off = (np.linalg.norm(seen - centre_mm, axis=1) - RADIUS_MM).reshape(len(LINES), -1)
    depth = seen[:, 2].reshape(len(LINES), -1)
    changes = np.signbit(off[:, 1:]) != np.signbit(off[:, :-1])
    hit = np.flatnonzero(changes.any(axis=1))
    # The side of the sphere towards the sensor.
    first = np.array([min(np.flatnonzero(changes[row]), key=lambda k, row=row: depth[row, k]) for row in hit])
    low, high = reach[first], reach[first + 1]
    sign = np.signbit(off[hit, first])
    for _ in range(30):
        middle = (low + high) / 2
        same = np.signbit(np.linalg.norm(points(LINES[hit], middle) - centre_mm, axis=1) - RADIUS_MM) == sign
        low, high = np.where(same, middle, low), np.where(same, high, middle)
    return np.column_stack([LINES[hit], (low + high) / 2])
