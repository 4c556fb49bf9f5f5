"""Lengths by the sequential calibration against those by the joint one, from the same drawn images.

python -m docs.studies.joint_against_sequential [SEEDS] [--first 0] [--write]
"""

from dataclasses import replace

import numpy as np
from cyclopts import App

from docs.studies.result_tables import publish, table
from tests.uwlts.simulated_campaign import ModelErrors, drawn_reality, evidence
from uwlts.calibration.calibrate import solve_jointly
from uwlts.calibration.camera.lens import LensChoice
from uwlts.calibration.joint.observability import (
    compute_mesh_lengths,
    list_regions,
    project_sheet_points,
    read_region_estimate,
)
from uwlts.calibration.sequential.sequential_calibration import CalibrationOptions, Evidence, solve
from uwlts.errors import CalibrationError
from uwlts.model.calibration import Calibration
from uwlts.model.library import load_sensor
from uwlts.optics.triangulation import rays_on_sheet

WRONG = {
    "target stretched by 0.3 %": ModelErrors(stretch=0.003),
    "target a saddle of 0.5 mm": ModelErrors(saddle_mm=0.5),
    "target twisted by 0.5 mm": ModelErrors(twist_mm=0.5),
    "lens with k3 = 0.3 more": ModelErrors(distortion=(("k3", 0.3),)),
}
"""Errors that the description does not contain."""
NONE = "as described, within the stated uncertainties"
OPTIONS = CalibrationOptions(poses="stage-normal", correct_circles=False, lens=LensChoice())


def compare(joint: Calibration, other: Calibration) -> float:
    """Return the rms difference of lengths on the sheet, divided by the rms standard uncertainty of the joint ones."""
    region = list_regions(joint)[0]
    known, at = read_region_estimate(joint, region), region.mesh().reshape(-1, 2)
    lengths, index = compute_mesh_lengths(known, region), 1.0
    if region.view.medium is not None:
        index = joint.medium_index(region.medium)
    seen = other if region.view.window else other.model_copy(update={"window": None})
    points = rays_on_sheet(seen, project_sheet_points(known, at), medium_index=index)[0].points_mm
    first, second = np.triu_indices(len(at), k=1)
    differences = np.linalg.norm(points[first] - points[second], axis=1) - lengths.length_mm
    return float(np.sqrt(np.mean(differences**2) / np.mean(lengths.std_mm(known.covariance) ** 2)))


def measure(seed: int, errors: ModelErrors) -> tuple[str, float]:
    """Return what the joint calibration says of a drawn campaign, and the ratio of `compare`."""
    sensor = load_sensor("thesis")
    gathered = evidence(drawn_reality(sensor, np.random.default_rng(seed), errors=errors), sensor, wet=True)
    gathered = replace(gathered, series=gathered.series[:1])
    try:
        joint = solve_jointly(gathered, options=OPTIONS)
    except CalibrationError:
        return "refused", np.nan
    series = gathered.series[0]
    given = Evidence(
        sensor=sensor,
        medium_kind="air",
        stage_direction=np.array([0.0, 0.0, 1.0]),
        approaching=series.approaching is not False,
        air=replace(series.found, outliers=[0] * len(series.found.images)),
        window=sensor.camera.window,
        steps=[step for step, _ in gathered.steps],
        sources={},
        warnings=[],
    )
    said = "accepted with a warning" if joint.warnings else "accepted"
    return said, compare(joint.calibration, solve(given, options=OPTIONS).calibration)


def main(seeds: int = 8, *, first: int = 0, write: bool = False) -> None:
    """Print the ratios; with `--write`, put their ranges into their page."""
    rows = []
    for name, errors in {NONE: ModelErrors(), **WRONG}.items():
        found = [measure(seed, errors) for seed in range(first, first + (seeds if name == NONE else 2))]
        print(name, found, flush=True)
        said, ratios = [each for each, _ in found], [ratio for _, ratio in found if np.isfinite(ratio)]
        counts = ", ".join(f"{each} {said.count(each)}" for each in dict.fromkeys(said))
        rows.append([name, counts, f"{min(ratios):.1f} to {max(ratios):.1f}" if ratios else "-"])
    head = ["sensor and target", "joint calibration", "difference / stated standard uncertainty"]
    publish({"joint-against-sequential": table(head, rows)}, write=write)


if __name__ == "__main__":
    App(help=__doc__, help_format="plaintext", default_command=main)()
