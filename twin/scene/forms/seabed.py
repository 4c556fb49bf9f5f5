"""Patch of the sea floor: rippled, rough sediment with half-buried stones."""

from typing import Annotated, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from twin.scene.forms.triangles import chord_step, grid_faces, require_few_vertices, tube, waves
from twin.scene.scene_object import FreeForm
from uwlts.model.sensor import NotNegative, Positive

_SAG_MM = 0.02  # largest distance of the sediment's facets from the surface; twice as much for stones
_SHORTEST = 0.2  # shortest wavelength of the roughness, divided by the ripples' pitch
_LONGEST = 1.0  # longest wavelength, divided by the ripples' pitch


class Seabed(FreeForm):
    """Sediment in its own x-y plane, centred at its origin, facing -z (towards the sensor).

    Ripples are parallel to y, with ``ripple_pitch_mm`` between crests along x and ``ripple_height_mm`` from trough to
    crest. The surface has a roughness of up to ``roughness_mm``. ``stones`` of ``stone_diameter_mm`` are half buried at
    random positions from ``seed``. With ``smallest_stone_mm``, diameters are log-uniform between both.
    """

    kind: Literal["seabed"]
    width_mm: Positive = 200.0
    height_mm: Positive = 200.0
    ripple_pitch_mm: Positive = 60.0
    ripple_height_mm: NotNegative = 6.0
    roughness_mm: NotNegative = 1.0
    stones: Annotated[int, Field(ge=0, le=10_000)] = 6
    stone_diameter_mm: Positive = 15.0
    smallest_stone_mm: Positive | None = None
    seed: Annotated[int, Field(ge=0)] = 0

    @model_validator(mode="after")
    def _check_stones(self) -> Self:
        if self.stone_diameter_mm > min(self.width_mm, self.height_mm):
            raise ValueError(
                f"stone_diameter_mm {self.stone_diameter_mm:g} is more than width_mm {self.width_mm:g} or height_mm "
                f"{self.height_mm:g}"
            )
        if self.smallest_stone_mm is not None and self.smallest_stone_mm > self.stone_diameter_mm:
            raise ValueError(
                f"smallest_stone_mm {self.smallest_stone_mm:g} is more than stone_diameter_mm "
                f"{self.stone_diameter_mm:g}"
            )
        return self

    def stone_places(self) -> np.ndarray:
        """Return the centres (stones, 2) of the stones in the x-y plane, in mm."""
        most = 0.5 * (np.array([self.width_mm, self.height_mm]) - self.stone_diameter_mm)
        return np.random.default_rng([self.seed, 1]).uniform(-1, 1, (self.stones, 2)) * most

    def stone_diameters(self) -> np.ndarray:
        """Return the diameters (stones,) of the stones, in mm."""
        smallest = self.smallest_stone_mm or self.stone_diameter_mm
        share = np.random.default_rng([self.seed, 2]).uniform(0, 1, self.stones)
        return self.stone_diameter_mm * (smallest / self.stone_diameter_mm) ** share

    def triangles(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the open surface of the sediment, and those of the stones, which intersect it."""
        k = 2 * np.pi / self.ripple_pitch_mm
        curvature = 0.5 * self.ripple_height_mm * k**2 + 0.25 * self.roughness_mm * (k / _SHORTEST) ** 2
        step = chord_step(_SAG_MM, max(curvature, 8 * _SAG_MM / min(self.width_mm, self.height_mm) ** 2))
        columns, rows = (int(np.ceil(side / step)) + 1 for side in (self.width_mm, self.height_mm))
        diameters = self.stone_diameters()
        count = rows * columns + sum(int(np.prod(_count_stone_facets(each))) for each in diameters)
        require_few_vertices(count, step_mm=step, advice="make it smaller, its ripples longer, or its stones fewer")
        x, y = (np.linspace(-0.5, 0.5, count) for count in (columns, rows))
        x, y = np.meshgrid(x * self.width_mm, y * self.height_mm, indexing="ij")
        vertices = [np.stack([x, y, -_compute_sediment_height(self, x, y)], axis=-1).reshape(-1, 3)]
        faces, used = [grid_faces(x.shape)], x.size
        for place, diameter in zip(self.stone_places(), diameters, strict=True):
            points, facets = _make_stone(diameter)
            vertices.append(points + (*place, 0.0))
            faces.append(facets + used)
            used += len(points)
        return np.concatenate(vertices), np.concatenate(faces)


def _count_stone_facets(diameter_mm: float) -> tuple[int, int]:
    """Return the number of rings from a stone's rim to its top, and of facets around it.

    On an ellipse with the larger half axis a, a chord over the parameter angle p deviates by at most a p^2 / 8.
    """
    angle = chord_step(2 * _SAG_MM, 0.5 * diameter_mm)
    return int(np.ceil(0.5 * np.pi / angle)) + 1, int(np.ceil(2 * np.pi / angle))


def _make_stone(diameter_mm: float) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices (V, 3) and faces (F, 3) of the upper half of a spheroid, half as high as wide."""
    rings, around = _count_stone_facets(diameter_mm)
    angle = np.linspace(0, 0.5 * np.pi, rings)
    radius = np.tile(0.5 * diameter_mm * np.cos(angle)[:, None], around)
    turns = np.linspace(0, 2 * np.pi, around, endpoint=False)
    vertices, faces = tube(0.25 * diameter_mm * np.sin(angle), turns, radius)
    # The last ring is a single point, the top.
    faces = np.minimum(faces, (rings - 1) * around)
    faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
    # The tube's axis, x, becomes -z.
    return np.stack([vertices[:, 2], vertices[:, 1], -vertices[:, 0]], axis=1)[: (rings - 1) * around + 1], faces


def _compute_sediment_height(bed: Seabed, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return the height of the sea floor without stones."""
    places = np.stack(np.broadcast_arrays(x, y)) / bed.ripple_pitch_mm
    height = 0.5 * bed.ripple_height_mm * np.cos(2 * np.pi * places[0])
    rng = np.random.default_rng([bed.seed, 0])
    return height + bed.roughness_mm * waves(places, rng, shortest=_SHORTEST, longest=_LONGEST)
