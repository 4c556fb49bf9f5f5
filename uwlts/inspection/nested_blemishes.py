"""Blemishes within and beside a large one, whose own surface is estimated and taken out of the heights.

A search for departures from the undamaged surface joins a pit with the dent around it, and finds the shallow rest of a
dent again. Relative to the dent's own surface, a pit in it is a departure like any other, and the rest is none. This
surface consists of local quadratics with Tukey's biweight, which gives a pit no weight.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy import ndimage
from scipy.interpolate import RectBivariateSpline
from scipy.spatial import KDTree

from uwlts.errors import EvaluationError
from uwlts.fitting.least_squares import MAD_TO_STD, biweight, thin_evenly
from uwlts.fitting.propagation import PointErrors
from uwlts.inspection.bell_maps import SEARCH_RULE, UnrolledSurface
from uwlts.inspection.blemish_search import BlemishSearch, Indication, search_blemishes
from uwlts.inspection.blemishes import Blemish, NotSignificantError, measure_blemish
from uwlts.inspection.features import FeatureKind, plain_value


class _Rule:
    """Numbers of the surface of a large blemish."""

    bandwidth: float = 0.35
    """Radius of a local quadratic, in radii of the large blemish. Blemishes of up to half this radius cover a
    quarter of its points, which the biweight tolerates."""
    window: float = 1.2
    """Width of the surroundings, in radii of the large blemish, to where a bell that it may be part of has ended."""
    nodes: int = 2  # nodes of the surface per bandwidth
    most_points: int = 400  # most points of a local quadratic; more of them would not change it
    fewest_points: int = 12  # fewest points of a local quadratic: twice its terms
    reweighted: int = 15  # reweighted fits of a quadratic; the corrections refine them further
    corrections: int = 2
    """Corrections of the surface for what was smoothed away: one leaves 0.04 mm at the bottom of a bell 7 mm deep."""
    rough: float = 1.5
    """Scatter about the smooth surface where it is deep, divided by that beside it, above which the ground is rough: a
    gouge or an area of corrosion is one finding. Of docs/studies/inspection_verdicts.py, seeds 0 to 6 and 600 to 609,
    14 dents have 0.9 to 1.3, and gouges with invented findings 1.75 and more."""
    significant: float = 3.0  # least height of an indication, in errors of the smooth surface
    worst: float = 0.99  # quantile of these errors: edges cover a few percent of the window, other pits less than one


_SMALLEST = 1e-12  # lower bound of a scatter, mm, so that rounding of exact heights produces no outliers


@dataclass(frozen=True, eq=False)
class LargeBlemish:
    """Large blemish with those inside and beside it."""

    indication: Indication  # the large one, with the points of those inside it
    chosen: np.ndarray  # (n,) int; points of the window
    surface: UnrolledSurface  # window with heights relative to the large blemish's surface
    # (n,); height of that surface above the undamaged one, and its standard uncertainty by the smoothing.
    height_mm: np.ndarray
    std_mm: np.ndarray
    search: BlemishSearch  # search in the window
    largest_mm: float  # largest radius of this search

    def explains(self, other: Indication) -> bool:
        """Return True for the large indication itself, its rim, and what the second search covers.

        A rim departs from its surroundings in the other direction, but not from the undamaged surface.
        """
        if other is self.indication:
            return True
        inside = np.isin(self.chosen, other.points)
        if np.count_nonzero(inside) < 0.5 * len(other.points):
            return False
        height = float(np.mean((self.surface.heights + self.height_mm)[inside]))
        is_rim = other.height_mm * self.indication.height_mm < 0 and height / other.height_mm < SEARCH_RULE.edge_share
        return is_rim or other.radius_mm <= self.largest_mm

    def parts_beside(self, others: Sequence[Indication]) -> list[Indication]:
        """Return the indications of the window, without those at larger ones of the first search, ``others``."""
        kept = [each.points for each in others if not self.explains(each)]
        taken = np.concatenate([np.zeros(0, int), *kept])
        return [each for each in self.search.indications if not np.isin(self.chosen[each.points], taken).any()]

    def is_form(self, indication: Indication) -> bool:
        """Return whether an indication of the window belongs to the form of the large one.

        It is not significant if its height contains the errors of a smooth surface elsewhere: those at sharp edges.
        """
        places = self.surface.places[indication.points]
        middle = places.mean(axis=0)
        reach = float(np.max(np.hypot(*(places - middle).T)))
        elsewhere = np.hypot(*(self.surface.places - middle).T) > reach + 2 * self.largest_mm
        error = float(np.quantile(self.std_mm[elsewhere], _Rule.worst)) if elsewhere.any() else np.inf
        significant = abs(indication.height_mm) * self.search.threshold / indication.z
        return abs(indication.height_mm) < significant + _Rule.significant * error

    def without(self, surface: UnrolledSurface, points: np.ndarray) -> UnrolledSurface:
        """Return the whole surface with the heights of the large one at the given points (N,) bool."""
        inside, bare = points[self.chosen], surface.heights.copy()
        bare[self.chosen[inside]] = self.height_mm[inside]
        return replace(surface, heights=bare)

    def measure(
        self, indication: Indication, errors: PointErrors, *, diameter_mm: float, wall_mm: float | None
    ) -> Blemish:
        """Measure an indication of the window; a pit in a dent also has its total depth.

        ``errors`` are those of all points. EvaluationError as `measure_blemish`; NotSignificantError also for a part
        that is not sized, in a hollow that is deeper.
        """
        sizes = {"diameter_mm": diameter_mm, "wall_mm": wall_mm, "beneath_mm": self.height_mm}
        found = measure_blemish(self.surface, self.search, indication, errors[self.chosen], **sizes)
        points, depth = self.chosen[indication.points], found.values[0]
        random = float(np.hypot(depth.random, float(self.std_mm[indication.points].max())))
        values = [plain_value(found.kind, depth.name, depth.value, random, depth.systematic, least=0.0)]
        if values[0].low <= 0:
            raise NotSignificantError(f"it is not significant relative to the surface below: {values[0].text()}")
        deepest, total = float(np.abs(self.height_mm).max()), depth.value + found.beneath_mm
        in_hollow = self.indication.height_mm < 0 and found.beneath_mm > SEARCH_RULE.edge_share * deepest
        if found.reason is not None and in_hollow and total < deepest:
            raise NotSignificantError(f"{found.reason}, and the hollow around it is deeper")
        if found.kind != FeatureKind.PROTRUSION and in_hollow:
            # The sum of both depths does not depend on the surface between them.
            values.append(plain_value(found.kind, "total depth", total, depth.random, depth.systematic))
        if found.reason is not None:
            values = [value.as_bound() for value in values]
        return replace(found, values=(*values, *found.values[1:]), points=points)


def search_within(surface: UnrolledSurface, search: BlemishSearch, large: Indication) -> LargeBlemish | None:
    """Search for blemishes within and beside a large one; None if it has no room for them, or no smooth ground.

    ``surface`` and ``search`` are those of the whole pipe, cut open far from the large blemish.
    """
    places = surface.places[large.points]
    low, high = places.min(axis=0), places.max(axis=0)
    radius = 0.25 * float(np.sum(high - low))
    bandwidth = _Rule.bandwidth * radius
    if 0.5 * bandwidth < search.smallest_mm:
        return None
    low, high = low - _Rule.window * radius, high + _Rule.window * radius
    chosen = surface.points_between(low, high)
    chosen = chosen[~search.outliers[chosen]]
    names = "places", "heights", "std", "footprint_mm"
    window = replace(surface, **{name: getattr(surface, name)[chosen] for name in names})
    # Twicing: the residuals contain what was smoothed away, and the size of the last correction is its uncertainty.
    smooth = correction = _estimate_surface(window, bandwidth)
    for _ in range(_Rule.corrections):
        correction = _estimate_surface(replace(window, heights=window.heights - smooth), bandwidth)
        smooth = smooth + correction
    relative = replace(window, heights=window.heights - smooth)
    deep = np.isin(chosen, large.points) & (np.abs(smooth) > 0.5 * float(np.abs(smooth).max()))
    rough, usual = (np.median(np.abs(relative.heights[part])) for part in (deep, search.undamaged[chosen]))
    if not deep.any() or rough > _Rule.rough * usual:
        return None
    share = len(chosen) / np.count_nonzero(~search.outliers)
    try:
        found = search_blemishes(relative, false_alarm=share * search.false_alarm, largest_mm=0.5 * bandwidth)
    except EvaluationError:
        return None
    # Points that the search of the whole surface calls undamaged depart from the smooth surface only.
    real = [each for each in found.indications if np.mean(search.undamaged[chosen[each.points]]) < 0.5]
    found = replace(found, indications=tuple(real))
    return LargeBlemish(large, chosen, relative, smooth, np.abs(correction), found, 0.5 * bandwidth)


def _estimate_surface(window: UnrolledSurface, bandwidth: float) -> np.ndarray:
    """Return the heights (n,) of a surface of local quadratics at the points of a window."""
    tree, places = KDTree(window.places), window.places
    low, high = places.min(axis=0), places.max(axis=0)
    counts: Any = np.maximum(np.ceil((high - low) / bandwidth * _Rule.nodes).astype(int) + 1, 4)
    sides = [np.linspace(a, b, count) for a, b, count in zip(low, high, counts, strict=True)]
    nodes = np.stack(np.meshgrid(*sides, indexing="ij"), axis=-1).reshape(-1, 2)
    near = [thin_evenly(np.array(each, int), _Rule.most_points) for each in tree.query_ball_point(nodes, bandwidth)]
    known = np.array([len(each) >= _Rule.fewest_points for each in near])
    if not known.any():
        return np.zeros(len(places))
    values = np.full(len(nodes), np.nan)
    values[known] = _fit_quadratics(
        window, nodes[known], [each for each, is_known in zip(near, known, strict=True) if is_known], bandwidth
    )
    unknown = ~known.reshape(counts)
    nearest: Any = ndimage.distance_transform_edt(unknown, return_distances=False, return_indices=True)
    return RectBivariateSpline(sides[0], sides[1], values.reshape(counts)[tuple(nearest)]).ev(*places.T)


def _fit_quadratics(window: UnrolledSurface, nodes: np.ndarray, near: list[np.ndarray], bandwidth: float) -> np.ndarray:
    """Return the values (m,) at nodes (m, 2) of quadratics through points near them, with Tukey's biweight."""
    number = np.array([len(each) for each in near])
    counted = np.arange(number.max()) < number[:, None]
    index = np.zeros(counted.shape, int)
    index[counted] = np.concatenate(near)
    u, v = np.moveaxis((window.places[index] - nodes[:, None]) / bandwidth, -1, 0)
    design = np.stack([np.ones(u.shape), u, v, u * u, u * v, v * v], axis=-1)
    heights, weights = window.heights[index][..., None], counted.astype(float)
    coefficients = np.zeros((len(nodes), 6, 1))
    for _ in range(_Rule.reweighted):
        loaded = (design * weights[..., None]).transpose(0, 2, 1)
        coefficients = np.linalg.pinv(loaded @ design, hermitian=True) @ (loaded @ heights)
        left = np.abs(heights - design @ coefficients)[..., 0]
        middle = np.sort(np.where(counted, left, np.inf), axis=1)[np.arange(len(nodes)), number // 2]
        weights = counted * biweight(left / np.maximum(MAD_TO_STD * middle, _SMALLEST)[:, None])
    return coefficients[:, 0, 0]
