"""Mounts calibrated from simulated profiles of a sphere: errors, coverage, and points on a sphere that was held out.

    python docs/studies/mount_calibration.py 60
    python docs/studies/mount_calibration.py 40 --sensors

The second draws a sensor for each campaign from the covariance of its calibration (`tests/uwlts/sensor_profiles.py`).
"""

import argparse
import sys
from pathlib import Path

import numpy as np
from result_tables import publish, table

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from tests.uwlts.mount_views import RADIUS_MM, Campaign, errors_of, sphere_campaign
from tests.uwlts.sensor_profiles import captured_by, joint_estimate
from uwlts.calibration.mount.calibrate_mount import calibrate_mount
from uwlts.model.library import load_sensor

ERRORS = "shift, median / 95 % mm", "rotation, median / 95 % deg"


def by_sensors(campaigns: int, *, write: bool) -> None:
    """Publish the errors and coverage of mounts of sensors that differ from their calibration."""
    known, rows = joint_estimate(load_sensor("thesis")), []
    for seed in range(campaigns):
        rng = np.random.default_rng(seed)
        values = rng.multivariate_normal(known.values, known.covariance, method="svd")
        mount = calibrate_mount(captured_by(known, values, rng), radius_mm=19.05)
        assert mount.sensor is not None
        shift, turn = errors_of(mount.transform())
        apart = np.sqrt(np.diag(mount.sensor.covariance_apart))
        within = [np.mean(np.abs([*shift, *turn]) < mount.coverage_factor * std) for std in (mount.std(), apart)]
        rows.append((np.linalg.norm(shift), np.degrees(np.linalg.norm(turn)), *within))
    shifts, turns, own, exact = np.transpose(rows)
    head = [*ERRORS, "within 95 % interval", "with the sensor taken as exact"]
    row = [*_errors(shifts, turns), *(f"{100 * within.mean():.1f} %" for within in (own, exact))]
    publish({"mount by other sensors": table(head, [row])}, write=write)


def by_sphere(campaigns: int, *, write: bool) -> None:
    """Publish the errors and coverage of mounts by a sphere."""
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
                *_errors(shifts, turns),
                f"{100 * np.mean(within):.1f}",
            ]
        )
    head = ["poses", "robot mm", "noise mm", "radius", *ERRORS, "within 95 % interval, %"]
    publish({"mount by a sphere": table(head, rows)}, write=write)


def _errors(shifts_mm: list[float] | np.ndarray, turns_deg: list[float] | np.ndarray) -> list[str]:
    """Return the cells of the columns `ERRORS`."""
    return [
        f"{np.median(shifts_mm):.3f} / {np.quantile(shifts_mm, 0.95):.3f}",
        f"{np.median(turns_deg):.4f} / {np.quantile(turns_deg, 0.95):.4f}",
    ]


def _of(campaign: Campaign) -> tuple[list[np.ndarray], np.ndarray]:
    return campaign.profiles, campaign.poses


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("campaigns", type=int)
    parser.add_argument("--sensors", action="store_true")
    parser.add_argument("--write", action="store_true", help="put the tables into their page of docs/results")
    given = parser.parse_args()
    if given.sensors:
        by_sensors(given.campaigns, write=given.write)
    else:
        by_sphere(given.campaigns, write=given.write)
