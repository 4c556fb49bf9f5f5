"""Rotary table, pipe from five sides and vehicle: figures of the rendered scenes against their truth.

    python docs/studies/moving_recordings.py FOLDER rotary-sphere rotary-target --sensors 1 2 3 4 5 --seeds 0 1
    python docs/studies/moving_recordings.py FOLDER robot-sphere --sensors 1 2 3 4 5 --seeds 0 1
    python docs/studies/moving_recordings.py FOLDER pipe-five-sides --sensors 1 2 3 4 5 --seeds 0 1 --denser 4
    twin simulate vehicle-pipe --sensor thesis-small --out FOLDER/vehicle.h5
    python docs/studies/moving_scenes.py FOLDER

The mount for a pipe is that of the robot's capture with the same seed and sensor. The pipe's poses have the same
uncertainty as those of that robot.
"""

from pathlib import Path

import numpy as np
from cyclopts import App
from robot_campaigns import FOR_THE_MOUNT, RADIUS_MM
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


def rotary(path: Path) -> str:
    """Error of a table's axis from a sphere or target on it, and its standard uncertainty."""
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
    return (
        f"{path.parent.name}, {path.stem}: "
        f"axis off by {np.degrees(turn):.3f} deg ({np.degrees(np.linalg.norm(std[3:5])):.3f} stated) and "
        f"{np.linalg.norm(off):.3f} mm ({np.linalg.norm(std[:2]):.3f} stated)"
    )


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


def vehicle(path: Path) -> str:
    """Return the point errors, as text, with the reported path, and with the true path and mount."""
    motion, truth = truth_of(path)
    reported = uwlts.read(str(path).replace(".h5", ".trajectory.csv"))
    with uwlts.read(path) as capture:
        times, stated = capture.time_s[:] + motion.clock_offset_s, np.trace(capture.pose_covariance[-1, :3, :3])
    cloud = uwlts.reconstruct(
        path, uwlts.nominal("thesis-small", medium="water"), trajectory=reported, clock_offset_s=motion.clock_offset_s
    )
    expected = truth.point_mm[cloud.frame, cloud.line]
    carried = reported.poses_at(times)[cloud.frame] @ motion.mount.matrix()
    seen = np.einsum("nji,nj->ni", carried[:, :3, :3], cloud.points_mm - carried[:, :3, 3])
    true = truth.pose[cloud.frame]
    again = np.einsum("nij,nj->ni", true[:, :3, :3], seen) + true[:, :3, 3]
    off = [np.nanmedian(np.linalg.norm(points - expected, axis=1)) for points in (cloud.points_mm, again)]
    platform = truth.pose @ np.linalg.inv(motion.true_mount.matrix())
    end = np.linalg.norm(reported.poses_at(times)[-1, :3, 3] - platform[-1, :3, 3])
    way = np.linalg.norm(np.diff(platform[:, :3, 3], axis=0), axis=1).sum()
    return (
        f"vehicle: {len(times)} images over {way / 1e3:.1f} m, at the end off by {end:.0f} mm ({np.sqrt(stated):.0f} "
        f"stated); points off by {off[0]:.1f} mm (median), with the true path and mount {off[1]:.3f} mm"
    )


def main(folder: Path) -> None:
    """Print all figures."""

    def recorded(scene: str) -> list[Path]:
        return [path for path in sorted(folder.glob(f"sensor-*/{scene}-*.h5")) if ".truth." not in path.name]

    for path in recorded("rotary-sphere") + recorded("rotary-target"):
        print(rotary(path), flush=True)
    rows = []
    for path in recorded("pipe-five-sides"):
        calibration = uwlts.read(path.parent / "calibration.json")
        assert isinstance(calibration, Calibration)
        robot = captured(path.parent / path.name.replace("pipe-five-sides", "robot-sphere"))
        mount = uwlts.calibrate_mount(robot.select(np.arange(FOR_THE_MOUNT)), radius_mm=RADIUS_MM)
        rows.append(pipe(path, calibration, mount))
        print(f"{path.parent.name}, {path.stem}: diameter, ovality, largest step, largest closure, mm", flush=True)
        print(
            "by the poses; registered freely, with the poses known, with spheres besides:",
            *np.round(rows[-1], 3),
            sep="\n",
        )
    if rows:
        sizes = np.abs(rows)
        print("registered", *np.isfinite(sizes[:, :, 0]).sum(axis=0))
        print("mean of the sizes", *np.round(np.nanmean(sizes, axis=0), 3), sep="\n")
        print("largest", *np.round(np.nanmax(sizes, axis=0), 3), sep="\n")
    if (path := folder / "vehicle.h5").exists():
        print(vehicle(path))


if __name__ == "__main__":
    App(help=__doc__, help_format="plaintext", default_command=main)()
