"""How well an artefact's figures are known, correlations between the points included."""

from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from uwlts.cloud import PointCloud
from uwlts.metrology.artefacts import Artefact, Evaluation, SphereEvaluation, evaluate_cloud
from uwlts.uncertainty.moved_spheres import MovedSpheres
from uwlts.uncertainty.points import PAIRS, PointUncertainty

# The standard deviation of as many is right to 27 % and to 10 %.
_DRAWS, _QUICK_DRAWS = 8, 50
_SEED = 635


@dataclass(frozen=True)
class FigureUncertainty:
    """Standard uncertainties in mm of one figure: by noise of stripe and positions, and by calibration and stage."""

    random_mm: float
    systematic_mm: float

    @property
    def expanded_mm(self) -> float:
        """Expanded uncertainty in mm with the coverage factor 2."""
        return 2.0 * float(np.hypot(self.random_mm, self.systematic_mm))


def figure_uncertainties(cloud: PointCloud, artefact: Artefact, evaluation: Evaluation) -> dict[str, FigureUncertainty]:
    """Uncertainty of the figures of an evaluation of a cloud; nothing where the cloud's points have none.

    Figures are calculated again with each pattern of the calibration added to the points; the squares of their changes
    add up (GUM, section 5.1, with independent inputs). For the noise they are calculated with noise drawn anew
    (GUM Supplement 1). Spheres are not searched for again.

    Raises
    ------
    EvaluationError
        As `evaluate_cloud`.
    """
    if cloud.uncertainty is None:
        return {}

    plain, draws = evaluation.figures_mm, _DRAWS
    if isinstance(evaluation, SphereEvaluation):
        figures_mm, draws = MovedSpheres(cloud.points_mm, artefact, evaluation).figures_mm, _QUICK_DRAWS
    else:
        figures_mm = partial(_evaluated, cloud, artefact)

    def changed(by: np.ndarray) -> np.ndarray:
        figures = figures_mm(by)
        return np.array([figures[name] - value for name, value in plain.items()])

    systematic = [changed(pattern) for pattern in cloud.uncertainty.patterns_mm]
    rng, along = np.random.default_rng(_SEED), noise_mm(cloud.uncertainty)
    images, image = np.unique(cloud.frame, return_inverse=True)

    def noise() -> np.ndarray:
        position = rng.standard_normal((len(images), 1))[image] * cloud.uncertainty.position_mm
        return rng.standard_normal((len(cloud), 1)) * along + position

    drawn = [changed(noise()) for _ in range(draws)]
    by_calibration = np.sqrt(np.sum(np.square(systematic), axis=0))
    by_noise = np.std(drawn, axis=0, ddof=1)
    return {
        name: FigureUncertainty(float(r), float(s)) for name, r, s in zip(plain, by_noise, by_calibration, strict=True)
    }


def _evaluated(cloud: PointCloud, artefact: Artefact, moves: np.ndarray) -> dict[str, float]:
    return evaluate_cloud(replace(cloud, points_mm=cloud.points_mm + moves), artefact).figures_mm


def noise_mm(uncertainty: PointUncertainty) -> np.ndarray:
    """How each point moves (N, 3) for one standard deviation of its stripe centre; the sign is any."""
    covariance = np.zeros((len(uncertainty.random_mm2), 3, 3))
    for column, (i, j) in enumerate(PAIRS):
        covariance[:, i, j] = covariance[:, j, i] = uncertainty.random_mm2[:, column]
    # The covariance is v v^T: its column with the largest element on the diagonal is v times that of v.
    largest = np.argmax(np.einsum("nii->ni", covariance), axis=1)
    rows = np.arange(len(covariance))
    return covariance[rows, largest] / np.sqrt(covariance[rows, largest, largest])[:, None]
