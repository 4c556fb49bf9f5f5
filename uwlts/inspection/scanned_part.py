"""Search for the straight pipe in a cloud before its inspection, and for other bodies or parts.

Distances from the fitted form are summarised in cells along and around the pipe. Cells that rise to another body
(branch, flange, clamp) and cells covered by material (growth, coating) are left out and named. A bend, a cone, or a
part with little surface on one pipe is refused by name.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import ndimage
from scipy.optimize import least_squares
from scipy.spatial import KDTree

from uwlts.errors import EvaluationError
from uwlts.fitting.least_squares import MAD_TO_STD, robust_std, thin_evenly
from uwlts.inspection.pipe_form import FORM_RULE, PipeForm, fit_pipe, refit_pipe
from uwlts.shapes.cylinder import Cylinder, local_normals
from uwlts.shapes.flat import Circle
from uwlts.storage.cloud import PointCloud


class _Rule:
    """Numbers that separate straight pipes from other parts.

    Chosen by hand on the parts of tests/oracles/joined_pipes.py with seeds 0 to 11, judged on seeds 100 to 119.
    """

    points_in_cell: float = 12.0  # points of a cell on average: their median is known to a third of the noise
    most_cells: int = 160  # most cells along the pipe and around it
    quiet: float = 0.2
    """Quantile of the scatter in cells that is the noise: cells of rough growth scatter more."""
    risen: float = 4.0  # height of a cell, in noise, up to which a second body extends
    departs: float = 0.005  # least distance of a cell, divided by the radius, that counts against the form
    seed_share: float = 0.2  # least fraction of the points of a cell beyond `off_pipe` that shows a second body
    fewest_cells: int = 2  # fewest cells of a second body; single ones may be outliers
    covered: float = 0.1  # least share of risen cells that is growth or a coating, no protrusion
    least_bare: float = 0.4  # least share of the cells that must lie on the pipe
    rounds: int = 8  # most fits to the lower envelope
    bend_points: int = 3000  # points that determine a bend, or the cylinder of a part
    starts: int = 12  # parts whose cylinders are tried
    part: int = 6  # share of the points in a part, as a divisor
    refits: int = 2  # fits of such a cylinder to all points near it
    bend_scatter: float = 0.02  # largest scatter about a bend, divided by the radius
    better: float = 0.6  # scatter about a bend, divided by that about the straight form, below which it is bent
    least_bow: float = 0.02  # least sagitta of a bend, divided by the radius; the form of a pipe contains smaller ones
    cone: float = 0.06  # change of the radius over the length, divided by the radius, from which a pipe is a cone
    coarse: float = 0.35  # distance of neighbouring points, divided by the radius, that does not show a pipe


def find_straight_pipe(cloud: PointCloud, *, largest_ovality: float) -> tuple[PipeForm, np.ndarray, tuple[str, ...]]:
    """Find the straight pipe in a cloud and what else is there.

    Returns its form, a mask (N,) of points of other bodies and of covered regions, and notes on these.

    Raises EvaluationError with the name of the part if it is no straight pipe, or if its bare surface is not seen
    sufficiently.
    """
    form, scatter = _fit_straight(cloud, largest_ovality)
    _refuse_bend(cloud, scatter)
    if isinstance(form, EvaluationError):
        raise form
    _refuse_coarse(cloud, form)
    cells, left_out = _Cells.of(form), np.zeros(len(cloud), bool)
    if np.mean(cells.departing[cells.seen]) > _Rule.covered:
        form, cells = _fit_envelope(cloud, form, cells)
    bodies = cells.find_bodies()
    notes = [cells.describe(form, region) for region in bodies]
    beside = np.any(bodies, axis=0) if bodies else np.zeros_like(cells.seen)
    rest = cells.seen & ~beside
    risen = rest & cells.departing & (cells.height > 0)
    if np.count_nonzero(risen) > _Rule.covered * np.count_nonzero(rest):
        risen = cells.grow(risen)
        covered = np.count_nonzero(risen & cells.seen) / np.count_nonzero(cells.seen)
        high = float(np.nanquantile(cells.height[risen & cells.seen], 0.95))
        notes.append(
            f"{100 * covered:.0f} % of the seen surface is covered by material up to {high:.2g} mm high, such as "
            "growth: it is not inspected, and depths refer to the bare surface"
        )
        beside |= risen
    _refuse_other(form, cells, beside)
    if notes:
        left_out = cells.points_in(beside)
        form = refit_pipe(cloud, form, left_out=left_out)
    return form, left_out, tuple(notes)


@dataclass(frozen=True, eq=False)
class _Cells:
    """Summary of the distances from a form in A cells along by B around; NaN heights in empty cells."""

    flat: np.ndarray  # (N,) int; cell of each point
    height: np.ndarray  # (A, B); median distances
    high: np.ndarray  # (A, B) bool; cells with points of a body outside the pipe
    departing: np.ndarray  # (A, B) bool; cells off the form
    noise: float  # scatter of the points
    distance: np.ndarray  # (N,)

    @classmethod
    def of(cls, form: PipeForm) -> _Cells:
        along, distance, radius = form.along_mm, form.distance_mm, form.radius_mm
        near = np.abs(distance) < FORM_RULE.off_pipe * radius
        area = np.ptp(along) * form.arc * radius
        side = np.sqrt(_Rule.points_in_cell * area / max(np.count_nonzero(near), 1))
        shape = [int(np.clip(n / side, 4, _Rule.most_cells)) for n in (np.ptp(along), 2 * np.pi * radius)]
        place = (along - along.min()) / max(np.ptp(along), 1e-9), np.mod(form.angle / (2 * np.pi), 1)
        at = [np.minimum((n * p).astype(int), n - 1) for n, p in zip(shape, place, strict=True)]
        flat = at[0] * shape[1] + at[1]
        count = np.bincount(flat, minlength=shape[0] * shape[1])
        median = _compute_cell_medians(flat, distance, count)
        scatter = MAD_TO_STD * _compute_cell_medians(flat, np.abs(distance - median[flat]), count)
        full = count >= 0.5 * _Rule.points_in_cell
        noise = float(np.quantile(scatter[full], _Rule.quiet)) if full.any() else robust_std(distance)
        beyond = np.bincount(flat, distance > FORM_RULE.off_pipe * radius, len(count))
        high = (beyond >= 3) & (beyond >= _Rule.seed_share * count)
        off = np.abs(median) > max(_Rule.risen * noise, _Rule.departs * radius)
        height, high, off = (each.reshape(shape) for each in (median, high, off))
        return cls(flat, height, high, off, noise, distance)

    @property
    def seen(self) -> np.ndarray:
        """Cells (A, B) with points."""
        return np.isfinite(self.height)

    def grow(self, cells: np.ndarray) -> np.ndarray:
        """Return cells (A, B) grown by their neighbours, also across the cut."""
        wide = np.pad(cells, ((1, 1), (1, 1)), mode="wrap")
        wide[0], wide[-1] = False, False
        return np.asarray(ndimage.binary_dilation(wide, structure=np.ones((3, 3))))[1:-1, 1:-1]

    def find_bodies(self) -> list[np.ndarray]:
        """Return masks (A, B) of the bodies outside the pipe, with the cells that rise to them."""
        # Between the lines of a coarse scan cells may be empty.
        risen = self.high | (self.seen & (self.height > _Rule.risen * self.noise))
        found = []
        for region in _label_around(self.grow(risen)):
            if np.count_nonzero(region & self.high) >= _Rule.fewest_cells:
                found.append(region)
        return found

    def points_in(self, cells: np.ndarray) -> np.ndarray:
        """Return the mask (N,) of the points in cells (A, B)."""
        return cells.ravel()[self.flat]

    def describe(self, form: PipeForm, region: np.ndarray) -> str:
        """Describe the place and the size of a second body."""
        members = self.points_in(region & self.seen)
        high = self.distance[members & (self.distance > FORM_RULE.off_pipe * form.radius_mm)]
        rows = np.flatnonzero(region.any(axis=1))
        around = 360 * np.count_nonzero(region.any(axis=0)) / region.shape[1]
        along = (rows[-1] - rows[0] + 1) * np.ptp(form.along_mm) / region.shape[0]
        angle = float(np.angle(np.mean(np.exp(1j * form.angle[members]))))
        x, y, z = form.points_at(np.array([np.median(form.along_mm[members])]), np.array([angle]))[0]
        return (
            f"a second body joins the pipe at ({x:.1f}, {y:.1f}, {z:.1f}) mm and rises {high.max():.3g} mm from it: "
            f"its region, {along:.3g} mm along the pipe and {around:.0f} deg around it, is not inspected"
        )


def _compute_cell_medians(flat: np.ndarray, values: np.ndarray, count: np.ndarray) -> np.ndarray:
    """Return the median of the values (N,) in each cell; NaN in empty cells."""
    order = np.lexsort((values, flat))
    start, result = np.cumsum(count) - count, np.full(len(count), np.nan)
    full = count > 0
    result[full] = values[order[(start + count // 2)[full]]]
    return result


def _label_around(cells: np.ndarray) -> list[np.ndarray]:
    """Return the masks (A, B) of connected cells; the first and last columns are neighbours."""
    labelled: Any = ndimage.label(cells, structure=np.ones((3, 3)))
    labels = labelled[0]
    for a, b in zip(labels[:, 0], labels[:, -1], strict=True):
        if a and b and a != b:
            labels[labels == b] = a
    return [labels == number for number in np.unique(labels[labels > 0])]


def _fit_envelope(cloud: PointCloud, form: PipeForm, cells: _Cells) -> tuple[PipeForm, _Cells]:
    """Fit the form to the lower envelope of its points; return the first form if the envelope is on no pipe."""
    first = form, cells
    for _ in range(_Rule.rounds):
        left_out = form.distance_mm > _Rule.risen * cells.noise
        try:
            form = refit_pipe(cloud, form, left_out=left_out)
        except EvaluationError:
            return first
        cells = _Cells.of(form)
        if np.mean(left_out == (form.distance_mm > _Rule.risen * cells.noise)) > 1 - 1e-3:
            break
    # The lower one of two surfaces is the pipe only if no more cells lie below it than below the first form.
    below = [np.count_nonzero(each.departing & (each.height < 0)) for each in (first[1], cells)]
    return (form, cells) if below[1] <= below[0] else first


def _fit_straight(cloud: PointCloud, largest_ovality: float) -> tuple[PipeForm | EvaluationError, float]:
    """Return the form, or the reason why there is none, and the scatter about it (limited for a bend without one).

    If the points as a whole do not give a form, it starts from the cylinder of a part with which most points agree.
    """
    try:
        form = fit_pipe(cloud, largest_ovality=largest_ovality)
    except EvaluationError as error:
        start = _find_largest_cylinder(cloud.points_mm)
        if start is None:
            return error, np.inf
        try:
            form = fit_pipe(cloud, largest_ovality=largest_ovality, start=start)
        except EvaluationError:
            return error, robust_std(start.distances_mm(cloud.points_mm))
    return form, robust_std(form.distance_mm)


def _find_largest_cylinder(points: np.ndarray) -> Cylinder | None:
    """Return the cylinder of a part of the points (N, 3) with which most points agree; None without one."""
    thinned = thin_evenly(points, _Rule.bend_points)
    tree, best, most = KDTree(thinned), None, 0
    for seed in thin_evenly(np.random.default_rng(0).permutation(thinned), _Rule.starts):
        near: Any = tree.query(seed, k=max(len(thinned) // _Rule.part, 30))
        try:
            found = Cylinder.fit(thinned[near[1]])
            for _ in range(_Rule.refits):
                on = np.abs(found.distances_mm(thinned)) < FORM_RULE.off_pipe * found.radius_mm
                found = Cylinder.fit(thinned[on], axis_start=found.axis)
        except EvaluationError:
            continue
        on = np.count_nonzero(np.abs(found.distances_mm(thinned)) < 0.5 * FORM_RULE.off_pipe * found.radius_mm)
        if on > most:
            best, most = found, on
    return best


def _refuse_coarse(cloud: PointCloud, form: PipeForm) -> None:
    points = cloud.points_mm
    near: Any = KDTree(points).query(thin_evenly(points, _Rule.bend_points), k=4, workers=-1)
    spacing = float(np.median(near[0][:, 3]))
    if spacing > _Rule.coarse * form.radius_mm:
        raise EvaluationError(
            f"the cloud is too coarse for a pipe: {spacing:.3g} mm between its points, on a radius of about "
            f"{form.radius_mm:.3g} mm; at most {_Rule.coarse * form.radius_mm:.2g} mm are expected"
        )


def _refuse_other(form: PipeForm, cells: _Cells, beside: np.ndarray) -> None:
    """Raise EvaluationError for a cone, and for a part with little surface on one pipe."""
    taper = 2 * abs(float(form.coefficients[form.terms.index("along")]))
    if taper > _Rule.cone * form.radius_mm:
        raise EvaluationError(
            f"this is a cone, not a straight pipe: its radius of {form.radius_mm:.4g} mm changes by {taper:.3g} mm"
        )
    bare = np.count_nonzero(cells.seen & ~beside & ~cells.departing) / np.count_nonzero(cells.seen)
    if bare < _Rule.least_bare:
        limit = max(_Rule.risen * cells.noise, _Rule.departs * form.radius_mm)
        raise EvaluationError(
            f"only {100 * bare:.0f} % of the seen surface lies within {limit:.2g} mm of one straight pipe of "
            f"{2 * form.radius_mm:.4g} mm diameter; {100 * _Rule.least_bare:.0f} % are needed. It may be covered by "
            "growth, or be another part, such as a bend or a reducer: inspect its straight, bare parts"
        )


def _refuse_bend(cloud: PointCloud, straight: float) -> None:
    """Raise EvaluationError if a bend (torus) has much less scatter than the ``straight`` form."""
    points = thin_evenly(cloud.points_mm, _Rule.bend_points)
    if (found := _fit_torus(points)) is None:
        return
    radius, tube, turn, scatter = found
    bow = radius * (1 - np.cos(min(turn, np.pi) / 2))
    # Spheres, cones and planes give tori that are none: their tubes are wide, or longer than the cloud.
    is_tube = tube < radius and radius * turn < 2 * float(np.linalg.norm(np.ptp(points, axis=0)))
    if is_tube and scatter < min(_Rule.better * straight, _Rule.bend_scatter * tube) and bow > _Rule.least_bow * tube:
        raise EvaluationError(
            f"this is a bend of radius about {radius:.3g} mm over {np.degrees(turn):.0f} deg, of a pipe of about "
            f"{2 * tube:.4g} mm diameter, not a straight pipe: inspect its straight parts, cut from the cloud"
        )


def _fit_torus(points: np.ndarray) -> tuple[float, float, float, float] | None:
    """Return bend radius, tube radius, turn (rad) and robust scatter of a torus fitted to points; None without one.

    The normals of a surface of revolution meet its axis. The axis is therefore the linear complex nearest to their
    lines (Pottmann and Wallner, Computational Line Geometry, 2001, section 4.1); all is refined by least squares.
    """
    middle = points.mean(axis=0)
    scale = float(np.sqrt(np.mean(np.sum((points - middle) ** 2, axis=1))))
    places = (points - middle) / scale
    normals = local_normals(places)
    lines = np.hstack([np.cross(places, normals), normals])
    best = None
    # A cylinder has two such complexes; the second one of a nearly straight bend may be its axis.
    for vector in np.linalg.eigh(lines.T @ lines)[1].T[:2]:
        direction = vector[:3] / max(float(np.linalg.norm(vector[:3])), 1e-9)
        point = np.cross(vector[:3], vector[3:]) / max(float(vector[:3] @ vector[:3]), 1e-9)
        if np.linalg.norm(point) < 100:
            found = _refine_torus(places, point, direction)
            best = found if best is None or found[3] < best[3] else best
    return None if best is None else (scale * best[0], scale * best[1], best[2], scale * best[3])


def _refine_torus(places: np.ndarray, point: np.ndarray, direction: np.ndarray) -> tuple[float, float, float, float]:
    """Return bend radius, tube radius, turn and scatter of a torus, refined from an approximate axis."""
    _, _, frame = np.linalg.svd(direction[None])
    across = frame[1:]

    def meridian(x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        axis = direction + x[2:4] @ across
        axis = axis / np.linalg.norm(axis)
        distance = places - point - x[:2] @ across
        height = distance @ axis
        return np.linalg.norm(distance - np.outer(height, axis), axis=1), height, distance

    out, height, _ = meridian(np.zeros(4))
    try:
        circle = Circle.fit(np.column_stack([out, height]))
        centre, tube = circle.centre_mm, circle.radius_mm
    except EvaluationError:
        centre, tube = np.array([np.median(out), np.median(height)]), float(np.ptp(height)) / 2
    start = np.array([0.0, 0.0, 0.0, 0.0, *centre, tube])

    def residuals(x: np.ndarray) -> np.ndarray:
        out, height, _ = meridian(x)
        return np.hypot(out - x[4], height - x[5]) - x[6]

    limit = max(robust_std(residuals(start)), 1e-6)
    x = np.asarray(least_squares(residuals, start, loss="soft_l1", f_scale=limit, max_nfev=60).x)
    for _ in range(2):
        limit = max(robust_std(residuals(x)), 1e-6)
        x = np.asarray(least_squares(residuals, x, loss="cauchy", f_scale=2 * limit, max_nfev=60).x)
    left = residuals(x)
    distance = meridian(x)[2][np.abs(left) < 5 * max(robust_std(left), 1e-9)]
    turned = np.arctan2(*(distance @ across.T).T)
    turned = np.angle(np.exp(1j * (turned - np.angle(np.mean(np.exp(1j * turned))))))
    return float(x[4]), float(x[6]), float(np.ptp(turned)), robust_std(left)
