"""Texts, numbers and tables of a study's page: names, tiles, evaluated designs, and verdicts of the verification."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterable, Mapping

import numpy as np

from twin.design.choice import StudyResults, describe_turbidity
from twin.design.designs import HighlightedDesign
from twin.design.figures_of_merit import CLASS_NAMES, FIGURES, RENDERED_SCATTERING_DEPTH
from twin.design.study import Study, Variable
from twin.design.verification import AGREES_WITHIN, Agreement
from twin.scene.description import Value
from uwlts.optics.design import SAFETY_FACTOR
from uwlts.pages.toolkit import Tile

MISSING = "\N{EN DASH}"

_WHOLE = {
    "width_px": ("image width", "px"),
    "height_px": ("image height", "px"),
    "f_number": ("f-number", ""),
    "beam_quality_m2": ("beam quality M²", ""),
    "quantum_efficiency": ("quantum efficiency", ""),
    "prnu": ("PRNU", ""),
    "bow_deg": ("bow", "°"),
}
_UNITS = {
    "_w_per_m2": "W/m²",
    "_e_per_s": "e⁻/s",
    "_per_million": "per million",
    "_per_m": "1/m",
    "_g_kg": "g/kg",
    "_um": "µm",
    "_mw": "mW",
    "_deg": "°",
    "_us": "µs",
    "_hz": "Hz",
    "_dn": "DN",
    "_e": "e⁻",
    "_c": "°C",
    "_k": "K",
} | {f"_{unit}": unit for unit in ("mm", "nm", "px", "ms", "s", "m")}
"""Units by suffix of names; the first match counts."""


def words_and_unit(name: str) -> tuple[str, str]:
    """Return the label of a figure, path or choice, and its unit ("" without a unit)."""
    if name in FIGURES:
        return FIGURES[name]
    *parents, key = name.split(".")
    if not parents:
        return key.replace("_", " "), ""
    # A medium is known by its name alone, and named waters by their medium's.
    parents = [each for each in parents if each not in ("media", key)]
    ending = next((ending for ending in _UNITS if key.endswith(ending)), "")
    text, unit = _WHOLE.get(key, (key.removesuffix(ending), _UNITS.get(ending, "")))
    return " ".join([*parents, text]).replace("_", " "), unit


def words_of(name: str) -> str:
    """Return the label of a name without its unit."""
    return words_and_unit(name)[0]


def label_of(name: str) -> str:
    """Return the label of a name with its unit, as for an axis."""
    text, unit = words_and_unit(name)
    return f"{text} ({unit})" if unit else text


def number_text(value: float | None, digits: int = 4) -> str:
    """Format a number with significant digits and a minus sign; a dash if it is missing or not finite."""
    if value is None or not math.isfinite(value):
        return MISSING
    if float(value).is_integer():
        text = f"{value:.0f}"
    else:
        text = np.format_float_positional(value, precision=digits, unique=False, fractional=False, trim="-")
    return text.replace("-", "\N{MINUS SIGN}")


_SCATTER = ("sigma_", "speckle_limit", "centre_", "blur_")


def value_text(name: str, value: Value | None, *, unit: bool = True) -> str:
    """Format the value of a figure or a free variable with its unit."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if value is None or isinstance(value, str):
        return MISSING if value is None else value
    if name == "laser_class" and math.isfinite(value):
        return CLASS_NAMES.get(round(value), MISSING)
    if name == "coverage" and math.isfinite(value):
        return f"{100 * value:.0f} %"
    # Formulas and rendered scatter differ by up to some 10 %: two digits.
    text, of = number_text(value, 2 if name.startswith(_SCATTER) else 4), words_and_unit(name)[1]
    if not unit or not of or text == MISSING:
        return text
    return text + (of if of == "°" else "\N{NO-BREAK SPACE}" + of)


def round_for_json(values: Iterable[float]) -> list[float | None]:
    """Round numbers to five significant digits for JSON: None if not finite."""
    numbers = np.asarray(values, dtype=float).tolist()
    return [float(f"{value:.5g}") if math.isfinite(value) else None for value in numbers]


def without_numbers(text: str) -> str:
    """Replace the numbers in a text by "…", so that reasons of the same kind are equal."""
    return re.sub(r"(?<![\w.])[-+]?\d+(\.\d+)?(e[-+]?\d+)?", "…", text)


def format_design_value(judged: StudyResults, name: str, place: int, *, unit: bool = True) -> str:
    """Format a design's value with its unit; values beyond those of the rendered designs are marked."""
    value = judged.columns[name][place : place + 1].tolist()[0]
    mark = " (not verified)" if name == "scattering_depth" and value > RENDERED_SCATTERING_DEPTH else ""
    return value_text(name, value, unit=unit) + mark


def failure_counts(judged: StudyResults) -> list[tuple[str, str]]:
    """Return reasons of failure without numbers, and their counts, the most frequent first."""
    counts = Counter(without_numbers(text) for text in judged.failures if text)
    return [(text, f"{count:,}") for text, count in counts.most_common()]


def bound_text(name: str, sign: int, bound: float) -> str:
    """Format a bound as a text."""
    return f"{words_of(name)} {_describe_limit(name, sign, bound)}"


def _describe_limit(name: str, sign: int, bound: float) -> str:
    return f"{'at most' if sign > 0 else 'at least'} {value_text(name, bound)}"


def misses(study: Study, row: Mapping[str, Value | None]) -> dict[str, str]:
    """Return the figures that violate a bound, each with a text of the bound."""
    return {
        name: f"{_describe_limit(name, sign, bound)} is required"
        for name, sign, bound in study.bounds()
        if isinstance(value := row.get(name), int | float) and sign * (value - bound) > 0
    }


def range_text(name: str, variable: Variable) -> str:
    """Format the values of a free variable."""
    if variable.values is not None:
        return f"{words_of(name)} ({', '.join(value_text(name, value) for value in variable.values)})"
    scale = ", logarithmic" if variable.scale == "log" else ""
    return f"{words_of(name)} from {value_text(name, variable.least)} to {value_text(name, variable.most)}{scale}"


_ALWAYS_SHOWN = (
    *("sigma_z_near_mm", "sigma_z_middle_mm", "sigma_z_far_mm"),
    *("line_mm", "depth_mm", "standoff_mm", "scattering_depth"),
)


def tiles(study: Study, chosen: HighlightedDesign, compared: HighlightedDesign | None) -> list[Tile]:
    """Return tiles with the chosen design's values: free variables, objectives, constraints and other key figures.

    The values of the ``compared`` design are shown as notes.
    """
    row, missed = chosen.design.table(), misses(study, chosen.design.table())
    label, other = ("", {}) if compared is None else (compared.label, compared.design.table())
    factor, needed = chosen.design.number_of("window_safety"), value_text("window_mm", row.get("window_mm"))
    weak = f" – less than {SAFETY_FACTOR:g}, too thin" if factor < SAFETY_FACTOR else ""
    window = f"at {study.water_depth_m:g} m; the camera's window needs {needed}{weak}"

    def tile(name: str, *, accent: bool = False, note: str = "") -> Tile:
        text, beside = value_text(name, row.get(name)), value_text(name, other.get(name))
        notes = (
            note,
            f"misses its bound: {missed[name]}" if name in missed else "",
            "beyond the rendered designs" if describe_turbidity(chosen) and name == "scattering_depth" else "",
            "not reached by camera or laser" if name.startswith("sigma_z_") and text == MISSING else "",
            f"{label}: {beside}" if beside not in (MISSING, label, "base") else "",
        )
        return Tile(words_of(name), text, "\n".join(filter(None, notes)), accent)

    objectives = [objective.figure for objective in study.objectives]
    others = [name for name in dict.fromkeys([*_ALWAYS_SHOWN, *study.constraints]) if name not in objectives]
    found = [
        tile(name, accent=True, note="at the end of its range: widen it" if _is_at_end(one, row[name]) else "")
        for name, one in study.free().items()
    ]
    found += [tile(name, accent=True, note="an objective") for name in objectives]
    found += [tile(name) for name in others]
    needs, used = (chosen.design.number_of(name) for name in ("required_ms", "exposure_ms"))
    darker = f"required for the wanted brightness: {value_text('required_ms', needs)}" if needs > 1.001 * used else ""
    last = (("exposure_ms", darker), ("laser_class", "estimate, IEC 60825-1"), ("window_safety", window))
    found += [tile(name, note=note) for name, note in last if name not in (*objectives, *others)]
    return found


def _is_at_end(variable: Variable, value: Value | None) -> bool:
    """Return whether a value is within 0.1 % of a range from one of its ends."""
    least, most = (math.nan, math.nan) if variable.values is not None else variable.ends()
    return isinstance(value, int | float) and min(value - least, most - value) <= 1e-3 * (most - least)


def agreement_text(found: Agreement) -> str:
    """Return a sentence on the agreement of formulas and rendering for a design."""
    if found.failure:
        return f"It could not be verified: {found.failure}."
    factor = number_text(found.ratio, 3)
    if found.agrees:
        return f"Formulas and rendering agree: their scatters differ by a factor {factor} (limit {AGREES_WITHIN:g})."
    predicted, rendered = np.array(found.predicted_mm, float), np.array(found.rendered_mm, float)
    with np.errstate(all="ignore"):
        off = np.abs(np.log(rendered / predicted))
    if factor == MISSING or not np.isfinite(off).any():
        return "Formulas and rendering could not be compared: rendering found no scatter at any depth."
    worst = int(np.argmax(np.where(np.isfinite(off), off, -1.0)))
    return (
        f"Formulas and rendering disagree by a factor {factor} (limit {AGREES_WITHIN:g}), most "
        f"at Z = {number_text(found.z_mm[worst])} mm: {number_text(1e3 * predicted[worst])} µm predicted, "
        f"{number_text(1e3 * rendered[worst])} µm rendered. Do not rely on the formulas for designs like this one."
    )
