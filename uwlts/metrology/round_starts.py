"""Start values for circles and spheres in closed form."""

import numpy as np


def algebraic_centres(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Centres (..., D) and radii (...) of circles (D = 2) or spheres (D = 3) through centred points (..., N, D).

    Taubin's fit, nearly unbiased on short arcs where the simpler one of Kasa shrinks the radius: the eigenvector of
    the smallest eigenvalue of the moments of (|p|^2 - m) / (2 sqrt m) and p, with m the mean of |p|^2 (N. Chernov,
    Circular and linear regression, 2010, section 5.10). Points on a line or plane give huge, finite radii.
    """
    squares = np.sum(points**2, axis=-1)
    mean = squares.mean(axis=-1)
    half = 2.0 * np.sqrt(mean)
    design = np.concatenate([((squares - mean[..., None]) / half[..., None])[..., None], points], axis=-1)
    _, vectors = np.linalg.eigh(np.swapaxes(design, -1, -2) @ design)
    vector = vectors[..., :, 0]
    curvature = vector[..., 0] / half
    curvature = np.where(np.abs(curvature) < 1e-9, np.copysign(1e-9, curvature), curvature)
    centres = -vector[..., 1:] / (2.0 * curvature[..., None])
    radii = np.sqrt(np.sum(centres**2, axis=-1) + mean)
    return centres, radii


def centre_of_known_radius(points: np.ndarray, radius: float) -> np.ndarray:
    """Start centre (D,) of a circle or sphere of known radius through centred points (N, D).

    In the direction of the algebraic centre, as deep below the points as their extent across it demands.
    """
    centre, _ = algebraic_centres(points)
    direction = centre / max(float(np.linalg.norm(centre)), 1e-12)
    across = np.sum(points**2, axis=-1) - (points @ direction) ** 2
    depth = np.sqrt(max(radius**2 - float(across.mean()), (0.1 * radius) ** 2))
    return direction * depth
