"""Texture of the circle plate, evaluated exactly instead of from a bitmap whose texels would blur the rims."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from twin.scene import CirclePlate


def register_circle_pattern() -> None:
    """Make the texture ``circle_pattern`` known to the selected Mitsuba variant."""

    class CirclePattern(mi.Texture):
        """Reflectance of a `CirclePlate` on a rectangle whose uv run from 0 to 1 over width and height."""

        def __init__(self, props: mi.Properties):
            mi.Texture.__init__(self, props)
            self.plate = CirclePlate.model_validate_json(props["plate"])

        def eval(self, si: mi.SurfaceInteraction3f, active: mi.Bool = True) -> mi.Float:
            return self.eval_1(si, active)

        def eval_1(self, si: mi.SurfaceInteraction3f, active: mi.Bool = True) -> mi.Float:
            plate = self.plate
            x, y = (si.uv.x - 0.5) * plate.width_mm, (0.5 - si.uv.y) * plate.height_mm
            i, j = dr.round(x / plate.spacing_x_mm), dr.round(y / plate.spacing_y_mm)
            radius = dr.norm(mi.Vector2f(x - i * plate.spacing_x_mm, y - j * plate.spacing_y_mm))
            column, row = i + plate.origin[0], j + plate.origin[1]
            in_lattice = (column >= 0) & (column < plate.columns) & (row >= 0) & (row < plate.rows)
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
