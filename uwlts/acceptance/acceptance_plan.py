"""Plan of an acceptance test: artefacts with certificates, maximum permissible errors, and what is to be measured."""

from pathlib import Path
from typing import Annotated, Literal, assert_never, get_args

from pydantic import Field, model_validator

from uwlts.model.artefacts import Artefact, PipeStandard, PlaneStandard, SphereStandard, StepStandard
from uwlts.model.library import read_table, validate_description
from uwlts.model.sensor import Description, NotNegative

Symbol = Literal["PF", "PF95", "PS", "SD", "F", "F95", "E"]
"""Symbols of the characteristics, as in the names of the permissible errors."""
SYMBOLS: tuple[Symbol, ...] = get_args(Symbol)

Length = Annotated[float, Field(ge=-1e6, le=1e6)]
"""Length or coordinate in mm: larger ones than a kilometre are damage."""
Size = Annotated[float, Field(ge=1e-6, le=1e6)]
"""Positive length in mm, between a nanometre and a kilometre."""
Spread = Annotated[float, Field(ge=0, le=1e6)]
"""Uncertainty in mm, or growth of a limit in mm/m."""

REFERENCE_C = 20.0
"""Reference temperature of lengths (ISO 1)."""

DecisionRule = Literal["U", "1.65 u", "simple"]
"""Rule that decides on conformity: guard bands of U or 1.65 u, or none."""

Interval = tuple[Length, Length]
"""Lower and upper end of a coordinate, mm."""


class PermissibleErrors(Description):
    """Maximum permissible errors, mm, as the maker or the user states them; None: not stated.

    ``PF`` and ``PF95`` limit the probing error of form, by all points and by 95 % of them. ``PS`` limits the probing
    error of size, ``SD`` the sphere-spacing error, ``F`` and ``F95`` the flatness measurement error, and ``E`` the
    error of the step's height. ``SD`` and ``E`` may grow with the length: ``SD_mm_per_m`` and ``E_mm_per_m`` are added
    for each metre (the form A + L / K of ISO 10360).
    """

    PF_mm: Size | None = None
    PF95_mm: Size | None = None
    PS_mm: Size | None = None
    SD_mm: Size | None = None
    F_mm: Size | None = None
    F95_mm: Size | None = None
    E_mm: Size | None = None
    SD_mm_per_m: Spread = 0.0
    E_mm_per_m: Spread = 0.0

    @model_validator(mode="after")
    def _check_parts(self) -> "PermissibleErrors":
        for symbol in ("SD", "E"):
            if getattr(self, f"{symbol}_mm_per_m") and getattr(self, f"{symbol}_mm") is None:
                raise ValueError(f"{symbol}_mm_per_m needs {symbol}_mm, the limit for short lengths")
        return self

    def of(self, symbol: Symbol) -> float | None:
        """Return the maximum permissible error of a characteristic, mm; None if it is not stated."""
        return getattr(self, f"{symbol}_mm")

    def per_metre(self, symbol: Symbol) -> float:
        """Return the growth of the maximum permissible error with the length, mm/m."""
        return getattr(self, f"{symbol}_mm_per_m", 0.0)


class CertifiedArtefact(Description):
    """Artefact of a test, as its certificate states it.

    Attributes
    ----------
    standard : Artefact
        Kind and calibrated sizes at 20 °C with expanded uncertainties (k = 2), as for `evaluate`.
    certificate : str, optional
        Number of the certificate.
    form_mm, form_uncertainty_mm : float, optional
        Form error of the spheres or flatness of the plane, and its expanded uncertainty (k = 2).
    alignment_uncertainty_mm : float
        Expanded uncertainty (k = 2) of the sizes by alignment and mounting in the test.
    expansion_per_k, expansion_uncertainty_per_k : float, optional
        Thermal expansion coefficient and its expanded uncertainty (k = 2).
    margin_mm : float, optional
        Largest distance of a point from the surface. By default a tenth of a sphere's diameter, and a twentieth of the
        volume's diagonal for a plane.
    """

    standard: Artefact
    certificate: str | None = None
    form_mm: NotNegative | None = None
    form_uncertainty_mm: NotNegative = 0.0
    alignment_uncertainty_mm: NotNegative = 0.0
    expansion_per_k: NotNegative | None = None
    expansion_uncertainty_per_k: NotNegative = 0.0
    margin_mm: Size | None = None

    @model_validator(mode="after")
    def _check_kind(self) -> "CertifiedArtefact":
        if isinstance(self.standard, PipeStandard):
            raise ValueError("a pipe is no artefact of an acceptance test; give spheres, a plane or a step")
        return self

    def stated_form_mm(self) -> float | None:
        """Return the form error of the artefact's surfaces, mm; None if the certificate states none."""
        flatness = self.standard.flatness_mm if isinstance(self.standard, PlaneStandard) else None
        return flatness if self.form_mm is None else self.form_mm

    def at_temperature(self, temperature_c: float | None) -> Artefact:
        """Return the standard with its sizes at a temperature; unchanged if that or the expansion is not stated."""
        if temperature_c is None or self.expansion_per_k is None:
            return self.standard
        factor = 1.0 + self.expansion_per_k * (temperature_c - REFERENCE_C)
        match self.standard:
            case SphereStandard():
                sizes = {
                    "diameters_mm": tuple(factor * each for each in self.standard.diameters_mm),
                    "spacings_mm": tuple(factor * each for each in self.standard.spacings_mm),
                }
            case StepStandard():
                sizes = {"height_mm": factor * self.standard.height_mm}
            case PlaneStandard() | PipeStandard():
                sizes = {}
            case _:
                assert_never(self.standard)
        return self.standard.model_copy(update=sizes)


class Temperature(Description):
    """Temperature of the artefacts in the test, and its expanded uncertainty (k = 2)."""

    value_c: float
    uncertainty_k: NotNegative = 0.0


class PlannedPosition(Description):
    """Position of an artefact: its name in the plan, and the file of its capture or cloud, beside the plan.

    ``region_mm`` are the intervals of X, Y and Z that contain nothing but the artefact; by default everything.
    """

    name: str
    artefact: str
    file: str
    region_mm: tuple[Interval, Interval, Interval] | None = None

    @model_validator(mode="after")
    def _check_region(self) -> "PlannedPosition":
        for axis, (low, high) in zip("XYZ", self.region_mm or (), strict=False):
            if low >= high:
                raise ValueError(f"region_mm: the interval of {axis} is {low:g} to {high:g}; expected an increase")
        return self


class AcceptancePlan(Description):
    """Plan of an acceptance test, read from TOML.

    Attributes
    ----------
    title, sensor, client, operator : str
        Statements for the page.
    calibration : str, optional
        File of the sensor's calibration, beside the plan; captures need it.
    volume_mm : (float, float, float)
        Size of the measuring volume along X, Y and Z.
    decision_rule : {"U", "1.65 u", "simple"}
        Guard band of the decisions: the expanded uncertainty U (k = 2), 1.65 u of ISO 14253-1:2017, or none.
    mpe : PermissibleErrors
    temperature : Temperature, optional
    artefacts : dict
        `CertifiedArtefact` by name.
    positions : tuple of PlannedPosition
        What is to be measured, in this order.
    """

    title: str
    sensor: str | None = None
    client: str | None = None
    operator: str | None = None
    calibration: str | None = None
    volume_mm: tuple[Size, Size, Size]
    decision_rule: DecisionRule = "U"
    mpe: PermissibleErrors = Field(default_factory=PermissibleErrors)
    temperature: Temperature | None = None
    artefacts: dict[str, CertifiedArtefact]
    positions: tuple[PlannedPosition, ...] = Field(min_length=1)

    @model_validator(mode="after")
    def _check_names(self) -> "AcceptancePlan":
        names, files = [each.name for each in self.positions], [each.file for each in self.positions]
        for listed, what in ((names, "name"), (files, "file")):
            if twice := sorted({each for each in listed if listed.count(each) > 1}):
                raise ValueError(f"two positions have the {what} {twice[0]!r}; each position needs its own")
        if unknown := sorted({each.artefact for each in self.positions} - self.artefacts.keys()):
            raise ValueError(
                f"a position names the artefact {unknown[0]!r}; the plan has {', '.join(sorted(self.artefacts))}"
            )
        return self

    def margin_mm(self, artefact: CertifiedArtefact) -> float:
        """Return the largest distance of a point from an artefact's surface, mm."""
        if artefact.margin_mm is not None:
            return artefact.margin_mm
        standard = artefact.standard
        return min(standard.diameters_mm) / 10 if isinstance(standard, SphereStandard) else self.diagonal_mm() / 20

    def diagonal_mm(self) -> float:
        """Return the diagonal of the measuring volume (L0 of VDI/VDE 2634)."""
        return sum(each**2 for each in self.volume_mm) ** 0.5


def load_plan(path: str | Path) -> AcceptancePlan:
    """Read a plan; DescriptionError if the file is missing or not a plan."""
    return validate_description(AcceptancePlan, read_table(Path(path)), path)
