"""What VDI/VDE 2634 part 2 demands of artefacts and positions, and what was done in an acceptance test."""

from collections.abc import Callable, Iterable, Iterator

import numpy as np

from uwlts.acceptance.acceptance_plan import AcceptancePlan, Symbol
from uwlts.acceptance.characteristics import CharacteristicValue, StoredPart
from uwlts.fitting.least_squares import VDI_OUTLIER_SHARE
from uwlts.model.artefacts import PlaneStandard, SphereStandard

_PROBED, _SPACED, _FLAT = 10, 7, 6
"""Least numbers of measured spheres, spacings and planes."""
_DIAMETERS = (0.02, 0.2)
"""Smallest and largest diameter of a sphere (unit: diagonal of the volume)."""
_SPACING = 0.3
"""Least spacing of two spheres (unit: diagonal of the volume)."""
_PLANE = 0.5
"""Least length of a plane (unit: diagonal of the volume)."""
_WIDTH_MM = 50.0
"""Least width of a plane."""
_APART = 0.05
"""Distance (unit: diagonal of the volume) from which positions differ: a sixth of the least spacing of two spheres."""
_TURNED_DEG = 10.0
"""Angle from which directions differ; seven directions of a bar are at least 30 deg apart if they are spread evenly."""


class Requirement(StoredPart):
    """Requirement of the guideline: its clause, what is demanded, what was done, and whether that meets it."""

    clause: str
    required: str
    done: str
    met: bool


def check_requirements(
    plan: AcceptancePlan, values: Iterable[CharacteristicValue], rejected_shares: Iterable[float]
) -> tuple[Requirement, ...]:
    """Return all requirements on spheres, spacings, planes and left out points, with what was measured."""
    values, diagonal = list(values), plan.diagonal_mm()
    standards = [each.standard for each in plan.artefacts.values()]
    spheres = [each for each in standards if isinstance(each, SphereStandard)]
    low, high = (share * diagonal for share in _DIAMETERS)
    rows = [_count("probing error: positions", _PROBED, plan, values, "PF", lambda each: len(each.diameters_mm))]
    rows += _sizes(
        f"probing error: diameter of the spheres, {_DIAMETERS[0]:g} to {_DIAMETERS[1]:g} L0",
        [size for each in spheres for size in each.diameters_mm],
        low,
        high,
    )
    rows += [_count("sphere spacing: positions", _SPACED, plan, values, "SD", lambda each: len(each.spacings_mm))]
    spacings = [size for each in spheres for size in each.spacings_mm]
    rows += _sizes(f"sphere spacing: length, {_SPACING:g} L0", spacings, _SPACING * diagonal, np.inf)
    rows += [_count("flatness: positions", _FLAT, plan, values, "F", lambda _: 0)]
    extents = [each.extent_mm for each in values if each.symbol == "F" and each.extent_mm is not None]
    lengths, widths = [length for length, _ in extents], [width for _, width in extents]
    rows += _sizes(f"flatness: measured length, {_PLANE:g} L0", lengths, _PLANE * diagonal, np.inf)
    rows += _sizes("flatness: measured width", widths, _WIDTH_MM, np.inf)
    if shares := list(rejected_shares):
        largest = max(shares)
        most, met = f"at most {100 * VDI_OUTLIER_SHARE:g} %", largest <= VDI_OUTLIER_SHARE
        rows.append(Requirement(clause="points left out", required=most, done=f"{100 * largest:.2f} %", met=met))
    return tuple(rows)


def _count(
    clause: str,
    least: int,
    plan: AcceptancePlan,
    values: list[CharacteristicValue],
    symbol: Symbol,
    count_of: Callable[[SphereStandard], int],
) -> Requirement:
    """Compare the number of different positions with the least one."""
    own = [each for each in values if each.symbol == symbol]
    planned = 0
    for position in plan.positions:
        standard = plan.artefacts[position.artefact].standard
        if isinstance(standard, SphereStandard):
            planned += count_of(standard)
        planned += isinstance(standard, PlaneStandard) and symbol == "F"
    different = count_different(own, plan.diagonal_mm())
    done = f"{len(own)} of {planned} planned" + (f", {different} differ" if different < len(own) else "")
    return Requirement(clause=clause, required=f"at least {least}", done=done, met=different >= least)


def count_different(values: list[CharacteristicValue], diagonal_mm: float) -> int:
    """Return the number of values whose place or direction differs from all others that are counted."""
    counted: list[CharacteristicValue] = []
    for each in values:
        if all(_differ(each, other, diagonal_mm) for other in counted):
            counted.append(each)
    return len(counted)


def _differ(one: CharacteristicValue, other: CharacteristicValue, diagonal_mm: float) -> bool:
    if np.linalg.norm(np.subtract(one.place_mm, other.place_mm)) > _APART * diagonal_mm:
        return True
    if one.direction is None or other.direction is None:
        return False
    return abs(float(np.dot(one.direction, other.direction))) < np.cos(np.radians(_TURNED_DEG))


def _sizes(clause: str, sizes: list[float], low: float, high: float) -> Iterator[Requirement]:
    """Compare the smallest and largest of some sizes with their limits; nothing without sizes."""
    if sizes:
        required = f"at least {low:.0f} mm" if np.isinf(high) else f"{low:.1f} to {high:.1f} mm"
        smallest, largest = min(sizes), max(sizes)
        done = f"{smallest:.1f} mm" if np.isinf(high) else f"{smallest:.2f} to {largest:.2f} mm"
        yield Requirement(clause=clause, required=required, done=done, met=low <= smallest and largest <= high)
