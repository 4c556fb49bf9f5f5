"""Phase functions of scatterers in water: names, parameters, limits and formulas.

A new phase function is a class in this module that is listed in `KINDS`. A medium's description refers to it by name or
by a table with its parameters, such as ``phase = {kind = "two-term", asymmetry_forward = 0.95}``. The twin
evaluates phase functions, and the sensor software where it fits the halo of a stripe. All arrays are float64.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, ClassVar, Self

import numpy as np
from pydantic import BaseModel, ConfigDict, Field
from pydantic.dataclasses import dataclass as validated_dataclass

from uwlts.model.media import check_range, read_table

MOLECULAR_ANISOTROPY = 0.925
"""k = (1 - d) / (1 + d) with the depolarisation ratio of water d = 0.039 (Zhang, Hu and He 2009)."""
PETZOLD_FORWARD_EXPONENT = 1.346
"""Below 0.1 deg, where the table starts, the function is extrapolated as angle^-1.346 (Petzold 1972, harbour)."""

_STRICT = ConfigDict(extra="forbid", allow_inf_nan=False)

Asymmetry = Annotated[float, Field(gt=-1, lt=1)]
ParticleIndex = Annotated[float, Field(gt=1, lt=1.5)]
ParticleSlope = Annotated[float, Field(gt=3, lt=5)]
BackscatterShare = Annotated[float, Field(ge=1e-4, le=0.1)]


class PhaseFunction(ABC):
    """Base of phase functions; ``name`` is used in descriptions, ``sentence`` in the documentation."""

    name: ClassVar[str]
    sentence: ClassVar[str]

    @classmethod
    def of_keys(cls, keys: Mapping[str, float]) -> Self:
        """Make the function from the keys of a medium's description; keys that are not its parameters are ignored."""
        return cls()

    @abstractmethod
    def per_sr(self, angle: np.ndarray) -> np.ndarray:
        """Return the phase function (N,) in 1/sr at scattering angles (N,) in rad, between 0 and pi exclusive."""

    def share_within(self, angle: float) -> float | None:
        """Return the fraction scattered by less than a small angle in rad; None for a power law of the angle."""
        return None


@validated_dataclass(frozen=True, config=_STRICT)
class Molecular(PhaseFunction):
    """Scattering by the molecules of water."""

    name = "molecular"
    sentence = "scattering by the molecules of water (Morel 1974)"

    def per_sr(self, angle: np.ndarray) -> np.ndarray:
        """Return 3 (1 + k cos^2) / (4 pi (3 + k)) in 1/sr (Morel 1974)."""
        k = MOLECULAR_ANISOTROPY
        return 3 * (1 + k * np.cos(angle) ** 2) / (4 * math.pi * (3 + k))


@validated_dataclass(frozen=True, config=_STRICT)
class HenyeyGreenstein(PhaseFunction):
    """Phase function of Henyey and Greenstein; the asymmetry is the mean cosine."""

    name = "henyey-greenstein"
    sentence = "one peak of a given mean cosine, `asymmetry` (Henyey and Greenstein 1941)"

    asymmetry: Asymmetry = 0.924

    @classmethod
    def of_keys(cls, keys: Mapping[str, float]) -> Self:
        """Make the function from the medium's ``asymmetry``."""
        return cls(keys["asymmetry"])

    def per_sr(self, angle: np.ndarray) -> np.ndarray:
        """Return (1 - g^2) / (4 pi (1 + g^2 - 2 g cos)^1.5) in 1/sr (Henyey and Greenstein 1941, Eq. 2).

        The bracket is written as a sum of squares, which avoids cancellation at the forward (g > 0) or backward peak.
        """
        g = self.asymmetry
        half = np.sin(angle / 2) if g >= 0 else np.cos(angle / 2)
        return (1 - g * g) / (4 * math.pi) * ((1 - abs(g)) ** 2 + 4 * abs(g) * half**2) ** -1.5


@validated_dataclass(frozen=True, config=_STRICT)
class PetzoldAverage(PhaseFunction):
    """Petzold's average particle; the integral is 1 to the accuracy of the table."""

    name = "petzold"
    sentence = "Petzold's average particle (1972, as tabulated by Mobley 1994)"

    def per_sr(self, angle: np.ndarray) -> np.ndarray:
        """Return the table, interpolated linearly in the logarithms, with its forward extrapolation, in 1/sr."""
        degrees, value = read_table("petzold_phase.csv")
        log_angle, log_end = np.log(angle), math.log(math.radians(degrees[0]))
        inside = np.interp(log_angle, np.log(np.radians(degrees)), np.log(value))
        return np.exp(inside - PETZOLD_FORWARD_EXPONENT * np.minimum(log_angle - log_end, 0.0))


@validated_dataclass(frozen=True, config=_STRICT)
class FournierForand(PhaseFunction):
    """Spheres with an index relative to water and a number density proportional to diameter^(-slope)."""

    name = "fournier-forand"
    sentence = "particles by `particle_index` and `particle_slope`, or `backscatter_share` (Fournier and Forand 1994)"

    index: ParticleIndex = 1.10
    slope: ParticleSlope = 3.5835

    @classmethod
    def of_keys(cls, keys: Mapping[str, float]) -> Self:
        """Make the function from ``backscatter_share``, else from ``particle_index`` and ``particle_slope``."""
        if "backscatter_share" in keys:
            return cls.of_backscatter(keys["backscatter_share"])
        return cls(keys["particle_index"], keys["particle_slope"])

    @classmethod
    def of_backscatter(cls, share: float) -> Self:
        """Make the function with a given backscatter fraction.

        Index and slope are coupled by index = 1.01 + 0.1542 (slope - 3) (Mobley, Sundman and Boss 2002, Applied Optics
        41:1035). The formula was not compared with the paper itself; it agrees with the published pairs for fractions
        from 1e-4 to 0.1. Raises RangeError outside this range.
        """
        check_range("backscatter_share", share, 1e-4, 0.1, "the line of Mobley, Sundman and Boss (2002)")
        # Bisection between slopes with less than the smallest and more than the largest fraction.
        low, high = 3.02, 4.2
        while high - low > 1e-12:
            middle = (low + high) / 2
            less = cls(1.01 + 0.1542 * (middle - 3), middle).backscatter_share() < share
            low, high = (middle, high) if less else (low, middle)
        return cls(1.01 + 0.1542 * (low - 3), low)

    def backscatter_share(self) -> float:
        """Return the fraction scattered by more than 90 deg (Mobley, Sundman and Boss 2002, Eq. 7, not compared)."""
        nu, delta = (3 - self.slope) / 2, 2 / (3 * (self.index - 1) ** 2)
        power = delta**nu
        return 1 - (1 - delta * power - 0.5 * (1 - power)) / ((1 - delta) * power)

    def per_sr(self, angle: np.ndarray) -> np.ndarray:
        """Return the function of Fournier and Forand 1994 in the form of Fournier and Jonasz 1999 (SPIE 3761:62).

        With d = 4 h / (3 (n - 1)^2), h = sin^2(angle / 2), v = (3 - mu) / 2 and d180 = d at h = 1, the function is

            (v (1 - d) - (1 - d^v) + (d (1 - d^v) - v (1 - d)) / h) / (4 pi (1 - d)^2 d^v)
            + (1 - d180^v) (3 cos^2 - 1) / (16 pi (d180 - 1) d180^v).

        Near d = 1, both numerators vanish as (1 - d)^2. With 1 - d^v = v (1 - d) - (1 - d)^2 s, the first term becomes
        (s - (v + d s) / h) / (4 pi d^v), without cancellation.
        """
        h = np.sin(angle / 2) ** 2
        v, whole = (3 - self.slope) / 2, 4 / (3 * (self.index - 1) ** 2)
        d = whole * h
        s = _expand_remainder(d, v)
        around = (1 - whole**v) * (3 * np.cos(angle) ** 2 - 1) / (16 * math.pi * (whole - 1) * whole**v)
        return (s - (v + d * s) / h) / (4 * math.pi * d**v) + around

    def share_within(self, angle: float) -> float:
        """Return the fraction scattered by less than an angle, for d < 1 (Fournier and Jonasz 1999).

        (1 - d^(v + 1) - (1 - d^v) h) / ((1 - d) d^v) + (1 - d180^v) cos sin^2 / (8 (d180 - 1) d180^v)
        """
        h = math.sin(angle / 2) ** 2
        v, whole = (3 - self.slope) / 2, 4 / (3 * (self.index - 1) ** 2)
        d = whole * h
        around = (1 - whole**v) * math.cos(angle) * math.sin(angle) ** 2 / (8 * (whole - 1) * whole**v)
        return (1 - d ** (v + 1) - (1 - d**v) * h) / ((1 - d) * d**v) + around


def _expand_remainder(d: np.ndarray, v: float) -> np.ndarray:
    """Return (v (1 - d) - (1 - d^v)) / (1 - d)^2, near d = 1 by the binomial series of d^v."""
    x = 1 - d
    # The remainder of the 12 terms is below 0.05^12, less than the rounding error of 64 bits.
    near = np.abs(x) < 0.05
    far = np.where(near, 0.5, x)
    series, coefficient = np.zeros_like(x), v
    for k in range(2, 14):
        coefficient *= -(v - k + 1) / k
        series += -coefficient * np.where(near, x, 0.0) ** (k - 2)
    return np.where(near, series, (v * far - (1 - np.where(near, 0.5, d) ** v)) / far**2)


_ALL: tuple[type[PhaseFunction], ...] = (Molecular, HenyeyGreenstein, PetzoldAverage, FournierForand)
KINDS = {kind.name: kind for kind in _ALL}
"""All phase functions by name."""


def phase_function_kind(name: str) -> type[PhaseFunction]:
    """Return the class of a phase function by name; ValueError with the known names."""
    if name not in KINDS:
        raise ValueError(f"unknown phase function '{name}'; known are {', '.join(KINDS)}")
    return KINDS[name]


class DescribedPhase(BaseModel):
    """Phase function in a description: its kind and its parameters."""

    model_config = ConfigDict(frozen=True, extra="allow", allow_inf_nan=False)

    kind: str

    def phase_function(self) -> PhaseFunction:
        """Return the phase function; ValueError if the kind or a parameter is unknown or out of range."""
        try:
            return phase_function_kind(self.kind)(**(self.model_extra or {}))
        except TypeError as error:
            raise ValueError(f"the phase function '{self.kind}' does not have these parameters: {error}") from error


@dataclass(frozen=True)
class Scatterer:
    """One kind of scatterers in a medium: its scattering coefficient in 1/mm, and its phase function."""

    coefficient_per_mm: float
    phase: PhaseFunction
