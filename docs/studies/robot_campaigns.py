"""Mounts from rendered robot campaigns: errors, coverage, and points on the sphere from poses that were held out.

Of each campaign the robot's capture of a sphere and its truth are read; the sensor's calibration is given:

    python docs/studies/robot_campaigns.py calibration.json FOLDER/robot-*.h5
"""

import sys
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation
from stripe_tables import table

import uwlts
from twin.scene.description import Scene
from twin.scene.platforms import Robot
from uwlts.calibration.mount import profiles_of
from uwlts.metrology.fits import fit_sphere
from uwlts.model.calibration import Calibration
from uwlts.model.mount import Mount, SphereFound
from uwlts.storage.truth import read_truth, truth_path

FOR_THE_MOUNT = 15
RADIUS_MM = 19.05


def scatter_mm(profiles: list[np.ndarray], poses: np.ndarray, mount: np.ndarray, centre_mm: np.ndarray) -> float:
    """Root mean square distance of the points on a sphere of known radius from that which fits them best."""
    points = np.vstack(
        [p @ (pose @ mount)[:3, :3].T + (pose @ mount)[:3, 3] for p, pose in zip(profiles, poses, strict=True)]
    )
    for _ in range(5):
        near = np.abs(np.linalg.norm(points - centre_mm, axis=1) - RADIUS_MM) < 0.5
        fit = fit_sphere(points[near], RADIUS_MM)
        centre_mm = fit.centre_mm
    return float(np.sqrt(np.mean(fit.residuals_mm**2)))


def main(calibration_path: str, *paths: str) -> None:
    """Print the table of the documentation."""
    calibration = uwlts.load_calibration(calibration_path)
    assert isinstance(calibration, Calibration)
    figures: dict[str, list[tuple[float, float, float, float, float]]] = {}
    within: dict[str, list[np.ndarray]] = {}
    for path in paths:
        header, truth = read_truth(truth_path(path))
        motion = Scene.model_validate(header.scene).motion
        assert isinstance(motion, Robot) and truth.pose is not None
        true = (motion.true_mount or motion.mount).matrix()
        with uwlts.open_capture(path) as capture:
            profiles, reported, _, _ = profiles_of(capture, calibration, None, None)
        for name, poses in {"ideal": truth.pose @ np.linalg.inv(true), "as reported": reported}.items():
            mount = uwlts.calibrate_mount(profiles[:FOR_THE_MOUNT], poses[:FOR_THE_MOUNT], radius_mm=RADIUS_MM)
            shift, turn = errors(mount, true)
            assert isinstance(mount.artefact, SphereFound)
            centre = np.array(mount.artefact.centre_mm)
            held = profiles[FOR_THE_MOUNT:], poses[FOR_THE_MOUNT:]
            ratio = scatter_mm(*held, mount.transform(), centre) / scatter_mm(*held, true, centre)
            row = (
                np.linalg.norm(shift),
                np.degrees(np.linalg.norm(turn)),
                ratio,
                mount.point_std_mm,
                mount.pose_std_mm,
            )
            figures.setdefault(name, []).append(tuple(map(float, row)))
            within.setdefault(name, []).append(np.abs([*shift, *turn]) < mount.coverage_factor * mount.std())
            print(path, name, row, within[name][-1], file=sys.stderr)
    rows = []
    for name, values in figures.items():
        mean = np.mean(values, axis=0)
        cells = [f"{mean[0]:.3f}", f"{mean[1]:.4f}", f"{mean[2]:.3f}", f"{mean[3]:.3f}", f"{mean[4]:.3f}"]
        rows.append([name, str(len(values)), *cells, f"{100 * np.mean(within[name]):.0f} %"])
    head = ["robot", "campaigns", "shift mm", "turn deg", "held-out over the robot's own", "noise mm", "robot mm"]
    print(table([*head, "within 95 % interval"], rows))


def errors(mount: Mount, true: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Error of translation (3,), mm, and rotation (3,), rad, about the platform's axes."""
    found = mount.transform()
    return true[:3, 3] - found[:3, 3], Rotation.from_matrix(true[:3, :3] @ found[:3, :3].T).as_rotvec()


if __name__ == "__main__":
    main(*map(str, map(Path, sys.argv[1:])))
