"""Description of a sensor from drawings and data sheets, read from TOML and validated when made.

All values are nominal. Lengths are in mm. The camera frame has x to the right, y down, z along the optical axis, and
its origin at the entrance pupil. All refractive indices are relative to air.
"""

import math
from itertools import pairwise
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    JsonValue,
    field_validator,
    model_validator,
)
from pydantic_core import to_jsonable_python

from uwlts.errors import DescriptionError
from uwlts.files.reading import require_plain
from uwlts.model import media, phase_functions
from uwlts.model.short_text import Brief

Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]
Vector = tuple[float, float, float]

_Length = Annotated[float, Field(ge=1e-6, le=1e6)]
"""A length of a sensor in mm: from 1 nm to 1 km, so that no product of lengths leaves the range of numbers."""

_Coordinate = Annotated[float, Field(ge=-1e6, le=1e6)]
"""A coordinate in an image in px; shifted lenses have principal points far outside the image."""


def _check_unit(vector: Vector) -> Vector:
    if not np.isclose(np.linalg.norm(vector), 1, atol=1e-6):
        raise ValueError(f"{vector} is not a unit vector")
    return vector


Rows = tuple[tuple[float, ...], ...]


def is_rigid(matrices: np.ndarray, *, within: float) -> bool:
    """Return whether matrices (..., 4, 4) are rigid transforms without reflection; ``within`` is the tolerance."""
    rotation = matrices[..., :3, :3]
    if not (np.abs(rotation) < 2).all() or not np.isfinite(matrices).all():
        return False
    square = np.allclose(rotation @ np.swapaxes(rotation, -1, -2), np.eye(3), atol=within)
    last = np.allclose(matrices[..., 3, :], (0, 0, 0, 1), atol=within)
    return square and last and bool((np.linalg.det(rotation) > 0).all())


def _check_rigid(rows: Rows) -> Rows:
    """Raise ValueError unless the rows are a rigid transform (4, 4) to 1e-6 (text may be rounded)."""
    if [*map(len, rows)] == [4] * 4 and is_rigid(np.array(rows), within=1e-6):
        return rows
    raise ValueError("must be a 4x4 rigid transform: rotation, translation, and last row 0 0 0 1")


RigidTransform = Annotated[Rows, AfterValidator(_check_rigid)]
UnitVector = Annotated[Vector, AfterValidator(_check_unit)]

_INDEX_FORMULA = 1.5e-5  # uncertainty of the formula for the index of water, as stated by Quan and Fry (1995)


Table = Annotated[dict[str, JsonValue], BeforeValidator(to_jsonable_python), AfterValidator(require_plain)]
"""A table of a TOML or JSON file; code that uses it checks its content."""


def to_rows(matrix: np.ndarray) -> tuple[tuple[Any, ...], ...]:
    """Return the rows of a matrix as descriptions contain them."""
    return tuple(map(tuple, matrix.tolist()))


class Description(BaseModel):
    """Base class of all descriptions: frozen; rejects unknown keys and numbers that are not finite."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class Window(Description):
    """Flat window in front of a module (camera or laser).

    ``distance_mm`` is measured along the module's axis from its origin to the inner face. The normal is the module's
    axis, rotated by ``tilt_x_deg`` about the module's x axis, then by ``tilt_y_deg`` about its y axis. ``glass`` is a
    name in `uwlts.model.media.GLASSES` or a refractive index relative to air. Without a mounted window the module looks
    directly into the medium, which must be air.
    """

    distance_mm: _Length
    thickness_mm: _Length
    glass: str | Annotated[float, Field(gt=1, lt=4)]
    aperture_diameter_mm: _Length
    tilt_x_deg: Annotated[float, Field(gt=-45, lt=45)] = 0.0
    tilt_y_deg: Annotated[float, Field(gt=-45, lt=45)] = 0.0
    absorption_per_m: NotNegative | None = None
    mounted: bool = True

    @field_validator("glass")
    @classmethod
    def _check_glass(cls, value: str | float) -> str | float:
        if isinstance(value, str):
            media.find_glass(value)
        return value

    def index(self, wavelength_nm: float) -> float:
        """Return the refractive index of the glass relative to air."""
        name = self.glass
        return media.glass_index(name, wavelength_nm=wavelength_nm) if isinstance(name, str) else name

    def absorption_per_mm(self) -> float:
        """Return the absorption of the glass in 1/mm: the given value, else the named glass's at 635 nm, else 0."""
        if self.absorption_per_m is not None:
            return 1e-3 * self.absorption_per_m
        return 1e-3 * media.find_glass(self.glass).absorption_per_m if isinstance(self.glass, str) else 0.0

    def strength_mpa(self) -> float | None:
        """Return the fracture strength of the named glass in MPa; None if it is unknown."""
        return media.find_glass(self.glass).strength_mpa if isinstance(self.glass, str) else None

    def normal(self) -> np.ndarray:
        """Return the unit normal (3,) in the module's frame, directed away from the module."""
        x, y = math.radians(self.tilt_x_deg), math.radians(self.tilt_y_deg)
        return np.array([math.cos(x) * math.sin(y), -math.sin(x), math.cos(x) * math.cos(y)])


_Coefficient = Annotated[float, Field(ge=-1e9, le=1e9)]
"""Telephoto lenses have coefficients of several thousand, because r is small. The limit prevents overflow with r^6."""


class Distortion(Description):
    """Distortion coefficients in OpenCV's order: the Brown-Conrady model, or with k4, k5 and k6 the rational model.

    The radial factor is g = (1 + k1 r2 + k2 r4 + k3 r6) / (1 + k4 r2 + k5 r4 + k6 r6) with r2 = x2 + y2. The distorted
    image of (x, y) is x g + 2 p1 x y + p2 (r2 + 2 x2), y g + 2 p2 x y + p1 (r2 + 2 y2).
    """

    k1: _Coefficient = 0.0
    k2: _Coefficient = 0.0
    p1: _Coefficient = 0.0
    p2: _Coefficient = 0.0
    k3: _Coefficient = 0.0
    k4: _Coefficient = 0.0
    k5: _Coefficient = 0.0
    k6: _Coefficient = 0.0

    def is_rational(self) -> bool:
        """Return whether the radial factor is a rational function."""
        return self.k4 != 0 or self.k5 != 0 or self.k6 != 0

    def used_coefficients(self) -> dict[str, float]:
        """Return the coefficients of the model in use: five for Brown-Conrady, all eight for the rational model."""
        return self.model_dump(exclude=None if self.is_rational() else {"k4", "k5", "k6"})


class Camera(Description):
    """Image sensor and lens.

    ``focal_length_mm`` is the image distance of the pinhole model (camera constant). ``stripe_along`` is the direction
    of the laser stripe in the image: "width" (one peak per column, 1280 in the thesis's camera) or "height" (one peak
    per row, 1024). It also defines the side of the laser: above the camera (-y) for "width", to the right (+x) for
    "height". ``pixel_size_um`` is the width of a pixel, and ``pixel_aspect`` its width divided by its height.
    ``offset_px`` is the column and row of the images' first pixel on the image sensor, if known: images of the same
    size from another part of it have another principal point.
    """

    width_px: Annotated[int, Field(ge=16, le=20000)]
    height_px: Annotated[int, Field(ge=16, le=20000)]
    pixel_size_um: Annotated[float, Field(ge=0.1, le=1000)]
    pixel_aspect: Annotated[float, Field(ge=0.9, le=1.1)] = 1.0
    offset_px: tuple[Annotated[int, Field(ge=0, le=20000)], Annotated[int, Field(ge=0, le=20000)]] | None = None
    focal_length_mm: _Length
    principal_point_px: tuple[_Coordinate, _Coordinate] | None = None
    distortion: Distortion = Distortion()
    f_number: Annotated[float, Field(ge=0.1, le=1000)]
    focus_distance_mm: _Length
    stripe_along: Literal["width", "height"]
    window: Window

    def principal_point(self) -> tuple[float, float]:
        """Return the principal point in px, by default the image centre. Pixel (0, 0) is the first pixel's centre."""
        return self.principal_point_px or ((self.width_px - 1) / 2, (self.height_px - 1) / 2)

    def focal_length_px(self) -> float:
        """Return the focal length in pixels along x."""
        return 1e3 * self.focal_length_mm / self.pixel_size_um

    def focal_lengths_px(self) -> tuple[float, float]:
        """Return the focal lengths in pixels along x and y."""
        return self.focal_length_px(), self.pixel_aspect * self.focal_length_px()

    def working_f_number(self) -> float:
        """Return the f-number for the magnification m at the described focus: N (1 + m)."""
        return self.f_number * (1 + self.focal_length_mm / (self.focus_distance_mm - self.focal_length_mm))

    def corner_slope(self) -> float:
        """Return the slope in air of the rays to the image's corners, for a principal point in the image's centre."""
        fx, fy = self.focal_lengths_px()
        return math.hypot(self.width_px / fx, self.height_px / fy) / 2

    def lines(self) -> int:
        """Return the number of profile lines: image columns if the stripe runs along the width, else image rows."""
        return self.width_px if self.stripe_along == "width" else self.height_px


_POWELL_BEAM = 1.7
"""Squared radius of the beam at a Powell lens, relative to that of a flat line: the edges are 20 % brighter (assumed).
"""
_POWELL_NODES = 97  # linear interpolation between them is accurate to 1 % of the power in the middle
_LARGEST_LOBE = 200.0
"""Largest offset plus radius of side lobes in radii of the sheet, beyond which they would fill the image."""


class Laser(Description):
    """Laser that emits a sheet of light.

    It is placed either by ``baseline_mm`` and ``triangulation_angle_deg``, or by ``origin_mm`` and ``axis``. The
    baseline runs in the camera's x-y plane from the entrance pupil to the fan's origin. The angle is that between the
    camera's and the laser's axes. ``roll_deg`` rotates the fan about the laser's axis.

    ``waist_radius_mm`` is the 1/e^2 radius across the sheet at ``waist_distance_mm`` from the origin, in the medium of
    use. ``power_mw`` is the power behind the line optics. ``fan_profile`` is its distribution over the fan: "flat", a
    constant power per angle; "gaussian", exp(-2 (angle / half the fan)^2) up to the fan's edges; "powell", that of a
    Powell lens (`fan_table`); or pairs of an angle in deg and a relative power per angle, interpolated linearly and
    zero outside.

    ``side_lobes`` are weak Gaussian sheets parallel to the main one: stray light (a wide pedestal at the offset 0) and
    side lobes. Each is an offset towards the sheet's normal and a 1/e^2 radius, both in units of the main sheet's local
    radius, and a fraction of the power.

    ``bow_deg`` is the tilt of the beam at the line optics, which curves the line towards the sheet's normal (positive)
    or away from it. ``linewidth_nm`` is the full width at half maximum of the spectrum.
    """

    wavelength_nm: Annotated[float, Field(ge=400, le=700)]
    linewidth_nm: NotNegative = 0.0
    power_mw: Positive
    fan_angle_deg: Annotated[float, Field(gt=0, lt=120)]
    fan_profile: Literal["flat", "gaussian", "powell"] | tuple[tuple[float, float], ...] = "flat"
    side_lobes: tuple[tuple[float, Positive, Annotated[float, Field(gt=0, lt=1)]], ...] = ()
    bow_deg: Annotated[float, Field(gt=-10, lt=10)] = 0.0
    roll_deg: Annotated[float, Field(gt=-180, le=180)] = 0.0
    waist_radius_mm: _Length
    waist_distance_mm: _Length
    beam_quality_m2: Annotated[float, Field(ge=1, le=1e6)] = 1.0
    baseline_mm: _Length | None = None
    triangulation_angle_deg: Annotated[float, Field(gt=0, lt=90)] | None = None
    origin_mm: Vector | None = None
    axis: Vector | None = None
    window: Window

    @model_validator(mode="after")
    def _check_placement(self) -> "Laser":
        by_angle = (self.baseline_mm is not None, self.triangulation_angle_deg is not None)
        by_axis = (self.origin_mm is not None, self.axis is not None)
        if (all(by_angle), any(by_axis)) != (True, False) and (any(by_angle), all(by_axis)) != (False, True):
            raise ValueError("place the laser by baseline_mm and triangulation_angle_deg, or by origin_mm and axis")
        if self.axis is not None and np.linalg.norm(self.axis) < 1e-9:
            raise ValueError(f"axis is {self.axis}; expected a vector other than zero")
        return self

    @model_validator(mode="after")
    def _check_fan_profile(self) -> "Laser":
        if isinstance(self.fan_profile, str):
            return self
        if (count := len(self.fan_profile)) < 2:
            raise ValueError(f"fan_profile has {count} pairs of angle in deg and relative power: give at least two")
        angles, powers = zip(*self.fan_profile, strict=True)
        if any(b <= a for a, b in pairwise(angles)):
            raise ValueError(f"the angles of fan_profile must increase, found {angles} deg")
        if min(powers) < 0 or max(powers) == 0:
            raise ValueError(f"the powers of fan_profile must not be negative nor all zero, found {powers}")
        half = self.fan_angle_deg / 2
        if max(-angles[0], angles[-1]) > half:
            raise ValueError(
                f"fan_profile reaches from {angles[0]:g} to {angles[-1]:g} deg, but the fan only from {-half:g} to "
                f"{half:g} deg: widen fan_angle_deg or cut the profile"
            )
        return self

    @model_validator(mode="after")
    def _check_side_lobes(self) -> "Laser":
        if (total := math.fsum(share for _, _, share in self.side_lobes)) >= 1:
            raise ValueError(f"the fractions of side_lobes add up to {total:g}; the main sheet needs the rest of 1")
        if reach := [lobe for lobe in self.side_lobes if abs(lobe[0]) + lobe[1] > _LARGEST_LOBE]:
            raise ValueError(f"side_lobes {reach} reach farther than {_LARGEST_LOBE:g} radii of the sheet")
        return self

    def fan_table(self) -> tuple[tuple[float, float], ...]:
        """Return the tabulated power per angle of the fan: pairs of an angle in deg and a relative power.

        It is empty for the profiles "flat" and "gaussian". A Powell lens is a cylinder with a hyperbolic section
        (Powell, US patent 4826299). The slope of its surface at the height x is proportional to u = q / sqrt(1 + q^2),
        with q in proportion to x. The angle behind the lens is approximately u times half the fan. A Gaussian beam of
        the 1/e^2 radius q0 has the power per angle (1 - u^2)^(-3/2) exp(-2 u^2 / (q0^2 (1 - u^2))). It is flat in the
        middle for q0^2 = 4/3. A wider beam with q0^2 = 4/3 b raises it to b^(3/2) exp(3/2 (1/b - 1)) at u^2 = 1 - 1/b.
        Beyond that angle it falls to zero.
        """
        if self.fan_profile != "powell":
            return () if isinstance(self.fan_profile, str) else self.fan_profile
        half, squared = self.fan_angle_deg / 2, 4 / 3 * _POWELL_BEAM
        share = np.linspace(-1, 1, _POWELL_NODES)
        left = np.maximum(1 - share**2, 1e-3)
        power = left**-1.5 * np.exp(-2 * (1 / left - 1) / squared)
        return tuple(zip((half * share).tolist(), power.tolist(), strict=True))


AnyPhase = str | phase_functions.DescribedPhase | None


class Medium(Description):
    """Medium of a measurement: air, fresh or sea water with temperature and salinity, or custom with a given index.

    Water is pure by default. ``water`` selects a natural water of `uwlts.model.media`; ``turbidity`` interpolates from
    pure (0) over clear (1) and coastal (2) to harbour (3). ``absorption_per_m`` and ``scattering_per_m`` replace the
    resulting coefficients.

    ``phase`` is the phase function of the particles; scattering by water molecules is added. If ``scattering_per_m`` is
    given, ``phase`` applies to all scattering. It is a name in `uwlts.model.phase_functions.KINDS`, or a table with a
    ``kind`` and its parameters. The name "henyey-greenstein" uses ``asymmetry``. The name "fournier-forand" uses
    ``particle_index`` (relative to water) and ``particle_slope`` (of the size distribution), or ``backscatter_share``
    instead if it is given. The default is the phase function of the named ``water``, "petzold" with ``turbidity``, else
    "molecular".
    """

    kind: Literal["air", "fresh", "sea", "custom"]
    temperature_c: float = 20.0
    salinity_g_kg: NotNegative = 0.0
    index: Annotated[float, Field(ge=1, lt=2)] | None = None
    water: str | None = None
    turbidity: Annotated[float, Field(ge=0, le=3)] | None = None
    absorption_per_m: NotNegative | None = None
    scattering_per_m: NotNegative | None = None
    phase: AnyPhase = None
    asymmetry: phase_functions.Asymmetry = 0.924
    particle_index: phase_functions.ParticleIndex = 1.10
    particle_slope: phase_functions.ParticleSlope = 3.5835
    backscatter_share: phase_functions.BackscatterShare | None = None

    @field_validator("water")
    @classmethod
    def _check_water(cls, value: str | None) -> str | None:
        if value is not None and value not in media.WATERS:
            raise ValueError(f"unknown water; known are {', '.join(media.WATERS)}")
        return value

    @field_validator("phase")
    @classmethod
    def _check_phase(cls, value: AnyPhase) -> AnyPhase:
        if isinstance(value, str):
            phase_functions.phase_function_kind(value)
        elif value is not None:
            value.phase_function()
        return value

    @model_validator(mode="after")
    def _check_consistency(self) -> "Medium":
        if self.kind == "custom" and self.index is None:
            raise ValueError("a custom medium needs its index")
        if self.kind == "fresh" and self.salinity_g_kg > 0:
            raise ValueError(f"fresh water with salinity {self.salinity_g_kg:g} g/kg: use kind = 'sea'")
        if self.kind == "sea" and self.salinity_g_kg == 0:
            raise ValueError("sea water with salinity 0 g/kg: set salinity_g_kg, such as 35, or use kind = 'fresh'")
        if self.water is not None and self.turbidity is not None:
            raise ValueError(f"give water ('{self.water}') or turbidity ({self.turbidity:g}), not both")
        if self.kind == "air" and (self.water is not None or self.turbidity is not None):
            raise ValueError("air must have neither water nor turbidity: use kind = 'fresh', 'sea' or 'custom'")
        if self.kind in ("fresh", "sea") and self.index is None:
            self.refractive_index(635.0)
        return self

    def refractive_index(self, wavelength_nm: float) -> float:
        """Return the refractive index relative to air; RangeError outside the formula's range."""
        if self.index is not None or self.kind == "air":
            return self.index or 1.0
        state = {"temperature_c": self.temperature_c, "salinity_g_kg": self.salinity_g_kg}
        return media.water_index(wavelength_nm=wavelength_nm, **state)

    def index_per_kelvin(self, wavelength_nm: float) -> float:
        """Return the derivative of the index with respect to temperature, 1/K; 0 for a given index."""
        if self.index is not None or self.kind == "air":
            return 0.0
        # The formula is valid up to 30 degC.
        here = self.model_copy(update={"temperature_c": min(self.temperature_c, 29.0)})
        return here.warmer_by(1.0).refractive_index(wavelength_nm) - here.refractive_index(wavelength_nm)

    def index_uncertainty(self, wavelength_nm: float, uncertainty: "Uncertainty") -> float:
        """Return the standard uncertainty of the index, propagated from the temperature unless the index is given."""
        if self.index is not None or self.kind == "air":
            return uncertainty.index
        return math.hypot(self.index_per_kelvin(wavelength_nm) * uncertainty.temperature_k, _INDEX_FORMULA)

    def warmer_by(self, kelvin: float) -> "Medium":
        """Return the medium at a higher temperature."""
        return self.model_copy(update={"temperature_c": self.temperature_c + kelvin})

    def absorption_per_mm(self, wavelength_nm: float) -> float:
        """Return the absorption coefficient a in 1/mm; RangeError outside the tables."""
        if self.absorption_per_m is not None:
            return 1e-3 * self.absorption_per_m
        if not self._is_water():
            return 0.0
        pure = media.water_absorption_per_m(wavelength_nm=wavelength_nm)
        return 1e-3 * (pure + self._look_up_particles(wavelength_nm).absorption_per_m)

    def scattering_per_mm(self, wavelength_nm: float) -> float:
        """Return the scattering coefficient b in 1/mm; RangeError outside the tables."""
        return sum((part.coefficient_per_mm for part in self.scatterers(wavelength_nm)), 0.0)

    def scatterers(self, wavelength_nm: float) -> tuple[phase_functions.Scatterer, ...]:
        """Return the kinds of scatterers with their coefficients and phase functions; RangeError outside the tables."""
        if self.scattering_per_m is not None:
            parts = [(self.scattering_per_m, self._make_phase_function())]
        elif self._is_water():
            molecules = media.water_scattering_per_m(wavelength_nm=wavelength_nm, salinity_g_kg=self.salinity_g_kg)
            particles = self._look_up_particles(wavelength_nm).scattering_per_m
            parts = [(molecules, phase_functions.Molecular()), (particles, self._make_phase_function())]
        else:
            parts = []
        return tuple(phase_functions.Scatterer(1e-3 * b, phase) for b, phase in parts if b > 0)

    def _is_water(self) -> bool:
        """Return whether absorption and scattering follow from the properties of water."""
        return self.kind in ("fresh", "sea") or self.water is not None or self.turbidity is not None

    def _look_up_particles(self, wavelength_nm: float) -> media.Particles:
        if self.turbidity is not None:
            return media.particles_at(self.turbidity, wavelength_nm=wavelength_nm)
        return media.WATERS[self.water or "pure"].particles(wavelength_nm)

    def _make_phase_function(self) -> phase_functions.PhaseFunction:
        if isinstance(self.phase, phase_functions.DescribedPhase):
            return self.phase.phase_function()
        # The turbidity scale interpolates between Petzold's stations.
        name = self.phase or ("molecular" if self.turbidity is None else "petzold")
        if self.phase is None and self.water is not None:
            name = media.WATERS[self.water].phase
        parameters = {"asymmetry", "particle_index", "particle_slope", "backscatter_share"}
        keys = self.model_dump(include=parameters, exclude_none=True)
        return phase_functions.phase_function_kind(name).of_keys(keys)

    def extinction_per_mm(self, wavelength_nm: float) -> float:
        """Return the beam attenuation coefficient c = a + b in 1/mm."""
        return self.absorption_per_mm(wavelength_nm) + self.scattering_per_mm(wavelength_nm)


class Detector(Description):
    """Image sensor model after EMVA 1288: photons to electrons to grey values. The full well maps to full scale.

    ``dark_current_e_per_s`` is the value at ``reference_temperature_c``. It doubles for each increase of
    ``temperature_c``, the image sensor's temperature, by ``dark_current_doubling_k``.

    Differences between pixels are constant for a camera; ``pattern_seed`` identifies the camera, as a serial number
    does. ``prnu`` is the rms of the relative gain. ``dsnu_e`` is the rms in electrons of the readout offset, which is
    independent of exposure and temperature. ``dsnu_row_e`` and ``dsnu_column_e`` are additional offsets of rows and
    columns. Hot pixels, ``hot_pixels_per_million``, have an additional dark current. It is exponentially distributed
    with the mean ``hot_pixel_dark_current_e_per_s`` at the reference temperature.

    ``blooming`` is the fraction of the charge above the full well that spills along the columns; the rest is drained.
    A "rolling" shutter starts the exposure of each row ``line_time_us`` after that of the row above.
    """

    bits: Literal[8, 10, 12]
    quantum_efficiency: Annotated[float, Field(gt=0, le=1)]
    full_well_e: Positive
    read_noise_e: NotNegative
    dark_current_e_per_s: NotNegative = 0.0
    reference_temperature_c: Annotated[float, Field(ge=-100, le=150)] = 25.0
    dark_current_doubling_k: Annotated[float, Field(ge=1, le=100)] = 8.0
    temperature_c: Annotated[float, Field(ge=-100, le=150)] = 25.0
    prnu: Annotated[float, Field(ge=0, le=0.1)] = 0.0
    dsnu_e: NotNegative = 0.0
    dsnu_row_e: NotNegative = 0.0
    dsnu_column_e: NotNegative = 0.0
    hot_pixels_per_million: Annotated[float, Field(ge=0, le=1e6)] = 0.0
    hot_pixel_dark_current_e_per_s: NotNegative = 0.0
    pattern_seed: Annotated[int, Field(ge=0)] = 0
    blooming: Annotated[float, Field(ge=0, le=1)] = 0.0
    black_level_dn: NotNegative = 0.0
    frame_rate_hz: Positive = 60.0
    shutter: Literal["global", "rolling"] = "global"
    line_time_us: NotNegative = 0.0

    @model_validator(mode="after")
    def _check_completeness(self) -> "Detector":
        if self.shutter == "rolling" and self.line_time_us == 0:
            raise ValueError("a rolling shutter needs line_time_us, the delay from row to row; found 0")
        if (self.hot_pixels_per_million > 0) != (self.hot_pixel_dark_current_e_per_s > 0):
            raise ValueError(
                f"hot_pixels_per_million is {self.hot_pixels_per_million:g} and hot_pixel_dark_current_e_per_s "
                f"{self.hot_pixel_dark_current_e_per_s:g}: give both, or neither"
            )
        return self

    def full_scale_dn(self) -> int:
        """Return the largest grey value."""
        return 2**self.bits - 1

    def gain_dn_per_e(self) -> float:
        """Return the overall system gain K in grey values per electron."""
        return self.full_scale_dn() / self.full_well_e

    def dark_current_growth(self) -> float:
        """Return the ratio of the dark currents at image sensor and reference temperature (EMVA 1288 release 4)."""
        return 2.0 ** ((self.temperature_c - self.reference_temperature_c) / self.dark_current_doubling_k)


LEAST_BRACKET_STEP = 1.5
"""Least ratio of successive exposures in a bracket; exposures that are closer are repeats."""

MOST_IN_BRACKET = 8
"""Largest number of exposures in a bracket."""


def _check_bracket(factors: tuple[float, ...]) -> tuple[float, ...]:
    if factors[0] != 1 or any(b < LEAST_BRACKET_STEP * a for a, b in pairwise(factors)):
        raise ValueError(
            f"bracket is {factors}; expected increasing factors of the exposure, the first 1 and each at least "
            f"{LEAST_BRACKET_STEP:g} times the previous one, such as [1, 4, 16]"
        )
    return factors


Bracket = Annotated[
    tuple[Positive, ...], Field(min_length=1, max_length=MOST_IN_BRACKET), AfterValidator(_check_bracket)
]
"""Factors of the laser images' exposure, increasing from 1. Images with these exposures are fused."""


class Exposure(Description):
    """Exposure of laser and lamp images in ms. With "auto", the brightest pixel is at ``auto_level`` of full scale."""

    laser_ms: Positive | Literal["auto"] = "auto"
    lamp_ms: Positive | Literal["auto"] = "auto"
    auto_level: Annotated[float, Field(gt=0.05, lt=1)] = 0.8
    longest_ms: Positive = 1000.0

    def described_ms(self, light: str) -> float | Literal["auto"]:
        """Return the exposure of images under a light: "laser", or "lamp" and "day"."""
        return self.laser_ms if light == "laser" else self.lamp_ms


class Lamp(Description):
    """Light other than the laser's, as irradiance on every surface at the laser's wavelength.

    The lamp is on when the laser is off. ``ambient_w_per_m2`` is constant daylight, behind the camera's filter.
    """

    irradiance_w_per_m2: Positive = 5.0
    ambient_w_per_m2: NotNegative = 0.0


class Stage(Description):
    """Linear stage that moves the sensor; speed and acceleration are its limits."""

    travel_mm: Positive
    resolution_mm: Positive
    settling_s: NotNegative = 0.0
    speed_mm_per_s: Positive = 15.0
    acceleration_mm_per_s2: Positive = 50.0


class Volume(Description):
    """Measuring volume: depths along the camera's axis from the outer face of its window."""

    near_mm: _Length
    far_mm: _Length

    @model_validator(mode="after")
    def _check_order(self) -> "Volume":
        if self.near_mm >= self.far_mm:
            raise ValueError(f"near_mm {self.near_mm:g} must be smaller than far_mm {self.far_mm:g}")
        return self


class Uncertainty(Description):
    """Standard uncertainties of values from drawings, data sheets and certificates, for the joint calibration.

    A quantity with zero uncertainty is not estimated; its described value is used.

    - ``window_distance_mm``, ``window_tilt_deg``, ``glass_thickness_mm``, ``glass_index``: the camera's window.
    - ``laser_window_tilt_deg``: tilt of the laser's window relative to the sheet.
    - ``bow_deg``: tilt of the beam at the line optics.
    - ``temperature_k``: temperature of a medium whose index follows from its temperature; ``drift_k``: change of this
      temperature between calibration and scan.
    - ``index``: index of a medium with a given index.
    - ``stage_position_mm``: each stage position; ``stage_scale``: scale of all stage positions;
      ``stage_alignment_deg``: stage direction relative to the target's normal.
    - ``target_bow_mm``: deviation of the target's corners from its plane, each by a bow, a saddle and a twist.
    - ``target_stretch``: relative error of the target's lengths, independent along rows and columns, or for each. The
      default is that of a careful print on aluminium: it grows by 23 µm/m for each kelvin between print and use, and
      printers are off by some hundredths of a millimetre. An etched or measured target has 1e-5.
    - ``target_stripe_px``: shift of the stripe by the target's surface. The default is that of gloss or an unknown
      finish, whose lobe shifts a stripe by a tenth of a pixel; matt ceramic or paint has 0.02.
    - ``step_height_mm``: height of a step standard.
    - ``tangential``: the lens's coefficients p1 and p2.
    - ``sheet_thickness``: thickness of the laser sheet, relative.
    - ``sheet_offset_mm``, ``sheet_turn_deg``: position and directions of the sheet as built, where no image determines
      them (`uwlts recalibrate` from a description).
    - ``focal_length``: relative error of the focal length, of a camera that was calibrated before. Default: unknown,
      since lens names are rounded and focusing changes it. With 0, principal point and distortion are held, too.
    """

    window_distance_mm: NotNegative = 5.0
    window_tilt_deg: NotNegative = 0.5
    glass_thickness_mm: NotNegative = 0.05
    glass_index: NotNegative = 1e-3
    laser_window_tilt_deg: NotNegative = 0.5
    bow_deg: NotNegative = 0.5
    temperature_k: Positive = 1.0
    drift_k: NotNegative = 0.2
    index: Positive = 1e-4
    stage_position_mm: Positive = 0.005
    stage_scale: NotNegative = 1e-4
    stage_alignment_deg: Positive = 0.5
    target_bow_mm: NotNegative = 0.03
    target_stretch: NotNegative | tuple[NotNegative, NotNegative] = 1e-4
    target_stripe_px: NotNegative = 0.1
    step_height_mm: Positive = 0.01
    tangential: NotNegative = 5e-4
    sheet_thickness: NotNegative = 0.1
    sheet_offset_mm: Positive = 2.0
    sheet_turn_deg: Positive = 0.5
    focal_length: NotNegative | None = None

    def scaled(self, factor: float) -> "Uncertainty":
        """Return all uncertainties multiplied by a factor."""
        rows, columns = self.stretch_by_axis()
        update = {name: factor * value for name, value in self if isinstance(value, float)}
        return self.model_copy(update=update | {"target_stretch": (factor * rows, factor * columns)})

    def stretch_by_axis(self) -> tuple[float, float]:
        """Return the relative uncertainty of the target's lengths along rows and along columns."""
        stated = self.target_stretch
        return stated if isinstance(stated, tuple) else (stated, stated)

    def stage_lean(self) -> float:
        """Return the standard uncertainty of the stage's direction as a slope."""
        return float(np.tan(np.radians(self.stage_alignment_deg)))


class Sensor(Brief, Description):
    """Complete sensor and the media of its use, by name.

    ``more_lasers`` emit further sheets at the same time. ``stripe`` contains options of stripe detection
    (`uwlts.stripe.StripeOptions`) that differ from the defaults.
    """

    name: str
    notes: str = ""
    camera: Camera
    laser: Laser
    more_lasers: tuple[Laser, ...] = ()
    detector: Detector
    exposure: Exposure = Exposure()
    lamp: Lamp = Lamp()
    stage: Stage
    volume: Volume
    media: dict[str, Medium]
    uncertainty: Uncertainty = Uncertainty()
    stripe: Table = {}

    def medium(self, name: str) -> Medium:
        """Return one of the sensor's media; DescriptionError if the name is unknown."""
        if name not in self.media:
            raise DescriptionError(f"the sensor '{self.name}' knows the media {', '.join(self.media)}, not '{name}'")
        return self.media[name]

    @model_validator(mode="after")
    def _check_wavelengths(self) -> "Sensor":
        for laser in self.more_lasers:
            if laser.wavelength_nm != self.laser.wavelength_nm:
                raise ValueError(
                    f"the lasers have {self.laser.wavelength_nm:g} and {laser.wavelength_nm:g} nm; "
                    "all lasers of a sensor must have the same wavelength"
                )
        return self


class CaptureHeader(Description):
    """Description that is common to all frames of a capture.

    ``medium_name`` is the name of the medium in the sensor's description. ``stage_direction`` is the nominal direction
    of the sensor's motion by the stage, a unit vector in the OCS. ``saturation_dn`` is the grey value of clipped
    pixels; values above 2^k - 1 are marks (`uwlts.stripe.exposures`). ``target`` and ``artefact`` describe the measured
    object; `parse_target` and `parse_artefact` validate them later. ``T_platform_sensor`` (4, 4), mm, is the nominal
    pose of the sensor on a moving platform; with it, the frames' poses are those of the platform. ``provenance``
    documents how the capture was recorded.
    """

    name: str
    sensor: Sensor
    medium_name: str
    medium: Medium
    stage_direction: UnitVector
    saturation_dn: Annotated[int, Field(gt=0)]
    target: Table | None = None
    artefact: Table | None = None
    T_platform_sensor: RigidTransform | None = None
    provenance: Table = {}
