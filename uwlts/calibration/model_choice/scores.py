"""How well models predict the same images held out, and whether one does so better than chance would have it."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from uwlts.calibration.joint.noise import stray_limit
from uwlts.calibration.joint.observations import TARGET
from uwlts.calibration.model_choice.prediction import Misses, Prediction

POINTS, STRIPES = "points", "stripes"
"""The target's points; stripes on target and steps."""

_DRAWS = 2000


@dataclass(frozen=True)
class Score:
    """Root mean square miss of a model in the images held out in one way.

    Attributes
    ----------
    px : dict
        Of the target's points and of the stripes.
    mm : dict
        The same on the object.
    all_mm : float
        Of both together.
    std_mm : float
        Its standard error, by drawing the images anew.
    """

    px: dict[str, float]
    mm: dict[str, float]
    all_mm: float
    std_mm: float


@dataclass(frozen=True, eq=False)
class Tally:
    """Sums over the points of each image held out, for C models and I images; strays do not count.

    Attributes
    ----------
    px, mm : dict
        Squares (C, I) of misses, of points and of stripes.
    counts : dict
        Numbers (I,) of points.
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
        limits[kind] = min(stray_limit(np.concatenate([m.px for m in p.misses if m.kind == kind])) for p in predictions)

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
