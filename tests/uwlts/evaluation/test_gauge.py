"""Gauge studies: AIAG's example, coverage of the intervals, and rejected tables."""

import json

import numpy as np
import pytest
from scipy.stats import chi2

import uwlts
from uwlts.cli import app
from uwlts.errors import DescriptionError, EvaluationError

# AIAG, Measurement Systems Analysis, 4th ed., figure III-B 6a: ten parts, three appraisers, three trials.
AIAG = {
    "A": [
        [0.29, -0.56, 1.34, 0.47, -0.80, 0.02, 0.59, -0.31, 2.26, -1.36],
        [0.41, -0.68, 1.17, 0.50, -0.92, -0.11, 0.75, -0.20, 1.99, -1.25],
        [0.64, -0.58, 1.27, 0.64, -0.84, -0.21, 0.66, -0.17, 2.01, -1.31],
    ],
    "B": [
        [0.08, -0.47, 1.19, 0.01, -0.56, -0.20, 0.47, -0.63, 1.80, -1.68],
        [0.25, -1.22, 0.94, 1.03, -1.20, 0.22, 0.55, 0.08, 2.12, -1.62],
        [0.07, -0.68, 1.34, 0.20, -1.28, 0.06, 0.83, -0.34, 2.19, -1.50],
    ],
    "C": [
        [0.04, -1.38, 0.88, 0.14, -1.46, -0.29, 0.02, -0.46, 1.77, -1.49],
        [-0.11, -1.13, 1.09, 0.20, -1.07, -0.67, 0.01, -0.56, 1.45, -1.77],
        [-0.15, -0.96, 0.67, 0.11, -1.45, -0.49, 0.21, -0.49, 1.87, -2.16],
    ],
}
ROWS = [(f"{part}", who, value) for who, trials in AIAG.items() for trial in trials for part, value in enumerate(trial)]


def test_aiags_example():
    """The published analysis of variance and its components, with the interaction pooled."""
    study = uwlts.gauge_study(ROWS, tolerance=8.0)
    rows = {row.source: row for row in study.variances}
    published = {"parts": 88.3619, "operators": 3.1673, "parts x operators": 0.3590, "repeats": 2.7589}
    for name, squares in published.items():
        assert rows[name].sum_of_squares == pytest.approx(squares, abs=2e-4)
    assert rows["parts x operators"].f == pytest.approx(0.434, abs=1e-3) and study.interaction_pooled
    stds = {name: each.std for name, each in study.components.items()}
    assert stds["repeatability (EV)"] == pytest.approx(0.199933, abs=1e-5)
    assert stds["reproducibility (AV)"] == pytest.approx(0.226838, abs=1e-5)
    assert stds["gauge (GRR)"] == pytest.approx(0.302373, abs=1e-5)
    assert stds["parts (PV)"] == pytest.approx(1.042327, abs=1e-5)
    assert study.components["gauge (GRR)"].share_percent == pytest.approx(27.9, abs=0.05)
    assert study.components["gauge (GRR)"].tolerance_percent == pytest.approx(100 * 6 * 0.302373 / 8, abs=1e-3)
    assert study.distinct == 4
    assert any("pooled with the repeatability" in line for line in study.lines())


def test_intervals_of_single_mean_squares_are_those_of_chi_square():
    """78 degrees of freedom with the pooled interaction; a quantile of 20,000 draws is known to 0.5 %.

    The other mean squares are forty and two hundred times as large, so that nearly they alone count. Upper ends with 2
    and 9 degrees of freedom are known to 2.3 and 0.7 %.
    """
    components = uwlts.gauge_study(ROWS).components
    found = components["repeatability (EV)"]
    assert found.low == pytest.approx(found.std * np.sqrt(78 / chi2.ppf(0.975, 78)), rel=0.01)
    assert found.high == pytest.approx(found.std * np.sqrt(78 / chi2.ppf(0.025, 78)), rel=0.01)
    assert found.tolerance_percent is None
    parts, operators = components["parts (PV)"], components["reproducibility (AV)"]
    assert parts.low == pytest.approx(np.sqrt(9.8180 / chi2.ppf(0.975, 9)), rel=0.01)
    assert parts.high == pytest.approx(np.sqrt(9.8180 / chi2.ppf(0.025, 9)), rel=0.03)
    assert operators.high == pytest.approx(np.sqrt(1.5836 / 30 * 2 / chi2.ppf(0.025, 2)), rel=0.1)


def test_components_of_chosen_mean_squares():
    """Orthogonal effects of three parts, two operators, their interaction, and two repeats; by hand."""
    part, operator, both, repeat = 5.0, 1.5, 0.5, 0.1
    rows = [
        (f"p{p}", f"o{o}", 7 + part * (p - 1) + operator * s + both * s * (1, -2, 1)[p] + repeat * r)
        for p in range(3)
        for o, s in enumerate((-1, 1))
        for r in (-1, 1)
    ]
    study = uwlts.gauge_study(rows)
    squares = {"parts": 4 * part**2, "operators": 12 * operator**2, "parts x operators": 12 * both**2}
    squares["repeats"] = 2 * repeat**2
    assert {row.source: row.mean_square for row in study.variances} == pytest.approx(squares)
    assert [row.degrees for row in study.variances] == [2, 1, 2, 6] and not study.interaction_pooled
    assert [row.f for row in study.variances[:3]] == pytest.approx(
        [squares["parts"] / 3, squares["operators"] / 3, 3 / squares["repeats"]]
    )
    assert study.variances[3].f is None
    # F of 2 and 2 degrees of freedom exceeds x with the probability 1 / (1 + x).
    assert study.variances[0].probability == pytest.approx(1 / (1 + 100 / 3))
    of_both, of_operators, of_parts = (3 - 0.02) / 2, (27 - 3) / 6, (100 - 3) / 4
    variances = [0.02, of_operators + of_both, 0.02 + of_operators + of_both, of_parts]
    variances.append(variances[2] + of_parts)
    assert [each.std**2 for each in study.components.values()] == pytest.approx(variances)
    shares = [each.share_percent for each in study.components.values()]
    assert shares == pytest.approx(100 * np.sqrt(np.array(variances) / variances[-1]))
    assert study.distinct == int(1.41 * np.sqrt(of_parts / variances[2])) == 2
    assert "parts x operators             2            3  150.000       0.0000" in "\n".join(study.lines())


@pytest.mark.parametrize("interaction", [0.0, 0.5])
def test_intervals_hold_the_truth(interaction):
    rng, held, count = np.random.default_rng(3), [], 120
    truth = {"repeatability (EV)": 0.5, "parts (PV)": 2.0}
    truth["gauge (GRR)"] = float(np.sqrt(0.25 + 0.7**2 + interaction**2))
    for _ in range(count):
        values = 2.0 * rng.normal(size=(8, 1, 1)) + 0.7 * rng.normal(size=(1, 6, 1)) + 0.5 * rng.normal(size=(8, 6, 2))
        values = values + interaction * rng.normal(size=(8, 6, 1))
        rows = [(str(p), str(o), values[p, o, k]) for p in range(8) for o in range(6) for k in range(2)]
        study = uwlts.gauge_study(rows)
        held.append([study.components[name].low <= std <= study.components[name].high for name, std in truth.items()])
    # Four standard deviations of a fraction of 120 are 8 %; pooling after a test reduces the coverage a little more.
    assert (np.mean(held, axis=0) > 0.85).all()


def test_a_reference_measured_again_and_again():
    values = 50.0 + 0.004 + 0.002 * np.sin(np.arange(50.0))
    study = uwlts.gauge_study([("ball", "me", value) for value in values], tolerance=0.1, true_value=50.0)
    assert study.bias == pytest.approx(values.mean() - 50.0) and abs(study.bias) > study.bias_half_interval
    assert study.bias_half_interval == pytest.approx(2.0096 * values.std(ddof=1) / np.sqrt(50), rel=1e-4)
    assert study.cg == pytest.approx(0.02 / (6 * values.std(ddof=1)))
    assert study.cgk == pytest.approx((0.01 - study.bias) / (3 * values.std(ddof=1)))
    text = "\n".join(study.lines())
    assert "significant" in text and f"Cg, Cgk                   {study.cg:.3f}, {study.cgk:.3f}" in text


def write(path, rows, head="part;operator;value"):
    path.write_text("\n".join([head, *(f"{p};{o};{str(v).replace('.', ',')}" for p, o, v in rows)]) + "\n")
    return path


def test_the_command_reads_a_table_and_writes_json(tmp_path, capsys):
    path = write(tmp_path / "table.csv", ROWS)
    app(["gauge", str(path), "--tolerance", "8", "--out", str(tmp_path / "gauge.json")], result_action="return_value")
    assert "distinct categories       4" in capsys.readouterr().out
    record = json.loads((tmp_path / "gauge.json").read_text())
    assert record["components"]["gauge (GRR)"]["std"] == pytest.approx(0.302373, abs=1e-5)


@pytest.mark.parametrize(
    ("rows", "head", "error", "message"),
    [
        (ROWS[:-1], "part;operator;value", EvaluationError, "part 9, operator C: 2"),
        ([row for row in ROWS if row[0] == "1"], "part;operator;value", EvaluationError, "1 parts"),
        ([row for row in ROWS if row[1] == "A"], "part;operator;value", EvaluationError, "1 operators"),
        (ROWS[:10] + ROWS[30:40], "part;operator;value", EvaluationError, "a study needs repeats"),
        (ROWS, "part;operator;size", DescriptionError, "expected part, operator and value"),
        ([("a", "b", "x")], "part;operator;value", DescriptionError, "line 2: found 'x', expected a number"),
        ([("a", "b", "nan")], "part;operator;value", DescriptionError, "not finite"),
        ([(p, o, 1.0) for p, o, _ in ROWS], "part;operator;value", EvaluationError, "all repeats are equal"),
    ],
)
def test_other_tables_are_refused(tmp_path, rows, head, error, message):
    with pytest.raises(error, match=message):
        uwlts.gauge_study(write(tmp_path / "table.csv", rows, head))


def test_wrong_numbers_are_refused():
    with pytest.raises(EvaluationError, match="tolerance is -1"):
        uwlts.gauge_study(ROWS, tolerance=-1.0)
    with pytest.raises(EvaluationError, match="the table contains several"):
        uwlts.gauge_study(ROWS, true_value=1.0)
    ten = [("ball", "me", value) for value in np.linspace(0.9, 1.1, 10)]
    assert uwlts.gauge_study(ten, true_value=1.0) is not None
    with pytest.raises(EvaluationError, match="found 9 measurements; .* at least 10"):
        uwlts.gauge_study(ten[1:], true_value=1.0)
