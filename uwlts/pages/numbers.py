"""Numbers and their names as text: lengths to a micrometre, no negative zero, a dash for what is missing."""

import math
import re
from collections.abc import Iterator, Mapping
from typing import Any, TypeGuard

from uwlts.pages.toolkit import MISSING

_UNITS = {"px": "px", "mm": "mm", "deg": "°", "rad": "rad", "nm": "nm"}


def fixed(value: float | None, decimals: int = 3, *, signed: bool = False) -> str:
    """A number with fixed decimals; what rounds to zero has no sign."""
    if value is None or not math.isfinite(value):
        return MISSING
    text = f"{value:{'+' if signed else ''}.{decimals}f}"
    return text if float(text) else text.lstrip("+-")


def small_length(value_mm: float | None, *, signed: bool = False) -> str:
    """A length with its unit: micrometres with one decimal (two below 1 µm), or from 1 mm on millimetres with three."""
    if value_mm is None or not math.isfinite(value_mm):
        return MISSING
    if abs(value_mm) < 1:
        return f"{fixed(1e3 * value_mm, 1 if abs(value_mm) >= 1e-3 else 2, signed=signed)} µm"
    return f"{fixed(value_mm, signed=signed)} mm"


def plain(value: float) -> str:
    """Any figure with four significant digits, whole numbers as they are."""
    if float(value).is_integer() and abs(value) < 1e9:
        return f"{value:.0f}"
    return f"{value:.4g}"


def as_fine_as(value: float, scale: float, *, digits: int = 3) -> str:
    """A number with as many decimals as the significant digits of a scale have."""
    decimals = digits - 1 - math.floor(math.log10(scale)) if scale > 0 else 3
    return fixed(value, max(0, decimals))


def unit_of(name: str) -> str:
    """Unit that ends a name, as in ``rms_px``; nothing for a pure number."""
    return _UNITS.get(name.rsplit("_", 1)[-1], "") if "_" in name else ""


def words_of(name: str) -> str:
    """A name in words, without its unit."""
    bare = name.rsplit("_", 1)[0] if unit_of(name) else name
    return re.sub(r"_+", " ", bare)


def is_number(value: Any) -> TypeGuard[float]:
    """Whether a value from JSON is a finite number."""
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def number_list(value: Any) -> list[float | None] | None:
    """A list of finite numbers from JSON, None for missing ones; None if the value is anything else."""
    return value if isinstance(value, list) and all(each is None or is_number(each) for each in value) else None


def numbers_in(table: Any) -> dict[str, float]:
    """The finite numbers in a table from JSON by their names; none if the value is no table."""
    return {name: value for name, value in table.items() if is_number(value)} if isinstance(table, dict) else {}


def entries_of(table: Mapping[str, Any], group: str = "") -> Iterator[tuple[str, str, Any]]:
    """Group, name and value of the entries of nested tables; a group is the names of its tables."""
    for name, value in table.items():
        if isinstance(value, dict):
            yield from entries_of(value, f"{group} {name}".strip())
        else:
            yield group, name, value


def unit_for(spread_mm: float) -> tuple[str, float]:
    """Unit in which deviations of this spread are drawn, and how many of it are in a millimetre."""
    return ("µm", 1e3) if spread_mm < 0.5 else ("mm", 1.0)
