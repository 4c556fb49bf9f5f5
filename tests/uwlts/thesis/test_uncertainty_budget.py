"""Uncertainty budgets compared with two published ones: the thesis's Table 9 and the GUM's end gauge (H.1)."""

import math

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from scipy import stats

from uwlts.thesis.thesis_figures import UNIFORM, UncertaintySource, combine

# In mm. The table's first column is the uncertainty and its second the correction: so the standard uncertainties that
# it prints follow from the first, and the sum of the second is the printed total correction.
TABLE_9 = {
    "index": UncertaintySource(UNIFORM * 0.030, correction=0.060),
    "expansion": UncertaintySource(UNIFORM * 0.010, correction=0.011),
    "resolution": UncertaintySource(UNIFORM * 0.011),
    # Calibrated to 0.004 mm, k = 2.
    "standard": UncertaintySource(0.004 / 2),
    "SSE": UncertaintySource(0.110, 5, 0.040),
    "PE": UncertaintySource(0.140),
}
SOURCES = list(TABLE_9.values())


def factor(sources: list[UncertaintySource], **probability: float) -> float:
    """Return the coverage factor of a budget."""
    return combine(sources, **probability)["expanded"] / math.hypot(*(source.std for source in sources))


def test_the_thesis_budget():
    budget = combine(SOURCES, coverage_probability=0.9545)
    # Printed to 0.001 mm, 1 degree of freedom, and 0.01 mm.
    printed = [0.017, 0.006, 0.006, 0.002, 0.110, 0.140]
    np.testing.assert_allclose([source.std for source in SOURCES], printed, rtol=0, atol=0.0005)
    assert budget["degrees_of_freedom"] == pytest.approx(35, abs=0.5)
    assert budget["expanded"] == pytest.approx(0.37, abs=0.005)
    assert budget["correction"] == pytest.approx(0.11, abs=0.005)
    assert budget["largest_error"] == pytest.approx(0.48, abs=0.005)


def test_the_thesis_factor_is_not_that_of_95_percent():
    # GUM Table G.2 for 35 degrees of freedom: 2.03 at 95 %, 2.07 at 95.45 %.
    assert factor(SOURCES) == pytest.approx(2.03, abs=0.005)
    assert combine(SOURCES)["expanded"] == pytest.approx(0.36, abs=0.005)
    assert factor(SOURCES, coverage_probability=0.9545) == pytest.approx(2.07, abs=0.005)


def test_the_end_gauge_of_the_gum():
    # GUM Table H.1 in nm. The temperature's deviation and the standard's expansion have a sensitivity of zero. The
    # difference of the expansions is within 1e-6 per K and has 50 degrees of freedom, with a sensitivity of 50 mm x
    # 0.1 K; that of the temperatures within 0.05 K with 2, and 50 mm x 11.5e-6 per K.
    sources = [
        UncertaintySource(75 / 3, 18),  # standard
        UncertaintySource(9.7, 25.6),  # comparison
        UncertaintySource(0.0),  # expansion of the standard
        UncertaintySource(0.0),  # temperature
        UncertaintySource(5e6 * UNIFORM * 1e-6, 50),  # expansions
        UncertaintySource(575 * UNIFORM * 0.05, 2),  # temperatures
    ]
    budget = combine(sources, coverage_probability=0.99)
    # Printed to these digits, but the expanded uncertainty is there 2.92 x 32, where 32 is rounded by up to 0.5.
    assert [round(source.std, 1) for source in sources] == [25, 9.7, 0, 0, 2.9, 16.6]
    assert budget["degrees_of_freedom"] == pytest.approx(16.7, abs=0.1)
    # Not cut to 16, the factor would be 2.90.
    assert 2.915 < factor(sources, coverage_probability=0.99) == pytest.approx(2.92, abs=0.005)
    assert budget["expanded"] == pytest.approx(93, abs=0.5 + 2.92 * 0.5)


def test_sources_of_one_kind():
    # A repeated measurement alone keeps its degrees of freedom: Student's 2.571 for 5 (GUM Table G.2).
    repeated = [UncertaintySource(0.3, 5)]
    assert combine(repeated)["degrees_of_freedom"] == pytest.approx(5)
    assert factor(repeated) == pytest.approx(2.571, abs=5e-4)
    # Two equal sources have twice as many.
    assert combine(2 * repeated)["degrees_of_freedom"] == pytest.approx(10)
    certain = [UncertaintySource(0.15)]
    assert combine(certain)["degrees_of_freedom"] == math.inf
    assert factor(certain) == pytest.approx(1.960, abs=5e-4)


def test_rounding_costs_no_degree_of_freedom():
    for freedom in range(1, 60):
        expected = stats.t.ppf(0.975, 3 * freedom)
        assert factor(3 * [UncertaintySource(0.1, freedom)]) == pytest.approx(expected, rel=1e-12)


def test_corrections_add_up_with_their_signs():
    budget = combine([UncertaintySource(0.01, correction=-0.04), UncertaintySource(0.01, correction=0.015)])
    assert budget["correction"] == pytest.approx(-0.04 + 0.015)
    assert budget["largest_error"] == pytest.approx(0.025 + 1.96 * math.hypot(0.01, 0.01), abs=1e-5)


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
    budget = combine([UncertaintySource(*row) for row in rows], coverage_probability=probability)
    freedoms = [n for _, n, _ in rows]
    # Welch and Satterthwaite: between the fewest and the sum of all (GUM G.4.1).
    assert min(freedoms) * (1 - 1e-9) <= budget["degrees_of_freedom"] <= sum(freedoms) * (1 + 1e-9)
    assert budget["largest_error"] == abs(budget["correction"]) + budget["expanded"]
