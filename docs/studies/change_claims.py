"""False positives of `uwlts compare`: fraction of an unchanged surface that is reported as changed.

Clouds are drawn with the errors that they state: noise of single points, the position of each image, and a shift and a
tilt that all points share. Prints the table of docs/results/comparison.md, or puts it there (`--write`).
"""

import numpy as np
from cyclopts import App
from result_tables import publish, table

import uwlts
from uwlts.storage.cloud import PointCloud, PointUncertainty

NOISE_MM, SHIFT_MM, TILT, STAGE_MM = 0.03, 0.04, 1e-3, 0.02
SIDE_MM, STEP_MM, PAIRS = 60.0, 0.5, 10


def wavy(x, y):
    return 2.0 * np.sin(x / 9.0) + 1.5 * np.cos(y / 7.0) + 0.01 * x * y / 5


def pipe(x, y):
    return 150.0 - np.sqrt(150.0**2 - x**2)


def flat(x, y):
    return 0 * x


def scanned(rng: np.random.Generator, surface, *, common: bool, calibration: np.ndarray | None = None) -> PointCloud:
    """Return a scanned cloud; errors of its calibration (2,) in standard deviations are drawn by default."""
    axis = np.arange(-SIDE_MM / 2, SIDE_MM / 2, STEP_MM)
    x, y = np.meshgrid(axis, axis)
    image = np.repeat(np.arange(len(axis))[None], len(axis), axis=0).ravel()
    x, y = (each.ravel() + rng.uniform(-0.2, 0.2, x.size) for each in (x, y))
    count = len(x)
    patterns = np.zeros((2, count, 3), np.float32)
    patterns[0, :, 2], patterns[1, :, 2] = common * SHIFT_MM, common * TILT * y
    position, random = np.zeros((count, 3), np.float32), np.zeros((count, 6), np.float32)
    position[:, 2], random[:, 5] = STAGE_MM, NOISE_MM**2
    z = surface(x, y) + NOISE_MM * rng.normal(size=count) + STAGE_MM * rng.normal(size=len(axis))[image]
    errors = rng.normal(size=2) if calibration is None else calibration
    z += np.tensordot(errors, patterns[:, :, 2], axes=1)
    known = PointUncertainty(random, position, patterns, shared={f"sensor {errors}": np.eye(2)})
    return PointCloud(np.column_stack([x, y, z]), np.ones(count), image, np.zeros(count, int), uncertainty=known)


def main(*, write: bool = False) -> None:
    """Print the table; with `--write`, put it into its page."""
    cells = []
    rows = (
        ("two scans, noise and images only", wavy, False, False, None, False),
        ("two scans of one calibration", wavy, True, True, None, False),
        ("two scans of two calibrations", wavy, True, False, None, False),
        ("these, registered", wavy, True, False, None, True),
        ("plane, fitted", flat, True, False, "plane", False),
        ("cylinder of 300 mm, fitted", pipe, True, False, "cylinder", False),
    )
    for number, (name, surface, common, one, reference, register) in enumerate(rows):
        rng = np.random.default_rng([11, number])
        shares, ratios = [], []
        for _ in range(PAIRS):
            calibration = rng.normal(size=2) if one else None
            cloud = scanned(rng, surface, common=common, calibration=calibration)
            other = scanned(rng, surface, common=common, calibration=calibration) if reference is None else reference
            change = uwlts.compare_clouds(cloud, other, register=register)
            seen = change.compared
            shares.append(np.average(change.significant[seen], weights=change.area_mm2[seen]))
            ratios.append(np.mean((1.96 * change.distance_mm[seen] / change.level_mm[seen]) ** 2))
        mean, most = (f"{100 * value:.1f}" for value in (np.mean(shares), max(shares)))
        cells.append([name, mean, most, f"{np.sqrt(np.mean(ratios)):.2f}"])
    head = ["compared", "claimed of the area, mean %", "largest %"]
    publish({"unchanged surfaces": table([*head, "scatter relative to stated"], cells)}, write=write)


if __name__ == "__main__":
    App(help=__doc__, help_format="plaintext", default_command=main)()
