"""Parts that are no plain straight pipe are named or refused; damaged pipes are not.

Parts are those of `tests.oracles.joined_pipes` and `tests.oracles.damaged_pipes`, with a seed on which no threshold was
chosen. The study docs/studies/inspection_verdicts.py has 20 seeds a kind.
"""

import numpy as np
import pytest

from tests.oracles import damaged_pipes, joined_pipes
from tests.oracles.damaged_pipes import Part
from tests.uwlts.inspection.inspected_pipes import cloud_of
from uwlts.errors import EvaluationError
from uwlts.inspection.pipe_form import LARGEST_OVALITY, PipeForm
from uwlts.inspection.scanned_part import find_straight_pipe

SEED = 210
JOINED = "bend", "T-piece", "flanged end", "reducer", "marine growth"
DAMAGED = "clean pipe", "dent of 2 to 15 % of the diameter", "gouges", "patch of corrosion"


def scanned(part: Part) -> tuple[PipeForm, np.ndarray, tuple[str, ...]]:
    return find_straight_pipe(cloud_of(part), largest_ovality=LARGEST_OVALITY)


@pytest.mark.parametrize("kind", JOINED)
def test_other_parts_are_named_or_refused(kind: str) -> None:
    part = joined_pipes.KINDS[kind](np.random.default_rng([SEED, 1]))
    try:
        form, left_out, notes = scanned(part)
    except EvaluationError as error:
        assert kind not in ("T-piece", "flanged end") and any(name in str(error) for name in part.names)
        return
    assert kind != "bend" and any(name in note for name in part.names for note in notes)
    # Only bare pipe remains: noise of up to 0.05 mm, and 0.5 % of the radius beside growth.
    left = np.abs(form.distance_mm[~left_out])
    assert np.quantile(left, 0.9) < 3 * 0.05 + 0.005 * form.radius_mm


@pytest.mark.parametrize("kind", DAMAGED)
def test_damaged_pipes_remain_pipes(kind: str) -> None:
    _, left_out, notes = scanned(damaged_pipes.KINDS[kind](np.random.default_rng([SEED, 2])))
    assert not notes and not left_out.any()


def test_a_coarse_cloud_is_refused_in_words() -> None:
    """Points on a lattice of 31 mm, on a post of 60 mm radius that stands on a plate."""
    rng = np.random.default_rng(3)
    angle, along = rng.uniform(-1, 1, 600), rng.uniform(0, 2000, 600)
    post = np.column_stack([60 * np.cos(angle), 60 * np.sin(angle), along])
    plate = np.column_stack([rng.uniform(-300, 300, (300, 2)), np.zeros(300)])
    points = np.rint(np.vstack([post, plate]) / 31.25) * 31.25 + rng.uniform(-15, 15, 3)
    none = np.full(900, -1)
    with pytest.raises(EvaluationError, match=r"coarse|straight pipe|cylinder"):
        scanned(Part(points_mm=points, frame=none, line=none))
