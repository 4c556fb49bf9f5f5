"""How well an artefact's figures are known, correlations between the points included."""

from dataclasses import dataclass, replace

import numpy as np

from uwlts.cloud import PointCloud
from uwlts.metrology.artefacts import Artefact, evaluate_cloud
from uwlts.uncertainty.points import PAIRS, PointUncertainty

_DRAWS = 8
_SEED = 635


@dataclass(frozen=True)
class FigureUncertainty:
    """Standard uncertainties in mm of one figure: by the stripe's noise, and by the calibration."""

    random_mm: float
    systematic_mm: float

    @property
    def expanded_mm(self) -> float:
        """Expanded uncertainty in mm with the coverage factor 2."""
        return 2.0 * float(np.hypot(self.random_mm, self.systematic_mm))


def figure_uncertainties(
    cloud: PointCloud, artefact: Artefact, plain: dict[str, float]
) -> dict[str, FigureUncertainty]:
    """Uncertainty of the figures of an artefact, ``plain`` in mm by name; nothing where the cloud's points have none.

    Figures are calculated again with each pattern of the calibration added to the points; the squares of their changes
    add up (GUM, section 5.1, with independent inputs). For the noise they are calculated with noise drawn anew
    (GUM Supplement 1).

    Raises
    ------
    EvaluationError
        As `evaluate_cloud`.
    """
    if cloud.uncertainty is None:
        return {}

    def moved(by: np.ndarray) -> np.ndarray:
        figures = evaluate_cloud(replace(cloud, points_mm=cloud.points_mm + by), artefact).figures_mm
        return np.array([figures[name] - value for name, value in plain.items()])

    systematic = [moved(pattern) for pattern in cloud.uncertainty.patterns_mm]
    rng, along = np.random.default_rng(_SEED), noise_mm(cloud.uncertainty)
    drawn = [moved(rng.standard_normal((len(cloud), 1)) * along) for _ in range(_DRAWS)]
    by_calibration = np.sqrt(np.sum(np.square(systematic), axis=0))
    by_noise = np.std(drawn, axis=0, ddof=1)
    return {
        name: FigureUncertainty(float(r), float(s)) for name, r, s in zip(plain, by_noise, by_calibration, strict=True)
    }


def noise_mm(uncertainty: PointUncertainty) -> np.ndarray:
    """How each point moves (N, 3) for one standard deviation of its stripe centre; the sign is any."""
    covariance = np.zeros((len(uncertainty.random_mm2), 3, 3))
    for column, (i, j) in enumerate(PAIRS):
        covariance[:, i, j] = covariance[:, j, i] = uncertainty.random_mm2[:, column]
    # The covariance is v v^T: its column with the largest element on the diagonal is v times that of v.
    largest = np.argmax(np.einsum("nii->ni", covariance), axis=1)
    rows = np.arange(len(covariance))
    return covariance[rows, largest] / np.sqrt(covariance[rows, largest, largest])[:, None]
