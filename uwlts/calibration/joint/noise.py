"""Scatter of residuals, outliers among them, and the share of the scatter that they have in common."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from uwlts.calibration.joint.residuals import TARGET, Residuals
from uwlts.fitting.least_squares import MAD_TO_STD

_OUTLIER = 5.0  # standard deviations; of a million normal values one is farther
_LAGS = 100  # lines; filters and speckle join a few, wrong models some tens
_SHARED_LAG = 0.05  # correlation that some thousand pairs no longer separate from none, by three standard errors
_FEWEST_POINTS = 25  # of an image, for its ten smooth functions
_FINEST_PX = 1e-3  # no point of an image counts as better known: what is known before would count for nothing


@dataclass(frozen=True)
class Noise:
    """Scatter of one kind of residual: ``sigma_px``, the standard deviation of one, without outliers.

    ``together`` is the variance of a mean of many over that of as many independent ones, as neighbours along a stripe
    and images of the same point of the target err together; ``besides`` adds to that for errors that do not show, and
    for what the model lacks.
    """

    sigma_px: float
    together: float = 1.0
    besides: float = 0.0

    def effective_px(self) -> float:
        """Standard deviation of independent residuals that would say as little."""
        return self.sigma_px * float(np.sqrt(self.together + self.besides))


def outliers(residuals: Residuals, noise: Noise) -> np.ndarray:
    """Which residuals (n,) are too large to be noise; of the target's points both coordinates."""
    large = np.asarray(np.abs(residuals.values) > _OUTLIER * noise.sigma_px)
    if residuals.kind == TARGET:
        large = np.repeat(np.any(large.reshape(-1, 2), axis=1), 2)
    return large


def outlier_limit(values: np.ndarray) -> float:
    """Size beyond which values are outliers: five standard deviations, by a median that half of them leave as it is."""
    return _OUTLIER * MAD_TO_STD * float(np.median(np.abs(values)))


def judged(kind: str, residuals: Sequence[Residuals], points: Sequence[np.ndarray]) -> Noise:
    """Scatter of all residuals of a kind; ``points`` (N, 3) of each placement are the target's, for that kind."""
    values = np.concatenate([r.values for r in residuals])
    limit = outlier_limit(values)
    kept = np.abs(values) <= limit
    sigma = float(np.sqrt(np.mean(values[kept] ** 2))) if kept.any() else limit / _OUTLIER
    if sigma < _FINEST_PX:
        return Noise(_FINEST_PX)
    if kind == TARGET:
        places = np.vstack(points)[:, :2]
        together = max(_of_points(values, places, kept, sigma), _of_images(residuals, places, sigma))
    else:
        together = _of_neighbours(residuals, sigma)
    return Noise(sigma, max(together, 1.0))


def with_common_error(noise: Noise, common_px: np.ndarray, *, bodies: float) -> Noise:
    """Noise on scanned bodies, all points of which share an error of the standard uncertainties ``common_px`` (N,)."""
    points_per_body, common = len(common_px) / bodies, float(np.mean(common_px**2))
    return Noise(noise.sigma_px, noise.together, points_per_body * common / noise.sigma_px**2)


def with_misfit(noise: Noise, *, per_image: float) -> Noise:
    """Noise of residuals whose model lacks something: the ``per_image`` residuals of an image say as much as one."""
    return replace(noise, besides=noise.besides + max(per_image - noise.together, 0.0))


def _of_points(values: np.ndarray, places: np.ndarray, kept: np.ndarray, sigma: float) -> float:
    """By how much residuals of the same point in several images share their error."""
    _, point = np.unique(np.round(places, 6), axis=0, return_inverse=True)
    pairs, kept = values.reshape(-1, 2), np.all(kept.reshape(-1, 2), axis=1)
    number = np.bincount(point[kept], minlength=point.max() + 1)
    often = number >= 3
    if not often.any():
        return 1.0
    sums = np.stack([np.bincount(point[kept], pairs[kept, axis], len(number)) for axis in (0, 1)])
    # n times the variance of the mean of n, over the variance of one.
    return float(np.mean(sums[:, often] ** 2 / number[often])) / sigma**2


def _of_images(residuals: Sequence[Residuals], places: np.ndarray, sigma: float) -> float:
    """By how much residuals vary smoothly across an image, as those of a wrong lens or a bent target do.

    Independent ones have the variance sigma^2 along each of orthonormal functions of the place; here all products of
    powers up to the third order. The median of the images counts: a single one that does not fit is another matter.
    """
    found = []
    ends = np.cumsum([len(part.values) // 2 for part in residuals])
    for part, at in zip(residuals, np.split(places, ends[:-1]), strict=True):
        pairs = part.values.reshape(-1, 2)
        kept = np.all(np.abs(pairs) <= _OUTLIER * sigma, axis=1)
        at, pairs = at[kept], pairs[kept]
        if len(pairs) < _FEWEST_POINTS:
            continue
        x, y = ((at - at.mean(axis=0)) / at.std(axis=0)).T
        smooth = np.linalg.qr(np.column_stack([x**i * y**j for i in range(4) for j in range(4 - i)]))[0]
        found.append(np.mean((smooth.T @ pairs) ** 2) / sigma**2)
    return float(np.median(found)) if found else 1.0


def _of_neighbours(residuals: Sequence[Residuals], sigma: float) -> float:
    """1 + 2 sum of the autocorrelation along the stripe, up to where it fades, over all images."""
    products, counts = np.zeros(_LAGS), np.zeros(_LAGS)
    for part in residuals:
        kept = (np.abs(part.values) <= _OUTLIER * sigma).astype(np.float64)
        values = kept * part.values
        for lag in range(1, min(_LAGS, len(values) // 4)):
            products[lag] += values[lag:] @ values[:-lag]
            counts[lag] += kept[lag:] @ kept[:-lag]
    with np.errstate(invalid="ignore"):
        correlation = products / (counts * sigma**2)
    faded = np.flatnonzero(~(correlation[1:] > _SHARED_LAG))
    end = 1 + (faded[0] if len(faded) else _LAGS - 1)
    return 1.0 + 2.0 * float(correlation[1:end].sum())
