"""Pipe flange: a ring with a circle of bolt holes, bolt heads, and a slightly uneven face."""

from itertools import pairwise
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import Field, model_validator
from scipy.spatial import Delaunay

from twin.scene.forms.triangles import chord_step, quads, require_few_vertices
from twin.scene.scene_object import FreeForm
from uwlts.model.sensor import NotNegative, Positive

_SAG_MM = 0.004  # largest distance of the facets from the round edges and the face
_EMBEDDED_MM = 0.5  # depth of bolt heads below the face, which may be uneven there; also the smallest `thickness_mm`


class Flange(FreeForm):
    """A flange in its own x-y plane, centred at its origin; its face is at z = 0 and faces -z, with the ring behind it.

    ``holes`` holes are evenly spaced on the bolt circle, the first at ``first_hole_deg`` from x towards y. The first
    ``bolts`` holes have hexagonal heads of ``head_width_mm`` across flats and ``head_height_mm``, with two flats
    perpendicular to the radius. The face is a saddle with ``flatness_mm`` from its lowest to its highest point
    (`flange_face`).
    """

    kind: Literal["flange"]
    outer_diameter_mm: Positive = 165.0
    bore_diameter_mm: Positive = 62.0
    thickness_mm: Annotated[float, Field(ge=_EMBEDDED_MM)] = 18.0
    bolt_circle_mm: Positive = 125.0
    holes: Annotated[int, Field(ge=0, le=200)] = 4
    hole_diameter_mm: Positive = 18.0
    first_hole_deg: float = 45.0
    bolts: Annotated[int, Field(ge=0, le=200)] = 0
    head_width_mm: Positive = 24.0
    head_height_mm: Positive = 10.0
    flatness_mm: NotNegative = 0.0

    @model_validator(mode="after")
    def _has_room(self) -> Self:
        if self.bore_diameter_mm >= self.outer_diameter_mm:
            raise ValueError(
                f"bore_diameter_mm {self.bore_diameter_mm:g} is not smaller than outer_diameter_mm "
                f"{self.outer_diameter_mm:g}"
            )
        if self.flatness_mm > _EMBEDDED_MM:
            raise ValueError(f"flatness_mm {self.flatness_mm:g} is more than {_EMBEDDED_MM:g}")
        if self.holes and self.land_mm() <= 0:
            raise ValueError(
                f"{self.holes} holes of hole_diameter_mm {self.hole_diameter_mm:g} on a bolt_circle_mm of "
                f"{self.bolt_circle_mm:g} touch each other, the bore of {self.bore_diameter_mm:g} or the rim of "
                f"{self.outer_diameter_mm:g}"
            )
        if self.bolts > self.holes:
            raise ValueError(f"bolts is {self.bolts}, for {self.holes} holes")
        if self.bolts and self.head_width_mm <= self.hole_diameter_mm:
            raise ValueError(
                f"head_width_mm {self.head_width_mm:g} falls through a hole_diameter_mm of {self.hole_diameter_mm:g}"
            )
        return self

    def land_mm(self) -> float:
        """Return the smallest width of material between a hole and the next one, the bore or the rim."""
        circle, hole = self.bolt_circle_mm / 2, self.hole_diameter_mm / 2
        to_next = 2 * circle * np.sin(np.pi / self.holes) - 2 * hole if self.holes > 1 else np.inf
        edges = circle - hole - self.bore_diameter_mm / 2, self.outer_diameter_mm / 2 - circle - hole
        return float(min(to_next, *edges))

    def hole_places(self) -> np.ndarray:
        """Return the centres (holes, 2) of the bolt holes in the flange's own x-y plane, in mm."""
        angle = np.radians(self.first_hole_deg) + 2 * np.pi * np.arange(self.holes) / max(self.holes, 1)
        return self.bolt_circle_mm / 2 * np.stack([np.cos(angle), np.sin(angle)], axis=1)

    def triangles(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the closed surface of the ring, and those of the bolt heads, each closed separately.

        Facets deviate from the round edges and from `flange_face` by `_SAG_MM`. DescriptionError if small gaps between
        holes on a large ring require too many vertices.
        """
        flat, faces, circles = self._ring()
        z = flange_face(self, *flat.T, edges=True)
        count = len(flat)
        solid = [np.c_[flat, z], np.c_[flat, np.full(count, self.thickness_mm)]]
        # Seen from the front, anticlockwise in x and y is clockwise.
        parts = [faces[:, ::-1], faces + count]
        for number, circle in enumerate(circles):
            beside = np.roll(circle, -1)
            wall = quads(circle, beside, beside + count, circle + count)
            parts.append(wall if number == 0 else wall[:, ::-1])
        corners, count = np.concatenate(solid), 2 * count
        for x, y in self.hole_places()[: self.bolts]:
            vertices, hexagon = self._head(x, y)
            parts.append(hexagon + count)
            corners, count = np.concatenate([corners, vertices]), count + len(vertices)
        return corners, np.concatenate(parts)

    def _ring(self) -> tuple[np.ndarray, np.ndarray, list[np.ndarray]]:
        """Return vertices (V, 2) of the plane ring, faces (F, 3), and the vertices of its round edges, the rim first.

        Delaunay triangulation keeps the chords of a circle if all other vertices are farther away than their length.
        """
        outer, bore, hole = (d / 2 for d in (self.outer_diameter_mm, self.bore_diameter_mm, self.hole_diameter_mm))
        width = min(self.land_mm(), outer - bore) if self.holes else outer - bore
        # The saddle's second derivative, flatness / R^2, is far smaller than that of the edges.
        rings = [((0.0, 0.0), outer), ((0.0, 0.0), bore), *(((x, y), hole) for x, y in self.hole_places())]
        edges, steps = [], []
        for middle, radius in rings:
            steps.append(min(chord_step(_SAG_MM, 1 / radius), 0.5 * width))
            angle = np.linspace(0, 2 * np.pi, max(24, int(np.ceil(2 * np.pi * radius / steps[-1]))), endpoint=False)
            edges.append(np.array(middle) + radius * np.stack([np.cos(angle), np.sin(angle)], axis=1))
        coarse = max(steps)
        require_few_vertices(
            int(np.pi * outer**2 / coarse**2) + sum(map(len, edges)), step_mm=coarse, advice="leave more between holes"
        )
        x, y = np.meshgrid(*[np.arange(-outer, outer, coarse)] * 2)
        # Every second row is shifted by half a step.
        inner = np.stack([x + 0.5 * coarse * (np.arange(len(x)) % 2)[:, None], y], axis=-1).reshape(-1, 2)
        kept = np.hypot(*inner.T) < outer - coarse
        for ((x, y), radius), step in zip(rings[1:], steps[1:], strict=True):
            kept &= np.hypot(inner[:, 0] - x, inner[:, 1] - y) > radius + step
        points = np.concatenate([*edges, inner[kept]])
        faces = Delaunay(points).simplices
        a, b, c = (points[faces[:, k]] for k in range(3))
        turn = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])
        faces = np.where(turn[:, None] > 0, faces, faces[:, ::-1])
        # Facets in a hole have all corners on its edge, as there are no vertices inside.
        first = np.cumsum([0, *map(len, edges)])
        holes = [(faces >= low) & (faces < high) for low, high in pairwise(first[1:])]
        filled = np.any([every.all(axis=1) for every in holes], axis=0)
        return (
            points,
            faces[~filled & (np.abs(turn) > 1e-12)],
            [np.arange(low, high) for low, high in pairwise(first)],
        )

    def _head(self, x: float, y: float) -> tuple[np.ndarray, np.ndarray]:
        """Return vertices (12, 3) and faces of a hexagonal head over a hole."""
        angle = np.arctan2(y, x) + np.pi / 6 + np.pi / 3 * np.arange(6)
        edge = np.array([x, y]) + self.head_width_mm / np.sqrt(3) * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        vertices = np.concatenate([np.c_[edge, np.full(6, z)] for z in (-self.head_height_mm, _EMBEDDED_MM)])
        ring = np.arange(6)
        fan = np.stack([np.zeros(4, int), ring[1:5], ring[2:6]], axis=1)
        sides = quads(ring, np.roll(ring, -1), np.roll(ring, -1) + 6, ring + 6)
        return vertices, np.concatenate([fan[:, ::-1], fan + 6, sides])


def flange_face(flange: Flange, x: np.ndarray, y: np.ndarray, *, edges: bool = False) -> np.ndarray:
    """Return z in mm of a flange's face at ``x``, ``y`` (N,) in its own frame; NaN where there is no face.

    z = flatness / 2 (r / R)^2 cos(2 angle), with the rim radius R. The least-squares plane of this saddle is z = 0, and
    its rim touches two parallel planes, ``flatness_mm`` apart, in two points each. ``edges`` includes values beyond its
    edges. Bolts are not included.
    """
    z = 0.5 * flange.flatness_mm * (np.square(x) - np.square(y)) / (flange.outer_diameter_mm / 2) ** 2
    radius = np.hypot(x, y)
    on = (radius <= flange.outer_diameter_mm / 2) & (radius >= flange.bore_diameter_mm / 2)
    for at_x, at_y in flange.hole_places():
        on &= np.hypot(x - at_x, y - at_y) >= flange.hole_diameter_mm / 2
    return np.where(on | edges, z, np.nan)
