"""Regression of length errors on directions: exact without noise, intervals that cover, and what is undetermined."""

import numpy as np
import pytest

from uwlts.acceptance.characteristics import MeasuredValue
from uwlts.acceptance.directional_scale import fit_directional_scale

SHARES = {
    "XX": "stage",
    "YY": "sensor",
    "ZZ": "sensor",
    "YZ": "sensor",
    "XY": "stage or sensor",
    "XZ": "stage or sensor",
}
TRUE = {"XX": 4e-4, "YY": -1e-4, "ZZ": 2e-4, "YZ": 5e-5, "XY": -3e-4, "XZ": 1e-4}
LENGTH_MM = 100.0


def lengths(directions, errors_mm, *, calibration_std_mm=0.0):
    return [
        MeasuredValue(
            symbol="SD",
            position=str(number),
            label="spacing",
            value_mm=error,
            expanded_mm=0.0,
            place_mm=(0.0, 0.0, 0.0),
            length_mm=LENGTH_MM,
            direction=tuple(direction),
            calibration_std_mm=calibration_std_mm,
        )
        for number, (direction, error) in enumerate(zip(directions, errors_mm, strict=True))
    ]


def directions_of(rng, count):
    drawn = rng.normal(size=(count, 3))
    return drawn / np.linalg.norm(drawn, axis=1, keepdims=True)


def errors_of(directions):
    tensor = np.array(
        [
            [TRUE["XX"], TRUE["XY"], TRUE["XZ"]],
            [TRUE["XY"], TRUE["YY"], TRUE["YZ"]],
            [TRUE["XZ"], TRUE["YZ"], TRUE["ZZ"]],
        ]
    )
    return LENGTH_MM * np.einsum("ni,ij,nj->n", directions, tensor, directions)


def fit(values, stage=(1.0, 0.0, 0.0)):
    return fit_directional_scale(values, ["bar"] * len(values), [stage] * len(values))


def test_exact_errors_give_exact_components():
    directions = directions_of(np.random.default_rng(1), 9)
    found = fit(lengths(directions, errors_of(directions)))
    assert {each.component: each.share for each in found.components} == SHARES
    assert {each.component: each.value for each in found.components} == pytest.approx(TRUE, abs=1e-12)
    assert found.anisotropy.value == pytest.approx(TRUE["XX"] - (TRUE["YY"] + TRUE["ZZ"]) / 2, abs=1e-12)
    assert found.scatter_mm < 1e-10
    assert (found.lengths, found.degrees) == (9, 3)


def test_intervals_cover_the_true_components():
    """Over 300 drawn tests with scatter and a common error of calibration, 95 % of the intervals cover.

    The artefact's error makes the six of one test dependent: 300 independent ones have a standard deviation of 1.3 %.
    Coverage below 95 % - 5 * 1.3 % has a probability of less than 1e-6.
    """
    rng, covered, narrower = np.random.default_rng(2), [], []
    for _ in range(300):
        directions = directions_of(rng, 11)
        errors = errors_of(directions) + rng.normal(0, 0.005, 11) + rng.normal(0, 0.01)
        found = fit(lengths(directions, errors, calibration_std_mm=0.01))
        covered += [abs(each.value - TRUE[each.component]) <= each.half_interval for each in found.components]
        narrower.append(found.anisotropy.std / found.components[0].std)
        across = TRUE["XX"] - (TRUE["YY"] + TRUE["ZZ"]) / 2
        covered.append(abs(found.anisotropy.value - across) <= found.anisotropy.half_interval)
    assert 0.885 < np.mean(covered) <= 1.0
    # The calibration of 100 µm/m is most of a scale's uncertainty, and no part of the difference of two.
    assert np.median(narrower) < 0.8


def test_undetermined_components_have_no_value():
    """Bars along X and Y alone determine neither Z nor shears; their standard errors need further lengths."""
    found = fit(lengths(np.eye(3)[[0, 1, 1]], [0.01, 0.02, 0.02]))
    values = {each.component: each.value for each in found.components}
    assert values == pytest.approx({"XX": 1e-4, "YY": 2e-4, "ZZ": None, "YZ": None, "XY": None, "XZ": None})
    assert found.anisotropy is None
    assert any("do not determine ZZ, YZ, XY, XZ" in each for each in found.remarks)
    found = fit(lengths(np.eye(3)[:2], [0.01, 0.02]))
    assert [each.std for each in found.components] == [None] * 6
    assert any("standard errors are not known" in each for each in found.remarks)


def test_a_stage_along_the_sheet_has_no_share_of_its_own():
    directions = directions_of(np.random.default_rng(3), 9)
    found = fit(lengths(directions, errors_of(directions)), stage=(0.0, 0.0, 1.0))
    assert {each.share for each in found.components} == {"stage or sensor"}
    assert any("no direction of a length belongs" in each for each in found.remarks)


def test_no_lengths_give_no_shares():
    assert fit([]) is None
