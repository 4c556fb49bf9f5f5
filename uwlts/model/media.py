"""Refractive index, absorption and scattering of media and windows, and natural waters; indices are relative to air.

Formulas reject values outside the range of their fit. The window materials were measured in air, so that their formulas
give indices relative to air.

A new water is an entry of `WATERS`: a sentence, its absorption and scattering, and the phase function of its particles.

"clear", "coastal" and "harbour" are Petzold's stations (1972, SIO Ref. 72-78, Figs. 22 to 37). The report gives the
wavelength 530 nm; texts after Mobley give 514 nm. The excess absorption over pure water is scaled to a wavelength l by
exp(-S (l - 530 nm)) with S = 0.014 / nm, for coloured dissolved matter (Bricaud and others 1981; the literature has
0.011 to 0.018). The excess scattering is scaled by 530 nm / l (Haltrin 1999: exponents from 0.3 for large to 1.7 for
small particles). Both forms and S are quoted from memory and were not checked against the papers. They have little
effect near 635 nm. Towards 400 nm the absorption of "clear" is too high, because the station's absorption at 530 nm is
already three times that of pure water.

Jerlov's types are the tables of Solonenko and Mobley (2015), 400-700 nm. The scattering by other authors differs by a
factor of up to 2.8 for the same type; vary ``scattering_per_m`` if a result depends on it. Beyond 650 nm, the tables'
pure water absorbs a few per cent less than Pope and Fry's. The clearest types then absorb less than "pure".
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial
from importlib.resources import files

import numpy as np

from uwlts.errors import DescriptionError, RangeError


def check_range(name: str, value: float, lowest: float, highest: float, source: str) -> None:
    """Raise RangeError unless ``lowest <= value <= highest``; ``name`` has the unit, ``source`` is the range's."""
    if not (math.isfinite(value) and lowest <= value <= highest):
        raise RangeError(f"{name} is {value:g}, but {source} is valid from {lowest:g} to {highest:g}")


def water_index(*, wavelength_nm: float, temperature_c: float, salinity_g_kg: float = 0.0) -> float:
    """Return the refractive index of fresh or sea water relative to air.

    Quan and Fry 1995, Applied Optics 34:3477, Eq. 3. Raises RangeError outside 0-30 degC, 0-35 g/kg and 400-700 nm.
    """
    source = "the formula of Quan and Fry (1995)"
    check_range("wavelength_nm", wavelength_nm, 400.0, 700.0, source)
    check_range("temperature_c", temperature_c, 0.0, 30.0, source)
    check_range("salinity_g_kg", salinity_g_kg, 0.0, 35.0, source)
    t, s, w = temperature_c, salinity_g_kg, wavelength_nm
    return (
        1.31405
        + (1.779e-4 - 1.05e-6 * t + 1.6e-8 * t**2) * s
        - 2.02e-6 * t**2
        + (15.868 + 0.01155 * s - 0.00423 * t) / w
        - 4382.0 / w**2
        + 1.1455e6 / w**3
    )


@dataclass(frozen=True)
class Glass:
    """Window material: index relative to air as a function of wavelength in um, valid range, absorption at 635 nm.

    ``strength_mpa`` is the fracture strength for the thickness of a window under pressure with a safety factor of 4,
    and ``strength_source`` its source. It is None if no value with a source is known.
    """

    index: Callable[[float], float]
    lowest_um: float
    highest_um: float
    absorption_per_m: float
    source: str
    strength_mpa: float | None = None
    strength_source: str = ""


def _evaluate_sellmeier(strengths: tuple[float, ...], poles_um2: tuple[float, ...]) -> Callable[[float], float]:
    """Return Sellmeier's formula n^2 = 1 + sum B L^2 / (L^2 - C), with L in um and C in um^2."""
    return lambda um: math.sqrt(1 + sum(b * um**2 / (um**2 - c) for b, c in zip(strengths, poles_um2, strict=True)))


def _compute_soda_lime(um: float) -> float:
    """Return n = 1.5130 - 0.003169 L^2 + 0.003962 / L^2, L in um (Rubin 1985, Solar Energy Materials 12:275)."""
    return 1.5130 - 0.003169 * um**2 + 0.003962 / um**2


_BK7 = _evaluate_sellmeier((1.03961212, 0.231792344, 1.01046945), (0.00600069867, 0.0200179144, 103.560653))
_SAPPHIRE = _evaluate_sellmeier((1.4313493, 0.65054713, 5.3414021), (0.0726631**2, 0.1193242**2, 18.028251**2))
"""Ordinary ray, that of a window whose optical axis is normal to its faces; the other index is lower by 0.008."""
_SILICA = _evaluate_sellmeier((0.6961663, 0.4079426, 0.8974794), (0.0684043**2, 0.1162414**2, 9.896161**2))

FUSED_SILICA_MPA = 60.0
"""Fracture strength that is used for windows of unknown strength, as in the thesis (Figure 34, after Harris 1999)."""
_FLOAT_GLASS = 45.0, "EN 572-1, annealed float glass"
"""Characteristic bending strength: at most 5 % of panes break below it."""
_SAPPHIRE_LIMIT = 275.0, "apparent elastic limit, Uni Optics"
"""Well below the strengths of any cut of the crystal, 580 MPa and more (Fischer et al. 1990, Proc. SPIE 1326)."""
_CAST_ACRYLIC = 41.4, "4 times the 1500 psi of continuous load, Altuglas, Plexiglas G"
"""Acrylic breaks at 70 MPa, but crazes under a continuous tension above 1500 psi (10.3 MPa)."""

GLASSES = {
    "N-BK7": Glass(_BK7, 0.3, 2.5, 0.24, "Schott data sheet"),
    "fused-silica": Glass(_SILICA, 0.21, 3.71, 0.0, "Malitson 1965, JOSA 55:1205", FUSED_SILICA_MPA, "Harris 1999"),
    "soda-lime": Glass(_compute_soda_lime, 0.31, 4.6, 14.5, "Rubin 1985, clear", *_FLOAT_GLASS),
    "soda-lime-low-iron": Glass(_compute_soda_lime, 0.31, 4.6, 3.25, "Rubin 1985, low iron", *_FLOAT_GLASS),
    "sapphire": Glass(_SAPPHIRE, 0.2, 5.0, 0.0, "Malitson and Dodge 1972", *_SAPPHIRE_LIMIT),
    "PMMA": Glass(_evaluate_sellmeier((1.1819,), (0.011313,)), 0.4368, 1.052, 0.0, "Sultanova 2009", *_CAST_ACRYLIC),
}


_OTHER_NAMES = {
    "BK7": "N-BK7",
    "borosilicate crown": "N-BK7",
    "quartz": "fused-silica",
    "quartz glass": "fused-silica",
    "silica": "fused-silica",
    "float glass": "soda-lime",
    "window glass": "soda-lime",
    "acrylic": "PMMA",
    "acrylic glass": "PMMA",
    "plexiglas": "PMMA",
    "plexiglass": "PMMA",
    "perspex": "PMMA",
}
"""Common names of window materials, in any case and with - or _ in place of blanks."""


def _simplify_name(name: str) -> str:
    return " ".join(name.replace("-", " ").replace("_", " ").casefold().split())


_BY_PLAIN_NAME = {_simplify_name(name): name for name in GLASSES} | {
    _simplify_name(other): name for other, name in _OTHER_NAMES.items()
}


def find_glass(name: str) -> Glass:
    """Return the named window material, also by a common name; DescriptionError with the known names."""
    known = _BY_PLAIN_NAME.get(_simplify_name(name))
    if known is None:
        raise DescriptionError(
            f"unknown glass '{name}'; known are {', '.join(GLASSES)}, common names such as acrylic, or the "
            "index as a number"
        )
    return GLASSES[known]


def glass_index(name: str, *, wavelength_nm: float) -> float:
    """Return the refractive index of a named glass relative to air; RangeError outside the formula's range."""
    glass = find_glass(name)
    lowest, highest, source = 1e3 * glass.lowest_um, 1e3 * glass.highest_um, f"{name} ({glass.source})"
    check_range("wavelength_nm", wavelength_nm, lowest, highest, source)
    return glass.index(1e-3 * wavelength_nm)


@cache
def read_table(name: str) -> np.ndarray:
    """Read a table in ``uwlts/model/tables`` as (columns, rows); the first lines of the file name the source."""
    text = files("uwlts.model").joinpath("tables", name).read_text(encoding="utf-8")
    rows = [line for line in text.splitlines() if not line.startswith("#")]
    return np.loadtxt(rows, delimiter=",", skiprows=1).T


def water_absorption_per_m(*, wavelength_nm: float) -> float:
    """Return the absorption of pure water in 1/m (Pope and Fry 1997), interpolated linearly in steps of 2.5 nm."""
    wavelength, absorption = read_table("water_absorption.csv")
    check_range("wavelength_nm", wavelength_nm, wavelength[0], wavelength[-1], "the table of Pope and Fry (1997)")
    return float(np.interp(wavelength_nm, wavelength, absorption))


def water_scattering_per_m(*, wavelength_nm: float, salinity_g_kg: float = 0.0) -> float:
    """Return the molecular scattering of water in 1/m at 20 degC (Zhang, Hu and He 2009).

    The table is interpolated linearly in wavelength and salinity.
    """
    wavelength, fresh, sea = read_table("water_scattering.csv")
    source = "the table after Zhang, Hu and He (2009)"
    check_range("wavelength_nm", wavelength_nm, wavelength[0], wavelength[-1], source)
    check_range("salinity_g_kg", salinity_g_kg, 0.0, 35.0, source)
    ends = [np.interp(wavelength_nm, wavelength, column) for column in (fresh, sea)]
    return float(np.interp(salinity_g_kg, (0.0, 35.0), ends))


# Sources: see above.
_STATION_NM = 530.0
_ABSORPTION_SLOPE_PER_NM = 0.014
_SCATTERING_EXPONENT = 1.0
_SOURCE = "the absorption and scattering of natural waters"


@dataclass(frozen=True)
class Particles:
    """Absorption and scattering by particles and dissolved matter, in addition to pure water, in 1/m.

    The absorption can be slightly negative if a water's table assumes a lower absorption of pure water.
    """

    absorption_per_m: float
    scattering_per_m: float


@dataclass(frozen=True)
class NaturalWater:
    """Named water.

    ``particles`` returns its particles at a wavelength in nm (RangeError outside 400-700 nm unless pure). ``phase`` is
    the name of their phase function in `uwlts.model.phase_functions.KINDS`.
    """

    sentence: str
    particles: Callable[[float], Particles]
    phase: str = "petzold"


def _read_station(absorption_per_m: float, scattering_per_m: float, wavelength_nm: float) -> Particles:
    """Return the particles of a station at a wavelength, scaled from 530 nm; pure sea water is subtracted."""
    check_range("wavelength_nm", wavelength_nm, 400.0, 700.0, _SOURCE)
    absorption = absorption_per_m - water_absorption_per_m(wavelength_nm=_STATION_NM)
    scattering = scattering_per_m - water_scattering_per_m(wavelength_nm=_STATION_NM, salinity_g_kg=35.0)
    return Particles(
        absorption * math.exp(-_ABSORPTION_SLOPE_PER_NM * (wavelength_nm - _STATION_NM)),
        scattering * (_STATION_NM / wavelength_nm) ** _SCATTERING_EXPONENT,
    )


def _read_jerlov(column: int, wavelength_nm: float) -> Particles:
    """Return the particles of a Jerlov type, a column of the tables, interpolated linearly in steps of 25 nm.

    The difference from pure water is interpolated, because the absorption of pure water increases steeply between 575
    and 600 nm. The molecular scattering to be subtracted is that of the tables' authors (their Eq. 8, after Haltrin
    1999).
    """
    check_range("wavelength_nm", wavelength_nm, 400.0, 700.0, _SOURCE)
    wavelength, absorption = read_table("jerlov_absorption.csv")[[0, column]]
    scattering = read_table("jerlov_scattering.csv")[column]
    pure = np.array([water_absorption_per_m(wavelength_nm=w) for w in wavelength])
    molecules = 5.83e-3 * (400 / wavelength) ** 4.322
    return Particles(
        float(np.interp(wavelength_nm, wavelength, absorption - pure)),
        float(np.interp(wavelength_nm, wavelength, scattering - molecules)),
    )


WATERS = {
    "pure": NaturalWater("pure water", lambda wavelength_nm: Particles(0.0, 0.0)),
    "clear": NaturalWater("Petzold's AUTEC 8, Bahamas", partial(_read_station, 0.114, 0.037)),
    "coastal": NaturalWater("Petzold's HAOCE 11, California", partial(_read_station, 0.179, 0.219)),
    "harbour": NaturalWater("Petzold's NUC 2040, San Diego", partial(_read_station, 0.366, 1.824)),
    "jerlov-I": NaturalWater("the clearest ocean", partial(_read_jerlov, 1)),
    "jerlov-IB": NaturalWater("ocean, between I and II", partial(_read_jerlov, 2)),
    "jerlov-II": NaturalWater("ocean", partial(_read_jerlov, 3)),
    "jerlov-III": NaturalWater("the most turbid ocean", partial(_read_jerlov, 4)),
    "jerlov-1C": NaturalWater("the clearest coast", partial(_read_jerlov, 5)),
    "jerlov-3C": NaturalWater("coast", partial(_read_jerlov, 6)),
    "jerlov-5C": NaturalWater("coast, more turbid", partial(_read_jerlov, 7)),
    "jerlov-7C": NaturalWater("coast, turbid", partial(_read_jerlov, 8)),
    "jerlov-9C": NaturalWater("the most turbid coast", partial(_read_jerlov, 9)),
}
"""All named waters. Petzold's: absorption and scattering in 1/m including sea water; Jerlov's: column of the tables."""


def particles_at(turbidity: float, *, wavelength_nm: float) -> Particles:
    """Return the particles of water with a turbidity: 0 is "pure", 1 "clear", 2 "coastal", 3 "harbour".

    The interpolation is linear between 0 and 1, and geometric above 1. Raises RangeError outside 400-700 nm.
    """
    clear, coastal, harbour = (WATERS[name].particles(wavelength_nm) for name in ("clear", "coastal", "harbour"))
    if turbidity <= 1:
        return Particles(turbidity * clear.absorption_per_m, turbidity * clear.scattering_per_m)
    low, high, share = (clear, coastal, turbidity - 1) if turbidity < 2 else (coastal, harbour, turbidity - 2)
    return Particles(
        low.absorption_per_m ** (1 - share) * high.absorption_per_m**share,
        low.scattering_per_m ** (1 - share) * high.scattering_per_m**share,
    )
