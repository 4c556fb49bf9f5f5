"""Experiments: table of figures, refused campaigns, and a prediction by rendering."""

import json
import math
import os
import re
import sys
from pathlib import Path

import numpy as np
import pytest
from markupsafe import escape

import twin
import uwlts
from twin.experiments.detection import ProbabilityOfDetection
from twin.experiments.result import ExperimentResult
from twin.experiments.runner import CommandFailed, CommandLine, run_stages
from uwlts.errors import DescriptionError, DescriptionWarning, SetupError
from uwlts.model.library import load_sensor
from uwlts.storage.cloud import PointCloud
from uwlts.storage.cloud_files import write_cloud
from uwlts.storage.figure_table import FigureTable, MeasuredFigure


def row(campaign: str, figure: str, measured_mm: float, true_mm: float | None, expanded_mm: float | None):
    values = {"measured_mm": measured_mm, "true_mm": true_mm, "expanded_mm": expanded_mm}
    return MeasuredFigure(campaign=campaign, scan="spheres", method="joint", figure=figure, **values)


TABLE = FigureTable(
    rows=(
        row("0", "SSE", 100.0 - 0.035, 100.0, 0.03),
        row("0", "STD", 0.02, None, None),
        row("1", "SSE", 100.0 + 0.005, 100.0, 0.04),
    )
)
RESULT = ExperimentResult(
    campaign="c", sensor="s", as_built="b", seeds=(0, 1), table=TABLE, conditions={"spheres": "two spheres"}
)
CAMPAIGN = """
title = "small"
sensor = "thesis-small"
as_built = "thesis-small-as-built"

[imperfections]
stage_position_std_mm = 0.003

"""
TARGET = """
[[recordings]]
name = "target"
scene = "target-through-window"
motion = { step_mm = 40.0, count = 4 }
"""
SPHERES = """
[[recordings]]
name = "spheres"
scene = "spheres"
placements = ["standoff"]
"""


def test_errors_are_compared_with_their_uncertainties():
    (found,) = TABLE.errors()
    assert (found.scan, found.method, found.name) == ("spheres", "joint", "SSE")
    assert found.errors_mm == pytest.approx((-0.035, 0.005), abs=1e-12)
    assert found.stated_mm == pytest.approx(math.sqrt((0.03**2 + 0.04**2) / 2))
    assert found.found_mm == pytest.approx(2 * math.sqrt((0.035**2 + 0.005**2) / 2))
    assert found.covered == 1
    assert TABLE.covered_share() == 0.5
    assert RESULT.lines()[2].split() == ["spheres", "joint", "SSE", "0.0354", "0.0500", "1", "of", "2"]
    assert RESULT.lines()[-1] == "  spheres: two spheres"


def test_several_calibrations_are_compared_by_object_and_medium(tmp_path: Path):
    """Spheres and axes count together, air and water apart; a calibration without uncertainty has errors only."""
    sizes = {"one refraction": (0.08, None), "joint": (0.02, 0.03)}
    rows = [
        MeasuredFigure(
            campaign="0",
            scan=scan,
            method=method,
            figure=figure,
            true_mm=50.0,
            measured_mm=50.0 + sign * error,
            expanded_mm=expanded,
        )
        for method, (error, expanded) in sizes.items()
        for scan in ("spheres-near-water", "spheres-far-water", "spheres-near-air")
        for figure, sign in (("diameter error sphere 1", 1), ("diameter error sphere 2", -1), ("SSE", 2))
    ]
    table = FigureTable(rows=(*rows, row("0", "STD", 0.02, None, None)))
    found = {(each.scan, each.name, each.method): each for each in table.pooled_errors()}
    assert [*found] == [
        (scan, name, method)
        for scan in ("spheres", "spheres in air")
        for name in ("diameter error", "SSE")
        for method in sizes
    ]
    both = found["spheres", "diameter error", "joint"]
    assert both.errors_mm == pytest.approx((0.02, -0.02) * 2)
    assert (both.stated_mm, both.covered) == (pytest.approx(0.03), 4)
    assert found["spheres", "SSE", "joint"].covered == 0
    assert found["spheres", "SSE", "one refraction"].texts()[3:] == ("-", "0.3200", "-")
    result = RESULT.model_copy(update={"table": table})
    assert result.verdict() == "67 % of all errors are within U"
    cloud = PointCloud(np.eye(3), *np.zeros((3, 3), int), deviation_mm=np.array([0.01, -0.01, 0.0]))
    write_cloud(tmp_path / "a.ply", cloud)
    result.write(tmp_path, {"spheres-near": tmp_path / "a.ply"})
    page = (tmp_path / "experiment.html").read_text(encoding="utf-8")
    assert page.count('class="cloud-figure"') == 1 and "All 3 points" in page
    assert re.search(r"<td[^>]*>STD</td>\s*<td[^>]*>0.0200</td>", page)


def test_without_errors_there_is_no_verdict():
    nothing = TABLE.select(figure="STD")
    assert len(nothing.rows) == 1
    assert RESULT.model_copy(update={"table": nothing}).verdict() == "no errors to judge"


def test_the_table_becomes_a_data_frame():
    frame = uwlts.report.to_frame(TABLE)
    assert list(frame.columns[:4]) == ["campaign", "scan", "method", "figure"]
    assert frame["error_mm"].isna().tolist() == [False, True, False]
    assert frame["measured_mm"].tolist()[1] == 0.02


def test_a_missing_pandas_is_named_with_its_installation(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(SetupError, match=r"needs the library pandas.* -m pip install"):
        uwlts.report.to_frame(TABLE)


def test_detections_have_their_own_table():
    pits = ProbabilityOfDetection(
        flaw="pit",
        width_mm=5.0,
        method="hit/miss",
        checked="a pipe",
        depths_mm=(0.1, 0.2),
        found=(False, True),
        false_calls=1,
        a90_mm=0.18,
    )
    lines = RESULT.model_copy(update={"detections": (pits,)}).lines()
    (row,) = (line for line in lines if line.startswith("pit "))
    assert row.split(maxsplit=8)[:8] == ["pit", "hit/miss", "5", "1", "of", "2", "1", "0.180"]
    assert row.endswith("-  2 flaws, fewer than 60; a90 is not bounded")


def test_commands_that_are_done_are_skipped(tmp_path: Path):
    """A line runs if its output is missing or older than an input."""
    source, made = tmp_path / "a.toml", tmp_path / "nominal.json"
    source.touch()
    line = CommandLine("calibrate", f"uwlts nominal thesis --medium water --out {made} --overwrite", (source,), made)
    assert not line.is_done()
    counted: list[tuple[int, int]] = []
    run_stages([line], progress=lambda done, total, stage="": counted.append((done, total)))
    assert counted == [(0, 1), (1, 1)]
    assert line.is_done()
    before = made.stat().st_mtime_ns
    run_stages([line])
    assert made.stat().st_mtime_ns == before
    os.utime(source, ns=(before + 1, before + 1))
    assert not line.is_done()


@pytest.mark.parametrize(
    ("scenes", "seeds", "says"),
    [
        ([], [0], "scenes is empty"),
        (["spheres"], [], "seeds is empty"),
        (["spheres"], [-1], "seed is -1"),
        (["nowhere"], [0], "nowhere"),
        ([{"scene": "spheres", "place": "near"}], [0], "place"),
        (["target"], [0], "has no scan"),
    ],
)
def test_experiments_without_a_result_are_refused_before_rendering(scenes, seeds, says, tmp_path: Path):
    with pytest.raises(DescriptionError, match=says):
        twin.experiment("thesis-small", scenes, seeds, out=tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_a_sensor_and_its_scenes_give_a_table(tmp_path: Path):
    """Errors of a described sensor in an artefact and a free form.

    Added seeds are tested with less to render in `tests.system.test_reproduce`.
    """
    sensor = load_sensor("thesis-small")
    scenes = [
        {"scene": "spheres", "name": "spheres", "motion": {"start_mm": -18.0, "step_mm": 6.0, "count": 7}},
        {"scene": "head", "name": "head", "motion": {"start_mm": -20.0, "step_mm": 20.0, "count": 3}},
    ]
    found = twin.experiment(sensor, scenes, [3], out=tmp_path / "out", spp=4, imperfections={}, workers=1).table
    assert {row.scan for row in found.rows} == {"spheres", "head"}
    assert {row.campaign for row in found.rows} == {"campaign-3"}
    # Three expanded uncertainties are exceeded once in 10^9 figures.
    assert all(abs(e) < 3 * u for each in found.errors() for e, u in zip(each.errors_mm, each.expanded_mm, strict=True))
    assert {each.name for each in found.select(scan="head").errors()} == {f"mean error {axis}" for axis in "XYZ"}


@pytest.mark.parametrize(
    ("recordings", "options", "says"),
    [
        (SPHERES, {}, "'small' has no recording of a target for the calibration"),
        (TARGET, {}, "'small' has no scan of an artefact, a pitted pipe or a weld"),
        (TARGET + SPHERES, {"campaigns": 0}, "campaigns is 0; it must be at least 1"),
        (TARGET + SPHERES, {"water": 4.0}, "4"),
        (TARGET + SPHERES, {"first": -1}, "first is -1; it must be at least 0"),
    ],
)
def test_campaigns_that_predict_nothing_are_refused_before_rendering(recordings, options, says, tmp_path: Path):
    described = tmp_path / "small.toml"
    described.write_text(CAMPAIGN + recordings, encoding="utf-8")
    with pytest.raises(DescriptionError, match=says):
        twin.predict(campaign=described, out=tmp_path / "out", **options)
    assert not (tmp_path / "out").exists()


def write_results(folder: Path, name: str, *, error_mm: float, random_mm: float, systematic_mm: float) -> None:
    """Write the evaluation of spheres with one spacing, or the inspection of a pipe, as the software does."""
    expanded = 2 * math.hypot(random_mm, systematic_mm)
    parts = {"random_mm": random_mm, "systematic_mm": systematic_mm, "expanded_mm": expanded}
    evaluation = {
        "format": "uwlts-evaluation",
        "evaluation": {"figures_mm": {"SSE": error_mm, "PE": 0.1}, "vdi_range_mm": 0.08},
        "uncertainty": {"SSE": parts},
    }
    size = {"value": error_mm, "random": random_mm, "systematic": systematic_mm}
    inspection = {"format": "uwlts-findings", "features": [{"values": {"diameter": size, "ovality": size}}]}
    content = {"spheres": ("evaluation", evaluation), "pipe-around": ("inspection", inspection)}
    kind, written = content[name]
    (folder / f"{name}.{kind}.json").write_text(json.dumps(written), encoding="utf-8")


def predict_without_rendering(campaign: Path, out: Path, monkeypatch: pytest.MonkeyPatch) -> ExperimentResult:
    """Predict from results that are written instead of rendered and measured ones, of two campaigns."""

    def written(*_: object, seeds: range, **__: object) -> list[Path]:
        folders = [out / f"campaign-{seed}" for seed in seeds]
        for folder, systematic_mm in zip(folders, (0.12, 0.05), strict=True):
            folder.mkdir(parents=True)
            for name in ("spheres", "pipe-around"):
                write_results(folder, name, error_mm=0.1, random_mm=0.03, systematic_mm=systematic_mm)
        return folders

    monkeypatch.setattr("twin.experiments.experiment.record_campaigns", written)
    monkeypatch.setattr("twin.experiments.experiment.run_stages", lambda *_, **__: None)
    return twin.predict(campaign=campaign, out=out, campaigns=2)


PIPE = """
[[recordings]]
name = "pipe-around"
scene = "pipe-around"
"""


def test_predicted_uncertainties_contain_systematic_parts_and_certificates(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    described = tmp_path / "small.toml"
    described.write_text(CAMPAIGN + TARGET + SPHERES + PIPE, encoding="utf-8")
    result = predict_without_rendering(described, tmp_path / "out", monkeypatch)
    spacing, diameter, ovality = result.table.errors()
    certificate = 0.01  # of the scene `spheres`
    assert (spacing.scan, diameter.scan, ovality.scan) == ("spheres", "pipe-around", "pipe-around")
    assert (spacing.name, diameter.name, ovality.name) == ("SSE", "diameter error", "ovality error")
    assert ovality.expanded_mm == pytest.approx([2 * math.hypot(0.03, part) for part in (0.12, 0.05)])
    assert spacing.expanded_mm == pytest.approx([math.hypot(2 * 0.03, 2 * part, certificate) for part in (0.12, 0.05)])
    assert not result.understated


def test_deviations_beyond_the_stated_uncertainty_are_told_on_all_outputs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    described = tmp_path / "small.toml"
    larger = CAMPAIGN.replace("[imperfections]", "[imperfections]\ntemperature_half_width_c = 30.0")
    described.write_text(larger + TARGET + SPHERES + PIPE, encoding="utf-8")
    with pytest.warns(DescriptionWarning, match="temperature of the water") as told:
        result = predict_without_rendering(described, tmp_path / "out", monkeypatch)
    assert [each.key for each in result.understated] == ["temperature_k", "drift_k"]
    sentences = [each.text() for each in result.understated]
    assert [str(each.message) for each in told] == sentences
    assert "which is too small" in result.verdict()
    assert [line for line in result.lines() if line.startswith("understated: ")] == [
        f"understated: {text}" for text in sentences
    ]
    page = (tmp_path / "out" / "experiment.html").read_text(encoding="utf-8")
    assert all(str(escape(text)) in page for text in sentences)
    written = json.loads((tmp_path / "out" / "experiment.json").read_text(encoding="utf-8"))
    assert [each["key"] for each in written["understated"]] == ["temperature_k", "drift_k"]


def test_a_failed_calibration_is_reported_with_its_reason(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
):
    """The recordings are missing, as if another program had removed them."""
    described, out = tmp_path / "small.toml", tmp_path / "out"
    described.write_text(CAMPAIGN + TARGET + SPHERES, encoding="utf-8")
    (out / "campaign-0").mkdir(parents=True)
    monkeypatch.setattr("twin.experiments.experiment.record_campaigns", lambda *_, **__: [out / "campaign-0"])
    with pytest.raises(CommandFailed):
        twin.predict(campaign=described, out=out, campaigns=1)
    assert re.search(r"error: .*target\.h5", capfd.readouterr().out)
    assert not (out / "experiment.json").exists()


SMALL = """
base = "prediction"
title = "small"
sensor = "thesis-small"
as_built = "thesis-small"

[[recordings]]
name = "target-bare"
scene = "target"
motion = { step_mm = 38.0, count = 8 }

[[recordings]]
name = "target-air"
scene = "target-through-window"
motion = { step_mm = 38.0, count = 8 }

[[recordings]]
name = "target-water"
scene = "target-through-window"
media = ["water"]
motion = { start_mm = -120.0, step_mm = 26.0, count = 8 }

[[recordings]]
scene = "step"
placements = ["near", "far"]

[[recordings]]
name = "spheres"
scene = "spheres"

[[recordings]]
name = "step-scan"
scene = "step-scan"

[[recordings]]
name = "pipe-around"
scene = "pipe-around"

[[recordings]]
name = "pits"
scene = "pits"

[[recordings]]
name = "undercut"
scene = "undercut"
motion = { start_mm = -8.0, step_mm = 0.5, count = 33 }
"""


@pytest.mark.slow
def test_errors_of_a_rendered_campaign_are_within_the_prediction(tmp_path: Path):
    campaign, out = tmp_path / "small.toml", tmp_path / "out"
    campaign.write_text(SMALL, encoding="utf-8")
    options = {"campaign": campaign, "out": out, "water": "clear", "campaigns": 1, "every": 4, "spp": 8}
    options["workers"] = 1  # a second process would compile the renderer again
    result = twin.predict(**options)
    assert {each.scan for each in result.table.errors()} >= {"spheres", "step-scan", "pipe-around", "undercuts"}
    # Three expanded uncertainties are exceeded once in 10^9 figures.
    for each in result.table.errors():
        assert np.all(np.abs(each.errors_mm) < 3 * np.array(each.expanded_mm)), each
        assert 0.001 < each.stated_mm < 1.0, each
        assert "a = 0.32/m and b = 0.03/m" in result.conditions[each.scan], each
    assert {each.flaw for each in result.detections} == {"pit", "undercut"}
    assert any("25 profiles 2 mm apart" in each.checked for each in result.detections), "thinned by `every`"
    written = json.loads((out / "experiment.json").read_text(encoding="utf-8"))
    assert written["format"] == "twin-experiment"
    assert len(written["table"]["rows"]) == len(result.table.rows)
    assert len(written["detections"]) == 2
    page = (out / "experiment.html").read_text(encoding="utf-8")
    assert "spheres, SSE" in page and "Probability of detection" in page and "Where the statements were checked" in page
    # A second call renders nothing again.
    before = {path: path.stat().st_mtime_ns for path in out.rglob("*.truth.h5")}
    assert twin.predict(**options) == result
    assert {path: path.stat().st_mtime_ns for path in out.rglob("*.truth.h5")} == before
