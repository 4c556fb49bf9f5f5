"""Domain gap between generated and real images: distance of the distributions of the stripe's statistics.

The gap is the energy coefficient of inhomogeneity of windows X and Y of two sets at the Euclidean distance d:
H = (2 E d(X, Y) - E d(X, X') - E d(Y, Y')) / (2 E d(X, Y)). It is 0 for equal distributions, and at most 1 (Rizzo and
Székely, Energy distance, WIREs Computational Statistics 8, 2016, 27-38). Each statistic is first replaced by its
quantile in the mixture of both sets with equal weights, so that units and transformations do not matter. Means are over
pairs of different windows (U-statistics).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from itertools import product
from pathlib import Path

import numpy as np
from scipy.spatial.distance import cdist

from uwlts._version import __version__
from uwlts.errors import CaptureError, DescriptionError, RangeError
from uwlts.fitting.propagation import jackknife
from uwlts.model.sensor import Table
from uwlts.model.short_text import Brief, align_columns
from uwlts.radiometry.stripe_windows import STATISTICS, WINDOW_LINES, StripeWindows, measure_windows, open_image_set
from uwlts.runtime.progress import ProgressListener, ignore_progress
from uwlts.stripe import StripeSettings

_MOST_WINDOWS = 2000
"""Largest number of windows of a set whose pairs are compared; more are thinned evenly."""
_FEWEST_WINDOWS = 6
"""Least number of windows of a set: median and range of fewer say little."""
_FEWEST_IMAGES = 6
"""Least number of images for a jackknife over images; with fewer, it is over parts of successive windows."""
_PARTS = 8
"""Parts of successive windows: a jackknife over fewer has no stable standard deviation."""
_HALVINGS = 50
"""Random halves of a real set: their mean is then known to a seventh of its scatter."""
_COVERED = (0.01, 0.99)
"""Quantiles of the generated values between which a real value counts as covered."""
QUANTILES = (0.05, 0.5, 0.95)
"""Quantiles in tables: the middle, and the range without one of twenty on either side."""


@dataclass(frozen=True)
class SetGap:
    """Domain gap of a set from a real one.

    Attributes
    ----------
    name, real : str
        Names of both sets.
    gap, std : float
        Energy coefficient, and its standard uncertainty by the jackknife over images.
    by_statistic : dict
        Energy coefficient of each statistic alone.
    covered : dict
        Fraction of the real windows whose statistic is within the central 98 % of the set's.
    covered_at_once : float
        Fraction of the real windows for which this holds for all statistics.
    """

    name: str
    real: str
    gap: float
    std: float
    by_statistic: dict[str, float]
    covered: dict[str, float]
    covered_at_once: float


@dataclass(frozen=True)
class GapFloor:
    """Domain gap between random halves of a real set: mean, and standard deviation of halvings."""

    real: str
    gap: float
    std: float


@dataclass(frozen=True, eq=False, repr=False)
class DomainGap(Brief):
    """Statistics of generated and real stripes, and the gaps between them.

    Attributes
    ----------
    generated, real : tuple of StripeWindows
        Statistics of all windows of each set.
    gaps : tuple of SetGap
        Gap of every generated set, and of every other real set, from every real set.
    floors : tuple of GapFloor
        Gap between halves of each real set.
    """

    generated: tuple[StripeWindows, ...]
    real: tuple[StripeWindows, ...]
    gaps: tuple[SetGap, ...]
    floors: tuple[GapFloor, ...]

    def sets(self) -> tuple[StripeWindows, ...]:
        """Return all sets, generated ones first."""
        return self.generated + self.real

    def gap_table(self) -> tuple[list[str], list[list[str]]]:
        """Return heading and rows of the table of gaps: one column for each real set."""
        by_pair = {(each.name, each.real): each for each in self.gaps}
        rows = []
        for each in self.sets():
            found = [by_pair.get((each.name, real.name)) for real in self.real]
            cells = ["" if pair is None else f"{pair.gap:.2f} ± {pair.std:.2f}" for pair in found]
            rows.append([each.name, f"{len(each.values)}", *cells])
        rows.append(["two halves", "", *(f"{floor.gap:.2f} ± {floor.std:.2f}" for floor in self.floors)])
        return ["gap", "windows", *(each.name for each in self.real)], rows

    def covered_table(self) -> tuple[list[str], list[list[str]]]:
        """Return heading and rows of the table of covered real windows, in percent, and of the gaps by statistic."""
        pairs = [each for each in self.gaps if each.name in {one.name for one in self.generated}]
        rows = [
            [
                each.name,
                *(f"{100 * pair.covered[each.name]:.0f} / {pair.by_statistic[each.name]:.2f}" for pair in pairs),
            ]
            for each in STATISTICS
        ]
        rows.append(["all", *(f"{100 * pair.covered_at_once:.0f} / {pair.gap:.2f}" for pair in pairs)])
        return ["% covered / gap", *(f"{pair.name}, {pair.real}" for pair in pairs)], rows

    def statistics_table(self) -> tuple[list[str], list[list[str]]]:
        """Return heading and rows of the table of all statistics: 5 %, median and 95 % of each set."""
        rows = [
            [
                f"{each.name} {each.unit}".rstrip(),
                *(", ".join(f"{x:.3g}" for x in np.quantile(one.values[:, k], QUANTILES)) for one in self.sets()),
            ]
            for k, each in enumerate(STATISTICS)
        ]
        return ["5 %, median, 95 %", *(each.name for each in self.sets())], rows

    def lines(self) -> list[str]:
        """Return the result as text."""
        blocks = [self.statistics_table()]
        if self.real:
            blocks += [self.covered_table()] if self.generated else []
            blocks.append(self.gap_table())
        return [line for head, rows in blocks for line in (*align_columns([head, *rows]), "")][:-1]

    def record(self) -> Table:
        """Return the result as JSON."""
        content: Table = {
            "format": "uwlts-domain-gap",
            "version": 1,
            "software": __version__,
            "window_lines": WINDOW_LINES,
            "statistics": [asdict(each) for each in STATISTICS],
            "sets": [
                {
                    "name": each.name,
                    "real": each in self.real,
                    "images": len(np.unique(each.image)),
                    "windows": len(each.values),
                    "quantiles": {
                        statistic.name: np.quantile(each.values[:, k], QUANTILES).tolist()
                        for k, statistic in enumerate(STATISTICS)
                    },
                }
                for each in self.sets()
            ],
            "gaps": [asdict(each) for each in self.gaps],
            "floors": [asdict(each) for each in self.floors],
        }
        return content


def measure_domain_gap(
    generated: Sequence[str | Path],
    *,
    real: Sequence[str | Path] = (),
    most_images: int = 200,
    stripe: StripeSettings = None,
    progress: ProgressListener = ignore_progress,
) -> DomainGap:
    """Measure the statistics of generated and real stripes, and the gaps between them; see `write_domain_gap`."""
    if not generated and not real:
        raise DescriptionError("no images are given: give `generated` or `real` sets of images, or both")
    if most_images < 1:
        raise RangeError(f"`most_images` is {most_images}; expected 1 or more")
    sources = [*generated, *real]
    found = []
    for number, source in enumerate(sources):
        windows = measure_windows(open_image_set(source, stripe=stripe), most_images=most_images)
        if len(windows.values) < _FEWEST_WINDOWS:
            raise CaptureError(
                f"{source} shows {len(windows.values)} pieces of a stripe {WINDOW_LINES} lines long; expected "
                f"{_FEWEST_WINDOWS} or more: give more images"
            )
        found.append(windows)
        progress(number + 1, len(sources), "statistics")
    names = [each.name for each in found]
    found = [
        each if names.count(each.name) == 1 else replace(each, name=str(source))
        for each, source in zip(found, sources, strict=True)
    ]
    ours, theirs = tuple(found[: len(generated)]), tuple(found[len(generated) :])
    pairs = [(one, other) for other, one in product(theirs, found) if one is not other]
    return DomainGap(ours, theirs, tuple(_set_gap(*pair) for pair in pairs), tuple(map(_measure_floor, theirs)))


def _set_gap(generated: StripeWindows, real: StripeWindows) -> SetGap:
    x, y = _thin(generated), _thin(real)
    p, q = _replace_by_quantiles(x.values, y.values)
    low, high = np.quantile(generated.values, _COVERED, axis=0)
    inside = (real.values >= low) & (real.values <= high)
    names = [each.name for each in STATISTICS]
    values, starts = np.vstack([p, q]), np.append(_group_starts(x.image), len(p) + _group_starts(y.image))
    first, second = np.split(np.arange(len(starts)), [np.searchsorted(starts, len(p))])
    single = [_GroupDistances.between(column[:, None], starts).coefficient(first, second) for column in values.T]
    whole = _GroupDistances.between(values, starts)
    left = [[whole.coefficient(first[first != group], second) for group in first]]
    left.append([whole.coefficient(first, second[second != group]) for group in second])
    return SetGap(
        generated.name,
        real.name,
        whole.coefficient(first, second),
        math.sqrt(sum(float(jackknife((np.array(each) - np.mean(each))[:, None])[0, 0]) for each in left)),
        dict(zip(names, single, strict=True)),
        dict(zip(names, inside.mean(axis=0).tolist(), strict=True)),
        float(inside.all(axis=1).mean()),
    )


def _measure_floor(real: StripeWindows) -> GapFloor:
    """Return the gap between random halves of the images of a real set, or of its parts if it has few images."""
    windows, rng = _thin(real), np.random.default_rng(0)
    values = _replace_by_quantiles(windows.values, windows.values)[0]
    whole = _GroupDistances.between(values, _group_starts(windows.image))
    count = len(whole.count)
    halves = [rng.permutation(count) for _ in range(_HALVINGS)]
    gaps = [whole.coefficient(each[: count // 2], each[count // 2 :]) for each in halves]
    return GapFloor(real.name, float(np.mean(gaps)), float(np.std(gaps)))


def _thin(windows: StripeWindows) -> StripeWindows:
    kept = np.unique(np.linspace(0, len(windows.values) - 1, min(_MOST_WINDOWS, len(windows.values))).astype(int))
    return StripeWindows(windows.name, windows.values[kept], windows.image[kept], ())


def _replace_by_quantiles(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Replace statistics (N, K) and (M, K) by their mid-quantiles in the mixture of both with equal weights."""

    def share(values: np.ndarray, among: np.ndarray) -> np.ndarray:
        order = np.sort(among)
        below, up_to = (np.searchsorted(order, values, side) for side in ("left", "right"))
        return 0.5 * (below + up_to) / len(order)

    mixed = [
        np.column_stack(
            [0.5 * (share(values[:, k], x[:, k]) + share(values[:, k], y[:, k])) for k in range(x.shape[1])]
        )
        for values in (x, y)
    ]
    return mixed[0], mixed[1]


@dataclass(frozen=True, eq=False)
class _GroupDistances:
    """Sums (G, G) of the distances between all windows of two groups, with numbers (G,) of their windows.

    Groups are images, or parts of successive windows.
    """

    sums: np.ndarray
    count: np.ndarray

    @classmethod
    def between(cls, values: np.ndarray, starts: np.ndarray) -> _GroupDistances:
        """Sum the distances of windows with statistics (N, K); ``starts`` (G,) are the first windows of groups."""
        by_group = np.add.reduceat(cdist(values, values), starts, axis=0)
        return cls(np.add.reduceat(by_group, starts, axis=1), np.diff(starts, append=len(values)))

    def coefficient(self, some: np.ndarray, others: np.ndarray) -> float:
        """Return the energy coefficient of inhomogeneity of some groups and of other ones, given by their numbers."""
        n, m = (int(self.count[groups].sum()) for groups in (some, others))
        within = sum(self.sums[np.ix_(g, g)].sum() / (k * (k - 1)) for g, k in ((some, n), (others, m)))
        between = 2 * self.sums[np.ix_(some, others)].sum() / (n * m)
        return float((between - within) / between) if between > 0 else 0.0


def _group_starts(image: np.ndarray) -> np.ndarray:
    """Return the first windows of groups: images, or parts of successive windows if there are few images."""
    starts = np.flatnonzero(np.diff(image, prepend=-1))
    if len(starts) >= _FEWEST_IMAGES:
        return starts
    return np.unique(np.linspace(0, len(image), min(_PARTS, len(image) // 2), endpoint=False).astype(int))
