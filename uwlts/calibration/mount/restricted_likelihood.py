"""Restricted maximum likelihood estimate of parameters and variance components from groups of residuals."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Generic, Self, TypeVar

import numpy as np
from scipy import special
from scipy.optimize import least_squares, minimize

from uwlts.errors import CalibrationError

_FALSE_ALARM = 1e-3  # probability that any pose of a campaign without wrong poses is rejected, for normal errors
LARGEST_ROUGH = 6.0  # multiple of the median misfit of a pose: of 45 normal poses, one in millions exceeds it
_SETTLED = 0.01
"""Last step in standard uncertainties, and last change of the likelihood, too small to change any stated figure."""
_SHRINKING = 0.7
"""Ratio of successive steps with opposite signs above which steps are damped; below it the rounds suffice."""
_MOST_ROUNDS = 60
"""Rounds after which an estimate has not converged: four halvings of the step, and ten rounds for each."""
_SPELL = 10
"""Rounds in which the steps must halve, or the estimate will not converge: 60 rounds make them 64 times smaller."""
_LEAST_FRACTION = 1 / 16  # smallest fraction of a step: it damps steps that overshoot up to 30-fold
_LEAST_EIGENVALUE = 1e-13  # smallest eigenvalue of information with a unit diagonal: below it, rounding errors dominate


State = TypeVar("State")


class GroupedEvidence(ABC, Generic[State]):
    """Groups of residuals (one group for each pose), their derivatives, and the variances of their errors.

    Groups have K residuals; shorter ones are padded with zeros of unit variance. ``logs`` (Q,) are logarithms of the
    variance components' standard deviations and lengths. ``free`` (V, size) maps parameters to all V values. On a
    rotary table (``table``), a shift of the mount along its z axis and a rotation about it have no effect and are not
    parameters.
    """

    table: bool

    @property
    @abstractmethod
    def values(self) -> int:
        """Number of values; the first six are shift and rotation of the mount."""

    @cached_property
    def free(self) -> np.ndarray:
        every = np.eye(self.values)
        return np.delete(every, (2, 5), axis=1) if self.table else every

    @property
    def size(self) -> int:
        """Number of parameters."""
        return self.free.shape[1]

    @abstractmethod
    def select(self, kept: np.ndarray) -> Self:
        """Return the evidence of some groups, given as a mask or as their numbers."""

    @abstractmethod
    def bounds(self) -> np.ndarray:
        """Return bounds (Q, 2) of the components; equal for a fixed one."""

    @abstractmethod
    def apply_step(self, state: State, step: np.ndarray) -> State:
        """Return the state after a step (size,) of the parameters."""

    @abstractmethod
    def residuals(self, state: State, step: np.ndarray | None = None) -> np.ndarray:
        """Return residuals (G, K) after a step from a state; the noise of the data stays as at the state."""

    @abstractmethod
    def jacobian(self, state: State, step: np.ndarray | None = None) -> np.ndarray:
        """Return derivatives (G, K, size) of the residuals by the step."""

    @abstractmethod
    def covariance(self, state: State) -> Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]:
        """Return a function of ``logs`` that gives covariances (G, K, K) and their derivatives (Q, G, K, K)."""

    def pool_repeats(self, state: State) -> tuple[int, float]:
        """Return degrees of freedom and sum of squares of further residuals that have the first component only."""
        return 0, 0.0

    @abstractmethod
    def pose_directions(self, state: State) -> Sequence[np.ndarray]:
        """Return orthonormal bases (K, q) of the residual changes that a wrong pose can cause in each group."""


@dataclass(frozen=True, eq=False)
class RestrictedEstimate(Generic[State]):
    """Parameters and variance components; ``criterion`` is minus twice the log likelihood at convergence."""

    evidence: GroupedEvidence[State]
    state: State
    scatter: np.ndarray
    criterion: float = np.inf

    @cached_property
    def residuals(self) -> np.ndarray:
        """Residuals (G, K)."""
        return self.evidence.residuals(self.state)

    @cached_property
    def jacobian(self) -> np.ndarray:
        """Derivatives (G, K, size)."""
        return self.evidence.jacobian(self.state)

    @cached_property
    def covariances(self) -> tuple[np.ndarray, np.ndarray]:
        """Covariances of the residuals (G, K, K) and their derivatives (Q, G, K, K) by the components."""
        return self.evidence.covariance(self.state)(np.log(self.scatter))

    @cached_property
    def _weighted(self) -> np.ndarray:
        """Inverse covariance times derivatives (G, K, size)."""
        return np.linalg.solve(self.covariances[0], self.jacobian)

    @cached_property
    def information(self) -> np.ndarray:
        """Information (G, size, size) of each group on the parameters."""
        return np.swapaxes(self.jacobian, 1, 2) @ self._weighted

    @cached_property
    def covariance(self) -> np.ndarray:
        """Covariance (size, size) of the parameters."""
        return invert_information(self.information.sum(axis=0))

    def propagate(self, moved: np.ndarray) -> np.ndarray:
        """Return derivatives (size, M) of the parameters, given those of the residuals, ``moved`` (G, K, M)."""
        return -self.covariance @ np.einsum("gkp,gkm->pm", self._weighted, moved)

    @cached_property
    def without_each(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """Parameter step (a Gauss-Newton step) and covariance of the parameters without each group."""
        slopes = np.einsum("gkp,gk->gp", self._weighted, self.residuals)
        total, slope, found = self.information.sum(axis=0), slopes.sum(axis=0), []
        for information, each in zip(self.information, slopes, strict=True):
            covariance = invert_information(total - information)
            found.append((-covariance @ (slope - each), covariance))
        return found

    def excess(self, *, probability: float) -> np.ndarray:
        """Return each pose's squared distance (G,) from the others' prediction, divided by its limit.

        One correct pose exceeds 1 with ``probability``. The limit is that of an F distribution, because the scatter is
        estimated from as many directions as the poses have, less the parameters.
        """
        excess, bases = [], self.evidence.pose_directions(self.state)
        freedom = max(sum(basis.shape[1] for basis in bases) - self.evidence.size, 1)
        for g, (basis, (step, covariance)) in enumerate(zip(bases, self.without_each, strict=True)):
            by = basis.T @ self.jacobian[g]
            spread = by @ covariance @ by.T + basis.T @ self.covariances[0][g] @ basis
            off = basis.T @ self.residuals[g] + by @ step
            limit = len(off) * special.fdtri(len(off), freedom, 1 - probability)
            excess.append(float(off @ np.linalg.solve(spread, off) / limit))
        return np.array(excess)

    def coverage_factor(self, scales: np.ndarray, rows: np.ndarray) -> float:
        """Return the coverage factor (Student's t) for 95 % intervals of ``rows`` (R, size) of the parameters.

        The degrees of freedom follow from Satterthwaite's formula: twice the squared variance, divided by the variance
        of that variance (Giesbrecht and Burns, Biometrics 41, 1985). ``scales`` (R,) are the fractions of the variances
        that are estimated; the rest is known. The median over the rows is used.
        """
        covariances, changes = self.covariances
        summed = self.covariance @ (np.swapaxes(self._weighted, 1, 2) @ changes @ self._weighted).sum(axis=1)
        left = np.linalg.inv(covariances) @ changes
        twice = np.einsum("gkp,agkl,bglm,gmq->abpq", self.jacobian, left, left, self._weighted, optimize=True)
        known = 0.5 * (np.einsum("agkl,bglk->ab", left, left) + np.einsum("apq,bqp->ab", summed, summed))
        known -= np.einsum("pq,abqp->ab", self.covariance, twice)
        known[0, 0] += 2 * self.evidence.pool_repeats(self.state)[0]
        free = np.diag(known) > 0
        variances = np.einsum("rp,pq,rq->r", rows, self.covariance, rows)
        by = np.einsum("rp,qpm,mn,rn->rq", rows, summed, self.covariance, rows)[:, free]
        uncertain = np.einsum("rq,qs,rs->r", by, invert_information(known[free][:, free]), by)
        freedom = 2 * variances**2 / np.maximum(uncertain * scales**2, 1e-30 * variances**2)
        return float(special.stdtrit(max(float(np.median(freedom)), 1.0), 0.975))


def settle(evidence: GroupedEvidence[State], starts: Sequence[tuple[State, np.ndarray]]) -> RestrictedEstimate[State]:
    """Iterate from several states and components; return the likeliest converged estimate.

    Raises CalibrationError if the iteration converges from none of the starts.
    """
    found, failed = [], None
    for state, scatter in starts:
        try:
            found.append(_iterate(evidence, state, scatter))
        except NotSettled as error:
            failed = error
    if not found:
        assert failed is not None
        raise failed
    return min(found, key=lambda each: each.criterion)


def settle_agreeing(
    evidence: GroupedEvidence[State],
    starts: Sequence[tuple[State, np.ndarray]],
    *,
    require: Callable[[np.ndarray], None],
) -> tuple[RestrictedEstimate[State], np.ndarray]:
    """Estimate from the groups that agree, and return their mask (G,).

    The worst group is rejected as long as it contradicts the prediction of the others. ``require`` raises an error if a
    mask (G,) leaves too few groups.
    """
    kept = np.ones(len(evidence.residuals(starts[0][0])), dtype=bool)
    while True:
        require(kept)
        found = settle(evidence.select(kept), starts)
        excess = found.excess(probability=_FALSE_ALARM / len(kept))
        if excess.max() <= 1:
            return found, kept
        kept[np.flatnonzero(kept)[np.argmax(excess)]] = False
        starts = [(found.state, found.scatter)]


class NotSettled(CalibrationError):
    """The iteration has not converged after all rounds; ``last`` is its last estimate."""

    def __init__(self, text: str, last: RestrictedEstimate[Any]) -> None:
        super().__init__(text)
        self.last = last


def _iterate(evidence: GroupedEvidence[State], state: State, scatter: np.ndarray) -> RestrictedEstimate[State]:
    """Alternate weighted least squares and maximum likelihood of the components; damp oscillating steps."""
    fraction, before, size, criterion = 1.0, np.zeros(evidence.size), 0.0, np.inf
    sizes: list[float] = []
    for _ in range(_MOST_ROUNDS):
        here = RestrictedEstimate(evidence, state, scatter)
        step, information = solve_step(evidence, state, here.covariances[0]), here.information.sum(axis=0)
        size, last = (float(np.sqrt(each @ information @ each / evidence.size)) for each in (step, before))
        if step @ information @ before >= 0:
            fraction = min(2 * fraction, 1.0)
        elif size > _SHRINKING * last:
            fraction = max(fraction / 2, _LEAST_FRACTION)
        before = step
        state = evidence.apply_step(state, fraction * step)
        scatter, criterion, gain = _maximise_likelihood(evidence, state, scatter)
        if size < _SETTLED and gain < _SETTLED:
            return RestrictedEstimate(evidence, state, scatter, criterion)
        sizes.append(size)
        earlier, latest = sizes[-2 * _SPELL : -_SPELL], sizes[-_SPELL:]
        if len(earlier) == _SPELL and np.median(latest) > max(np.median(earlier) / 2, _SETTLED):
            break
    raise NotSettled(
        f"the estimate of the mount does not converge: after {len(sizes)} rounds it still changes by {size:.2g} "
        "standard uncertainties. Record more poses, with rotations about two axes and the artefact in all parts of the "
        "profile",
        RestrictedEstimate(evidence, state, scatter, criterion),
    )


def solve_step(
    evidence: GroupedEvidence[State], state: State, covariances: np.ndarray, *, loss: str = "linear"
) -> np.ndarray:
    """Return the step (size,) from a state that minimises the weighted squared residuals, with fixed covariances."""
    whitener = np.linalg.inv(np.linalg.cholesky(covariances))

    def misfit(step: np.ndarray) -> np.ndarray:
        return (whitener @ evidence.residuals(state, step)[..., None]).ravel()

    def jacobian(step: np.ndarray) -> np.ndarray:
        return (whitener @ evidence.jacobian(state, step)).reshape(-1, evidence.size)

    return least_squares(
        misfit,
        np.zeros(evidence.size),
        jacobian,  # pyright: ignore[reportArgumentType]
        loss=loss,
        x_scale="jac",
        max_nfev=60,
    ).x


def _maximise_likelihood(
    evidence: GroupedEvidence[State], state: State, start: np.ndarray
) -> tuple[np.ndarray, float, float]:
    """Maximise the restricted likelihood at a state; return the variance components, the criterion and its gain.

    The criterion is minus twice the log likelihood of the residuals after projecting out the parameters (Patterson and
    Thompson, Biometrika 58, 1971).
    """
    residuals, covariance = evidence.residuals(state), evidence.covariance(state)
    # Every basis of the derivatives has the same likelihood. They are nearly dependent if the base is far away.
    by = evidence.jacobian(state)
    basis = np.linalg.qr(by.reshape(-1, evidence.size))[0].reshape(by.shape)
    freedom, squares = evidence.pool_repeats(state)

    def criterion(logs: np.ndarray) -> tuple[float, np.ndarray]:
        covariances, changes = covariance(logs)
        weights = np.linalg.inv(covariances)
        weighted = weights @ basis
        information = np.einsum("gkp,gkq->pq", basis, weighted)
        across = np.linalg.solve(information, np.einsum("gkp,gk->p", weighted, residuals))
        left = np.einsum("gkl,gl->gk", weights, residuals - basis @ across)
        value = float(
            np.linalg.slogdet(covariances)[1].sum() + np.linalg.slogdet(information)[1] + np.sum(left * residuals)
        )
        inner = weights - weighted @ np.linalg.solve(information, np.swapaxes(weighted, 1, 2))
        slope = np.einsum("qgkl,gkl->q", changes, inner - left[:, :, None] * left[:, None, :])
        repeated = squares * np.exp(-2 * logs[0])
        slope[0] += 2 * (freedom - repeated)
        return value + 2 * freedom * float(logs[0]) + repeated, slope

    bounds = np.log(evidence.bounds())
    begin = np.clip(np.log(start), *bounds.T)
    found = minimize(criterion, begin, jac=True, method="L-BFGS-B", bounds=bounds)
    return np.exp(found.x), float(found.fun), criterion(begin)[0] - float(found.fun)


def invert_information(information: np.ndarray) -> np.ndarray:
    """Invert an information matrix; directions without information get huge variances."""
    size = 1 / np.sqrt(np.maximum(np.diag(information), 1e-30))
    values, vectors = np.linalg.eigh(size[:, None] * information * size)
    return size[:, None] * (vectors / np.maximum(values, _LEAST_EIGENVALUE)) @ vectors.T * size
