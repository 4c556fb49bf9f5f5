"""Girth and seam welds of a pipe: beads around it or along it, found by their length and measured as welds.

Heights above the pipe's form are averaged in cells: narrow across the weld, long along it. A bead is higher than its
surroundings in nearly all cells along it, which no blemish is.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import ndimage

from uwlts.fitting.least_squares import fit_biweight, robust_std
from uwlts.fitting.propagation import PointErrors
from uwlts.inspection.features import Feature, FeatureKind
from uwlts.inspection.pipe_form import PipeForm
from uwlts.inspection.weld import build_bead, measure_bead
from uwlts.storage.cloud import PointCloud


class _Rule:
    """Numbers of the search for welds of a pipe."""

    lengths: int = 36
    """Cells along a weld. A blemish covers a few of them."""
    share: float = 0.8  # part of the cells along a weld that are higher than their surroundings
    spacings: float = 2.0  # width of a cell, in point spacings
    baseline: float = 0.4
    """Width of the median that gives the height beside a weld, as a fraction of the pipe's extent across the weld."""
    significant: float = 3.0  # least height of a weld in its cells, in standard deviations of a cell
    lean: float = 0.06
    """Largest inclination of a girth weld's plane, as the change of its place divided by the diameter: a cut of 3
    deg, with a margin for the error of the place."""
    toes: float = 1.7
    """Half width of the region that belongs to a weld, divided by that of its bead: it contains the undercuts."""


@dataclass(frozen=True, eq=False)
class PipeWeld:
    """Weld of a pipe with N points."""

    is_girth: bool  # True around the pipe, False along it
    # (N,); places of the points across the weld, from its middle, and along it.
    across_mm: np.ndarray
    along_mm: np.ndarray
    half_mm: float  # approximate half width of the bead

    @property
    def covers(self) -> np.ndarray:
        """Mask (N,) of the points on the bead and its toes."""
        return np.abs(self.across_mm) < _Rule.toes * self.half_mm


def find_welds(form: PipeForm, chosen: np.ndarray) -> list[PipeWeld]:
    """Find the welds around a pipe and along it, among its ``chosen`` (M,) points. NaN places for all others."""
    along, angle, heights = form.along_mm[chosen], form.angle[chosen], form.distance_mm[chosen]
    spacing = float(np.sqrt(np.ptp(along) * form.arc * form.radius_mm / len(chosen)))
    straight = along - _fit_lean(along, angle, heights, form.radius_mm, _Rule.spacings * spacing)
    whole, found = np.full(len(form.angle), np.nan), []

    def add(is_girth: bool, across: np.ndarray, length: np.ndarray, ridges: list[tuple[float, float]]) -> None:
        for middle, half in ridges:
            # Cells are coarse: the points of the bead give its middle, and the rest of its inclination.
            terms = [np.ones(len(across)), *([np.cos(angle), np.sin(angle)] if is_girth else [])]
            design, members = np.stack(terms, axis=1), np.abs(across - middle) < half
            weights = np.sqrt(np.maximum(heights[members], 0))
            fit = np.linalg.lstsq(design[members] * weights[:, None], across[members] * weights, rcond=None)[0]
            off, at = whole.copy(), whole.copy()
            off[chosen], at[chosen] = across - design @ fit, length
            found.append(PipeWeld(is_girth, off, at, half))

    around = form.radius_mm * angle
    add(True, straight, around, _find_ridges(straight, around, heights, _Rule.spacings * spacing))
    for turn in (0.0, np.pi):
        # The pipe is cut at two places. Ridges in the half far from the cut are taken.
        around = form.radius_mm * (np.mod(angle - turn + np.pi, 2 * np.pi) - np.pi)
        ridges = _find_ridges(around, along, heights, _Rule.spacings * spacing)
        quarter = 0.5 * np.pi * form.radius_mm
        add(False, around, along, [each for each in ridges if -quarter <= each[0] < quarter])
    return found


def measure_weld(cloud: PointCloud, form: PipeForm, weld: PipeWeld, name: str) -> Feature:
    """Measure a weld of a pipe; EvaluationError if it does not show the surface on both sides of the bead."""
    local = np.column_stack([weld.along_mm, weld.across_mm, form.distance_mm])
    on_bead = np.flatnonzero(np.abs(weld.across_mm) < weld.half_mm)
    axis, out = form.frame.axes[2], form.outwards
    angle = np.angle(np.mean(np.exp(1j * form.angle[on_bead])))
    nearest = on_bead[np.argmin(np.abs(np.angle(np.exp(1j * (form.angle[on_bead] - angle)))))]
    # An inclined girth weld is elsewhere at each angle: its middle is taken at this one.
    along = form.along_mm[nearest] - weld.across_mm[nearest] if weld.is_girth else np.median(form.along_mm[on_bead])
    middle = form.points_at(np.array([along]), np.array([angle]))[0]
    around = np.cross(axis, out)
    tangents = np.stack([around, np.broadcast_to(axis, out.shape)], axis=1)
    if not weld.is_girth:
        tangents = np.stack([tangents[:, 1], -around], axis=1)
        local[:, 1] *= -1
    axes = np.array([*tangents[nearest], out[nearest]])
    bead = build_bead(cloud, local, tangents, half_mm=weld.half_mm)
    values, extent, _ = measure_bead(bead, PointErrors.along_normals(cloud, bead.chosen, out[bead.chosen]))
    return Feature(FeatureKind.WELD, name, values, middle, axes, extent, bead.chosen[bead.on_bead])


def _average_cells(
    across: np.ndarray, length: np.ndarray, heights: np.ndarray, cell: float
) -> tuple[np.ndarray, float, np.ndarray]:
    """Return mean heights (A, L) of cells above their surroundings, NaN without points; their origin, and L edges."""
    origin, count = float(across.min()), int(np.ptp(across) / cell) + 1
    edges = np.linspace(length.min(), length.max(), _Rule.lengths + 1)
    at = ((across - origin) / cell).astype(int), np.clip(np.searchsorted(edges, length) - 1, 0, _Rule.lengths - 1)
    flat, shape = np.ravel_multi_index(at, (count, _Rule.lengths)), (count, _Rule.lengths)
    number = np.bincount(flat, minlength=count * _Rule.lengths).reshape(shape)
    total = np.bincount(flat, heights, count * _Rule.lengths).reshape(shape)
    mean = np.where(number > 0, total / np.maximum(number, 1), np.nan)
    filled, window = np.where(np.isfinite(mean), mean, 0.0), 2 * int(0.5 * _Rule.baseline * count) + 1
    # SciPy moves the window of a single line by its sorted values, almost independent of its width.
    mean -= np.column_stack([ndimage.median_filter(line, window, mode="nearest") for line in filled.T])
    return mean, origin, edges


def _find_ridges(across: np.ndarray, length: np.ndarray, heights: np.ndarray, cell: float) -> list[tuple[float, float]]:
    """Return the middles and half widths, mm, of ridges over the whole length."""
    mean, origin, _ = _average_cells(across, length, heights, cell)
    std = robust_std(mean[np.isfinite(mean)])
    seen = np.isfinite(mean).sum(axis=1)
    least = np.full(len(mean), -np.inf)
    wide = seen > 0.5 * np.median(seen)
    least[wide] = np.nanquantile(mean[wide], 1 - _Rule.share, axis=1)
    labelled: Any = ndimage.label(least > _Rule.significant * std)
    found = []
    for number in range(1, labelled[1] + 1):
        members = np.flatnonzero(labelled[0] == number)
        crest = np.nanmedian(mean[members], axis=1)
        core = members[crest > 0.5 * crest.max()]
        # A parabola is 1.4 times as wide at its foot as at half its height, and cells widen it at most by one.
        half = 0.5 * cell * max(1.4 * (np.ptp(core) + 1), len(members))
        middle = origin + cell * (float(np.average(core, weights=np.nanmedian(mean[core], axis=1))) + 0.5)
        if members[0] > 0 and members[-1] < len(mean) - 1:
            found.append((middle, half))
    return found


def _fit_lean(along: np.ndarray, angle: np.ndarray, heights: np.ndarray, radius: float, cell: float) -> np.ndarray:
    """Return the change of the places (M,) of a girth weld by an inclination of its plane; zero without one."""
    mean, origin, edges = _average_cells(along, radius * angle, heights, cell)
    std = robust_std(mean[np.isfinite(mean)])
    known = np.isfinite(mean).any(axis=0)
    top = np.nan_to_num(mean, nan=-np.inf)
    place = origin + cell * (np.argmax(top, axis=0) + 0.5)
    counted = known & (top.max(axis=0) > _Rule.significant * std)
    if np.count_nonzero(counted) < _Rule.share * np.count_nonzero(known):
        return np.zeros(len(along))
    turn = 0.5 * (edges[1:] + edges[:-1]) / radius
    design = np.column_stack([np.ones(len(turn)), np.cos(turn), np.sin(turn)])
    rows, weights = fit_biweight(design, place, counted)
    level, *lean = rows @ place
    agree = counted & (np.abs(place - design @ np.array([level, *lean])) < 2 * cell) & (weights > 0)
    if np.hypot(*lean) > _Rule.lean * radius or np.count_nonzero(agree) < _Rule.share * np.count_nonzero(known):
        return np.zeros(len(along))
    return lean[0] * np.cos(angle) + lean[1] * np.sin(angle)
