"""Phase functions of what scatters in water: their names, parameters, limits and formulas.

A new phase function is a class here, listed in `KINDS`. A medium's description names it, with its parameters where it
has any: ``phase = {kind = "two-term", asymmetry_forward = 0.95}``; the twin evaluates it. Nothing of how the sensor's
software computes uses this module. Everything is float64 NumPy.
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
"""k = (1 - d) / (1 + d) for water's depolarisation ratio d = 0.039 (Zhang, Hu and He 2009)."""
PETZOLD_FORWARD_EXPONENT = 1.346
"""Below the table's 0.1 deg the function goes on as angle^-1.346, the slope Petzold (1972) used for the harbour."""

_STRICT = ConfigDict(extra="forbid", allow_inf_nan=False)

Asymmetry = Annotated[float, Field(gt=-1, lt=1)]
ParticleIndex = Annotated[float, Field(gt=1, lt=1.5)]
ParticleSlope = Annotated[float, Field(gt=3, lt=5)]
BackscatterShare = Annotated[float, Field(ge=1e-4, le=0.1)]


class PhaseFunction(ABC):
    """A phase function; ``name`` is what descriptions call it, ``sentence`` what the documentation says of it."""

    name: ClassVar[str]
    sentence: ClassVar[str]

    @classmethod
    def of_keys(cls, keys: Mapping[str, float]) -> Self:
        """The function of a description that only names it, by those of the medium's keys that are its parameters."""
        return cls()

    @abstractmethod
    def per_sr(self, angle: np.ndarray) -> np.ndarray:
        """Phase function (N,) in 1/sr at scattering angles (N,) in rad between 0 and pi, both ends left out."""

    def share_within(self, angle: float) -> float | None:
        """Share scattered by less than a small angle in rad; None where the function is a power of the angle there."""
        return None


@validated_dataclass(frozen=True, config=_STRICT)
class Molecular(PhaseFunction):
    """Scattering by the molecules of water."""

    name = "molecular"
    sentence = "scattering by the molecules of water (Morel 1974)"

    def per_sr(self, angle: np.ndarray) -> np.ndarray:
        """3 (1 + k cos^2) / (4 pi (3 + k)), Morel 1974."""
        k = MOLECULAR_ANISOTROPY
        return 3 * (1 + k * np.cos(angle) ** 2) / (4 * math.pi * (3 + k))


@validated_dataclass(frozen=True, config=_STRICT)
class HenyeyGreenstein(PhaseFunction):
    """The phase function of Henyey and Greenstein; the asymmetry is the mean cosine."""

    name = "henyey-greenstein"
    sentence = "one peak of a given mean cosine, `asymmetry` (Henyey and Greenstein 1941)"

    asymmetry: Asymmetry = 0.924

    @classmethod
    def of_keys(cls, keys: Mapping[str, float]) -> Self:
        """By the medium's ``asymmetry``."""
        return cls(keys["asymmetry"])

    def per_sr(self, angle: np.ndarray) -> np.ndarray:
        """(1 - g^2) / (4 pi (1 + g^2 - 2 g cos)^1.5), Henyey and Greenstein 1941, Eq. 2.

        The root's argument is written as a sum of squares, exact at a peak forwards (g > 0) or backwards (g < 0).
        """
        g = self.asymmetry
        away = np.sin(angle / 2) if g >= 0 else np.cos(angle / 2)
        return (1 - g * g) / (4 * math.pi) * ((1 - abs(g)) ** 2 + 4 * abs(g) * away**2) ** -1.5


@validated_dataclass(frozen=True, config=_STRICT)
class PetzoldAverage(PhaseFunction):
    """Petzold's average particle; its integral is 1 to the table's accuracy."""

    name = "petzold"
    sentence = "Petzold's average particle (1972, as tabulated by Mobley 1994)"

    def per_sr(self, angle: np.ndarray) -> np.ndarray:
        """The table, its logarithm linear in the angle's, and its extension forwards."""
        degrees, value = read_table("petzold_phase.csv")
        log_angle, log_end = np.log(angle), math.log(math.radians(degrees[0]))
        inside = np.interp(log_angle, np.log(np.radians(degrees)), np.log(value))
        return np.exp(inside - PETZOLD_FORWARD_EXPONENT * np.minimum(log_angle - log_end, 0.0))


@validated_dataclass(frozen=True, config=_STRICT)
class FournierForand(PhaseFunction):
    """Spheres of an index relative to water whose number falls with the diameter to the power of minus the slope."""

    name = "fournier-forand"
    sentence = "particles by `particle_index` and `particle_slope`, or `backscatter_share` (Fournier and Forand 1994)"

    index: ParticleIndex = 1.10
    slope: ParticleSlope = 3.5835

    @classmethod
    def of_keys(cls, keys: Mapping[str, float]) -> Self:
        """By the medium's ``backscatter_share`` if given, else its ``particle_index`` and ``particle_slope``."""
        if "backscatter_share" in keys:
            return cls.of_backscatter(keys["backscatter_share"])
        return cls(keys["particle_index"], keys["particle_slope"])

    @classmethod
    def of_backscatter(cls, share: float) -> Self:
        """The function that scatters a share of the light backwards.

        Index and slope go together by index = 1.01 + 0.1542 (slope - 3) (Mobley, Sundman and Boss 2002, Applied Optics
        41:1035; recalled, it meets the published pairs of shares from 1e-4 to 0.1); RangeError outside that range.
        """
        check_range("backscatter_share", share, 1e-4, 0.1, "the line of Mobley, Sundman and Boss (2002)")
        # Slopes that give less than the least and more than the greatest share.
        low, high = 3.02, 4.2
        while high - low > 1e-12:
            middle = (low + high) / 2
            less = cls(1.01 + 0.1542 * (middle - 3), middle).backscatter_share() < share
            low, high = (middle, high) if less else (low, middle)
        return cls(1.01 + 0.1542 * (low - 3), low)

    def backscatter_share(self) -> float:
        """Share scattered by more than 90 deg: Mobley, Sundman and Boss 2002, Eq. 7 (recalled)."""
        nu, delta = (3 - self.slope) / 2, 2 / (3 * (self.index - 1) ** 2)
        power = delta**nu
        return 1 - (1 - delta * power - 0.5 * (1 - power)) / ((1 - delta) * power)

    def per_sr(self, angle: np.ndarray) -> np.ndarray:
        """Fournier and Forand 1994 in the form of Fournier and Jonasz 1999 (SPIE 3761:62).

        With d = 4 h / (3 (n - 1)^2), h = sin^2(angle / 2), v = (3 - mu) / 2 and d180 = d at h = 1, it is

            (v (1 - d) - (1 - d^v) + (d (1 - d^v) - v (1 - d)) / h) / (4 pi (1 - d)^2 d^v)
            + (1 - d180^v) (3 cos^2 - 1) / (16 pi (d180 - 1) d180^v).

        Both numerators vanish as (1 - d)^2 at d = 1. With 1 - d^v = v (1 - d) - (1 - d)^2 s the first term becomes
        (s - (v + d s) / h) / (4 pi d^v), in which nothing is lost.
        """
        h = np.sin(angle / 2) ** 2
        v, whole = (3 - self.slope) / 2, 4 / (3 * (self.index - 1) ** 2)
        d = whole * h
        s = _second_remainder(d, v)
        around = (1 - whole**v) * (3 * np.cos(angle) ** 2 - 1) / (16 * math.pi * (whole - 1) * whole**v)
        return (s - (v + d * s) / h) / (4 * math.pi * d**v) + around

    def share_within(self, angle: float) -> float:
        """Fournier and Jonasz 1999, for d < 1.

        (1 - d^(v + 1) - (1 - d^v) h) / ((1 - d) d^v) + (1 - d180^v) cos sin^2 / (8 (d180 - 1) d180^v)
        """
        h = math.sin(angle / 2) ** 2
        v, whole = (3 - self.slope) / 2, 4 / (3 * (self.index - 1) ** 2)
        d = whole * h
        around = (1 - whole**v) * math.cos(angle) * math.sin(angle) ** 2 / (8 * (whole - 1) * whole**v)
        return (1 - d ** (v + 1) - (1 - d**v) * h) / ((1 - d) * d**v) + around


def _second_remainder(d: np.ndarray, v: float) -> np.ndarray:
    """(v (1 - d) - (1 - d^v)) / (1 - d)^2; near d = 1 by the binomial series of d^v."""
    x = 1 - d
    # There the 12 terms of the series leave less than 0.05^12, below the rounding of 64 bits.
    near = np.abs(x) < 0.05
    far = np.where(near, 0.5, x)
    series, coefficient = np.zeros_like(x), v
    for k in range(2, 14):
        coefficient *= -(v - k + 1) / k
        series += -coefficient * np.where(near, x, 0.0) ** (k - 2)
    return np.where(near, series, (v * far - (1 - np.where(near, 0.5, d) ** v)) / far**2)


_ALL: tuple[type[PhaseFunction], ...] = (Molecular, HenyeyGreenstein, PetzoldAverage, FournierForand)
KINDS = {kind.name: kind for kind in _ALL}
"""All phase functions by the names that descriptions give them."""


def phase_function_kind(name: str) -> type[PhaseFunction]:
    """The phase function of a name; ValueError with the known names."""
    if name not in KINDS:
        raise ValueError(f"unknown phase function '{name}'; known are {', '.join(KINDS)}")
    return KINDS[name]


class DescribedPhase(BaseModel):
    """A phase function in a description, by its kind and its own parameters."""

    model_config = ConfigDict(frozen=True, extra="allow", allow_inf_nan=False)

    kind: str

    def phase_function(self) -> PhaseFunction:
        """The phase function; ValueError where the kind or a parameter is unknown or out of range."""
        try:
            return phase_function_kind(self.kind)(**(self.model_extra or {}))
        except TypeError as error:
            raise ValueError(f"the phase function '{self.kind}' does not have these parameters: {error}") from error


@dataclass(frozen=True)
class Scatterer:
    """One kind of scatterers in a medium: its part of the scattering coefficient in 1/mm, and its phase function."""

    coefficient_per_mm: float
    phase: PhaseFunction
