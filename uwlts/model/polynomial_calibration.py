"""Calibration by the polynomial reference method: two polynomials for each profile line, stored as JSON."""

import json
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, model_validator

from uwlts.argument_types import check_arguments
from uwlts.files.json_files import add_seal
from uwlts.files.writing import require_ending, write_atomically
from uwlts.model.calibration import Residuals
from uwlts.model.sensor import Description, Medium, Positive, Rows, Table
from uwlts.model.short_text import Brief

FORMAT, VERSION = "uwlts-polynomials", 1
Pair = tuple[float, float]


class PolynomialCalibration(Brief, Description):
    """Sensor calibrated by polynomials for each line: stripe position to Z, and Z to Y (thesis section 4.7).

    The calibration is valid only in its own medium, with the same window, and within the range of its evidence.

    Both Legendre polynomials of a line have the degree ``degree``. ``depth_coefficients`` (Z of position) and
    ``along_coefficients`` (Y of Z) have one row of coefficients in mm for each line; the first row belongs to
    ``first_line``. In all lines, the arguments -1 to 1 correspond to ``position_range_px`` (stripe position) and
    ``depth_range_mm`` (Z in the OCS). ``domains_px`` is the calibrated range of stripe positions of each line, None for
    a line without calibration.
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
        """Always None: polynomials come without a joint estimate."""

    @model_validator(mode="after")
    def _check_consistency(self) -> "PolynomialCalibration":
        count, lines = len(self.domains_px), self.width_px if self.stripe_along == "width" else self.height_px
        if not 0 < count <= lines - self.first_line:
            raise ValueError(f"{count} lines from line {self.first_line} on do not fit an image of {lines} lines")
        for name in ("depth_coefficients", "along_coefficients"):
            if [*map(len, getattr(self, name))] != [self.degree + 1] * count:
                expected = f"{count} rows of {self.degree + 1} numbers"
                raise ValueError(f"{name} must have {expected}, as domains_px and degree")
        for name in ("position_range_px", "depth_range_mm"):
            low, high = getattr(self, name)
            if not low < high:
                raise ValueError(f"{name} must increase; found {low:g} to {high:g}")
        low, high = self.position_range_px
        known = [domain for domain in self.domains_px if domain is not None]
        if not known or not all(low <= a <= b <= high for a, b in known):
            raise ValueError("domains_px must have increasing ranges within position_range_px")
        return self

    @check_arguments
    def save(self, path: str | Path, *, overwrite: bool = False) -> None:
        """Write the calibration as JSON, completely or not at all; OutputError if that fails."""
        # One line for each key; with indentation, each of thousands of coefficients would take a line.
        require_ending(Path(path), (".json",))
        content = add_seal({"format": FORMAT, "version": VERSION} | self.model_dump(mode="json"))
        lines = ",\n".join(f"  {json.dumps(key)}: {json.dumps(value)}" for key, value in content.items())
        with write_atomically(path, overwrite=overwrite) as aside:
            aside.write_text(f"{{\n{lines}\n}}\n", encoding="utf-8")

    def figures(self, step: str) -> Table:
        """Return the figures of a calibration step; an empty table if there are none."""
        return self.residuals.get(step, {})

    def medium_index(self, medium: Medium) -> float:
        """Return the index of a medium at the laser's wavelength, relative to air; RangeError outside the formula."""
        return medium.refractive_index(self.wavelength_nm)

    def domains(self) -> np.ndarray:
        """Return ``domains_px`` as an array (L, 2) with NaN for None."""
        return np.array([(np.nan, np.nan) if domain is None else domain for domain in self.domains_px])
