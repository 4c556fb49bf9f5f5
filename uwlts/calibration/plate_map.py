"""Where on the target's plate a pixel looks, learnt from the target's points in the same image and nothing else."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.polynomial import legendre
from scipy.spatial import ConvexHull

from uwlts.calibration.target_image import TargetImage
from uwlts.errors import CalibrationError
from uwlts.targets import circle_centre_bias

# What a lens and a flat window leave of a plane beside its homography is smooth: the fifth degree describes it to a
# micrometre over a view 200 mm wide. Fewer points than three for each coefficient would be fitted, not smoothed.
_HIGHEST_DEGREE = 5
_LOWEST_DEGREE = 3
_POINTS_PER_TERM = 3
_X, _Y = np.eye(3)[:2]


@dataclass(frozen=True, eq=False)
class SmoothMap:
    """Smooth map from one plane to another: a homography and a polynomial for what it leaves.

    Attributes
    ----------
    homography : (3, 3)
    low, high : (2,)
        Box of the points it was fitted to, on which the polynomial's arguments run from -1 to 1.
    degree : int
        Total degree of the polynomial.
    coefficients : (terms, 2)
        Legendre coefficients.
    residuals : (N, 2)
        Of the points it was fitted to.
    """

    homography: np.ndarray
    low: np.ndarray
    high: np.ndarray
    degree: int
    coefficients: np.ndarray
    residuals: np.ndarray

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """Images (M, 2) of points (M, 2)."""
        return self.coarsely(points) + _terms(points, self.low, self.high, self.degree) @ self.coefficients

    def coarsely(self, points: np.ndarray) -> np.ndarray:
        """Images (M, 2) by the homography alone, which stays sensible far outside the box."""
        return _project(self.homography, points)


@dataclass(frozen=True, eq=False)
class PlateMap:
    """Where on the plate pixels look.

    Attributes
    ----------
    to_plate : SmoothMap
        From pixels to plate coordinates in mm; its residuals are those of the target's points.
    hull : (K, 3)
        Sides of the points' convex hull on the plate: outward normal and offset in mm.
    """

    to_plate: SmoothMap
    hull: np.ndarray

    def __call__(self, pixels: np.ndarray) -> np.ndarray:
        """Plate coordinates (M, 2) in mm of pixels (M, 2)."""
        return self.to_plate(pixels)

    def beyond_mm(self, pixels: np.ndarray) -> np.ndarray:
        """How far (M,) outside the hull of the target's points pixels (M, 2) look, in mm; negative inside."""
        return np.max(self.to_plate.coarsely(pixels) @ self.hull[:, :2].T + self.hull[:, 2], axis=1)

    def rms_mm(self) -> float:
        """Root mean square length of the residuals."""
        return float(np.sqrt(np.mean(np.sum(self.to_plate.residuals**2, axis=1))))


def fit_plate_map(image: TargetImage, *, circle_diameter_mm: float | None = None) -> PlateMap:
    """Map from pixels to the plate through the points of one image.

    Parameters
    ----------
    image : TargetImage
    circle_diameter_mm : float, optional
        The points are circles of this diameter and their pixels the centres of their images. The offsets from the
        images of their centres are taken out by the map itself: refraction that stretches the image outwards shifts
        the centres as much as perspective does.

    Raises
    ------
    CalibrationError
        There are too few points, or they determine no homography.
    RangeError
        A circle's image is no ellipse.
    """
    points, pixels = image.points_mm, image.pixels
    if circle_diameter_mm is not None:
        to_image = fit_smooth_map(points[:, :2], pixels)
        pixels = pixels - circle_centre_bias(
            lambda rim: to_image(rim[:, :2]), points, diameter_mm=circle_diameter_mm, axis_u=_X, axis_v=_Y
        )
    return PlateMap(fit_smooth_map(pixels, points[:, :2]), ConvexHull(points[:, :2]).equations)


def fit_smooth_map(start: np.ndarray, end: np.ndarray) -> SmoothMap:
    """Smooth map from points (N, 2) to points (N, 2), by least squares.

    Raises
    ------
    CalibrationError
        There are too few points, or they determine no homography.
    """
    degrees = [d for d in range(_LOWEST_DEGREE, _HIGHEST_DEGREE + 1) if _POINTS_PER_TERM * _count(d) <= len(start)]
    if not degrees:
        raise CalibrationError(
            f"only {len(start)} points of the target are seen; at least {_POINTS_PER_TERM * _count(_LOWEST_DEGREE)} "
            "are needed to tell where on the plate the stripe lies"
        )
    found = cv2.findHomography(np.ascontiguousarray(start), np.ascontiguousarray(end), method=0)[0]
    if found is None or not np.isfinite(found).all():
        raise CalibrationError(f"the {len(start)} points of the target determine no homography of image and plate")
    low, high, degree = start.min(axis=0), start.max(axis=0), degrees[-1]
    left, terms = end - _project(found, start), _terms(start, low, high, degree)
    coefficients = np.linalg.lstsq(terms, left, rcond=None)[0]
    return SmoothMap(found, low, high, degree, coefficients, left - terms @ coefficients)


def _project(homography: np.ndarray, points: np.ndarray) -> np.ndarray:
    mapped = np.column_stack([points, np.ones(len(points))]) @ homography.T
    return mapped[:, :2] / mapped[:, 2:]


def _count(degree: int) -> int:
    """Number of terms of a polynomial in two variables of a total degree."""
    return (degree + 1) * (degree + 2) // 2


def _terms(points: np.ndarray, low: np.ndarray, high: np.ndarray, degree: int) -> np.ndarray:
    """Products of Legendre polynomials in both coordinates up to a total degree, (M, terms)."""
    first, second = ((2 * points - low - high) / (high - low)).T
    products = legendre.legvander2d(first, second, [degree, degree])
    powers = np.add.outer(np.arange(degree + 1), np.arange(degree + 1)).ravel()
    return products[:, powers <= degree]
