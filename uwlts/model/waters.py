"""Natural waters by name: absorption and scattering by particles and dissolved matter, in addition to pure water.

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
from functools import partial

import numpy as np

from uwlts.errors import DescriptionError
from uwlts.model.media import check_range, read_table, water_absorption_per_m, water_scattering_per_m

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


def _station(absorption_per_m: float, scattering_per_m: float, wavelength_nm: float) -> Particles:
    """Return the particles of a station at a wavelength, scaled from 530 nm; pure sea water is subtracted."""
    check_range("wavelength_nm", wavelength_nm, 400.0, 700.0, _SOURCE)
    absorption = absorption_per_m - water_absorption_per_m(wavelength_nm=_STATION_NM)
    scattering = scattering_per_m - water_scattering_per_m(wavelength_nm=_STATION_NM, salinity_g_kg=35.0)
    return Particles(
        absorption * math.exp(-_ABSORPTION_SLOPE_PER_NM * (wavelength_nm - _STATION_NM)),
        scattering * (_STATION_NM / wavelength_nm) ** _SCATTERING_EXPONENT,
    )


def _jerlov(column: int, wavelength_nm: float) -> Particles:
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
    "clear": NaturalWater("Petzold's AUTEC 8, Bahamas", partial(_station, 0.114, 0.037)),
    "coastal": NaturalWater("Petzold's HAOCE 11, California", partial(_station, 0.179, 0.219)),
    "harbour": NaturalWater("Petzold's NUC 2040, San Diego", partial(_station, 0.366, 1.824)),
    "jerlov-I": NaturalWater("the clearest ocean", partial(_jerlov, 1)),
    "jerlov-IB": NaturalWater("ocean, between I and II", partial(_jerlov, 2)),
    "jerlov-II": NaturalWater("ocean", partial(_jerlov, 3)),
    "jerlov-III": NaturalWater("the most turbid ocean", partial(_jerlov, 4)),
    "jerlov-1C": NaturalWater("the clearest coast", partial(_jerlov, 5)),
    "jerlov-3C": NaturalWater("coast", partial(_jerlov, 6)),
    "jerlov-5C": NaturalWater("coast, more turbid", partial(_jerlov, 7)),
    "jerlov-7C": NaturalWater("coast, turbid", partial(_jerlov, 8)),
    "jerlov-9C": NaturalWater("the most turbid coast", partial(_jerlov, 9)),
}
"""All named waters. Petzold's: absorption and scattering in 1/m including sea water; Jerlov's: column of the tables."""


def find_water(name: str) -> NaturalWater:
    """Return a water by name; DescriptionError with the known names."""
    if name not in WATERS:
        raise DescriptionError(f"unknown water '{name}'; known are {', '.join(WATERS)}")
    return WATERS[name]


def particles_at(turbidity: float, *, wavelength_nm: float) -> Particles:
    """Return the particles of water with a turbidity: 0 is "pure", 1 "clear", 2 "coastal", 3 "harbour".

    The interpolation is linear between 0 and 1, and geometric above 1. Raises RangeError if the turbidity is outside
    0 to 3, or the wavelength outside 400-700 nm.
    """
    check_range("turbidity", turbidity, 0.0, 3.0, "the scale from pure water to a harbour's")
    clear, coastal, harbour = (WATERS[name].particles(wavelength_nm) for name in ("clear", "coastal", "harbour"))
    if turbidity <= 1:
        return Particles(turbidity * clear.absorption_per_m, turbidity * clear.scattering_per_m)
    low, high, share = (clear, coastal, turbidity - 1) if turbidity < 2 else (coastal, harbour, turbidity - 2)
    return Particles(
        low.absorption_per_m ** (1 - share) * high.absorption_per_m**share,
        low.scattering_per_m ** (1 - share) * high.scattering_per_m**share,
    )
