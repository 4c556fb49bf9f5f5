"""Uncertainty budgets after the GUM (JCGM 100:2008), for uncorrelated sources."""

import math
from collections.abc import Iterable
from dataclasses import dataclass

from scipy import stats

from uwlts.errors import RangeError

UNIFORM = 1 / math.sqrt(3)
"""Standard deviation of a uniform distribution divided by its half-width (GUM 4.3.7)."""


@dataclass(frozen=True, kw_only=True)
class UncertaintySource:
    """Source of uncertainty, in the unit of the result.

    ``standard_uncertainty`` is at least 0, ``degrees_of_freedom`` at least 1, infinite if exactly known. ``correction``
    is to be added to the result.
    """

    name: str
    standard_uncertainty: float
    degrees_of_freedom: float = math.inf
    correction: float = 0.0


@dataclass(frozen=True, kw_only=True)
class Budget:
    """Combined uncertainty u_c of all sources (GUM Eq. 10), in the unit of the result.

    ``shares_percent`` are each source's contributions to u_c squared. ``degrees_of_freedom`` are effective, from the
    Welch-Satterthwaite formula (GUM G.4.1, Eq. G.2b), not rounded. ``coverage_factor`` k is Student's t for them,
    truncated to an integer (GUM G.4.1, note 1); ``expanded_uncertainty`` is k u_c. ``correction`` is the sum of the
    sources' corrections. ``largest_error`` applies to an uncorrected result: its absolute correction plus U (thesis
    section 4.8.5; the GUM would correct).
    """

    sources: tuple[UncertaintySource, ...]
    standard_uncertainty: float
    shares_percent: tuple[float, ...]
    degrees_of_freedom: float
    coverage_factor: float
    expanded_uncertainty: float
    correction: float
    largest_error: float


def combine(sources: Iterable[UncertaintySource], *, coverage_probability: float = 0.95) -> Budget:
    """Combine uncorrelated sources.

    The thesis's U of 0.37 mm (Table 9) has a coverage of 95.45 %, the probability of two normal standard deviations; 95
    % gives 0.36.

    Raises RangeError if no source has an uncertainty.
    """
    sources = tuple(sources)
    parts = [source.standard_uncertainty for source in sources]
    total = math.hypot(*parts)
    if not total > 0:
        raise RangeError(f"none of {len(sources)} sources has an uncertainty; expected at least one")
    spread = sum((part / total) ** 4 / s.degrees_of_freedom for part, s in zip(parts, sources, strict=True))
    freedom = 1 / spread if spread > 0 else math.inf
    # Rounding errors must not turn 5 degrees of freedom into 4.
    whole = math.floor(freedom * (1 + 1e-9)) if math.isfinite(freedom) else math.inf
    factor = float(stats.t.ppf((1 + coverage_probability) / 2, whole))
    correction = sum(source.correction for source in sources)
    return Budget(
        sources=sources,
        standard_uncertainty=total,
        shares_percent=tuple(100 * (part / total) ** 2 for part in parts),
        degrees_of_freedom=freedom,
        coverage_factor=factor,
        expanded_uncertainty=factor * total,
        correction=correction,
        largest_error=abs(correction) + factor * total,
    )
