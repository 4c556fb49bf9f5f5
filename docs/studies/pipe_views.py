"""Pipe of 300 mm scanned from five sides: diameter, ovality and closure of the registered scans against the truth.

    python -m docs.studies.pipe_views --campaigns 5 --one-sensor

Scans are those of `tests/uwlts/pipe_views.py`: an oval pipe with noise of 0.02 mm along the rays. Initial poses have
errors of up to 2 mm and 0.5 deg. All points of a scan share a scale, a bow and a tilt of 0.03 mm at the ends of the
stripe, times ``--systematic``. They are drawn for each scan, or once for all scans of a campaign (``--one-sensor``).
"""

import argparse

import numpy as np

import uwlts
from tests.uwlts.pipe_views import OVALITY_MM, RADIUS_MM, oval, views
from uwlts.evaluation.artefact_figures import evaluate_pipe
from uwlts.model.artefacts import PipeStandard


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--campaigns", type=int, default=5)
    parser.add_argument("--systematic", type=float, default=0.3)
    parser.add_argument("--one-sensor", action="store_true")
    given = parser.parse_args()
    rows = []
    for campaign in range(given.campaigns):
        rng = np.random.default_rng(campaign)
        scans, _, wrong = views(rng, radius=oval, systematic=given.systematic, one_sensor=given.one_sensor)
        found = uwlts.register(scans, poses=wrong)
        pipe = evaluate_pipe(found.cloud.points_mm, PipeStandard(diameter_mm=2 * RADIUS_MM))
        closures = [pair.closure_mm for pair in found.pairs if pair.closure_mm is not None]
        rows.append((pipe.diameter_error_mm, (pipe.ovality_mm or np.nan) - OVALITY_MM, max(closures, default=np.nan)))
        print(
            f"campaign {campaign}: diameter {rows[-1][0]:+.3f}, ovality {rows[-1][1]:+.3f}, "
            f"closure {rows[-1][2]:.3f} mm"
        )
    mean = np.mean(np.abs(rows), axis=0)
    print(f"mean of the sizes: diameter {mean[0]:.3f}, ovality {mean[1]:.3f}, closure {mean[2]:.3f} mm")


if __name__ == "__main__":
    main()
