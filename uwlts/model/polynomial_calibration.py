"""The polynomial reference method's calibration: two polynomials for each profile line, stored as JSON."""

import json
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, model_validator

from uwlts.files.writing import written_aside
from uwlts.model.brief import Brief
from uwlts.model.calibration import Residuals
from uwlts.model.sensor import Description, Medium, Positive, Table

FORMAT, VERSION = "uwlts-polynomials", 1
Pair = tuple[float, float]
Rows = tuple[tuple[float, ...], ...]


class PolynomialCalibration(Brief, Description):
    """A sensor calibrated by polynomials (thesis, section 4.7): stripe position to Z, and Z to Y, for each line.

    It holds in the medium and with the window it was made with, and only where its evidence reached. Both polynomials
    of a line are of ``degree``; the first row is the line ``first_line``. On ``position_range_px`` and
    ``depth_range_mm``, of the stripe position and of Z in the OCS, the arguments of the Legendre polynomials run from
    -1 to 1 in all lines.
    ``domains_px`` has for each line the range of stripe positions that was calibrated, None for a line without any;
    ``depth_coefficients`` and ``along_coefficients`` have a row of Legendre coefficients in mm for each line, of
    Z(position) and of Y(Z).
    """

    sensor_name: str
    stripe_along: Literal["width", "height"]
    wavelength_nm: Positive
    medium_name: str
    medium: Medium
    window_mounted: bool
    width_px: Annotated[int, Field(gt=0)]
    height_px: Annotated[int, Field(gt=0)]
    degree: Annotated[int, Field(ge=1)]
    first_line: Annotated[int, Field(ge=0)]
    position_range_px: Pair
    depth_range_mm: Pair
    domains_px: tuple[Pair | None, ...]
    depth_coefficients: Rows
    along_coefficients: Rows
    residuals: Residuals = {}
    provenance: Table = {}

    @property
    def joint(self) -> None:
        """Polynomials hold no joint estimate."""

    @model_validator(mode="after")
    def _consistent(self) -> "PolynomialCalibration":
        count, lines = len(self.domains_px), self.width_px if self.stripe_along == "width" else self.height_px
        if not 0 < count <= lines - self.first_line:
            raise ValueError(f"{count} lines from line {self.first_line} on do not lie in an image of {lines} lines")
        for name in ("depth_coefficients", "along_coefficients"):
            if [*map(len, getattr(self, name))] != [self.degree + 1] * count:
                expected = f"{count} rows of {self.degree + 1} numbers"
                raise ValueError(f"{name} must have {expected}, as domains_px and degree")
        for name in ("position_range_px", "depth_range_mm"):
            low, high = getattr(self, name)
            if not low < high:
                raise ValueError(f"{name} must grow, not go from {low:g} to {high:g}")
        low, high = self.position_range_px
        known = [domain for domain in self.domains_px if domain is not None]
        if not known or not all(low <= a <= b <= high for a, b in known):
            raise ValueError("domains_px must name ranges that grow and lie within position_range_px")
        return self

    def save(self, path: str | Path, *, overwrite: bool = False) -> None:
        """Write the calibration as JSON, whole or not at all; OutputError if that fails."""
        # One key a line: indented, the thousands of coefficients would take a line each.
        content = {"format": FORMAT, "version": VERSION} | self.model_dump(mode="json")
        lines = ",\n".join(f"  {json.dumps(key)}: {json.dumps(value)}" for key, value in content.items())
        with written_aside(path, overwrite=overwrite) as aside:
            aside.write_text(f"{{\n{lines}\n}}\n", encoding="utf-8")

    def figures(self, step: str) -> Table:
        """Figures of a step among the residuals; none where there are none of it."""
        return self.residuals.get(step, {})

    def index_of(self, medium: Medium) -> float:
        """Refractive index of a medium at the laser's wavelength, relative to air; RangeError where it has none."""
        return medium.refractive_index(self.wavelength_nm)

    def domains(self) -> np.ndarray:
        """``domains_px`` as an array (L, 2), NaN for None."""
        return np.array([(np.nan, np.nan) if domain is None else domain for domain in self.domains_px])
