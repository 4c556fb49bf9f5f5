"""Cable and rope: a smooth round jacket on an arc, and twisted strands."""

from typing import Annotated, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from twin.scene.forms.triangles import chord_step, require_few_vertices, tube
from twin.scene.scene_object import FreeForm
from uwlts.model.sensor import Positive

_SAG_MM = 0.005
"""Largest distance of the facets from the surfaces; ten times that in the valleys between strands."""


class Cable(FreeForm):
    """The jacket of a cable along an arc in its own x-y plane; at its origin, the centre, it runs along x.

    ``length_mm`` is the arc length and ``bend_radius_mm`` its radius, with the centre on y; without it the cable is
    straight. The surface is a torus: sqrt((rho - bend_radius)^2 + z^2) = diameter / 2, where rho is the distance from
    its axis.
    """

    kind: Literal["cable"]
    diameter_mm: Positive = 20.0
    length_mm: Positive = 150.0
    bend_radius_mm: Positive | None = None

    @model_validator(mode="after")
    def _can_be_bent(self) -> Self:
        bend = self.bend_radius_mm
        if bend is not None and (bend <= self.diameter_mm / 2 or self.length_mm > np.pi * bend):
            raise ValueError(
                f"a cable of diameter_mm {self.diameter_mm:g} and length_mm {self.length_mm:g} cannot lie on an arc of "
                f"bend_radius_mm {bend:g}: the radius must exceed half the diameter, the length at most half a circle"
            )
        return self

    def triangles(self) -> tuple[np.ndarray, np.ndarray]:
        """Return a tube with open ends whose facets deviate by `_SAG_MM`."""
        radius = self.diameter_mm / 2
        step = chord_step(_SAG_MM, 1 / radius)
        around = np.linspace(0, 2 * np.pi, int(np.ceil(2 * np.pi * radius / step)), endpoint=False)
        bend = self.bend_radius_mm
        along = self.length_mm if bend is None else chord_step(_SAG_MM, 1 / (bend + radius))
        rings = int(np.ceil(self.length_mm / along)) + 1
        require_few_vertices(rings * len(around), step_mm=step, advice="make it shorter or thinner")
        x = np.linspace(-0.5, 0.5, rings) * self.length_mm
        vertices, faces = tube(x, around, np.full((rings, len(around)), radius))
        if bend is None:
            return vertices, faces
        # Bend the straight tube about the axis at y = bend.
        angle, rho = vertices[:, 0] / bend, bend - vertices[:, 1]
        return np.stack([rho * np.sin(angle), bend - rho * np.cos(angle), vertices[:, 2]], axis=1), faces


class Rope(FreeForm):
    """A twisted rope along its own x axis, centred at its origin; ``diameter_mm`` is that of its circumscribed circle.

    ``strands`` round strands touch each other; ``lay_mm`` is the length of one turn about the axis (`rope_radius`).
    """

    kind: Literal["rope"]
    diameter_mm: Positive = 24.0
    length_mm: Positive = 150.0
    strands: Annotated[int, Field(ge=3, le=60)] = 3
    lay_mm: Positive = 80.0

    def triangles(self) -> tuple[np.ndarray, np.ndarray]:
        """Return a tube with open ends whose facets deviate by `_SAG_MM` away from the valleys."""
        strand, _ = _strand(self)
        step = chord_step(_SAG_MM, 1 / strand)
        around = np.linspace(0, 2 * np.pi, int(np.ceil(np.pi * self.diameter_mm / step)), endpoint=False)
        # A strand turns more slowly along the rope than around it, by this ratio.
        rings = int(np.ceil(self.length_mm / (step * max(1.0, self.lay_mm / (np.pi * self.diameter_mm))))) + 1
        require_few_vertices(
            rings * len(around), step_mm=step, advice="make it shorter or thinner, or its strands fewer"
        )
        x = np.linspace(-0.5, 0.5, rings) * self.length_mm
        return tube(x, around, rope_radius(self, x[:, None], around))


def rope_radius(rope: Rope, x: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Return the distance of a rope's surface from its axis at ``x`` in mm and angles in rad from -z towards y.

    In a section perpendicular to the axis, strands are circles of radius r. Their n centres are on a circle of radius c
    with r = c sin(pi / n), as they touch, and c + r = diameter / 2. At an angle b from the nearest centre, the distance
    is c cos(b) + sqrt(r^2 - c^2 sin^2(b)).
    """
    strand, circle = _strand(rope)
    pitch = 2 * np.pi / rope.strands
    turned = angle - 2 * np.pi * x / rope.lay_mm
    beside = turned - pitch * np.round(turned / pitch)
    return circle * np.cos(beside) + np.sqrt(np.maximum(strand**2 - np.square(circle * np.sin(beside)), 0))


def _strand(rope: Rope) -> tuple[float, float]:
    """Return the radius of the strands, and of the circle of their centres."""
    share = np.sin(np.pi / rope.strands)
    circle = 0.5 * rope.diameter_mm / (1 + share)
    return float(circle * share), float(circle)
