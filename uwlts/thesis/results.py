"""Results of campaigns in their folders: measurements, window study and budget."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal, Self

from pydantic import BaseModel, ConfigDict

from uwlts.errors import CaptureError
from uwlts.files.json_files import json_text, read_json, validate_content
from uwlts.files.writing import write_atomically

Points = list[tuple[float, float]]
"""Y and Z of points on a profile, mm."""


class _Kept(BaseModel):
    """File of a campaign's folder."""

    model_config = ConfigDict(frozen=True)

    @classmethod
    def read_file(cls, path: Path) -> Self:
        """Read the file; raises CaptureError if it cannot be read, is damaged or has another version."""
        advice = "; remove it to evaluate the campaign again"
        try:
            content = read_json(path, called="file of results")
        except CaptureError as error:
            raise CaptureError(f"{error}{advice}") from error
        return validate_content(cls, content, f"{path} contains no results that this program can read", advice=advice)

    def keep(self, path: Path) -> Self:
        """Write the file atomically; ValueError if a number is not finite."""
        with write_atomically(path, overwrite=True) as aside:
            aside.write_text(json_text(self.model_dump()), encoding="utf-8")
        return self


@dataclass(frozen=True)
class Measurement:
    """Figures of one scan by one method and image processing, mm; ``failure`` is the reason for missing ones."""

    thing: str
    placement: str
    medium: str
    method: str
    processing: str
    figures_mm: dict[str, float]
    points: int = 0
    failure: str | None = None


@dataclass(frozen=True)
class WindowChoice:
    """Window distance from some step images, and the resulting mean absolute sphere spacing error.

    ``images`` is the place and the image's number (from 1), the place alone, or "all". The numbers are None if the
    images determine no distance within the bounds.
    """

    images: str
    distance_mm: float | None
    mean_sse_mm: float | None


@dataclass(frozen=True)
class WindowProfile:
    """Step image through a window at a distance (Figure 45)."""

    distance_mm: float
    points_mm: Points


@dataclass(frozen=True)
class LineProfile:
    """Stripe on the pipe, and its length along Y (Figure 67)."""

    length_mm: float
    points_mm: Points


@dataclass(frozen=True)
class PolynomialLine:
    """Stripe position, Y and Z along one profile line."""

    line: int
    centre_px: list[float]
    y_mm: list[float]
    z_mm: list[float]


@dataclass(frozen=True)
class PolynomialCurves:
    """Z(v) and Y(Z) of some profile lines by name (Figures 58 and 59), and the residual of Z."""

    lines: dict[str, PolynomialLine]
    residual_mm: float


@dataclass(frozen=True)
class SpacingInterval:
    """Error of the sphere spacing in a scan, with standard uncertainty and 95 % interval from Monte-Carlo trials."""

    placement: str
    observed_mm: float
    std_mm: float
    interval_mm: tuple[float, float]
    contains_truth: bool


class CampaignResults(_Kept):
    """Results of one campaign: the file results.json."""

    format: Literal["uwlts-thesis-results"] = "uwlts-thesis-results"
    version: Literal[1] = 1
    measurements: list[Measurement]
    window: dict[str, WindowChoice]
    window_profiles: list[WindowProfile]
    two_refractions_distance_mm: float
    polynomials: dict[str, PolynomialCurves]
    budget: dict[str, float]
    line_profiles: dict[str, LineProfile]
    monte_carlo: list[SpacingInterval]
    trials: int
