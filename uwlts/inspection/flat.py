"""Inspection of flat objects: a step between two faces, a flange with its holes, a gap between two plates.

Faces are least-squares planes. Edges are found along the profiles. The brightness of the last point on a face, reduced
by the blur, gives the distance to the edge. Without brightness or blur it is half a point spacing.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.sparse.csgraph import connected_components
from scipy.stats import norm

from uwlts.errors import EvaluationError
from uwlts.evaluation.figures import TOWARDS_SENSOR
from uwlts.fitting.least_squares import robust_std
from uwlts.fitting.local_surface import project_footprint
from uwlts.fitting.propagation import PointErrors, group_neighbours
from uwlts.inspection.bead_profiles import BIAS_FACTOR
from uwlts.inspection.features import (
    WITHOUT_UNCERTAINTY,
    Feature,
    FeatureKind,
    FeatureValue,
    Inspection,
    linear_value,
    plain_value,
)
from uwlts.shapes.flat import Circle, Plane
from uwlts.shapes.step import StepFace, label_step_faces
from uwlts.storage.cloud import PointCloud
from uwlts.storage.cloud_files import load_cloud


class _Rule:
    """Numbers of the inspection of faces, edges, holes and gaps."""

    fewest_points: int = 200  # fewest points of a cloud, a face or a plate
    off_face: float = 6.0  # largest distance of a point from its face, in standard deviations
    histogram_bins: int = 200  # bins of the histogram of heights that separates both faces of a step
    level_bins: int = 6  # bins next to the first face that belong to this face, not to the second one
    gap_lines: int = 4  # fewest consecutive lines of a gap; fewer lines may be missing by noise
    edge_std: float = 1 / np.sqrt(12.0)
    """Standard uncertainty of an edge, in point spacings: rectangular distribution between two lines (GUM, 4.3.7)."""
    edge_blur: float = 0.5
    """Standard uncertainty common to all edges, in point spacings: by the camera's blur the stripe may end up to
    about one line beyond the edge."""
    plain_lines: range = range(5, 12)  # lines from an edge whose brightness is that of the face without the edge
    fewest_edges: int = 8  # fewest edge points of a hole or of each side of a gap
    fewest_images: int = 2  # fewest images that show a hole; in a single image lines may be missing by noise
    roundness: float = 0.08  # largest scatter of the edge of a round hole, as a fraction of its radius
    hole_arc_deg: float = 200.0  # least arc of a hole's edge, deg
    same_diameter: float = 0.2  # largest difference of the diameters of bolt holes, as a fraction
    flat_cells: int = 24
    """Cells across a face. The flatness is the range of their means."""
    edge_lines: int = 4
    """Lines next to an edge without influence on the flatness: by the camera's blur they also show what is beyond."""
    draws: int = 48  # noise draws for the flatness; 48 give a standard deviation to 10 %


def inspect_step(cloud: PointCloud | str | os.PathLike[str]) -> Inspection:
    """Measure the step between the two largest parallel faces of a cloud.

    Parameters
    ----------
    cloud
        See `inspect_pipe`.

    Returns
    -------
    Inspection
        Height and parallelism of the step with their uncertainties, mm and deg.

    Raises
    ------
    CaptureError
        The file cannot be read.
    EvaluationError
        The cloud does not show two such faces.
    """
    cloud = _load_faces(cloud)
    normal = _find_largest_face(cloud.points_mm)[0]
    labels = label_step_faces(cloud.points_mm, height_mm=_estimate_step_height(cloud.points_mm @ normal))
    lower, upper = (np.flatnonzero(labels == face) for face in (StepFace.LOWER, StepFace.UPPER))
    base = _fit_face(cloud, lower)
    other = _fit_face(cloud, upper)
    used = np.concatenate([lower, upper])
    # Height: mean of the upper face minus the lower plane below its middle. Slopes: difference of both planes.
    lever = np.append(1.0, (cloud.points_mm[upper].mean(axis=0) - base.point_mm) @ base.axes[:2].T)
    row = np.concatenate([-lever @ base.rows, np.full(len(upper), 1 / len(upper))])
    distance = cloud.points_mm[used] @ base.axes[2] - base.point_mm @ base.axes[2]
    height = float(row @ distance)
    errors = PointErrors.along_normals(cloud, used, np.broadcast_to(base.axes[2], (len(used), 3)))
    residuals = np.concatenate([base.residuals_mm, other.residuals_mm])
    turned = base.axes[:2] @ other.axes[:2].T
    slopes = np.hstack([-base.rows[1:], turned @ other.rows[1:]])
    known = errors.covariances(np.vstack([row, slopes]), residuals, group_neighbours(len(used)))
    angle = np.array([base.axes[k] @ other.axes[2] for k in (0, 1)])
    values = (
        linear_value(FeatureKind.STEP, "height", height, known, np.eye(3)[0], least=0.0),
        _make_angle(FeatureKind.STEP, angle, known),
    )
    points = cloud.points_mm[used]
    extent = np.append(np.ptp((points - base.point_mm) @ base.axes[:2].T, axis=0), height)
    feature = Feature(FeatureKind.STEP, "step", values, points.mean(axis=0), base.axes, extent, used)
    return _make_inspection("step", cloud, (feature,), [(lower, base), (upper, other)])


def inspect_flange(
    cloud: PointCloud | str | os.PathLike[str], *, datum: PointCloud | str | os.PathLike[str] | None = None
) -> Inspection:
    """Measure a flange's face: flatness, holes, bolt circle, and parallelism to the face of another cloud.

    The largest hole is the bore; the other holes, if they have equal diameters, are bolt holes.

    Parameters
    ----------
    cloud
        See `inspect_pipe`.
    datum
        Cloud of another face in the same frame, or its file. The parallelism refers to this face.

    Returns
    -------
    Inspection
        Flatness, holes, bolt circle and parallelism with their uncertainties, mm and deg.

    Raises
    ------
    CaptureError
        A file cannot be read.
    EvaluationError
        The cloud does not contain frames and lines, or a face.
    """
    cloud, datum = _load_faces(cloud), None if datum is None else load_cloud(datum)
    used = _find_largest_face(cloud.points_mm)[1]
    face = _fit_face(cloud, used)
    values = [_measure_flatness(cloud, face, used)]
    holes, features, notes = [], [], []
    for edges in _find_gaps(cloud, face, used):
        try:
            holes.append(_fit_hole(edges))
        except EvaluationError as error:
            if len(np.unique(edges.frame)) >= _Rule.fewest_images:
                notes.append(_note_omission(face, edges.places.mean(axis=0), str(error)))
    bolts, bore, odd = _sort_holes(face, holes)
    notes += odd
    if bore is not None:
        values.append(_make_diameter(FeatureKind.FLANGE, "bore", bore))
    offsets = [np.nan] * len(bolts)
    if len(bolts) >= 3:
        circle, offsets = _measure_bolt_circle(bolts)
        values.append(circle)
    for number, (hole, offset) in enumerate(zip(bolts, offsets, strict=True), start=1):
        features.append(_make_hole_feature(face, hole, number, offset))
    if datum is not None:
        values.append(_measure_parallelism(cloud, face, used, datum))
    extent = np.append(np.ptp((cloud.points_mm[used] - face.point_mm) @ face.axes[:2].T, axis=0), values[0].value)
    whole = Feature(FeatureKind.FLANGE, "flange", tuple(values), face.point_mm, face.axes, extent, used)
    return _make_inspection("flange", cloud, (whole, *features), [(used, face)], notes)


def _sort_holes(face: _Face, holes: list[_Hole]) -> tuple[list[_Hole], _Hole | None, list[str]]:
    """Return bolt holes, the bore, and notes on others; without a far larger hole, all of them are bolt holes."""
    if not holes:
        return [], None, []
    largest, notes = max(holes, key=lambda hole: hole.radius_mm), list[str]()
    others = [hole for hole in holes if hole is not largest]
    usual = float(np.median([hole.radius_mm for hole in others])) if others else 0.0
    bolts = [hole for hole in others if abs(hole.radius_mm - usual) < _Rule.same_diameter * usual]
    for hole in others:
        if hole not in bolts:
            sizes = f"its diameter is {2 * hole.radius_mm:.4g} mm, that of the others {2 * usual:.4g} mm"
            notes.append(_note_omission(face, hole.middle, sizes))
    if largest.radius_mm < 1.5 * max((hole.radius_mm for hole in bolts), default=0.0):
        return holes, None, notes
    return bolts, largest, notes


def inspect_gap(cloud: PointCloud | str | os.PathLike[str]) -> Inspection:
    """Measure a gap between two plates, scanned across: width, parallelism and flush.

    Parameters
    ----------
    cloud
        See `inspect_pipe`.

    Returns
    -------
    Inspection
        Width, parallelism and flush with their uncertainties, mm and deg.

    Raises
    ------
    CaptureError
        The file cannot be read.
    EvaluationError
        The cloud does not contain frames and lines, or no gap crosses the profiles.
    """
    cloud = _load_faces(cloud)
    # Gaps are searched for in all points, as the plates may be offset.
    everything = np.arange(len(cloud))
    face = _fit_face(cloud, _find_largest_face(cloud.points_mm)[1])
    found = _find_gaps(cloud, face, everything)
    if not found:
        raise EvaluationError("no gap found: scan across it, so that each profile shows both edges")
    edges = max(found, key=lambda each: len(np.unique(each.frame)))
    # The edge with the smaller line number comes first.
    sides = edges.places[edges.first], edges.places[~edges.first]
    middle = edges.places.mean(axis=0)
    if min(map(len, sides)) < _Rule.fewest_edges:
        raise EvaluationError(f"{min(map(len, sides))} profiles show the gap; at least {_Rule.fewest_edges} are needed")
    along = np.linalg.svd(np.vstack([side - side.mean(axis=0) for side in sides]))[2][0]
    across = np.array([-along[1], along[0]])
    turn = np.stack([along, across])
    # A line through each edge: its place in the middle and its slope.
    t, place = turn @ (edges.places - middle).T
    design = np.column_stack([one * term for one in (edges.first, ~edges.first) for term in (np.ones(len(t)), t)])
    rows = np.linalg.pinv(design)
    lines = rows @ place
    sign, left = np.sign(lines[2] - lines[0]), place - design @ lines
    weights = sign * (rows[2:] - rows[:2])
    noise = max(float(np.sqrt(np.sum(left**2) / max(len(left) - 4, 1))), edges.spacing * _Rule.edge_std)
    random = noise**2 * weights @ weights.T
    # Blur shifts both edges in opposite directions, even if the cloud does not state it.
    common = np.diag([(2 * _Rule.edge_blur * edges.spacing) ** 2, 0.0])
    if edges.patterns is not None:
        moved = weights @ (edges.patterns @ across).T
        common = common + moved @ moved.T
    width, slope = sign * (lines[2:] - lines[:2])
    kind = FeatureKind.GAP
    angle = float(np.degrees(np.arctan(slope)))
    values = [
        linear_value(kind, "width", float(width), (random, common), np.array([1.0, 0.0]), least=0.0),
        linear_value(kind, "parallelism", abs(angle), (random, common), np.array([0.0, np.degrees(1.0)]), least=0.0),
    ]
    local = (cloud.points_mm - face.point_mm) @ face.axes[:2].T - middle
    side = sign * (local @ across - 0.5 * (lines[0] + lines[2]))
    clear = 0.5 * abs(float(width)) + 2 * edges.spacing
    plates = [np.flatnonzero(side < -clear), np.flatnonzero(side > clear)]
    values.append(_measure_flush(cloud, face, plates, middle))
    place = face.point_mm + middle @ face.axes[:2]
    axes = np.vstack([turn @ face.axes[:2], face.axes[2]])
    extent = np.array([float(np.ptp((edges.places - middle) @ along)), abs(float(width)), values[-1].value])
    feature = Feature(kind, "gap", tuple(values), place, axes, extent, edges.points)
    notes = [
        _note_omission(face, each.places.mean(axis=0), f"{number} profiles cross it, fewer than the measured gap")
        for each in found
        if each is not edges and (number := len(np.unique(each.frame))) >= _Rule.fewest_images
    ]
    return _make_inspection("gap", cloud, (feature,), [], notes)


@dataclass(frozen=True, eq=False)
class _Face:
    """Plane: point (3,), axes (3, 3) in it and outwards, residuals (n,), and rows (3, n) of its level and slopes."""

    point_mm: np.ndarray
    axes: np.ndarray
    residuals_mm: np.ndarray
    rows: np.ndarray
    std_mm: float


class _Edges(NamedTuple):
    """Edge points in a face."""

    places: np.ndarray  # (E, 2); places in the face, mm
    frame: np.ndarray  # (E,) int; image of each point
    first: np.ndarray  # (E,) bool; whether the point comes first along its profile
    patterns: np.ndarray | None  # (M, E, 2) or None; displacements by the common patterns
    points: np.ndarray  # (E,) int; adjacent points of the cloud
    spacing: float  # median point spacing, mm


@dataclass(frozen=True, eq=False)
class _Hole:
    """Circle in a face."""

    middle: np.ndarray  # (2,)
    radius_mm: float
    random: np.ndarray  # (3, 3); covariance of middle and radius by noise
    moved: np.ndarray | None  # (M, 3) or None; changes of middle and radius by the common patterns
    points: np.ndarray  # (E,) int; points of the edge
    blur_mm: float  # standard uncertainty of the radius by the camera's blur


def _load_faces(cloud: PointCloud | str | os.PathLike[str]) -> PointCloud:
    """Return the cloud, read if it is a file; raise EvaluationError if it has too few points."""
    cloud = load_cloud(cloud)
    if len(cloud) < _Rule.fewest_points:
        raise EvaluationError(f"the cloud has {len(cloud)} points; at least {_Rule.fewest_points} are needed")
    return cloud


def _find_largest_face(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the normal (3,), towards the sensor, and the points' indices of the plane with most points."""
    plane, inside = Plane.find(points, towards=TOWARDS_SENSOR, off=_Rule.off_face)
    if np.count_nonzero(inside) < _Rule.fewest_points:
        raise EvaluationError(
            f"the largest flat face holds {np.count_nonzero(inside)} points; {_Rule.fewest_points} are needed"
        )
    return plane.normal, np.flatnonzero(inside)


def _estimate_step_height(levels: np.ndarray) -> float:
    """Return the distance of the two most frequent heights."""
    low, high = np.quantile(levels, [0.001, 0.999])
    count, edges = np.histogram(levels, bins=_Rule.histogram_bins, range=(low, high))
    first = int(np.argmax(count))
    elsewhere = np.abs(np.arange(len(count)) - first) > _Rule.level_bins
    if high <= low or not count[elsewhere].any():
        raise EvaluationError("only one face found: the cloud has to show both faces of the step")
    second = int(np.argmax(np.where(elsewhere, count, 0)))
    return float(abs(edges[second] - edges[first]))


def _fit_face(cloud: PointCloud, chosen: np.ndarray) -> _Face:
    points = cloud.points_mm[chosen]
    fit = Plane.fit(points, towards=TOWARDS_SENSOR)
    axes = np.array([fit.axes[0], np.cross(fit.normal, fit.axes[0]), fit.normal])
    local = (points - fit.point_mm) @ axes.T
    design = np.column_stack([np.ones(len(local)), local[:, :2]])
    rows = np.linalg.solve(design.T @ design, design.T)
    return _Face(fit.point_mm, axes, local[:, 2], rows, fit.std_mm)


def _make_angle(
    kind: FeatureKind, slopes: np.ndarray, covariances: tuple[np.ndarray, np.ndarray | None]
) -> FeatureValue:
    """Return the angle in deg between two planes; the difference (2,) of their slopes comes last in the covariances."""
    size = float(np.linalg.norm(slopes))
    along = slopes / size if size > 0 else np.array([1.0, 0.0])
    by = np.append(np.zeros(len(covariances[0]) - 2), np.degrees(along))
    return linear_value(kind, "parallelism", float(np.degrees(np.arctan(size))), covariances, by, least=0.0)


def _make_inspection(
    kind: str,
    cloud: PointCloud,
    features: tuple[Feature, ...],
    faces: list[tuple[np.ndarray, _Face]],
    notes: Sequence[str] = (),
) -> Inspection:
    deviation = np.full(len(cloud), np.nan)
    for members, face in faces:
        deviation[members] = face.residuals_mm
    if cloud.uncertainty is None:
        notes = WITHOUT_UNCERTAINTY, *notes
    return Inspection(kind, features, deviation, np.full(len(cloud), np.nan), tuple(notes)).consider_cloud(cloud)


def _note_omission(face: _Face, place: np.ndarray, reason: str) -> str:
    """Return a note on an omitted hole at a place (2,) of a face."""
    x, y, z = face.point_mm + place @ face.axes[:2]
    return f"a hole at ({x:.1f}, {y:.1f}, {z:.1f}) mm is omitted: {reason}"


def _measure_flatness(cloud: PointCloud, face: _Face, used: np.ndarray) -> FeatureValue:
    """Return the range of the cell means of a face.

    Noise increases the range. The bias follows from adding the noise once more (`uwlts.inspection.bead_profiles`), and
    is subtracted. The uncertainty contains this increase.
    """
    inner = _mask_inner_points(cloud, used)
    local = (cloud.points_mm[used] - face.point_mm) @ face.axes[:2].T
    cell = float(np.ptp(local, axis=0).max()) / _Rule.flat_cells
    index = np.unique(np.floor(local / cell).astype(int), axis=0, return_inverse=True)[1].ravel()
    count = np.bincount(index[inner], minlength=int(index.max()) + 1)
    full = count >= max(8, 0.2 * np.median(count))
    design = np.column_stack([np.ones(len(local)), local])

    def means(distances: np.ndarray) -> np.ndarray:
        left = distances - design @ (face.rows @ distances)
        return np.bincount(index[inner], left[inner], len(count))[full] / count[full]

    found = means(face.residuals_mm)
    errors = PointErrors.along_normals(cloud, used, np.broadcast_to(face.axes[2], (len(used), 3)))
    noisy = replace(errors, single_mm=np.maximum(errors.single_mm, face.std_mm))
    value = float(np.ptp(found))

    def changed(moves: np.ndarray) -> float:
        return float(np.ptp(found + means(moves))) - value

    drawn = [changed(moves) for moves in noisy.draw(_Rule.draws)]
    increase, common = max(float(np.mean(drawn)), 0.0), errors.by_patterns(changed)
    flatness, random = max(value - BIAS_FACTOR * increase, 0.0), float(np.hypot(np.std(drawn), increase))
    shared = None if common is None else float(common)
    return plain_value(FeatureKind.FLANGE, "flatness", flatness, random, shared, least=0.0)


def _mask_inner_points(cloud: PointCloud, used: np.ndarray) -> np.ndarray:
    """Return a mask (N,) of the points that are not near an edge; all points if lines are unknown."""
    if np.any(cloud.frame[used] < 0) or np.any(cloud.line[used] < 0):
        return np.ones(len(used), bool)
    order = np.lexsort((cloud.line[used], cloud.frame[used]))
    frame, line = cloud.frame[used][order], cloud.line[used][order]
    # Few missing lines are no edge.
    run = np.cumsum(np.append(0, (np.diff(frame) != 0) | (np.diff(line) >= _Rule.gap_lines)))
    first, last = np.searchsorted(run, run), np.searchsorted(run, run, side="right") - 1
    inner = np.empty(len(used), bool)
    inner[order] = (line - line[first] >= _Rule.edge_lines) & (line[last] - line >= _Rule.edge_lines)
    return inner


def _find_gaps(cloud: PointCloud, face: _Face, used: np.ndarray) -> list[_Edges]:
    """Return the edges of each hole that profiles cross. Overlapping gaps of neighbouring images are one hole."""
    if np.any(cloud.frame[used] < 0) or np.any(cloud.line[used] < 0):
        raise EvaluationError(
            "edges are found along the profiles, but the cloud does not contain frames and lines: take a cloud that "
            "`reconstruct` has made"
        )
    order = np.lexsort((cloud.line[used], cloud.frame[used]))
    sorted_used = used[order]
    frame, line = cloud.frame[sorted_used], cloud.line[sorted_used]
    local = (cloud.points_mm[sorted_used] - face.point_mm) @ face.axes[:2].T
    same = frame[1:] == frame[:-1]
    step = np.linalg.norm(np.diff(local, axis=0), axis=1)
    spacing = float(np.median(step[same & (np.diff(line) == 1)]))
    at = np.flatnonzero(same & (np.diff(line) >= _Rule.gap_lines) & (step > _Rule.gap_lines * spacing))
    if not len(at):
        return []
    beyond = _locate_edges(cloud, sorted_used, np.append(0, np.cumsum(~same)), face, spacing)
    number = np.unique(cloud.frame, return_inverse=True)[1]
    image = number[sorted_used[at]]
    lower, upper = line[at], line[at + 1]
    overlaps = (image == image[:, None] + 1) & (lower <= upper[:, None]) & (upper >= lower[:, None])
    labels = connected_components(overlaps, directed=False)[1]
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
        points = sorted_used[inner]
        patterns = None if known is None else known.patterns_mm[:, points] @ face.axes[:2].T
        result.append(_Edges(places, frame[inner], first, patterns, points, spacing))
    return result


def _locate_edges(cloud: PointCloud, members: np.ndarray, row: np.ndarray, face: _Face, spacing: float) -> np.ndarray:
    """Return the distances (N, 2) from each point to an edge after it and before it along its profile.

    A blur with standard deviation s leaves the fraction Phi(d / s) of the brightness at a distance d within the edge.
    The distance is half a spacing if brightness or blur is unknown, or if the result exceeds one spacing.
    """
    result = np.full((len(members), 2), 0.5 * spacing)
    bright = cloud.intensity[members].astype(float)
    size = project_footprint(cloud, members, np.broadcast_to(face.axes[:2], (len(members), 2, 3)))[0]
    along = np.diff(cloud.points_mm[members] @ face.axes[:2].T, axis=0)[np.diff(row) == 0]
    axis = int(np.argmax(np.median(np.abs(along), axis=0)))
    blur = size[:, axis]
    if not (np.isfinite(bright).all() and (blur > 0).all()):
        return result
    for side, sign in ((0, -1), (1, 1)):
        inner = np.stack([np.clip(np.arange(len(members)) + sign * k, 0, len(members) - 1) for k in _Rule.plain_lines])
        known = (row[inner] == row).all(axis=0)
        share = bright / np.maximum(np.median(bright[inner], axis=0), 1e-9)
        within = blur * norm.ppf(np.clip(share, 0.02, 0.98))
        usable = known & (within < spacing)
        result[usable, side] = within[usable]
    return result


def _fit_hole(edges: _Edges) -> _Hole:
    """Fit a round hole to its edge by least squares.

    EvaluationError if the edge is not round, or too little of the edge is known.
    """
    if len(edges.places) < _Rule.fewest_edges:
        raise EvaluationError(f"its edge has {len(edges.places)} points, at least {_Rule.fewest_edges} are needed")
    circle = Circle.fit(edges.places)
    middle, radius = circle.centre_mm, circle.radius_mm
    offset = edges.places - middle
    distance = np.linalg.norm(offset, axis=1)
    left = distance - radius
    angle = np.sort(np.degrees(np.arctan2(offset[:, 1], offset[:, 0])))
    seen = 360 - float(np.max(np.diff(np.append(angle, angle[0] + 360))))
    scatter = float(np.sqrt(np.sum(left**2) / (len(left) - 3)))
    if scatter > (limit := max(_Rule.roundness * radius, 1.5 * edges.spacing)):
        raise EvaluationError(
            f"it is not round: its edge scatters about a circle by {scatter:.2g} mm, more than {limit:.2g} mm"
        )
    if seen < _Rule.hole_arc_deg:
        raise EvaluationError(f"the cloud shows {seen:.0f} deg of its edge; {_Rule.hole_arc_deg:.0f} deg are needed")
    rows = np.linalg.pinv(np.column_stack([offset / distance[:, None], np.ones(len(left))]))
    random = max(scatter, edges.spacing * _Rule.edge_std) ** 2 * rows @ rows.T
    moved = None
    if edges.patterns is not None:
        moved = np.einsum("mej,ej->me", edges.patterns, offset / distance[:, None]) @ rows.T
    return _Hole(middle, radius, random, moved, edges.points, _Rule.edge_blur * edges.spacing)


def _make_diameter(kind: FeatureKind, name: str, hole: _Hole) -> FeatureValue:
    # Blur shifts both ends of a diameter in opposite directions, even if the cloud does not state it.
    shared = 0.0 if hole.moved is None else float(np.linalg.norm(hole.moved[:, 2]))
    common = 2 * float(np.hypot(shared, hole.blur_mm))
    return plain_value(kind, name, 2 * hole.radius_mm, 2 * float(np.sqrt(hole.random[2, 2])), common)


def _measure_bolt_circle(bolts: list[_Hole]) -> tuple[FeatureValue, list[float]]:
    """Return the bolt circle's diameter, and each hole's distance from its place on an even division."""
    middles = np.array([hole.middle for hole in bolts])
    circle = Circle.fit(middles)
    centre, radius = circle.centre_mm, circle.radius_mm
    offset = middles - centre
    units = offset / np.linalg.norm(offset, axis=1, keepdims=True)
    rows = np.linalg.pinv(np.column_stack([units, np.ones(len(bolts))]))
    std = np.array([np.sqrt(u @ hole.random[:2, :2] @ u) for u, hole in zip(units, bolts, strict=True)])
    random, common = 2 * float(np.sqrt(np.sum((rows[2] * std) ** 2))), None
    moves = [hole.moved for hole in bolts if hole.moved is not None]
    if len(moves) == len(bolts):
        along = np.array([move[:, :2] @ u for move, u in zip(moves, units, strict=True)])
        common = 2 * float(np.linalg.norm(rows[2] @ along))
    value = plain_value(FeatureKind.FLANGE, "bolt circle", 2 * radius, random, common)
    angle = np.arctan2(offset[:, 1], offset[:, 0])
    # Holes may be missing: the smallest angle between two holes gives the division.
    between = np.diff(np.sort(np.append(angle, angle.min() + 2 * np.pi)))
    count = max(len(bolts), round(2 * np.pi / float(np.min(between))))
    phase = np.angle(np.mean(np.exp(1j * count * angle))) / count
    nearest = phase + 2 * np.pi / count * np.round((angle - phase) * count / (2 * np.pi))
    even = centre + radius * np.column_stack([np.cos(nearest), np.sin(nearest)])
    return value, np.linalg.norm(middles - even, axis=1).tolist()


def _make_hole_feature(face: _Face, hole: _Hole, number: int, offset: float) -> Feature:
    values = [_make_diameter(FeatureKind.HOLE, "diameter", hole)]
    if np.isfinite(offset):
        random = float(np.sqrt(np.trace(hole.random[:2, :2]) / 2))
        common = None if hole.moved is None else float(np.sqrt(np.mean(np.sum(hole.moved[:, :2] ** 2, axis=0))))
        values.append(plain_value(FeatureKind.HOLE, "position", offset, random, common, least=0.0))
    place = face.point_mm + hole.middle @ face.axes[:2]
    extent = np.array([2 * hole.radius_mm, 2 * hole.radius_mm, 0.0])
    return Feature(FeatureKind.HOLE, f"hole {number}", tuple(values), place, face.axes, extent, hole.points)


def _measure_parallelism(cloud: PointCloud, face: _Face, used: np.ndarray, datum: PointCloud) -> FeatureValue:
    """Return the angle to the largest face of another cloud, whose calibration is taken as independent."""
    on_datum = _find_largest_face(datum.points_mm)[1]
    other = _fit_face(datum, on_datum)
    facing = 1.0 if face.axes[2] @ other.axes[2] > 0 else -1.0
    slopes = facing * face.axes[:2] @ other.axes[2]
    random, common = np.zeros((2, 2)), None
    for scan, plane, chosen in ((cloud, face, used), (datum, other, on_datum)):
        errors: PointErrors = PointErrors.along_normals(scan, chosen, np.broadcast_to(plane.axes[2], (len(chosen), 3)))
        rows = (face.axes[:2] @ plane.axes[:2].T) @ plane.rows[1:]
        by_noise, by_common = errors.covariances(rows, plane.residuals_mm, group_neighbours(len(chosen)))
        random = random + by_noise
        if by_common is not None:
            common = by_common if common is None else common + by_common
    return _make_angle(FeatureKind.FLANGE, slopes, (random, common))


def _measure_flush(cloud: PointCloud, face: _Face, plates: list[np.ndarray], middle: np.ndarray) -> FeatureValue:
    """Return the offset of two plates along the normal at a place between them."""
    if min(map(len, plates)) < _Rule.fewest_points:
        raise EvaluationError(f"the smaller plate has {min(map(len, plates))} points; {_Rule.fewest_points} are needed")
    parts = []
    for sign, chosen in zip((-1.0, 1.0), plates, strict=True):
        local = (cloud.points_mm[chosen] - face.point_mm) @ face.axes.T
        off = local[:, 2] - np.median(local[:, 2])
        near = np.abs(off) < _Rule.off_face * max(robust_std(off), 1e-9)
        chosen, local = chosen[near], local[near]
        design = np.column_stack([np.ones(len(local)), local[:, :2] - middle])
        rows = np.linalg.solve(design.T @ design, design.T)
        parts.append((sign * rows[0], chosen, local[:, 2] - design @ (rows @ local[:, 2])))
    weights, both, residuals = (np.concatenate(each) for each in zip(*parts, strict=True))
    offset = float(weights @ ((cloud.points_mm[both] - face.point_mm) @ face.axes[2]))
    errors = PointErrors.along_normals(cloud, both, np.broadcast_to(face.axes[2], (len(both), 3)))
    known = errors.covariances(weights[None], residuals, group_neighbours(len(both)))
    return linear_value(FeatureKind.GAP, "flush", abs(offset), known, np.ones(1), least=0.0)
