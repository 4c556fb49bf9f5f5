"""Requirements of VDI/VDE 2634 part 2: numbers of different positions, and sizes against the volume."""

import numpy as np
import pytest

from uwlts.acceptance.accept import check_requirements, count_different
from uwlts.acceptance.acceptance_plan import AcceptancePlan
from uwlts.acceptance.characteristics import CharacteristicValue

DIAGONAL_MM = 300.0


def plan(*, diameter=25.0, spacing=100.0):
    side = DIAGONAL_MM / np.sqrt(3)
    bar = {"kind": "spheres", "diameters_mm": [diameter, diameter], "spacings_mm": [spacing]}
    artefacts = {"bar": {"standard": bar}, "plate": {"standard": {"kind": "plane"}}}
    positions = [{"name": f"b{n}", "artefact": "bar", "file": f"b{n}.ply"} for n in range(8)]
    positions += [{"name": f"p{n}", "artefact": "plate", "file": f"p{n}.ply"} for n in range(6)]
    content = {"title": "t", "volume_mm": [side] * 3, "artefacts": artefacts, "positions": positions}
    return AcceptancePlan.model_validate(content)


def measured(symbol, place, **more):
    content = {"symbol": symbol, "position": "p", "label": "l", "value_mm": 0.0, "expanded_mm": None}
    return CharacteristicValue.model_validate(content | {"place_mm": tuple(place)} | more)


def everything(rng, *, extent=(160.0, 60.0)):
    """Values of eight bars and six planes at places that are far from each other."""
    places = np.array([[x, y, z] for x in (-80, 0, 80) for y in (-80, 0, 80) for z in (0, 80)], dtype=float)
    rng.shuffle(places)
    values = [measured("PF", place) for place in places[:16]]
    values += [measured("SD", place, length_mm=100.0, direction=(0, 1, 0)) for place in places[:8]]
    return values + [measured("F", place, direction=(0, 0, -1), extent_mm=extent) for place in places[:6]]


def unmet(found):
    return [each.clause.split(",")[0] for each in found if not each.met]


def test_a_complete_test_meets_all_requirements():
    found = check_requirements(plan(), everything(np.random.default_rng(1)), [0.0029])
    assert len(found) == 8 and not unmet(found)


@pytest.mark.parametrize("seed", range(10))
def test_sizes_are_compared_with_the_diagonal(seed):
    """Drawn sizes: 0.02 to 0.2 L0 for spheres, 0.3 L0 for spacings, 0.5 L0 and 50 mm for planes."""
    rng = np.random.default_rng([2634, seed])
    diameter, spacing = DIAGONAL_MM * 10 ** rng.uniform(-2.2, -0.4), DIAGONAL_MM * rng.uniform(0.1, 0.6)
    spacing = max(spacing, diameter)
    extent = DIAGONAL_MM * rng.uniform(0.3, 0.8), rng.uniform(30.0, 80.0)
    expected = ["probing error: diameter of the spheres"] if not 0.02 <= diameter / DIAGONAL_MM <= 0.2 else []
    expected += ["sphere spacing: length"] if spacing < 0.3 * DIAGONAL_MM else []
    expected += ["flatness: measured length"] if extent[0] < 0.5 * DIAGONAL_MM else []
    expected += ["flatness: measured width"] if extent[1] < 50.0 else []
    found = check_requirements(plan(diameter=diameter, spacing=spacing), everything(rng, extent=extent), [])
    assert unmet(found) == expected


@pytest.mark.parametrize("seed", range(5))
def test_repeated_positions_are_not_new_ones(seed):
    """Repetitions within 10 mm and 5 deg of seven bars; a turn of 20 deg about the same place is another position."""
    rng = np.random.default_rng([7, seed])
    bars = [value for value in everything(rng) if value.symbol == "SD"][:7]
    again = [
        each.model_copy(
            update={
                "place_mm": tuple(each.place_mm + rng.uniform(-5, 5, 3)),
                "direction": (0.0, -np.cos(np.radians(5)), np.sin(np.radians(5))),
            }
        )
        for each in bars
    ]
    assert count_different([*bars[:4], *again[:4], *again[:4]], DIAGONAL_MM) == 4
    found = check_requirements(plan(), [*bars[:6], *again[:2]], [])
    row = next(each for each in found if each.clause == "sphere spacing: positions")
    assert (row.met, row.required, row.done) == (False, "at least 7", "8 of 8 planned, 6 differ")
    turned = bars[0].model_copy(update={"direction": (0.0, np.cos(np.radians(20)), np.sin(np.radians(20)))})
    assert count_different([*bars[:6], turned], DIAGONAL_MM) == 7
