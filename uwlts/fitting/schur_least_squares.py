"""Levenberg-Marquardt least squares with global parameters and local parameters of groups of observations."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import sparse

from uwlts.errors import CalibrationError

_ROUNDS = 60  # largest number of rounds: several times that of typical problems
_SMALLEST_STEP = 1e-11  # step, in the unit of residuals, that rounding of sums over all residuals produces
_HARDLY_DAMPED = 1e-8  # largest damping, relative to columns of unit length, of practically full Gauss-Newton steps
_SAFE = 1e-7  # largest relative gain for the linear model to replace an evaluation of all residuals
_SINGULAR = 1e-13  # eigenvalue of the normal matrix of the scaled global parameters, below which it is rounding noise
_SMALL_BLOCK = 16  # size of a matrix that is inverted as a whole: a search for its diagonal part would take as long


@dataclass(frozen=True, eq=False)
class Observation:
    """Residuals (n, c) of one group and their derivatives by global (c n, k) and local (c n, b) parameters.

    If ``local_columns`` is given, ``by_local`` has only these columns and the others are zero.
    """

    residuals: np.ndarray
    by_global: np.ndarray
    by_local: np.ndarray
    local_columns: np.ndarray | None = None


@dataclass(frozen=True, eq=False)
class LocalPrior:
    """Residuals (n, 1) of prior knowledge of a group's local parameters, and sparse derivatives (n, b) by them."""

    residuals: np.ndarray
    by_local: sparse.csr_array


Model = Callable[[int, np.ndarray, np.ndarray], Observation | Sequence[Observation | LocalPrior] | None]


@dataclass(frozen=True, eq=False)
class SchurFit:
    """Solution of a grouped least-squares problem."""

    global_values: np.ndarray  # (k,)
    local: list[np.ndarray]  # (b,) each
    residuals: list[np.ndarray]  # (n, c) each
    covariance: np.ndarray  # (k, k); covariance of the global parameters, scaled by the variance of the residuals
    local_covariances: list[np.ndarray]  # (b, b) each
    sigma: float  # standard deviation of one coordinate of a residual, by the degrees of freedom
    rounds: int
    stopped: str  # reason for the end of the iteration


@dataclass(frozen=True, eq=False)
class _Group:
    """Residuals (n, c) of a group and its blocks of the normal equations, with columns scaled to unit length."""

    residuals: np.ndarray
    border: np.ndarray
    block: np.ndarray
    gradient: np.ndarray
    scale: np.ndarray


@dataclass(frozen=True, eq=False)
class _Normal:
    """Normal equations in blocks, with columns scaled to unit length, and the cost of their parameters."""

    cost: float
    block: np.ndarray
    gradient: np.ndarray
    scale: np.ndarray
    groups: list[_Group]

    def count(self) -> int:
        """Count the coordinates of all residuals."""
        return sum(group.residuals.size for group in self.groups)


def schur_least_squares(
    model: Model,
    global_values: np.ndarray,
    local: Sequence[np.ndarray],
    *,
    soft_limit: float | None = None,
    smallest_gain: float = 1e-13,
    damping: float = 1e-4,
    enough_rounds: int | None = None,
) -> SchurFit:
    """Minimise the squares over all groups, eliminating the local parameters in each step (Schur complement).

    ``model`` is a function of the group number, global values (K,) and local values (B,). It returns an `Observation`,
    several that form one, or None if the parameters are infeasible. ``global_values`` and ``local`` are initial values.

    ``soft_limit`` is the scale s of the "soft L1" loss 2 s^2 (sqrt(1 + |r|^2 / s^2) - 1) of residual vectors r, by
    default quadratic. The iteration ends when the cost is reduced, or predicted to be, by less than the fraction
    ``smallest_gain``, or after ``enough_rounds``. The initial ``damping`` is relative to the squared lengths of the
    derivatives; near the solution none is needed.

    CalibrationError if the initial parameters are infeasible, the observations do not determine the parameters, or the
    iteration does not converge within 60 rounds.
    """
    global_values, local = np.array(global_values, dtype=np.float64), [np.array(o, dtype=np.float64) for o in local]
    normal = _assemble(model, global_values, local, soft_limit)
    if normal is None:
        raise CalibrationError("the initial parameters place observed points behind the camera: check points and poses")
    for rounds in range(1, _ROUNDS + 1):
        global_step, local_steps = _solve_step(normal, damping)
        tried_global = global_values + global_step
        tried_local = [value + step for value, step in zip(local, local_steps, strict=True)]
        scales = (normal.scale, *(group.scale for group in normal.groups))
        steps = zip((global_step, *local_steps), scales, strict=True)
        size = max(float(np.max(np.abs(step * scale), initial=0.0)) for step, scale in steps)
        # Scaled steps have the unit of residuals, summed over all of them.
        small = size <= _SMALLEST_STEP * np.sqrt(normal.count())
        settling = damping <= _HARDLY_DAMPED and not small
        if settling and _predict_gain(normal, global_step, local_steps) <= min(smallest_gain, _SAFE) * normal.cost:
            # Near the solution, the linear model replaces another evaluation of all residuals.
            return _make_solution(tried_global, tried_local, normal, rounds, "cost settled")
        tried = _assemble(model, tried_global, tried_local, soft_limit)
        if tried is not None and tried.cost <= normal.cost:
            gain = normal.cost - tried.cost
            settled = small or gain <= smallest_gain * normal.cost
            global_values, local, normal, damping = tried_global, tried_local, tried, max(damping / 10, 1e-12)
            if settled:
                why = "step below rounding" if small else "cost settled"
                return _make_solution(global_values, local, normal, rounds, why)
        elif small or damping > 1e8 or (tried is not None and tried.cost - normal.cost <= smallest_gain * normal.cost):
            return _make_solution(global_values, local, normal, rounds, "no step lowers the cost further")
        else:
            damping *= 10
        if rounds == enough_rounds:
            return _make_solution(global_values, local, normal, rounds, "enough rounds")
    raise CalibrationError(
        f"the camera calibration did not converge in {_ROUNDS} rounds. Either the target images do not determine the "
        "camera (tilt the target, or fix some parameters), or they contradict each other"
    )


def normal_equations(
    parts: Sequence[Observation | LocalPrior], count: int, size: int, *, soft_limit: float | None = None
) -> tuple[np.ndarray, float]:
    """Return the normal equations of a group, and the cost of its residuals.

    The matrix (count + size + 1, count + size + 1) contains the products of the derivatives by ``count`` global and
    ``size`` local parameters and, in the last column, with the residuals.
    """
    product, cost = np.zeros((count + size + 1,) * 2), 0.0
    for part in parts:
        squares, weight = np.sum(part.residuals**2, axis=1), None
        if soft_limit is None:
            cost += float(squares.sum())
        else:
            root = np.sqrt(1 + squares / soft_limit**2)
            cost += float(np.sum(2 * soft_limit**2 * (root - 1)))
            weight = np.repeat(np.sqrt(root), part.residuals.shape[1])[:, None]
        if isinstance(part, LocalPrior):
            by_local, off = part.by_local, part.residuals
            if weight is not None:
                by_local, off = by_local.multiply(1 / weight).tocsr(), off / weight
            product[count:-1, count:-1] += (by_local.T @ by_local).toarray()
            product[count:-1, -1:] += by_local.T @ off
            continue
        columns = np.hstack([part.by_global, part.by_local, part.residuals.reshape(-1, 1)])
        if weight is not None:
            columns /= weight
        places = np.arange(size) if part.local_columns is None else part.local_columns
        at = np.r_[0:count, count + places, count + size]
        product[np.ix_(at, at)] += columns.T @ columns
    return product, cost


def _assemble(
    model: Model, global_values: np.ndarray, local: list[np.ndarray], soft_limit: float | None
) -> _Normal | None:
    count, cost, found = len(global_values), 0.0, []
    for number, values in enumerate(local):
        parts = model(number, global_values, values)
        if parts is None:
            return None
        parts = [parts] if isinstance(parts, Observation) else parts
        if not all(np.isfinite(part.residuals).all() for part in parts):
            return None
        product, own_cost = normal_equations(parts, count, len(values), soft_limit=soft_limit)
        cost += own_cost
        found.append((np.vstack([part.residuals for part in parts]), product))
    global_scale = _compute_column_lengths(sum((np.diag(product)[:count] for _, product in found), np.zeros(count)))
    block, gradient, groups = np.zeros((count, count)), np.zeros(count), []
    for residuals, product in found:
        scale = _compute_column_lengths(np.diag(product)[count:-1])
        scaled = product / np.outer(both := np.r_[global_scale, scale, 1.0], both)
        block += scaled[:count, :count]
        gradient += scaled[:count, -1]
        blocks = (scaled[:count, count:-1], scaled[count:-1, count:-1], scaled[count:-1, -1])
        groups.append(_Group(residuals, *blocks, scale))
    return _Normal(cost, block, gradient, global_scale, groups)


def _compute_column_lengths(squares: np.ndarray) -> np.ndarray:
    return np.where(squares > 0, np.sqrt(squares), 1.0)


def _solve_step(normal: _Normal, damping: float) -> tuple[np.ndarray, list[np.ndarray]]:
    """Solve for the damped step; each block is positive definite for positive damping."""
    reduced = normal.block + damping * np.eye(len(normal.block))
    right = -normal.gradient
    inverses = [invert_block(group.block + damping * np.eye(len(group.block))) for group in normal.groups]
    for group, inverse in zip(normal.groups, inverses, strict=True):
        reduced = reduced - group.border @ inverse @ group.border.T
        right = right + group.border @ inverse @ group.gradient
    step = np.linalg.lstsq(reduced, right, rcond=1e-15)[0]
    local = [
        -inverse @ (group.gradient + group.border.T @ step) / group.scale
        for group, inverse in zip(normal.groups, inverses, strict=True)
    ]
    return step / normal.scale, local


def invert_block(matrix: np.ndarray, *, least: float | None = None) -> np.ndarray:
    """Return the inverse of a symmetric positive definite matrix (n, n), whose last part may be diagonal.

    The diagonal part is eliminated (Schur complement): only the size of the leading part enters with its third power.

    Raises numpy.linalg.LinAlgError if the matrix is singular, or its smallest eigenvalue, after elimination of a
    diagonal part, is below ``least``.
    """
    coupled = np.arange(len(matrix))
    if len(matrix) > _SMALL_BLOCK:
        coupled = np.flatnonzero(np.tril(matrix, -1).any(axis=0))
    head = coupled[-1] + 1 if len(coupled) else 0
    border, alone = matrix[:head, head:], np.diag(matrix)[head:]
    if not (alone > 0).all():
        raise np.linalg.LinAlgError("a diagonal element is not positive")
    shares = border / alone
    leading = matrix[:head, :head] - shares @ border.T
    if least is not None and head and np.linalg.eigvalsh(leading)[0] < least:
        raise np.linalg.LinAlgError("an eigenvalue is below the least")
    inverse = np.diag(np.append(np.zeros(head), 1 / alone))
    inverse[:head, :head] = corner = np.linalg.inv(leading)
    inverse[:head, head:] = -corner @ shares
    inverse[head:, :head] = inverse[:head, head:].T
    inverse[head:, head:] += shares.T @ corner @ shares
    return inverse


def _predict_gain(normal: _Normal, global_step: np.ndarray, local_steps: list[np.ndarray]) -> float:
    """Return the predicted reduction of the cost for linear residuals and small damping."""
    groups = zip(normal.groups, local_steps, strict=True)
    slopes = [normal.gradient @ (normal.scale * global_step), *(g.gradient @ (g.scale * step) for g, step in groups)]
    return -float(sum(slopes))


def _make_solution(
    global_values: np.ndarray, local: list[np.ndarray], normal: _Normal, rounds: int, stopped: str
) -> SchurFit:
    undetermined = CalibrationError(
        "the target images do not determine the camera: tilt the target differently between images, cover more of the "
        "image, or fix some parameters (square pixels, principal point, fewer distortion coefficients)"
    )
    reduced, inverses = normal.block.copy(), []
    for group in normal.groups:
        try:
            inverses.append(invert_block(group.block, least=_SINGULAR))
        except np.linalg.LinAlgError:
            raise undetermined from None
        reduced -= group.border @ inverses[-1] @ group.border.T
    if np.linalg.eigvalsh(reduced)[0] < _SINGULAR:
        raise undetermined
    sigma = float(np.sqrt(normal.cost / (normal.count() - len(global_values) - sum(map(len, local)))))
    covariance, local_covariances = np.linalg.inv(reduced), []
    for group, inverse in zip(normal.groups, inverses, strict=True):
        spread = inverse @ group.border.T
        total = inverse + spread @ covariance @ spread.T
        local_covariances.append(sigma**2 * total / np.outer(group.scale, group.scale))
    return SchurFit(
        global_values=global_values,
        local=local,
        residuals=[group.residuals for group in normal.groups],
        covariance=sigma**2 * covariance / np.outer(normal.scale, normal.scale),
        local_covariances=local_covariances,
        sigma=sigma,
        rounds=rounds,
        stopped=stopped,
    )
