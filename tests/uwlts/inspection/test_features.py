"""Values of features with their intervals, by hand."""

import numpy as np
import pytest

from uwlts.inspection.features import Feature, FeatureKind, Inspection, amplitude_value, plain_value
from uwlts.storage.cloud import STEP, PointCloud

TWO_SIDED = 1.96


def test_intervals_contain_both_parts_of_the_uncertainty_and_end_at_the_least_value() -> None:
    value = plain_value(FeatureKind.PIPE, "diameter", 100.0, 0.3, 0.4)
    assert value.uncertainty == pytest.approx(0.5)
    assert (value.low, value.high) == pytest.approx((100 - 0.5 * TWO_SIDED, 100 + 0.5 * TWO_SIDED), rel=1e-4)
    small = plain_value(FeatureKind.PIT, "depth", 0.1, 0.3, None, least=0.0)
    assert small.low == 0.0 and small.high == pytest.approx(0.1 + 0.3 * TWO_SIDED, rel=1e-4)
    assert small.systematic is None and small.unit == "mm" and value.text().startswith("diameter 100 (99.02 to 101)")


def test_wider_values_add_independent_parts() -> None:
    """Of 0.3 and 0.4 mm; an asymmetric interval keeps its asymmetry, and one from zero does not go below."""
    value = plain_value(FeatureKind.PIPE, "diameter", 100.0, 0.3, None).widen(systematic=0.4)
    assert value.uncertainty == pytest.approx(0.5) and value.systematic == pytest.approx(0.4)
    assert (value.low, value.high) == pytest.approx((100 - 0.5 * TWO_SIDED, 100 + 0.5 * TWO_SIDED), rel=1e-4)
    again = value.widen(random=1.2)
    assert again.random == pytest.approx(np.hypot(0.3, 1.2)) and again.systematic == pytest.approx(0.4)
    assert again.high == pytest.approx(100 + 1.3 * TWO_SIDED, rel=1e-4)
    cut = plain_value(FeatureKind.PIT, "depth", 0.1, 0.03, None, least=0.0).widen(random=1.0)
    assert cut.low == 0.0


def test_amplitudes_are_free_of_the_length_of_noise() -> None:
    """A vector (3, 4) with a common part along it, and one that is shorter than its noise."""
    along = np.outer([0.6, 0.8], [0.6, 0.8])
    value = amplitude_value(
        FeatureKind.PIPE, "ovality", np.array([3.0, 4.0]), 0.04 * np.eye(2), 0.09 * along, scale=4.0
    )
    length = np.sqrt(25 - 0.08 - 0.09)
    assert value.value == pytest.approx(4 * length)
    assert (value.random, value.systematic) == pytest.approx((4 * 0.2, 4 * 0.3))
    half = TWO_SIDED * np.hypot(0.2, 0.3)
    assert (value.low, value.high) == pytest.approx((4 * (length - half), 4 * (5 + half)), rel=1e-4)
    # Square to the vector, noise of 0.5 does not count for its length if it is three times as long.
    across = amplitude_value(FeatureKind.PIPE, "ovality", np.array([0.0, 5.0]), np.diag([0.25, 0.01]), None, scale=1.0)
    assert across.random == pytest.approx(0.1) and across.value == pytest.approx(np.sqrt(25 - 0.26))
    nothing = amplitude_value(FeatureKind.PIPE, "ovality", np.zeros(2), np.diag([0.25, 0.01]), None, scale=1.0)
    assert (nothing.value, nothing.low) == (0.0, 0.0) and nothing.random == pytest.approx(0.5)
    # Halfway: a ninth of the squared length over the trace is the part of the variance along the vector.
    trace = 0.26
    some = amplitude_value(
        FeatureKind.PIPE, "ovality", np.array([0.0, np.sqrt(4.5 * trace)]), np.diag([0.25, 0.01]), None, scale=1.0
    )
    assert some.random == pytest.approx(np.sqrt(0.5 * 0.25 + 0.5 * 0.01))


def test_steps_of_coordinates_widen_lengths_only() -> None:
    values = (
        plain_value(FeatureKind.PIPE, "diameter", 5.0, 0.3, None),
        plain_value(FeatureKind.PIPE, "axis slope 1", 0.1, 0.02, None),
    )
    nothing = np.zeros(3)
    pipe = Feature(FeatureKind.PIPE, "pipe", values, nothing, np.eye(3), nothing, np.arange(4))
    whole = Inspection("pipe", (pipe,), nothing)
    cloud = PointCloud(np.zeros((1, 3)), np.ones(1), np.zeros(1, int), np.zeros(1, int), metadata={STEP: 1.2})
    (wider,) = whole.consider_cloud(cloud).features
    assert wider["diameter"].systematic == pytest.approx(1.2 / np.sqrt(12)) and wider["axis slope 1"] == values[1]
    assert whole.consider_cloud(cloud).notes == (
        "uncertainties contain 0.35 mm for the steps of the cloud's stored coordinates",
    )
