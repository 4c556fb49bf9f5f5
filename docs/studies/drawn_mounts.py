"""Mounts from sets drawn by `tests/oracles/profilers.py`, beside plain least squares of the same points.

    python docs/studies/drawn_mounts.py 400 406 --artefact sphere
    python docs/studies/drawn_mounts.py 400 406 --artefact sphere --size-known --short-arcs --halves --fixed-mm 0.03

Arguments are the first seed and the one after the last.
"""

import argparse
import sys
import time
from pathlib import Path

import numpy as np
from scipy.stats import chi2

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from tests.oracles.profilers import Kind, draw_set, scatter_mm
from tests.uwlts.drawn_mounts import SHORT_ARCS, differences, least_squares_mount, mount_of, rms_mm
from uwlts.errors import CalibrationError


def measure(
    seed: int, kind: Kind, *, size_known: bool, short_arcs: bool, halves: bool, fixed_mm: float
) -> list[float] | None:
    """Print a row of one set, and return its figures; None if it was refused."""
    given = draw_set([seed, 7], kind, fixed_mm=fixed_mm, **(SHORT_ARCS if short_arcs else {}))
    begun = time.process_time()
    try:
        mount = mount_of(given, size_known=size_known)
    except CalibrationError as error:
        print(f"{seed}: {time.process_time() - begun:.1f} s, {error}", flush=True)
        return None
    spent = time.process_time() - begun
    plain, least = least_squares_mount(given, size_known=size_known)
    error, other = (differences(each, given.mount) for each in (mount.transform(), plain))
    true = scatter_mm(given, given.mount, given.artefact[:3, 3], given.artefact[:3, 2], given.size_mm)
    row = [
        rms_mm(given, mount) / least,
        float(np.sqrt(np.mean(true**2))) / least,
        float(np.linalg.norm(error[:3])),
        float(np.linalg.norm(other[:3])),
        float(np.linalg.norm(mount.std()[:3])),
        float(np.mean(np.abs(error) < mount.coverage_factor * mount.std())),
        sum(pose.reason is not None for pose in mount.poses),
        len(mount.poses),
        spent,
        np.nan,
    ]
    if halves:
        one, two = (mount_of(given.select(slice(k, None, 2)), size_known=size_known) for k in (0, 1))
        apart, spread = differences(one.transform(), two.transform()), np.add(one.covariance, two.covariance)
        row[-1] = float(chi2.sf(apart @ np.linalg.solve(spread, apart), 6))
    print(f"{seed}:", " ".join(f"{value:.3g}" for value in row), flush=True)
    return row


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("first", type=int)
    parser.add_argument("last", type=int)
    parser.add_argument("--fixed-mm", type=float, default=0.0, help="form error that is the same in all profiles")
    parser.add_argument("--artefact", choices=["sphere", "plane"], default="sphere")
    for flag in ("--size-known", "--short-arcs", "--halves"):
        parser.add_argument(flag, action="store_true")
    own = vars(parser.parse_args())
    seeds, artefact = range(own.pop("first"), own.pop("last")), own.pop("artefact")
    print(
        "seed: scatter / least, that of the true values, error mm, that of least squares, stated, within 95 %, left "
        "out, poses, s, p of halves"
    )
    rows = np.array([row for seed in seeds if (row := measure(seed, artefact, **own)) is not None])
    print(
        f"{len(rows)} of {len(seeds)} sets: scatter relative to least squares {np.median(rows[:, 0]):.3f} (median), "
        f"{rows[:, 0].max():.3f} (largest), of the true values {np.median(rows[:, 1]):.3f} and {rows[:, 1].max():.3f}; "
        f"error {np.sqrt(np.mean(rows[:, 2] ** 2)):.3f} mm (rms), least squares "
        f"{np.sqrt(np.mean(rows[:, 3] ** 2)):.3f} mm; within 95 % intervals {100 * rows[:, 5].mean():.1f} %; "
        f"{rows[:, 6].sum():.0f} of {rows[:, 7].sum():.0f} poses left out; at most {rows[:, 8].max():.1f} s"
    )
