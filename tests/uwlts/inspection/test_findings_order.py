"""Verdicts on findings by their intervals, and places by the clock."""

from itertools import product

import numpy as np
import pytest

from uwlts.errors import EvaluationError
from uwlts.inspection.features import Feature, FeatureKind, plain_value
from uwlts.inspection.findings_order import (
    FindingDatum,
    FindingLimits,
    format_place,
    judge_feature,
    judge_value,
    resolve_datum,
    sort_by_severity,
)

LIMITS = FindingLimits(depth_mm=2.0, remaining_wall_mm=6.0, ovality_percent=1.0)
PIPE = Feature(FeatureKind.PIPE, "pipe", (), np.zeros(3), np.eye(3), np.ones(3), np.zeros(0, int))


def pit(name, depth, *, std=0.1, wall=None, place=(0.0, 0.0, 0.0)):
    """A pit of some depth and remaining wall; both have the same standard uncertainty."""
    values = [plain_value(FeatureKind.PIT, "depth", depth, std, None)]
    if wall is not None:
        values.append(plain_value(FeatureKind.PIT, "remaining wall", wall, std, None))
    return Feature(FeatureKind.PIT, name, tuple(values), np.array(place), np.eye(3), np.ones(3), np.zeros(0, int))


@pytest.mark.parametrize(
    ("depth", "verdict"),
    # The interval is 0.196 mm on either side.
    [(1.8, "within the limit"), (1.81, "undecided"), (2.19, "undecided"), (2.2, "exceeds the limit")],
)
def test_a_verdict_needs_the_whole_interval(depth, verdict):
    assert judge_value(pit("pit", depth).values[0], LIMITS) == verdict


def test_a_wall_is_limited_from_below_and_the_worst_value_decides():
    assert judge_feature(pit("pit", 1.0, wall=5.0), LIMITS) == ("exceeds the limit", ["remaining wall"])
    assert judge_feature(pit("pit", 1.0, wall=6.1), LIMITS) == ("undecided", ["remaining wall"])
    assert judge_feature(pit("pit", 1.0, wall=8.0), LIMITS)[0] == "within the limit"
    assert judge_feature(pit("pit", 9.0), FindingLimits()) == ("no limit", [])


def test_the_most_severe_finding_is_first():
    found = [pit("shallow", 0.5), pit("undecided", 2.1), pit("thin", 1.0, wall=4.0), pit("deep", 2.5), pit("near", 1.7)]
    assert [each.name for each in sort_by_severity(found, LIMITS)] == ["thin", "deep", "undecided", "near", "shallow"]


@pytest.mark.parametrize(
    ("place", "clock"),
    # Looking along +Z with 12 o'clock at +Y, 3 o'clock is at cross(Z, Y) = -X.
    [((0, 1, 30), "12:00"), ((-1, 0, 30), "3:00"), ((0, -1, 30), "6:00"), ((1, 0, 30), "9:00"), ((-1, 1, 30), "1:30")],
)
def test_the_clock_is_read_along_the_direction(place, clock):
    datum = FindingDatum(place_mm=(0, 0, 10), direction=(0, 0, 1), twelve_o_clock=(0, 1, 0))
    assert format_place(pit("pit", 1, place=place), PIPE, np.zeros((1, 3)), datum) == (clock, "20")
    back = FindingDatum(place_mm=(0, 0, 40), direction=(0, 0, -1), twelve_o_clock=(0, 1, 0))
    hours, minutes = map(int, clock.split(":"))
    mirrored = (720 - 60 * (hours % 12) - minutes) % 720
    expected = f"{mirrored // 60 or 12}:{mirrored % 60:02d}", "10"
    assert format_place(pit("pit", 1, place=place), PIPE, np.zeros((1, 3)), back) == expected


def test_directions_that_do_not_determine_the_clock_are_refused():
    with pytest.raises(EvaluationError, match="does not determine the clock"):
        format_place(pit("pit", 1), PIPE, np.zeros((1, 3)), FindingDatum(direction=(0, 0, 1), twelve_o_clock=(0, 0, 1)))


@pytest.mark.parametrize("axis", [axis for axis in product((-1, 0, 1), repeat=3) if any(axis)])
def test_a_datum_without_directions_does_not_depend_on_noise(axis):
    """Axes turned by 2 deg either way, and with either sign, give directions that differ by no more than that."""
    rng, found = np.random.default_rng(4), []
    for sign in (1, -1) * 20:
        turned = np.array(axis) / np.linalg.norm(axis) + np.radians(2) / np.sqrt(3) * rng.uniform(-1, 1, 3)
        *ways, note = resolve_datum(FindingDatum(), sign * turned / np.linalg.norm(turned))
        assert note is not None and "distances increase along (" in note and "12 o'clock is (" in note
        found.append(ways)
    # The part of 12 o'clock across the axis is at least 0.3, by which its error grows.
    spread = np.max(np.linalg.norm(np.array(found) - found[0], axis=2), axis=0)
    assert spread[0] < np.radians(4) and spread[1] < np.radians(4) / 0.3


def test_stated_directions_are_kept_and_noise_does_not_decide_them():
    axis = np.array([1e-4, 1.0, 0.0]) / np.hypot(1e-4, 1)
    direction, up, note = resolve_datum(FindingDatum(direction=(0, -5, 0), twelve_o_clock=(0, 0, 1)), axis)
    assert direction == pytest.approx(-axis) and up == pytest.approx([0, 0, 1]) and note is None
    with pytest.raises(EvaluationError, match="does not determine the clock"):
        resolve_datum(FindingDatum(direction=(1, 0, 0)), axis)
