"""Pipe with marine growth: a soft, uneven layer with barnacles."""

from typing import Annotated, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from twin.scene.forms.triangles import chord_step, require_few_vertices, space_angles, tube, waves
from twin.scene.scene_object import FreeForm
from uwlts.model.sensor import NotNegative, Positive

_SAG_MM = 0.04
"""Largest distance of the facets from the surface, well below the uncertainty of real growth."""
_GROWN_DEG = 60.0
"""Barnacles are within this angle of the side that faces the sensor."""
_SHORTEST = 0.5
"""Shortest wavelength of the layer's waves, divided by ``patch_mm``."""
_LONGEST = 2.0
"""Longest wavelength, divided by ``patch_mm``."""


class OvergrownPipe(FreeForm):
    """The outer surface of a pipe under marine growth, along its own x axis and centred at its origin.

    ``diameter_mm`` is that of the bare pipe. The growth has the mean thickness ``growth_mm`` and varies by the fraction
    ``unevenness`` of it, in patches about ``patch_mm`` wide. ``barnacles`` of ``barnacle_diameter_mm`` and
    ``barnacle_height_mm``, with craters, are within 60 deg of -z at random positions from ``seed``
    (`overgrown_radius`).
    """

    kind: Literal["overgrown_pipe"]
    diameter_mm: Positive = 80.0
    length_mm: Positive = 120.0
    growth_mm: NotNegative = 6.0
    unevenness: Annotated[float, Field(ge=0, le=1)] = 0.5
    patch_mm: Positive = 20.0
    barnacles: Annotated[int, Field(ge=0, le=1000)] = 20
    barnacle_diameter_mm: Positive = 10.0
    barnacle_height_mm: NotNegative = 4.0
    seed: Annotated[int, Field(ge=0)] = 0

    @model_validator(mode="after")
    def _has_room(self) -> Self:
        if self.barnacle_diameter_mm > min(self.length_mm, self.diameter_mm / 2):
            raise ValueError(
                f"barnacle_diameter_mm {self.barnacle_diameter_mm:g} is more than length_mm {self.length_mm:g}, or "
                f"than half of diameter_mm {self.diameter_mm:g}"
            )
        return self

    def barnacle_places(self) -> np.ndarray:
        """Return positions (barnacles, 2) of their centres: x in mm, and the angle in rad from -z towards y."""
        most = 0.5 * (self.length_mm - self.barnacle_diameter_mm), np.radians(_GROWN_DEG)
        return np.random.default_rng([self.seed, 1]).uniform(-1, 1, (self.barnacles, 2)) * most

    def triangles(self) -> tuple[np.ndarray, np.ndarray]:
        """Return a tube with open ends whose facets deviate by `_SAG_MM`, more where barnacles meet."""
        radius = self.diameter_mm / 2 + self.growth_mm
        wavy = self.unevenness * self.growth_mm * (2 * np.pi / (_SHORTEST * self.patch_mm)) ** 2 / 4
        # Curvature of a barnacle's flank, and of its narrower crater.
        shell = 24 * self.barnacle_height_mm / (0.5 * self.barnacle_diameter_mm) ** 2 if self.barnacles else 0.0
        step = chord_step(_SAG_MM, 1 / radius + wavy + shell)
        plain = chord_step(_SAG_MM, 1 / radius + wavy)
        reach = np.radians(_GROWN_DEG) + 0.5 * self.barnacle_diameter_mm / (self.diameter_mm / 2)
        around = space_angles(reach, radius, step=step, plain=plain)
        rings = int(np.ceil(self.length_mm / step)) + 1
        require_few_vertices(
            rings * len(around), step_mm=step, advice="make its barnacles wider or lower, or the pipe smaller"
        )
        x = np.linspace(-0.5, 0.5, rings) * self.length_mm
        return tube(x, around, overgrown_radius(self, x[:, None], np.where(around > np.pi, around - 2 * np.pi, around)))


def overgrown_radius(pipe: OvergrownPipe, x: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Return the distance of the growth's surface from the axis at ``x`` in mm and angles in rad.

    Angles are -pi to pi, from -z towards y. The pipe's radius is increased by growth (1 + unevenness w), with smooth
    waves w between -1 and 1, and by the highest barnacle: height ((1 - t^2)^2 - 0.6 (1 - (t / 0.4)^2)^2). Here t is 0
    at its centre and 1 at its foot, and the second term, the crater, applies up to t = 0.4. Distances are measured
    along the bare pipe.
    """
    bare = pipe.diameter_mm / 2
    places = np.stack([*np.broadcast_arrays(x, bare * np.cos(angle), bare * np.sin(angle))]) / pipe.patch_mm
    layer = waves(places, np.random.default_rng([pipe.seed, 0]), shortest=_SHORTEST, longest=_LONGEST)
    shells = np.zeros(np.broadcast(x, angle).shape)
    for at_x, at_angle in pipe.barnacle_places():
        squared = np.square(x - at_x) + np.square(bare * (angle - at_angle))
        squared = squared / (0.5 * pipe.barnacle_diameter_mm) ** 2
        cone, crater = (np.square(np.maximum(1 - squared / width**2, 0)) for width in (1.0, 0.4))
        shells = np.maximum(shells, pipe.barnacle_height_mm * (cone - 0.6 * crater))
    return bare + pipe.growth_mm * (1 + pipe.unevenness * layer) + shells
