"""An earlier joint estimate as knowledge before a new one: all its parameters at once, with their correlations."""

from dataclasses import dataclass, field

import numpy as np

from uwlts.errors import CalibrationError


@dataclass(frozen=True, eq=False)
class EarlierEstimate:
    """What an earlier estimate says of the first K parameters of a vector.

    Attributes
    ----------
    values : (K,)
    covariance : (K, K)
    whitening : (K, K)
        W with W^T W the inverse of the covariance: W (x - values) are K residuals of variance one, independent.

    Raises
    ------
    CalibrationError
        The covariance is not positive definite.
    """

    values: np.ndarray
    covariance: np.ndarray
    whitening: np.ndarray = field(init=False)

    def __post_init__(self) -> None:
        variance = np.diag(self.covariance)
        try:
            if not variance.min() > 0:
                raise np.linalg.LinAlgError("a variance is not positive")
            # Pixels, millimetres and radians stand beside each other: factored as correlations, none is lost.
            std = np.sqrt(variance)
            root = np.linalg.cholesky(self.covariance / np.outer(std, std))
        except np.linalg.LinAlgError as error:
            raise CalibrationError(
                f"the covariance of the earlier calibration is damaged or says nothing ({error}): calibrate again"
            ) from error
        object.__setattr__(self, "whitening", np.linalg.inv(root) / std)

    def std(self) -> np.ndarray:
        """Standard uncertainty (K,) of each parameter."""
        return np.sqrt(np.diag(self.covariance))

    def residuals(self, global_values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Residuals (K,) of variance one of a vector (P,) that begins with these parameters, and derivatives (K, P)."""
        count = len(self.values)
        by_global = np.zeros((count, len(global_values)))
        by_global[:, :count] = self.whitening
        return self.whitening @ (global_values[:count] - self.values), by_global
