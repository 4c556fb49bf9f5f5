"""Decisions on drawn values by each rule: worst value, guard bands, and the probability of conformity."""

from statistics import NormalDist
from typing import get_args

import numpy as np
import pytest

from uwlts.acceptance.acceptance_plan import DecisionRule
from uwlts.acceptance.characteristics import RULES, CharacteristicValue, Decision, judge_characteristic

GUARDS = {"U": 2.0, "1.65 u": 1.65, "simple": 0.0}


def value(error, expanded, number=0):
    return CharacteristicValue(
        symbol="SD", position=f"p{number}", label="spacing", value_mm=error, expanded_mm=expanded, place_mm=(0, 0, 0)
    )


def draw(seed):
    """Values about a limit of 0.1 mm, each with its own uncertainty."""
    rng = np.random.default_rng([14253, seed])
    errors, expanded = rng.uniform(-0.12, 0.12, 6) * rng.choice([0.5, 1.0]), rng.uniform(0.001, 0.04, 6)
    return [value(*pair, number) for number, pair in enumerate(zip(errors, expanded, strict=True))]


def test_each_rule_is_tested_and_named_with_its_edition():
    assert GUARDS.keys() == RULES.keys() == set(get_args(DecisionRule))
    for rule, edition in (("U", "2013"), ("1.65 u", "2017"), ("simple", "2019")):
        assert edition in RULES[rule]


@pytest.mark.parametrize("rule", GUARDS)
def test_the_worst_value_decides_with_its_guard_band(rule):
    """Of 200 draws; the worst value is that with the largest sum of size and guard band."""
    found: set[Decision] = set()
    for seed in range(200):
        values = draw(seed)
        guards = [GUARDS[rule] * each.expanded_mm / 2 for each in values]
        sizes = [abs(each.value_mm) for each in values]
        judged = judge_characteristic("SD", values, 0.1, rule=rule)
        reach = [size + guard for size, guard in zip(sizes, guards, strict=True)]
        assert judged.worst is values[int(np.argmax(reach))], seed
        outside = any(size - guard > 0.1 for size, guard in zip(sizes, guards, strict=True))
        within = max(reach) <= 0.1
        proven, against = (
            ("accepted", "rejected") if rule == "simple" else ("conformity proven", "nonconformity proven")
        )
        assert judged.decision == (against if outside else proven if within else "undecided"), seed
        assert bool(judged.reason) == (judged.decision == "undecided")
        found.add(judged.decision)
    assert len(found) == (2 if rule == "simple" else 3)


def test_the_probability_of_conformity_is_that_of_draws():
    """Of true values about each value, 20,000 draws; the smallest of all values counts."""
    rng = np.random.default_rng(5)
    for seed in range(10):
        values = draw(seed)
        shares = [
            np.mean(np.abs(each.value_mm + each.expanded_mm / 2 * rng.standard_normal(20_000)) <= 0.1)
            for each in values
        ]
        stated = judge_characteristic("SD", values, 0.1).probability
        # Five standard deviations of a share of 20,000 draws.
        assert stated == pytest.approx(min(shares), abs=5 * 0.5 / np.sqrt(20_000))


def test_the_rule_of_2017_accepts_95_per_cent_at_its_border():
    """The guard band of 1.65 u leaves a probability of conformity of 95 %, that of U 97.7 %."""
    for rule, share in (("1.65 u", 0.95), ("U", NormalDist().cdf(2.0))):
        border = 0.1 - GUARDS[rule] * 0.01
        for step, proven in ((-1e-9, True), (1e-6, False)):
            judged = judge_characteristic("SD", [value(border + step, 0.02)], 0.1, rule=rule)
            assert (judged.decision == "conformity proven") == proven
            assert judged.probability == pytest.approx(share, abs=1e-3)


def test_without_an_uncertainty_only_simple_acceptance_decides():
    values = [value(0.02, None), value(0.01, 0.004, 1)]
    for rule, decision in (("U", "undecided"), ("1.65 u", "undecided"), ("simple", "accepted")):
        judged = judge_characteristic("SD", values, 0.1, rule=rule)
        assert (judged.decision, judged.probability) == (decision, None)
    assert judge_characteristic("SD", [], 0.1).reason == "not measured"
    assert judge_characteristic("SD", values, None).decision == "no MPE"


def test_probabilities_near_one_are_not_rounded_to_certainty():
    texts = [judge_characteristic("SD", [value(error, 0.02)], 0.1).probability_text() for error in (0.0, 0.098, 0.15)]
    assert texts == ["> 99.9 %", "57.9 %", "< 0.1 %"]
