"""Designs of a study: sampling, descriptions of their sensors, and figures by formulas."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import numpy as np

from twin.design.figures_of_merit import FIGURES, Figures, compute_figures
from twin.design.sensor_arrays import (
    PARAMETER_OF,
    SensorArrays,
    adjust_to_standoff,
    extract_numbers,
    extract_parameters,
    list_independent_paths,
    stack_parameters,
)
from twin.design.study import OTHER_COLUMNS, Study
from twin.scene.description import Value, value_at, with_values
from uwlts.errors import DesignError, Error
from uwlts.model.library import validate_description
from uwlts.model.sensor import Sensor

Columns = dict[str, np.ndarray]
"""Results of a study, one row per design: "design", free variables, `Figures`, "violation" and "failure"."""


@dataclass(frozen=True)
class Design:
    """Design: its number in the study, and the values of all free variables."""

    number: int
    values: dict[str, Value]


@dataclass(frozen=True)
class EvaluatedDesign:
    """Design with its results by formulas.

    ``number`` is -1 for a sensor that is not a design of the study. ``values`` are those of the free variables.
    ``figures`` are those of `Figures`, NaN if the design fails. ``violation`` is the total violation of the constraints
    (0: all met), and ``failure`` the reason why the design cannot work ("" if it works).
    """

    number: int
    values: dict[str, Value | None]
    figures: dict[str, float]
    violation: float
    failure: str

    def table(self) -> dict[str, Value | None]:
        """Return all columns of a study's results for this design."""
        ends = {"violation": self.violation, "failure": self.failure}
        return {"design": self.number} | self.values | self.figures | ends

    def without_results(self) -> Design:
        """Return the design without its results."""
        return Design(self.number, {name: value for name, value in self.values.items() if value is not None})

    def number_of(self, name: str) -> float:
        """Return the number in a column; NaN if it is missing or not a number."""
        value = self.table().get(name)
        return math.nan if value is None or isinstance(value, str) else value


@dataclass(frozen=True)
class HighlightedDesign:
    """Highlighted design: its label, its sensor as built, and its values and figures."""

    label: str
    sensor: Sensor
    design: EvaluatedDesign


def make_sensor(study: Study, design: Design, *, described: dict[str, Any] | None = None) -> Sensor:
    """Return a design's sensor without adjustments to the stand-off; DescriptionError if it is not valid.

    ``described`` is the study's sensor as a table, for repeated calls.
    """
    changes: dict[str, Value] = {}
    for name, value in design.values.items():
        changes |= study.choices[name][str(value)] if name in study.choices else {name: value}
    described = study.sensor.model_dump(exclude_none=True) if described is None else described
    return validate_description(Sensor, with_values(described, changes), f"design {design.number}")


def build_sensor(study: Study, design: Design) -> Sensor:
    """Return a design's sensor as built, with all adjustments to the stand-off."""
    sensor = make_sensor(study, design)
    found = adjust_to_standoff(np, extract_parameters([sensor], [study.medium_of(sensor)]), study.follow)
    numbers = {
        "focus": {"camera.focus_distance_mm": found.focus_mm},
        "waist": {"laser.waist_distance_mm": found.waist_distance_mm},
        "volume": {"volume.near_mm": found.near_mm, "volume.far_mm": found.far_mm},
    }
    changes: dict[str, Value] = {path: value.item() for name in study.follow for path, value in numbers[name].items()}
    return validate_description(
        Sensor, with_values(sensor.model_dump(exclude_none=True), changes), f"design {design.number}"
    )


def evaluate_designs(study: Study, designs: Sequence[Design]) -> Columns:
    """Evaluate N designs by formulas; return columns (N,).

    The columns are "design" (the number), the free variables, all `Figures`, "violation" and "failure", see
    `EvaluatedDesign`. A design that fails has NaN figures and an infinite violation.
    """
    parameters, places, failures = _make_parameters(study, designs)
    columns = make_failed_columns(study, designs, failures)
    if parameters is not None:
        options = {"reflectance": study.reflectance, "water_depth_m": study.water_depth_m, "follow": study.follow}
        figures, reasons = compute_figures(parameters, **options)
        columns["failure"][places] = reasons
        works = np.array([not reason for reason in reasons])
        for name in FIGURES:
            columns[name][places[works]] = getattr(figures, name)[works]
        columns["violation"][places[works]] = sum_violations(study, figures)[works]
    return columns


def _make_parameters(study: Study, designs: Sequence[Design]) -> tuple[SensorArrays | None, np.ndarray, list[str]]:
    """Return the parameters of the M valid designs of N, their indices (M,), and the reasons (N,) of the others.

    Designs that differ only in numbers of `PARAMETER_OF` are validated together, at all corners of the box of these
    numbers. This saves time: the validation of one description takes 0.1 ms.
    """
    described = study.sensor.model_dump(exclude_none=True)
    alone = [path for path in list_independent_paths(study.sensor) if path in study.continuous()]
    failures = [""] * len(designs)
    rows: list[SensorArrays] = []
    row_of = np.full(len(designs), -1)

    def numbers(design: Design) -> SensorArrays:
        sensor = make_sensor(study, design, described=described)
        return extract_numbers(sensor, study.medium_of(sensor))

    values = np.empty((len(designs), len(alone)))
    for k, path in enumerate(alone):
        values[:, k] = [float(design.values[path]) for design in designs]
    besides = [name for name in study.free() if name not in alone]
    groups: dict[tuple[Value, ...], list[int]] = {}
    for place, design in enumerate(designs):
        groups.setdefault(tuple([design.values[name] for name in besides]), []).append(place)
    for places in groups.values():
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
    return replace(stack_parameters(rows).select(row_of[valid]), **columns), valid, failures


def make_failed_columns(study: Study, designs: Sequence[Design], reasons: Sequence[str]) -> Columns:
    """Return the columns (N,) of N failed designs with their reasons: NaN figures and infinite violation."""
    columns = {"design": np.array([design.number for design in designs])}
    columns |= {name: np.array([design.values[name] for design in designs]) for name in study.free()}
    columns |= {name: np.full(len(designs), math.nan) for name in FIGURES}
    return columns | {"violation": np.full(len(designs), math.inf), "failure": np.array(reasons, dtype=object)}


def evaluate_sensor(study: Study, label: str, sensor: Sensor) -> EvaluatedDesign:
    """Evaluate a sensor that is not a design of the study, without adjustments to the stand-off.

    Raises DesignError if the sensor cannot work.
    """
    numbers = extract_parameters([sensor], [study.medium_of(sensor)])
    figures, (reason,) = compute_figures(numbers, reflectance=study.reflectance, water_depth_m=study.water_depth_m)
    if reason:
        raise DesignError(f"{label}: {reason}")
    values = {name: label if name in study.choices else value_at(sensor, name, label) for name in study.free()}
    numbers = {name: column.item() for name, column in vars(figures).items()}
    return EvaluatedDesign(-1, values, numbers, sum_violations(study, figures).item(), "")


def select_design(columns: Columns, place: int) -> EvaluatedDesign:
    """Return one design from a study's columns."""
    row = {name: one[place].item() if one.dtype != object else one[place] for name, one in columns.items()}
    values = {name: value for name, value in row.items() if name not in (*FIGURES, *OTHER_COLUMNS)}
    figures = {name: value for name, value in row.items() if name in FIGURES}
    return EvaluatedDesign(row["design"], values, figures, row["violation"], row["failure"] or "")


def sum_violations(study: Study, figures: Figures) -> np.ndarray:
    """Return the total violation (N,) of the constraints, each relative to its bound; 0 if all are met."""
    total = np.zeros(len(figures.coverage))
    for name, sign, bound in study.bounds():
        values = getattr(figures, name)
        missed = np.where(np.isnan(values), math.inf, sign * (values - bound))
        total += np.maximum(missed, 0.0) / (abs(bound) or 1.0)
    return total


def count_designs(study: Study) -> int:
    """Return the number of designs of a study."""
    if study.sampling.kind != "grid":
        return study.sampling.designs
    return math.prod(len(variable.grid()) for variable in study.free().values())


def sample_designs(study: Study, first: int, count: int) -> list[Design]:
    """Return designs ``first`` to ``first + count - 1`` of a grid, random or Sobol study.

    In a grid, the last variable changes fastest.
    """
    numbers = range(first, min(first + count, count_designs(study)))
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
            from scipy.stats import qmc

            sequence = qmc.Sobol(variables, rng=np.random.default_rng(seed))
            with warnings.catch_warnings():
                # The warning asks for a power of two as length, which does not apply to a part of the sequence.
                warnings.simplefilter("ignore", UserWarning)
                if numbers.start > 0:
                    sequence.fast_forward(numbers.start)
                shares = sequence.random(len(numbers))
        columns = [v.values_at(s) for v, s in zip(free.values(), shares.reshape(-1, variables).T, strict=True)]
    rows = zip(*columns, strict=True)
    return [Design(number, dict(zip(free, row, strict=True))) for number, row in zip(numbers, rows, strict=True)]
