"""Check of a cloud by its own overlaps: surfaces that the sensor passed twice agree within the stated uncertainty.

The unknowns are the independent errors in the cloud's uncertainty (calibration, water, mount, path), of zero mean and
unit variance. One linear step estimates them from the disagreement of the passes (`surface_cells`). The verdict is the
probability of values as large by chance.
"""

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import uniform_filter1d

from uwlts.errors import CalibrationError, EvaluationError
from uwlts.fitting.patches import find_disc_radius
from uwlts.fitting.propagation import noise_shifts
from uwlts.recalibration.pass_estimate import POOR_FIT, chance, estimate_covariance, normal_equations, weigh
from uwlts.recalibration.surface_cells import CELL, LINES, PassPoints, divide, observe
from uwlts.storage.cloud import PointCloud

_MOST_POINTS = 30_000  # for a second of computation
_SMOOTHED = 9
"""Number of images whose mean motion is the direction of a pass: steps vary with what is seen."""
_DOUBTED = 0.01
"""Probability of chance below which passes disagree: once in a hundred right scans."""
_PART = 0.1  # least weight of a group of errors in a pattern that counts as its own


@dataclass(frozen=True)
class PassCheck:
    """Agreement of a cloud's passes: their number, that of the common parts of the surface, and the probability.

    ``scatter`` is the ratio of the disagreement that no stated error explains to the noise, at least 1. ``cause`` is
    the stated error that explains the disagreement best.
    """

    passes: int
    parts: int
    probability: float
    scatter: float
    cause: str

    @property
    def agree(self) -> bool:
        """True unless the disagreement is beyond chance."""
        return self.probability >= _DOUBTED and self.scatter <= POOR_FIT

    @property
    def text(self) -> str:
        """The result as text."""
        seen = f"{self.passes} passes overlap in {self.parts} parts of the surface"
        if self.agree:
            return f"{seen}, and agree within the stated uncertainty (probability {self.probability:.2g})"
        if self.scatter > POOR_FIT:
            why = f"{self.scatter:.1f} times their noise: the scene moved, or the poses have larger errors than stated"
        else:
            why = f"(probability {self.probability:.1g}): most of it would follow from an error of {self.cause}"
        return f"{seen}, and disagree beyond the stated uncertainty, {why}; uwlts recalibrate shows more"


def split_passes(cloud: PointCloud) -> np.ndarray:
    """Return the pass (N,) of each point: a pass ends where the images' motion turns by more than 90 deg.

    Images about a turn belong to no pass, -1, so that the end of a pass is no overlap with the next one. The same holds
    for passes of fewer images than the mean motion needs.
    """
    image, of_point = np.unique(cloud.frame, return_inverse=True)
    sums = [np.bincount(of_point, axis) for axis in cloud.points_mm.T]
    place = np.stack(sums, axis=1) / np.bincount(of_point)[:, None]
    number = np.zeros(len(image), int)
    if len(image) > _SMOOTHED:
        way = np.gradient(uniform_filter1d(place, _SMOOTHED, axis=0), axis=0)
        reference, turns = 0, []
        for each in range(1, len(image)):
            if each > reference and way[each] @ way[reference] < 0:
                turns.append(each)
                # The turn itself has no direction.
                reference = min(each + _SMOOTHED, len(image) - 1)
        number = np.searchsorted(turns, np.arange(len(image)), side="right")
        for each in turns:
            number[max(0, each - _SMOOTHED // 2) : each + _SMOOTHED // 2] = -1
        number[np.bincount(number + 1)[number + 1] < _SMOOTHED] = -1
    return number[of_point]


def check_passes(cloud: PointCloud) -> PassCheck | None:
    """Return the agreement of a platform's passes; None without their overlap, or without the cloud's uncertainty."""
    if cloud.uncertainty is None or cloud.time_s is None:
        return None
    number = split_passes(cloud)
    chosen = np.flatnonzero((cloud.line % LINES == 0) & (number >= 0))
    chosen = chosen[:: max(1, len(chosen) // _MOST_POINTS)]
    number, known, places = number[chosen], cloud.uncertainty[chosen], cloud.points_mm[chosen]
    if len(np.unique(number)) < 2:
        return None
    points = PassPoints(
        places,
        number,
        known.patterns_mm.astype(np.float64).transpose(1, 2, 0),
        noise_shifts(known),
        np.zeros(len(places)),
        np.ones(len(places)),
        known.image_errors_mm().astype(np.float64),
        cloud.frame[chosen],
    )
    try:
        radius = max(find_disc_radius(places[number == each]) for each in np.unique(number))
        cells = observe(points, divide(places, CELL * radius), 1.0, keep=False)
    except (CalibrationError, EvaluationError):
        return None  # no overlap, or too few points
    unknowns = len(known.patterns_mm)
    none = np.zeros(unknowns)
    total, gradient = normal_equations(cells, np.ones(len(cells)), none)
    amplitudes = -np.linalg.solve(total, gradient)
    left = [cell.apart.T @ (cell.residuals + cell.rows @ amplitudes) for cell in cells]
    weights, spread = weigh(np.array([np.mean(each**2) for each in left]))
    total, gradient = normal_equations(cells, weights, none)
    amplitudes = -np.linalg.solve(total, gradient)
    covariance = estimate_covariance(cells, weights, total, points, None)
    probability = chance(amplitudes, covariance, np.eye(unknowns))
    return PassCheck(
        len(np.unique(number)), len(cells), probability, spread, _find_cause(cloud, amplitudes, covariance)
    )


def _find_cause(cloud: PointCloud, amplitudes: np.ndarray, covariance: np.ndarray) -> str:
    """Return the name of the group of errors whose deviation is the least probable."""
    assert cloud.uncertainty is not None
    text = {"sensor": "the calibration", "mount": "the mount"}
    shared = cloud.uncertainty.shared
    groups = {text.get(name.split()[0], "the water's index"): by for name, by in shared.items()}
    alone = ~np.any([np.zeros(len(amplitudes), bool), *(by.any(axis=1) for by in shared.values())], axis=0)
    groups["the poses"] = np.eye(len(amplitudes))[:, alone]
    chances = {}
    for name, by in groups.items():
        vectors, sizes, _ = np.linalg.svd(by, full_matrices=False)
        chances[name] = chance(amplitudes, covariance, vectors[:, sizes > _PART].T)
    return min(chances, key=chances.__getitem__)
