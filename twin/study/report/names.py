"""Names, units and numbers in words: figures of merit, paths of the description, values."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from twin.study.description import Objective
from twin.study.safety import CLASS_NAMES

MISSING = "\N{EN DASH}"

FIGURE_NAMES: dict[str, tuple[str, str]] = {
    "sigma_x_mm": ("σ X, by the stage", "mm"),
    "sigma_y_mm": ("σ Y, largest in the volume", "mm"),
    "sigma_z_mm": ("σ Z, largest in the volume", "mm"),
    "sigma_z_rms_mm": ("σ Z, rms over the volume", "mm"),
    "sigma_z_near_mm": ("σ Z at the near end", "mm"),
    "sigma_z_middle_mm": ("σ Z in the middle", "mm"),
    "sigma_z_far_mm": ("σ Z at the far end", "mm"),
    "depth_per_px_mm": ("depth per pixel", "mm/px"),
    "along_per_px_mm": ("length along the stripe per pixel", "mm/px"),
    "coverage": ("share of the volume in reach", ""),
    "standoff_mm": ("stand-off", "mm"),
    "near_mm": ("near end of the volume", "mm"),
    "far_mm": ("far end of the volume", "mm"),
    "depth_mm": ("depth of the volume", "mm"),
    "line_near_mm": ("line length at the near end", "mm"),
    "line_mm": ("line length in the middle", "mm"),
    "line_far_mm": ("line length at the far end", "mm"),
    "section_cm2": ("area of the sheet in the volume", "cm²"),
    "occlusion_deg": ("occlusion angle, largest", "°"),
    "signal_e": ("faintest signal", "e⁻"),
    "exposure_ms": ("exposure", "ms"),
    "required_ms": ("exposure required", "ms"),
    "stripe_px": ("width of the stripe's image (σ)", "px"),
    "blur_px": ("the lens's blur (σ)", "px"),
    "centre_px": ("σ of the stripe's centre", "px"),
    "speckle_limit_mm": ("speckle limit of Z", "mm"),
    "laser_class": ("laser class", ""),
    "window_mm": ("window thickness needed", "mm"),
    "baseline_mm": ("width of the sensor", "mm"),
}
"""Words and unit of every figure of merit."""

_WHOLE = {
    "width_px": ("image width", "px"), "height_px": ("image height", "px"),
    "f_number": ("f-number", ""), "beam_quality_m2": ("beam quality M²", ""),
    "quantum_efficiency": ("quantum efficiency", ""), "prnu": ("PRNU", ""), "bow_deg": ("bow", "°"),
}  # fmt: skip
_UNITS = {
    "_w_per_m2": "W/m²", "_e_per_s": "e⁻/s", "_per_million": "per million", "_per_m": "1/m", "_g_kg": "g/kg",
    "_mm": "mm", "_um": "µm", "_nm": "nm", "_mw": "mW", "_deg": "°", "_px": "px", "_ms": "ms", "_us": "µs", "_hz": "Hz",
    "_dn": "DN", "_e": "e⁻", "_c": "°C", "_k": "K", "_s": "s", "_m": "m",
}  # fmt: skip


def words_and_unit(name: str) -> tuple[str, str]:
    """A figure's, a path's or a choice's name in words, and its unit ("" if it has none)."""
    if name in FIGURE_NAMES:
        return FIGURE_NAMES[name]
    *parents, key = name.split(".")
    if not parents:
        return key.replace("_", " "), ""
    if key in _WHOLE:
        words, unit = _WHOLE[key]
    else:
        ending = next((ending for ending in _UNITS if key.endswith(ending)), "")
        words, unit = key.removesuffix(ending).replace("_", " "), _UNITS.get(ending, "")
    return " ".join([*(parent.replace("_", " ") for parent in parents), words]), unit


def words_of(name: str) -> str:
    """A name in words, without its unit."""
    return words_and_unit(name)[0]


def label_of(name: str) -> str:
    """A name in words with its unit, as an axis has it."""
    words, unit = words_and_unit(name)
    return f"{words} ({unit})" if unit else words


def number_text(value: Any, digits: int = 4) -> str:
    """A number with some significant digits and a proper minus sign; a dash for what is missing or not finite."""
    if value is None or not math.isfinite(value):
        return MISSING
    if float(value).is_integer() and abs(value) < 1e6:
        text = f"{value:.0f}"
    else:
        text = f"{value:.{digits}g}"
        # Scientific notation is for what no sensor has.
        if "e" in text and 1e-6 < abs(value) < 1e9:
            text = f"{value:.0f}" if abs(value) >= 1 else f"{value:.{digits + 5}f}".rstrip("0")
    return text.replace("-", "\N{MINUS SIGN}")


def value_text(name: str, value: Any, *, unit: bool = True) -> str:
    """A value of a figure or of something free, with its unit."""
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, bool):
        return "yes" if value else "no"
    if value is None:
        return MISSING
    if isinstance(value, str):
        return value
    if name == "laser_class" and math.isfinite(value):
        return CLASS_NAMES.get(round(value), MISSING)
    if name == "coverage" and math.isfinite(value):
        return f"{100 * value:.0f} %"
    text, of = number_text(value), words_and_unit(name)[1]
    if not unit or not of or text == MISSING:
        return text
    return text + (of if of == "°" else "\N{NO-BREAK SPACE}" + of)


def goal_text(objective: Objective) -> str:
    """An objective in words."""
    return f"{'smallest' if objective.goal == 'minimise' else 'largest'} {words_of(objective.figure)}"


def listed(words: Sequence[str]) -> str:
    """Words in a row: "a, b and c"."""
    return " and ".join([", ".join(words[:-1]), words[-1]] if len(words) > 1 else words)


def rounded(values: Iterable[float]) -> list[float | None]:
    """Numbers to five significant digits, as JSON holds them: None for what is not finite."""
    numbers = np.asarray(values, dtype=float).tolist()
    return [float(f"{value:.5g}") if math.isfinite(value) else None for value in numbers]


def without_numbers(text: str) -> str:
    """A text with its numbers left out, so that reasons of the same kind are the same."""
    return re.sub(r"(?<![\w.])[-+]?\d+(\.\d+)?(e[-+]?\d+)?", "…", text)
