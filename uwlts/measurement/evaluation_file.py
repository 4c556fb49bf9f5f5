"""The evaluation file: figures of a cloud's evaluation, as JSON."""

from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, SerializerFunctionWrapHandler, model_serializer

from uwlts.metrology.evaluation import FigureKey, figure_keys
from uwlts.model.artefacts import Artefact
from uwlts.storage.files import read_model

FORMAT = "uwlts-evaluation"
VERSION = 1
Count = Annotated[int, Field(ge=0)]


class _Stored(BaseModel):
    # The results of each kind of artefact, and what newer versions may add, are kept as they are.
    model_config = ConfigDict(frozen=True, extra="allow", allow_inf_nan=False)


class ArtefactFigures(_Stored):
    """Figures of an artefact's evaluation by name, mm, the numbers of points, and the kind's own results."""

    kind: str
    figures_mm: dict[str, float]
    points_total: Count
    points_used: Count
    points_rejected: Count
    within_vdi_outliers: bool

    @model_serializer(mode="wrap")
    def _verdict_last(self, plain: SerializerFunctionWrapHandler) -> dict[str, Any]:
        content = plain(self)
        content["within_vdi_outliers"] = content.pop("within_vdi_outliers")
        return content


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


class StoredUncertainty(_Stored):
    """Standard uncertainties of a figure, mm, and the expanded one (k = 2) of both together."""

    random_mm: float
    systematic_mm: float
    expanded_mm: float


class EvaluationRecord(_Stored):
    """Content of an evaluation file; ``calibration`` is the digest of the one with which the cloud was made."""

    cloud: str
    capture: str | None = None
    sensor: str | None = None
    medium: str | None = None
    medium_index: float | None = None
    artefact: Artefact | None = None
    calibration: str | None = None
    evaluation: ArtefactFigures | None = None
    truth: TruthComparisons | None = None
    uncertainty: dict[str, StoredUncertainty] = {}

    def figure_keys(self) -> dict[str, FigureKey]:
        """Keys of the artefact's figures by name; empty where the file names no artefact."""
        return {} if self.artefact is None else {key.name: key for key in figure_keys(self.artefact)}

    @model_serializer(mode="wrap")
    def _as_given(self, plain: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Without the keys that were not given: a cloud of another program has no metadata."""
        return {key: value for key, value in plain(self).items() if key in self.model_fields_set}


def read_evaluation(path: str | Path) -> EvaluationRecord:
    """Read an evaluation file; CaptureError where it is missing, foreign, newer or damaged."""
    advice = "; evaluate the cloud again"
    return read_model(path, EvaluationRecord, format=FORMAT, version=VERSION, called="evaluation", advice=advice)
