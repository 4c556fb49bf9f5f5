"""What every evaluation of an artefact returns."""

import dataclasses
from abc import ABC, abstractmethod
from typing import Any, ClassVar

import numpy as np

from uwlts.metrology.robust_fit import VDI_OUTLIER_SHARE

TOWARDS_SENSOR = np.array([0.0, 0.0, -1.0])
"""Direction from a surface to the sensor in the object coordinate system."""


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class Evaluation(ABC):
    """Named figures and the account of the points.

    Attributes
    ----------
    points_used : int
        Points on which the figures rest.
    points_rejected : int
        Stray points on the artefact that were left out (`fit_robustly`); other points of the cloud, which do not
        belong to the artefact, are in neither number.
    deviation_mm : (N,)
        Signed deviation of every used point of the cloud; NaN for all others.
    """

    kind: ClassVar[str]

    points_used: int
    points_rejected: int
    deviation_mm: np.ndarray

    @property
    def rejected_share(self) -> float:
        """Share of the artefact's points that were left out."""
        return self.points_rejected / (self.points_used + self.points_rejected)

    @property
    def within_vdi_outliers(self) -> bool:
        """Whether no more points were left out than the 3 permille that VDI/VDE 2634 allows."""
        return self.rejected_share <= VDI_OUTLIER_SHARE

    @property
    @abstractmethod
    def figures_mm(self) -> dict[str, float]:
        """The figures by which artefacts are judged, by name, mm."""

    def as_dict(self) -> dict[str, Any]:
        """Everything but the deviations of the single points, as plain JSON."""
        fields = {field.name: _plain(getattr(self, field.name)) for field in dataclasses.fields(self)}
        del fields["deviation_mm"]
        return {
            "kind": self.kind,
            "figures_mm": self.figures_mm,
            "points_total": len(self.deviation_mm),
            **fields,
            "rejected_share": self.rejected_share,
            "within_vdi_outliers": self.within_vdi_outliers,
        }


def spread_mm(residuals_mm: np.ndarray) -> float:
    """Range of residuals: largest less smallest (PE and RE of VDI/VDE 2634)."""
    return float(np.ptp(residuals_mm))


def _plain(value: Any) -> Any:
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {field.name: _plain(getattr(value, field.name)) for field in dataclasses.fields(value)}
    if isinstance(value, tuple):
        return [_plain(item) for item in value]
    return value.tolist() if isinstance(value, np.ndarray | np.generic) else value
