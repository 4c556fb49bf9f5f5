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

from tests.uwlts.mount_views import MOUNT, RADIUS_MM, Campaign, errors_of, sphere_campaign
from tests.uwlts.sensor_profiles import captured_by, joint_estimate
from uwlts.calibration.mount.calibrate_mount import calibrate_mount
from uwlts.model.library import load_sensor
from uwlts.model.mount import Mount, SphereFound

ERRORS = "shift, median / 95 % mm", "rotation, median / 95 % deg"


def held_out_ratio(mount: Mount, campaign: Campaign) -> float:
    """Return the scatter of a new campaign's points about their best sphere, divided by that with the true mount."""

    def rms(transform: np.ndarray) -> float:
        off = []
        for profile, pose in zip(campaign.profiles, campaign.poses, strict=True):
            seen = profile[np.isfinite(profile).all(axis=1)]
            points = np.column_stack([seen[:, 0], np.zeros(len(seen)), seen[:, 1], np.ones(len(seen))])
            off.append((pose @ transform @ points.T)[:3].T)
        points = np.vstack(off)
        centre = mount_centre
        for _ in range(10):
            away = points - centre
            distance = np.linalg.norm(away, axis=1)
            near = np.abs(distance - RADIUS_MM) < 1.0
            centre = centre + np.linalg.lstsq(away[near] / distance[near, None], distance[near] - RADIUS_MM)[0]
        distance = np.linalg.norm(points - centre, axis=1) - RADIUS_MM
        return float(np.sqrt(np.mean(distance[np.abs(distance) < 1.0] ** 2)))

    assert isinstance(mount.artefact, SphereFound)
    mount_centre = np.array(mount.artefact.centre_mm)
    return rms(mount.transform()) / rms(MOUNT)


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
    """Publish the errors and coverage of mounts by a sphere, and points on a sphere that was held out."""
    rows = []
    for poses, robot, noise, radius in [
        (15, 0.0, 0.02, RADIUS_MM),
        (15, 0.0, 0.05, RADIUS_MM),
        (15, 0.05, 0.03, RADIUS_MM),
        (15, 0.05, 0.03, None),
        (40, 0.05, 0.03, RADIUS_MM),
    ]:
        shifts, turns, within, ratios = [], [], [], []
        for seed in range(campaigns):
            rng = np.random.default_rng([seed, poses])
            mount = calibrate_mount(
                *_of(sphere_campaign(rng, poses=poses, noise_mm=noise, robot_mm=robot)), radius_mm=radius
            )
            shift, turn = errors_of(mount.transform())
            shifts.append(np.linalg.norm(shift))
            turns.append(np.degrees(np.linalg.norm(turn)))
            within.append(np.abs(np.append(shift, turn)) < mount.coverage_factor * mount.std())
            held = sphere_campaign(rng, poses=30, noise_mm=noise, robot_mm=robot, background=False)
            ratios.append(held_out_ratio(mount, held))
        rows.append(
            [
                f"{poses}",
                f"{robot:g}",
                f"{noise:g}",
                "known" if radius else "unknown",
                *_errors(shifts, turns),
                f"{100 * np.mean(within):.1f} %",
                f"{np.median(ratios):.3f} / {np.quantile(ratios, 0.95):.3f}",
            ]
        )
    head = ["poses", "robot mm", "noise mm", "radius", *ERRORS, "within 95 % interval"]
    last = "held-out sphere relative to the robot's own error, median / 95 %"
    publish({"mount by a sphere": table([*head, last], rows)}, write=write)


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
