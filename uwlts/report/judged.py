"""What the report reads from an evaluation file."""

from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from uwlts.errors import CaptureError
from uwlts.evaluate import read_evaluation
from uwlts.metrology.artefact_descriptions import Artefact

Count = Annotated[int, Field(ge=0)]


class _Stored(BaseModel):
    # Newer evaluations may say more than the report shows.
    model_config = ConfigDict(frozen=True, extra="ignore", allow_inf_nan=False)


class ArtefactFigures(_Stored):
    """Figures of an artefact's evaluation by name, mm, and the account of its points."""

    kind: str
    figures_mm: dict[str, float]
    points_total: Count
    points_used: Count
    points_rejected: Count
    within_vdi_outliers: bool


class TruthFigures(_Stored):
    """Signed distances of the matched points to the true surface, mm; see `TruthComparison`."""

    matched: Count
    tolerance_mm: float
    mean_mm: float
    std_mm: float
    rms_mm: float
    p95_mm: float
    p99_mm: float
    largest_mm: float
    share_within_tolerance: Annotated[float, Field(ge=0, le=1)]
    false_points: Count
    missed: Count


class TruthComparisons(TruthFigures):
    """The points as measured, and after the rigid motion that fits them best to the truth."""

    after_best_fit: TruthFigures | None = None


class Judged(_Stored):
    """An evaluation file; ``calibration`` is the digest of the one with which the cloud was made."""

    cloud: str
    sensor: str | None = None
    medium: str | None = None
    medium_index: float | None = None
    calibration: str | None = None
    artefact: Artefact | None = None
    evaluation: ArtefactFigures | None = None
    truth: TruthComparisons | None = None


def read_judged(path: Path) -> Judged:
    """Read an evaluation file; CaptureError where it is foreign, damaged or lacks what the report shows."""
    content: dict[str, Any] = read_evaluation(path)
    try:
        return Judged.model_validate(content)
    except ValidationError as error:
        details = "; ".join(f"{'.'.join(map(str, p['loc']))}: {p['msg']}" for p in error.errors())
        raise CaptureError(f"{path} is damaged: {details}; evaluate the cloud again") from error
