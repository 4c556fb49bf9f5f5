"""Alignment of a pass of 20 m with three crossings, 0.3 m and 1 deg of drift: errors of the path and of lengths.

    python -m docs.studies.trajectory_alignment --seeds 3

The vehicle, its navigation and the sea bed are those of `tests/uwlts/path_views.py`; ``--walk`` adds a random walk, a
multiple of the drift.
"""

import argparse

import numpy as np

import uwlts
from tests.uwlts.path_views import ALTITUDE_MM, ride

PASS_MM = np.array(
    [
        *((-400, 0), (3400, 0), (3400, 1600), (700, 1600), (700, -400), (2000, -400)),
        *((2000, 3400), (300, 3400), (300, 2300), (1700, 2300)),
    ],
    float,
)
"""Crosses itself at (700, 0), (2000, 0) and (2000, 1600)."""
SWATH_MM = 140.0


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--drift-mm", type=float, default=300.0)
    parser.add_argument("--drift-deg", type=float, default=1.0)
    parser.add_argument("--walk", type=float, default=0.0)
    given = parser.parse_args()
    for seed in range(given.seeds):
        drift = {"drift_mm": given.drift_mm, "drift_deg": given.drift_deg}
        cloud, reported, true = ride(np.random.default_rng(seed), PASS_MM, walk=given.walk, **drift)
        found = uwlts.align_trajectory(cloud, reported, **drift)
        before, after = (
            np.sqrt(np.mean(np.sum((each.poses[:, :3, 3] - true.poses[:, :3, 3]) ** 2, axis=1)))
            for each in (reported, found.trajectory)
        )
        lengths = [_apart(found.trajectory, true, each.times_s) for each in found.crossings if each.patches > 100]
        print(
            f"seed {seed}: path {before:.1f} -> {after:.1f} mm (rms), {before / after:.1f} times better; "
            f"{len(lengths)} overlaps, lengths between both passes wrong by "
            f"{np.sqrt(np.mean(np.square(lengths))):.3f} mm (rms)",
            flush=True,
        )


def _apart(found: uwlts.Trajectory, true: uwlts.Trajectory, times: tuple[float, float]) -> np.ndarray:
    """Errors (9,) of lengths from points of the first pass to points of the second, within a crossing, mm."""
    moved, places = [], []
    k = int(np.argmin(np.abs(true.times_s - times[0])))
    middle = true.poses[k, :3, 3] - [0, 0, ALTITUDE_MM]
    for time, corners in zip(times, ([-1, -1, 0], [1, 1, 0]), strict=True):
        k = int(np.argmin(np.abs(true.times_s - time)))
        wrong = found.poses[k] @ np.linalg.inv(true.poses[k])
        points = middle + 0.5 * SWATH_MM * np.array([corners, np.multiply(corners, [1, -0.5, 0]), np.zeros(3)])
        places.append(points)
        moved.append(points @ wrong[:3, :3].T + wrong[:3, 3])
    lengths = [np.linalg.norm(second[None] - first[:, None], axis=2).ravel() for first, second in (moved, places)]
    return lengths[0] - lengths[1]


if __name__ == "__main__":
    main()
