"""Description of a study: base sensor, free variables, objectives, constraints, and sampling of designs."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, model_validator

from twin.design.figures_of_merit import FIGURES
from twin.design.sensor_arrays import Follow
from twin.scene.description import NamedSensor, Value, value_at
from uwlts.errors import DescriptionError
from uwlts.files.reading import is_regular_file
from uwlts.model.library import find_description, read_table, validate_description
from uwlts.model.sensor import Description, Medium, NotNegative, Sensor

FOLDER = "studies"
OTHER_COLUMNS = ("design", "violation", "failure")
"""Columns of results in addition to values and figures."""
FOLLOWING: dict[Follow, str] = {"focus": "camera.focus_distance_mm", "waist": "laser.waist_distance_mm"}
"""Paths that `Study.follow` sets; they must not be free at the same time."""
MOST_DESIGNS = 10**8  # hours of screening


class Variable(Description):
    """Free number of the sensor's description: from ``least`` to ``most``, or one of ``values``.

    A grid has ``steps`` values of a range, evenly spaced on the ``scale``. ``whole`` rounds to integers; numbers that
    are integers in the description, such as pixels, are always rounded.
    """

    least: float | None = None
    most: float | None = None
    steps: Annotated[int, Field(ge=2, le=100000)] = 11
    scale: Literal["linear", "log"] = "linear"
    whole: bool = False
    values: tuple[Value, ...] | None = None

    @model_validator(mode="after")
    def _check_range_or_values(self) -> Variable:
        given = [self.least is not None, self.most is not None, self.values is not None]
        if given not in ([True, True, False], [False, False, True]):
            raise ValueError("give least and most, or values")
        if self.values is not None:
            if not self.values:
                raise ValueError("values is empty; give at least one")
            if len({isinstance(value, str) for value in self.values}) > 1:
                raise ValueError(f"values contain texts and numbers, {self.values}: use choices, or two studies")
            return self
        least, most = self.ends()
        if not least < most:
            raise ValueError(f"least {least:g} must be smaller than most {most:g}")
        if self.scale == "log" and least <= 0:
            raise ValueError(f"a log scale needs a least above 0, found {least:g}")
        return self

    def ends(self) -> tuple[float, float]:
        """Return the least and most value of a range; DescriptionError for a list of values."""
        if self.least is None or self.most is None:
            raise DescriptionError(f"a variable with the values {self.values} is not a range with least and most")
        return self.least, self.most

    def values_at(self, shares: np.ndarray) -> list[Value]:
        """Return the values for designs at fractions (N,) from 0 to 1 of the range or of the list."""
        if self.values is not None:
            return [self.values[min(int(share * len(self.values)), len(self.values) - 1)] for share in shares.tolist()]
        least, most = self.ends()
        values = least * (most / least) ** shares if self.scale == "log" else least + shares * (most - least)
        return np.rint(values).astype(int).tolist() if self.whole else values.tolist()

    def grid(self) -> list[Value]:
        """Return all values of a grid."""
        if self.values is not None:
            return list(self.values)
        return list(dict.fromkeys(self.values_at(np.arange(self.steps) / (self.steps - 1))))


class Objective(Description):
    """Figure to minimise or maximise."""

    figure: str
    goal: Literal["minimise", "maximise"] = "minimise"


class Constraint(Description):
    """Bounds of a figure."""

    least: float | None = None
    most: float | None = None

    @model_validator(mode="after")
    def _check_bounds(self) -> Constraint:
        if self.least is None and self.most is None:
            raise ValueError("give least, most, or both")
        if self.least is not None and self.most is not None and self.least > self.most:
            raise ValueError(f"least {self.least:g} is above most {self.most:g}")
        return self


class Sampling(Description):
    """Sampling of designs: a grid, random, a Sobol sequence, or an optimiser (NSGA-II).

    ``designs`` is their number, except for a grid; ``batch`` is the number of designs that are evaluated together.
    """

    kind: Literal["grid", "random", "sobol", "optimise"] = "grid"
    designs: Annotated[int, Field(ge=1, le=MOST_DESIGNS)] = 4096
    seed: Annotated[int, Field(ge=0)] = 0
    batch: Annotated[int, Field(ge=1, le=100_000)] = 1000


class Study(Description):
    """Study as read from TOML.

    ``sensor`` is the base sensor, given by name, path or table. It is stored completely, because remote workers may not
    have its file. ``variables`` are free values of the sensor's description by path (``camera.focal_length_mm``).
    ``choices`` are named alternatives that set several paths at once, such as commercial cameras. ``follow`` lists the
    adjustments to each design's stand-off, see `twin.design.sensor_arrays.compute_adjustments`. ``verify`` is the
    number of designs to render, in addition to the base sensor.
    """

    title: str
    sensor: NamedSensor = Field(default="thesis", validate_default=True)
    medium: str = "water"
    reflectance: Annotated[float, Field(gt=0, le=1)] = 0.5
    water_depth_m: NotNegative = 100.0
    variables: dict[str, Variable] = {}
    choices: dict[str, dict[str, dict[str, Value]]] = {}
    follow: tuple[Follow, ...] = ()
    sampling: Sampling = Sampling()
    objectives: Annotated[tuple[Objective, ...], Field(min_length=1)] = (Objective(figure="sigma_z_rms_mm"),)
    constraints: dict[str, Constraint] = {}
    verify: Annotated[int, Field(ge=0, le=1000)] = 2

    @model_validator(mode="after")
    def _check_consistency(self) -> Study:
        if unknown := [name for name in self.figures() if name not in FIGURES]:
            raise ValueError(f"unknown figure {', '.join(unknown)}; known are {', '.join(FIGURES)}")
        if not self.variables and not self.choices:
            raise ValueError("nothing is free: give variables or choices")
        chosen = self._check_choices()
        for what, path in FOLLOWING.items():
            if what in self.follow and path in (*self.variables, *chosen):
                raise ValueError(f"{path} is free, but follow sets it: leave '{what}' out of follow, or the path")
        if unfit := [path for path in (*self.variables, *chosen) if path.startswith("laser.window.tilt")]:
            raise ValueError(f"{unfit[0]}: the formulas do not contain it; compare two rendered sensors instead")
        free = self.free().values()
        count = math.prod(one.steps if one.values is None else len(one.values) for one in free)
        if self.sampling.kind == "grid" and count > MOST_DESIGNS:
            raise ValueError(
                f"the grid has {count:.3g} designs, more than {MOST_DESIGNS:g}: use fewer steps, or sampling 'sobol'"
            )
        return self

    def _check_choices(self) -> dict[str, None]:
        """Return the paths that choices set, after checks of their names and options."""
        if twice := set(self.variables) & set(self.choices):
            raise ValueError(f"{', '.join(sorted(twice))}: a variable has this name; give the choice another")
        if empty := [name for name, options in self.choices.items() if not options]:
            raise ValueError(f"choices.{empty[0]} is empty; give at least one option")
        if taken := [name for name in self.choices if name in (*FIGURES, *OTHER_COLUMNS)]:
            raise ValueError(f"choices.{taken[0]}: a figure has this name; give the choice another")
        chosen = self.choice_paths()
        if twice := sorted(chosen.keys() & self.variables):
            raise ValueError(f"{twice[0]} is set by a variable and by a choice")
        return chosen

    def choice_paths(self) -> dict[str, None]:
        """Return the paths that options of choices set, in order, as keys."""
        options = (option for options in self.choices.values() for option in options.values())
        return dict.fromkeys(path for option in options for path in option)

    def free(self) -> dict[str, Variable]:
        """Return all free variables in order: variables, then choices with the names of their options as values."""
        return self.variables | {name: Variable(values=tuple(options)) for name, options in self.choices.items()}

    def continuous(self) -> list[str]:
        """Return the paths of continuous variables."""
        return [path for path, one in self.variables.items() if one.values is None and not one.whole]

    def figures(self) -> list[str]:
        """Return the figures of the objectives and of the constraints, in this order."""
        return list(dict.fromkeys([*(objective.figure for objective in self.objectives), *self.constraints]))

    def bounds(self) -> list[tuple[str, int, float]]:
        """Return all bounds as figure, sign (1 for an upper, -1 for a lower bound) and value."""
        return [
            (name, sign, bound)
            for name, constraint in self.constraints.items()
            for sign, bound in ((-1, constraint.least), (1, constraint.most))
            if bound is not None
        ]

    def medium_of(self, sensor: Sensor) -> Medium:
        """Return the study's medium from a sensor's media."""
        return sensor.medium(self.medium)


def load_study(study: str | Path | Study, *, designs: int | None = None, verify: int | None = None) -> Study:
    """Load a study by name (``baseline-angle``) or path, or check a given study.

    ``designs`` and ``verify`` replace the study's own values. The base sensor can be the name of a file in the study's
    folder. Raises DescriptionError if the study is not valid, or a path does not exist in the sensor's description.
    """
    if isinstance(study, Study):
        path, table = Path("the study"), study.model_dump()
    else:
        path = find_description(study, FOLDER)
        table = read_table(path, FOLDER)
        beside = path.parent / str(table.get("sensor", ""))
        if beside.suffix == ".toml" and is_regular_file(beside):
            table["sensor"] = str(beside)
    sampling = table.get("sampling", {})
    if designs is not None and isinstance(sampling, dict):
        table["sampling"] = sampling | {"designs": designs}
    if verify is not None:
        table["verify"] = verify
    found = validate_description(Study, table, path)
    found.medium_of(found.sensor)
    for name in found.choice_paths():
        value_at(found.sensor, name, path)
    counted = [name for name in found.variables if type(value_at(found.sensor, name, path)) is int]
    whole = {name: found.variables[name].model_copy(update={"whole": True}) for name in counted}
    return found.model_copy(update={"variables": found.variables | whole})
