"""Scores of models and of polynomials in the same images held out, with standard errors."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.polynomial import legendre

from uwlts.calibration.joint.evidence import STRIPE, TARGET
from uwlts.calibration.joint.gathering import Series
from uwlts.calibration.joint.noise import outlier_limit
from uwlts.calibration.model_comparison.held_out import Image, Misses, Prediction
from uwlts.calibration.polynomial import fit_line_polynomials
from uwlts.calibration.polynomial_evidence import object_coordinates, stripes_on_plate
from uwlts.storage.capture import CaptureHeader

POINTS, STRIPES = "points", "stripes"
"""The target's points; stripes on target and steps."""

_DRAWS = 2000  # standard errors to 2 %


@dataclass(frozen=True)
class Score:
    """Root mean square miss of a model in the images held out in one way.

    Attributes
    ----------
    px : of the target's points and of the stripes
    mm : the same on the object
    all_mm : of both together
    std_mm : its standard error, by drawing the images anew
    """

    px: dict[str, float]
    mm: dict[str, float]
    all_mm: float
    std_mm: float


@dataclass(frozen=True, eq=False)
class Tally:
    """Sums over the points of each image held out, for C models and I images; outliers do not count.

    Attributes
    ----------
    px, mm : squares (C, I) of misses, of points and of stripes
    counts : numbers (I,) of points
    """

    px: dict[str, np.ndarray]
    mm: dict[str, np.ndarray]
    counts: dict[str, np.ndarray]

    def score(self, model: int) -> Score:
        """Score of a model."""
        seen = [kind for kind in self.counts if self.counts[kind].any()]
        all_mm, std_mm = rms_of_images(self._all(model), self._number())
        return Score(
            px={kind: _rms(self.px[kind][model], self.counts[kind]) for kind in seen},
            mm={kind: _rms(self.mm[kind][model], self.counts[kind]) for kind in seen},
            all_mm=all_mm,
            std_mm=std_mm,
        )

    def beyond(self, model: int, other: int) -> tuple[float, float]:
        """By how much a model's mean square in mm2 is above another's, image by image, and its standard error."""
        difference, draws = self._all(model) - self._all(other), _draws(len(self._number()))
        drawn = draws @ difference / (draws @ self._number())
        return float(difference.sum() / self._number().sum()), float(drawn.std(ddof=1))

    def as_good(self, model: int, other: int) -> bool:
        """Whether a model is no worse than another, within the standard error of their difference."""
        difference, std = self.beyond(model, other)
        return difference <= std

    def _all(self, model: int) -> np.ndarray:
        return np.sum([squares[model] for squares in self.mm.values()], axis=0)

    def _number(self) -> np.ndarray:
        return np.sum(list(self.counts.values()), axis=0)


def tally(predictions: Sequence[Prediction]) -> Tally:
    """The sums of several predictions of the same images."""
    used, first = _used(predictions), predictions[0].misses
    images = sorted({miss.image for miss in first})
    shape = len(predictions), len(images)
    sums = {what: {kind: np.zeros(shape) for kind in (POINTS, STRIPES)} for what in ("px", "mm")}
    counts = {kind: np.zeros(len(images)) for kind in (POINTS, STRIPES)}
    for place, miss in enumerate(first):
        kind, image = POINTS if miss.kind == TARGET else STRIPES, images.index(miss.image)
        counts[kind][image] += used[place].sum()
        for model, prediction in enumerate(predictions):
            for what, squares in sums.items():
                squares[kind][model, image] += np.sum(getattr(prediction.misses[place], what)[used[place]] ** 2)
    return Tally(sums["px"], sums["mm"], counts)


def _used(predictions: Sequence[Prediction]) -> list[np.ndarray]:
    """Which points (n,) of each of the misses count: not those that all models miss by far."""
    limits: dict[str, float] = {}
    for kind in {miss.kind for miss in predictions[0].misses}:
        limits[kind] = min(
            outlier_limit(np.concatenate([m.px for m in p.misses if m.kind == kind])) for p in predictions
        )

    def near(same: Sequence[Misses]) -> np.ndarray:
        return np.min([miss.px for miss in same], axis=0) <= limits[same[0].kind]

    return [near(same) for same in zip(*(p.misses for p in predictions), strict=True)]


def rms_of_images(squares: np.ndarray, counts: np.ndarray) -> tuple[float, float]:
    """Root of the mean square over all images, from sums of squares (I,) and counts (I,), and its standard error."""
    draws = _draws(len(counts))
    return _rms(squares, counts), float(np.sqrt(draws @ squares / (draws @ counts)).std(ddof=1))


def _draws(images: int) -> np.ndarray:
    """How often each image is drawn (B, I); the same draws for all."""
    return np.random.default_rng(0).multinomial(images, np.full(images, 1 / images), size=_DRAWS)


def _rms(squares: np.ndarray, counts: np.ndarray) -> float:
    return float(np.sqrt(squares.sum() / counts.sum()))


DEGREE = 6  # of the polynomials (thesis, section 4.7)


@dataclass(frozen=True)
class PolynomialScore:
    """Root mean square misses in mm of stripes on the target, inside the calibrated volume.

    Polynomials have no camera, so that they are judged on the object only; outside they do not measure.

    Attributes
    ----------
    all_mm, std_mm : by polynomials, with the standard error
    model_mm, model_std_mm : in the same images by the model they are compared with
    """

    medium: str
    images: int
    all_mm: float
    std_mm: float
    model_mm: float
    model_std_mm: float


def polynomial_score(
    series: Series, header: CaptureHeader, images: Sequence[Image], model: Prediction
) -> PolynomialScore | None:
    """Score of polynomials in the images of a series that are held out; None where there is no such image.

    Raises CalibrationError: the series is not fit for polynomials.
    """
    if not images:
        return None
    stripes, _, _ = stripes_on_plate(series.found, header, DEGREE)
    depth_mm, _ = object_coordinates(stripes, header)
    held = np.isin(stripes.pose, [image for _, image in images])
    fit = fit_line_polynomials(stripes.lines[~held], stripes.centres_px[~held], depth_mm[~held], degree=DEGREE)
    low, high = fit.range
    rows, x = stripes.lines[held] - fit.first_line, stripes.centres_px[held]
    known = (rows >= 0) & (rows < len(fit.coefficients)) & (x >= low) & (x <= high)
    argument = (2 * x[known] - low - high) / (high - low)
    found = legendre.legval(argument, fit.coefficients[rows[known]].T, tensor=False)
    off, pose = found - depth_mm[held][known], stripes.pose[held][known]
    by_model = [m.mm for m in model.misses if m.image in images and m.kind == STRIPE]
    all_mm, std_mm = _robust_rms([off[pose == image] for image in np.unique(pose)])
    model_mm, model_std_mm = _robust_rms(by_model)
    return PolynomialScore(header.medium_name, len(images), all_mm, std_mm, model_mm, model_std_mm)


def _robust_rms(misses: Sequence[np.ndarray]) -> tuple[float, float]:
    """Root mean square of the misses in several images, without outliers, and its standard error."""
    limit = outlier_limit(np.concatenate(misses))
    kept = [off[np.abs(off) <= limit] for off in misses]
    squares, counts = np.array([np.sum(off**2) for off in kept]), np.array([len(off) for off in kept])
    return rms_of_images(squares, counts)
