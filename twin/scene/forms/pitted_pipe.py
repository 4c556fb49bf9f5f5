"""Corroded, slightly oval pipe with pits of known position and size."""

from typing import Annotated, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from twin.scene.forms.triangles import chord_step, require_few_vertices, space_angles, tube
from twin.scene.scene_object import FreeForm
from uwlts.model.sensor import NotNegative, Positive

_PIT_SAG_MM = 0.01
"""Largest distance of a pitted pipe's facets from its surface."""
_PITTED_DEG = 60.0
"""Pits are within this angle of the side that faces the sensor."""


class PittedPipe(FreeForm):
    """The outer surface of a corroded, slightly oval pipe, along its own x axis and centred at its origin.

    The largest diameter is along z, the smallest perpendicular to it; ``ovality`` is their difference divided by their
    mean, ``diameter_mm``. ``pits`` pits of ``pit_diameter_mm`` and ``pit_depth_mm`` are within 60 deg of -z at random
    positions from ``seed`` (`pit_places`).
    """

    kind: Literal["pitted_pipe"]
    diameter_mm: Positive = 100.0
    length_mm: Positive = 120.0
    ovality: Annotated[float, Field(ge=0, le=0.2)] = 0.0
    pits: Annotated[int, Field(ge=0, le=1000)] = 12
    pit_diameter_mm: Positive = 10.0
    pit_depth_mm: NotNegative = 2.0
    seed: Annotated[int, Field(ge=0)] = 0

    @model_validator(mode="after")
    def _has_room_for_pits(self) -> Self:
        if self.pit_diameter_mm > min(self.length_mm, self.diameter_mm / 2):
            raise ValueError(
                f"pit_diameter_mm {self.pit_diameter_mm:g} is more than length_mm {self.length_mm:g}, or than half of "
                f"diameter_mm {self.diameter_mm:g}"
            )
        if self.pit_depth_mm > self.diameter_mm / 4:
            raise ValueError(
                f"pit_depth_mm {self.pit_depth_mm:g} is more than a quarter of diameter_mm {self.diameter_mm:g}"
            )
        return self

    def triangles(self) -> tuple[np.ndarray, np.ndarray]:
        """Return a tube with open ends.

        Facets deviate from `pitted_radius` by `_PIT_SAG_MM`, by up to ten times that at creases between overlapping
        pits. DescriptionError if small and deep pits on a large pipe require too many vertices.
        """
        # The second derivative of a pit is largest at its rim.
        radius = self.diameter_mm / 2
        step = chord_step(_PIT_SAG_MM, 1 / radius + 8 * self.pit_depth_mm / (0.5 * self.pit_diameter_mm) ** 2)
        plain = chord_step(_PIT_SAG_MM, 1 / radius)
        reach = np.radians(_PITTED_DEG) + 0.5 * self.pit_diameter_mm / radius if self.pits else 0.0
        around = space_angles(reach, radius, step=step, plain=plain)
        rings = int(np.ceil(self.length_mm / (step if self.pits else self.length_mm))) + 1
        advice = "make its pits wider or flatter, or the pipe smaller"
        require_few_vertices(rings * len(around), step_mm=step, advice=advice)
        x = np.linspace(-0.5, 0.5, rings) * self.length_mm
        # Angles at the back, without pits, exceed pi.
        return tube(x, around, pitted_radius(self, x[:, None], np.where(around > np.pi, around - 2 * np.pi, around)))


def pit_places(pipe: PittedPipe) -> np.ndarray:
    """Return positions (pits, 2) of the centres of a pipe's pits: x in mm, and the angle in rad from -z towards y."""
    most = 0.5 * (pipe.length_mm - pipe.pit_diameter_mm), np.radians(_PITTED_DEG)
    return np.random.default_rng(pipe.seed).uniform(-1, 1, (pipe.pits, 2)) * most


def pitted_radius(pipe: PittedPipe, x: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Return the distance of a pitted pipe's surface from its axis at ``x`` in mm and angles in rad from -z to y.

    R (1 + ovality / 2 cos(2 angle)), minus the depth of the deepest pit: `pit_depth_mm` (1 - t^2)^2, where t is 0 at
    the pit's centre and 1 at its rim, measured along the surface of the round pipe.
    """
    round_mm, pit_mm = pipe.diameter_mm / 2, pipe.pit_diameter_mm / 2
    depth = np.zeros(np.broadcast(x, angle).shape)
    for at_x, at_angle in pit_places(pipe):
        squared = (np.square(x - at_x) + np.square(round_mm * (angle - at_angle))) / pit_mm**2
        depth = np.maximum(depth, pipe.pit_depth_mm * np.square(np.maximum(1 - squared, 0)))
    return round_mm * (1 + 0.5 * pipe.ovality * np.cos(2 * angle)) - depth
