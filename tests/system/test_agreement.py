"""Agreement between a design's formulas and the results of rendering and software, and its storage."""

from pathlib import Path

import numpy as np
import pytest

from tests.virtual_sensors import altered
from twin.design.designs import Design, EvaluatedDesign, HighlightedDesign, build_sensor
from twin.design.figures_of_merit import predict_scatter
from twin.design.sensor_arrays import extract_parameters
from twin.design.study import Study
from twin.design.verification import (
    Agreement,
    VerifiedMeasurements,
    compare_scatter,
    verify_candidate,
    verify_candidates,
)
from twin.rendering_options import CPU
from uwlts.model.sensor import Sensor
from uwlts.runtime.workers import open_workers

pytestmark = pytest.mark.slow


def candidate(label: str, number: int, sensor: Sensor) -> HighlightedDesign:
    return HighlightedDesign(label, sensor, EvaluatedDesign(number, {}, {}, 0.0, ""))


@pytest.fixture
def study() -> Study:
    variables = {
        "laser.baseline_mm": {"least": 150.0, "most": 400.0},
        "laser.triangulation_angle_deg": {"least": 15.0, "most": 60.0},
    }
    table = {"title": "test", "sensor": "thesis-small", "variables": variables, "follow": ["focus", "waist", "volume"]}
    return Study.model_validate(table)


def test_formulas_foretell_what_a_rendered_design_measures(study):
    # Unlike the thesis's in baseline, angle, stand-off and volume.
    design = Design(0, {"laser.baseline_mm": 200.0, "laser.triangulation_angle_deg": 30.0})
    row = verify_candidate(study, candidate("slim", 0, build_sensor(study, design)), workers=2, variant=CPU)
    assert row.failure == ""
    assert row.agrees and row.ratio < 1.25
    found, foretold = np.array(row.rendered_mm), np.array(row.predicted_mm)
    # At every depth, from sharp to blurred; nine depths differ more than twofold.
    assert len(found) >= 5 and found.max() > 2 * found.min()
    assert (np.abs(found / foretold - 1) < 0.35).all()
    assert row.exposure_ms == pytest.approx(row.predicted_exposure_ms, rel=0.3)
    assert np.abs(row.error_mm).max() < 0.1


def test_a_disagreement_is_reported(study, thesis):
    z = np.linspace(-50.0, 80.0, 5)
    foretold = predict_scatter(
        extract_parameters([thesis], [thesis.media["water"]]), z, np.full(5, 60.0), reflectance=0.5
    )

    def measured(factor: float) -> Agreement:
        rendered = VerifiedMeasurements(
            z_mm=z,
            points=np.full(5, 1000),
            scatter_mm=factor * foretold,
            error_mm=np.zeros(5),
            line_mm=np.full(5, 120.0),
            exposure_ms=1.0,
            seconds=1.0,
        )
        return compare_scatter(study, candidate("thesis", -1, thesis), rendered)

    for factor, agrees in ((1.0, True), (1.45, True), (1 / 1.45, True), (1.55, False), (1 / 1.55, False)):
        row = measured(factor)
        assert row.agrees is agrees
        assert row.ratio == pytest.approx(max(factor, 1 / factor))
        assert row.rendered_over_predicted == pytest.approx(factor)


def test_a_candidate_that_fails_is_kept_with_its_reason_and_tried_again(study, thesis, tmp_path):
    hopeless = altered(thesis, {"volume": {"near_mm": 900.0, "far_mm": 950.0}})
    candidates = [candidate("hopeless", 3, hopeless)]
    with open_workers(workers=1) as pool:
        (row,) = verify_candidates(study, tmp_path / "verified", candidates, pool, variant=CPU)
        (path,) = (tmp_path / "verified").iterdir()
        first = path.stat().st_mtime_ns
        (again,) = verify_candidates(study, tmp_path / "verified", candidates, pool, variant=CPU)
    assert row.label == "hopeless" and not row.agrees
    assert "volume" in row.failure and again.failure == row.failure
    assert path.stat().st_mtime_ns > first


def test_what_was_rendered_is_not_rendered_again(study, thesis, tmp_path, monkeypatch):
    folder: Path = tmp_path / "verified"
    candidates = [candidate("thesis", -1, thesis)]
    monkeypatch.setattr("twin.design.verification.verify_candidate", _counted)
    with open_workers(workers=1) as pool:
        for label in ("thesis", "renamed"):
            candidates = [candidate(label, -1, thesis)]
            (row,) = verify_candidates(study, folder, candidates, pool, variant=CPU)
            assert (row.label, row.ratio) == (label, 1.25)
    assert len(list(folder.iterdir())) == 1
    # The second time the worker would have returned another ratio.
    with open_workers(workers=1) as pool:
        (other,) = verify_candidates(
            study, folder, [candidate("x", -1, altered(thesis, {"laser": {"power_mw": 8.0}}))], pool, variant=CPU
        )
    assert other.ratio == 1.25 and len(list(folder.iterdir())) == 2


def _counted(study: Study, candidate: HighlightedDesign, **options: object) -> Agreement:
    first = candidate.label != "renamed"
    return Agreement(
        candidate.label,
        -1,
        z_mm=[1.0],
        predicted_mm=[1.0],
        rendered_mm=[1.0],
        error_mm=[1.0],
        line_mm=[1.0],
        ratio=1.25 if first else 9.0,
        rendered_over_predicted=1.25,
        agrees=True,
        exposure_ms=1.25,
        predicted_exposure_ms=1.25,
        seconds=1.25,
    )
