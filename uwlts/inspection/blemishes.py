"""Depth, extent and lost metal of a blemish on an unrolled surface, with uncertainty.

The surface is a local quadratic through the points near each place of a grid. The undamaged surface is a plane through
the points around the blemish.

The quadratics and the footprints of the points smooth the surface. Twicing corrects this: the heights that the points
would measure on the smoothed surface are subtracted from their own heights, and the smoothed residuals are added
(Tukey, Exploratory Data Analysis, 1977, 16C; Van Cittert, Z. Phys. 69, 1931).

All depths are linear in the heights of the points. Point errors are therefore propagated to every value: common
patterns one by one, and noise by repeated draws (GUM Supplement 1, JCGM 101:2008).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy import ndimage, sparse
from scipy.spatial import KDTree

from uwlts.errors import EvaluationError
from uwlts.fitting.least_squares import fit_biweight
from uwlts.fitting.local_surface import measure_spacing
from uwlts.fitting.propagation import PointErrors
from uwlts.inspection.bead_profiles import BIAS_FACTOR, NODES, cubic_weights
from uwlts.inspection.bell_maps import SEARCH_RULE, UnrolledSurface
from uwlts.inspection.blemish_search import BlemishSearch, Indication
from uwlts.inspection.features import BIAS_STD, COVERAGE, COVERAGE_FACTOR, SEED, FeatureKind, FeatureValue, plain_value


class _Rule:
    """Numbers of the measurement of a blemish, whose edge is that of the search (`SEARCH_RULE`)."""

    draws: int = 120  # noise draws: three exceed either end of a 95 % interval
    depth_draws: int = 48  # noise draws for the standard deviation of depths, which 48 give to 10 %
    exponents: tuple[int, ...] = (1, 2, 3)
    """Exponents p of simulated bells (1 - t^2)^p, from a paraboloid with a sharp edge to a bell with a flat edge."""
    bandwidth: float = 0.35
    """Radius of the local quadratic, in radii of the blemish: it lowers the depth of a bell by 0.3 %."""
    narrow: float = 1.4
    """Radius of the local quadratic in rough ground, in radii of the smallest indication: two dozen points."""
    points: int = 150
    """Most points in a local quadratic, whose radius is reduced to this: its noise is a sixth of one point's."""
    ring: float = 0.6  # width of the surroundings, in radii of the blemish
    fewest_points: int = 12  # fewest undamaged points in the surroundings
    most_variance: float = 12.0
    """Largest variance of a quadratic's value, times its number of points; it is 3 to 5 inside the point set."""
    cells: int = 26  # cells of the grid across the blemish
    most_cells: int = 10_000  # most cells of the grid, limited by time
    half_depth: float = 0.6
    """Distance from the deepest place to half the depth, in radii: 0.5 for a cosine, 0.54 for a bell, 0.71 for a
    paraboloid. It gives the radius of the deepest hollow of a blemish of any outline."""
    compact: float = 0.45
    """Least radius of the deepest hollow, in half the largest extent, of a blemish that is simulated as a bell."""
    off_bell: float = 0.1
    """Largest root mean square of depths beside those of a bell, divided by the depth, of a blemish that is simulated
    as a bell: cosine, paraboloid and normal distribution have less than 0.05. Chosen on seeds 0 to 9 of
    docs/studies/inspection_verdicts.py."""
    single: float = 0.75
    """Radius of the deepest hollow, in radii of the blemish, from which the blemish is this hollow."""
    beyond: float = 1.85
    """Distance beyond the contour, in gaps, within which places without points leave it open."""
    subdivision: int = 2  # subdivision of cells for contours, on a cubic spline
    end_std: float = 1 / np.sqrt(12.0)
    """Standard uncertainty of each end of a length, in spacings of profiles or points: rectangular distribution
    between two of them (GUM, 4.3.7), as the form of the surface there is unknown."""
    saddle: float = 0.75
    """Largest depth between neighbours in one contour, as a fraction of the shallower one's depth. Rough ground of a
    single pit has higher saddles."""
    saddle_std: float = 4.0
    """Least height of a saddle above the shallower neighbour, in standard deviations of their difference. Rare
    enough for the dozens of peaks of noise in a contour."""


DENT_SHARE = 0.1  # least length and width of a dent, as a fraction of the pipe's diameter; smaller hollows are pits

_NODES = [(np.array([a, b]), u * v) for a, u in NODES for b, v in NODES]
"""Places and weights of a normal distribution in two dimensions."""


class NotSignificantError(EvaluationError):
    """The depth, length or width of an indication is not significant relative to its surroundings."""


@dataclass(frozen=True, eq=False)
class Blemish:
    """Measured blemish on an unrolled surface."""

    kind: FeatureKind
    values: tuple[FeatureValue, ...]  # without the spacing of profiles and points (`with_spacing`)
    place: np.ndarray  # (2,); deepest place
    extent_mm: np.ndarray  # (3,); size along both axes, and depth
    points: np.ndarray  # (K,) int
    outline: np.ndarray  # (L, 2); closed contour at the edge depth
    hollows: np.ndarray
    """(H, 2); deepest places of neighbours that the search joined, the deepest first; empty for a single blemish."""
    spacing_mm: np.ndarray  # (2,); spacing of the points along both axes
    reason: str | None  # why its values are bounds only
    beneath_mm: float
    """Largest sum of its depth and the surface beneath it, minus its depth; zero without such a surface."""

    def with_spacing(self) -> tuple[FeatureValue, ...]:
        """Return the values; length and width are known no better than the spacing of the points at both ends."""
        both_ends = np.sqrt(2) * _Rule.end_std * self.spacing_mm
        more = dict(zip(("length", "width"), both_ends.tolist(), strict=True))
        return tuple(value.widen(random=more[value.name]) if value.name in more else value for value in self.values)


def measure_blemish(
    surface: UnrolledSurface,
    search: BlemishSearch,
    indication: Indication,
    errors: PointErrors,
    *,
    diameter_mm: float,
    wall_mm: float | None = None,
    beneath_mm: np.ndarray | None = None,
) -> Blemish:
    """Measure an indication of a search on an unrolled surface of N points.

    The pipe's diameter distinguishes dents from pits; ``wall_mm`` is that of the undamaged wall, for the remaining
    wall. ``beneath_mm`` (N,) is the height of a smooth surface, of a dent for example, above which those of ``surface``
    count.

    Raises EvaluationError if too few points around the indication determine the undamaged surface, and
    NotSignificantError if its depth, length or width is not significant.
    """
    sign = float(np.sign(indication.height_mm))
    field, local, wide_depth = _choose_field(surface, search, indication)
    is_rough = wide_depth is not None
    heights = sign * surface.heights[field.near]
    depths = field.depths(heights)
    deepest, between = field.find_deepest(heights)
    depth = float(depths[deepest]) + between
    # Noise of independent points that explains the scatter of local means.
    noise = indication.noise_mm * surface.std[field.near] / surface.usual_std
    rng, here = np.random.default_rng(SEED), errors[field.near]
    moves = list(replace(here, single_mm=noise).draw(_Rule.draws, rng))
    inside = np.arange(len(noise)) < len(indication.points)
    more = field.scatter_ratio(heights, moves[: _Rule.depth_draws], inside)
    moves = [np.where(inside, more, 1.0) * each for each in moves]
    by_noise = np.std([field.depths(each) for each in moves[: _Rule.depth_draws]], axis=0, ddof=1)
    edge = max(SEARCH_RULE.edge_share * depth, SEARCH_RULE.edge_std * float(np.median(by_noise[field.region])))
    seen = field.figures(depths, edge, deepest, between)
    # Errors of simulated blemishes of this size, measured at these points: noise, sampling and smoothing. One of
    # another outline than a bell is its own model.
    bells = [_Bell.resembling(seen, edge, field.grid[deepest], indication.radius_mm, p) for p in _Rule.exponents]
    wrong: list[np.ndarray] = []
    own_heights = field.seen @ np.where(field.region, depths, 0.0)
    for move in moves:
        if is_rough:
            wrong.append(field.measure(own_heights + move, edge) - seen)
            continue
        bell = bells[rng.integers(len(bells))]
        shift = rng.uniform(-0.5, 0.5, 2) * search.smallest_mm
        wrong.append(field.measure(field.observe(bell, shift) + move, edge) - bell.figures(edge))
    low, bias, high = np.quantile(wrong, [0.5 - 0.5 * COVERAGE, 0.5, 0.5 + 0.5 * COVERAGE], axis=0)
    random = 0.5 * (high - low) / COVERAGE_FACTOR
    # Uncertainty by the footprints' size and, without a known form, by the width of the quadratics, the smoothing's
    # correction (at a ridge sqrt(2) times as much remains after a Gaussian kernel), and a second one.
    again: list[dict[str, Any]] = [{"share": 1 - field.footprint_std}] + [{"steps": 0}, {"steps": 2}] * is_rough
    resolved = np.array([field.figures(field.depths(heights, **each), edge, deepest, between) - seen for each in again])
    if wide_depth is not None:
        changes = wide_depth - seen[0], field.std_of_tips(depths, deepest)
        resolved = np.vstack([resolved, *([each, 0, 0, 0, 0] for each in changes)])
        # This model has the noise already. Its bias increases with the variance at a single summit, and with the
        # standard deviation in level ground: between 1 and `BIAS_FACTOR` times the increase by the same noise again.
        # Scatter that steep ground adds to it is a misfit of the quadratics, which makes no place deeper.
        smoothed = field.measure(own_heights, edge) - seen
        bias = smoothed + 0.5 * (1 + BIAS_FACTOR) / more * (bias - smoothed)
        # The largest of many similar depths scatters less than one, and the noise adds to their number.
        random[0] = max(random[0], by_noise[deepest])
    tail = field.measure_tail(heights, noise, deepest)
    plain = np.maximum(seen - bias - np.array([tail, 0, 0, 0, 0]), 0)
    without_bias = np.hypot(random, np.linalg.norm(resolved, axis=0))
    # A tail may reach beyond the surroundings: it is corrected by as much as it is uncertain.
    without_bias[0] = np.hypot(without_bias[0], tail)
    random = np.hypot(without_bias, BIAS_STD * bias)
    reason = field.find_reason(surface, depths, edge, deepest)
    if reason:
        # Between few points, or beside them, the surface is unknown: no bound is beyond the deepest point.
        above = (heights - field.design @ (field.plane @ heights) - COVERAGE_FACTOR * noise)[inside]
        random[0] = max(random[0], (plain[0] - float(above.max())) / COVERAGE_FACTOR)

    def changed(pattern: np.ndarray) -> np.ndarray:
        """Return the change of all figures by a pattern of height errors."""
        return field.figures(depths + field.depths(pattern), edge, deepest, between) - seen

    common = here.by_patterns(changed)
    shared = [None] * len(seen) if common is None else common.tolist()
    length, width = plain[1], plain[2]
    kind = FeatureKind.PROTRUSION
    if sign < 0:
        # Joined pits are pits: the deepest hollow counts, whose contour is three half-depth radii long.
        least = min(length, width, 3 * _Rule.half_depth * local)
        kind = FeatureKind.DENT if least >= DENT_SHARE * diameter_mm else FeatureKind.PIT
    names = ("height" if sign > 0 else "depth", "length", "width", "area", *(("lost area",) if sign < 0 else ()))
    values = [plain_value(kind, name, plain[k], random[k], shared[k], least=0.0) for k, name in enumerate(names)]
    # All of the bias counts here: an indication by noise alone consists of it.
    for k, name in enumerate(names[:3]):
        widest = plain_value(kind, name, plain[k], np.hypot(without_bias[k], bias[k]), shared[k], least=0.0)
        if widest.low <= 0:
            raise NotSignificantError(f"it is not significant relative to its surroundings: {widest.text()}")
    values.insert(1, plain_value(kind, "edge depth", edge, 0.0, None if common is None else 0.0))
    if wall_mm is not None and sign < 0:
        values.append(plain_value(kind, "remaining wall", wall_mm - plain[0], random[0], shared[0]))
    extent = np.array([length, width, depth])
    beneath = 0.0
    if beneath_mm is not None:
        # On a slope the deepest place of both surfaces together is not that of the blemish.
        beneath = field.find_total(heights, sign * beneath_mm[field.near]) - float(seen[0])
    if reason:
        values = [value if value.name == "edge depth" else value.as_bound() for value in values]
    std_of_drop = float(np.sqrt(2) * np.median(by_noise[field.region]))
    return Blemish(
        kind,
        tuple(values),
        field.grid[deepest],
        extent,
        indication.points,
        field.trace_outline(depths, edge, deepest),
        field.grid[_find_hollows(depths, field.region & (depths > edge), field.shape, edge, std_of_drop)],
        measure_spacing(surface.places[field.near], np.flatnonzero(inside)),
        reason,
        beneath,
    )


def _choose_field(
    surface: UnrolledSurface, search: BlemishSearch, indication: Indication
) -> tuple[_Field, float, float | None]:
    """Return the field of an indication, the radius of its deepest hollow, and None for the form of a bell.

    The deepest hollow of a gouge or an area of corrosion is far smaller than these. Rough ground has narrow quadratics;
    the depth by those of its size is returned.
    """
    field = _Field.about(surface, search, indication)
    heights = float(np.sign(indication.height_mm)) * surface.heights[field.near]
    local = field.hollow_radius(heights, indication.noise_mm)
    field = _Field.about(surface, search, indication, local_mm=local)
    depths, noise = field.depths(heights), field.noise_of_means(indication.noise_mm)
    deepest, between = field.find_deepest(heights)
    depth = float(depths[deepest]) + between
    edge = max(SEARCH_RULE.edge_share * depth, SEARCH_RULE.edge_std * float(np.median(noise[field.region])))
    seen = field.figures(depths, edge, deepest)
    if local < 0.5 * _Rule.compact * float(np.max(seen[1:3])):
        return field, local, depth
    bells = [_Bell.resembling(seen, edge, field.grid[deepest], indication.radius_mm, p) for p in _Rule.exponents]
    off = min(np.mean(np.square(depths - bell.depths_at(field.grid))[field.region]) for bell in bells)
    # A correction increases the variance of the noise, by up to four.
    if off < (_Rule.off_bell * depth) ** 2 + 4 * np.mean(np.square(noise[field.region])):
        return field, local, None
    narrow = _Rule.narrow * search.smallest_mm / _Rule.bandwidth
    return _Field.about(surface, search, indication, local_mm=narrow), local, depth


@dataclass(frozen=True, eq=False)
class _Bell:
    """Blemish of depth (1 - t^2)^p and elliptic outline, with half axes (2,) about a middle (2,), mm."""

    middle: np.ndarray
    half: np.ndarray
    depth: float
    exponent: int

    @classmethod
    def resembling(cls, seen: np.ndarray, edge: float, middle: np.ndarray, radius: float, exponent: int) -> _Bell:
        """Return a bell of the measured figures at an edge, or NotSignificantError; ``radius`` replaces zero sizes."""
        if seen[0] <= 0:
            raise NotSignificantError("it does not depart from its surroundings in this direction")
        rim = float(np.sqrt(1 - min(edge / seen[0], 0.99) ** (1 / exponent)))
        return cls(middle, np.where(seen[1:3] > 0, 0.5 * seen[1:3] / rim, radius), float(seen[0]), exponent)

    def depths_at(self, places: np.ndarray) -> np.ndarray:
        """Return depths (N,) at places (N, 2)."""
        t2 = np.sum(np.square((places - self.middle) / self.half), axis=1)
        return self.depth * np.maximum(1 - t2, 0) ** self.exponent

    def figures(self, edge: float) -> np.ndarray:
        """Return the depth, and length, width, area and lost area within the contour at the edge depth."""
        rim = float(np.sqrt(1 - min(edge / self.depth, 1.0) ** (1 / self.exponent)))
        t = np.linspace(0, rim, 101)
        lost = 2 * self.half[0] * self.depth * float(np.trapezoid((1 - t * t) ** self.exponent, t))
        length, width = 2 * self.half * rim
        return np.array([self.depth, length, width, 0.25 * np.pi * length * width, lost])


@dataclass(frozen=True, eq=False)
class _Field:
    """Depths on a grid of G places, as linear functions of the heights of n points near a blemish."""

    near: np.ndarray  # (n,) int; points of the blemish, then the undamaged points around it
    # (n, 2); places of these points and their footprints, mm.
    places: np.ndarray
    size: np.ndarray
    grid: np.ndarray  # (G, 2); places of the grid, mm
    shape: tuple[int, int]  # shape of the grid
    cell: float  # side of a cell, mm
    smooth: sparse.csr_array  # (G, n) sparse; local quadratics
    # (n, 3) and (3, n); terms of the undamaged plane, and their least-squares rows.
    design: np.ndarray
    plane: np.ndarray
    outer: np.ndarray  # (3, n); these rows by the outer half of the surroundings, minus those by all
    # (n, G) sparse; heights that points with and without their footprint measure for given depths on the grid.
    seen: sparse.csr_array
    sharp: sparse.csr_array
    footprint_std: float  # relative standard uncertainty of the squared footprints
    bandwidth: float  # radius of the quadratics, mm
    region: np.ndarray  # (G,) bool; cells of the blemish
    gap_mm: float  # distance from all points, from which a place is not seen

    @classmethod
    def about(
        cls, surface: UnrolledSurface, search: BlemishSearch, indication: Indication, *, local_mm: float = np.inf
    ) -> _Field:
        """Set up the grid and its operators around an indication; ``local_mm`` is the radius of its deepest hollow."""
        members = surface.places[indication.points]
        low, high = members.min(axis=0), members.max(axis=0)
        radius = 0.25 * float(np.sum(high - low))
        reach = max(_Rule.ring * radius, 3 * search.smallest_mm)
        around = surface.points_between(low - reach, high + reach)
        around = around[search.undamaged[around]]
        distance = KDTree(members).query(surface.places[around])[0]
        around, distance = around[distance <= reach], distance[distance <= reach]
        if len(around) < _Rule.fewest_points:
            raise EvaluationError(f"{len(around)} undamaged points surround it; {_Rule.fewest_points} are needed")
        near = np.concatenate([indication.points, around])
        middle = 0.5 * (low + high)
        places, heights = surface.places[near] - middle, surface.heights[near]
        ring = np.arange(len(near)) >= len(indication.points)
        dense = len(indication.points) / max(float(np.prod(high - low)), 1e-9)
        # A noisy radius of the only hollow would add noise.
        radius = local_mm if local_mm < _Rule.single * radius else radius
        bandwidth = min(_Rule.bandwidth * radius, float(np.sqrt(_Rule.points / np.pi / dense)))
        bandwidth = max(bandwidth, search.smallest_mm)
        cell = min(float(np.max(high - low)) / _Rule.cells, 0.5 * bandwidth)
        cell = max(cell, float(np.sqrt(np.prod(high - low + bandwidth) / _Rule.most_cells)))
        sides = [np.arange(a - cell, b + 2 * cell, cell) for a, b in zip(low - middle, high - middle, strict=True)]
        shape = len(sides[0]), len(sides[1])
        grid = np.stack(np.meshgrid(*sides, indexing="ij"), axis=-1).reshape(-1, 2)
        smooth = _make_quadratic_rows(grid, places, KDTree(places), bandwidth)
        # Beyond a border of the points quadratics would extrapolate.
        widest = float(np.max(measure_spacing(surface.places[near], np.flatnonzero(~ring))))
        region = KDTree(places[~ring]).query(grid)[0] < min(bandwidth, max(search.smallest_mm, widest))
        size = surface.footprint_mm[near]
        sharp = seen = _interpolate((places - grid[0]) / cell, shape)
        if np.any(size > 0):
            parts = [weight * _interpolate((places + node * size - grid[0]) / cell, shape) for node, weight in _NODES]
            seen = sparse.csr_array(sum(parts[1:], parts[0]))
        design = np.column_stack([np.ones(len(places)), places])
        plane, outer = fit_biweight(design, heights, ring)[0], np.zeros((3, len(near)))
        far = np.append(np.zeros(len(members), bool), distance > 0.5 * reach)
        if np.count_nonzero(far) >= _Rule.fewest_points:
            outer = fit_biweight(design, heights, far)[0] - plane
        known = surface.places[near], size, grid + middle, shape, cell
        gap = max(search.gap_mm, widest)
        return cls(
            near, *known, smooth, design, plane, outer, seen, sharp, surface.footprint_std, bandwidth, region, gap
        )

    def depths(self, heights: np.ndarray, *, steps: int = 1, share: float = 1.0) -> np.ndarray:
        """Return heights (G,) above the undamaged surface for point heights (n,).

        Smoothing is corrected ``steps`` times. ``share`` scales the footprints' part in this correction.
        """
        left = heights - self.design @ (self.plane @ heights)
        first = self.smooth @ left
        depths = first
        for _ in range(steps):
            there = self.seen @ depths
            if share != 1.0:
                there = share * there + (1 - share) * (self.sharp @ depths)
            depths = depths + self.smooth @ (left - there)
        return depths

    def measure_tail(self, heights: np.ndarray, noise: np.ndarray, cell: int) -> float:
        """Return the change of the undamaged surface at a cell by its outer surroundings alone, beyond noise (n,)."""
        row = (self.smooth[[cell]] @ self.design).ravel() @ self.outer
        change = float(row @ heights)
        return float(np.sign(change)) * float(np.sqrt(max(change**2 - float(np.square(row * noise).sum()), 0.0)))

    def find_total(self, heights: np.ndarray, beneath: np.ndarray) -> float:
        """Return the largest depth of the blemish and a smooth surface ``beneath`` (n,) together."""
        base = self.smooth @ beneath
        top, between = self.find_deepest(heights, base)
        return float(self.depths(heights)[top] + base[top]) + between

    def find_deepest(self, heights: np.ndarray, base: np.ndarray | float = 0.0) -> tuple[int, float]:
        """Return the deepest cell of the smooth surface, and the interpolated depth minus the depth of this cell.

        The maximum of the corrected surface would be biased by its larger noise. Depths ``base`` (G,) are added.
        """
        smooth = self.depths(heights, steps=0) + base
        top = int(np.argmax(np.where(self.region, smooth, -np.inf)))
        return top, self.interpolate_depth(smooth, top) - float(smooth[top])

    def hollow_radius(self, heights: np.ndarray, noise_mm: float) -> float:
        """Return the radius of the deepest hollow, from its deepest place to depths significantly below half of it."""
        smooth = self.depths(heights, steps=0)
        top = int(np.argmax(np.where(self.region, smooth, -np.inf)))
        distance = np.hypot(*(self.grid - self.grid[top]).T)
        below = smooth < 0.5 * smooth[top] - SEARCH_RULE.edge_std * self.noise_of_means(noise_mm)
        return float(np.min(distance, where=below, initial=float(distance.max()))) / _Rule.half_depth

    def find_reason(self, surface: UnrolledSurface, depths: np.ndarray, edge: float, deepest: int) -> str | None:
        """Return why a blemish is not seen whole (places in it or beside it have no points) or not sized, or None."""
        labelled: Any = ndimage.label((self.region & (depths > edge)).reshape(self.shape), np.ones((3, 3)))
        labels = labelled[0].ravel()
        within = np.union1d(np.flatnonzero((labels == labels[deepest]) & (labels > 0)), [deepest])
        turns = np.arange(8) * np.pi / 4
        around = _Rule.beyond * self.gap_mm * np.vstack([[0.0, 0.0], np.column_stack([np.cos(turns), np.sin(turns)])])
        probes = (self.grid[within, None] + around).reshape(-1, 2)
        near = surface.points_between(probes.min(axis=0) - 2 * self.gap_mm, probes.max(axis=0) + 2 * self.gap_mm)
        if np.any(KDTree(surface.places[near]).query(probes)[0] > self.gap_mm):
            return f"not seen whole: the points end beside it, or have a gap of {2 * self.gap_mm:.2g} mm or more in it"
        showing = KDTree(self.grid[within]).query(surface.places[near])[0] < self.cell
        if np.count_nonzero(showing) < SEARCH_RULE.points_in_smallest:
            return f"not sized: {np.count_nonzero(showing)} points show it; {SEARCH_RULE.points_in_smallest} are needed"
        return None

    def std_of_tips(self, depths: np.ndarray, deepest: int) -> float:
        """Return the standard uncertainty of the depth by the unknown form of the deepest place.

        It lies between a cone and a level disc with a kink at its rim, which are as deep as the surface there and a
        bandwidth away (rectangular distribution, GUM, 4.3.7).
        """
        distance = np.hypot(*(self.grid - self.grid[deepest]).T)
        around = self.region & (np.abs(distance - self.bandwidth) < 0.5 * self.cell)
        drop = depths[deepest] - float(np.mean(depths[around])) if around.any() else 0.0
        r = np.minimum(np.hypot(*(self.places - self.grid[deepest]).T) / self.bandwidth, 1.0)
        # The difference of both forms: the depth is linear in the heights.
        return abs(float(self.depths(drop * (r - np.maximum(2 * r - 1, 0)))[deepest])) / np.sqrt(12)

    def noise_of_means(self, noise_mm: float) -> np.ndarray:
        """Return the standard deviations (G,) of the smooth surface by the noise of independent points."""
        return noise_mm * np.sqrt(np.asarray(self.smooth.power(2).sum(axis=1)).ravel())

    def measure(self, heights: np.ndarray, edge: float) -> np.ndarray:
        """Return the figures for point heights (n,), at their own deepest place."""
        top, between = self.find_deepest(heights)
        return self.figures(self.depths(heights), edge, top, between)

    def scatter_ratio(self, heights: np.ndarray, moves: list[np.ndarray], inside: np.ndarray) -> float:
        """Return the ratio of residual scatter ``inside`` (n,) the blemish to that around it; at least 1.

        A stripe scatters more on the slopes of a blemish. Both scatters are divided by those of the noise ``moves``,
        because the fit absorbs a part of the noise.
        """

        def squares(each: np.ndarray) -> np.ndarray:
            left = each - self.design @ (self.plane @ each) - self.seen @ self.depths(each)
            return np.array([np.mean(np.square(left[part])) for part in (inside, ~inside)])

        within, around = squares(heights) / np.maximum(np.mean([squares(each) for each in moves], axis=0), 1e-300)
        return max(1.0, float(np.sqrt(within / max(around, 1e-300))))

    def observe(self, bell: _Bell, shift: np.ndarray) -> np.ndarray:
        """Return the heights (n,) that the points with their footprints would measure on a shifted bell."""
        if not np.any(self.size > 0):
            return bell.depths_at(self.places - shift)
        return sum(
            (weight * bell.depths_at(self.places - shift + node * self.size) for node, weight in _NODES), np.zeros(1)
        )

    def interpolate_depth(self, depths: np.ndarray, top: int) -> float:
        """Return the largest depth between cells, from parabolas through the deepest cell and its neighbours."""
        field, at = depths.reshape(self.shape), np.array(np.unravel_index(top, self.shape))
        depth = float(field[tuple(at)])
        for step in max(1, round(0.5 * self.bandwidth / self.cell)) * np.eye(2, dtype=int):
            if np.all(at - step >= 0) and np.all(at + step < self.shape):
                before, after = float(field[tuple(at - step)]), float(field[tuple(at + step)])
                bend = before + after - 2 * float(field[tuple(at)])
                if bend < 0 and abs(after - before) <= -bend:
                    depth -= (after - before) ** 2 / (8 * bend)
        return depth

    @cached_property
    def fine_region(self) -> np.ndarray:
        """Cells of the blemish on the finer grid for contours."""
        size = [_Rule.subdivision * (n - 1) + 1 for n in self.shape]
        return np.asarray(ndimage.zoom(self.region.reshape(self.shape), np.divide(size, self.shape), order=0))

    def _refine_contour(self, depths: np.ndarray, edge: float, deepest: int) -> tuple[np.ndarray, np.ndarray, float]:
        """Return depths on the finer grid, a mask of those in and beside the contour about ``deepest``, and the cell.

        The mask is empty if the deepest cell is not within the edge.
        """
        size = [_Rule.subdivision * (n - 1) + 1 for n in self.shape]
        top = tuple(_Rule.subdivision * k for k in np.unravel_index(deepest, self.shape))
        fine = np.asarray(ndimage.zoom(depths.reshape(self.shape), np.divide(size, self.shape), order=3))
        labelled: Any = ndimage.label(self.fine_region & (fine > edge), structure=np.ones((3, 3)))
        blemish = (labelled[0] == labelled[0][top]) & (labelled[0][top] > 0)
        return fine, ndimage.binary_dilation(blemish, structure=np.ones((3, 3))), self.cell / _Rule.subdivision

    def figures(self, depths: np.ndarray, edge: float, deepest: int, between: float = 0.0) -> np.ndarray:
        """Return the depth of cell ``deepest`` and ``between`` it, length, width, area and lost area within an edge."""
        fine, grown, cell = self._refine_contour(depths, edge, deepest)
        depth = float(depths[deepest]) + between
        if not grown.any():
            return np.array([depth, 0.0, 0.0, 0.0, 0.0])
        field = np.where(grown, fine, -np.inf)
        length, lost = _measure_section(field.max(axis=1), edge, cell)
        width, _ = _measure_section(field.max(axis=0), edge, cell)
        steep = np.maximum(np.hypot(*np.gradient(fine, cell)) * cell, 1e-9)
        share = np.clip((np.where(grown, fine, -1e9) - edge) / steep + 0.5, 0, 1)
        return np.array([depth, length, width, float(share.sum()) * cell**2, lost])

    def trace_outline(self, depths: np.ndarray, edge: float, deepest: int) -> np.ndarray:
        """Return the longest closed contour (L, 2) at an edge about cell ``deepest``, mm; empty if there is none."""
        from skimage.measure import find_contours

        fine, grown, cell = self._refine_contour(depths, edge, deepest)
        # Beside the grid and the mask the depth is just below the edge.
        field = np.pad(np.where(grown, fine, np.minimum(fine, 0.0)), 1, constant_values=min(0.0, edge))
        found = find_contours(field, edge) if grown.any() else []
        return self.grid[0] + cell * (max(found, key=len) - 1) if found else np.zeros((0, 2))


def _find_hollows(depths: np.ndarray, inside: np.ndarray, shape: tuple[int, int], edge: float, std: float) -> list[int]:
    """Return the deepest cells of neighbours in a blemish, the deepest first; none for a single hollow.

    ``depths`` (G,) are those of a grid, and ``inside`` (G,) is the mask of the blemish's cells below the edge.

    Cells are joined from the deepest on. A hollow is separate if it is clearly deeper than the saddle to a deeper
    one: by a fraction, and by some standard deviations ``std`` of such a difference.
    """
    top, saddles, kept = np.full(len(depths), -1), dict[int, float](), list[int]()

    def root(cell: int) -> int:
        while top[cell] != cell:
            cell = top[cell]
        return cell

    for cell in sorted(np.flatnonzero(inside), key=lambda each: -depths[each]):
        row, column = divmod(int(cell), shape[1])
        beside = {
            root(i * shape[1] + j)
            for i in range(max(row - 1, 0), min(row + 2, shape[0]))
            for j in range(max(column - 1, 0), min(column + 2, shape[1]))
            if top[i * shape[1] + j] >= 0
        }
        best = max(beside, key=lambda each: depths[each], default=cell)
        top[cell] = best
        for other in beside - {best}:
            top[other] = best
            saddles[other] = float(depths[cell])
    # Hollows that no saddle joins are separated by the edge.
    for other in saddles | dict.fromkeys(np.flatnonzero(top == np.arange(len(top))).tolist(), 0.0):
        drop = depths[other] - saddles.get(other, edge)
        if drop > max((1 - _Rule.saddle) * depths[other], _Rule.saddle_std * std):
            kept.append(other)
    return sorted(kept, key=lambda each: -depths[each]) if len(kept) > 1 else []


def _measure_section(profile: np.ndarray, edge: float, cell: float) -> tuple[float, float]:
    """Return the length over which a profile exceeds an edge, with interpolated ends, and its area there."""
    above = np.flatnonzero(profile > edge)
    if not len(above):
        return 0.0, 0.0
    first, last = int(above[0]), int(above[-1])

    def part(inner: int, outer: int) -> float:
        if not 0 <= outer < len(profile) or not np.isfinite(profile[outer]):
            return 0.5
        return float((profile[inner] - edge) / max(profile[inner] - profile[outer], 1e-12))

    ends = part(first, first - 1), part(last, last + 1)
    length = cell * (last - first + sum(ends))
    body = float(np.trapezoid(np.maximum(profile[first : last + 1], 0), dx=cell))
    rims = sum(cell * end * 0.5 * (edge + float(profile[k])) for end, k in zip(ends, (first, last), strict=True))
    return length, body + rims


def _interpolate(places: np.ndarray, shape: tuple[int, int]) -> sparse.csr_array:
    """Return rows (n, G) that interpolate a grid at places (n, 2) in cells, and are zero beyond its border."""
    (first, along), (second, around) = (cubic_weights(place, n) for place, n in zip(places.T, shape, strict=True))
    columns = (first[:, :, None] * shape[1] + second[:, None, :]).ravel()
    values, rows = (along[:, :, None] * around[:, None, :]).ravel(), np.repeat(np.arange(len(places)), 16)
    return sparse.csr_array((values, (rows, columns)), shape=(len(places), shape[0] * shape[1]))


def _make_quadratic_rows(grid: np.ndarray, places: np.ndarray, tree: KDTree, bandwidth: float) -> sparse.csr_array:
    """Return rows (G, n) that give local quadratics at the grid's places as products with heights.

    Weights are Epanechnikov's. A place with fewer than nine points in the window takes the mean of the nearest three.
    """
    close = tree.query_ball_point(grid, bandwidth)
    number = np.array([len(each) for each in close])
    many = np.flatnonzero(number >= 9)
    points = np.concatenate([np.zeros(0, np.intp), *(np.array(close[k], np.intp) for k in many)])
    window, starts = np.repeat(np.arange(len(many)), number[many]), np.cumsum(number[many]) - number[many]
    u, v = ((places[points] - grid[many[window]]) / bandwidth).T
    weight, terms = np.maximum(1 - u * u - v * v, 0), (np.ones(len(u)), u, v, u * u, u * v, v * v)
    normal = np.array([[np.add.reduceat(weight * a * b, starts) for a in terms] for b in terms]).transpose(2, 0, 1)
    regular = np.linalg.cond(normal) < 1e8
    normal[~regular] = np.eye(6)
    first = np.linalg.solve(normal, np.eye(6)[:, :1])[window, :, 0].T
    values = weight * sum(a * b for a, b in zip(terms, first, strict=True))
    # Quadratics extrapolate badly beside the points.
    regular &= np.add.reduceat(values * values, starts) < _Rule.most_variance / number[many]
    kept, others = regular[window], np.setdiff1d(np.arange(len(grid)), many[regular])
    nearest: Any = tree.query(grid[others], k=3)
    rows = np.concatenate([many[window[kept]], np.repeat(others, 3)])
    parts = np.append(values[kept], np.full(3 * len(others), 1 / 3)), (rows, np.append(points[kept], nearest[1]))
    return sparse.csr_array(parts, shape=(len(grid), len(places)))
