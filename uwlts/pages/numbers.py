"""Text for numbers and their names: no negative zero, a dash for missing values."""

import math
import re
from collections.abc import Iterator, Mapping
from typing import Any, TypeGuard

from uwlts.pages.toolkit import MISSING

_UNITS = {"px": "px", "mm": "mm", "deg": "°", "rad": "rad", "nm": "nm"}


def format_fixed(value: float | None, decimals: int = 3, *, signed: bool = False) -> str:
    """Format a number with fixed decimals; a number that rounds to zero has no sign."""
    if value is None or not math.isfinite(value):
        return MISSING
    text = f"{value:{'+' if signed else ''}.{decimals}f}"
    return text if float(text) else text.lstrip("+-")


def format_to_scale(value: float, scale: float, *, digits: int = 3) -> str:
    """Format a number with as many decimals as a scale with some significant digits has."""
    decimals = digits - 1 - math.floor(math.log10(scale)) if scale > 0 else 3
    return format_fixed(value, max(0, decimals))


def unit_of(name: str) -> str:
    """Return the unit at the end of a name, as in ``rms_px``; empty for a pure number."""
    return _UNITS.get(name.rsplit("_", 1)[-1], "") if "_" in name else ""


def split_name(name: str) -> str:
    """Return a name as words, without its unit."""
    bare = name.rsplit("_", 1)[0] if unit_of(name) else name
    return re.sub(r"_+", " ", bare)


def is_number(value: Any) -> TypeGuard[float]:
    """Return whether a value from JSON is a finite number."""
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def number_list(value: Any) -> list[float | None] | None:
    """Return a list from JSON if it contains only finite numbers and None, else None."""
    return value if isinstance(value, list) and all(each is None or is_number(each) for each in value) else None


def numbers_in(table: Any) -> dict[str, float]:
    """Return the finite numbers in a table from JSON by name; empty if the value is not a table."""
    return {name: value for name, value in table.items() if is_number(value)} if isinstance(table, dict) else {}


def entries_of(table: Mapping[str, Any], group: str = "") -> Iterator[tuple[str, str, Any]]:
    """Iterate over group, name and value of the entries of nested tables; a group is the names of its tables."""
    for name, value in table.items():
        if isinstance(value, dict):
            yield from entries_of(value, f"{group} {name}".strip())
        else:
            yield group, name, value


def unit_for(spread_mm: float) -> tuple[str, float]:
    """Return the unit for drawing deviations of this spread, and its number per millimetre."""
    return ("µm", 1e3) if spread_mm < 0.5 else ("mm", 1.0)
