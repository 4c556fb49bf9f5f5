"""Passes that the recalibration advises, and passes drawn at random: how many images the same uncertainty takes.

    python -m docs.studies.advised_motions --first 2200 --count 10 --enough-mm 0.025 --write

Sensor, water and surface are drawn as in the tests of `uwlts.recalibrate`; images follow from Fermat's principle. After
the first pass, the sensor moves as advised, or as drawn: uniform shifts of up to 60 mm along Y, and 80 mm along Z, a
turn about Z and a roll of up to 30 deg about X, one of the four or all of them. Motions that see less than 30 % of the
first pass's scene are drawn again. The poses have the stated standard uncertainties. A campaign ends when 100 mm along
Y and Z have a standard uncertainty of ``enough_mm`` (rms), or after eight passes.
"""

from contextlib import suppress
from dataclasses import replace

import numpy as np
from cyclopts import App
from scipy.spatial.transform import Rotation

from docs.studies.result_tables import publish, table
from tests.uwlts.recalibration import test_recalibration
from tests.uwlts.recalibration.test_recalibration import TRAVEL, campaign, draw_sensor, draw_surface, record, solve
from uwlts.errors import CalibrationError
from uwlts.model.calibration import rigid_transform

MOST = 8
"""Passes of a campaign."""
SHIFT_MM, LIFT_MM, ROLL_DEG = 60.0, 80.0, 30.0
KINDS = ("advised", "one drawn motion", "all motions drawn")
MIDDLE_MM = np.array([0.0, 0.0, 20.0])
"""About the middle of the scene."""


def draw_pose(kind: str, rng: np.random.Generator) -> np.ndarray:
    """Return a pose (4, 4) with one motion from the first pass, or all."""
    shift, lift = rng.uniform(-SHIFT_MM, SHIFT_MM), rng.uniform(-LIFT_MM, LIFT_MM)
    angles = np.array([rng.uniform(-ROLL_DEG, ROLL_DEG), 0.0, rng.uniform(-180.0, 180.0)])
    if kind == "one drawn motion":
        chosen = rng.integers(4)
        shift, lift = shift * (chosen == 0), lift * (chosen == 1)
        angles = angles * [chosen == 2, 0, chosen == 3]
    rotation = Rotation.from_euler("xyz", angles, degrees=True).as_matrix()
    return rigid_transform(rotation, MIDDLE_MM - rotation @ MIDDLE_MM + [0.0, shift, lift])


def run(seed: int, kind: str, enough_mm: float) -> list[float]:
    """Return the standard uncertainty, mm, of 100 mm (rms of both axes) after each pass."""
    *_, problem = campaign(seed, {"first": (0.0, 0.0, 0.0)})
    rng = np.random.default_rng([61, seed])
    built, water = draw_sensor(rng)
    height = draw_surface(rng)
    rng = np.random.default_rng([seed, KINDS.index(kind)])
    reached: list[float] = []
    found = solve(problem)
    while True:
        reached.append(float(np.sqrt(np.mean([each.after_mm**2 for each in found.lengths]))))
        if reached[-1] <= enough_mm or len(problem.passes) == MOST:
            return reached
        advice = iter(found.next_passes)
        while True:
            pose = next(advice).candidate.pose if kind == "advised" else draw_pose(kind, rng)
            another = record(built, water, height, pose, rng, f"{len(problem.passes)}")
            trial = replace(problem, passes=[*problem.passes, another])
            # A pass that sees too little, or nothing in common, is replaced by the next one.
            if len(another.line) > 0.3 * len(problem.passes[0].line):
                with suppress(CalibrationError):
                    found, problem = solve(trial), trial
                    break


app = App(help=__doc__)


@app.default
def main(
    *,
    first: int = 0,
    count: int = 10,
    enough_mm: float = 0.05,
    pose_std_mm: float = 0.01,
    pose_std_deg: float = 0.005,
    kinds: str = ",".join(KINDS),
    name: str = "motions",
    write: bool = False,
) -> None:
    """Run campaigns of each kind, and publish the table."""
    rows, motion = [], test_recalibration.MOTION
    test_recalibration.MOTION = replace(motion, pose_mm=pose_std_mm, pose_rad=float(np.radians(pose_std_deg)))
    for kind in kinds.split(","):
        results = []
        for seed in range(first, first + count):
            results.append(run(seed, kind, enough_mm))
            print(kind, seed, [f"{each:.3f}" for each in results[-1]], flush=True)
        images = np.array([len(each) for each in results]) * len(TRAVEL)
        failed = sum(each[-1] > enough_mm for each in results)
        second = np.median([each[min(1, len(each) - 1)] for each in results])
        rows.append(
            [kind, str(count), f"{images.mean():.0f}", f"{images.max()}", f"{second:.3f}", f"{failed} of {count}"]
        )
    head = ["motions", "campaigns", "images (mean)", "images (most)", "after two passes, mm (median)", "not reached"]
    publish({f"advised {name}": table(head, rows)}, write=write)


if __name__ == "__main__":
    app()
