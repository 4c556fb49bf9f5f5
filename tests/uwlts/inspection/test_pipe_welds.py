"""Girth and seam welds of pipes are welds, with height, width and place; pits beside them remain.

Pipes are those of `tests.oracles.pipes`.
"""

import numpy as np
import pytest

from tests.oracles.joined_pipes import TOES
from tests.oracles.pipes import Bump, WeldBead, scan_pipe
from tests.uwlts.inspection.inspected_pipes import BLEMISHES, GATE, inspect
from uwlts.inspection.features import FeatureKind
from uwlts.inspection.pipe_welds import _find_ridges

RADIUS_MM = 80.0
BEAD_GATE = 3.0
"""Largest error of sizes of beads, in standard uncertainties: most of them is the unknown form, of limited effect."""


@pytest.mark.parametrize("kind", ["girth", "seam"])
@pytest.mark.parametrize("seed", [31, pytest.param(32, marks=pytest.mark.slow)])
def test_a_weld_of_a_pipe_is_a_weld(kind: str, seed: int) -> None:
    """Beads of 1 to 2.5 mm; the plane of a girth weld is inclined by up to 3 deg, and its crest is rippled."""
    rng = np.random.default_rng([seed, 7])
    height, width = float(rng.uniform(1, 2.5)), float(rng.uniform(8, 14))
    along, angle = float(rng.uniform(-20, 20)), float(rng.uniform(-np.pi, np.pi))
    if kind == "girth":
        bead = WeldBead(height_mm=height, width_mm=width, along_mm=along, lean_mm=float(rng.uniform(0, 4)))
    else:
        bead = WeldBead(height_mm=height, width_mm=width, angle=angle)
    pit = Bump(along_mm=along - 25 * np.sign(along), angle=angle + 1.0, diameter_mm=10.0, height_mm=-0.6)
    pipe = scan_pipe(rng, axis=(0.2, 1, 0.1), radius_mm=RADIUS_MM, length_mm=110.0, spacing_mm=1.4, bumps=[bead, pit])
    found = inspect(pipe)
    (weld,) = found.select(FeatureKind.WELD)
    assert weld.name == f"{kind} weld 1"
    for name, truth, largest in (("height", height, 0.05), ("width", TOES * width, 0.1)):
        value = weld[name]
        assert value.value == pytest.approx(truth, abs=BEAD_GATE * value.uncertainty), value
        assert value.uncertainty < largest * truth
    # Smoothing a toe without undercut gives a groove of up to 0.1 mm.
    assert weld["undercut left"].low == weld["undercut right"].low == 0
    place, around = pipe.own_places(weld.place_mm)
    if kind == "girth":
        assert place[0] == pytest.approx(along + bead.lean_mm * np.cos(around[0]), abs=1.0)
    else:
        assert RADIUS_MM * np.angle(np.exp(1j * (around[0] - angle))) == pytest.approx(0.0, abs=1.0)
    (own,) = found.select(*BLEMISHES)
    assert pipe.distance_mm(pit, own.place_mm) < 1.5
    assert own["depth"].value == pytest.approx(0.6, abs=GATE * own["depth"].uncertainty)


def test_a_ridge_of_a_single_cell_stands_out_from_its_neighbours() -> None:
    """Nine cells, each with a hundred points: their surroundings are three cells, whose median is that of the pipe."""
    rng = np.random.default_rng(8)
    across, length = (each.ravel() for each in np.meshgrid(np.arange(9) + 0.5, np.arange(100.0), indexing="ij"))
    heights = np.where(np.abs(across - 4.5) < 0.5, 1.0, 0.0) + 0.01 * rng.standard_normal(len(across))
    ((middle, half),) = _find_ridges(across, length, heights, 1.0)
    assert middle == pytest.approx(4.5 + 0.5, abs=1e-6) and 0.5 <= half <= 1.0
