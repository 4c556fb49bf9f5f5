"""Descriptions of studies, and their designs."""

from pathlib import Path

import numpy as np
import pytest

from twin.design.choice import StudyResults, describe_turbidity
from twin.design.designs import (
    Design,
    HighlightedDesign,
    build_sensor,
    count_designs,
    evaluate_designs,
    evaluate_sensor,
    make_sensor,
    sample_designs,
    select_design,
)
from twin.design.figures_of_merit import FIGURES, RENDERED_SCATTERING_DEPTH
from twin.design.study import Study, load_study
from twin.design.study_tables import format_design_value
from twin.design.sweep import encode_part, read_parts, write_csv, write_part
from uwlts.errors import CaptureError, DescriptionError, DesignError
from uwlts.model.library import list_names, load_sensor

BASELINE, ANGLE = "laser.baseline_mm", "laser.triangulation_angle_deg"
STUDY = """
title = "test"
follow = ["focus", "waist", "volume"]

[variables."laser.baseline_mm"]
least = 200.0
most = 400.0
steps = 3

[variables."camera.window.glass"]
values = ["N-BK7", "fused-silica"]

[choices.camera.small]
"camera.width_px" = 640
"camera.height_px" = 512
[choices.camera.large]
"camera.width_px" = 1280
"camera.height_px" = 1024

[constraints.line_mm]
least = 100.0
"""


def written(folder: Path, text: str = STUDY) -> Path:
    path = folder / "study.toml"
    path.write_text(text, encoding="utf-8")
    return path


@pytest.fixture
def study(tmp_path: Path) -> Study:
    return load_study(written(tmp_path))


def sampled(study: Study, **sampling: object) -> Study:
    return Study.model_validate(study.model_dump() | {"sampling": sampling})


# --- description ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", list_names("studies"))
def test_shipped_studies_can_be_judged(name):
    study = load_study(name)
    columns = evaluate_designs(study, sample_designs(study, 0, 300))
    assert np.isfinite(columns["violation"]).any()


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (("laser.baseline_mm", "laser.base_mm"), "no 'base_mm'"),
        (("laser.baseline_mm", "lidar.baseline_mm"), "no 'lidar'"),
        (("laser.baseline_mm", "camera.window"), "is a table"),
        (("least = 200.0", "least = 500.0"), "must be smaller"),
        (("steps = 3", "stepz = 3"), "unknown key"),
        (("line_mm", "line_km"), "unknown figure"),
        (('"focus"', '"fokus"'), "follow"),
        (('title = "test"', 'title = "test"\nsensor = "nobody"'), "nobody"),
        (('title = "test"', 'title = "test"\nmedium = "beer"'), "beer"),
        (('title = "test"', 'title = "test"\nreflectance = 1.5'), "reflectance"),
        (("least = 200.0\n", "values = [1.0]\nleast = 200.0\n"), "give least and most, or values"),
        (('"N-BK7", "fused-silica"', '"N-BK7", 1.52'), "contain texts and numbers"),
        (("choices.camera.", "choices.line_mm."), "give the choice another"),
        (('"camera.width_px" = 640', '"laser.baseline_mm" = 640'), "by a variable and by a choice"),
        (("laser.baseline_mm", "camera.focus_distance_mm"), "follow sets it"),
        (("laser.baseline_mm", "laser.window.tilt_x_deg"), "do not contain it"),
        (
            ("steps = 3", 'steps = 99999\n[variables."camera.f_number"]\nleast = 2.0\nmost = 9.0\nsteps = 9999'),
            "the grid has",
        ),
    ],
)
def test_mistakes_in_a_study_are_named(tmp_path, change, says):
    with pytest.raises(DescriptionError, match=says):
        load_study(written(tmp_path, STUDY.replace(*change)))


def test_a_sensor_beside_the_study_is_found(tmp_path):
    (tmp_path / "mine.toml").write_text('base = "thesis"\nname = "mine"\n[laser]\nbaseline_mm = 222.0\n')
    study = load_study(written(tmp_path, STUDY.replace('title = "test"', 'title = "test"\nsensor = "mine.toml"')))
    assert study.sensor.laser.baseline_mm == 222.0


def test_the_command_line_overrules_the_study(tmp_path):
    study = load_study(written(tmp_path), designs=17, verify=0)
    assert (study.sampling.designs, study.verify) == (17, 0)


# --- sampling ---------------------------------------------------------------------------------------------------------


def test_a_grid_holds_every_combination_once(study):
    assert count_designs(study) == 12
    designs = sample_designs(study, 0, 12)
    assert [design.number for design in designs] == list(range(12))
    assert len({tuple(design.values.values()) for design in designs}) == 12
    assert {design.values[BASELINE] for design in designs} == {200.0, 300.0, 400.0}
    assert {design.values["camera"] for design in designs} == {"small", "large"}


@pytest.mark.parametrize("kind", ["grid", "random", "sobol"])
def test_a_design_depends_on_its_number_only(study, kind):
    study = sampled(study, kind=kind, designs=12, seed=4)
    whole = sample_designs(study, 0, 12)
    assert [*sample_designs(study, 0, 5), *sample_designs(study, 5, 5), *sample_designs(study, 10, 99)] == whole
    if kind != "grid":
        assert sample_designs(sampled(study, kind=kind, designs=12, seed=5), 0, 12) != whole


def test_a_sobol_sequence_fills_the_range_evenly(study):
    study = sampled(study, kind="sobol", designs=1024)
    values = np.array([design.values[BASELINE] for design in sample_designs(study, 0, 1024)])
    counts, _ = np.histogram(values, bins=32, range=(200, 400))
    # A (0, m, s) net has exactly 1024 / 32 points in each of 32 even parts of every coordinate.
    assert (counts == 32).all()


def test_a_log_scale_is_even_in_the_logarithm():
    study = Study.model_validate(
        {"title": "t", "variables": {"laser.power_mw": {"least": 1.0, "most": 100.0, "steps": 3, "scale": "log"}}}
    )
    assert [design.values["laser.power_mw"] for design in sample_designs(study, 0, 3)] == pytest.approx(
        [1.0, 10.0, 100.0]
    )


def test_numbers_that_are_counted_are_whole(tmp_path):
    text = 'title = "t"\n[variables."camera.width_px"]\nleast = 1000.2\nmost = 1004.8\nsteps = 9\n'
    study = load_study(written(tmp_path, text))
    assert [design.values["camera.width_px"] for design in sample_designs(study, 0, 99)] == [
        1000,
        1001,
        1002,
        1003,
        1004,
        1005,
    ]
    random = sampled(study, kind="random", designs=50)
    assert {type(design.values["camera.width_px"]) for design in sample_designs(random, 0, 50)} == {int}


# --- designs ----------------------------------------------------------------------------------------------------------


def test_values_and_choices_reach_the_sensor(study):
    design = Design(0, {BASELINE: 333.0, "camera.window.glass": "N-BK7", "camera": "small"})
    sensor = make_sensor(study, design)
    assert (sensor.laser.baseline_mm, sensor.camera.window.glass) == (333.0, "N-BK7")
    assert (sensor.camera.width_px, sensor.camera.height_px) == (640, 512)
    # Fixed parameters keep the values of the base, and the base itself does not change.
    assert sensor.detector == load_sensor("thesis").detector
    assert study.sensor.laser.baseline_mm == 265.0


def test_a_design_as_built_is_judged_as_in_the_sweep(study):
    design = Design(0, {BASELINE: 333.0, "camera.window.glass": "N-BK7", "camera": "large"})
    sensor = build_sensor(study, design)
    assert sensor.camera.focus_distance_mm != load_sensor("thesis").camera.focus_distance_mm
    swept, alone = select_design(evaluate_designs(study, [design]), 0), evaluate_sensor(study, "built", sensor)
    for name in FIGURES:
        assert swept.figures[name] == pytest.approx(alone.figures[name], rel=1e-12, nan_ok=True)


@pytest.mark.parametrize(("share", "marked"), [(0.99, False), (1.01, True)])
def test_a_design_in_more_turbid_water_than_the_rendered_ones_is_marked(study, share, marked):
    thesis = load_sensor("thesis")

    def evaluated(per_m: float) -> HighlightedDesign:
        water = thesis.media["water"].model_copy(update={"scattering_per_m": per_m, "phase": "petzold"})
        sensor = thesis.model_copy(update={"media": thesis.media | {"water": water}})
        return HighlightedDesign("mine", sensor, evaluate_sensor(study, "built", sensor))

    per_metre = evaluated(1.0).design.number_of("scattering_depth")
    one = evaluated(share * RENDERED_SCATTERING_DEPTH / per_metre)
    depth = one.design.number_of("scattering_depth")
    assert depth == pytest.approx(share * RENDERED_SCATTERING_DEPTH)
    assert ("compared only up to" in describe_turbidity(one)) == marked
    columns = evaluate_designs(study, sample_designs(study, 0, 1)) | {"scattering_depth": np.array([depth])}
    judged = StudyResults(study, columns)
    assert ("not verified" in format_design_value(judged, "scattering_depth", 0)) == marked


def test_designs_that_fail_are_reported_with_their_reason(study):
    good = Design(0, {BASELINE: 300.0, "camera.window.glass": "N-BK7", "camera": "large"})
    absurd = Design(1, good.values | {BASELINE: -5.0})
    close = Design(2, good.values | {BASELINE: 60.0})
    columns = evaluate_designs(study, [absurd, good, close])
    assert columns["design"].tolist() == [1, 0, 2]
    assert "laser.baseline_mm" in columns["failure"][0] and columns["failure"][1] == ""
    assert "begin" in columns["failure"][2]
    assert np.isinf(columns["violation"][[0, 2]]).all() and np.isfinite(columns["sigma_z_rms_mm"]).tolist() == [0, 1, 0]


def test_violation_is_what_lacks_of_the_bounds(study):
    strict = Study.model_validate(
        study.model_dump() | {"constraints": {"line_mm": {"least": 300.0}, "sigma_z_rms_mm": {"most": 0.5}}}
    )
    design = Design(0, {BASELINE: 300.0, "camera.window.glass": "N-BK7", "camera": "large"})
    columns = evaluate_designs(strict, [design])
    assert columns["violation"].item() == pytest.approx(1 - columns["line_mm"].item() / 300.0)


def test_a_base_that_cannot_work_says_why(study):
    base = load_sensor("thesis")
    near = base.model_copy(update={"volume": base.volume.model_copy(update={"near_mm": 800.0, "far_mm": 900.0})})
    with pytest.raises(DesignError, match="reach no point"):
        evaluate_sensor(study, "near", near)


@pytest.mark.parametrize("name", list_names("studies"))
def test_many_designs_are_judged_as_each_by_itself(name):
    study = load_study(name)
    designs = sample_designs(sampled(study, kind="sobol", designs=1200), 0, 1200)
    # Small batches are evaluated without compiled formulas.
    places = [*range(30), *range(220, 250), *range(1170, 1200)]
    parts = [evaluate_designs(study, [designs[place] for place in places[k : k + 3]]) for k in range(0, len(places), 3)]
    # Formulas compiled for one number of designs are valid for fewer and for more.
    for count in (250, 1200, 250):
        for column, values in evaluate_designs(study, designs[:count]).items():
            found = values[[place for place in places if place < count]]
            apart = np.concatenate([part[column] for part in parts])[: len(found)]
            if values.dtype.kind == "f":
                # Newton's method ends at rounding errors, which a near end of some 200 mm has in its 13th digit.
                np.testing.assert_allclose(found, apart, rtol=1e-9, atol=1e-9)
            else:
                assert list(found) == list(apart)


def test_a_design_beyond_its_description_s_bounds_fails_alone():
    ranges = {BASELINE: {"least": 200.0, "most": 400.0}, "volume.near_mm": {"least": 100.0, "most": 500.0}}
    study = sampled(Study.model_validate({"title": "t", "variables": ranges}), kind="random", designs=64)
    columns = evaluate_designs(study, sample_designs(study, 0, 64))
    beyond = columns["volume.near_mm"] >= study.sensor.volume.far_mm
    assert 0 < beyond.sum() < 64
    assert all(
        ("must be smaller than far_mm" in reason) == wrong
        for reason, wrong in zip(columns["failure"], beyond, strict=True)
    )


# --- parts ------------------------------------------------------------------------------------------------------------


def test_parts_are_read_in_order_and_once(study, tmp_path):
    folder = tmp_path / "parts"
    folder.mkdir()
    for first in (6, 0, 3):
        write_part(folder, first, encode_part(evaluate_designs(study, sample_designs(study, first, 5))))
    columns = read_parts(folder)
    assert columns["design"].tolist() == list(range(11))
    expected = evaluate_designs(study, sample_designs(study, 0, 11))
    np.testing.assert_array_equal(columns["sigma_z_rms_mm"], expected["sigma_z_rms_mm"])
    assert columns["camera"].tolist() == expected["camera"].tolist()
    write_csv(tmp_path / "designs.csv", columns)
    lines = (tmp_path / "designs.csv").read_text().splitlines()
    assert len(lines) == 12 and lines[0].startswith(f"design,{BASELINE}")


def test_a_damaged_part_is_named(study, tmp_path):
    write_part(tmp_path, 0, encode_part(evaluate_designs(study, sample_designs(study, 0, 5)))[:-20])
    with pytest.raises(CaptureError, match="part-000000000"):
        read_parts(tmp_path)


def test_no_parts_are_no_columns(tmp_path):
    assert read_parts(tmp_path) == {}
