"""Designs of a study: how they are chosen, the sensors that they describe, and their figures by formulas."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import numpy as np
from scipy.stats import qmc

from twin.design.figures_of_merit import FIGURES, Figures, figures_of
from twin.design.parameters import (
    PARAMETER_OF,
    SensorArrays,
    followed,
    numbers_of,
    parameters_alone,
    parameters_of,
    stacked,
)
from twin.design.study import OTHER_COLUMNS, Study
from twin.scene.paths import Value, value_at, with_values
from uwlts.errors import DesignError, Error
from uwlts.model.library import validated
from uwlts.model.sensor import Sensor

Columns = dict[str, np.ndarray]
"""A study's results by column: "design", what is free, `Figures`, "violation" and "failure", one row per design."""


@dataclass(frozen=True)
class Design:
    """One design: its number in the study, and the value of everything that is free."""

    number: int
    values: dict[str, Value]


@dataclass(frozen=True)
class EvaluatedDesign:
    """A design with what the formulas say of it.

    ``number`` is -1 for a sensor that is none of the study's designs; ``values`` are those of what is free, ``figures``
    those of `Figures`, NaN where the design fails. ``violation`` is by how much the constraints are missed together (0:
    not at all), ``failure`` why the design cannot work ("" if it can).
    """

    number: int
    values: dict[str, Value | None]
    figures: dict[str, float]
    violation: float
    failure: str

    def table(self) -> dict[str, Value | None]:
        """All columns of a study's results for this design."""
        ends = {"violation": self.violation, "failure": self.failure}
        return {"design": self.number} | self.values | self.figures | ends

    def again(self) -> Design:
        """The design alone, to be evaluated again."""
        return Design(self.number, {name: value for name, value in self.values.items() if value is not None})

    def number_of(self, name: str) -> float:
        """A number by the name of its column, NaN where the design has none."""
        value = self.table().get(name)
        return math.nan if value is None or isinstance(value, str) else value


@dataclass(frozen=True)
class Marked:
    """A design to point out: its label, its sensor as built, and its values and figures."""

    label: str
    sensor: Sensor
    design: EvaluatedDesign


def sensor_of(study: Study, design: Design, *, described: dict[str, Any] | None = None) -> Sensor:
    """The design's sensor, before anything follows the stand-off; errors where the values make no description.

    ``described`` is the study's sensor as a table, which many designs share.
    """
    changes: dict[str, Value] = {}
    for name, value in design.values.items():
        changes |= study.choices[name][str(value)] if name in study.choices else {name: value}
    described = study.sensor.model_dump(exclude_none=True) if described is None else described
    return validated(Sensor, with_values(described, changes), f"design {design.number}")


def built(study: Study, design: Design) -> Sensor:
    """The design's sensor as it is to be built, with everything set that follows the stand-off."""
    sensor = sensor_of(study, design)
    found = followed(np, parameters_of([sensor], [study.medium_of(sensor)]), study.follow)
    numbers = {
        "focus": {"camera.focus_distance_mm": found.focus_mm},
        "waist": {"laser.waist_distance_mm": found.waist_distance_mm},
        "volume": {"volume.near_mm": found.near_mm, "volume.far_mm": found.far_mm},
    }
    changes: dict[str, Value] = {path: value.item() for name in study.follow for path, value in numbers[name].items()}
    return validated(Sensor, with_values(sensor.model_dump(exclude_none=True), changes), f"design {design.number}")


def judged(study: Study, designs: Sequence[Design]) -> Columns:
    """Results of the formulas for N designs, as columns (N,).

    "design" is the number; the values of what is free and all `Figures` follow by their names, then "violation" and
    "failure", see `EvaluatedDesign`. A design that fails has figures NaN and an infinite violation.
    """
    parameters, places, failures = _parameters(study, designs)
    columns = failed(study, designs, failures)
    if parameters is not None:
        options = {"reflectance": study.reflectance, "water_depth_m": study.water_depth_m, "follow": study.follow}
        figures, reasons = figures_of(parameters, **options)
        columns["failure"][places] = reasons
        works = np.array([not reason for reason in reasons])
        for name in FIGURES:
            columns[name][places[works]] = getattr(figures, name)[works]
        columns["violation"][places[works]] = violations(study, figures)[works]
    return columns


def _parameters(study: Study, designs: Sequence[Design]) -> tuple[SensorArrays | None, np.ndarray, list[str]]:
    """Parameters of those M of N designs that are valid descriptions, their places (M,), and why each other is none.

    Designs that differ only in numbers of `PARAMETER_OF` are checked together, at all corners of the box that these
    numbers fill: a description takes its sensor 0.1 ms to check.
    """
    described = study.sensor.model_dump(exclude_none=True)
    alone = [path for path in parameters_alone(study.sensor) if path in study.continuous()]
    failures = [""] * len(designs)
    rows: list[SensorArrays] = []
    row_of = np.full(len(designs), -1)

    def numbers(design: Design) -> SensorArrays:
        sensor = sensor_of(study, design, described=described)
        return numbers_of(sensor, study.medium_of(sensor))

    values = np.empty((len(designs), len(alone)))
    for k, path in enumerate(alone):
        values[:, k] = [float(design.values[path]) for design in designs]
    besides = [name for name in study.free() if name not in alone]
    alike: dict[tuple[Value, ...], list[int]] = {}
    for place, design in enumerate(designs):
        alike.setdefault(tuple([design.values[name] for name in besides]), []).append(place)
    for places in alike.values():
        first, ends = designs[places[0]], zip(values[places].min(axis=0), values[places].max(axis=0), strict=True)
        corners = list(product(*(dict.fromkeys(map(float, pair)) for pair in ends)))
        if len(corners) < len(places):
            try:
                box = [
                    numbers(Design(first.number, first.values | dict(zip(alone, at, strict=True)))) for at in corners
                ]
                row_of[places] = len(rows)
                rows.append(box[0])
                continue
            except Error:
                pass
        for place in places:
            try:
                one = numbers(designs[place])
            except Error as error:
                failures[place] = str(error)
                continue
            row_of[place] = len(rows)
            rows.append(one)
    valid = np.flatnonzero(row_of >= 0)
    if not rows:
        return None, valid, failures
    columns = {
        column: (values[valid, k] * unit).reshape(-1, 1, 1)
        for k, (column, unit) in enumerate(PARAMETER_OF[path] for path in alone)
    }
    return replace(stacked(rows).at(row_of[valid]), **columns), valid, failures


def failed(study: Study, designs: Sequence[Design], reasons: Sequence[str]) -> Columns:
    """Columns (N,) of N designs that fail for these reasons: figures NaN, and an infinite violation."""
    columns = {"design": np.array([design.number for design in designs])}
    columns |= {name: np.array([design.values[name] for design in designs]) for name in study.free()}
    columns |= {name: np.full(len(designs), math.nan) for name in FIGURES}
    return columns | {"violation": np.full(len(designs), math.inf), "failure": np.array(reasons, dtype=object)}


def described(study: Study, label: str, sensor: Sensor) -> EvaluatedDesign:
    """A sensor that is not one of the study's designs, evaluated; nothing in it follows the stand-off. DesignError
    where the sensor cannot work."""
    numbers = parameters_of([sensor], [study.medium_of(sensor)])
    figures, (reason,) = figures_of(numbers, reflectance=study.reflectance, water_depth_m=study.water_depth_m)
    if reason:
        raise DesignError(f"{label}: {reason}")
    values = {name: label if name in study.choices else value_at(sensor, name, label) for name in study.free()}
    numbers = {name: column.item() for name, column in vars(figures).items()}
    return EvaluatedDesign(-1, values, numbers, violations(study, figures).item(), "")


def row_of(columns: Columns, place: int) -> EvaluatedDesign:
    """One design of a study's columns."""
    row = {name: one[place].item() if one.dtype != object else one[place] for name, one in columns.items()}
    values = {name: value for name, value in row.items() if name not in (*FIGURES, *OTHER_COLUMNS)}
    figures = {name: value for name, value in row.items() if name in FIGURES}
    return EvaluatedDesign(row["design"], values, figures, row["violation"], row["failure"] or "")


def violations(study: Study, figures: Figures) -> np.ndarray:
    """By how much designs (N,) miss the constraints together, in parts of the bounds; 0 where all hold."""
    total = np.zeros(len(figures.coverage))
    for name, sign, bound in study.bounds():
        values = getattr(figures, name)
        missed = np.where(np.isnan(values), math.inf, sign * (values - bound))
        total += np.maximum(missed, 0.0) / (abs(bound) or 1.0)
    return total


def number_of_designs(study: Study) -> int:
    """Number of designs that a study judges."""
    if study.sampling.kind != "grid":
        return study.sampling.designs
    return math.prod(len(variable.grid()) for variable in study.free().values())


def designs_of(study: Study, first: int, count: int) -> list[Design]:
    """Designs ``first`` to ``first + count - 1`` of a grid (the last variable runs fastest), random or Sobol study."""
    numbers = range(first, min(first + count, number_of_designs(study)))
    free = study.free()
    if study.sampling.kind == "grid":
        grids = [variable.grid() for variable in free.values()]
        places = np.unravel_index(np.array(numbers), [len(grid) for grid in grids])
        columns = [[grid[k] for k in row.tolist()] for grid, row in zip(grids, places, strict=True)]
    else:
        variables, seed = len(free), study.sampling.seed
        if study.sampling.kind == "random":
            shares = np.array([np.random.default_rng([seed, number]).random(variables) for number in numbers])
        else:
            sequence = qmc.Sobol(variables, rng=np.random.default_rng(seed))
            with warnings.catch_warnings():
                # A part of the sequence need not be a power of two long: the whole counts.
                warnings.simplefilter("ignore", UserWarning)
                if numbers.start > 0:
                    sequence.fast_forward(numbers.start)
                shares = sequence.random(len(numbers))
        columns = [v.drawn(s) for v, s in zip(free.values(), shares.reshape(-1, variables).T, strict=True)]
    # Tuples of values, one after the other: names are put to them last.
    rows = zip(*columns, strict=True)
    return [Design(number, dict(zip(free, row, strict=True))) for number, row in zip(numbers, rows, strict=True)]
