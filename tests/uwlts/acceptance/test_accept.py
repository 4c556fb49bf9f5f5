"""Acceptance test on drawn clouds: values, test value uncertainty, decisions, states, and the command."""

import json

import numpy as np
import pytest
import tomli_w
from scipy.spatial.transform import Rotation

import uwlts
from tests.system.in_process import run_program
from uwlts.cli import app
from uwlts.errors import DescriptionError
from uwlts.storage.cloud import PointCloud

NOISE_MM = 0.02
RADIUS_MM, SPACING_MM, HEIGHT_MM = 12.5, 60.0, 20.0
EXPANSION = 1.2e-5
STRETCH = np.diag([1.0004, 1.0001, 0.9998])
"""Deformation of all clouds: scale errors of 400, 100 and -200 µm/m along X, Y and Z."""
TURNS = {
    "across": (0.0, 0.0, 0.0),
    "along": (0.0, 0.0, 90.0),
    "depth-left": (40.0, 0.0, 0.0),
    "depth-right": (-40.0, 0.0, 0.0),
    "depth-along": (40.0, 0.0, 90.0),
    "diagonal": (25.0, 0.0, 45.0),
    "across-again": (5.0, 0.0, 0.0),
}


def save(folder, name, points, rng):
    noisy = points @ STRETCH + rng.normal(0, NOISE_MM, points.shape)
    count = len(noisy)
    PointCloud(noisy, np.ones(count), np.zeros(count), np.arange(count)).save(folder / name)


def sphere(rng, centre):
    """Points of a sphere, evenly over the cap of 70 deg about the point that faces the sensor."""
    z = 1 - rng.random(1500) * (1 - np.cos(np.radians(70)))
    turn, across = rng.uniform(0, 2 * np.pi, 1500), np.sqrt(1 - z**2)
    return centre + RADIUS_MM * np.column_stack([across * np.cos(turn), across * np.sin(turn), -z])


def plate(rng, count, low, high, z):
    return np.column_stack(
        [rng.uniform(low[0], high[0], count), rng.uniform(low[1], high[1], count), np.full(count, z)]
    )


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Clouds of a ball bar in seven positions, of a plane and of a step."""
    place, rng = tmp_path_factory.mktemp("clouds"), np.random.default_rng(5)
    for name, turn in TURNS.items():
        ends = Rotation.from_euler("xyz", turn, degrees=True).apply([[0, -SPACING_MM / 2, 0], [0, SPACING_MM / 2, 0]])
        save(place, f"{name}.ply", np.vstack([sphere(rng, end) for end in ends]), rng)
    save(place, "plane.ply", plate(rng, 4000, (-60, -60), (60, 60), 10.0), rng)
    step = [plate(rng, 2000, (-20, 2), (20, 40), 0.0), plate(rng, 2000, (-20, -40), (20, -2), HEIGHT_MM)]
    save(place, "step.ply", np.vstack(step), rng)
    return place


def content_of(**changes):
    bar = {"kind": "spheres", "diameters_mm": [25.0, 25.0], "spacings_mm": [SPACING_MM]}
    bar |= {"diameter_uncertainty_mm": 0.004, "spacing_uncertainty_mm": 0.006}
    artefacts = {
        "bar": {"standard": bar, "form_mm": 0.004, "form_uncertainty_mm": 0.003, "expansion_per_k": EXPANSION},
        "plate": {"standard": {"kind": "plane"}, "form_mm": 0.01},
        "step": {"standard": {"kind": "step", "height_mm": HEIGHT_MM, "height_uncertainty_mm": 0.004}},
    }
    positions = [{"name": name, "artefact": "bar", "file": f"{name}.ply"} for name in TURNS]
    positions += [
        {"name": name, "artefact": name, "file": f"{file}.ply"} for name, file in (("plate", "plane"), ("step", "step"))
    ]
    limits = {"PF_mm": 0.3, "PF95_mm": 0.15, "PS_mm": 0.1, "SD_mm": 0.1, "F_mm": 0.3, "F95_mm": 0.15, "E_mm": 0.05}
    content = {"title": "test", "volume_mm": [100.0, 120.0, 120.0], "mpe": limits, "artefacts": artefacts}
    content |= {"temperature": {"value_c": 20.0, "uncertainty_k": 2.0}, "positions": positions}
    return content | changes


def write_plan(folder, name="plan.toml", **changes):
    (folder / name).write_text(tomli_w.dumps(content_of(**changes)), encoding="utf-8")
    return folder / name


@pytest.fixture(scope="module")
def found(folder):
    return uwlts.accept(write_plan(folder))


def of(found, symbol):
    return next(each for each in found.characteristics if each.symbol == symbol)


def test_values_are_those_of_the_drawn_clouds(found):
    """Deformation and noise are known, so that every value is, too."""
    assert {each.state for each in found.positions} == {"judged"}
    spacings = [each for each in found.values if each.symbol == "SD"]
    assert len(spacings) == len(TURNS)
    for value, turn in zip(spacings, TURNS.values(), strict=True):
        along = Rotation.from_euler("xyz", turn, degrees=True).apply([0, SPACING_MM, 0])
        true = np.linalg.norm(along @ STRETCH) - SPACING_MM
        # The centre of a cap of 1,500 points with this noise has a standard uncertainty of 4 µm along its axis.
        assert value.value_mm == pytest.approx(true, abs=6 * 0.004 * np.sqrt(2))
        assert abs(abs(np.dot(value.direction, along)) / SPACING_MM - 1) < 1e-3
    # 95 % of normal noise are within 1.96 standard deviations; the spheres are deformed by 25 mm * 6e-4 / 2.
    for symbol, deformed in (("PF95", 0.008), ("F95", 0.0)):
        for value in (each for each in found.values if each.symbol == symbol):
            assert 3.92 * 0.9 * NOISE_MM < value.value_mm < 3.92 * 1.1 * NOISE_MM + deformed
    # All but 0.3 % of the points are within 2.97 standard deviations on average.
    for value in (each for each in found.values if each.symbol in ("PF", "F")):
        assert 5 * NOISE_MM < value.value_mm < 8 * NOISE_MM + 0.008
    assert of(found, "E").worst.value_mm == pytest.approx(-2e-4 * HEIGHT_MM, abs=6 * NOISE_MM * np.sqrt(8 / 2000))


def test_the_test_value_uncertainty_is_that_of_the_artefacts(found):
    """It has no part of the noise; the formulas are those of ISO/TS 23165."""
    thermal = SPACING_MM * EXPANSION * 1.0
    assert of(found, "SD").worst.expanded_mm == pytest.approx(2 * np.hypot(0.003, thermal), rel=1e-3)
    assert of(found, "PS").worst.expanded_mm == pytest.approx(2 * np.hypot(0.002, 25 * EXPANSION), rel=1e-3)
    assert of(found, "PF").worst.expanded_mm == pytest.approx(2 * np.hypot(0.002, 0.0015))
    assert of(found, "F").worst.expanded_mm == pytest.approx(0.01)
    assert of(found, "E").worst.expanded_mm == pytest.approx(0.004)


def test_warm_artefacts_are_longer(folder, found):
    warm = uwlts.accept(write_plan(folder, "warm.toml", temperature={"value_c": 30.0}))
    for cold, heated in zip(found.values, warm.values, strict=True):
        if cold.symbol == "SD":
            assert heated.value_mm - cold.value_mm == pytest.approx(-SPACING_MM * EXPANSION * 10, abs=1e-9)
    assert any("step: temperature or expansion is not stated" in each for each in warm.remarks)


@pytest.mark.parametrize(
    ("share", "decision"), [(1.1, "conformity proven"), (1.0, "undecided"), (0.9, "nonconformity proven")]
)
def test_a_decision_needs_the_whole_interval(found, folder, share, decision):
    """The limit is beyond, within or before the interval of the worst spacing."""
    worst = of(found, "SD").worst
    limit = abs(worst.value_mm) + (share - 1) * 12 * worst.expanded_mm
    judged = uwlts.accept(folder / "plan.toml", earlier=found.model_copy())
    assert judged.positions == found.positions
    limits = content_of()["mpe"] | {"SD_mm": limit}
    judged = uwlts.accept(write_plan(folder, "limited.toml", mpe=limits), earlier=found)
    assert of(judged, "SD").decision == decision
    assert judged.verdict == decision
    assert judged.conclusion.startswith(f"{decision}: ")
    if decision == "undecided":
        assert "SD: the limit is within the guard band" in judged.conclusion


def test_limits_may_grow_with_the_length(found, folder):
    worst = of(found, "SD").worst
    reach = abs(worst.value_mm) + worst.expanded_mm
    constant = 0.5 * reach
    for per_m, decision in ((1.1, "conformity proven"), (0.9, "undecided")):
        growth = (per_m * reach - constant) / (1e-3 * worst.length_mm)
        limits = content_of()["mpe"] | {"SD_mm": constant, "SD_mm_per_m": growth}
        judged = of(uwlts.accept(write_plan(folder, "growing.toml", mpe=limits), earlier=found), "SD")
        assert judged.decision == decision
        assert judged.limit_mm(judged.worst) == pytest.approx(constant + 1e-3 * growth * judged.worst.length_mm)
        assert judged.limit_text() == f"{constant:g} + {growth:g} L / m"


def test_what_is_missing_is_named(folder, tmp_path):
    """Missing files, unstated limits and certificates, and too few measurements: nothing is skipped in silence."""
    bare = content_of()["artefacts"]
    del bare["bar"]["form_mm"]
    bare["bar"]["standard"] = bare["bar"]["standard"] | {"spacings_mm": [SPACING_MM]}
    positions = content_of()["positions"][:1] + [{"name": "later", "artefact": "plate", "file": "later.ply"}]
    changes = {"artefacts": bare, "positions": positions, "mpe": {"PF_mm": 0.3, "F_mm": 0.3, "E_mm": 0.1}}
    found = uwlts.accept(write_plan(folder, "bare.toml", **changes))
    assert found.verdict == "undecided"
    assert found.conclusion == "undecided: 1 of 2 positions are still to be measured"
    assert [each.name for each in found.outstanding] == ["later"]
    decisions = {each.symbol: each.decision for each in found.characteristics}
    expected = {"PF": "undecided", "PF95": "no MPE", "PS": "no MPE", "SD": "no MPE"}
    assert decisions == expected | {"F": "undecided", "E": "undecided"}
    assert "states too little for a test value uncertainty" in of(found, "PF").reason
    assert of(found, "F").reason == of(found, "E").reason == "not measured"
    said = "\n".join(found.lines())
    assert "next: measure plate, later, into later.ply" in said
    assert "not met: sphere spacing: positions: at least 7; 1 of 1 planned" in said
    assert "not met: flatness: positions: at least 6; 0 of 1 planned" in said
    assert "bar: without form_mm of the certificate" in said
    assert "SD: no maximum permissible error is stated" in said


def test_a_cloud_without_the_artefact_fails_with_the_reason(folder):
    positions = [{"name": "wrong", "artefact": "bar", "file": "plane.ply"}, *content_of()["positions"][1:2]]
    found = uwlts.accept(write_plan(folder, "wrong.toml", positions=positions))
    assert found.positions[0].state == "failed"
    assert "spheres found" in found.positions[0].reason
    assert found.verdict == "undecided"
    assert "wrong failed: " in found.conclusion
    assert "next: measure again bar, wrong" in "\n".join(found.lines())


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"positions": []}, "positions"),
        ({"positions": content_of()["positions"][:1] * 2}, "two positions have the name 'across'"),
        ({"positions": [{"name": "a", "artefact": "cube", "file": "a.ply"}]}, "names the artefact 'cube'"),
        ({"artefacts": {"pipe": {"standard": {"kind": "pipe", "diameter_mm": 3.0}}}}, "a pipe is no artefact"),
        ({"mpe": {"PF": 0.1}}, "mpe.PF: unknown key"),
        ({"mpe": {"PF_mm": -0.1}}, "mpe.PF_mm"),
        ({"mpe": {"SD_mm_per_m": 0.1}}, "SD_mm_per_m needs SD_mm"),
        ({"decision_rule": "U95"}, "decision_rule"),
        ({"positions": [content_of()["positions"][0] | {"region_mm": [[0, 1], [2, 1], [0, 1]]}]}, "interval of Y"),
    ],
)
def test_wrong_plans_are_refused(tmp_path, changes, said):
    with pytest.raises(DescriptionError, match=said):
        uwlts.accept(write_plan(tmp_path, **changes))


def test_a_result_is_kept_whole_and_sealed(folder, found, tmp_path):
    found.save(tmp_path / "result.json")
    assert uwlts.read(tmp_path / "result.json") == found
    content = json.loads((tmp_path / "result.json").read_text(encoding="utf-8"))
    content["characteristics"][0]["mpe_mm"] = 9.0
    (tmp_path / "result.json").write_text(json.dumps(content), encoding="utf-8")
    continued = uwlts.accept(folder / "plan.toml", earlier=tmp_path / "result.json")
    assert continued.edited
    assert "the earlier result was edited after it was written" in continued.remarks
    assert uwlts.read(tmp_path / "result.json").edited


def test_the_command_leads_through_the_plan(folder, tmp_path):
    """The same command line again and again: each run continues the result, and judges when everything is there."""
    for name in ("plane.ply", "step.ply"):
        (tmp_path / name).write_bytes((folder / name).read_bytes())
    plan = write_plan(
        tmp_path, positions=content_of()["positions"][7:], mpe={"F_mm": 0.3, "F95_mm": 0.15, "E_mm": 0.05}
    )
    (tmp_path / "step.ply").rename(tmp_path / "later.ply")
    begun = run_program(app, "uwlts", "accept", str(plan))
    assert begun.returncode == 1
    assert "next: measure step, step, into step.ply" in begun.stdout
    assert begun.stdout.splitlines()[-2] == "undecided: 1 of 2 positions are still to be measured"
    (tmp_path / "later.ply").rename(tmp_path / "step.ply")
    done = run_program(app, "uwlts", "accept", str(plan))
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[-2].startswith("conformity proven: every value with its guard band is within")
    assert "requirements of VDI/VDE 2634 part 2 are not met" in done.stdout.splitlines()[-2]
    page = (tmp_path / "plan.acceptance.html").read_text(encoding="utf-8")
    assert "Conformity proven" in page and "not tested" in page
    assert uwlts.read(tmp_path / "plan.acceptance.json").verdict == "conformity proven"
    other = write_plan(tmp_path, title="another")
    refused = run_program(app, "uwlts", "accept", str(other))
    assert refused.returncode == 2
    assert "is not of the test 'another'" in refused.stderr
