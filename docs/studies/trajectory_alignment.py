"""Alignment of a pass of 20 m with three crossings, 0.3 m and 1 deg of drift: errors of the path and of lengths.

    python -m docs.studies.trajectory_alignment --seeds 0 1 2

The vehicle, its navigation and the sea bed are those of `tests/uwlts/path_views.py`; ``--walk`` adds a random walk, a
multiple of the drift. First it prints by which factor the best linear estimate of a drift of known kind lowers the path
error, given the exact displacement at the three crossings (`best`), for kinds of drift.
"""

import argparse
from itertools import product

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
SWATH_MM, LENGTH_MM = 140.0, 19_400.0
PASSING_S = 1.5
"""Around the middle of a piece, in which the pass lies over the crossing."""
CROSSINGS = (0.057, 0.500), (0.124, 0.608), (0.351, 0.691)
"""Of the pass, as parts of its length."""


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--drift-mm", type=float, default=300.0)
    parser.add_argument("--drift-deg", type=float, default=1.0)
    parser.add_argument("--walk", type=float, default=0.0)
    given = parser.parse_args()
    for shares in (
        (1.0, 0.0, 0.0),
        (0.5, 0.5, 0.0),
        (0.0, 1.0, 0.0),
        (0.95, 0.0, 0.05),
        (0.5, 0.0, 0.5),
        (0.0, 0.0, 1.0),
    ):
        kinds = ("steady rate", "wandering rate", "random walk")
        words = ", ".join(f"{kind} {100 * share:.0f} %" for kind, share in zip(kinds, shares, strict=True) if share)
        print(f"{words}: at best {min(best(*shares), 1000):.1f} times")
    # Of `ride`: a rate of 0.7 to 1.2 times the drift, a wave of a fifth of it, and the walk.
    own = {"rate": (1.2**3 - 0.7**3) / 1.5, "wandering": 0.0, "walk": given.walk**2, "wave": 0.2}
    bounds = [min(best(**own, apart=apart), 1000) for apart in (0.0, SWATH_MM / LENGTH_MM)]
    print(f"drift of these rides: at best {bounds[0]:.1f} times, {bounds[1]:.1f} times with the rates within crossings")
    for seed in given.seeds:
        drift = {"drift_mm": given.drift_mm, "drift_deg": given.drift_deg}
        cloud, reported, true = ride(np.random.default_rng(seed), PASS_MM, walk=given.walk, **drift)
        try:
            found = uwlts.align_trajectory(cloud, reported, **drift)
        except uwlts.Error as error:
            print(f"seed {seed}: {error}", flush=True)
            continue
        assert found.trajectory.covariance is not None
        known = np.einsum("nii->n", found.trajectory.covariance[:, :3, :3])
        last = max(each.times_s[1] for each in found.crossings)
        words = []
        for name, part in (
            ("path", slice(None)),
            ("to the last crossing", reported.times_s <= last),
            ("behind it", reported.times_s > last),
        ):
            before, after = (
                np.sqrt(np.mean(np.sum((each.poses[part, :3, 3] - true.poses[part, :3, 3]) ** 2, axis=1)))
                for each in (reported, found.trajectory)
            )
            words.append(
                f"{name} {before:.1f} -> {after:.1f} mm (rms), {before / after:.1f} times, "
                f"{np.sqrt(known[part].mean()):.1f} mm stated"
            )
        lengths = [_apart(found.trajectory, true, each.times_s) for each in found.crossings if each.patches > 100]
        print(
            f"seed {seed}: {'; '.join(words)}; {len(lengths)} overlaps, lengths between both passes wrong by "
            f"{_rms(lengths):.3f} mm (rms), {len(found.doubtful_s)} crossings left out",
            flush=True,
        )


def best(rate: float, wandering: float, walk: float, *, wave: float = 0.0, apart: float = 0.0) -> float:
    """Times by which three exact crossings lower the rms error of a path, at best: the drift is a Gaussian process.

    The parts of its variance at the end are those of a steady rate, of a rate that walks at random, and of a random
    walk; ``wave`` is the amplitude of that of `ride`. Given are the displacements at two places ``apart`` of the path
    within each crossing, which determine the rates there, too. A linear Gaussian estimate by the true covariance has
    the least error of all.
    """
    count = 2000
    t = np.arange(1, count + 1) / count
    first, second = np.minimum(t[:, None], t), np.maximum(t[:, None], t)
    before = rate * np.outer(t, t) + wandering * first**2 * (3 * second - first) / 2 + walk * first
    turns = 2 * np.pi * 0.8 * t
    before += wave**2 / 2 * (np.cos(turns[:, None] - turns) - np.cos(turns)[:, None] - np.cos(turns) + 1)
    seen = np.zeros((2 * len(CROSSINGS), count))
    for row, (ends, off) in zip(seen, product(CROSSINGS, (-apart / 2, apart / 2)), strict=True):
        row[[int(count * (end + off)) for end in ends]] = -1, 1
    gain = before @ seen.T
    after = before - gain @ np.linalg.solve(seen @ gain + 1e-10 * np.eye(len(seen)), gain.T)
    return float(np.sqrt(np.trace(before) / np.trace(after)))


def _rms(values: list[np.ndarray]) -> float:
    return float(np.sqrt(np.mean(np.square(values)))) if values else np.nan


def _apart(found: uwlts.Trajectory, true: uwlts.Trajectory, times: tuple[float, float]) -> np.ndarray:
    """Errors (9,) of lengths from points of the first pass to points of the second, within a crossing, mm.

    A point has the errors of the image in which its pass saw it.
    """
    passes = [np.flatnonzero(np.abs(true.times_s - time) < PASSING_S) for time in times]
    first, second = (true.poses[images, :2, 3] for images in passes)
    apart = np.linalg.norm(first[:, None] - second, axis=2)
    crossed = passes[0][np.unravel_index(np.argmin(apart), apart.shape)[0]]
    middle = true.poses[crossed, :3, 3] - [0, 0, ALTITUDE_MM]
    moved, places = [], []
    for images, corners in zip(passes, ([-1, -1, 0], [1, 1, 0]), strict=True):
        points = middle + 0.5 * SWATH_MM * np.array([corners, np.multiply(corners, [1, -0.5, 0]), np.zeros(3)])
        along = np.einsum("pni,ni->pn", points[:, None] - true.poses[images, :3, 3], true.poses[images, :3, 0])
        seen = images[np.argmin(np.abs(along), axis=1)]
        wrong = found.poses[seen] @ np.linalg.inv(true.poses[seen])
        places.append(points)
        moved.append(np.einsum("pij,pj->pi", wrong[:, :3, :3], points) + wrong[:, :3, 3])
    lengths = [np.linalg.norm(second[None] - first[:, None], axis=2).ravel() for first, second in (moved, places)]
    return lengths[0] - lengths[1]


if __name__ == "__main__":
    main()
