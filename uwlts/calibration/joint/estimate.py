"""Joint least-squares estimate from all evidence and prior knowledge, weighted by the noise of the residuals."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from uwlts.calibration.joint.parameters import Parameters
from uwlts.calibration.joint.residuals import STEP, STRIPE, TARGET, Residuals, StepProfileEvidence, TargetEvidence
from uwlts.calibration.joint.scanned_surfaces import SCANNED, SurfaceScanEvidence
from uwlts.errors import CalibrationError
from uwlts.fitting.least_squares import DEFAULT_K, robust_std
from uwlts.fitting.schur_least_squares import LocalPrior, Observation, SchurFit, schur_least_squares
from uwlts.model.parameter_keys import ParameterKey
from uwlts.model.sensor import Uncertainty

Evidence = TargetEvidence | StepProfileEvidence | SurfaceScanEvidence


@dataclass(frozen=True)
class Noise:
    """Noise of one kind of residual; ``sigma_px`` is the standard deviation of a residual without outliers.

    ``together`` is the variance of a mean of many residuals relative to independent ones: errors of neighbours along a
    stripe, or of a target point in several images, are correlated. ``besides`` is added to it for errors that residuals
    do not show, and for an incomplete model.
    """

    sigma_px: float
    together: float = 1.0
    besides: float = 0.0

    def effective_px(self) -> float:
        """Return the standard deviation of independent residuals with the same information."""
        return self.sigma_px * float(np.sqrt(self.together + self.besides))


_FIRST = {TARGET: Noise(0.1), STRIPE: Noise(0.3), STEP: Noise(0.3), **dict.fromkeys(SCANNED, Noise(0.3))}
_SOFT_LIMIT = 3.0  # standard deviations; larger residuals count linearly in the first round
_ROUNDS = 10  # of weights and corrections; a few suffice, unless parts of the evidence contradict each other
_SETTLED = 0.02  # relative change of a scatter: the standard uncertainty of the scatter of a thousand values
UNSETTLED = "the residuals' scatter changes from round to round"
_SETTLED_PX = 1e-3  # change of a corrected centre, as `_FINEST_PX` for the noise
_SMALLEST_GAIN = 1e-7
"""Smallest gain of a step, relative to the number of residuals: it changes parameters by a tenth of their uncertainty.
"""
_FIRST_GAIN = 1e-3  # the same in the first round, whose result is only the next start
_DAMPING = 1e-9  # for the first step near the solution
_FIRST_DAMPING = 1e-4  # for the first step from the start
_FIRST_LINES = slice(None, None, 4)  # stripe pixels on targets in the first round: enough for a start, and fast
_FIRST_ROUNDS = 30  # then outliers are rejected and the rest is solved to convergence
_LAGS = 100  # lines; filters and speckle correlate a few, wrong models some tens
_SHARED_LAG = 0.05  # correlation that some thousand pairs can distinguish from zero by three standard errors
_FEWEST_POINTS = 25  # points of an image, for its ten smooth functions
_FINEST_PX = 1e-3  # smallest noise of an image point: a smaller one would make prior knowledge irrelevant


@dataclass(frozen=True, eq=False)
class Estimate:
    """Global parameters ``values`` (P,) with ``covariance`` (P, P), and the residuals of the evidence.

    ``local`` (b,) with ``local_covariances`` (b, b) and ``residuals`` (with outliers) are those of every piece of
    evidence. ``noise`` is that of every kind of residual, ``outliers`` the number of rejected residuals. ``rounds``
    counts all least-squares iterations. ``formal_covariance`` (P, P) takes tied parameters as exactly known; None if
    none are tied.
    """

    parameters: Parameters
    values: np.ndarray
    covariance: np.ndarray
    local: list[np.ndarray]
    local_covariances: list[np.ndarray]
    noise: dict[str, Noise]
    residuals: list[list[Residuals]]
    outliers: int
    rounds: int
    stopped: str
    formal_covariance: np.ndarray | None = None

    def std(self) -> dict[ParameterKey, float]:
        """Return the standard uncertainty of every parameter."""
        return dict(zip(self.parameters.keys, np.sqrt(np.diag(self.covariance)).tolist(), strict=True))

    def no_surer_than(self, other: Self) -> Self:
        """Return the estimate with uncertainties at least those of another of the same parameters."""
        local = map(_enlarge, self.local_covariances, other.local_covariances)
        return replace(self, covariance=_enlarge(self.covariance, other.covariance), local_covariances=[*local])


def _enlarge(covariance: np.ndarray, least: np.ndarray) -> np.ndarray:
    """Return a covariance with variances at least those of another, and its own correlations."""
    larger = np.sqrt(np.maximum(np.diag(least) / np.diag(covariance), 1.0))
    return covariance * np.outer(larger, larger)


def estimate(
    parameters: Parameters,
    evidence: Sequence[Evidence],
    global_values: np.ndarray,
    local: Sequence[np.ndarray],
    *,
    uncertainty: Uncertainty,
    diameter_mm: float | None = None,
    misfits: Collection[str] = (),
) -> Estimate:
    """Solve least squares over all evidence, repeated until weights and corrections are consistent with the solution.

    At first, large residuals count linearly; then outliers beyond five standard deviations are rejected.

    Parameters
    ----------
    parameters, evidence
        Global parameters with prior knowledge, and pieces of evidence.
    global_values, local
        Start values: (P,), and (b,) for every piece of evidence.
    uncertainty
        Stated uncertainties of the sensor, for prior knowledge of local parameters.
    diameter_mm
        Diameter of the target's circles, to correct the offsets of their images' centres. None: no correction.
    misfits
        Kinds of residuals with an incomplete model: all residuals of an image then count as one.

    Raises
    ------
    CalibrationError
        The start is invalid, the evidence does not determine the parameters, or corrections do not converge.
    """
    found, local, rounds, known = list(evidence), list(local), 0, dict(_FIRST)
    left_out: list[list[np.ndarray]] | None = None
    moved, residuals = np.inf, list[list[Residuals]]()
    for number in range(_ROUNDS):
        first, last = number == 0, number == _ROUNDS - 1
        thinned = [e.with_stripes(_FIRST_LINES) if isinstance(e, TargetEvidence) else e for e in evidence]
        fit = _fit(parameters, thinned if first else evidence, global_values, local, uncertainty, known, left_out)
        global_values, local, rounds = fit.global_values, fit.local[:-1], rounds + fit.rounds
        residuals.clear()
        for piece, values in zip(evidence, local, strict=True):
            if (parts := piece.residuals(parameters, global_values, values)) is None:
                raise CalibrationError(
                    "the joint calibration diverged: an observed ray does not meet the sheet or target"
                )
            residuals.append(parts)
        before, known = known, _estimate_all_noise(evidence, residuals, misfits)
        left_out = [[outliers(r, known[r.kind]) for r in parts] for parts in residuals]
        used, evidence = evidence, []
        for piece, values, parts, masks in zip(found, local, residuals, left_out, strict=True):
            if diameter_mm is not None and isinstance(piece, TargetEvidence):
                piece = piece.with_centres(parameters, global_values, values, diameter_mm)
            evidence.append(piece.linearise(parts, [~mask for mask in masks]))
        changes = [
            float(np.abs(a.placement.pixels - b.placement.pixels).max())
            for a, b in zip(used, evidence, strict=True)
            if isinstance(a, TargetEvidence) and isinstance(b, TargetEvidence)
        ]
        moved = max(changes, default=0.0)
        steady = all(abs(known[k].effective_px() / before[k].effective_px() - 1) < _SETTLED for k in known)
        if moved <= _SETTLED_PX and not first and (steady or last):
            return Estimate(
                parameters=parameters,
                values=global_values,
                covariance=fit.covariance / fit.sigma**2,
                local=local,
                local_covariances=[each / fit.sigma**2 for each in fit.local_covariances[:-1]],
                noise=known,
                residuals=residuals,
                outliers=sum(int(mask.sum()) for parts in left_out for mask in parts),
                rounds=rounds,
                stopped=fit.stopped if steady else UNSETTLED,
            )
    times, kind, worst = max(
        (robust_std(part.values) / known[part.kind].sigma_px, part.kind, piece.sources[part.image])
        for piece, parts in zip(found, residuals, strict=True)
        for part in parts
    )
    raise CalibrationError(
        f"the joint calibration did not converge in {_ROUNDS} rounds: the offsets of the circles' images still change "
        f"by {moved:.2g} px; check the diameter of the circles, and {worst}, where the {kind} scatters {times:.1f} "
        "times as much as usual"
    )


def _fit(
    parameters: Parameters,
    evidence: Sequence[Evidence],
    global_values: np.ndarray,
    local: Sequence[np.ndarray],
    uncertainty: Uncertainty,
    noise: dict[str, Noise],
    left_out: list[list[np.ndarray]] | None,
) -> SchurFit:
    """Solve with every piece of evidence as a group with local parameters; the last group is prior knowledge."""

    def model(group: int, global_values: np.ndarray, local: np.ndarray) -> Sequence[Observation | LocalPrior] | None:
        if group == len(evidence):
            return prior_observations(parameters, global_values)
        piece = evidence[group]
        parts = piece.residuals(parameters, global_values, local)
        if parts is None:
            return None
        used = [slice(None)] * len(parts) if left_out is None else [~mask for mask in left_out[group]]
        pairs = zip(parts, used, strict=True)
        rows = [part.weighted(noise[part.kind].effective_px(), kept) for part, kept in pairs]
        known = piece.known_before(local, uncertainty)
        return [*rows, known] if len(known.residuals) else rows

    starts = [*local, np.empty(0)]
    if left_out is not None:
        return schur_least_squares(model, global_values, starts, smallest_gain=_SMALLEST_GAIN, damping=_DAMPING)
    first = {"smallest_gain": _FIRST_GAIN, "damping": _FIRST_DAMPING, "soft_limit": _SOFT_LIMIT}
    return schur_least_squares(model, global_values, starts, **first, enough_rounds=_FIRST_ROUNDS)


def prior_observations(parameters: Parameters, global_values: np.ndarray) -> list[Observation]:
    """Return prior knowledge: of single parameters, and of many jointly from an earlier estimate."""
    std = parameters.prior_std()
    known = np.isfinite(std)
    found = [((global_values - parameters.prior_mean())[known] / std[known], np.diag(1.0 / std)[known])]
    if parameters.earlier is not None:
        found.append(parameters.earlier.residuals(global_values))
    return [Observation(off[:, None], by_global, np.empty((len(off), 0))) for off, by_global in found]


def _estimate_all_noise(
    evidence: Sequence[Evidence], residuals: list[list[Residuals]], misfits: Collection[str]
) -> dict[str, Noise]:
    result = {}
    for kind in dict.fromkeys(r.kind for parts in residuals for r in parts):
        points = [e.placement.points_mm for e in evidence if kind == TARGET and isinstance(e, TargetEvidence)]
        of_kind = [r for parts in residuals for r in parts if r.kind == kind]
        result[kind] = estimate_noise(kind, of_kind, points)
        if kind in SCANNED:
            scans = [e for e in evidence if isinstance(e, SurfaceScanEvidence) and e.surface.kind == kind]
            common_px, bodies = np.concatenate([e.common_px for e in scans]), sum(e.surface.count for e in scans)
            result[kind] = add_common_error(result[kind], common_px, bodies=bodies)
        if kind in misfits:
            # With an incomplete model, the residuals of an image count as one.
            noise, per_image = result[kind], float(np.mean([len(r.values) for r in of_kind]))
            result[kind] = replace(noise, besides=noise.besides + max(per_image - noise.together, 0.0))
    return result


def outliers(residuals: Residuals, noise: Noise) -> np.ndarray:
    """Return which residuals (n,) are outliers; for target points, both coordinates together."""
    large = np.asarray(np.abs(residuals.values) > DEFAULT_K * noise.sigma_px)
    if residuals.kind == TARGET:
        large = np.repeat(np.any(large.reshape(-1, 2), axis=1), 2)
    return large


def estimate_noise(kind: str, residuals: Sequence[Residuals], points: Sequence[np.ndarray]) -> Noise:
    """Estimate the noise of all residuals of a kind; ``points`` (N, 3) of each placement are used for target points."""
    values = np.concatenate([r.values for r in residuals])
    limit = DEFAULT_K * robust_std(values)
    kept = np.abs(values) <= limit
    sigma = float(np.sqrt(np.mean(values[kept] ** 2))) if kept.any() else limit / DEFAULT_K
    if sigma < _FINEST_PX:
        return Noise(_FINEST_PX)
    if kind == TARGET:
        places = np.vstack(points)[:, :2]
        together = max(
            _find_point_variance_factor(values, places, kept, sigma),
            _find_image_variance_factor(residuals, places, sigma),
        )
    else:
        together = _find_neighbour_variance_factor(residuals, sigma)
    return Noise(sigma, max(together, 1.0))


def add_common_error(noise: Noise, common_px: np.ndarray, *, bodies: float) -> Noise:
    """Add a common error of all points of a scanned body, with standard uncertainties ``common_px`` (N,)."""
    points_per_body, common = len(common_px) / bodies, float(np.mean(common_px**2))
    return Noise(noise.sigma_px, noise.together, points_per_body * common / noise.sigma_px**2)


def _find_point_variance_factor(values: np.ndarray, places: np.ndarray, kept: np.ndarray, sigma: float) -> float:
    """Return the variance factor of residuals of the same point in several images, from their correlation."""
    _, point = np.unique(np.round(places, 6), axis=0, return_inverse=True)
    pairs, kept = values.reshape(-1, 2), np.all(kept.reshape(-1, 2), axis=1)
    number = np.bincount(point[kept], minlength=point.max() + 1)
    often = number >= 3
    if not often.any():
        return 1.0
    sums = np.stack([np.bincount(point[kept], pairs[kept, axis], len(number)) for axis in (0, 1)])
    # n times the variance of the mean of n, divided by the variance of one
    return float(np.mean(sums[:, often] ** 2 / number[often])) / sigma**2


def _find_image_variance_factor(residuals: Sequence[Residuals], places: np.ndarray, sigma: float) -> float:
    """Return the variance factor of residuals that vary smoothly across an image, as with a wrong lens or bent target.

    Independent residuals have the variance sigma^2 along each orthonormal function of the position; here all products
    of powers up to third order. The median over the images excludes single images that do not fit.
    """
    found = []
    ends = np.cumsum([len(part.values) // 2 for part in residuals])
    for part, at in zip(residuals, np.split(places, ends[:-1]), strict=True):
        pairs = part.values.reshape(-1, 2)
        kept = np.all(np.abs(pairs) <= DEFAULT_K * sigma, axis=1)
        at, pairs = at[kept], pairs[kept]
        if len(pairs) < _FEWEST_POINTS:
            continue
        x, y = ((at - at.mean(axis=0)) / at.std(axis=0)).T
        smooth = np.linalg.qr(np.column_stack([x**i * y**j for i in range(4) for j in range(4 - i)]))[0]
        found.append(np.mean((smooth.T @ pairs) ** 2) / sigma**2)
    return float(np.median(found)) if found else 1.0


def _find_neighbour_variance_factor(residuals: Sequence[Residuals], sigma: float) -> float:
    """Return the variance factor 1 + 2 sum of the autocorrelation along the stripe, over all images."""
    products, counts = np.zeros(_LAGS), np.zeros(_LAGS)
    for part in residuals:
        kept = (np.abs(part.values) <= DEFAULT_K * sigma).astype(np.float64)
        values = kept * part.values
        for lag in range(1, min(_LAGS, len(values) // 4)):
            products[lag] += values[lag:] @ values[:-lag]
            counts[lag] += kept[lag:] @ kept[:-lag]
    with np.errstate(invalid="ignore"):
        correlation = products / (counts * sigma**2)
    faded = np.flatnonzero(~(correlation[1:] > _SHARED_LAG))
    end = 1 + (faded[0] if len(faded) else _LAGS - 1)
    return 1.0 + 2.0 * float(correlation[1:end].sum())
