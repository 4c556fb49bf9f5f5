"""Description of a study: a base sensor, free variables, objectives, constraints, and the choice of designs."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, field_validator, model_validator

from twin.design.figures_of_merit import FIGURES
from twin.design.parameters import Follow
from twin.scene.paths import Value, value_at
from uwlts.errors import DescriptionError
from uwlts.files.reading import is_regular_file
from uwlts.model.library import find, load_sensor, read_table, validated
from uwlts.model.sensor import Description, Medium, NotNegative, Sensor

FOLDER = "studies"
OTHER_COLUMNS = ("design", "violation", "failure")
"""Columns of results besides values and figures."""
FOLLOWING: dict[Follow, str] = {"focus": "camera.focus_distance_mm", "waist": "laser.waist_distance_mm"}
"""Parameters that follow the stand-off and could be free as well."""
MOST_DESIGNS = 10**8


class Variable(Description):
    """A free number of the sensor's description: from ``least`` to ``most``, or one of ``values``.

    A grid takes ``steps`` of a range, evenly spaced, in their logarithm where ``scale`` is "log". ``whole`` rounds to
    whole numbers; numbers that the description counts, such as pixels, are whole anyway.
    """

    least: float | None = None
    most: float | None = None
    steps: Annotated[int, Field(ge=2, le=100000)] = 11
    scale: Literal["linear", "log"] = "linear"
    whole: bool = False
    values: tuple[Value, ...] | None = None

    @model_validator(mode="after")
    def _range_or_values(self) -> Variable:
        given = [self.least is not None, self.most is not None, self.values is not None]
        if given not in ([True, True, False], [False, False, True]):
            raise ValueError("give least and most, or values")
        if self.values is not None:
            if not self.values:
                raise ValueError("values is empty")
            if len({isinstance(value, str) for value in self.values}) > 1:
                raise ValueError(f"values mix words and numbers, {self.values}: make them choices, or two studies")
            return self
        least, most = self.ends()
        if not least < most:
            raise ValueError(f"least {least:g} must be smaller than most {most:g}")
        if self.scale == "log" and least <= 0:
            raise ValueError(f"a log scale needs a least above 0, found {least:g}")
        return self

    def ends(self) -> tuple[float, float]:
        """Least and most value of a range; DescriptionError where the variable is a list of values."""
        if self.least is None or self.most is None:
            raise DescriptionError(f"a variable with the values {self.values} has no least and most")
        return self.least, self.most

    def at(self, share: float) -> Value:
        """The value at a share from 0 to 1 of the range, not rounded, or of the list."""
        if self.values is not None:
            return self.values[min(int(share * len(self.values)), len(self.values) - 1)]
        least, most = self.ends()
        if self.scale == "log":
            return float(math.exp(math.log(least) + share * math.log(most / least)))
        return least + share * (most - least)

    def taken(self, value: Value) -> Value:
        """The value as a design takes it: rounded if it has to be whole."""
        return round(float(value)) if self.whole and self.values is None else value

    def drawn(self, shares: np.ndarray) -> list[Value]:
        """Values at shares (N,) as designs take them: as of `at` and `taken`."""
        if self.values is not None or self.scale == "log":
            return [self.taken(self.at(share)) for share in shares.tolist()]
        least, most = self.ends()
        values = least + shares * (most - least)
        return np.rint(values).astype(int).tolist() if self.whole else values.tolist()

    def grid(self) -> list[Value]:
        """All values of a grid."""
        if self.values is not None:
            return list(self.values)
        return list(dict.fromkeys(self.taken(self.at(k / (self.steps - 1))) for k in range(self.steps)))


class Objective(Description):
    """A figure to make as small or as large as possible."""

    figure: str
    goal: Literal["minimise", "maximise"] = "minimise"


class Constraint(Description):
    """Bounds of a figure."""

    least: float | None = None
    most: float | None = None

    @model_validator(mode="after")
    def _bounded(self) -> Constraint:
        if self.least is None and self.most is None:
            raise ValueError("give least, most, or both")
        if self.least is not None and self.most is not None and self.least > self.most:
            raise ValueError(f"least {self.least:g} is above most {self.most:g}")
        return self


class Sampling(Description):
    """Choice of designs: all of a grid, at random, by a Sobol sequence, or by an optimiser (NSGA-II).

    ``designs`` is their number where it is not the grid's; ``batch`` designs are judged at a time.
    """

    kind: Literal["grid", "random", "sobol", "optimise"] = "grid"
    designs: Annotated[int, Field(ge=1, le=MOST_DESIGNS)] = 4096
    seed: Annotated[int, Field(ge=0)] = 0
    batch: Annotated[int, Field(ge=1, le=100_000)] = 1000


class Study(Description):
    """A study as read from TOML.

    ``sensor`` is the base sensor, given by name, path or table; it is kept whole, as workers elsewhere may not have
    its file.
    ``variables`` are free numbers or words of the sensor's description, by their path (``camera.focal_length_mm``);
    ``choices`` are named alternatives that set several paths at once, such as cameras that can be bought. ``follow``
    is what is set anew for every design as one would on the bench, see `twin.design.parameters.followed`.
    ``refine`` lets the best design be improved along the gradient; ``verify`` is how many of the best are rendered, in
    addition to the base sensor.
    """

    title: str
    sensor: Sensor = Field(default="thesis", validate_default=True)
    medium: str = "water"
    reflectance: Annotated[float, Field(gt=0, le=1)] = 0.5
    water_depth_m: NotNegative = 100.0
    variables: dict[str, Variable] = {}
    choices: dict[str, dict[str, dict[str, Value]]] = {}
    follow: tuple[Follow, ...] = ()
    sampling: Sampling = Sampling()
    objectives: Annotated[tuple[Objective, ...], Field(min_length=1)] = (Objective(figure="sigma_z_rms_mm"),)
    constraints: dict[str, Constraint] = {}
    refine: bool = True
    verify: Annotated[int, Field(ge=0, le=1000)] = 2
    verify_tolerance: Annotated[float, Field(gt=1)] = 1.5

    @field_validator("sensor", mode="before")
    @classmethod
    def _found(cls, value: object) -> object:
        return load_sensor(value) if isinstance(value, str) else value

    @model_validator(mode="after")
    def _consistent(self) -> Study:
        if unknown := [name for name in self.wanted() if name not in FIGURES]:
            raise ValueError(f"unknown figure {', '.join(unknown)}; known are {', '.join(FIGURES)}")
        if not self.variables and not self.choices:
            raise ValueError("nothing is free: give variables or choices")
        if twice := set(self.variables) & set(self.choices):
            raise ValueError(f"{', '.join(sorted(twice))}: a choice needs a name of its own")
        if empty := [name for name, options in self.choices.items() if not options]:
            raise ValueError(f"choices.{empty[0]} has no options")
        if taken := [name for name in self.choices if name in (*FIGURES, *OTHER_COLUMNS)]:
            raise ValueError(f"choices.{taken[0]}: a figure has this name; give the choice another")
        chosen = self.chosen()
        if twice := sorted(chosen.keys() & self.variables):
            raise ValueError(f"{twice[0]} is set by a variable and by a choice")
        for what, path in FOLLOWING.items():
            if what in self.follow and path in (*self.variables, *chosen):
                raise ValueError(f"{path} is free, but follow sets it: leave '{what}' out of follow, or the path")
        if unfit := [path for path in (*self.variables, *chosen) if path.startswith("laser.window.tilt")]:
            raise ValueError(f"{unfit[0]}: the formulas do not know it; compare two rendered sensors instead")
        free = self.free().values()
        count = math.prod(one.steps if one.values is None else len(one.values) for one in free)
        if self.sampling.kind == "grid" and count > MOST_DESIGNS:
            raise ValueError(f"a grid of {count:.3g} designs; at most {MOST_DESIGNS:g}: take fewer steps, or sobol")
        return self

    def chosen(self) -> dict[str, None]:
        """Paths that options of choices set, in order."""
        options = (option for options in self.choices.values() for option in options.values())
        return dict.fromkeys(path for option in options for path in option)

    def free(self) -> dict[str, Variable]:
        """All that is free, in order: variables, then choices by the names of their options."""
        return self.variables | {name: Variable(values=tuple(options)) for name, options in self.choices.items()}

    def continuous(self) -> list[str]:
        """Paths of the variables that take any number of a range."""
        return [path for path, one in self.variables.items() if one.values is None and not one.whole]

    def wanted(self) -> list[str]:
        """Figures of the objectives and of the constraints, in this order."""
        return list(dict.fromkeys([*(objective.figure for objective in self.objectives), *self.constraints]))

    def bounds(self) -> list[tuple[str, int, float]]:
        """All bounds: the figure, 1 for one from above and -1 for one from below, and the bound."""
        return [
            (name, sign, bound)
            for name, constraint in self.constraints.items()
            for sign, bound in ((-1, constraint.least), (1, constraint.most))
            if bound is not None
        ]

    def medium_of(self, sensor: Sensor) -> Medium:
        """The study's medium of a sensor."""
        return sensor.medium(self.medium)


def load_study(study: str | Path | Study, *, designs: int | None = None, verify: int | None = None) -> Study:
    """Study by name (``baseline-angle``) or path; a sensor beside it is found by its file name.

    ``designs`` and ``verify`` replace the study's own; a study that is given as such is checked in the same way.
    DescriptionError where the study is not valid, or a path does not exist in the sensor's description.
    """
    if isinstance(study, Study):
        path, table = Path("the study"), study.model_dump()
    else:
        path = find(study, FOLDER)
        table = read_table(path, FOLDER)
        beside = path.parent / str(table.get("sensor", ""))
        if beside.suffix == ".toml" and is_regular_file(beside):
            table["sensor"] = str(beside)
    sampling = table.get("sampling", {})
    if designs is not None and isinstance(sampling, dict):
        table["sampling"] = sampling | {"designs": designs}
    if verify is not None:
        table["verify"] = verify
    found = validated(Study, table, path)
    found.medium_of(found.sensor)
    for name in found.chosen():
        value_at(found.sensor, name, path)
    counted = [name for name in found.variables if type(value_at(found.sensor, name, path)) is int]
    whole = {name: found.variables[name].model_copy(update={"whole": True}) for name in counted}
    return found.model_copy(update={"variables": found.variables | whole})
