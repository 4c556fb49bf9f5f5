"""Pass of a vehicle over 20 m with three crossings, rendered: errors of its path and of lengths, before and after.

Five sensors with imperfections take two passes each, with different errors of the navigation. Each sensor has a joint
calibration and a mount calibration from 15 poses of a sphere on a robot:

    for k in 1 2 3 4 5; do python docs/studies/moving_recordings.py FOLDER robot-sphere vehicle-pass \\
        --sensor thesis-small --sensors $k --seeds $((2 * k - 2)) $((2 * k - 1)); done
    python docs/studies/vehicle_pass.py FOLDER

The offset of the clocks is given. The figures of each pass are stored beside its capture. ``--again`` recalculates
them.
"""

import argparse
import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from moving_scenes import captured, truth_of
from result_tables import publish, table
from robot_campaigns import FOR_THE_MOUNT, RADIUS_MM, select_profiles

import uwlts
from twin.scene.platform_kinds import Vehicle
from uwlts.storage.cloud import PointCloud
from uwlts.storage.pose_files import trajectory_path
from uwlts.storage.truth import Truth

INSIDE_MM = 70.0
"""Largest distance of the points of a crossing from its middle: the swath is 185 mm wide."""
PAIRS = 20_000
"""Number of lengths drawn in each crossing."""
LEAST_FACTOR = 10.0
"""Goal: the error of the path is reduced by this factor."""


@dataclass(frozen=True)
class Figures:
    """Rms errors of one pass, mm, before and after: of the path, the path up to the last crossing, and lengths.

    ``own_mm`` are errors of the path (rms) relative to its first position, which no surface determines. ``stated_mm``
    are root-mean variances of the corrected path, whole and up to the last crossing. ``within`` is the fraction of
    coordinates with an error, relative to the first position, within twice the stated uncertainty.
    """

    path_mm: tuple[float, float]
    own_mm: tuple[float, float]
    to_last_mm: tuple[float, float]
    behind_mm: tuple[float, float]
    stated_mm: tuple[float, float]
    lengths_mm: tuple[tuple[float, float], ...]
    within: float
    doubtful: int
    refused: str = ""


def aligned_pass(path: Path) -> Figures:
    """Calibrate the mount, reconstruct and align one pass; return its errors from the truth."""
    motion, truth = truth_of(path)
    assert isinstance(motion, Vehicle) and truth.pose is not None
    robot = captured(path.parent / path.name.replace("vehicle-pass", "robot-sphere"))
    mount = uwlts.calibrate_mount(select_profiles(robot, np.arange(FOR_THE_MOUNT)), radius_mm=RADIUS_MM)
    reported = uwlts.read(trajectory_path(path))
    offset = motion.clock_offset_s
    cloud = uwlts.reconstruct(
        path,
        path.parent / "calibration.json",
        mount=mount,
        trajectory=reported,
        with_uncertainty=False,
        clock_offset_s=offset,
    )
    with uwlts.read(path) as capture:
        times = capture.time_s[:]
    true = truth.pose @ np.linalg.inv((motion.true_mount or motion.mount).matrix())
    before = reported.poses_at(times + offset)
    crossings = crossings_of(truth.pose[:, :2, 3])
    last = times <= times[max(second for _, second in crossings)]

    def off(poses: np.ndarray) -> np.ndarray:
        return poses[:, :3, 3] - true[:, :3, 3]

    def errors(poses: np.ndarray, part: np.ndarray) -> float:
        return _rms(np.linalg.norm(off(poses)[part], axis=1))

    def own(poses: np.ndarray) -> np.ndarray:
        return off(poses) - off(poses)[0]

    def lengths(corrected: PointCloud) -> tuple[tuple[float, float], ...]:
        return tuple((length_error(cloud, truth, each), length_error(corrected, truth, each)) for each in crossings)

    def figures(after: np.ndarray, corrected: PointCloud, **others: Any) -> Figures:
        whole, to_last, behind = (
            (errors(before, part), errors(after, part)) for part in (np.ones(len(times), bool), last, ~last)
        )
        in_own = [_rms(np.linalg.norm(own(poses), axis=1)) for poses in (before, after)]
        return Figures(whole, (in_own[0], in_own[1]), to_last, behind, lengths_mm=lengths(corrected), **others)

    try:
        found = uwlts.align_trajectory(cloud, reported, clock_offset_s=offset)
    except uwlts.Error as error:
        return figures(before, cloud, stated_mm=(np.nan, np.nan), within=np.nan, doubtful=0, refused=str(error))
    after = found.trajectory.poses_at(times + offset)
    covariance = found.trajectory.covariance_at(times + offset)
    assert covariance is not None
    variance = np.einsum("nii->n", covariance[:, :3, :3])
    # The alignment assumes an exact start.
    stated = np.sqrt(np.einsum("nii->ni", covariance[:, :3, :3]))
    return figures(
        after,
        found.cloud,
        stated_mm=(float(np.sqrt(variance.mean())), float(np.sqrt(variance[last].mean()))),
        within=float(np.mean(np.abs(own(after)) < 2 * stated)),
        doubtful=len(found.doubtful_s),
    )


def crossings_of(places: np.ndarray) -> list[tuple[int, int]]:
    """Numbers of the images before both passes of each crossing of a path (N, 2)."""
    found = []
    start, step = places[:-1], np.diff(places, axis=0)
    for k in range(2, len(step)):
        # Intersections of segment k with earlier ones: start + a step = start_k + b step_k.
        apart, area = start[k] - start[: k - 1], _area(step[: k - 1], step[k])
        with np.errstate(divide="ignore", invalid="ignore"):
            a, b = _area(apart, step[k]) / area, _area(apart, step[: k - 1]) / area
        found += [(int(j), k) for j in np.flatnonzero((a >= 0) & (a < 1) & (b >= 0) & (b < 1))]
    return found


def _area(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return the signed areas between vectors (N, 2) and one vector (2,) or N vectors."""
    return first[..., 0] * second[..., 1] - first[..., 1] * second[..., 0]


def length_error(cloud: PointCloud, truth: Truth, crossing: tuple[int, int]) -> float:
    """Return the rms error of lengths between points of both passes of a crossing, mm."""
    assert cloud.frame is not None and cloud.line is not None and truth.pose is not None
    middle = truth.pose[list(crossing), :2, 3].mean(axis=0)
    place = truth.point_mm[cloud.frame, cloud.line]
    inside = np.linalg.norm(place[:, :2] - middle, axis=1) < INSIDE_MM
    rng, ends = np.random.default_rng(0), []
    for number in crossing:
        near = np.flatnonzero(inside & (np.abs(cloud.frame - number) < 200))
        ends.append(rng.choice(near, PAIRS))
    lengths = [np.linalg.norm(points[ends[0]] - points[ends[1]], axis=1) for points in (cloud.points_mm, place)]
    return float(np.sqrt(np.mean((lengths[0] - lengths[1]) ** 2)))


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("folder", type=Path)
    parser.add_argument("--again", action="store_true")
    parser.add_argument("--write", action="store_true", help="put the tables into their page of docs/results")
    given = parser.parse_args()
    found = []
    for path in sorted(given.folder.glob("sensor-*/vehicle-pass-?.h5")):
        kept = path.with_suffix(".pass.json")
        if given.again or not kept.exists():
            kept.write_text(json.dumps(asdict(aligned_pass(path))))
        found.append(Figures(**json.loads(kept.read_text())))
        print(path, found[-1], flush=True)
    (before, after), ratios = (
        np.transpose([each.path_mm for each in found]),
        [np.divide(*each.path_mm) for each in found],
    )
    lengths = np.concatenate([each.lengths_mm for each in found])[:, 1]
    missed, within = sum(ratio < LEAST_FACTOR for ratio in ratios), [each.within for each in found]
    row = [
        f"{len(found)}",
        f"{_rms(before):.0f}",
        f"{_rms(after):.1f}",
        f"{_rms(np.array([each.stated_mm[0] for each in found])):.1f}",
        f"{min(ratios):.1f} to {max(ratios):.1f}, missed by {missed}",
        f"{_rms(lengths):.2f}",
        f"{100 * min(within):.0f} to {100 * max(within):.0f} %",
    ]
    head = ["passes", "path before, rms mm", "after", "stated", f"factor (goal: {LEAST_FACTOR:g})"]
    head += ["lengths across a crossing, rms mm", "within twice the stated"]
    publish({"vehicle passes": table(head, [row])}, write=given.write)


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


if __name__ == "__main__":
    main()
