"""Stated uncertainty of registered views against their errors, for surfaces and errors that are drawn afresh.

    python -m docs.studies.registration_coverage [--count 6] [--first 1000] [--write]

Views are those of `tests/oracles/views.py`: free-form surfaces, domes and uneven pipes, made with NumPy alone. Initial
poses have errors of up to 0.8 mm and 0.4 deg. Errors of the poses are whitened with the stated covariance.
"""

import sys
from typing import NamedTuple

import numpy as np
from cyclopts import App

import uwlts
from docs.studies.result_tables import publish, table
from tests.oracles.profilers import turn_between, turn_by
from tests.oracles.views import ERRORS, SHAPES, Errors, Shape, View, draw_views
from uwlts.errors import EvaluationError
from uwlts.storage.cloud import PAIRS, PointCloud, PointUncertainty

_NORMAL_95 = 1.96


class Judged(NamedTuple):
    """Whitened square error of a registration, its degrees of freedom, and errors in stated standard deviations."""

    chi_square: float
    freedom: int
    pulls: np.ndarray


def as_cloud(view: View) -> PointCloud:
    """Return a view as a cloud with its stated uncertainty."""
    count, along = len(view.points_mm), view.towards
    own = np.tile([view.own_mm**2 * along[i] * along[j] for i, j in PAIRS], (count, 1))
    poses = view.profile_mm[:, :, None] * along if len(view.profile_mm) else None
    known = PointUncertainty(own, np.zeros((count, 3)), view.systematic_mm[:, :, None] * along, poses)
    uncertainty = known if view.stated else None
    return PointCloud(view.points_mm, np.full(count, 100.0), view.frame, view.line, uncertainty=uncertainty)


def judge(seed: int, shape: Shape, errors: Errors) -> Judged:
    """Register drawn views from wrong poses, and compare their errors with the stated covariance."""
    views, rng = draw_views(seed, shape, errors), np.random.default_rng([seed, 1])
    true = np.linalg.inv(views[0].pose) @ np.array([view.pose for view in views])
    start = true.copy()
    for number, view in enumerate(views[1:], start=1):
        middle = true[number, :3, :3] @ view.points_mm.mean(axis=0) + true[number, :3, 3]
        turn = turn_by(np.radians(0.4) * rng.uniform(-1, 1, 3))
        start[number, :3, :3] = turn @ true[number, :3, :3]
        start[number, :3, 3] = turn @ (true[number, :3, 3] - middle) + middle + rng.uniform(-0.8, 0.8, 3)
    found = uwlts.register([as_cloud(view) for view in views], poses=start)
    off = []
    for pose, right, middle in zip(found.poses[1:], true[1:], found.middles_mm[1:], strict=True):
        there = right[:3, :3] @ pose[:3, :3].T @ (middle - pose[:3, 3]) + right[:3, 3]
        off += [*(middle - there), *turn_between(right[:3, :3], pose[:3, :3])]
    std = found.std[1:].ravel()
    values, ways = np.linalg.eigh(found.covariance[6:, 6:] / np.outer(std, std))
    known = values > 1e-9
    whitened = (ways[:, known].T @ (off / std)) / np.sqrt(values[known])
    return Judged(float(whitened @ whitened), int(known.sum()), off / std)


def main(*, count: int = 6, first: int = 1000, write: bool = False) -> None:
    """Print the table; with `--write`, put it into its page. Refused registrations are counted, not averaged."""
    rows, total, refused = [], list[Judged](), 0
    for errors in ERRORS:
        cells = []
        for shape in SHAPES:
            own = []
            for seed in range(first, first + count):
                try:
                    own.append(judge(seed, shape, errors))
                except EvaluationError as error:
                    print(f"{shape}, {errors}, {seed}: {error}", file=sys.stderr)
            total += own
            refused += count - len(own)
            cells.append(_chi_square(own) if own else "refused")
        rows.append([errors, *cells])
    pulls = np.abs(np.concatenate([each.pulls for each in total]))
    inside = f"{100 * np.mean(pulls < _NORMAL_95):.0f} % of {len(pulls)} coordinates are within 95 %"
    rows.append([f"all: {_chi_square(total)}; {inside}; {refused} refused", *[""] * len(SHAPES)])
    publish({"coverage of registrations": table(["chi-square per degree of freedom", *SHAPES], rows)}, write=write)


def _chi_square(judged: list[Judged]) -> str:
    return f"{np.mean([each.chi_square / each.freedom for each in judged]):.2f}"


if __name__ == "__main__":
    App(help=__doc__, help_format="plaintext", default_command=main)()
