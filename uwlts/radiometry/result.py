"""Result of `uwlts.fit_radiometry`: estimates and their files."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from uwlts.argument_types import check_arguments
from uwlts.files.json_files import json_text
from uwlts.files.writing import require_ending, write_atomically
from uwlts.model.sensor import Sensor, Table
from uwlts.model.short_text import Brief

FORMAT, VERSION = "uwlts-radiometry", 1


@dataclass(frozen=True)
class ImageEstimate:
    """Estimate with its standard uncertainty, unit and meaning; not determined if the images contradict its model."""

    name: str
    value: float
    std: float
    unit: str
    meaning: str
    determined: bool = True

    def line(self) -> str:
        """Return the estimate as text."""
        text = f"{self.meaning}: {format_value(self.value, self.std)} {self.unit}".rstrip()
        return text if self.determined else f"{text} (not determined)"


@dataclass(frozen=True)
class PartFit:
    """Fit of the model to a part of the images, which ``names`` of estimates follow from.

    ``misfit`` is the rms of the residuals divided by the largest one that the model explains; ``finding`` states it.
    """

    part: str
    misfit: float
    finding: str
    names: tuple[str, ...]

    def line(self) -> str:
        """Return the fit as text."""
        return f"{self.part}: {self.misfit:.2f}" + (f", not explained: {self.finding}" if self.misfit > 1 else "")


@dataclass(frozen=True)
class Outlook:
    """Water at a glance for the operator.

    ``attenuation_per_m`` and ``scattering_per_m`` are None if the scan does not determine them. ``reach_mm`` is the
    depth outside the window to which the stripe is found at the exposure ``exposure_ms``, ``view_mm`` the depth at
    which the sheet leaves the view. ``advised_exposure_ms`` brings the brightest stripe to the sensor's
    ``exposure.auto_level``.
    """

    attenuation_per_m: float | None
    scattering_per_m: float | None
    reach_mm: float
    view_mm: float
    exposure_ms: float
    advised_exposure_ms: float

    def lines(self) -> list[str]:
        """Return the outlook as text."""
        water, halo = "attenuation not determined by this scan", "not determined by this scan"
        if self.scattering_per_m is not None:
            halo = f"{self.scattering_per_m:.2f}/m"
        if self.attenuation_per_m is not None:
            water = f"attenuation {self.attenuation_per_m:.2f}/m"
            if self.attenuation_per_m > 0:
                water += f" (light falls to a tenth in {math.log(10) / self.attenuation_per_m:.1f} m)"
        whole = self.reach_mm >= self.view_mm - 1.0
        reach = f"the whole view, {self.view_mm:.0f} mm" if whole else f"{self.reach_mm:.0f} of {self.view_mm:.0f} mm"
        found = f"at {self.exposure_ms:.3g} ms the stripe is found to a depth of {reach}"
        return [f"water: {water}, scattering {halo}", f"{found}; use {self.advised_exposure_ms:.3g} ms"]


@dataclass(frozen=True, eq=False, repr=False)
class Radiometry(Brief):
    """Light, water and noise fitted to the images of a scan.

    Attributes
    ----------
    date : str
        Date and time of the fit, UTC.
    sensor : Sensor
        Description with the calibrated geometry and the fitted values.
    medium_name : str
        Medium of the scan in the description.
    reflectance : float
        Reflectance by which the fitted product of power and reflectance was divided.
    estimates : tuple of ImageEstimate
    correlation : (P, P) float64
        Correlation of the first P estimates, those of the stripe.
    parts : tuple of PartFit
        Fit of each part of the images: light along the stripe, halo, background, and noise of repeated images.
    not_separable : tuple of str
        Quantities that the images do not separate.
    outlook : Outlook
    sources : dict
        Digests of capture and calibration.
    path_mm : (float, float)
        Shortest and longest path of the light in the water.
    """

    date: str
    sensor: Sensor
    medium_name: str
    reflectance: float
    estimates: tuple[ImageEstimate, ...]
    correlation: np.ndarray
    parts: tuple[PartFit, ...]
    not_separable: tuple[str, ...]
    outlook: Outlook
    sources: Table
    path_mm: tuple[float, float]

    def __getitem__(self, name: str) -> ImageEstimate:
        """Return an estimate by name."""
        return next(each for each in self.estimates if each.name == name)

    def lines(self) -> list[str]:
        """Return the result as text."""
        low, high = self.path_mm
        return [
            *self.outlook.lines(),
            f"from paths of {low:.0f} to {high:.0f} mm in the water:",
            *(f"  {each.line()}" for each in self.estimates),
            "misfit of each part of the images (up to 1: the model explains it):",
            *(f"  {each.line()}" for each in self.parts),
            "not separable in these images:",
            *(f"  {text}" for text in self.not_separable),
        ]

    def record(self) -> Table:
        """Return everything but the sensor as JSON."""
        content: Any = {
            "format": FORMAT,
            "version": VERSION,
            "date": self.date,
            "sources": self.sources,
            "medium": self.medium_name,
            "reflectance": self.reflectance,
            "estimates": [asdict(each) for each in self.estimates],
            "correlation": self.correlation.tolist(),
            "parts": [asdict(each) for each in self.parts],
            "not_separable": list(self.not_separable),
            "outlook": asdict(self.outlook),
            "path_mm": list(self.path_mm),
        }
        return content

    @check_arguments
    def save(self, path: str | Path, *, overwrite: bool = False) -> None:
        """Write the description of the sensor as TOML, and everything else as JSON beside it.

        Both are written completely or not at all; OutputError if that fails.
        """
        import tomli_w

        require_ending(Path(path), (".toml",))
        source: Any = self.sources["capture"]
        head = [
            f"{self.sensor.name}: fitted to images by uwlts radiometry, {self.date}",
            f"capture {source['file']}, SHA-256 {source['sha256']}",
            f"calibration {self.sources['calibration']}; reflectance of the surface taken as {self.reflectance:g}",
            *(each.line() for each in (*self.estimates, *self.parts)),
            *(f"not separable: {text}" for text in self.not_separable),
        ]
        table = self.sensor.model_dump(mode="json", exclude_none=True)  # TOML cannot express None
        text = "".join(f"# {line}\n" for line in head) + "\n" + tomli_w.dumps(table)
        with (
            write_atomically(Path(path).with_suffix(".json"), overwrite=overwrite) as record,
            write_atomically(path, overwrite=overwrite) as description,
        ):
            record.write_text(json_text(self.record(), indent=1), encoding="utf-8")
            description.write_text(text, encoding="utf-8")


def format_value(value: float, std: float) -> str:
    """Return a value with its standard uncertainty to two digits, as in 0.832 ± 0.014."""
    if not (math.isfinite(std) and std > 0):
        return f"{value:.4g}"
    digits = max(0, 1 - math.floor(math.log10(std)))
    return f"{value:.{digits}f} ± {std:.{digits}f}"
