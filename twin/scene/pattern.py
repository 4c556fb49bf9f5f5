"""Textures of calibration targets, evaluated exactly instead of from a bitmap whose texels would blur the edges."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, assert_never

import drjit as dr
import mitsuba as mi
import numpy as np

from twin.backend.arrays import Bool, Float, SurfaceInteraction3f, to_jit
from twin.scene.description import CirclePlate, TargetPlate

_SHIFT = "circle_shift_mm"
_CELLS_PER_PATCH = 4
"""Cells of the grid that lists the patches near a place: so many that most cells list at most three patches."""
_PATCH_VALUES = 6
"""Columns of the table of patches."""
_ROUNDING_MM = 1e-3
"""Places on a plate of 1 m are rounded by less than this in 32 bits."""


def pattern_texture(plate: CirclePlate | TargetPlate) -> dict[str, Any]:
    """Mitsuba's description of a plate's reflectance, for a variant with `register_patterns`."""
    match plate:
        case CirclePlate():
            kind = "circle_pattern"
        case TargetPlate():
            kind = "target_pattern"
        case _:
            assert_never(plate)
    return {"type": kind, "plate": plate.model_dump_json()}


def register_patterns() -> None:
    """Make the textures ``circle_pattern`` and ``target_pattern`` known to the selected Mitsuba variant."""

    class CirclePattern(mi.Texture):
        """Reflectance of a `CirclePlate` on a rectangle whose uv run from 0 to 1 over width and height."""

        def __init__(self, props: mi.Properties):
            mi.Texture.__init__(self, props)
            self.plate = CirclePlate.model_validate_json(str(props["plate"]))
            self.shift_mm = to_jit(mi.Float, printed_shifts(self.plate).ravel())

        def traverse(self, cb: mi.TraversalCallback) -> None:
            cb.put(_SHIFT, self.shift_mm, mi.ParamFlags.NonDifferentiable)

        def parameters_changed(self, keys: Sequence[str] = ()) -> None:
            pass

        def eval(self, si: SurfaceInteraction3f, active: Bool = True) -> Float:
            return self.eval_1(si, active)

        def eval_1(self, si: SurfaceInteraction3f, active: Bool = True) -> Float:
            plate = self.plate
            x, y = (si.uv.x - 0.5) * plate.width_mm, (0.5 - si.uv.y) * plate.height_mm
            i, j = dr.round(x / plate.spacing_x_mm), dr.round(y / plate.spacing_y_mm)
            column, row = i + plate.origin[0], j + plate.origin[1]
            in_lattice = (column >= 0) & (column < plate.columns) & (row >= 0) & (row < plate.rows)
            entry = mi.UInt32(dr.select(in_lattice, 2 * (row * plate.columns + column), 0.0))
            shift = [dr.gather(mi.Float, self.shift_mm, entry + k, active & in_lattice) for k in (0, 1)]
            radius = dr.norm(mi.Vector2f(x - i * plate.spacing_x_mm - shift[0], y - j * plate.spacing_y_mm - shift[1]))
            circle = in_lattice & (radius < plate.diameter_mm / 2)
            marked = (i == 0) & (j == 0)
            for di, dj in (plate.marker_x, plate.marker_y):
                marked |= (i == di) & (j == dj)
            value = dr.select(circle, plate.circle_reflectance, plate.reflectance)
            return dr.select(marked & (radius < plate.marker_diameter_mm / 2), plate.marker_reflectance, value)

        def mean(self) -> Float:
            return mi.Float(self.plate.reflectance)

        def is_spatially_varying(self) -> bool:
            return True

        def to_string(self) -> str:
            return f"CirclePattern[{self.plate.columns} x {self.plate.rows}]"

    class TargetPattern(mi.Texture):
        """Reflectance of a `TargetPlate` on a rectangle whose uv run from 0 to 1 over its bounds."""

        def __init__(self, props: mi.Properties):
            mi.Texture.__init__(self, props)
            self.plate = TargetPlate.model_validate_json(str(props["plate"]))
            first, last = self.plate.bounds_mm()
            self.middle, self.size = ((first + last) / 2).tolist(), (last - first).tolist()
            lists, self.cell_mm = _patches_by_cell(self.plate)
            self.rows, self.columns, self.depth = lists.shape
            self.first = first.tolist()
            self.lists = to_jit(mi.UInt32, lists.ravel())
            self.patches = to_jit(mi.Float, _patch_table(self.plate).ravel())

        def traverse(self, cb: mi.TraversalCallback) -> None:
            pass

        def eval(self, si: SurfaceInteraction3f, active: Bool = True) -> Float:
            return self.eval_1(si, active)

        def eval_1(self, si: SurfaceInteraction3f, active: Bool = True) -> Float:
            x = self.middle[0] + (si.uv.x - 0.5) * self.size[0]
            y = self.middle[1] + (0.5 - si.uv.y) * self.size[1]
            column = dr.clip(dr.floor((x - self.first[0]) / self.cell_mm), 0, self.columns - 1)
            row = dr.clip(dr.floor((y - self.first[1]) / self.cell_mm), 0, self.rows - 1)
            start = mi.UInt32((row * self.columns + column) * self.depth)
            value = mi.Float(self.plate.reflectance)
            for k in range(self.depth):
                entry = dr.gather(mi.UInt32, self.lists, start + k, active) * _PATCH_VALUES
                x_min, y_min, x_max, y_max, rounded, reflectance = (
                    dr.gather(mi.Float, self.patches, entry + i, active) for i in range(_PATCH_VALUES)
                )
                # From -1 to 1 over a patch.
                u, v = (2 * x - x_min - x_max) / (x_max - x_min), (2 * y - y_min - y_max) / (y_max - y_min)
                in_box = (x >= x_min) & (x <= x_max) & (y >= y_min) & (y <= y_max)
                inside = in_box & ((rounded == 0) | (u * u + v * v < 1))
                value = dr.select(inside, reflectance, value)
            return value

        def mean(self) -> Float:
            return mi.Float(self.plate.reflectance)

        def is_spatially_varying(self) -> bool:
            return True

        def to_string(self) -> str:
            return f"TargetPattern[{type(self.plate.target).__name__}]"

    mi.register_texture("circle_pattern", CirclePattern)
    mi.register_texture("target_pattern", TargetPattern)


def _patch_table(plate: TargetPlate) -> np.ndarray:
    """Box in mm, roundness and reflectance (N + 1, 6) of each patch of a plate; the last one is never hit."""
    rows = [
        (p.x_min_mm, p.y_min_mm, p.x_max_mm, p.y_max_mm, p.round, plate.ink_reflectance if p.ink else plate.reflectance)
        for p in plate.target.patches()
    ]
    return np.array([*rows, (1.0, 1.0, 0.0, 0.0, 0.0, 0.0)], float)


def _patches_by_cell(plate: TargetPlate) -> tuple[np.ndarray, float]:
    """Numbers (rows, columns, depth) of the patches that reach into each cell of a grid, and the cells' side in mm.

    They are in the order of printing; lists are filled up with the patch that is never hit.
    """
    first, last = plate.bounds_mm()
    boxes = _patch_table(plate)[:-1, :4]
    cell_mm = float(np.sqrt(np.prod(last - first) / (_CELLS_PER_PATCH * len(boxes))))
    columns, rows = np.ceil((last - first) / cell_mm).astype(int).tolist()
    start = np.floor((boxes[:, :2] - first - _ROUNDING_MM) / cell_mm).astype(int).clip(min=0)
    stop = np.floor((boxes[:, 2:] - first + _ROUNDING_MM) / cell_mm).astype(int) + 1
    count = np.zeros((rows, columns), int)
    for (i, j), (k, m) in zip(start, stop, strict=True):
        count[j:m, i:k] += 1
    lists = np.full((rows, columns, count.max()), len(boxes))
    count[:] = 0
    for number, ((i, j), (k, m)) in enumerate(zip(start, stop, strict=True)):
        y, x = np.mgrid[j : min(m, rows), i : min(k, columns)]
        lists[y, x, count[y, x]] = number
        count[y, x] += 1
    return lists, cell_mm


def printed_shifts(plate: CirclePlate) -> np.ndarray:
    """Offsets (rows, columns, 2) in mm of a plate's circles from their lattice, along x and y."""
    rng = np.random.default_rng([plate.errors_seed, 0])
    return plate.centre_std_mm * rng.standard_normal((plate.rows, plate.columns, 2))


def shift_circles(scene: mi.Scene, plate: CirclePlate, *, mm_per_px: float, image: int) -> None:
    """Move the circles of a scene's only plate to where they lie in one image, detection errors included."""
    rng = np.random.default_rng([plate.errors_seed, 1, image])
    noise = mm_per_px * plate.detection_std_px * rng.standard_normal((plate.rows, plate.columns, 2))
    parameters = mi.traverse(scene)
    (key,) = (key for key in dict(parameters) if key.endswith(_SHIFT))
    parameters[key] = to_jit(mi.Float, (printed_shifts(plate) + noise).ravel())
    parameters.update()
