"""The head of a study's page: what was asked, and the chosen design in numbers."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from twin.study.description import Study, Variable
from twin.study.report.names import MISSING, goal_text, listed, value_text, words_of
from twin.study.report.table import Judged, bound_text, bounds_of, misses
from uwlts.sensor import Sensor

_CHOSEN = {
    "grid": "all of a grid", "random": "drawn at random", "sobol": "by a Sobol sequence",
    "optimise": "proposed by an optimiser (NSGA-II)",
}  # fmt: skip
_FOLLOW = {
    "focus": "the lens is focused on it", "waist": "the laser is focused on it", "volume": "the volume lies about it",
}  # fmt: skip


@dataclass(frozen=True)
class Tile:
    """A number of the chosen design, and what is to be said of it."""

    name: str
    value: str
    note: str
    accent: bool


def introduction(judged: Judged) -> list[tuple[str, str]]:
    """What was asked and how many designs were judged, by key words."""
    study, feasible, works = judged.study, int(judged.feasible.sum()), int(judged.works.sum())
    base = study.base()
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


def tiles(
    study: Study, sensor: Sensor, row: Mapping[str, Any], *, compared: tuple[str, Mapping[str, Any]] | None
) -> list[Tile]:  # fmt: skip
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
    others = [
        "sigma_z_near_mm", "sigma_z_middle_mm", "sigma_z_far_mm", "line_mm", "depth_mm", "standoff_mm",
        *study.constraints,
    ]  # fmt: skip
    found += [tile(name) for name in dict.fromkeys(others) if name not in objectives]
    required, used = row.get("required_ms", math.nan), row.get("exposure_ms", math.nan)
    darker = f"the wanted brightness takes {value_text('required_ms', required)}" if required > 1.001 * used else ""
    shown = {*objectives, *others}
    found += [tile("exposure_ms", note=darker)] if "exposure_ms" not in shown else []
    found += [tile("laser_class", note="estimate, IEC 60825-1")] if "laser_class" not in shown else []
    return found + ([_window_tile(study, sensor, row)] if "window_mm" not in objectives else [])


def _window_tile(study: Study, sensor: Sensor, row: Mapping[str, Any]) -> Tile:
    """The window's thickness and the one it needs."""
    window, needed = sensor.camera.window, row.get("window_mm", math.nan)
    if not window.mounted:
        return Tile("camera's window", "none", "", False)
    text = f"{value_text('window_mm', needed)} needed at {study.water_depth_m:g} m"
    thin = " – too thin" if needed > window.thickness_mm else ""
    return Tile("camera's window", value_text("window_mm", window.thickness_mm), text + thin, False)
