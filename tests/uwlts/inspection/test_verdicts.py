"""Verdicts on drawn damaged pipes: no finding is cut short, sized from a stump, split or left out unsaid.

Parts are those of `tests.oracles.damaged_pipes`. No threshold was chosen with their seeds, except where a test says so.
"""

import math
from typing import Any

import numpy as np
import pytest

from docs.studies.inspection_verdicts import count_drawn, inspect
from tests.oracles.damaged_pipes import KINDS

DAMAGED = [kind for kind in KINDS if kind != "clean pipe"]


@pytest.mark.parametrize("kind", DAMAGED)
def test_no_verdict_on_a_damaged_pipe_is_false(kind: str) -> None:
    """Each truth is mentioned; a limit 10 % beside its depth is never judged on the wrong side.

    More seeds are those of docs/studies/inspection_verdicts.py.
    """
    counts = count_drawn(kind, 200)
    assert counts["truths"] > 0
    assert not counts["not mentioned"] + counts["false within"] + counts["false exceeds"], counts


def test_a_finding_cut_by_a_border_says_so() -> None:
    """Its values are bounds, as text and as JSON, and the reason is stated. The hole is 4 points wide."""
    found = inspect(KINDS["pits cut by a border"](np.random.default_rng([418, 1])))
    cut = [each for each in found.features if each.reason]
    assert len(cut) == 4
    for each in cut:
        depth = each["depth"]
        assert math.isinf(depth.high) and depth.text().startswith("depth at least")
        record: Any = each.record()
        assert record["values"]["depth"]["high"] is None and record["reason"] == each.reason
    assert sum("not seen whole" in line for line in found.lines()) == 4


@pytest.mark.parametrize(("kind", "seed"), [("gouges", 406), ("gouges", 609), ("patch of corrosion", 414)])
def test_rough_ground_is_one_finding(kind: str, seed: int) -> None:
    """A smooth surface does not follow a gouge or an area of corrosion: nothing is searched for within these.

    The threshold was chosen with these parts, among others.
    """
    counts = count_drawn(kind, seed)
    assert counts["inside"] == counts["values"] == counts["truths"] and not counts["invented"], counts


@pytest.mark.parametrize("seed", [603, 607])
def test_a_dent_is_one_finding(seed: int) -> None:
    """The smooth surface of 603 is wrong at the end of the scan; the dent of 607 covers 100 of 116 mm of its pipe."""
    counts = count_drawn("dent of 2 to 15 % of the diameter", seed)
    assert counts["inside"] == counts["values"] == 1 and not counts["invented"], counts
