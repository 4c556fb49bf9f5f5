"""Latency between camera and stage, from a scan there and back.

Where the clock of the stage's positions runs late against the camera's, what is seen on the way there is shifted along
the stage one way, and what is seen on the way back the other way, by the speed times the latency each. So both passes
show the same surface, displaced by twice that. Play of the drive displaces them too, by the same way at every speed.
"""

from dataclasses import dataclass

import numpy as np

from uwlts.errors import EvaluationError
from uwlts.fitting.least_squares import robust_std

_LARGEST_S = 0.5
"""Latency that is looked for at most: that of slow drivers."""
_MOST_BENT_PX = 2.0
"""Largest change of the stripe's motion from one frame to the next, px. Beyond is an edge, unless the motion changes
alike beside it."""
_MOST_BENT = 0.5
"""The same as a share of the motion: at a jump it changes by twice its mean, and next by the opposite."""
_FEWEST = 200
"""Pairs of stripe centres with relief from which the latency is estimated."""
_GRAIN = 2.0
"""Neighbouring lines share their speckle, so that the scatter of their mean is so many times as large."""
_LEAST_RELIEF = 0.5
"""Passes are compared where they share so much of the most relief that they share at any shift."""
_FAR_PX = 20.0
"""Distances beyond are those of something else."""
_ROUNDS = 8
"""Rounds, at most, in which outliers are found anew."""
_OUTLIER = 4.0
"""Standard deviations beyond which a distance is left out: one in 16,000 of Gaussian ones."""


@dataclass(frozen=True)
class Latency:
    """A stage's positions are those of a time ``latency_s`` before the camera's, with a standard uncertainty in s.

    A frame's position is the reported one plus its speed times the latency.
    """

    latency_s: float
    std_s: float


def measure_latency(centre_px: np.ndarray, stage_mm: np.ndarray, speed_mm_per_s: np.ndarray) -> Latency:
    """The latency from frames (N,) of passes in both directions over a surface that stands still.

    Parameters
    ----------
    centre_px : (N, L) stripe centres on all profile lines, NaN where there is none
    stage_mm, speed_mm_per_s : (N,) position and signed speed of the stage at each frame

    Raises EvaluationError: a pass is missing, or the surface has too little relief along the motion.
    """
    there, back = (np.flatnonzero(sign * speed_mm_per_s > 0) for sign in (1, -1))
    if min(len(there), len(back)) < 4:
        raise EvaluationError(
            f"{len(there)} frames were taken one way and {len(back)} the other: a latency shows in four or more each"
        )
    there, back = (frames[np.argsort(stage_mm[frames])] for frames in (there, back))
    surface = _Surface.of(stage_mm[there], centre_px[there])
    speed = float(np.median(speed_mm_per_s[there]) - np.median(speed_mm_per_s[back])) / 2
    seen, position = centre_px[back], stage_mm[back]
    # A frame at x on the way back shows what the way there shows at x - 2 v latency.
    step = surface.step_mm / 2
    reach = int(np.ceil(2 * speed * _LARGEST_S / step))
    ways = step * np.arange(-reach, reach + 1)
    ways = ways[np.argsort(np.abs(ways), kind="stable")]
    costs, relief = np.array([_cost(surface, position, seen, way) for way in ways]).T
    # Flat ground beside the relief fits flat ground, whatever the shift.
    comparable = relief >= _LEAST_RELIEF * relief.max()
    if not relief.max() > 0:
        raise EvaluationError(
            "the passes there and back hardly see the same lines, or no relief on them: was a surface with slopes in "
            "view both ways?"
        )
    shift = float(ways[np.argmin(np.where(comparable, costs, np.inf))])
    away = slope = np.empty(0)
    for _ in range(_ROUNDS):
        away, slope = surface.at(position - shift, seen)
        scatter = robust_std(away - np.median(away)) if len(away) else 0.0
        near = np.abs(away) <= max(_OUTLIER * scatter, 1e-6)
        if np.count_nonzero(near) < _FEWEST or not (slope[near] ** 2).sum() > 0:
            raise EvaluationError(
                "the surface has too little relief along the motion to show the latency: scan something with slopes, "
                "such as a sphere, or give latency_ms"
            )
        away, slope = away[near], slope[near]
        # away = c_back(x) - c_there(x - shift); a further shift d changes it by slope d.
        further = -float((slope * away).sum() / (slope**2).sum())
        shift += further
        if abs(further) < 1e-6:
            break
    std = _GRAIN * float(np.std(away)) / float(np.sqrt((slope**2).sum()))
    return Latency(shift / (2 * speed), std / (2 * speed))


def _cost(surface: "_Surface", position: np.ndarray, seen: np.ndarray, shift: float) -> tuple[float, float]:
    """Mean distance in px of what is seen on the way back, and the sum of the slopes squared where it is compared."""
    away, slope = surface.at(position - shift, seen)
    if len(away) < _FEWEST:
        return np.inf, 0.0
    return float(np.mean(np.minimum(np.abs(away), _FAR_PX))), float((slope**2).sum())


@dataclass(frozen=True, eq=False)
class _Surface:
    """Stripe centres (N, L) as a function of the position (N,), between frames by a cubic through their slopes."""

    position: np.ndarray
    centre: np.ndarray
    slope: np.ndarray

    @classmethod
    def of(cls, position: np.ndarray, centre: np.ndarray) -> "_Surface":
        apart = position[2:] - position[:-2]
        slope = np.full_like(centre, np.nan)
        across = centre[2:] - centre[:-2]
        bend = centre[2:] - 2 * centre[1:-1] + centre[:-2]
        odd = np.abs(bend)
        odd[1:-1] = np.fmin(odd[1:-1], np.abs(bend[1:-1] - (bend[2:] + bend[:-2]) / 2))
        smooth = odd < np.maximum(_MOST_BENT_PX, _MOST_BENT * np.abs(across) / 2)
        slope[1:-1] = np.where(smooth, across / apart[:, None], np.nan)
        return cls(position, centre, slope)

    @property
    def step_mm(self) -> float:
        """Usual way from one frame to the next."""
        return float(np.median(np.diff(self.position)))

    def at(self, places: np.ndarray, seen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Distance (K,) of what is ``seen`` (M, L) at places (M,) from the surface, and its slope there (K,) in px/mm.

        Hermite's cubic; only where both neighbours are seen.
        """
        left = np.clip(np.searchsorted(self.position, places) - 1, 0, len(self.position) - 2)
        gap = self.position[left + 1] - self.position[left]
        t = ((places - self.position[left]) / gap)[:, None]
        h = gap[:, None]
        a, b, da, db = self.centre[left], self.centre[left + 1], self.slope[left] * h, self.slope[left + 1] * h
        value = a + t * da + t**2 * (3 * (b - a) - 2 * da - db) + t**3 * (2 * (a - b) + da + db)
        slope = (da + 2 * t * (3 * (b - a) - 2 * da - db) + 3 * t**2 * (2 * (a - b) + da + db)) / h
        away = seen - value
        good = np.isfinite(away) & ((t >= 0) & (t <= 1))
        return away[good], slope[good]
