"""Estimate parameters and variance components together from groups of residuals (restricted maximum likelihood)."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Generic, Self, TypeVar

import numpy as np
from scipy.optimize import least_squares, minimize
from scipy.stats import chi2, t

from uwlts.errors import CalibrationError

_FALSE_ALARM = 1e-3
"""Probability that any pose of a campaign without wrong ones is left out."""
LARGEST_ROUGH = 6.0
"""Times the median misfit of a pose: of 45 normal poses one in millions lies farther out."""
_SETTLED = 0.01
"""Last step in standard uncertainties, and last change of the likelihood, which no stated figure shows."""
_SHRINKING = 0.7
"""Ratio of successive steps of opposite directions from which they are damped: faster ones settle within the rounds."""
_MOST_ROUNDS = 60
"""Rounds after which an estimate counts as not settled: four halvings of the steps, and ten rounds for each."""
_LEAST_FRACTION = 1 / 16
"""Smallest fraction of a step: it damps steps that overshoot up to 30-fold."""
_LEAST_EIGENVALUE = 1e-13
"""Of information with a unit diagonal: below, rounding errors count and a direction is open."""


State = TypeVar("State")


class GroupedEvidence(ABC, Generic[State]):
    """Groups of residuals (one group for each pose), their derivatives, and the variances of their errors.

    Groups have K residuals; shorter ones are filled up with zeros, of unit variance. ``logs`` (Q,) are logarithms of
    the variance components' standard deviations, and of lengths. ``free`` (V, size) are steps of all V values by the
    parameters: on a rotary table (``table``) shift of the mount along its z axis and turn about it change nothing, and
    are none.
    """

    table: bool

    @property
    @abstractmethod
    def values(self) -> int:
        """Number of values, of which the first six are shift and turn of the mount."""

    @cached_property
    def free(self) -> np.ndarray:
        every = np.eye(self.values)
        return np.delete(every, (2, 5), axis=1) if self.table else every

    @property
    def size(self) -> int:
        """Number of parameters."""
        return self.free.shape[1]

    @property
    @abstractmethod
    def groups(self) -> int:
        """Number of groups."""

    @abstractmethod
    def selected(self, kept: np.ndarray) -> Self:
        """Evidence of some of the groups: a mask, or their numbers."""

    @abstractmethod
    def bounds(self) -> np.ndarray:
        """Bounds (Q, 2) of the components; equal where one is fixed."""

    @abstractmethod
    def stepped(self, state: State, step: np.ndarray) -> State:
        """State after a step (size,) of the parameters."""

    @abstractmethod
    def residuals(self, state: State, step: np.ndarray | None = None) -> np.ndarray:
        """Residuals (G, K) after a step from a state, with the noise of the data as at the state."""

    @abstractmethod
    def jacobian(self, state: State, step: np.ndarray | None = None) -> np.ndarray:
        """Derivatives (G, K, size) of the residuals by the step."""

    @abstractmethod
    def covariance(self, state: State) -> Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]:
        """Function of ``logs`` that returns covariances (G, K, K) and their derivatives (Q, G, K, K) by ``logs``."""

    def repeated(self, state: State) -> tuple[int, float]:
        """Degrees of freedom and sum of squares of further residuals that show the first component alone; none."""
        return 0, 0.0

    @abstractmethod
    def pose_directions(self, state: State) -> Sequence[np.ndarray]:
        """Orthonormal bases (K, q) of all that a wrong pose does to the residuals of each group."""


@dataclass(frozen=True, eq=False)
class RestrictedEstimate(Generic[State]):
    """Parameters and variance components; ``criterion`` is minus twice the log likelihood where they settled."""

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
    def _covariances(self) -> tuple[np.ndarray, np.ndarray]:
        return self.evidence.covariance(self.state)(np.log(self.scatter))

    @cached_property
    def _weighted(self) -> np.ndarray:
        """Inverse covariance times derivatives (G, K, size)."""
        return np.linalg.solve(self._covariances[0], self.jacobian)

    @cached_property
    def information(self) -> np.ndarray:
        """Information (G, size, size) of each group on the parameters."""
        return np.swapaxes(self.jacobian, 1, 2) @ self._weighted

    @cached_property
    def covariance(self) -> np.ndarray:
        """Covariance (size, size) of the parameters."""
        return inverse(self.information.sum(axis=0))

    def by(self, moved: np.ndarray) -> np.ndarray:
        """Derivatives (size, M) of the parameters by what moves the residuals by ``moved`` (G, K, M)."""
        return -self.covariance @ np.einsum("gkp,gkm->pm", self._weighted, moved)

    @cached_property
    def without_each(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """For every group the step of the parameters without it (a Gauss-Newton step), and their covariance then."""
        slopes = np.einsum("gkp,gk->gp", self._weighted, self.residuals)
        total, slope, found = self.information.sum(axis=0), slopes.sum(axis=0), []
        for information, own in zip(self.information, slopes, strict=True):
            covariance = inverse(total - information)
            found.append((-covariance @ (slope - own), covariance))
        return found

    def excess(self, *, probability: float) -> np.ndarray:
        """Squared distance (G,) of each pose from what the others predict, divided by what it exceeds by chance.

        Squares are chi-square; ``probability`` is that of one pose to exceed 1.
        """
        excess, bases = [], self.evidence.pose_directions(self.state)
        for g, (basis, (step, covariance)) in enumerate(zip(bases, self.without_each, strict=True)):
            by = basis.T @ self.jacobian[g]
            spread = by @ covariance @ by.T + basis.T @ self._covariances[0][g] @ basis
            off = basis.T @ self.residuals[g] + by @ step
            excess.append(float(off @ np.linalg.solve(spread, off) / chi2.isf(probability, len(off))))
        return np.array(excess)

    def coverage_factor(self, scales: np.ndarray, rows: np.ndarray) -> float:
        """Student's factor for 95 % intervals of ``rows`` (R, size) of the parameters.

        Degrees of freedom are by Satterthwaite, from how well the variance components are known: twice the square of
        a variance divided by the variance of that (Giesbrecht and Burns, Biometrics 41, 1985). ``scales`` (R,) are
        shares of the variances that the estimate makes; the rest is known. The median of the rows counts.
        """
        _, changes = self._covariances
        inverses = np.linalg.inv(self._covariances[0])
        flows = [np.swapaxes(self._weighted, 1, 2) @ change @ self._weighted for change in changes]
        summed = self.covariance @ np.sum(flows, axis=1)
        left = [inverses @ change for change in changes]
        size = len(changes)
        known = np.zeros((size, size))
        for a in range(size):
            for b in range(size):
                twice = np.einsum("gkp,gkl,glm->pm", self.jacobian, left[a] @ left[b], self._weighted)
                known[a, b] = 0.5 * (
                    np.sum(left[a] * np.swapaxes(left[b], 1, 2))
                    - 2 * np.sum(self.covariance * twice.T)
                    + np.sum(summed[a] * summed[b].T)
                )
        known[0, 0] += 2 * self.evidence.repeated(self.state)[0]
        free = np.diag(known) > 0
        variances = np.einsum("rp,pq,rq->r", rows, self.covariance, rows)
        by = np.einsum("rp,qpm,mn,rn->rq", rows, summed, self.covariance, rows)[:, free]
        uncertain = np.einsum("rq,qs,rs->r", by, inverse(known[free][:, free]), by)
        freedom = 2 * variances**2 / np.maximum(uncertain * scales**2, 1e-30 * variances**2)
        return float(t.ppf(0.975, max(float(np.median(freedom)), 1.0)))


def settle(evidence: GroupedEvidence[State], starts: Sequence[tuple[State, np.ndarray]]) -> RestrictedEstimate[State]:
    """The likeliest of the estimates to which the iterations from several states and components settle.

    Raises
    ------
    CalibrationError
        None of them settles.
    """
    found, failed = [], None
    for state, scatter in starts:
        try:
            found.append(_settled(evidence, state, scatter))
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
    """Estimate from the groups that agree, and their mask (G,).

    While a group contradicts what the others predict, the worst one is left out. ``require`` raises an error where a
    mask (G,) leaves too few groups.
    """
    kept = np.ones(evidence.groups, dtype=bool)
    while True:
        require(kept)
        found = settle(evidence.selected(kept), starts)
        excess = found.excess(probability=_FALSE_ALARM / len(kept))
        if excess.max() <= 1:
            return found, kept
        kept[np.flatnonzero(kept)[np.argmax(excess)]] = False
        starts = [(found.state, found.scatter)]


class NotSettled(CalibrationError):
    """An iteration that still changes its result after all rounds."""


def _settled(evidence: GroupedEvidence[State], state: State, scatter: np.ndarray) -> RestrictedEstimate[State]:
    """Weighted least squares and likeliest components by turns; steps that oscillate are damped."""
    fraction, before, size = 1.0, np.zeros(evidence.size), 0.0
    for _ in range(_MOST_ROUNDS):
        covariances, _ = evidence.covariance(state)(np.log(scatter))
        step = solved_step(evidence, state, covariances)
        by = evidence.jacobian(state)
        information = np.einsum("gkp,gkq->pq", by, np.linalg.solve(covariances, by))
        size, last = (float(np.sqrt(each @ information @ each / evidence.size)) for each in (step, before))
        if step @ information @ before >= 0:
            fraction = min(2 * fraction, 1.0)
        elif size > _SHRINKING * last:
            fraction = max(fraction / 2, _LEAST_FRACTION)
        before = step
        state = evidence.stepped(state, fraction * step)
        scatter, criterion, gain = _likeliest(evidence, state, scatter)
        if size < _SETTLED and gain < _SETTLED:
            return RestrictedEstimate(evidence, state, scatter, criterion)
    raise NotSettled(
        f"the estimate of the mount does not settle: after {_MOST_ROUNDS} rounds it still moves by {size:.2g} standard "
        "uncertainties. Record more poses, with turns about two axes and the artefact in all parts of the profile"
    )


def solved_step(
    evidence: GroupedEvidence[State], state: State, covariances: np.ndarray, *, loss: str = "linear"
) -> np.ndarray:
    """The step (size,) from a state to the least weighted squares of the residuals, the covariances held fixed."""
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


def _likeliest(evidence: GroupedEvidence[State], state: State, start: np.ndarray) -> tuple[np.ndarray, float, float]:
    """Variance components of the greatest restricted likelihood at a state, the criterion, and the gain in it.

    Patterson and Thompson 1971: minus twice the log likelihood of what is left of the residuals after the parameters.
    """
    residuals, covariance = evidence.residuals(state), evidence.covariance(state)
    # Any basis of the derivatives has the same likelihood. They are nearly dependent where the base is far away.
    by = evidence.jacobian(state)
    basis = np.linalg.qr(by.reshape(-1, evidence.size))[0].reshape(by.shape)
    freedom, squares = evidence.repeated(state)

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


def inverse(information: np.ndarray) -> np.ndarray:
    """Covariance of an information matrix; directions without information get huge variances."""
    size = 1 / np.sqrt(np.maximum(np.diag(information), 1e-30))
    values, vectors = np.linalg.eigh(size[:, None] * information * size)
    return size[:, None] * (vectors / np.maximum(values, _LEAST_EIGENVALUE)) @ vectors.T * size
