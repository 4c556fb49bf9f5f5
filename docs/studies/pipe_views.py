"""Pipe of 300 mm scanned from five sides: diameter, ovality and closure of the registered scans against the truth.

    python -m docs.studies.pipe_views [--write]

Scans are those of `tests/uwlts/pipe_views.py`: an oval pipe with noise of 0.02 mm along the rays. Initial poses have
errors of up to 2 mm and 0.5 deg. All points of a scan share a scale, a bow and a tilt of 0.03 mm at the ends of the
stripe, times a factor. They are drawn for each scan, or once for all scans of a campaign.
"""

import sys

import numpy as np
from cyclopts import App

import uwlts
from docs.studies.result_tables import publish, table
from tests.uwlts.pipe_views import OVALITY_MM, RADIUS_MM, oval, views
from uwlts.errors import EvaluationError
from uwlts.evaluation.artefact_figures import evaluate_pipe
from uwlts.model.artefacts import PipeStandard

CASES = (
    ("0.009 mm, of each scan", 0.3, False, 5),
    ("0.009 mm, of one calibration", 0.3, True, 10),
    ("0.03 mm, of one calibration", 1.0, True, 10),
)
"""Name, factor of the common errors, if they are those of one calibration, and campaigns."""


def errors_mm(campaigns: int, *, systematic: float, one_sensor: bool) -> np.ndarray:
    """Return the errors of diameter and ovality and the largest closure (C, 3) of campaigns that register, mm."""
    rows = []
    for campaign in range(campaigns):
        rng = np.random.default_rng(campaign)
        scans, _, wrong = views(rng, radius=oval, systematic=systematic, one_sensor=one_sensor)
        try:
            found = uwlts.register(scans, poses=wrong)
        except EvaluationError as error:
            print(f"campaign {campaign}: {error}", file=sys.stderr)
            continue
        pipe = evaluate_pipe(found.cloud.points_mm, PipeStandard(diameter_mm=2 * RADIUS_MM))
        closures = [pair.closure_mm for pair in found.pairs if pair.closure_mm is not None]
        rows.append((pipe.diameter_error_mm, (pipe.ovality_mm or np.nan) - OVALITY_MM, max(closures, default=np.nan)))
    return np.array(rows)


def main(*, write: bool = False) -> None:
    """Print the table; with `--write`, put it into its page. Refused campaigns are not averaged."""
    rows = []
    for name, systematic, one_sensor, campaigns in CASES:
        found = np.abs(errors_mm(campaigns, systematic=systematic, one_sensor=one_sensor))
        cells = [f"{value:.3f}" for value in found.mean(axis=0)]
        rows.append([name, f"{len(found)} of {campaigns}", *cells, f"{found[:, 2].max():.3f}"])
    head = ["errors", "campaigns that register", "diameter mm", "ovality mm", "largest closure mm", "at most"]
    publish({"scans of a pipe": table(head, rows)}, write=write)


if __name__ == "__main__":
    App(help=__doc__, help_format="plaintext", default_command=main)()
