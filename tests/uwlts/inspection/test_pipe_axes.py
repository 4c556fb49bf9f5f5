"""Inspections of pipes along any axis: equal findings, none lost, none twice, none on undamaged pipes.

Pipes are those of `tests.oracles.pipes`. Each search has a false-alarm probability of 1e-4, all of them together 1 %.
"""

from dataclasses import replace

import numpy as np
import pytest

from tests.oracles.pipes import Bump, ScannedPipe, scan_pipe
from tests.uwlts.inspection.inspected_pipes import BLEMISHES, GATE, cloud_of, inspect
from uwlts.inspection.blemish_search import BlemishSearch, Indication
from uwlts.inspection.features import Feature, FeatureKind, Inspection
from uwlts.inspection.pipe import _join_copies
from uwlts.inspection.pipe_form import fit_pipe, refit_pipe
from uwlts.shapes.cylinder import Cylinder

FALSE_ALARM = 1e-4
AXES = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0), "tilted": (1.0, 0.3, -0.2)}
DRAWS = pytest.mark.parametrize(("axis", "seed"), list(zip(AXES.values(), range(4), strict=True)), ids=AXES)
DEPTHS_MM = 0.3, 0.6, 1.2, 2.0, 3.0
"""The shallowest is fifteen times the noise of a point; the deepest is within the 6 % of the radius that count."""


def matched(pipe: ScannedPipe, found: Inspection, bumps: list[Bump]) -> list[Feature]:
    """Return the one feature of each bump, with its place and depth, and assert that there are no others."""
    left, own = list(found.select(*BLEMISHES)), []
    for bump in bumps:
        near = [each for each in left if pipe.distance_mm(bump, each.place_mm) < 0.15 * bump.diameter_mm]
        assert len(near) == 1, (bump, [each.name for each in near], found.notes)
        size = near[0].values[0]
        assert size.value == pytest.approx(abs(bump.height_mm), abs=GATE * size.uncertainty)
        assert size.uncertainty < 0.1 * abs(bump.height_mm)
        assert (near[0].kind == FeatureKind.PROTRUSION) == (bump.height_mm > 0)
        left.remove(near[0])
        own += near
    assert not left, [each.values for each in left]
    return own


@DRAWS
def test_all_pits_are_found_along_any_axis(axis: tuple[float, float, float], seed: int) -> None:
    """Pits all around the pipe; in some runs one of them is at the cut."""
    rng = np.random.default_rng([seed, 1])
    turn = 2 * np.pi / len(DEPTHS_MM)
    bumps = [
        Bump(
            along_mm=float(rng.uniform(-25, 25)),
            angle=float(turn * (k + rng.uniform(-0.1, 0.1))),
            diameter_mm=8 + 3 * depth,
            height_mm=-depth,
        )
        for k, depth in enumerate(rng.permutation(DEPTHS_MM))
    ]
    pipe = scan_pipe(rng, axis=axis, length_mm=90.0, bumps=bumps, holes=[(0.0, 2.5 * turn, 6.0)])
    found = inspect(pipe, false_alarm=FALSE_ALARM)
    matched(pipe, found, bumps)
    assert not any("is omitted" in note for note in found.notes)


@DRAWS
def test_clean_pipes_have_no_findings_along_any_axis(axis: tuple[float, float, float], seed: int) -> None:
    rng = np.random.default_rng([seed, 2])
    arc = 2 * np.pi if seed % 2 else 0.8 * np.pi
    pipe = scan_pipe(rng, axis=axis, arc=arc, spacing_mm=1.5, holes=[(5.0, 1.0, 15.0)])
    found = inspect(pipe, false_alarm=FALSE_ALARM)
    assert not found.select(*BLEMISHES) and not any("is omitted" in note for note in found.notes)


def test_a_dent_at_the_cut_is_one_finding() -> None:
    """Dents wider than the overlap of both sides, about a gap that determines the cut, at -0.02 rad."""
    for seed in (0, 5):
        rng, angle = np.random.default_rng([seed, 3]), -0.02 + 0.005 * (seed - 2.5)
        dent = Bump(along_mm=0.0, angle=float(angle), diameter_mm=70.0, height_mm=-3.0)
        pipe = scan_pipe(
            rng, axis=(1, 0, 0), arc=2 * np.pi - 0.04, length_mm=110.0, spacing_mm=2.0, bumps=[dent], lost=0.0
        )
        (own,) = matched(pipe, inspect(pipe, false_alarm=FALSE_ALARM), [dent])
        assert own.kind == FeatureKind.DENT


def test_copies_of_an_indication_on_both_sides_of_the_cut_are_joined() -> None:
    """Points 8 to 11 are copies of 0 to 3: two indications share point 2, one of the other sign shares it alone."""
    copied, nothing = np.array([*range(8), *range(4)]), np.zeros(12, bool)
    found = [
        Indication(2.0, height, 9.0, 1e-9, 0.02, np.array(points))
        for height, points in ((-1.0, [1, 2]), (-1.0, [10, 11, 7]), (1.0, [2]), (-1.0, [5]))
    ]
    search = BlemishSearch(tuple(found), (), nothing, ~nothing, np.ones(12), 1.0, 1.0, 5.0, 1e-4)
    joined = _join_copies(search, copied, 8)
    assert [(each.height_mm, each.points.tolist()) for each in joined.indications] == [
        (-1.0, [1, 2, 3, 7]),
        (1.0, [2]),
        (-1.0, [5]),
    ]
    assert joined.undamaged.tolist() == [True, False, False, False, True, False, True, False]


@pytest.mark.parametrize("axis", AXES.values(), ids=AXES)
def test_noise_turns_no_frame(axis: tuple[float, float, float]) -> None:
    """Both directions across are equal for all scans, and for successive fits of a pipe."""
    across = []
    for seed in range(6):
        rng = np.random.default_rng([seed, 4])
        pipe = scan_pipe(rng, axis=axis, length_mm=60.0, spacing_mm=4.0)
        across.append(Cylinder.fit(pipe.points_mm).across)
        cloud = cloud_of(pipe)
        form = fit_pipe(cloud)
        again = refit_pipe(cloud, form, left_out=rng.random(len(cloud)) < 0.3)
        turned = np.angle(np.exp(1j * (again.angle - form.angle)))
        # Noise of the axis: 0.02 mm divided by the root of a thousand points.
        assert np.abs(turned).max() < 1e-3
        assert np.abs(again.along_mm - form.along_mm).max() < 0.05
    assert np.ptp(across, axis=0).max() < 1e-3


def test_what_is_left_out_is_named() -> None:
    """Points off the pipe, and sections with few points."""
    rng = np.random.default_rng(5)
    deep = Bump(along_mm=0.0, angle=1.0, diameter_mm=30.0, height_mm=-40.0)
    pipe = scan_pipe(rng, axis=(0, 1, 0), spacing_mm=2.0, bumps=[deep])
    along, angle = pipe.own_places(pipe.points_mm)
    kept = (along < 20) | (along > 50) | (np.abs(angle) < 0.3)
    seen = replace(pipe, points_mm=pipe.points_mm[kept], frame=pipe.frame[kept], line=pipe.line[kept])
    notes = inspect(seen, false_alarm=FALSE_ALARM).notes
    off = next(note for note in notes if "off the pipe" in note)
    height = deep.heights(along, angle, pipe.radius_mm)
    # Points at the limit may be on either side by their noise.
    expected = [np.count_nonzero(kept & (height <= limit)) for limit in (-21.1, -20.9)]
    assert expected[0] <= int(off.split()[0]) <= expected[1] and expected[0] > 10
    assert sum("no section from" in note for note in notes) in (2, 3)
