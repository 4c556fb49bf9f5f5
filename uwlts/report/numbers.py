"""Numbers as text: lengths to a micrometre, no negative zero, a dash for what is missing."""

import math

MISSING = "-"


def fixed(value: float | None, decimals: int = 3, *, signed: bool = False) -> str:
    """A number with fixed decimals; what rounds to zero has no sign."""
    if value is None or not math.isfinite(value):
        return MISSING
    text = f"{value:{'+' if signed else ''}.{decimals}f}"
    return text if float(text) else text.lstrip("+-")


def small_length(value_mm: float | None, *, signed: bool = False) -> str:
    """A length with its unit: micrometres with one decimal below a millimetre, else millimetres with three."""
    if value_mm is None or not math.isfinite(value_mm):
        return MISSING
    if abs(value_mm) < 1:
        return f"{fixed(1e3 * value_mm, 1, signed=signed)} µm"
    return f"{fixed(value_mm, signed=signed)} mm"


def plain(value: float) -> str:
    """Any figure with four significant digits, whole numbers as they are."""
    if float(value).is_integer() and abs(value) < 1e9:
        return f"{value:.0f}"
    return f"{value:.4g}"


def unit_for(spread_mm: float) -> tuple[str, float]:
    """Unit in which deviations of this spread are drawn, and how many of it are in a millimetre."""
    return ("µm", 1e3) if spread_mm < 0.5 else ("mm", 1.0)
