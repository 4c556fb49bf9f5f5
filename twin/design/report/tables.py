"""Texts, numbers and tables of a study's page: names, tiles, judged designs, and verdicts of the verification."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from twin.design.choice import pareto
from twin.design.description import Objective, Study, Value, Variable
from twin.design.figures import CLASS_NAMES
from twin.design.verification import Agreement
from uwlts.model.errors import EvaluationError
from uwlts.model.sensor import Sensor
from uwlts.report.page_toolkit import Tile

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
    "_mm": "mm",
    "_um": "µm",
    "_nm": "nm",
    "_mw": "mW",
    "_deg": "°",
    "_px": "px",
    "_ms": "ms",
    "_us": "µs",
    "_hz": "Hz",
    "_dn": "DN",
    "_e": "e⁻",
    "_c": "°C",
    "_k": "K",
    "_s": "s",
    "_m": "m",
}


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


def number_text(value: float | None, digits: int = 4) -> str:
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


def value_text(name: str, value: Value | None, *, unit: bool = True) -> str:
    """A value of a figure or of something free, with its unit."""
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


@dataclass(frozen=True, eq=False)
class Judged:
    """A study and the columns of its judged designs, as `twin.design.results.read_parts` gives them."""

    study: Study
    columns: Mapping[str, np.ndarray]

    def __post_init__(self) -> None:
        expected = ["design", "violation", "failure", *self.study.free(), *(o.figure for o in self.study.objectives)]
        if self.columns and (missing := [name for name in expected if name not in self.columns]):
            raise EvaluationError(
                f"the results have no {', '.join(missing)}, but {', '.join(self.columns)}: they are of another study"
            )

    def __len__(self) -> int:
        return len(self.columns["design"]) if self.columns else 0

    def figure(self, name: str) -> np.ndarray:
        """A figure of all designs, (N,) float; NaN where it is unknown."""
        if name not in self.columns:
            return np.full(len(self), np.nan)
        return np.asarray(self.columns[name], dtype=np.float64)

    def cost(self, place: int = 0) -> np.ndarray:
        """An objective of all designs, (N,), turned so that smaller is better."""
        objective = self.study.objectives[place]
        return self.figure(objective.figure) * (1 if objective.goal == "minimise" else -1)

    @cached_property
    def failures(self) -> list[str]:
        """Why designs cannot work, "" for those that do."""
        return [text or "" for text in self.columns["failure"].tolist()] if self.columns else []

    @cached_property
    def works(self) -> np.ndarray:
        """Designs (N,) that work and whose first objective is known."""
        return np.array([not text for text in self.failures], dtype=bool) & np.isfinite(self.cost())

    @cached_property
    def feasible(self) -> np.ndarray:
        """Designs (N,) that work and meet all constraints."""
        return self.works & (self.figure("violation") <= 0)

    @cached_property
    def best_first(self) -> np.ndarray:
        """Places of the designs that work: those that miss the constraints least, then those of the best objective."""
        order = np.lexsort((self.cost(), self.figure("violation")))
        return order[self.works[order]]

    @cached_property
    def front(self) -> np.ndarray:
        """Designs (N,) that no other of those that count beats in all objectives, see `of_interest`."""
        values = np.column_stack([self.cost(k) for k in range(len(self.study.objectives))])
        return pareto(np.where(self.of_interest[:, None], values, np.nan))

    @property
    def of_interest(self) -> np.ndarray:
        """Designs (N,) that meet all constraints, or all that work if none does."""
        return self.feasible if self.feasible.any() else self.works

    def text(self, name: str, place: int) -> str:
        """A design's value in words, with its unit."""
        return value_text(name, self.columns[name][place : place + 1].tolist()[0])

    def failure_counts(self) -> list[tuple[str, int]]:
        """Why designs cannot work, without the numbers, and how many; the most frequent first."""
        return Counter(without_numbers(text) for text in self.failures if text).most_common()

    def miss_counts(self) -> list[tuple[str, int]]:
        """Constraints in words, and how many of the working designs miss each."""
        counts = []
        for name, sign, bound in bounds_of(self.study):
            missed = sign * (self.figure(name)[self.works] - bound) > 0
            counts.append((bound_text(name, sign, bound), int(missed.sum())))
        return counts


def bounds_of(study: Study) -> list[tuple[str, int, float]]:
    """All bounds: the figure, 1 for one from above and -1 for one from below, and the bound."""
    return [
        (name, sign, bound)
        for name, constraint in study.constraints.items()
        for sign, bound in ((-1, constraint.least), (1, constraint.most))
        if bound is not None
    ]


def bound_text(name: str, sign: int, bound: float) -> str:
    """A bound in words."""
    return f"{words_of(name)} {'at most' if sign > 0 else 'at least'} {value_text(name, bound)}"


def misses(study: Study, row: Mapping[str, Value | None]) -> list[str]:
    """Which constraints a design misses, in words."""
    found = []
    for name, sign, bound in bounds_of(study):
        value = _number(row, name)
        if sign * (value - bound) > 0:
            limit = f"{'at most' if sign > 0 else 'at least'} {value_text(name, bound)} is asked"
            found.append(f"{words_of(name)} is {value_text(name, value)}, {limit}")
    return found


_CHOSEN = {
    "grid": "all of a grid",
    "random": "drawn at random",
    "sobol": "by a Sobol sequence",
    "optimise": "proposed by an optimiser (NSGA-II)",
}
_FOLLOW = {
    "focus": "the lens is focused on it",
    "waist": "the laser is focused on it",
    "volume": "the volume lies about it",
}


def introduction(judged: Judged) -> list[tuple[str, str]]:
    """What was asked and how many designs were judged, by key words."""
    study, feasible, works = judged.study, int(judged.feasible.sum()), int(judged.works.sum())
    base = study.sensor
    facts = [
        ("base sensor", f"{base.name}, in {study.medium}, on surfaces of reflectance {study.reflectance:g}"),
        ("free", "; ".join(_range_text(name, variable) for name, variable in study.free().items())),
        ("wanted", "; ".join(goal_text(objective) for objective in study.objectives)),
    ]
    if bounds := bounds_of(study):
        facts.append(("constraints", "; ".join(bound_text(*bound) for bound in bounds)))
    if study.follow:
        facts.append(("at each stand-off", listed([_FOLLOW[name] for name in study.follow])))
    counted = f"{len(judged):,} judged, {_CHOSEN[study.sampling.kind]}; {works:,} work"
    facts.append(("designs", counted + (f", {feasible:,} meet all constraints" if bounds_of(study) else "")))
    return facts


def _range_text(name: str, variable: Variable) -> str:
    if variable.values is not None:
        return f"{words_of(name)} ({', '.join(value_text(name, value) for value in variable.values)})"
    scale = ", logarithmic" if variable.scale == "log" else ""
    return f"{words_of(name)} from {value_text(name, variable.least)} to {value_text(name, variable.most)}{scale}"


_ALWAYS_SHOWN = ("sigma_z_near_mm", "sigma_z_middle_mm", "sigma_z_far_mm", "line_mm", "depth_mm", "standoff_mm")


def tiles(
    study: Study,
    sensor: Sensor,
    row: Mapping[str, Value | None],
    *,
    compared: tuple[str, Mapping[str, Value | None]] | None,
) -> list[Tile]:
    """What is free, what is wanted, and what else decides, of a design; beside that of another one (label, row)."""
    missed = {text.split(" is ")[0]: text for text in misses(study, row)}

    def tile(name: str, *, accent: bool = False, note: str = "") -> Tile:
        notes = [note] if note else []
        if words_of(name) in missed:
            notes.append(f"misses its bound: {missed[words_of(name)].rpartition(', ')[2]}")
        if name.startswith("sigma_z_") and value_text(name, row.get(name)) == MISSING:
            notes.append("camera or laser do not reach it")
        if compared is not None:
            other = value_text(name, compared[1].get(name))
            notes += [f"{compared[0]}: {other}"] if other not in (MISSING, compared[0], "base") else []
        return Tile(words_of(name), value_text(name, row.get(name)), "\n".join(notes), accent)

    found = [tile(name, accent=True) for name in study.free()]
    objectives = [objective.figure for objective in study.objectives]
    found += [tile(name, accent=True, note="an objective") for name in objectives]
    others = [*_ALWAYS_SHOWN, *study.constraints]
    found += [tile(name) for name in dict.fromkeys(others) if name not in objectives]
    required, used = (_number(row, name) for name in ("required_ms", "exposure_ms"))
    darker = f"the wanted brightness takes {value_text('required_ms', required)}" if required > 1.001 * used else ""
    for name, note in (("exposure_ms", darker), ("laser_class", "estimate, IEC 60825-1")):
        if name not in (*objectives, *others):
            found.append(tile(name, note=note))
    return found + ([_window_tile(study, sensor, row)] if "window_mm" not in objectives else [])


def _number(row: Mapping[str, Value | None], name: str) -> float:
    """A number of a row, NaN where it is missing."""
    value = row.get(name)
    return math.nan if value is None or isinstance(value, str) else value


def _window_tile(study: Study, sensor: Sensor, row: Mapping[str, Value | None]) -> Tile:
    """The window's thickness and the one it needs."""
    window, needed = sensor.camera.window, _number(row, "window_mm")
    if not window.mounted:
        return Tile("camera's window", "none")
    text = f"{value_text('window_mm', needed)} needed at {study.water_depth_m:g} m"
    thin = " – too thin" if needed > window.thickness_mm else ""
    return Tile("camera's window", value_text("window_mm", window.thickness_mm), text + thin)


def agreement_text(study: Study, found: Agreement) -> str:
    """Whether formulas and rendering agree on a design, in a sentence."""
    if found.failure:
        return f"It could not be verified: {found.failure}."
    factor = number_text(found.ratio, 3)
    if found.agrees:
        return (
            f"Formulas and rendering agree: their scatters differ by a factor {factor}, up to "
            f"{number_text(study.verify_tolerance, 3)} is allowed."
        )
    predicted, rendered = np.array(found.predicted_mm, float), np.array(found.rendered_mm, float)
    with np.errstate(all="ignore"):
        off = np.abs(np.log(rendered / predicted))
    if factor == MISSING or not np.isfinite(off).any():
        return "Formulas and rendering could not be compared: rendering found no scatter at any depth."
    worst = int(np.argmax(np.where(np.isfinite(off), off, -1.0)))
    return (
        f"Formulas and rendering disagree by a factor {factor}, more than the {number_text(study.verify_tolerance, 3)} "
        f"allowed: most at Z = {number_text(found.z_mm[worst])} mm, where "
        f"{number_text(1e3 * predicted[worst])} µm were predicted and {number_text(1e3 * rendered[worst])} µm "
        "rendered. Do not rely on the formulas for designs like this one."
    )


def agreement_rows(agreements: Sequence[Agreement]) -> list[list[str]]:
    """Rows of the table of what was rendered."""
    rows = []
    for found in agreements:
        errors = [abs(value) for value in found.error_mm if math.isfinite(value)]
        lines = found.line_mm
        rows.append(
            [
                found.label,
                str(found.design) if found.design >= 0 else MISSING,
                "failed" if found.failure else "agree" if found.agrees else "DISAGREE",
                number_text(found.ratio, 3),
                number_text(1e3 * max(errors)) if errors else MISSING,
                f"{number_text(min(lines))} to {number_text(max(lines))}" if lines else MISSING,
                value_text("exposure_ms", found.predicted_exposure_ms, unit=False),
                value_text("exposure_ms", found.exposure_ms, unit=False),
                number_text(found.seconds, 3),
            ]
        )
    return rows
