"""Inspection of a pipe: its form, section by section, with pits, dents and protrusions."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial

import numpy as np
from scipy import ndimage

from uwlts.errors import EvaluationError
from uwlts.fitting.least_squares import robust_std
from uwlts.fitting.local_surface import project_footprint
from uwlts.fitting.propagation import PointErrors
from uwlts.inspection.bell_maps import SEARCH_RULE, UnrolledSurface
from uwlts.inspection.blemish_search import BlemishSearch, Indication, search_blemishes
from uwlts.inspection.blemishes import DENT_SHARE, Blemish, NotSignificantError, measure_blemish
from uwlts.inspection.features import WITHOUT_UNCERTAINTY, Feature, FeatureKind, Inspection, plain_value
from uwlts.inspection.nested_blemishes import LargeBlemish, search_within
from uwlts.inspection.pipe_form import FORM_RULE, LARGEST_OVALITY, PipeForm, pipe_features, refit_pipe
from uwlts.inspection.pipe_welds import PipeWeld, find_welds, measure_weld
from uwlts.inspection.scanned_part import find_straight_pipe
from uwlts.storage.cloud import FOOTPRINT, PointCloud
from uwlts.storage.cloud_files import load_cloud

_OVERLAP = 0.6  # overlap, rad, of both sides of a pipe that is cut open, unless a gap of this size separates them
_BEYOND_CUT = 0.1
"""Largest angle of findings beyond the cut, rad. Farther points only serve as surroundings: on the other side of
the cut the same blemishes are found with more surroundings."""
_SMALLEST_MM, _USUAL_MM = 5.0, (20.0, 5000.0)
"""Smallest diameter that a triangulation sensor could inspect, and usual diameters of pipes."""
_OTHER_UNITS = {"cm": 10.0, "inches": 25.4, "m": 1000.0}
_THICKEST = 5
"""Ratio of diameter to wall below which a pipe is unusual; in ASME B36.10M it is larger from 1 1/2 inches on."""
_OFF_SURFACE = 0.35
"""Largest distance from the form of a point of the pipe's surface, as a fraction of the radius: dents of 15 % of the
diameter, the deepest that codes assess, are 0.3 deep."""
_MOVED = 0.2  # change of the form, in standard deviations of a point, after which the surface is searched again
_FEWEST_POINTS = 500  # fewest points for a search on a pipe's surface


def inspect_pipe(
    cloud: PointCloud | str | os.PathLike[str],
    *,
    wall_mm: float | None = None,
    false_alarm: float = 0.05,
    largest_ovality: float = LARGEST_OVALITY,
) -> Inspection:
    """Measure a pipe's form and find the blemishes of its outer surface.

    The form is a cylinder with out of roundness, bow and taper (`uwlts.inspection.pipe_form`). Local departures from it
    are searched for at all sizes (`uwlts.inspection.blemish_search`) and measured relative to the surface around them
    (`uwlts.inspection.blemishes`).

    Uncertainties are propagated from the covariance of the points, including errors of the calibration common to all
    points. They are never smaller than the scatter of the points implies. For a cloud without covariance they contain
    the scatter only, with a note.

    Parameters
    ----------
    cloud
        Cloud of the object, or its file (.ply, .h5; from other programs .las, .laz, .e57, and text in mm).
    wall_mm
        Thickness of the pipe's undamaged wall, for the remaining wall.
    false_alarm
        Probability of any finding on the whole surface of an undamaged pipe.
    largest_ovality
        Largest ovality divided by the diameter, used if the cloud shows less than half of the circumference: the
        tolerance of the pipe's specification, if it still applies.

    Returns
    -------
    Inspection
        Form of the pipe and its blemishes with their uncertainties, mm.

    Raises
    ------
    CaptureError
        The file cannot be read.
    EvaluationError
        The points do not determine a pipe, or a parameter is out of range.

    Examples
    --------
    >>> found = uwlts.inspect_pipe("pipe.cloud.h5", wall_mm=9.5)
    >>> print("\\n".join(found.lines()))
    """
    cloud = load_cloud(cloud)
    if wall_mm is not None and not 0 < wall_mm < np.inf:
        raise EvaluationError(f"wall_mm is {wall_mm:g}; expected a positive thickness in mm")
    if not 0 < false_alarm < 1:
        raise EvaluationError(f"false_alarm is {false_alarm:g}; expected a probability between 0 and 1")
    if not 0 <= largest_ovality <= 0.2:
        raise EvaluationError(
            f"largest_ovality is {largest_ovality:g}; expected a fraction of the diameter from 0 to 0.2, such as 0.02"
        )
    if len(cloud) < _FEWEST_POINTS:
        raise EvaluationError(f"the cloud has {len(cloud)} points; at least {_FEWEST_POINTS} are needed for a pipe")
    form, left_out, regions = find_straight_pipe(cloud, largest_ovality=largest_ovality)
    of_size = _check_size(2 * form.radius_mm, wall_mm)
    on_pipe = np.abs(form.distance_mm) < _OFF_SURFACE * form.radius_mm
    off = []
    if stray := np.count_nonzero(is_off := ~(on_pipe | left_out)):
        inside, limit = np.count_nonzero(is_off & (form.distance_mm < 0)), _OFF_SURFACE * form.radius_mm
        off.append(
            f"{stray} of {len(cloud)} points are {limit:.2g} mm or more off the pipe ({inside} inside) and are "
            "omitted: a finding beside them is not seen whole"
        )
    chosen = np.flatnonzero(on_pipe & ~left_out)
    welds = find_welds(form, chosen)
    on_weld = np.any([weld.covers for weld in welds], axis=0) if welds else np.zeros(len(cloud), bool)
    chosen = chosen[~on_weld[chosen]]
    search = _search_form(cloud, form, chosen, false_alarm)
    if search.indications or welds:
        # Fit again without the damaged points and the welds, which bias the form.
        damaged = np.ones(len(cloud), bool)
        damaged[chosen[search.undamaged]] = False
        before, form = form.distance_mm[~damaged], refit_pipe(cloud, form, left_out=damaged)
        after = form.distance_mm[~damaged]
        if np.std(after - before) > _MOVED * robust_std(after):
            search = _search_form(cloud, form, chosen, false_alarm)
    features, of_sections = pipe_features(cloud, form)
    of_welds, on_welds = _make_weld_features(cloud, form, welds)
    blemishes = _Blemishes(cloud, form, chosen, search, wall_mm)
    features += [*of_welds, *blemishes.measure_all()]
    deviation = np.full(len(cloud), np.nan)
    deviation[chosen[~search.outliers]] = form.distance_mm[chosen[~search.outliers]]
    notes = *regions, *_note_limits(cloud, form, search), *of_size, *off, *of_sections, *on_welds, *blemishes.notes
    found = Inspection("pipe", tuple(features), deviation, notes)
    return found.consider_cloud(cloud)


def _check_size(diameter_mm: float, wall_mm: float | None) -> list[str]:
    """Return a note if the size of a pipe is unusual; raises EvaluationError if it is impossible."""
    thinnest = max(_SMALLEST_MM, 2 * (wall_mm or 0))
    if diameter_mm < thinnest:
        least = max(_USUAL_MM[0], _THICKEST * (wall_mm or 0))
        likely = [name for name, mm in _OTHER_UNITS.items() if least < mm * diameter_mm < _USUAL_MM[1]]
        wall = "" if wall_mm is None else f" and a wall of {wall_mm:g} mm"
        raise EvaluationError(
            f"the pipe has a diameter of {diameter_mm:.4g} mm{wall}, which is impossible: the coordinates must be in "
            f"mm{', but seem to be in ' if likely else ''}{' or '.join(likely)}"
        )
    if wall_mm is not None and diameter_mm < _THICKEST * wall_mm:
        return [
            f"the wall of {wall_mm:g} mm is unusually thick for a diameter of {diameter_mm:.4g} mm: check the unit of "
            "the coordinates (mm) and the wall"
        ]
    return []


def _search_form(cloud: PointCloud, form: PipeForm, chosen: np.ndarray, false_alarm: float) -> BlemishSearch:
    """Search the pipe, cut open where the surface departs least; both sides overlap unless there is a gap.

    A blemish at the cut would lack surroundings on one side.
    """
    angle = form.angle[chosen]
    sector = (np.mod(angle, 2 * np.pi) / (2 * np.pi) * (FORM_RULE.sectors - 1e-6)).astype(int)
    departs = np.bincount(sector, np.abs(form.distance_mm[chosen]), FORM_RULE.sectors)
    departs = ndimage.convolve1d(departs, np.ones(2 * int(_OVERLAP / (4 * np.pi) * FORM_RULE.sectors) + 1), mode="wrap")
    cut = int(np.argmin(departs))
    angle = np.mod(angle - (cut + 0.5) * 2 * np.pi / FORM_RULE.sectors, 2 * np.pi)
    copied = np.arange(len(chosen))
    if departs[cut] > 0:
        first, last = np.flatnonzero(angle < _OVERLAP), np.flatnonzero(angle > 2 * np.pi - _OVERLAP)
        copied = np.concatenate([copied, first, last])
        angle = np.concatenate([angle, angle[first] + 2 * np.pi, angle[last] - 2 * np.pi])
    errors = PointErrors.along_normals(cloud, chosen, form.frame.normals_at(form.angle[chosen]))[copied]
    surface = _unroll(cloud, form, chosen[copied], angle, errors)
    search = search_blemishes(surface, false_alarm=false_alarm)
    beyond = np.abs(surface.places[:, 1] / form.radius_mm - np.pi) - np.pi
    found = [each for each in search.indications if np.median(beyond[each.points]) <= _BEYOND_CUT]
    # Of copies on both sides of the cut one remains.
    unresolved = {
        int(copied[each.point]): replace(each, point=int(copied[each.point]))
        for each in search.unresolved
        if beyond[each.point] <= _BEYOND_CUT
    }
    search = replace(search, indications=tuple(found), unresolved=tuple(unresolved.values()))
    return _join_copies(search, copied, len(chosen))


def _join_copies(search: BlemishSearch, copied: np.ndarray, count: int) -> BlemishSearch:
    """Return the search result for ``count`` points from the one on their copies (N,); originals come first.

    Indications on both sides of the cut are joined if they have the same sign and share points.
    """
    joined: list[Indication] = []
    for indication in sorted(search.indications, key=lambda each: len(each.points), reverse=True):
        one = replace(indication, points=np.unique(copied[indication.points]))
        for number, other in enumerate(joined):
            # An indication removes its points from the search: only copies are in two of them.
            if one.height_mm * other.height_mm > 0 and np.isin(one.points, other.points, assume_unique=True).any():
                joined[number] = replace(other, points=np.union1d(one.points, other.points))
                break
        else:
            joined.append(one)
    undamaged = search.undamaged[:count].copy()
    for indication in joined:
        undamaged[indication.points] = False
    return replace(
        search,
        indications=tuple(joined),
        outliers=search.outliers[:count],
        undamaged=undamaged,
        level_mm=search.level_mm[:count],
    )


def _unroll(
    cloud: PointCloud, form: PipeForm, chosen: np.ndarray, angle: np.ndarray, errors: PointErrors
) -> UnrolledSurface:
    """Return the surface of the chosen points (M,), unrolled by angles (M,) from any origin."""
    heights = form.distance_mm[chosen]
    spread = max(robust_std(heights - np.median(heights)), 1e-9)
    std = errors.single_mm if np.all(errors.single_mm > 0) else np.full(len(heights), spread)
    places = np.column_stack([form.along_mm[chosen], form.radius_mm * angle])
    footprint, footprint_std = np.zeros(places.shape), 0.0
    if FOOTPRINT in cloud.metadata:
        axis = np.broadcast_to(form.frame.axes[2], (len(chosen), 3))
        tangents = np.stack([axis, np.cross(axis, form.frame.normals_at(form.angle[chosen]))], axis=1)
        footprint, footprint_std = project_footprint(cloud, chosen, tangents)
    return UnrolledSurface(places, heights, std, footprint, footprint_std)


def _make_weld_features(cloud: PointCloud, form: PipeForm, welds: list[PipeWeld]) -> tuple[list[Feature], list[str]]:
    """Return the welds as features, and notes on them."""
    features, notes = [], []
    for weld in welds:
        kind = "girth weld" if weld.is_girth else "seam weld"
        name = f"{kind} {1 + sum(each.name.startswith(kind) for each in features)}"
        wide = f"{np.ptp(weld.across_mm[weld.covers]):.3g} mm"
        notes.append(f"no blemishes are searched for on the {name}, over a width of {wide}: inspect it as a weld")
        try:
            features.append(measure_weld(cloud, form, weld, name))
        except EvaluationError as error:
            notes.append(f"the {kind} is not measured: {error}")
    return features, notes


class _Blemishes:
    """Blemishes of a pipe: the large ones of a search, each with those inside and beside it, and the others.

    ``notes`` name what is omitted.
    """

    def __init__(
        self, cloud: PointCloud, form: PipeForm, chosen: np.ndarray, search: BlemishSearch, wall_mm: float | None
    ):
        self.notes: list[str] = []
        self._cloud, self._form, self._chosen, self._search = cloud, form, chosen, search
        self._sizes = {"diameter_mm": 2 * form.radius_mm, "wall_mm": wall_mm}
        self._errors = PointErrors.along_normals(cloud, chosen, form.frame.normals_at(form.angle[chosen]))
        self._flat = _unroll(cloud, form, chosen, form.angle[chosen], self._errors)
        # Blemish, angle about which its surface is unrolled, and probability of a false alarm.
        self._measured: list[tuple[Blemish, float, float]] = []
        # Kind, points, height, bound and reason of findings that are not sized.
        self._unsized: list[tuple[FeatureKind, np.ndarray, float, float, str]] = []
        self._large: list[LargeBlemish] = []
        for indication in sorted(search.indications, key=lambda each: abs(each.height_mm), reverse=True):
            around, _ = self._unroll_about(indication)
            sides = np.ptp(around.places[indication.points], axis=0)
            if not self._is_explained(indication) and np.min(sides) >= DENT_SHARE * 2 * form.radius_mm:
                whole = search_within(around, search, indication)
                self._large += [] if whole is None else [whole]

    def measure_all(self) -> list[Feature]:
        """Measure all blemishes; return them, the deepest first, and then those that are not sized."""
        self._add_unresolved(self._search, np.arange(len(self._chosen)))
        taken = np.zeros(len(self._chosen), bool)
        for whole in self._large:
            self._measure_large(whole, taken)
        for indication in self._search.indications:
            if not self._is_explained(indication):
                surface, middle = self._unroll_about(indication)
                self._measure(indication, indication.points, middle, partial(measure_blemish, surface, self._search))
        self._measured.sort(key=lambda each: each[0].extent_mm[2], reverse=True)
        numbers = dict.fromkeys(FeatureKind, 0)
        found = [*map(self._make_sized_feature, self._measured), *map(self._make_unsized_feature, self._unsized)]
        features = []
        for feature in found:
            numbers[feature.kind] += 1
            features.append(replace(feature, name=f"{feature.kind} {numbers[feature.kind]}"))
            self.notes += _note_merged(features[-1])
        if self._measured:
            along, around = np.median([blemish.spacing_mm for blemish, *_ in self._measured], axis=0)
            spacing = f"{along:.2g} mm along the pipe, {around:.2g} mm around it, median"
            self.notes.insert(
                0,
                "lengths and widths of findings are known no better than the spacing of profiles and points there "
                f"({spacing}): their intervals include it at both ends",
            )
        return features

    def _unroll_about(self, indication: Indication) -> tuple[UnrolledSurface, float]:
        """Return the surface unrolled about an indication, so that it is not cut, and its angle."""
        middle = float(np.angle(np.mean(np.exp(1j * self._form.angle[self._chosen[indication.points]]))))
        places, circumference = self._flat.places.copy(), 2 * np.pi * self._form.radius_mm
        places[:, 1] -= self._form.radius_mm * middle
        places[:, 1] -= circumference * np.rint(places[:, 1] / circumference)
        return replace(self._flat, places=places), middle

    def _is_explained(self, indication: Indication) -> bool:
        """Return whether an indication is part of a large blemish."""
        return any(whole.explains(indication) for whole in self._large)

    def _measure_large(self, whole: LargeBlemish, taken: np.ndarray) -> None:
        """Measure a large blemish and those inside and beside it, whose points are marked in ``taken`` (N,)."""
        large, (surface, middle) = whole.indication, self._unroll_about(whole.indication)
        parts = whole.parts_beside(self._search.indications)
        formed = [abs(part.height_mm) for part in parts if whole.is_form(part)]
        if formed:
            departs = f"has {len(formed)} departures of up to {max(formed):.2g} mm from a smooth surface, by its form"
            self.notes.append(_note_indication(self._cloud, self._chosen[large.points], large.height_mm, departs))
        for part in parts:
            points = whole.chosen[part.points]
            if not taken[points].any() and not whole.is_form(part):
                taken[points] = self._measure(part, points, middle, whole.measure)
        self._add_unresolved(whole.search, whole.chosen, within=large.points)
        bare = whole.without(surface, taken)
        self._measure(large, large.points, middle, partial(measure_blemish, bare, self._search))

    def _measure(
        self, indication: Indication, points: np.ndarray, middle: float, measure: Callable[..., Blemish]
    ) -> bool:
        """Add the blemish, or a note and return False; ``points`` are those of the indication."""
        try:
            blemish = measure(indication, self._errors, **self._sizes)
        except EvaluationError as error:
            others = [whole.indication.points for whole in self._large if whole.indication is not indication]
            if isinstance(error, NotSignificantError) or any(np.isin(points, each).all() for each in others):
                omitted = f"is omitted: {error}"
                note = _note_indication(self._cloud, self._chosen[points], indication.height_mm, omitted)
                self.notes.append(note)
            else:
                self._add_unsized(points, indication.height_mm, 0.0, str(error))
            return False
        self._measured.append((blemish, middle, indication.false_alarm))
        return True

    def _add_unresolved(self, search: BlemishSearch, chosen: np.ndarray, within: np.ndarray | None = None) -> None:
        """Add what a search of the ``chosen`` points (M,) did not resolve, if it is ``within`` (K,) some of them."""
        for each in search.unresolved:
            point = chosen[each.point]
            if within is None or point in within:
                self._add_unsized(np.array([point]), each.height_mm, each.bound_mm, each.reason)

    def _add_unsized(self, points: np.ndarray, height: float, bound: float, reason: str) -> None:
        """Add a finding that is not sized, of some points and a signed height."""
        kind = FeatureKind.PROTRUSION if height > 0 else FeatureKind.PIT
        self._unsized.append((kind, self._chosen[points], abs(height), bound, f"not sized: {reason}"))

    def _make_sized_feature(self, measured: tuple[Blemish, float, float]) -> Feature:
        blemish, middle, chance = measured
        form = self._form

        def in_cloud(places: np.ndarray) -> np.ndarray:
            """Return points (K, 3) on the pipe at places (K, 2) of the surface unrolled about the angle."""
            return form.points_at(places[:, 0], places[:, 1] / form.radius_mm + middle)

        out = form.frame.normals_at(np.array([blemish.place[1] / form.radius_mm + middle]))[0]
        return Feature(
            blemish.kind,
            "",
            blemish.with_spacing(),
            in_cloud(blemish.place[None])[0],
            self._find_axes(out),
            blemish.extent_mm,
            self._chosen[blemish.points],
            chance,
            in_cloud(blemish.outline),
            in_cloud(blemish.hollows),
            blemish.reason,
        )

    def _make_unsized_feature(self, found: tuple[FeatureKind, np.ndarray, float, float, str]) -> Feature:
        kind, points, height, bound, reason = found
        place = self._cloud.points_mm[points].mean(axis=0)
        out = self._form.frame.normals_at(self._form.frame.cylindrical(place[None])[1])[0]
        name = "height" if kind == FeatureKind.PROTRUSION else "depth"
        value = replace(plain_value(kind, name, max(height, bound), 0.0, None), low=bound).as_bound()
        extent = np.array([0.0, 0.0, height])
        return Feature(kind, "", (value,), place, self._find_axes(out), extent, points, reason=reason)

    def _find_axes(self, out: np.ndarray) -> np.ndarray:
        """Return the axes (3, 3) of a feature with an outward normal (3,)."""
        along = self._form.frame.axes[2]
        return np.array([along, np.cross(out, along), out])


def _note_merged(feature: Feature) -> Iterator[str]:
    """Yield a note on a finding that consists of several neighbours."""
    if len(feature.hollows_mm):
        distance = np.linalg.norm(feature.hollows_mm[1:] - feature.hollows_mm[0], axis=1)
        places = " and ".join(f"{each:.1f} mm" for each in sorted(distance))
        yield (
            f"{feature.name} is {len(feature.hollows_mm)} neighbours that the search joined, {places} from the "
            "deepest: its depth is that of the deepest, its length and width those of the contour around that one; "
            "measure the others on their own"
        )


def _note_indication(cloud: PointCloud, points: np.ndarray, height_mm: float, text: str) -> str:
    """Return a note on an indication at some points."""
    x, y, z = cloud.points_mm[points].mean(axis=0)
    return f"an indication of {height_mm:.2g} mm at ({x:.1f}, {y:.1f}, {z:.1f}) mm {text}"


def _note_limits(cloud: PointCloud, form: PipeForm, search: BlemishSearch) -> Iterator[str]:
    if cloud.uncertainty is None:
        yield WITHOUT_UNCERTAINTY
    if not form.is_seen_round:
        seen = np.degrees(form.arc)
        yield (
            f"the cloud shows {seen:.0f} deg of the circumference, too little for the ovality: the interval of the "
            f"diameter includes the effect of an ovality of up to {100 * form.largest_ovality:g} %"
        )
    level = float(np.nanmedian(search.level_mm)) if np.isfinite(search.level_mm).any() else np.nan
    yield (
        f"blemishes of {2 * search.smallest_mm:.2g} mm diameter are significant from {level:.2g} mm depth (median), "
        f"larger ones from less; the probability of any false indication is {search.false_alarm:g}"
    )
    if stray := np.count_nonzero(search.outliers):
        yield (
            f"{stray} of {len(search.outliers)} points are left out as stray points: each departs from its neighbours "
            f"by more than {SEARCH_RULE.outlier:g} standard deviations, and too few beside it do"
        )
