"""Known lengths of an object that passes see (diameter, step, spacing of spheres), as observations of their points."""

from dataclasses import dataclass

import numpy as np
from scipy.special import chdtrc

from uwlts.errors import EvaluationError
from uwlts.evaluation.artefact_figures import evaluate_cloud
from uwlts.evaluation.figure_uncertainty import linearise_figures
from uwlts.evaluation.figures import Quantity
from uwlts.model.artefacts import Artefact
from uwlts.recalibration.surface_cells import PassPoints
from uwlts.storage.cloud import PointCloud

_USED = (Quantity.DIAMETER_ERROR, Quantity.SPACING_ERROR, Quantity.HEIGHT_ERROR)


@dataclass(frozen=True, eq=False)
class KnownLengths:
    """Errors (L,) of measured lengths, mm, linear in the unknowns (U,).

    ``errors_mm`` are those at the unknowns ``start`` (U,), ``by_unknowns`` (L, U) their derivatives, and ``std_mm``
    (L,) contain the noise of the points and the uncertainty of the known values.
    """

    names: tuple[str, ...]
    errors_mm: np.ndarray
    by_unknowns: np.ndarray
    std_mm: np.ndarray
    start: np.ndarray

    @property
    def rows(self) -> np.ndarray:
        """Whitened derivatives (L, U)."""
        return self.by_unknowns / self.std_mm[:, None]

    def residuals(self, unknowns: np.ndarray) -> np.ndarray:
        """Return the whitened residuals (L,)."""
        return self.errors_mm / self.std_mm + self.rows @ (unknowns - self.start)

    def chances(self, unknowns: np.ndarray, covariance: np.ndarray) -> np.ndarray:
        """Return the probability (L,) of residuals as large after an estimate with a covariance (U, U)."""
        variance = 1.0 - np.einsum("lu,uv,lv->l", self.rows, covariance, self.rows)
        return chdtrc(1, self.residuals(unknowns) ** 2 / np.maximum(variance, 1e-6))


def measure_known_lengths(
    points: PassPoints, unknowns: np.ndarray, artefact: Artefact, *, pose: np.ndarray
) -> KnownLengths:
    """Return the errors of an artefact's lengths in the points of all passes, as from the sensor's ``pose`` (4, 4).

    Raises EvaluationError if the points do not show the artefact, or it has no length.
    """
    rotation = pose[:3, :3]
    unknown = np.full(len(points.number), np.nan, np.float32)
    cloud = PointCloud((points.places_mm - pose[:3, 3]) @ rotation, unknown, points.image, np.arange(len(unknown)))
    found = evaluate_cloud(cloud, artefact)
    gradients = linearise_figures(cloud, found).gradients
    figures = [figure for figure in found.figures if figure.key.quantity in _USED]
    if not figures:
        raise EvaluationError(f"a {artefact.kind} has no known length: give a pipe, a step or spheres")
    by_points = np.array([gradients[figure.key.name] @ rotation.T for figure in figures])
    noise = np.einsum("lni,ni->ln", by_points, points.by_px) * points.noise_px
    by_image = np.einsum("lni,kni->lkn", by_points, points.image_mm)
    of_images = np.array([[np.sum(np.bincount(points.image, part) ** 2) for part in row] for row in by_image])
    calibrated = [figure.key.calibrated for figure in figures if figure.key.calibrated is not None]
    known = np.array([(each.uncertainty_mm or 0.0) / 2.0 for each in calibrated])
    return KnownLengths(
        tuple(each.name for each in calibrated),
        np.array([figure.value_mm for figure in figures]),
        np.einsum("lni,niu->lu", by_points, points.by_unknowns),
        np.sqrt(np.sum(noise**2, axis=1) + np.sum(of_images, axis=1) + known**2),
        unknowns,
    )
