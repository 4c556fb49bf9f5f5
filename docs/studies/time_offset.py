"""Time offset of a robot that carries a profiler over a sphere at 100 mm/s: errors in simulated campaigns.

python docs/studies/time_offset.py [CAMPAIGNS] [--write]
"""

import sys
from pathlib import Path

import numpy as np
from cyclopts import App
from result_tables import publish, table
from scipy.spatial.transform import Rotation

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from tests.uwlts.mount_views import MOUNT, RADIUS_MM, SPHERE_MM, profile_of
from uwlts.calibration.mount.calibrate_mount import calibrate_mount

SPEED_MM_S = 100.0
SWEEPS = 16
NOISE_MM, ROBOT_MM = 0.03, 0.02


def error_ms(seed: int) -> tuple[float, float]:
    """Error of the offset and its stated standard uncertainty, ms, of sweeps along x and y at many attitudes."""
    rng = np.random.default_rng(seed)
    offset_s = rng.uniform(-0.02, 0.02)
    profiles, times, poses, pose_times = [], [], [], []
    for sweep in range(SWEEPS):
        attitude = Rotation.from_euler("x", np.pi) * Rotation.from_rotvec(rng.uniform(-1, 1, 3) * np.radians(25))
        across, spin = sweep % 2 == 0, rng.uniform(-0.1, 0.1, 3)
        way = np.eye(3)[0 if across else 1] * (1 if sweep % 4 < 2 else -1)
        y_mm = rng.uniform(-0.5, 0.5) * RADIUS_MM if across else 0.0
        place = np.array([rng.uniform(-25, 25), y_mm, 220 + rng.uniform(-30, 30)])

        def sensor(at_s: float, attitude=attitude, spin=spin, place=place, way=way) -> np.ndarray:
            pose = np.eye(4)
            pose[:3, :3] = (attitude * Rotation.from_rotvec(spin * at_s)).as_matrix()
            pose[:3, 3] = SPHERE_MM - pose[:3, :3] @ (place - SPEED_MM_S * at_s * way)
            return pose

        for at_s in np.linspace(-0.1, 0.1, 5):
            profiles.append(profile_of(sensor(at_s), rng, noise_mm=NOISE_MM))
            times.append(2.0 * sweep + at_s)
        for at_s in np.linspace(-0.4, 0.4, 81):
            pose = sensor(at_s) @ np.linalg.inv(MOUNT)
            pose[:3, 3] += ROBOT_MM * rng.standard_normal(3)
            poses.append(pose)
            pose_times.append(2.0 * sweep + at_s + offset_s)
    clocks = {"profile_times_s": np.array(times), "pose_times_s": np.array(pose_times)}
    mount = calibrate_mount(profiles, np.array(poses), radius_mm=RADIUS_MM, time=True, **clocks)
    assert mount.time_offset_s is not None and mount.time_offset_std_s is not None
    return 1e3 * (mount.time_offset_s - offset_s), 1e3 * mount.time_offset_std_s


def main(campaigns: int = 16, *, write: bool = False) -> None:
    """Print the errors; with `--write`, put them into their page."""
    found = np.array([error_ms(seed) for seed in range(campaigns)])
    rms, largest, stated = np.sqrt(np.mean(found[:, 0] ** 2)), np.abs(found[:, 0]).max(), found[:, 1].mean()
    head = ["campaigns", "error, rms ms", "largest ms", "stated ms"]
    row = [str(len(found)), *(f"{value:.3f}" for value in (rms, largest, stated))]
    publish({"time offset": table(head, [row])}, write=write)


if __name__ == "__main__":
    App(help=__doc__, help_format="plaintext", default_command=main)()
