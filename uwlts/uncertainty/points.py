"""How well each point of a cloud is known: by itself, and together with all others."""

from dataclasses import dataclass

import numpy as np

PAIRS = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
"""The coordinates whose covariances are kept of the symmetric 3x3 matrix: xx, xy, xz, yy, yz, zz."""


@dataclass(frozen=True, eq=False)
class PointUncertainty:
    """Standard uncertainty of points in the OCS, mm.

    Attributes
    ----------
    random_mm2 : (N, 6) float32
        Covariance of each point by the stripe's noise, independent from point to point; see `PAIRS`.
    position_mm : (N, 3) float32
        How each point moves for one standard deviation of its image's stage position, independent from image to image.
    patterns_mm : (M, N, 3) float32
        How each point moves for one standard deviation of what is independent in calibration and stage, largest first.
    """

    random_mm2: np.ndarray
    position_mm: np.ndarray
    patterns_mm: np.ndarray

    def systematic_mm2(self) -> np.ndarray:
        """Covariance (N, 6) of each point by calibration and stage."""
        return np.stack([np.sum(self.patterns_mm[:, :, i] * self.patterns_mm[:, :, j], axis=0) for i, j in PAIRS], 1)

    def std_mm(self) -> np.ndarray:
        """Standard uncertainty (N, 3) of each coordinate, of all kinds together."""
        total = self.random_mm2 + self.systematic_mm2()
        return np.sqrt(total[:, [0, 3, 5]] + np.square(self.position_mm))
