"""What a calibration's file keeps of a joint estimate, so that a damaged one is noticed when it is read."""

from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, ValidationError

from uwlts.sensor import Uncertainty

_Count = Annotated[int, Field(ge=0)]
_Std = Annotated[FiniteFloat, Field(ge=0)]
_Numbers = list[FiniteFloat]


class _Covered(BaseModel):
    medium: _Count | None
    name: str
    window: bool
    points: _Count
    camera_depth_mm: Annotated[_Numbers, Field(min_length=2, max_length=2)]
    outline_mm: list[Annotated[_Numbers, Field(min_length=2, max_length=2)]]


class _Image(BaseModel):
    source: str
    kind: str
    rms_px: FiniteFloat | None
    residuals: _Count
    strays: _Count


class _Joint(BaseModel):
    model_config = ConfigDict(extra="allow")

    parameters: list[str]
    values: _Numbers
    std: list[_Std]
    std_before: list[_Std | None]
    covariance: list[_Numbers]
    described_sheet: dict[str, Any]
    scatter_px: dict[str, _Std]
    shared_variance: dict[str, _Std] = {}
    residuals: _Count
    strays: _Count
    images: list[_Image] = []
    covered: list[_Covered] = []


class _Source(BaseModel):
    file: str
    sha256: str


class _Origin(BaseModel):
    known_before: Uncertainty = Uncertainty()
    air_captures: list[_Source] = []
    step_captures: list[_Source] = []
    scan_captures: list[_Source] = []


def require_joint(figures: Any, provenance: Any) -> None:
    """Refuse figures of a joint estimate, or what tells where it comes from, that lack something or do not fit.

    Raises
    ------
    ValueError
    """
    try:
        joint = _Joint.model_validate(figures)
        _Origin.model_validate(provenance)
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(map(str, first["loc"]))
        raise ValueError(f"the joint estimate is damaged: {place + ': ' if place else ''}{first['msg']}") from error
    count = len(joint.parameters)
    sized = [joint.values, joint.std, joint.std_before, joint.covariance, *joint.covariance]
    if any(len(each) != count for each in sized):
        raise ValueError(f"the joint estimate is damaged: not all of it is of its {count} parameters")
    if any(row[place] < 0 for place, row in enumerate(joint.covariance)):
        raise ValueError("the joint estimate is damaged: a variance is negative")
