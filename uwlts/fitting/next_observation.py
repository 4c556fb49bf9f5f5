"""Selection of the next observation by the reduction of the uncertainty of given functions of the parameters.

Each candidate adds information (inverse covariance) to what is known, so that its effect follows before it is recorded
(Atkinson, Donev and Tobias, Optimum Experimental Designs, 2007).
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Self

import numpy as np

_LEAST_EIGENVALUE = 1e-15
"""Smallest eigenvalue of information with a unit diagonal, relative to the largest: less is a rounding error."""
_HELPFUL = 0.95  # ratio to the previous uncertainty; less than a twentieth is not an improvement


@dataclass(frozen=True, eq=False)
class CovarianceRoot:
    """Covariance (P, P) of parameters, ``root @ root.T``, as ``root`` (P, K).

    The inverse of a covariance may be inaccurate where parameters are strongly correlated; the root needs none.
    """

    root: np.ndarray

    @classmethod
    def from_covariance(cls, covariance: np.ndarray) -> Self:
        """Return the symmetric root (P, P), computed from the correlations.

        It does not depend on the platform, so its columns (independent parts of the parameters) can be compared.
        """
        scale = np.sqrt(np.diag(covariance))
        scale = np.where(scale > 0, scale, 1.0)
        values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
        return cls(scale[:, None] * ((vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T))

    @classmethod
    def from_information(cls, information: np.ndarray) -> Self:
        """Return the root for information (P, P); directions without information get a huge variance."""
        scale = 1.0 / np.sqrt(np.diag(information))
        values, vectors = np.linalg.eigh(scale[:, None] * information * scale)
        return cls(scale[:, None] * vectors / np.sqrt(np.maximum(values, _LEAST_EIGENVALUE * values[-1])))

    def with_information(self, information: np.ndarray) -> Self:
        """Return the root after an independent observation that adds information (P, P)."""
        values, vectors = np.linalg.eigh(np.eye(self.root.shape[1]) + self.root.T @ information @ self.root)
        return type(self)(self.root @ vectors / np.sqrt(np.maximum(values, 1.0)))

    def covariance(self) -> np.ndarray:
        """Return the covariance (P, P)."""
        return self.root @ self.root.T

    def std(self, functions: np.ndarray) -> np.ndarray:
        """Return the standard uncertainties (M,) of functions with derivatives (M, P) by the parameters."""
        return np.linalg.norm(functions @ self.root, axis=1)


@dataclass(frozen=True, eq=False, kw_only=True)
class Candidate:
    """Observation that may be made next, as text, and the information (P, P) that it adds to the parameters.

    ``pose`` (4, 4) is that of the object to observe, or of what carries the sensor; ``single`` is False if several
    motions lead there.
    """

    words: str = ""
    information: np.ndarray
    pose: np.ndarray
    single: bool = True


@dataclass(frozen=True, eq=False)
class Forecast:
    """Expected effect of a candidate.

    ``before`` and ``after`` are the figure to be reduced without and with the candidate, as a rule the root mean square
    of the uncertainties of the functions. ``known`` is the covariance of the parameters with it.
    """

    candidate: Candidate
    before: float
    after: float
    known: CovarianceRoot

    @property
    def gain(self) -> float:
        """Reduction of the figure."""
        return self.before - self.after

    @property
    def helpful(self) -> bool:
        """True if the candidate reduces the figure enough to be advised."""
        return self.after <= _HELPFUL * self.before

    def advice(self, lengths: str) -> str:
        """Describe the candidate as advice for the uncertainty of ``lengths``, mm, without a full stop."""
        if not self.helpful:
            return f"no single further image would reduce the uncertainty of {lengths} by a twentieth"
        return (
            f"{self.candidate.words} would reduce the standard uncertainty of {lengths} from {self.before:.4f} to "
            f"{self.after:.4f} mm"
        )


def rank_candidates(
    known: CovarianceRoot,
    functions: np.ndarray,
    candidates: Iterable[Candidate],
    *,
    figure: Callable[[np.ndarray, Candidate | None], float] | None = None,
) -> list[Forecast]:
    """Return the expected effect of each candidate, the most helpful one first.

    For several observations in turn, rank the remaining candidates again from the best forecast's ``known``.

    ``known`` is the covariance of the P parameters before; ``functions`` (M, P) are derivatives of the functions of
    interest, for example of lengths. ``figure`` is to be reduced, a function of the standard uncertainties (M,) and the
    candidate (None: before it), by default their root mean square. Candidates with equal effect stay in their order.
    """
    measure = figure or (lambda std, _: float(np.sqrt(np.mean(std**2))))
    before, found = measure(known.std(functions), None), []
    for candidate in candidates:
        after = known.with_information(candidate.information)
        found.append(Forecast(candidate, before, measure(after.std(functions), candidate), after))
    return sorted(found, key=lambda each: each.after)


def eliminate_others(information: np.ndarray, count: int) -> np.ndarray:
    """Return the information (P, P) on the first ``count`` parameters if all others are unknown (Schur complement)."""
    border, block = information[:count, count:], information[count:, count:]
    scale = 1.0 / np.sqrt(np.diag(block))
    border, block = border * scale, block * np.outer(scale, scale)
    return information[:count, :count] - border @ np.linalg.solve(block, border.T)
