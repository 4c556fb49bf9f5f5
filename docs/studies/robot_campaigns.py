"""Mounts from rendered robot campaigns: errors, coverage, and points on the sphere from poses that were held out.

Sensors, their calibrations and the robot's captures of a sphere, with their truth, are those of `moving_recordings.py`:

    for k in 1 2 3 4 5; do
        python docs/studies/moving_recordings.py FOLDER robot-sphere --sensors $k --seeds ${k}0 ${k}1 ${k}2 ${k}3
    done
    python docs/studies/robot_campaigns.py FOLDER
"""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
from cyclopts import App
from result_tables import publish, table
from scipy.spatial.transform import Rotation

import uwlts
from twin.scene.description import Scene
from twin.scene.platform_kinds import Robot
from uwlts.calibration.mount.captured_profiles import CapturedProfiles, reconstruct_profiles
from uwlts.model.calibration import Calibration
from uwlts.model.mount import Mount, SphereFound
from uwlts.shapes.sphere import Sphere
from uwlts.storage.truth import read_truth, truth_path

FOR_THE_MOUNT = 15
RADIUS_MM = 19.05


def scatter_mm(captured: CapturedProfiles, mount: np.ndarray, centre_mm: np.ndarray) -> float:
    """Return the root mean square distance of points from the best-fitting sphere of known radius."""
    placed = captured.poses @ mount
    points = np.vstack([p @ pose[:3, :3].T + pose[:3, 3] for p, pose in zip(captured.profiles, placed, strict=True)])
    for _ in range(5):
        near = np.abs(np.linalg.norm(points - centre_mm, axis=1) - RADIUS_MM) < 0.5
        fit = Sphere.fit(points[near], RADIUS_MM)
        centre_mm = fit.centre_mm
    return float(np.sqrt(np.mean(fit.residuals_mm**2)))


def errors(mount: Mount, true: np.ndarray) -> np.ndarray:
    """Error (6,) of translation, mm, and rotation, rad, about the platform's axes."""
    found = mount.transform()
    turn = Rotation.from_matrix(true[:3, :3] @ found[:3, :3].T).as_rotvec()
    return np.append(true[:3, 3] - found[:3, 3], turn)


def select_profiles(captured: CapturedProfiles, numbers: np.ndarray) -> CapturedProfiles:
    """Return some of the profiles, each with its own pose."""
    profiles, stripes = ([each[number] for number in numbers] for each in (captured.profiles, captured.stripes))
    times, poses = captured.times_s[numbers], captured.poses[numbers]
    return replace(captured, profiles=profiles, stripes=stripes, times_s=times, poses=poses)


def main(folder: Path, *, write: bool = False) -> None:
    """Print the table; with `--write`, put it into its page."""
    figures: dict[str, list[tuple[float, ...]]] = {}
    for path in sorted(folder.glob("sensor-*/robot-sphere-*.h5")):
        if ".truth." in path.name:
            continue
        calibration = uwlts.read(path.parent / "calibration.json")
        assert isinstance(calibration, Calibration)
        header, truth = read_truth(truth_path(path))
        motion = Scene.model_validate(header.scene).motion
        assert isinstance(motion, Robot) and truth.pose is not None
        true = (motion.true_mount or motion.mount).matrix()
        with uwlts.read(path) as capture:
            reported = reconstruct_profiles(capture, calibration, None, None)
        ideal = profiles_of_poses(reported, truth.pose @ np.linalg.inv(true))
        for name, captured in {"ideal": ideal, "as reported": reported}.items():
            numbers = np.split(np.arange(len(captured.poses)), [FOR_THE_MOUNT])
            first, held = (select_profiles(captured, each) for each in numbers)
            mount = uwlts.calibrate_mount(first, radius_mm=RADIUS_MM)
            assert isinstance(mount.artefact, SphereFound) and mount.sensor is not None
            off, centre = errors(mount, true), np.array(mount.artefact.centre_mm)
            ratio = scatter_mm(held, mount.transform(), centre) / scatter_mm(held, true, centre)
            sizes = np.linalg.norm(off[:3]), np.degrees(np.linalg.norm(off[3:]))
            apart = np.sqrt(np.diag(mount.sensor.covariance_apart))
            within = [np.mean(np.abs(off) < mount.coverage_factor * std) for std in (mount.std(), apart)]
            row = (*sizes, ratio, mount.point_std_mm, mount.pose_std_mm, *within)
            figures.setdefault(name, []).append(tuple(map(float, row)))
            print(path, name, np.round(row, 4), np.round(off / mount.std(), 2), mount.std(), file=sys.stderr)
    rows = []
    for name, values in figures.items():
        mean = np.mean(values, axis=0)
        cells = [f"{mean[0]:.3f}", f"{mean[1]:.4f}", f"{mean[2]:.3f}"]
        rows.append([name, str(len(values)), *cells, *(f"{100 * share:.0f}" for share in mean[5:])])
    head = ["robot", "campaigns", "shift mm", "rotation deg", "held-out sphere / own error"]
    head += ["within 95 % interval, %", "sensor taken as exact, %"]
    publish({"mount by a robot": table(head, rows)}, write=write)


def profiles_of_poses(captured: CapturedProfiles, poses: np.ndarray) -> CapturedProfiles:
    """Return the same profiles with other poses."""
    return CapturedProfiles(**{**vars(captured), "poses": poses})


if __name__ == "__main__":
    App(help=__doc__, help_format="plaintext", default_command=main)()
