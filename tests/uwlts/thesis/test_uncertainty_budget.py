"""Uncertainty budgets compared with two published ones: the thesis's Table 9 and the GUM's end gauge (H.1)."""

import math

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from scipy import stats

from uwlts.errors import RangeError
from uwlts.thesis.thesis_figures import UNIFORM, UncertaintySource, combine

# In mm. The table's first column is the uncertainty and its second the correction: so the standard uncertainties that
# it prints follow from the first, and the sum of the second is the printed total correction.
TABLE_9 = [
    UncertaintySource(name="index", standard_uncertainty=UNIFORM * 0.030, correction=0.060),
    UncertaintySource(name="expansion", standard_uncertainty=UNIFORM * 0.010, correction=0.011),
    UncertaintySource(name="resolution", standard_uncertainty=UNIFORM * 0.011),
    # Calibrated to 0.004 mm, k = 2.
    UncertaintySource(name="standard", standard_uncertainty=0.004 / 2),
    UncertaintySource(name="SSE", standard_uncertainty=0.110, degrees_of_freedom=5, correction=0.040),
    UncertaintySource(name="PE", standard_uncertainty=0.140),
]


def test_the_thesis_budget():
    budget = combine(TABLE_9, coverage_probability=0.9545)
    # Printed to 0.001 mm, 1 degree of freedom, and 0.01 mm.
    printed = [0.017, 0.006, 0.006, 0.002, 0.110, 0.140]
    np.testing.assert_allclose([s.standard_uncertainty for s in TABLE_9], printed, rtol=0, atol=0.0005)
    assert budget.standard_uncertainty == pytest.approx(math.sqrt(sum(u**2 for u in printed)), abs=0.0005)
    assert budget.degrees_of_freedom == pytest.approx(35, abs=0.5)
    assert budget.expanded_uncertainty == pytest.approx(0.37, abs=0.005)
    assert budget.correction == pytest.approx(0.11, abs=0.005)
    assert budget.largest_error == pytest.approx(0.48, abs=0.005)
    # Printed to 0.1 %; 0.0005 mm of rounding in 0.110 and 0.140 mm move these shares by up to 0.2 % each.
    np.testing.assert_allclose(budget.shares_percent, [0.9, 0.1, 0.1, 0.0, 37.6, 61.2], rtol=0, atol=0.4)


def test_the_thesis_factor_is_not_that_of_95_percent():
    # GUM Table G.2 for 35 degrees of freedom: 2.03 at 95 %, 2.07 at 95.45 %.
    budget = combine(TABLE_9)
    assert budget.coverage_factor == pytest.approx(2.03, abs=0.005)
    assert budget.expanded_uncertainty == pytest.approx(0.36, abs=0.005)
    assert combine(TABLE_9, coverage_probability=0.9545).coverage_factor == pytest.approx(2.07, abs=0.005)


def test_the_end_gauge_of_the_gum():
    # GUM Table H.1 in nm. The temperature's deviation and the standard's expansion have a sensitivity of zero. The
    # difference of the expansions is within 1e-6 per K and has 50 degrees of freedom, with a sensitivity of 50 mm x
    # 0.1 K; that of the temperatures within 0.05 K with 2, and 50 mm x 11.5e-6 per K.
    sources = [
        UncertaintySource(name="standard", standard_uncertainty=75 / 3, degrees_of_freedom=18),
        UncertaintySource(name="comparison", standard_uncertainty=9.7, degrees_of_freedom=25.6),
        UncertaintySource(name="expansion of the standard", standard_uncertainty=0.0),
        UncertaintySource(name="temperature", standard_uncertainty=0.0),
        UncertaintySource(name="expansions", standard_uncertainty=5e6 * UNIFORM * 1e-6, degrees_of_freedom=50),
        UncertaintySource(name="temperatures", standard_uncertainty=575 * UNIFORM * 0.05, degrees_of_freedom=2),
    ]
    budget = combine(sources, coverage_probability=0.99)
    # Printed to these digits, but the expanded uncertainty is there 2.92 x 32, where 32 is rounded by up to 0.5.
    assert [round(s.standard_uncertainty, 1) for s in sources] == [25, 9.7, 0, 0, 2.9, 16.6]
    assert budget.standard_uncertainty == pytest.approx(32, abs=0.5)
    assert budget.degrees_of_freedom == pytest.approx(16.7, abs=0.1)
    assert budget.coverage_factor == pytest.approx(2.92, abs=0.005)
    assert budget.expanded_uncertainty == pytest.approx(93, abs=0.5 + 2.92 * 0.5)
    # Not cut to 16, the factor would be 2.90.
    assert budget.coverage_factor > 2.915


def test_sources_of_one_kind():
    # A repeated measurement alone keeps its degrees of freedom: Student's 2.571 for 5 (GUM Table G.2).
    repeated = combine([UncertaintySource(name="mean", standard_uncertainty=0.3, degrees_of_freedom=5)])
    assert repeated.degrees_of_freedom == pytest.approx(5)
    assert repeated.coverage_factor == pytest.approx(2.571, abs=5e-4)
    # Two equal sources have twice as many.
    assert combine(
        [UncertaintySource(name=n, standard_uncertainty=0.3, degrees_of_freedom=5) for n in "ab"]
    ).degrees_of_freedom == pytest.approx(10)
    certain = combine([UncertaintySource(name="certificate", standard_uncertainty=0.15)])
    assert certain.degrees_of_freedom == math.inf
    assert certain.coverage_factor == pytest.approx(1.960, abs=5e-4)
    assert certain.standard_uncertainty == pytest.approx(0.15)


def test_rounding_costs_no_degree_of_freedom():
    for freedom in range(1, 60):
        budget = combine(
            [UncertaintySource(name=n, standard_uncertainty=0.1, degrees_of_freedom=freedom) for n in "abc"]
        )
        assert budget.coverage_factor == pytest.approx(stats.t.ppf(0.975, 3 * freedom), rel=1e-12)


def test_corrections_add_up_with_their_signs():
    budget = combine(
        [
            UncertaintySource(name="temperature", standard_uncertainty=0.01, correction=-0.04),
            UncertaintySource(name="standard", standard_uncertainty=0.01, correction=0.015),
        ]
    )
    assert budget.correction == pytest.approx(-0.04 + 0.015)
    assert budget.largest_error == pytest.approx(0.025 + 1.96 * math.hypot(0.01, 0.01), abs=1e-5)


def test_the_uniform_distribution_is_as_wide_as_drawn():
    draws = np.random.default_rng(1).uniform(-2, 2, 200_000)
    # The standard deviation of N draws scatters by less than 1 / sqrt(2 N) = 1.6e-3, as these have thin tails.
    assert pytest.approx(draws.std(), rel=5 * 1.6e-3) == 2 * UNIFORM


@settings(deadline=None)
@given(
    st.lists(st.tuples(st.floats(1e-6, 1e6), st.floats(1, 1e6), st.floats(-10, 10)), min_size=1, max_size=8),
    st.floats(0.5, 0.999),
)
def test_every_budget_fulfils_the_same_rules(rows, probability):
    sources = [
        UncertaintySource(name="a", standard_uncertainty=u, degrees_of_freedom=n, correction=c) for u, n, c in rows
    ]
    budget = combine(sources, coverage_probability=probability)
    freedoms = [n for _, n, _ in rows]
    assert sum(budget.shares_percent) == pytest.approx(100)
    # Welch and Satterthwaite: between the fewest and the sum of all (GUM G.4.1).
    assert min(freedoms) * (1 - 1e-9) <= budget.degrees_of_freedom <= sum(freedoms) * (1 + 1e-9)
    assert budget.standard_uncertainty >= max(u for u, _, _ in rows)
    assert budget.largest_error == abs(budget.correction) + budget.expanded_uncertainty


def test_budgets_without_a_meaning_are_refused():
    with pytest.raises(RangeError, match="none of 0 sources"):
        combine([])
    with pytest.raises(RangeError, match="none of 1 sources"):
        combine([UncertaintySource(name="a", standard_uncertainty=0.0)])
