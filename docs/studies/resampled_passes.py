"""Covariance of a calibration by passes, against the scatter of solves with all errors drawn again.

    python -m docs.studies.resampled_passes --first 4000 --count 60 --write

Sensor, water, poses and noise are drawn as in the tests of `uwlts.recalibrate`; images follow from Fermat's principle.
Distances are those from the middle of the sheet to eight points around it, at 50 mm along Y and Z, as each calibration
measures them in images of its true sensor. Their stated covariance follows from the calibration's and the derivatives
of the points.
"""

import numpy as np
from cyclopts import App

from docs.studies.result_tables import publish, table
from tests.uwlts.joint_views import seen
from tests.uwlts.recalibration.test_recalibration import SENSOR, SHIFTED, TURNED, WATER, campaign, solve
from uwlts.calibration.joint.stored_estimate import read_stored_estimate
from uwlts.model.parameter_keys import MediumIndex, WindowParameter
from uwlts.model.placement import camera_from_object

PLACES_MM = np.array([0.0, 0.0, 20.0]) + 50.0 * np.array(
    [(0, 0, 0), (0, 1, 0), (0, 0, 1), (0, -1, 0), (0, 0, -1), (0, 1, 1), (0, 1, -1), (0, -1, 1), (0, -1, -1)]
)
"""The middle comes first, then a place along Y and one along Z."""
SIGNIFICANT = 1e-3
"""Least variance of an independent combination of distances, relative to the largest: others are numerical noise."""


def run(seed: int, motions: dict[str, tuple[float, float, float]]) -> tuple[dict[str, float], float, int]:
    """Return errors relative to the statement by quantity; chi-squared of all distances, and its degrees of freedom."""
    built, water, problem = campaign(seed, motions)
    found = solve(problem)
    ocs, index = camera_from_object(built), water.refractive_index(built.laser.wavelength_nm)
    pixels = seen(built, PLACES_MM @ ocs[:3, :3].T + ocs[:3, 3], index=index, window=True)
    known = read_stored_estimate(found.calibration, SENSOR, WATER)
    points, by = known.triangulate(pixels[:, 0], pixels[:, 1])
    away = points[1:] - points[0]
    distance = np.linalg.norm(away, axis=1)
    by_parameters = np.einsum("nj,njp->np", away / distance[:, None], by[1:, :, 1:] - by[0, :, 1:])
    covariance = by_parameters @ known.covariance @ by_parameters.T
    error = distance - np.linalg.norm(PLACES_MM[1:] - PLACES_MM[0], axis=1)
    relative = error / np.sqrt(np.diag(covariance))
    variance, along = np.linalg.eigh(covariance)
    kept = variance > SIGNIFICANT * variance[-1]
    chi2 = float(np.sum((along.T @ error)[kept] ** 2 / variance[kept]))
    true = {WindowParameter.DISTANCE: built.camera.window.distance_mm, MediumIndex("medium"): index}
    straight = {"50 mm along Y": float(relative[0]), "50 mm along Z": float(relative[1])}
    names = {WindowParameter.DISTANCE: "window distance", MediumIndex("medium"): "index of the water"}
    changed = {
        names[each.key]: float((each.after - true[each.key]) / each.std)
        for each in found.parameters
        if each.key in true
    }
    return straight | changed, chi2, int(kept.sum())


app = App(help=__doc__)


@app.default
def main(*, first: int = 4000, count: int = 60, write: bool = False) -> None:
    """Solve drawn campaigns of shifted and turned passes, and publish the table."""
    rows = []
    for kind, motions in (("shifted", SHIFTED), ("turned", TURNED)):
        results = []
        for seed in range(first, first + count):
            results.append(run(seed, motions))
            print(kind, seed, results[-1], flush=True)
        of_quantities = [[each[0][name] for each in results] for name in results[0][0]]
        chi2, freedom = (sum(each[k] for each in results) for k in (1, 2))
        ratios = [*np.sqrt(np.mean(np.square(of_quantities), axis=1)), np.sqrt(chi2 / freedom)]
        rows.append([kind, str(count), *(f"{each:.2f}" for each in ratios)])
    head = ["passes", "campaigns", *results[0][0], "all eight distances"]
    publish({"resampled passes": table(head, rows)}, write=write)


if __name__ == "__main__":
    app()
