"""Inspection of flat things: a step between two faces, a flange's face with its holes, a gap between two plates.

Faces are least-squares planes. Edges are found along the profiles, from how much of the stripe's brightness the blur
has left to the last point on a face, and are known to half a point's spacing.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.stats import norm

from uwlts.errors import EvaluationError
from uwlts.evaluation.figures import TOWARDS_SENSOR
from uwlts.evaluation.step_faces import StepFace, label_step_faces
from uwlts.fitting.least_squares import evenly_thinned, fit_robustly, robust_std
from uwlts.fitting.point_spacing import footprint_on
from uwlts.fitting.propagation import PointErrors, neighbours_in_order
from uwlts.fitting.shapes import fit_plane
from uwlts.inspection.features import Feature, FeatureKind, FeatureValue, Inspection, plain_value
from uwlts.storage.cloud import PointCloud
from uwlts.storage.cloud_files import loaded_cloud

_FEWEST = 200
_PROPOSALS = 600
"""Planes through three points that are tried for the largest face."""
_THINNED = 3000
"""Points on which they are judged."""
_NEAR_SHARE = 2e-3
"""Of the cloud's size: how near to a proposed plane a point has to be; flatter faces than that are refined after."""
_OFF_FACE = 6.0
"""Standard deviations from a face at which a point is not on it."""
_LEAST_GAP = 4
"""Lines without a point on the face from which they are a gap; fewer are lines that were lost."""
_EDGE_STD = 1 / np.sqrt(12.0)
"""Of a point's spacing: an edge lies anywhere between two lines (GUM, 4.3.7)."""
_EDGE_BLUR = 0.5
"""Standard uncertainty, in the spacing of points, of where all edges are seen together: the camera's blur lets the
stripe end up to about a line beyond the edge."""
_WHOLE_LINES = range(5, 12)
"""Lines from an edge whose brightness is that of the face."""
_FEWEST_EDGES = 8
_FEWEST_IMAGES = 2
"""Images in which the lines of a hole are missing, from which it counts as one; in a single image lines are lost."""
_ROUND_SHARE = 0.08
"""Of a hole's radius: scatter of its edge from which it is none."""
_HOLE_ARC = 200.0
"""Degrees of a hole's edge that have to be seen."""
_SAME_SHARE = 0.2
"""By which the diameters of bolt holes may differ."""
_REFINED = 4
_FLAT_CELLS = 24
"""Across the face; the means of cells are its smoothed form."""
_EDGE_LINES = 4
"""Lines next to an edge that do not count for the flatness: the camera's blur mixes in what lies beyond."""
_DRAWS = 48
"""Draws of noise for the flatness: their standard deviation is right to 10 %."""

_facing_plane = partial(fit_plane, towards=TOWARDS_SENSOR)


def inspect_step(cloud: PointCloud | str | os.PathLike[str]) -> Inspection:
    """Measure the step between the two largest parallel faces of a cloud.

    Parameters
    ----------
    cloud
        As for `inspect_pipe`.

    Raises
    ------
    CaptureError
        The file cannot be read.
    EvaluationError
        There are no two such faces.
    """
    cloud = _cloud_of_faces(cloud)
    normal = _largest_plane(cloud.points_mm)[0]
    labels = label_step_faces(cloud.points_mm, height_mm=_height_between(cloud.points_mm @ normal))
    lower, upper = (np.flatnonzero(labels == face) for face in (StepFace.LOWER, StepFace.UPPER))
    base = _face_of(cloud, lower)
    other = _face_of(cloud, upper)
    used = np.concatenate([lower, upper])
    # The mean of the upper face less the lower one's plane below its middle, and the slopes of both.
    lever = np.append(1.0, (cloud.points_mm[upper].mean(axis=0) - base.point_mm) @ base.axes[:2].T)
    row = np.concatenate([-lever @ base.rows, np.full(len(upper), 1 / len(upper))])
    distance = cloud.points_mm[used] @ base.axes[2] - base.point_mm @ base.axes[2]
    height = float(row @ distance)
    errors = PointErrors.along(cloud, used, np.broadcast_to(base.axes[2], (len(used), 3)))
    residuals = np.concatenate([base.residuals_mm, other.residuals_mm])
    turned = base.axes[:2] @ other.axes[:2].T
    slopes = np.hstack([-base.rows[1:], turned @ other.rows[1:]])
    random, common = errors.covariances(np.vstack([row, slopes]), residuals, neighbours_in_order(len(used)))
    angle = np.array([base.axes[k] @ other.axes[2] for k in (0, 1)])
    values = (
        _plain(FeatureKind.STEP, "height", height, random, common, 0),
        _angle(FeatureKind.STEP, angle, random[1:, 1:], None if common is None else common[1:, 1:]),
    )
    points = cloud.points_mm[used]
    extent = np.append(np.ptp((points - base.point_mm) @ base.axes[:2].T, axis=0), height)
    feature = Feature(FeatureKind.STEP, "step", values, points.mean(axis=0), base.axes, extent, used)
    return _inspection("step", cloud, (feature,), [(lower, base), (upper, other)])


def inspect_flange(
    cloud: PointCloud | str | os.PathLike[str], *, datum: PointCloud | str | os.PathLike[str] | None = None
) -> Inspection:
    """Measure a flange's face: flatness, holes, bolt circle, and its parallelism to the face of another cloud.

    Of the holes the largest is the bore, those of like diameter are for bolts.

    Parameters
    ----------
    cloud
        As for `inspect_pipe`.
    datum
        Cloud of another face in the same frame, to which the flange's face is to be parallel, or its file.

    Raises
    ------
    CaptureError
        The file cannot be read.
    EvaluationError
        The cloud has no frames and lines, or no face.
    """
    cloud, datum = _cloud_of_faces(cloud), None if datum is None else loaded_cloud(datum)
    used = _largest_plane(cloud.points_mm)[1]
    face = _face_of(cloud, used)
    values = [_flatness(cloud, face, used)]
    holes, features, notes = [], [], []
    for edges in _gaps(cloud, face, used):
        try:
            holes.append(_hole(edges))
        except EvaluationError as error:
            if len(np.unique(edges.frame)) >= _FEWEST_IMAGES:
                notes.append(_left_out(face, edges.places.mean(axis=0), str(error)))
    if holes:
        largest = max(holes, key=lambda hole: hole.radius_mm)
        bolts = [hole for hole in holes if hole is not largest]
        if bolts:
            usual = float(np.median([hole.radius_mm for hole in bolts]))
            same = [abs(hole.radius_mm - usual) < _SAME_SHARE * usual for hole in bolts]
            notes += [
                _left_out(
                    face, hole.middle, f"its diameter is {2 * hole.radius_mm:.4g} mm, the others' {2 * usual:.4g}"
                )
                for hole, alike in zip(bolts, same, strict=True)
                if not alike
            ]
            bolts = [hole for hole, alike in zip(bolts, same, strict=True) if alike]
        if largest.radius_mm < 1.5 * max((hole.radius_mm for hole in bolts), default=0.0):
            bolts = holes
        else:
            values.append(_diameter(FeatureKind.FLANGE, "bore", largest))
        offsets = [np.nan] * len(bolts)
        if len(bolts) >= 3:
            circle, offsets = _bolt_circle(bolts)
            values.append(circle)
        for number, (hole, offset) in enumerate(zip(bolts, offsets, strict=True), start=1):
            features.append(_hole_feature(face, hole, number, offset))
    if datum is not None:
        values.append(_parallelism(cloud, face, used, datum))
    extent = np.append(np.ptp((cloud.points_mm[used] - face.point_mm) @ face.axes[:2].T, axis=0), values[0].value)
    whole = Feature(FeatureKind.FLANGE, "flange", tuple(values), face.point_mm, face.axes, extent, used)
    return _inspection("flange", cloud, (whole, *features), [(used, face)], notes)


def inspect_gap(cloud: PointCloud | str | os.PathLike[str]) -> Inspection:
    """Measure the gap between two plates that the profiles cross: width, parallelism and flush.

    Parameters
    ----------
    cloud
        As for `inspect_pipe`.

    Raises
    ------
    CaptureError
        The file cannot be read.
    EvaluationError
        The cloud has no frames and lines, or no gap goes through it.
    """
    cloud = _cloud_of_faces(cloud)
    # Both plates, which may be offset: everything on either side of the widest hole in the profiles.
    everything = np.arange(len(cloud))
    face = _face_of(cloud, _largest_plane(cloud.points_mm)[1])
    found = _gaps(cloud, face, everything)
    if not found:
        raise EvaluationError("no gap goes through the profiles: scan across it, so that each profile has both edges")
    edges = max(found, key=lambda each: len(np.unique(each.frame)))
    # Ends of the gaps alternate: first the one with the smaller line.
    sides = edges.places[edges.first], edges.places[~edges.first]
    middle = edges.places.mean(axis=0)
    if min(map(len, sides)) < _FEWEST_EDGES:
        raise EvaluationError(
            f"the gap was seen in {min(map(len, sides))} profiles; at least {_FEWEST_EDGES} are needed"
        )
    along = np.linalg.svd(np.vstack([side - side.mean(axis=0) for side in sides]))[2][0]
    across = np.array([-along[1], along[0]])
    turn = np.stack([along, across])
    design, rows = [], []
    for side in sides:
        t = (side - middle) @ along
        design.append(np.column_stack([np.ones(len(t)), t]))
        rows.append(np.linalg.pinv(design[-1]))
    places = [(side - middle) @ across for side in sides]
    lines = [row @ place for row, place in zip(rows, places, strict=True)]
    sign = np.sign(lines[1][0] - lines[0][0])
    left = np.concatenate([p - d @ line for p, d, line in zip(places, design, lines, strict=True)])
    weights = sign * np.hstack([-rows[0], rows[1]])
    noise = max(float(np.sqrt(np.sum(left**2) / max(len(left) - 4, 1))), edges.spacing * _EDGE_STD)
    random = noise**2 * weights @ weights.T
    # Both edges are blurred alike, whether or not the cloud states more.
    common = np.diag([(2 * _EDGE_BLUR * edges.spacing) ** 2, 0.0])
    order = np.concatenate([np.flatnonzero(edges.first), np.flatnonzero(~edges.first)])
    if edges.patterns is not None:
        moved = weights @ (edges.patterns[:, order] @ across).T
        common = common + moved @ moved.T
    width, slope = sign * (lines[1] - lines[0])
    kind = FeatureKind.GAP
    angle = float(np.degrees(np.arctan(slope)))
    stds = [None if each is None else float(np.degrees(np.sqrt(each[1, 1]))) for each in (random, common)]
    values = [
        _plain(kind, "width", float(width), random, common, 0),
        plain_value(kind, "parallelism", abs(angle), stds[0] or 0.0, stds[1], least=0.0),
    ]
    local = (cloud.points_mm - face.point_mm) @ face.axes[:2].T - middle
    side = sign * (local @ across - np.mean([line[0] for line in lines]))
    clear = 0.5 * abs(float(width)) + 2 * edges.spacing
    plates = [np.flatnonzero(side < -clear), np.flatnonzero(side > clear)]
    values.append(_flush(cloud, face, plates, middle))
    place = face.point_mm + middle @ face.axes[:2]
    axes = np.vstack([turn @ face.axes[:2], face.axes[2]])
    extent = np.array([float(np.ptp((edges.places - middle) @ along)), abs(float(width)), values[-1].value])
    feature = Feature(kind, "gap", tuple(values), place, axes, extent, edges.points)
    notes = [
        _left_out(face, each.places.mean(axis=0), f"{number} profiles cross it, fewer than the gap")
        for each in found
        if each is not edges and (number := len(np.unique(each.frame))) >= _FEWEST_IMAGES
    ]
    return _inspection("gap", cloud, (feature,), [], notes)


@dataclass(frozen=True, eq=False)
class _Face:
    """A plane: point (3,), axes (3, 3) in it and outwards, residuals (n,), and rows (3, n) of its level and slopes."""

    point_mm: np.ndarray
    axes: np.ndarray
    residuals_mm: np.ndarray
    rows: np.ndarray
    std_mm: float


class _Edges(NamedTuple):
    """Edge points in a face: places (E, 2), the image of each, whether it comes first along its profile, the motion
    (M, E, 2) with each pattern, the indices of the face's points beside them, and the usual spacing of points."""

    places: np.ndarray
    frame: np.ndarray
    first: np.ndarray
    patterns: np.ndarray | None
    points: np.ndarray
    spacing: float


@dataclass(frozen=True, eq=False)
class _Hole:
    """A circle in a face: middle (2,), radius, covariance (3, 3), changes (M, 3) with patterns, edge points, blur."""

    middle: np.ndarray
    radius_mm: float
    random: np.ndarray
    moved: np.ndarray | None
    points: np.ndarray
    blur_mm: float


def _cloud_of_faces(cloud: PointCloud | str | os.PathLike[str]) -> PointCloud:
    """The cloud, read if it is a file; EvaluationError if it has too few points."""
    cloud = loaded_cloud(cloud)
    if len(cloud) < _FEWEST:
        raise EvaluationError(f"the cloud has {len(cloud)} points; at least {_FEWEST} are needed")
    return cloud


def _largest_plane(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Normal (3,) towards the sensor and indices of the points of the plane that holds most of them."""
    thinned = evenly_thinned(points, _THINNED)
    size = float(np.linalg.norm(np.ptp(points, axis=0)))
    rng = np.random.default_rng(0)
    corners = thinned[rng.integers(len(thinned), size=(_PROPOSALS, 3))]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normals, axis=1)
    normals, corners = normals[length > 0] / length[length > 0, None], corners[length > 0, 0]
    levels = np.einsum("pi,pi->p", normals, corners)
    near = np.abs(thinned @ normals.T - levels) < _NEAR_SHARE * size
    best = int(np.argmax(near.sum(axis=0)))
    inside = np.abs(points @ normals[best] - levels[best]) < _NEAR_SHARE * size
    normal = normals[best]
    for _ in range(_REFINED):
        fit = fit_robustly(_facing_plane, points[inside]).fit
        normal, distance = fit.normal, fit.distances_mm(points)
        spread = robust_std(distance[inside])
        inside = np.abs(distance) < _OFF_FACE * max(spread, 1e-9)
    if np.count_nonzero(inside) < _FEWEST:
        raise EvaluationError(f"the largest flat face holds {np.count_nonzero(inside)} points; {_FEWEST} are needed")
    return normal, np.flatnonzero(inside)


def _height_between(levels: np.ndarray) -> float:
    """Distance of the two levels with most points."""
    low, high = np.quantile(levels, [0.001, 0.999])
    count, edges = np.histogram(levels, bins=200, range=(low, high))
    first = int(np.argmax(count))
    apart = np.abs(np.arange(200) - first) > 6
    if high <= low or not count[apart].any():
        raise EvaluationError("there is one level only: show both faces of the step")
    second = int(np.argmax(np.where(apart, count, 0)))
    return float(abs(edges[second] - edges[first]))


def _face_of(cloud: PointCloud, chosen: np.ndarray) -> _Face:
    points = cloud.points_mm[chosen]
    fit = fit_plane(points, towards=TOWARDS_SENSOR)
    axes = np.array([fit.axes[0], np.cross(fit.normal, fit.axes[0]), fit.normal])
    local = (points - fit.point_mm) @ axes.T
    design = np.column_stack([np.ones(len(local)), local[:, :2]])
    rows = np.linalg.solve(design.T @ design, design.T)
    return _Face(fit.point_mm, axes, local[:, 2], rows, fit.std_mm)


def _plain(
    kind: FeatureKind, name: str, value: float, random: np.ndarray, common: np.ndarray | None, at: int
) -> FeatureValue:
    shared = None if common is None else float(np.sqrt(common[at, at]))
    return plain_value(kind, name, value, float(np.sqrt(random[at, at])), shared, least=0.0)


def _angle(kind: FeatureKind, slopes: np.ndarray, random: np.ndarray, common: np.ndarray | None) -> FeatureValue:
    """Angle in deg between two planes whose slopes differ by (2,)."""
    size = float(np.linalg.norm(slopes))
    along = slopes / size if size > 0 else np.array([1.0, 0.0])
    stds = [None if each is None else float(np.degrees(np.sqrt(along @ each @ along))) for each in (random, common)]
    return plain_value(kind, "parallelism", float(np.degrees(np.arctan(size))), stds[0] or 0.0, stds[1], least=0.0)


def _inspection(
    kind: str,
    cloud: PointCloud,
    features: tuple[Feature, ...],
    faces: list[tuple[np.ndarray, _Face]],
    notes: Sequence[str] = (),
) -> Inspection:
    deviation = np.full(len(cloud), np.nan)
    for own, face in faces:
        deviation[own] = face.residuals_mm
    if cloud.uncertainty is None:
        notes = "the cloud states no uncertainty: intervals are of the scatter of its points alone", *notes
    return Inspection(kind, features, deviation, np.full(len(cloud), np.nan), tuple(notes))


def _left_out(face: _Face, place: np.ndarray, reason: str) -> str:
    """Note on a hole at a place (2,) of a face that is not listed."""
    x, y, z = face.point_mm + place @ face.axes[:2]
    return f"a hole at ({x:.1f}, {y:.1f}, {z:.1f}) mm is not listed: {reason}"


def _flatness(cloud: PointCloud, face: _Face, used: np.ndarray) -> FeatureValue:
    """Range of the means of small cells of the face, less what noise alone adds to it (by drawing it again)."""
    inner = _away_from_edges(cloud, used)
    local = (cloud.points_mm[used] - face.point_mm) @ face.axes[:2].T
    cell = float(np.ptp(local, axis=0).max()) / _FLAT_CELLS
    index = np.unique(np.floor(local / cell).astype(int), axis=0, return_inverse=True)[1].ravel()
    count = np.bincount(index[inner], minlength=int(index.max()) + 1)
    full = count >= max(8, 0.2 * np.median(count))
    design = np.column_stack([np.ones(len(local)), local])

    def means(distances: np.ndarray) -> np.ndarray:
        left = distances - design @ (face.rows @ distances)
        return np.bincount(index[inner], left[inner], len(count))[full] / count[full]

    found = means(face.residuals_mm)
    errors = PointErrors.along(cloud, used, np.broadcast_to(face.axes[2], (len(used), 3)))
    noisy = replace(errors, single_mm=np.maximum(errors.single_mm, face.std_mm))
    value = float(np.ptp(found))

    def changed(moves: np.ndarray) -> float:
        return float(np.ptp(found + means(moves))) - value

    drawn = [changed(moves) for moves in noisy.drawn(_DRAWS)]
    bias, common = max(float(np.mean(drawn)), 0.0), errors.by_patterns(changed)
    random = float(np.hypot(np.std(drawn), bias))
    shared = None if common is None else float(common)
    return plain_value(FeatureKind.FLANGE, "flatness", max(value - bias, 0.0), random, shared, least=0.0)


def _away_from_edges(cloud: PointCloud, used: np.ndarray) -> np.ndarray:
    """Which of the points (N,) have enough lines beside them that were seen, on both sides; all without lines."""
    if np.any(cloud.frame[used] < 0) or np.any(cloud.line[used] < 0):
        return np.ones(len(used), bool)
    order = np.lexsort((cloud.line[used], cloud.frame[used]))
    frame, line = cloud.frame[used][order], cloud.line[used][order]
    # Single lost lines are no edge.
    run = np.cumsum(np.append(0, (np.diff(frame) != 0) | (np.diff(line) >= _LEAST_GAP)))
    first, last = np.searchsorted(run, run), np.searchsorted(run, run, side="right") - 1
    inner = np.empty(len(used), bool)
    inner[order] = (line - line[first] >= _EDGE_LINES) & (line[last] - line >= _EDGE_LINES)
    return inner


def _gaps(cloud: PointCloud, face: _Face, used: np.ndarray) -> list[_Edges]:
    """Edges of the holes that profiles cross, each hole by itself: gaps that overlap in neighbouring images."""
    if np.any(cloud.frame[used] < 0) or np.any(cloud.line[used] < 0):
        raise EvaluationError("edges are found along the profiles, and the cloud has no frames and lines")
    order = np.lexsort((cloud.line[used], cloud.frame[used]))
    own = used[order]
    frame, line = cloud.frame[own], cloud.line[own]
    local = (cloud.points_mm[own] - face.point_mm) @ face.axes[:2].T
    same = frame[1:] == frame[:-1]
    step = np.linalg.norm(np.diff(local, axis=0), axis=1)
    spacing = float(np.median(step[same & (np.diff(line) == 1)]))
    at = np.flatnonzero(same & (np.diff(line) >= _LEAST_GAP) & (step > _LEAST_GAP * spacing))
    if not len(at):
        return []
    beyond = _beyond_last(cloud, own, np.append(0, np.cumsum(~same)), face, spacing)
    number = np.unique(cloud.frame, return_inverse=True)[1]
    image = number[own[at]]
    lower, upper = line[at], line[at + 1]
    before, after = [], []
    for k in range(len(at)):
        neighbours = np.flatnonzero((image == image[k] + 1) & (lower <= upper[k]) & (upper >= lower[k]))
        before += [k] * len(neighbours)
        after += neighbours.tolist()
    graph = coo_array((np.ones(len(before)), (before, after)), shape=(len(at), len(at)))
    labels = connected_components(graph, directed=False)[1]
    result = []
    known = cloud.uncertainty
    for label in np.unique(labels):
        gap = at[labels == label]
        inner = np.concatenate([gap, gap + 1])
        first = np.repeat([True, False], len(gap))
        direction = local[gap + 1] - local[gap]
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        outwards = np.concatenate([direction, -direction])
        places = local[inner] + beyond[inner, first.astype(int)][:, None] * outwards
        points = own[inner]
        patterns = None if known is None else known.patterns_mm[:, points] @ face.axes[:2].T
        result.append(_Edges(places, frame[inner], first, patterns, points, spacing))
    return result


def _beyond_last(cloud: PointCloud, own: np.ndarray, row: np.ndarray, face: _Face, spacing: float) -> np.ndarray:
    """How far beyond a point (N,) an edge lies if it is the last one before it: (N, 2), after and before it in its row.

    Blur of standard deviation s leaves the share Phi(d / s) of a stripe's brightness at a distance d within an edge.
    Where brightness or blur is not known, or the share tells nothing, the edge is half a spacing away.
    """
    result = np.full((len(own), 2), 0.5 * spacing)
    bright = cloud.intensity[own].astype(float)
    size = footprint_on(cloud, own, np.broadcast_to(face.axes[:2], (len(own), 2, 3)))[0]
    along = np.diff(cloud.points_mm[own] @ face.axes[:2].T, axis=0)[np.diff(row) == 0]
    axis = int(np.argmax(np.median(np.abs(along), axis=0)))
    blur = size[:, axis]
    if not (np.isfinite(bright).all() and (blur > 0).all()):
        return result
    for side, sign in ((0, -1), (1, 1)):
        inner = np.stack([np.clip(np.arange(len(own)) + sign * k, 0, len(own) - 1) for k in _WHOLE_LINES])
        known = (row[inner] == row).all(axis=0)
        share = bright / np.maximum(np.median(bright[inner], axis=0), 1e-9)
        within = blur * norm.ppf(np.clip(share, 0.02, 0.98))
        usable = known & (within < spacing)
        result[usable, side] = within[usable]
    return result


def _hole(edges: _Edges) -> _Hole:
    """A round hole by least squares of its edge. EvaluationError where that is not round or not seen all around."""
    if len(edges.places) < _FEWEST_EDGES:
        raise EvaluationError(f"its edge has {len(edges.places)} points; at least {_FEWEST_EDGES} are needed")
    solved = _circle(edges.places)
    away = edges.places - solved[:2]
    distance = np.linalg.norm(away, axis=1)
    left = distance - solved[2]
    angle = np.sort(np.degrees(np.arctan2(away[:, 1], away[:, 0])))
    seen = 360 - float(np.max(np.diff(np.append(angle, angle[0] + 360))))
    scatter = float(np.sqrt(np.sum(left**2) / (len(left) - 3)))
    if scatter > (limit := max(_ROUND_SHARE * solved[2], 1.5 * edges.spacing)):
        raise EvaluationError(f"it is not round: its edge is off a circle by {scatter:.2g} mm, more than {limit:.2g}")
    if seen < _HOLE_ARC:
        raise EvaluationError(f"{seen:.0f} deg of its edge were seen; {_HOLE_ARC:.0f} are needed")
    rows = np.linalg.pinv(np.column_stack([away / distance[:, None], np.ones(len(left))]))
    random = max(scatter, edges.spacing * _EDGE_STD) ** 2 * rows @ rows.T
    moved = None
    if edges.patterns is not None:
        moved = np.einsum("mej,ej->me", edges.patterns, away / distance[:, None]) @ rows.T
    return _Hole(solved[:2], float(solved[2]), random, moved, edges.points, _EDGE_BLUR * edges.spacing)


def _circle(places: np.ndarray) -> np.ndarray:
    """Middle and radius (3,) of the least-squares circle (Gauss-Newton from the algebraic one)."""
    centre = places.mean(axis=0)
    local = places - centre
    solved = np.linalg.lstsq(np.column_stack([2 * local, np.ones(len(local))]), np.sum(local**2, axis=1), rcond=None)[0]
    result = np.array([*(centre + solved[:2]), np.sqrt(max(solved[2] + solved[:2] @ solved[:2], 1e-12))])
    for _ in range(20):
        away = places - result[:2]
        distance = np.maximum(np.linalg.norm(away, axis=1), 1e-12)
        design = np.column_stack([away / distance[:, None], np.ones(len(away))])
        step = np.linalg.lstsq(design, distance - result[2], rcond=None)[0]
        result = result + step
        if np.abs(step).max() < 1e-9:
            return result
    raise EvaluationError(f"no circle fits the {len(places)} places: the least squares do not settle")


def _diameter(kind: FeatureKind, name: str, hole: _Hole) -> FeatureValue:
    # Both ends of a diameter are blurred alike, whether or not the cloud states more.
    shared = 0.0 if hole.moved is None else float(np.linalg.norm(hole.moved[:, 2]))
    common = 2 * float(np.hypot(shared, hole.blur_mm))
    return plain_value(kind, name, 2 * hole.radius_mm, 2 * float(np.sqrt(hole.random[2, 2])), common)


def _bolt_circle(bolts: list[_Hole]) -> tuple[FeatureValue, list[float]]:
    """Diameter of the circle through the middles, and the distance of each from its place on an even division."""
    middles = np.array([hole.middle for hole in bolts])
    circle = _circle(middles)
    away = middles - circle[:2]
    units = away / np.linalg.norm(away, axis=1, keepdims=True)
    rows = np.linalg.pinv(np.column_stack([units, np.ones(len(bolts))]))
    std = np.array([np.sqrt(u @ hole.random[:2, :2] @ u) for u, hole in zip(units, bolts, strict=True)])
    random, common = 2 * float(np.sqrt(np.sum((rows[2] * std) ** 2))), None
    moves = [hole.moved for hole in bolts if hole.moved is not None]
    if len(moves) == len(bolts):
        along = np.array([move[:, :2] @ u for move, u in zip(moves, units, strict=True)])
        common = 2 * float(np.linalg.norm(rows[2] @ along))
    value = plain_value(FeatureKind.FLANGE, "bolt circle", 2 * float(circle[2]), random, common)
    angle = np.arctan2(away[:, 1], away[:, 0])
    # Holes that were not seen leave their places free: the division is that of the smallest angle between two.
    between = np.diff(np.sort(np.append(angle, angle.min() + 2 * np.pi)))
    count = max(len(bolts), round(2 * np.pi / float(np.min(between))))
    phase = np.angle(np.mean(np.exp(1j * count * angle))) / count
    nearest = phase + 2 * np.pi / count * np.round((angle - phase) * count / (2 * np.pi))
    even = circle[:2] + circle[2] * np.column_stack([np.cos(nearest), np.sin(nearest)])
    return value, np.linalg.norm(middles - even, axis=1).tolist()


def _hole_feature(face: _Face, hole: _Hole, number: int, offset: float) -> Feature:
    values = [_diameter(FeatureKind.HOLE, "diameter", hole)]
    if np.isfinite(offset):
        random = float(np.sqrt(np.trace(hole.random[:2, :2]) / 2))
        common = None if hole.moved is None else float(np.sqrt(np.mean(np.sum(hole.moved[:, :2] ** 2, axis=0))))
        values.append(plain_value(FeatureKind.HOLE, "position", offset, random, common, least=0.0))
    place = face.point_mm + hole.middle @ face.axes[:2]
    extent = np.array([2 * hole.radius_mm, 2 * hole.radius_mm, 0.0])
    return Feature(FeatureKind.HOLE, f"hole {number}", tuple(values), place, face.axes, extent, hole.points)


def _parallelism(cloud: PointCloud, face: _Face, used: np.ndarray, datum: PointCloud) -> FeatureValue:
    """Angle to the largest face of another cloud, whose calibration counts as independent."""
    on_datum = _largest_plane(datum.points_mm)[1]
    other = _face_of(datum, on_datum)
    facing = 1.0 if face.axes[2] @ other.axes[2] > 0 else -1.0
    slopes = facing * face.axes[:2] @ other.axes[2]
    random, common = np.zeros((2, 2)), None
    for own, plane, chosen in ((cloud, face, used), (datum, other, on_datum)):
        errors: PointErrors = PointErrors.along(own, chosen, np.broadcast_to(plane.axes[2], (len(chosen), 3)))
        rows = (face.axes[:2] @ plane.axes[:2].T) @ plane.rows[1:]
        by_noise, by_common = errors.covariances(rows, plane.residuals_mm, neighbours_in_order(len(chosen)))
        random = random + by_noise
        if by_common is not None:
            common = by_common if common is None else common + by_common
    return _angle(FeatureKind.FLANGE, slopes, random, common)


def _flush(cloud: PointCloud, face: _Face, plates: list[np.ndarray], middle: np.ndarray) -> FeatureValue:
    """Offset along the normal of two plates at a place between them."""
    if min(map(len, plates)) < _FEWEST:
        raise EvaluationError("too few points on one side of the gap for its plate")
    parts, used, residuals = [], [], []
    for sign, chosen in zip((-1.0, 1.0), plates, strict=True):
        local = (cloud.points_mm[chosen] - face.point_mm) @ face.axes.T
        near = np.abs(local[:, 2] - np.median(local[:, 2])) < _OFF_FACE * max(
            robust_std(local[:, 2] - np.median(local[:, 2])), 1e-9
        )
        chosen, local = chosen[near], local[near]
        design = np.column_stack([np.ones(len(local)), local[:, :2] - middle])
        rows = np.linalg.solve(design.T @ design, design.T)
        parts.append(sign * rows[0])
        used.append(chosen)
        residuals.append(local[:, 2] - design @ (rows @ local[:, 2]))
    both, weights = np.concatenate(used), np.concatenate(parts)[None]
    offset = float(weights[0] @ ((cloud.points_mm[both] - face.point_mm) @ face.axes[2]))
    errors = PointErrors.along(cloud, both, np.broadcast_to(face.axes[2], (len(both), 3)))
    random, common = errors.covariances(weights, np.concatenate(residuals), neighbours_in_order(len(both)))
    return _plain(FeatureKind.GAP, "flush", abs(offset), random, common, 0)
