"""Alignment of paths that cross themselves: bounds for kinds of drift: python -m docs.studies.trajectory_alignment."""

from itertools import product

import numpy as np
from cyclopts import App

from docs.studies.result_tables import publish, table
from uwlts.alignment.path_prior import DriftModel

SWATH_MM, LENGTH_MM = 140.0, 19_400.0
CROSSINGS = (0.057, 0.500), (0.124, 0.608), (0.351, 0.691)
"""Crossings of the pass, as fractions of its length."""
GRID, DRIFTS, EXACT = np.linspace(0.01, 1, 100), 200, 1e-7
"""Positions on the path as fractions of its length, number of drawn drifts, and variance of exact crossings.

The variance corresponds to 0.1 mm for a drift of 0.3 m.
"""
RIDE = {"rate": (1.2**3 - 0.7**3) / 1.5, "wave": 0.2}
"""Drift of `ride`: a rate of 0.7 to 1.2 times the drift, and a wave of a fifth of it."""
KINDS = {
    "steady rate": {"rate": 1.0},
    "wandering rate": {"wandering": 1.0},
    "random walk": {"walk": 1.0},
    "Gauss-Markov rate, correlation time 0.05 of the path": {"wandering": 1.0, "correlation": 0.05},
    "Gauss-Markov rate, correlation time 0.5": {"wandering": 1.0, "correlation": 0.5},
    "simulated rides: steady rate and a wave of a fifth": RIDE,
    "these with a random walk of 10 %": RIDE | {"walk": 0.1**2},
}
"""Kind of the drift: parts of its variance at the end, see `bounds`."""


def main(*, write: bool = False) -> None:
    """Print the table; with `--write`, put it into its page."""
    head = ["drift, of the variance at the end", "displacement", "rates", "size alone"]
    rows = [[name, *bounds(**kind)] for name, kind in KINDS.items()]
    publish({"drifts": table([*head, "within twice the stated uncertainty"], rows)}, write=write)


def bounds(
    *, rate: float = 0.0, wandering: float = 0.0, walk: float = 0.0, wave: float = 0.0, correlation: float = np.inf
) -> list[str]:
    """Return the factors that three exact crossings can reduce the rms error of a path by, and the coverage.

    The drift is a Gaussian process. Its variance at the end is the sum of ``rate`` (steady rate), ``wandering`` (rate
    with a random walk, or Gauss-Markov rate with a ``correlation`` time) and ``walk`` (random walk). ``wave`` is the
    amplitude of the wave of `ride`. The known displacement is that within each crossing, or at two positions of it,
    which also determines the rates. The linear Gaussian estimate with the true covariance has the smallest possible
    error. `align_trajectory` knows only the size of the drift: it uses its own model with the most likely random walk
    and correlation time.
    """
    found = []
    for apart in (0.0, SWATH_MM / LENGTH_MM):
        ends = [np.add(crossing, off) for crossing, off in product(CROSSINGS, (-apart / 2, apart / 2))]
        t = np.concatenate([GRID, np.ravel(ends)])
        first, second = np.minimum(t[:, None], t), np.maximum(t[:, None], t)
        true = rate * np.outer(t, t) + wandering * _wandered(first, second, correlation) + walk * first
        turns = 2 * np.pi * 0.8 * t
        true += wave**2 / 2 * (np.cos(turns[:, None] - turns) - np.cos(turns)[:, None] - np.cos(turns) + 1)
        seen = np.zeros((len(ends), len(t)))
        for row, values in enumerate(seen):
            values[len(GRID) + 2 * row : len(GRID) + 2 * row + 2] = -1, 1
        _, std, _ = _estimated(true, seen)
        found.append(float(np.sqrt(np.mean(np.diag(true)[: len(GRID)]) / np.mean(std**2))))
    models = [
        _estimated(model.covariance(t[:, None], t, 1.0)[0], seen) for model in DriftModel.of_size(1.0, 1.0).candidates()
    ]
    rng, root = np.random.default_rng(0), np.linalg.cholesky(true + EXACT * np.eye(len(t)))
    before, after, inside = [], [], []
    for _ in range(DRIFTS):
        drift = root @ rng.standard_normal((len(t), 6))
        gain, std, _ = max(models, key=lambda model: _twice_log_likelihood(seen @ drift, model[2]))
        off = gain @ (seen @ drift) - drift[: len(GRID)]
        before.append(drift[: len(GRID)])
        after.append(off)
        inside.append(np.abs(off) < 2 * std[:, None])
    factors = ["exact" if value > 1000 else f"{value:.1f}" for value in found]
    size = f"{_rms(np.array(before)) / _rms(np.array(after)):.1f}"
    return [*factors, size, f"{100 * np.mean(inside):.0f} %"]


def _wandered(first: np.ndarray, second: np.ndarray, correlation: float) -> np.ndarray:
    """Return the covariance of the integral of a rate between times, relative to the variance at time 1.

    The rate has the covariance exp(-|t - u| / T) of a Gauss-Markov process, or that of a random walk for T = inf.
    """
    if np.isinf(correlation):
        return first**2 * (3 * second - first) / 2
    of_first, of_second, apart = (np.exp(-each / correlation) for each in (first, second, second - first))
    end = 2 / correlation + 2 * np.exp(-1 / correlation) - 2
    return (2 * first / correlation + of_first + of_second - 1 - apart) / end


def _estimated(covariance: np.ndarray, seen: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return gain (G, Q) and standard deviations (G,) of an estimate on the grid, and observation covariance (Q, Q)."""
    of_seen = seen @ covariance @ seen.T + EXACT * np.eye(len(seen))
    shared = covariance[: len(GRID)] @ seen.T
    gain = np.linalg.solve(of_seen, shared.T).T
    left = np.diag(covariance)[: len(GRID)] - np.sum(gain * shared, axis=1)
    return gain, np.sqrt(np.maximum(left, 0.0)), of_seen


def _twice_log_likelihood(values: np.ndarray, covariance: np.ndarray) -> float:
    """Return twice the log likelihood of columns (Q, K), without a constant."""
    root = np.linalg.cholesky(covariance)
    return float(-np.sum(np.linalg.solve(root, values) ** 2) - 2 * values.shape[1] * np.sum(np.log(np.diag(root))))


def _rms(values: list[float] | np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


if __name__ == "__main__":
    App(help=__doc__, help_format="plaintext", default_command=main)()
