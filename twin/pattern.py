"""Texture of the circle plate, evaluated exactly instead of from a bitmap whose texels would blur the rims."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from twin.arrays import to_jit
from twin.scene import CirclePlate

_SHIFT = "circle_shift_mm"


def register_circle_pattern() -> None:
    """Make the texture ``circle_pattern`` known to the selected Mitsuba variant."""

    class CirclePattern(mi.Texture):
        """Reflectance of a `CirclePlate` on a rectangle whose uv run from 0 to 1 over width and height."""

        def __init__(self, props: mi.Properties):
            mi.Texture.__init__(self, props)
            self.plate = CirclePlate.model_validate_json(props["plate"])
            self.shift_mm = to_jit(mi.Float, printed_shifts(self.plate).ravel())

        def traverse(self, callback: mi.TraversalCallback) -> None:
            callback.put(_SHIFT, self.shift_mm, mi.ParamFlags.NonDifferentiable)

        def parameters_changed(self, keys: list[str]) -> None:
            pass

        def eval(self, si: mi.SurfaceInteraction3f, active: mi.Bool = True) -> mi.Float:
            return self.eval_1(si, active)

        def eval_1(self, si: mi.SurfaceInteraction3f, active: mi.Bool = True) -> mi.Float:
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

        def mean(self) -> mi.Float:
            return mi.Float(self.plate.reflectance)

        def is_spatially_varying(self) -> bool:
            return True

        def to_string(self) -> str:
            return f"CirclePattern[{self.plate.columns} x {self.plate.rows}]"

    mi.register_texture("circle_pattern", CirclePattern)


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
