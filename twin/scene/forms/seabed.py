"""A patch of the sea floor: rippled, rough sediment with stones half buried in it."""

from typing import Annotated, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from twin.scene.forms.triangles import grid_faces, require_few, step_of, waves
from twin.scene.placed import FreeForm
from uwlts.model.sensor import NotNegative, Positive

_SAG_MM = 0.02
"""Largest distance of the facets from the surface; at the foot of stones ten times that."""
_SHORTEST, _LONGEST = 0.2, 1.0
"""Wavelengths of the roughness over the ripples' pitch."""


class Seabed(FreeForm):
    """Sediment in its own x-y plane about its own origin, facing -z (towards the sensor).

    Ripples run along y, with ``ripple_pitch_mm`` from crest to crest along x and ``ripple_height_mm`` from trough to
    crest; the surface between is uneven by up to ``roughness_mm``. ``stones`` of ``stone_diameter_mm`` lie half buried,
    at places that ``seed`` chooses (`seabed_height`).
    """

    kind: Literal["seabed"]
    width_mm: Positive = 200.0
    height_mm: Positive = 200.0
    ripple_pitch_mm: Positive = 60.0
    ripple_height_mm: NotNegative = 6.0
    roughness_mm: NotNegative = 1.0
    stones: Annotated[int, Field(ge=0, le=1000)] = 6
    stone_diameter_mm: Positive = 15.0
    seed: Annotated[int, Field(ge=0)] = 0

    @model_validator(mode="after")
    def _stones_fit(self) -> Self:
        if self.stone_diameter_mm > min(self.width_mm, self.height_mm):
            raise ValueError(
                f"stone_diameter_mm {self.stone_diameter_mm:g} is more than width_mm {self.width_mm:g} or height_mm "
                f"{self.height_mm:g}"
            )
        return self

    def stone_places(self) -> np.ndarray:
        """Middles (stones, 2) of the stones in the x-y plane, in mm."""
        most = 0.5 * (np.array([self.width_mm, self.height_mm]) - self.stone_diameter_mm)
        return np.random.default_rng([self.seed, 1]).uniform(-1, 1, (self.stones, 2)) * most

    def triangles(self) -> tuple[np.ndarray, np.ndarray]:
        """An open surface whose facets deviate by `_SAG_MM`, more at the foot of stones."""
        k = 2 * np.pi / self.ripple_pitch_mm
        curvature = 0.5 * self.ripple_height_mm * k**2 + 0.25 * self.roughness_mm * (k / _SHORTEST) ** 2
        if self.stones:
            curvature += 4 / self.stone_diameter_mm
        step = step_of(_SAG_MM, max(curvature, 8 * _SAG_MM / min(self.width_mm, self.height_mm) ** 2))
        columns, rows = (int(np.ceil(side / step)) + 1 for side in (self.width_mm, self.height_mm))
        require_few(rows * columns, step_mm=step, advice="make it smaller, its ripples longer, or its stones larger")
        x, y = (np.linspace(-0.5, 0.5, count) for count in (columns, rows))
        x, y = np.meshgrid(x * self.width_mm, y * self.height_mm, indexing="ij")
        return np.stack([x, y, -seabed_height(self, x, y)], axis=-1).reshape(-1, 3), grid_faces(x.shape)


def seabed_height(bed: Seabed, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Height of the sea floor towards -z at places ``x``, ``y`` (N,), all in mm.

    Cosine ripples and smooth waves between -roughness and roughness, and above them the upper halves of spheroids,
    half as high as wide: height d / 4 sqrt(1 - t^2) over the plane, with t from 0 in a stone's middle to 1 at its rim.
    """
    places = np.stack(np.broadcast_arrays(x, y)) / bed.ripple_pitch_mm
    height = 0.5 * bed.ripple_height_mm * np.cos(2 * np.pi * places[0])
    height = height + bed.roughness_mm * waves(
        places, np.random.default_rng([bed.seed, 0]), shortest=_SHORTEST, longest=_LONGEST
    )
    for at_x, at_y in bed.stone_places():
        squared = (np.square(x - at_x) + np.square(y - at_y)) / (0.5 * bed.stone_diameter_mm) ** 2
        stone = 0.25 * bed.stone_diameter_mm * np.sqrt(np.maximum(1 - squared, 0))
        height = np.where(squared < 1, np.maximum(height, stone), height)
    return height
