"""Latency between camera and stage, from a forward and a backward scan.

A latency of the stage positions shifts the forward and the backward pass in opposite directions, each by speed times
latency. Both passes therefore show the same surface with twice this displacement. Backlash of the drive also displaces
them, but by an amount independent of speed.
"""

from dataclasses import dataclass

import numpy as np

from uwlts.errors import EvaluationError
from uwlts.fitting.least_squares import robust_std

_LARGEST_S = 0.5
"""Largest latency of the search, that of slow drivers."""
_MOST_BENT_PX = 2.0
"""Largest second difference of a stripe centre over frames, px. A larger one is an edge, unless neighbours share it."""
_MOST_BENT = 0.5
"""The same limit relative to the mean first difference. At a jump the ratio is 2, followed by the opposite sign."""
_FEWEST = 200
"""Least number of pairs of stripe centres with relief."""
_GRAIN = 2.0
"""Factor on the standard error, because adjacent lines have correlated speckle."""
_LEAST_RELIEF = 0.5
"""Least relief common to both passes, relative to its maximum over all shifts, for a shift to be compared."""
_FAR_PX = 20.0
"""Largest distance of a mismatch; above it, the cost is constant."""
_ROUNDS = 30
"""Largest number of rounds of outlier rejection; steps are short while slopes are mostly noise."""
_LEAST_COMMON = 0.5
"""Least product of the slopes of both passes, relative to the square of those of one: less is mostly noise."""
_OUTLIER = 4.0
"""Outlier limit in standard deviations; one in 16,000 Gaussian distances exceeds it."""


def measure_latency(centre_px: np.ndarray, stage_mm: np.ndarray, speed_mm_per_s: np.ndarray) -> tuple[float, float]:
    """Measure the latency of the stage positions relative to the camera, s, and its standard uncertainty.

    The true position of a frame is the reported one plus its speed times the latency. Passes in both directions over a
    static surface show it: stripe centres (N, L) of the frames on all profile lines, NaN without a stripe, and
    positions and signed speeds (N,) of the stage.

    EvaluationError if a pass is missing, or the surface has too little relief along the motion.
    """
    there, back = (np.flatnonzero(sign * speed_mm_per_s > 0) for sign in (1, -1))
    if min(len(there), len(back)) < 4:
        raise EvaluationError(
            f"found {len(there)} frames of the forward and {len(back)} of the backward pass; at least four of each are "
            "needed (both_ways = true)"
        )
    there, back = (frames[np.argsort(stage_mm[frames])] for frames in (there, back))
    surface = _CentreCurves.from_centres(stage_mm[there], centre_px[there])
    backward = _CentreCurves.from_centres(stage_mm[back], centre_px[back])
    speed = float(np.median(speed_mm_per_s[there]) - np.median(speed_mm_per_s[back])) / 2
    # A backward frame at x shows the same as the forward pass at x - 2 v latency.
    step = float(np.median(np.diff(surface.position))) / 2
    reach = int(np.ceil(2 * speed * _LARGEST_S / step))
    ways = step * np.arange(-reach, reach + 1)
    ways = ways[np.argsort(np.abs(ways), kind="stable")]
    costs, relief = np.array([_compute_cost(surface, backward, way) for way in ways]).T
    # Without relief, flat areas match at any shift.
    comparable = relief >= _LEAST_RELIEF * relief.max()
    if not relief.max() > 0:
        raise EvaluationError(
            "the forward and backward passes share too few lines, or these show no relief. Scan a surface with slopes "
            "in both directions"
        )
    shift = float(ways[np.argmin(np.where(comparable, costs, np.inf))])
    residual = slope = weight = np.empty(0)
    for _ in range(_ROUNDS):
        residual, slope, other = surface.compare(backward, shift)
        scatter = robust_std(residual - np.median(residual)) if len(residual) else 0.0
        near = np.abs(residual) <= max(_OUTLIER * scatter, 1e-6)
        if np.count_nonzero(near) < _FEWEST or not (slope[near] ** 2).sum() > 0:
            raise EvaluationError(
                "the surface has too little relief along the motion to determine the latency: scan a surface with "
                "slopes, such as a sphere, or give latency_ms"
            )
        residual, slope, weight = residual[near], slope[near], np.nan_to_num(other[near])
        # away = c_back(x) - c_there(x - shift); a further shift d changes it by slope d. The slope of the backward pass
        # is an instrumental variable: errors of the slope and of the value of the forward pass are correlated. Slopes
        # that are mostly noise are no instrument.
        if (weight * slope).sum() < _LEAST_COMMON * (slope**2).sum():
            weight = slope
        further = -float((weight * residual).sum() / (weight * slope).sum())
        shift += further
        if abs(further) < 1e-6:
            break
    std = _GRAIN * float(np.std(residual)) * float(np.sqrt((weight**2).sum()) / (weight * slope).sum())
    return shift / (2 * speed), std / (2 * speed)


def _compute_cost(surface: "_CentreCurves", backward: "_CentreCurves", shift: float) -> tuple[float, float]:
    """Return the mean capped distance, px, of the backward pass at a shift, and the sum of squared slopes."""
    residual, slope, _ = surface.compare(backward, shift)
    if len(residual) < _FEWEST:
        return np.inf, 0.0
    return float(np.mean(np.minimum(np.abs(residual), _FAR_PX))), float((slope**2).sum())


@dataclass(frozen=True, eq=False)
class _CentreCurves:
    """Stripe centres (N, L) as a function of the position (N,), with cubic Hermite interpolation between frames."""

    position: np.ndarray
    centre: np.ndarray
    slope: np.ndarray

    @classmethod
    def from_centres(cls, position: np.ndarray, centre: np.ndarray) -> "_CentreCurves":
        spacing = position[2:] - position[:-2]
        slope = np.full_like(centre, np.nan)
        across = centre[2:] - centre[:-2]
        bend = centre[2:] - 2 * centre[1:-1] + centre[:-2]
        odd = np.abs(bend)
        odd[1:-1] = np.fmin(odd[1:-1], np.abs(bend[1:-1] - (bend[2:] + bend[:-2]) / 2))
        smooth = odd < np.maximum(_MOST_BENT_PX, _MOST_BENT * np.abs(across) / 2)
        slope[1:-1] = np.where(smooth, across / spacing[:, None], np.nan)
        return cls(position, centre, slope)

    def compare(self, other: "_CentreCurves", shift: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Compare the centres of another pass at x with those of this pass at x - shift.

        Returns the distances (K,), px, and the slopes (K,) of this and of the other pass, px/mm. Only places between
        two visible neighbours of this pass are returned; the slope of the other pass may be NaN.
        """
        places = other.position - shift
        left = np.clip(np.searchsorted(self.position, places) - 1, 0, len(self.position) - 2)
        gap = self.position[left + 1] - self.position[left]
        t = ((places - self.position[left]) / gap)[:, None]
        h = gap[:, None]
        a, b, da, db = self.centre[left], self.centre[left + 1], self.slope[left] * h, self.slope[left + 1] * h
        rise = b - a
        cubic = da + db - 2 * rise
        square = rise - da - cubic
        value = a + t * (da + t * (square + t * cubic))
        slope = (da + t * (2 * square + 3 * t * cubic)) / h
        residual = other.centre - value
        good = np.isfinite(residual) & ((t >= 0) & (t <= 1))
        return residual[good], slope[good], other.slope[good]
