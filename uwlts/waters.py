"""Natural waters by name: what particles and dissolved matter add to pure water, and what light is scattered by.

Petzold's stations (1972, SIO Ref. 72-78, Figs. 22 to 37, at 530 nm; texts after Mobley give 514 nm, the report itself
530): "clear" is AUTEC 8, "coastal" HAOCE 11, "harbour" NUC 2040. Their absorption and scattering beyond pure water are
carried to other wavelengths by exp(-S (l - 530 nm)), S = 0.014 / nm (coloured dissolved matter, Bricaud and others
1981; 0.011 to 0.018 are found), and by 530 nm / l (exponents from 0.3 for large to 1.7 for small particles, Haltrin
1999); both forms and S are recalled, not checked against the papers. Around 635 nm they matter little. Towards 400 nm
the absorption of "clear" is too high, as that station's is threefold pure water's already at 530 nm.

Jerlov's types are the tables of Solonenko and Mobley (2015), 400-700 nm. Other authors' scattering differs up to 2.8
times for the same type: sweep ``scattering_per_m`` where a result depends on it. The tables' pure water absorbs a few
per cent less than Pope and Fry's beyond 650 nm, so that the clearest types then absorb less than "pure".
"""

import math
from dataclasses import dataclass

import numpy as np

from uwlts.errors import DescriptionError
from uwlts.media import check_range, read_table, water_absorption_per_m, water_scattering_per_m

JERLOV_TYPES = ("I", "IB", "II", "III", "1C", "3C", "5C", "7C", "9C")
"""In the order of the tables' columns."""

_STATION_NM = 530.0
_STATIONS = {"clear": (0.114, 0.037), "coastal": (0.179, 0.219), "harbour": (0.366, 1.824)}
"""Absorption and scattering at Petzold's stations in 1/m, sea water included."""
_ABSORPTION_SLOPE_PER_NM = 0.014
_SCATTERING_EXPONENT = 1.0


@dataclass(frozen=True)
class Molecular:
    """Scattering by the molecules of water."""


@dataclass(frozen=True)
class HenyeyGreenstein:
    """The phase function of Henyey and Greenstein; the asymmetry is the mean cosine."""

    asymmetry: float


@dataclass(frozen=True)
class PetzoldAverage:
    """Petzold's average particle."""


@dataclass(frozen=True)
class FournierForand:
    """Spheres of an index relative to water whose number falls with the diameter to the power of minus the slope."""

    index: float
    slope: float


PhaseFunction = Molecular | HenyeyGreenstein | PetzoldAverage | FournierForand


@dataclass(frozen=True)
class Scatterer:
    """One kind of scatterers in a medium: its part of the scattering coefficient in 1/mm, and its phase function."""

    coefficient_per_mm: float
    phase: PhaseFunction


@dataclass(frozen=True)
class Particles:
    """What particles and dissolved matter add to pure water's absorption and scattering, in 1/m.

    The absorption may be slightly negative where a water's table takes pure water to absorb less than ours.
    """

    absorption_per_m: float
    scattering_per_m: float


def water_names() -> tuple[str, ...]:
    """Names of the known waters, from pure to the most turbid of either family."""
    return ("pure", *_STATIONS, *(f"jerlov-{name}" for name in JERLOV_TYPES))


def particles_of(water: str, *, wavelength_nm: float) -> Particles:
    """What a named water adds to pure water.

    Raises
    ------
    DescriptionError
        The name is unknown.
    RangeError
        Outside 400-700 nm, unless the water is pure.
    """
    if water not in water_names():
        raise DescriptionError(f"unknown water '{water}'; known are {', '.join(water_names())}")
    if water == "pure":
        return Particles(0.0, 0.0)
    check_range("wavelength_nm", wavelength_nm, 400.0, 700.0, "the absorption and scattering of natural waters")
    if water in _STATIONS:
        return _at_station(*_STATIONS[water], wavelength_nm)
    return _of_jerlov_type(water.removeprefix("jerlov-"), wavelength_nm)


def particles_at(turbidity: float, *, wavelength_nm: float) -> Particles:
    """What water of a turbidity adds to pure water: 0 is "pure", 1 "clear", 2 "coastal", 3 "harbour".

    Between 0 and 1 it grows in proportion, from 1 on geometrically: equal steps multiply by equal factors.

    Raises
    ------
    RangeError
        The turbidity is outside 0..3, or the wavelength outside 400-700 nm.
    """
    check_range("turbidity", turbidity, 0.0, 3.0, "the scale from pure water to a harbour's")
    if turbidity <= 1:
        clear = particles_of("clear", wavelength_nm=wavelength_nm)
        return Particles(turbidity * clear.absorption_per_m, turbidity * clear.scattering_per_m)
    below, above = ("clear", "coastal") if turbidity < 2 else ("coastal", "harbour")
    share = turbidity - (1 if turbidity < 2 else 2)
    low, high = (particles_of(name, wavelength_nm=wavelength_nm) for name in (below, above))
    return Particles(
        low.absorption_per_m ** (1 - share) * high.absorption_per_m**share,
        low.scattering_per_m ** (1 - share) * high.scattering_per_m**share,
    )


def _at_station(absorption: float, scattering: float, wavelength_nm: float) -> Particles:
    """Beyond the sea water of a station, carried from 530 nm to another wavelength."""
    absorption -= water_absorption_per_m(wavelength_nm=_STATION_NM)
    scattering -= water_scattering_per_m(wavelength_nm=_STATION_NM, salinity_g_kg=35.0)
    return Particles(
        absorption * math.exp(-_ABSORPTION_SLOPE_PER_NM * (wavelength_nm - _STATION_NM)),
        scattering * (_STATION_NM / wavelength_nm) ** _SCATTERING_EXPONENT,
    )


def _of_jerlov_type(name: str, wavelength_nm: float) -> Particles:
    """Beyond pure water, linear between the tables' 25 nm.

    What is linear is the difference from pure water, as its absorption climbs steeply between 575 and 600 nm. The
    molecules' part taken off the scattering is the authors' own (their Eq. 8, after Haltrin 1999).
    """
    column = 1 + JERLOV_TYPES.index(name)
    wavelength, absorption = read_table("jerlov_absorption.csv")[[0, column]]
    scattering = read_table("jerlov_scattering.csv")[column]
    pure = np.array([water_absorption_per_m(wavelength_nm=w) for w in wavelength])
    molecules = 5.83e-3 * (400 / wavelength) ** 4.322
    return Particles(
        float(np.interp(wavelength_nm, wavelength, absorption - pure)),
        float(np.interp(wavelength_nm, wavelength, scattering - molecules)),
    )


def fournier_forand_of(backscatter_share: float) -> FournierForand:
    """The function of Fournier and Forand that scatters a share of the light backwards.

    Index and slope go together by index = 1.01 + 0.1542 (slope - 3) (Mobley, Sundman and Boss 2002, Applied Optics
    41:1035; recalled, it meets the published pairs of shares from 1e-4 to 0.1).

    Raises
    ------
    RangeError
        The share is outside 1e-4..0.1.
    """
    check_range("backscatter_share", backscatter_share, 1e-4, 0.1, "the line of Mobley, Sundman and Boss (2002)")
    low, high = 3.02, 4.2
    while high - low > 1e-12:
        middle = (low + high) / 2
        smaller = _backscatter_share(_on_line(middle)) < backscatter_share
        low, high = (middle, high) if smaller else (low, middle)
    return _on_line(low)


def _on_line(slope: float) -> FournierForand:
    return FournierForand(1.01 + 0.1542 * (slope - 3), slope)


def _backscatter_share(phase: FournierForand) -> float:
    """Share scattered by more than 90 deg: Mobley, Sundman and Boss 2002, Eq. 7 (recalled)."""
    nu, delta = (3 - phase.slope) / 2, 2 / (3 * (phase.index - 1) ** 2)
    power = delta**nu
    return 1 - (1 - delta * power - 0.5 * (1 - power)) / ((1 - delta) * power)
