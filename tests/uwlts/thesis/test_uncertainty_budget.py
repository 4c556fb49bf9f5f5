"""Uncertainty budgets against two that were published: the thesis's Table 9 and the GUM's end gauge (H.1)."""

import math

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from scipy import stats

from uwlts.errors import RangeError
from uwlts.thesis.uncertainty_budget import UncertaintySource, combine, thermal_expansion_mm

# In mm. The table's first column is the uncertainty and its second the correction: so the standard uncertainties that
# it prints follow from the first, and the sum of the second is the printed total correction.
TABLE_9 = [
    UncertaintySource(name="index", half_width=0.030, distribution="uniform", correction=0.060),
    UncertaintySource(name="expansion", half_width=0.010, distribution="uniform", correction=0.011),
    UncertaintySource(name="resolution", half_width=0.011, distribution="uniform"),
    # Calibrated to 0.004 mm, k = 2.
    UncertaintySource(name="standard", half_width=0.004, distribution="normal", coverage_factor=2),
    UncertaintySource(name="SSE", half_width=0.110, distribution="normal", degrees_of_freedom=5, correction=0.040),
    UncertaintySource(name="PE", half_width=0.140, distribution="normal"),
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
    # difference of the expansions lies within 1e-6 per K and has 50 degrees of freedom, with a sensitivity of 50 mm x
    # 0.1 K; that of the temperatures within 0.05 K with 2, and 50 mm x 11.5e-6 per K.
    sources = [
        UncertaintySource(name="standard", half_width=75, coverage_factor=3, degrees_of_freedom=18),
        UncertaintySource(name="comparison", half_width=9.7, degrees_of_freedom=25.6),
        UncertaintySource(name="expansion of the standard", half_width=2e-6, distribution="uniform", sensitivity=0),
        UncertaintySource(name="temperature", half_width=0.41, sensitivity=0),
        UncertaintySource(
            name="expansions", half_width=1e-6, distribution="uniform", sensitivity=-5e6, degrees_of_freedom=50
        ),
        UncertaintySource(
            name="temperatures", half_width=0.05, distribution="uniform", sensitivity=-575, degrees_of_freedom=2
        ),
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
    repeated = combine([UncertaintySource(name="mean", half_width=0.3, degrees_of_freedom=5)])
    assert repeated.degrees_of_freedom == pytest.approx(5)
    assert repeated.coverage_factor == pytest.approx(2.571, abs=5e-4)
    # Two alike have twice as many.
    assert combine(
        [UncertaintySource(name=n, half_width=0.3, degrees_of_freedom=5) for n in "ab"]
    ).degrees_of_freedom == pytest.approx(10)
    certain = combine([UncertaintySource(name="certificate", half_width=0.3, coverage_factor=2)])
    assert certain.degrees_of_freedom == math.inf
    assert certain.coverage_factor == pytest.approx(1.960, abs=5e-4)
    assert certain.standard_uncertainty == pytest.approx(0.15)


def test_rounding_costs_no_degree_of_freedom():
    for freedom in range(1, 60):
        budget = combine([UncertaintySource(name=n, half_width=0.1, degrees_of_freedom=freedom) for n in "abc"])
        assert budget.coverage_factor == pytest.approx(stats.t.ppf(0.975, 3 * freedom), rel=1e-12)


def test_corrections_go_through_the_sensitivity():
    warm = UncertaintySource(name="temperature", half_width=5.0, sensitivity=-0.002, correction=20.0)
    budget = combine([warm, UncertaintySource(name="standard", half_width=0.01, correction=0.015)])
    assert budget.correction == pytest.approx(-0.04 + 0.015)
    assert budget.largest_error == pytest.approx(0.025 + 1.96 * math.hypot(0.01, 0.01), abs=1e-5)


@pytest.mark.parametrize("distribution", ["uniform", "triangular"])
def test_standard_uncertainties_are_those_of_the_distributions(distribution):
    rng = np.random.default_rng(1)
    draws = {"uniform": rng.uniform(-2, 2, 200_000), "triangular": rng.triangular(-2, 0, 2, 200_000)}[distribution]
    source = UncertaintySource(name="a", half_width=2.0, distribution=distribution, sensitivity=-3.0)
    # The standard deviation of N draws scatters by less than 1 / sqrt(2 N) = 1.6e-3, as these have thin tails.
    assert source.standard_uncertainty == pytest.approx((-3 * draws).std(), rel=5 * 1.6e-3)


@settings(deadline=None)
@given(
    st.lists(st.tuples(st.floats(1e-6, 1e6), st.floats(1, 1e6), st.floats(-10, 10)), min_size=1, max_size=8),
    st.floats(0.5, 0.999),
)
def test_what_every_budget_keeps(rows, probability):
    sources = [UncertaintySource(name="a", half_width=u, degrees_of_freedom=n, correction=c) for u, n, c in rows]
    budget = combine(sources, coverage_probability=probability)
    freedoms = [n for _, n, _ in rows]
    assert sum(budget.shares_percent) == pytest.approx(100)
    # Welch and Satterthwaite: between the fewest and the sum of all (GUM G.4.1).
    assert min(freedoms) * (1 - 1e-9) <= budget.degrees_of_freedom <= sum(freedoms) * (1 + 1e-9)
    assert budget.standard_uncertainty >= max(u for u, _, _ in rows)
    assert budget.largest_error == abs(budget.correction) + budget.expanded_uncertainty


@pytest.mark.parametrize(
    ("numbers", "message"),
    [
        ({"half_width": -1.0}, "half_width is -1"),
        ({"half_width": math.nan}, "half_width is nan"),
        ({"distribution": "gaussian"}, "unknown distribution 'gaussian'; known are normal, uniform, triangular"),
        ({"sensitivity": math.inf}, "sensitivity inf"),
        ({"correction": math.nan}, "correction nan"),
        ({"degrees_of_freedom": 0.5}, "0.5 degrees of freedom"),
        ({"degrees_of_freedom": math.nan}, "nan degrees of freedom"),
        ({"coverage_factor": 0.0}, "coverage_factor is 0"),
        ({"coverage_factor": 2.0, "distribution": "uniform"}, "a uniform distribution has no coverage factor, found 2"),
    ],
)
def test_sources_without_a_meaning_are_refused(numbers, message):
    with pytest.raises(RangeError, match=f"index: .*{message}"):
        UncertaintySource(**{"name": "index", "half_width": 1.0} | numbers)


def test_budgets_without_a_meaning_are_refused():
    with pytest.raises(RangeError, match="none of 0 sources"):
        combine([])
    with pytest.raises(RangeError, match="none of 1 sources"):
        combine([UncertaintySource(name="a", half_width=1.0, sensitivity=0.0)])
    with pytest.raises(RangeError, match="coverage_probability is 95"):
        combine(TABLE_9, coverage_probability=95)


def test_thermal_expansion():
    # The thesis prints +- 0.011 mm for 5 K of the spheres' 98.28 or 99.18 mm.
    for length in (98.28, 99.18):
        growth = thermal_expansion_mm(length_mm=length, alpha_per_k=23e-6, temperature_change_k=5)
        assert growth == pytest.approx(0.011, abs=0.0005)
    assert thermal_expansion_mm(length_mm=1000, alpha_per_k=11.5e-6, temperature_change_k=-10) == pytest.approx(-0.115)
    with pytest.raises(RangeError, match="nan per K"):
        thermal_expansion_mm(length_mm=100, alpha_per_k=math.nan, temperature_change_k=5)
