"""Descriptions of artefacts with calibrated sizes, distinguished by `kind`."""

from itertools import pairwise
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, TypeAdapter, ValidationError, model_validator

from uwlts.errors import EvaluationError, describe_problems
from uwlts.files.reading import read_toml
from uwlts.model.sensor import Description, NotNegative, Positive

_MOST_SPHERES = 6  # of a sphere standard; ball plates with more are not evaluated


class SphereStandard(Description):
    """Spheres in fixed positions: two are the dumbbell of VDI/VDE 2634, one gives only the probing error.

    Sizes and spacings define the order of the spheres, unless they agree within 0.5 % of the smallest diameter. Then
    the spheres are ordered by increasing Y or X, the coordinate with the larger spread of centres. `cap_angle_deg`
    limits the evaluated points to a cap about the point that faces the sensor (-Z).
    """

    kind: Literal["spheres"] = "spheres"
    diameters_mm: Annotated[tuple[Positive, ...], Field(min_length=1, max_length=_MOST_SPHERES)]
    spacings_mm: tuple[Positive, ...] = ()
    diameter_uncertainty_mm: NotNegative | None = None
    spacing_uncertainty_mm: NotNegative | None = None
    cap_angle_deg: Annotated[float, Field(gt=0, le=180)] | None = None

    @model_validator(mode="after")
    def _check_spacings(self) -> "SphereStandard":
        count, given = len(self.diameters_mm), len(self.spacings_mm)
        if given != count - 1:
            raise ValueError(f"{count} spheres need {count - 1} spacings between neighbours; {given} are given")
        for spacing, (first, second) in zip(self.spacings_mm, pairwise(self.diameters_mm), strict=True):
            if spacing < (first + second) / 2:
                raise ValueError(f"spheres of {first} and {second} mm cannot stand {spacing} mm apart: they overlap")
        return self


class PlaneStandard(Description):
    """Flat surface."""

    kind: Literal["plane"] = "plane"
    flatness_mm: NotNegative | None = None


class StepStandard(Description):
    """Parallel faces at two levels: one step, or several of the same height (base - block - base)."""

    kind: Literal["step"] = "step"
    height_mm: Positive
    height_uncertainty_mm: NotNegative | None = None
    reference: Literal["lower", "upper"] = "lower"
    edge_mm: NotNegative = 1.0


class PipeStandard(Description):
    """Cylinder, measured from outside or inside."""

    kind: Literal["pipe"] = "pipe"
    diameter_mm: Positive
    diameter_uncertainty_mm: NotNegative | None = None


Artefact = Annotated[SphereStandard | PlaneStandard | StepStandard | PipeStandard, Field(discriminator="kind")]


def parse_artefact(table: object) -> Artefact:
    """Validate an artefact's description; EvaluationError with the invalid keys."""
    try:
        return TypeAdapter(Artefact).validate_python(table)
    except ValidationError as error:
        raise EvaluationError(f"the artefact's description is not valid: {describe_problems(error)}") from error


def resolve_artefact(given: object) -> Artefact | None:
    """Return the artefact given itself, as a table, or by the path of a TOML file; None stays None.

    Raises CaptureError if the file cannot be read, DescriptionError if it is not TOML, and EvaluationError if it does
    not describe an artefact.
    """
    table = read_toml(given, called="artefact") if isinstance(given, str | Path) else given
    return None if table is None else parse_artefact(table)
