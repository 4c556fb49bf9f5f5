"""Mounts calibrated from simulated profiles of a sphere: errors and coverage.

python docs/studies/mount_calibration.py 60
"""

import sys
from pathlib import Path

import numpy as np
from cyclopts import App
from result_tables import publish, table

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from tests.uwlts.mount_views import RADIUS_MM, Campaign, errors_of, sphere_campaign
from uwlts.calibration.mount.calibrate_mount import calibrate_mount


def main(campaigns: int, *, write: bool = False) -> None:
    """Print the table; with `--write`, put it into its page."""
    rows = []
    for poses, robot, noise, radius in [
        (15, 0.0, 0.02, RADIUS_MM),
        (15, 0.0, 0.05, RADIUS_MM),
        (15, 0.05, 0.03, RADIUS_MM),
        (15, 0.05, 0.03, None),
        (40, 0.05, 0.03, RADIUS_MM),
    ]:
        shifts, turns, within = [], [], []
        for seed in range(campaigns):
            rng = np.random.default_rng([seed, poses])
            mount = calibrate_mount(
                *_of(sphere_campaign(rng, poses=poses, noise_mm=noise, robot_mm=robot)), radius_mm=radius
            )
            shift, turn = errors_of(mount.transform())
            shifts.append(np.linalg.norm(shift))
            turns.append(np.degrees(np.linalg.norm(turn)))
            within.append(np.abs(np.append(shift, turn)) < mount.coverage_factor * mount.std())
        rows.append(
            [
                f"{poses}",
                f"{robot:g}",
                f"{noise:g}",
                "known" if radius else "unknown",
                f"{np.median(shifts):.3f} / {np.quantile(shifts, 0.95):.3f}",
                f"{np.median(turns):.4f} / {np.quantile(turns, 0.95):.4f}",
                f"{100 * np.mean(within):.1f}",
            ]
        )
    head = ["poses", "robot mm", "noise mm", "radius", "shift, median / 95 % mm", "rotation, median / 95 % deg"]
    head += ["within 95 % interval, %"]
    publish({"mount by a sphere": table(head, rows)}, write=write)


def _of(campaign: Campaign) -> tuple[list[np.ndarray], np.ndarray]:
    return campaign.profiles, campaign.poses


if __name__ == "__main__":
    App(help=__doc__, help_format="plaintext", default_command=main)()
