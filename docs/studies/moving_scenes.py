"""Rotary table and pipe from five sides: figures of the rendered scenes against their truth.

    python docs/studies/moving_recordings.py FOLDER rotary-sphere rotary-target --sensors 1 2 3 4 5 --seeds 0 1
    python docs/studies/moving_recordings.py FOLDER robot-sphere --sensors 1 2 3 4 5 --seeds 0 1
    python docs/studies/moving_recordings.py FOLDER pipe-five-sides --sensors 1 2 3 4 5 --seeds 0 1 --denser 4
    python docs/studies/moving_scenes.py FOLDER

The mount for a pipe is that of the robot's capture with the same seed and sensor. The pipe's poses have the same
uncertainty as those of that robot.
"""

from pathlib import Path

import numpy as np
from cyclopts import App
from result_tables import publish, table
from robot_campaigns import FOR_THE_MOUNT, RADIUS_MM, select_profiles
from scipy.optimize import least_squares

import uwlts
from twin.scene.description import Scene
from twin.scene.platforms import Platform
from uwlts.calibration.mount.captured_profiles import CapturedProfiles, reconstruct_profiles
from uwlts.model.calibration import Calibration
from uwlts.model.mount import Mount
from uwlts.storage.truth import Truth, read_truth, truth_path

Form = tuple[float, float, float]
VIEWS, PIPE_MM, OVALITY_MM, SPHERES_MM = 5, 300.0, 1.2, 16.0
ROBOT_STD_MM, ROBOT_STD_DEG = 0.05, 0.02
"""Standard deviations of a robot's poses: 0.05 mm, and a rotation of equal effect at the pipe's radius."""


def truth_of(path: Path) -> tuple[Platform, Truth]:
    """Motion and ground truth of a capture."""
    header, truth = read_truth(truth_path(path))
    motion = Scene.model_validate(header.scene).motion
    assert isinstance(motion, Platform)
    return motion, truth


def captured(path: Path) -> CapturedProfiles:
    """Profiles by the calibration beside the capture."""
    calibration = uwlts.read(path.parent / "calibration.json")
    assert isinstance(calibration, Calibration)
    with uwlts.read(path) as capture:
        return reconstruct_profiles(capture, calibration, None, None)


def rotary(path: Path) -> tuple[float, float, float, float]:
    """Error of a table's axis from a sphere or target on it and what is stated: angle in deg, position in mm."""
    motion, truth = truth_of(path)
    if path.name.startswith("rotary-sphere"):
        mount = uwlts.calibrate_mount(captured(path), radius_mm=RADIUS_MM, axis="-y")
    else:
        mount = uwlts.calibrate_mount(path, calibration=path.parent / "calibration.json", axis="-y")
    axis = np.linalg.inv(truth.pose[0]) @ motion.true_axis.matrix()
    found = np.linalg.inv(mount.transform())
    off = axis[:3, 3] - found[:3, 3]
    off -= off @ axis[:3, 2] * axis[:3, 2]
    turn, std = np.arccos(min(1.0, float(axis[:3, 2] @ found[:3, 2]))), mount.std()
    stated = float(np.degrees(np.linalg.norm(std[3:5]))), float(np.linalg.norm(std[:2]))
    return float(np.degrees(turn)), stated[0], float(np.linalg.norm(off)), stated[1]


def pipe(path: Path, calibration: Calibration, mount: Mount) -> np.ndarray:
    """Return errors (4, 4) in mm: those of `form`, and the largest stated closure.

    The rows are: views placed by the poses; registered freely; registered with the robot's pose uncertainty as prior;
    and registered with this prior and the spheres.
    """
    cloud = uwlts.reconstruct(path, calibration, mount=mount)
    view = cloud.frame * VIEWS // (int(cloud.frame.max()) + 1)
    views = [cloud.select(view == number) for number in range(VIEWS)]
    rows, numbers = [(*form(cloud.points_mm, view), np.nan)], np.repeat(np.arange(VIEWS), [len(each) for each in views])
    start = {"start_std_mm": ROBOT_STD_MM, "start_std_deg": ROBOT_STD_DEG}
    for known in ({}, start, start | {"sphere_mm": SPHERES_MM}):
        try:
            found = uwlts.register(views, **known)
        except uwlts.Error as error:
            print(f"{path}: {error}")
            rows.append((np.nan,) * 4)
            continue
        closures = [pair.closure_mm for pair in found.pairs if pair.closure_mm is not None]
        rows.append((*form(found.cloud.points_mm, numbers), max(closures, default=np.nan)))
    return np.array(rows)


def form(points: np.ndarray, view: np.ndarray) -> Form:
    """Errors of diameter and ovality, and the largest step between neighbouring views, mm."""
    angle = np.arctan2(points[:, 1], -points[:, 2])
    on_pipe = np.abs(np.hypot(points[:, 1], points[:, 2]) - PIPE_MM / 2) < 3

    def distances(x: np.ndarray, rows: np.ndarray) -> np.ndarray:
        y, z = points[rows, 1] - x[0] - x[1] * points[rows, 0], points[rows, 2] - x[2] - x[3] * points[rows, 0]
        around = np.arctan2(y, -z)
        return np.hypot(y, z) - (x[4] + x[5] * np.cos(2 * around) + x[6] * np.sin(2 * around))

    found, rows = np.array([0, 0, 0, 0, PIPE_MM / 2, 0, 0]), np.flatnonzero(on_pipe)
    for _ in range(6):
        found = least_squares(distances, found, args=(rows,), loss="soft_l1", f_scale=0.05).x
        off = distances(found, np.arange(len(points)))
        # Pits and spheres are left out.
        rows = np.flatnonzero(np.abs(off) < 4 * 1.4826 * np.median(np.abs(off[on_pipe])))
    steps = []
    for number in range(VIEWS):
        middle = 2 * np.pi * (number + 0.5) / VIEWS
        both = rows[np.abs(np.angle(np.exp(1j * (angle[rows] - middle)))) < np.radians(3)]
        steps.append(np.subtract(*(off[both][view[both] == (number + k) % VIEWS].mean() for k in (0, 1))))
    ovality = 4 * float(np.hypot(found[5], found[6]))
    return 2 * float(found[4]) - PIPE_MM, ovality - OVALITY_MM, float(np.abs(steps).max())


def main(folder: Path, *, write: bool = False) -> None:
    """Print the tables; with `--write`, put them into their page."""

    def recorded(scene: str) -> list[Path]:
        return [path for path in sorted(folder.glob(f"sensor-*/{scene}-*.h5")) if ".truth." not in path.name]

    rows = []
    for scene in ("rotary-sphere", "rotary-target"):
        found = np.array([rotary(path) for path in recorded(scene)])
        cells = (f"{np.sqrt(np.mean(each**2)):.3f}" for each in found.T)
        rows.append([scene, f"{len(found)}", *cells])
    head = ["scene", "campaigns", "angle, rms deg", "stated", "position, rms mm", "stated"]
    tables, errors = {"rotary table": table(head, rows)}, []
    for path in recorded("pipe-five-sides"):
        calibration = uwlts.read(path.parent / "calibration.json")
        assert isinstance(calibration, Calibration)
        robot = captured(path.parent / path.name.replace("pipe-five-sides", "robot-sphere"))
        mount = uwlts.calibrate_mount(select_profiles(robot, np.arange(FOR_THE_MOUNT)), radius_mm=RADIUS_MM)
        errors.append(pipe(path, calibration, mount))
        print(path.parent.name, path.stem, *np.round(errors[-1], 3), sep="\n", flush=True)
    sizes, rows = np.abs(errors), []
    for number, name in enumerate(("from poses and mount", "registered freely", "poses known", "and ten spheres")):
        own = sizes[np.isfinite(sizes[:, number, 0]), number]
        cells = (f"{each.mean():.3f} ({each.max():.3f})" if np.isfinite(each).all() else "" for each in own.T)
        rows.append([name, f"{len(own)} of {len(sizes)}", *cells])
    head = ["views", "campaigns", "diameter mm", "ovality mm", "largest step mm", "largest closure as stated mm"]
    publish(tables | {"pipe from five views": table(head, rows)}, write=write)


if __name__ == "__main__":
    App(help=__doc__, help_format="plaintext", default_command=main)()
