"""Mounts from sets drawn by `tests/oracles/profilers.py`, beside plain least squares of the same points.

python docs/studies/drawn_mounts.py [--first 500] [--write]
"""

import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np
from cyclopts import App
from result_tables import publish, table

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from tests.oracles.profilers import Kind, draw_set
from tests.uwlts.drawn_mounts import SHORT_ARCS, differences, least_squares_mount, mount_of, rms_mm
from uwlts.errors import CalibrationError


class Case(NamedTuple):
    """Kind of the sets: number, artefact, and options of the draw and of the calibration."""

    name: str
    count: int
    artefact: Kind = "sphere"
    size_known: bool = False
    short_arcs: bool = False
    fixed_mm: float = 0.0


CASES = (
    Case("sphere", 8),
    Case("plane with two ridges", 12, "plane"),
    Case("sphere of known size, arcs of 60 deg", 12, size_known=True, short_arcs=True),
    Case("the same, form error of 0.03 mm", 6, size_known=True, short_arcs=True, fixed_mm=0.03),
)


def measure(seed: int, case: Case) -> list[float] | None:
    """Return the figures of one set, None if it was refused.

    They are the scatter relative to the least, errors of the shift by the mount and by least squares, and the fraction
    of coordinates within their intervals.
    """
    given = draw_set([seed, 7], case.artefact, fixed_mm=case.fixed_mm, **(SHORT_ARCS if case.short_arcs else {}))
    try:
        mount = mount_of(given, size_known=case.size_known)
    except CalibrationError as error:
        print(f"{case.name}, {seed}: {error}", file=sys.stderr, flush=True)
        return None
    plain, least = least_squares_mount(given, size_known=case.size_known)
    error, other = (differences(each, given.mount) for each in (mount.transform(), plain))
    return [
        rms_mm(given, mount) / least,
        float(np.linalg.norm(error[:3])),
        float(np.linalg.norm(other[:3])),
        float(np.mean(np.abs(error) < mount.coverage_factor * mount.std())),
    ]


def main(*, first: int = 500, write: bool = False) -> None:
    """Print the table; with `--write`, put it into its page."""
    rows = []
    for case in CASES:
        found = [row for seed in range(first, first + case.count) if (row := measure(seed, case)) is not None]
        scatter, error, other, within = np.transpose(found)
        sizes = f"{np.median(scatter):.3f} / {scatter.max():.3f}"
        errors = (f"{np.sqrt(np.mean(each**2)):.2f}" for each in (error, other))
        rows.append([case.name, f"{len(found)} of {case.count}", sizes, *errors, f"{100 * within.mean():.0f} %"])
    head = ["artefact", "sets", "scatter relative to the least, median / largest"]
    head += ["error of shift, rms mm", "by least squares", "within 95 % intervals"]
    publish({"mounts of drawn sets": table(head, rows)}, write=write)


if __name__ == "__main__":
    App(help=__doc__, help_format="plaintext", default_command=main)()
