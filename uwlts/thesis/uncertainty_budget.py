"""Uncertainty budgets after the GUM (JCGM 100:2008), for sources that are not correlated."""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

from scipy import stats

from uwlts.errors import RangeError

Distribution = Literal["normal", "uniform", "triangular"]
_DIVISORS = {"normal": 1.0, "uniform": math.sqrt(3.0), "triangular": math.sqrt(6.0)}


@dataclass(frozen=True, kw_only=True)
class UncertaintySource:
    """A source of uncertainty, in a unit of its own.

    Attributes
    ----------
    name : str
    half_width : float
        Of a uniform or triangular distribution; of a normal one ``coverage_factor`` times its standard deviation.
    distribution : "normal", "uniform" or "triangular"
    sensitivity : float
        Change of the result per change of the source.
    degrees_of_freedom : float
        At least 1; infinite where the half-width itself is certain.
    correction : float
        To be added to the source's estimate.
    coverage_factor : float
        Only for a normal distribution: 2 for a certificate that says "k = 2".

    Raises
    ------
    RangeError
        A number is outside its range, or a coverage factor is given with a distribution that has a half-width.
    """

    name: str
    half_width: float
    distribution: Distribution = "normal"
    sensitivity: float = 1.0
    degrees_of_freedom: float = math.inf
    correction: float = 0.0
    coverage_factor: float = 1.0

    def __post_init__(self) -> None:
        factor, kind = self.coverage_factor, self.distribution
        numbers = f"sensitivity {self.sensitivity:g} and correction {self.correction:g}"
        refusals = [
            (kind not in _DIVISORS, f"unknown distribution '{kind}'; known are {', '.join(_DIVISORS)}"),
            (not all(map(math.isfinite, (self.sensitivity, self.correction))), f"{numbers}; both must be finite"),
            (
                not 0 <= self.half_width < math.inf,
                f"half_width is {self.half_width:g}; expected a finite number, at least 0",
            ),
            (not self.degrees_of_freedom >= 1, f"{self.degrees_of_freedom:g} degrees of freedom; expected at least 1"),
            (not 0 < factor < math.inf, f"coverage_factor is {factor:g}; expected a positive number"),
            (kind != "normal" and factor != 1, f"a {kind} distribution has no coverage factor, found {factor:g}"),
        ]
        for refused, message in refusals:
            if refused:
                raise RangeError(f"{self.name}: {message}")

    @property
    def standard_uncertainty(self) -> float:
        """u in the unit of the result: half-width over divisor (GUM 4.3), times sensitivity (GUM 5.1.3)."""
        return abs(self.sensitivity) * self.half_width / (_DIVISORS[self.distribution] * self.coverage_factor)


@dataclass(frozen=True, kw_only=True)
class Budget:
    """Combined uncertainty u_c of all sources (GUM Eq. 10), in the unit of the result.

    ``shares_percent`` are each source's part of u_c squared. ``degrees_of_freedom`` are effective, by Welch and
    Satterthwaite (GUM G.4.1, Eq. G.2b), not rounded. ``coverage_factor`` k is Student's t for them cut to an integer
    (GUM G.4.1, note 1), ``expanded_uncertainty`` k u_c. ``correction`` is the sum of the sources' corrections, each
    times its sensitivity, ``largest_error`` that of a result that is left uncorrected: its size and U together (thesis
    section 4.8.5; the GUM would correct).
    """

    sources: tuple[UncertaintySource, ...]
    standard_uncertainty: float
    shares_percent: tuple[float, ...]
    degrees_of_freedom: float
    coverage_probability: float
    coverage_factor: float
    expanded_uncertainty: float
    correction: float
    largest_error: float


def combine(sources: Iterable[UncertaintySource], *, coverage_probability: float = 0.95) -> Budget:
    """Combine sources that are not correlated.

    The thesis's U of 0.37 mm (Table 9) has 95.45 %, the probability of two normal standard deviations; 95 % give 0.36.

    Raises
    ------
    RangeError
        No source has an uncertainty, or the probability is not between 0 and 1.
    """
    sources = tuple(sources)
    if not 0 < coverage_probability < 1:
        raise RangeError(f"coverage_probability is {coverage_probability:g}; expected one between 0 and 1")
    parts = [source.standard_uncertainty for source in sources]
    total = math.hypot(*parts)
    if total == 0:
        raise RangeError(f"none of {len(sources)} sources has an uncertainty; give at least one that has")
    spread = sum((part / total) ** 4 / s.degrees_of_freedom for part, s in zip(parts, sources, strict=True))
    freedom = 1 / spread if spread > 0 else math.inf
    # Rounding must not turn 5 degrees of freedom into 4.
    whole = math.floor(freedom * (1 + 1e-9)) if math.isfinite(freedom) else math.inf
    factor = float(stats.t.ppf((1 + coverage_probability) / 2, whole))
    correction = sum(source.sensitivity * source.correction for source in sources)
    return Budget(
        sources=sources,
        standard_uncertainty=total,
        shares_percent=tuple(100 * (part / total) ** 2 for part in parts),
        degrees_of_freedom=freedom,
        coverage_probability=coverage_probability,
        coverage_factor=factor,
        expanded_uncertainty=factor * total,
        correction=correction,
        largest_error=abs(correction) + factor * total,
    )


def thermal_expansion_mm(*, length_mm: float, alpha_per_k: float, temperature_change_k: float) -> float:
    """By how much a length grows: alpha L dT.

    The thesis's +- 0.011 mm of the sphere spacing over 5 K take 23e-6 per K, aluminium.
    """
    if not all(map(math.isfinite, (length_mm, alpha_per_k, temperature_change_k))):
        raise RangeError(f"{length_mm:g} mm, {alpha_per_k:g} per K, {temperature_change_k:g} K: all must be finite")
    return length_mm * alpha_per_k * temperature_change_k
