"""Description of a virtual scene: objects, their poses, and the motion of the stage that scans them.

Scene coordinates are the sensor's object coordinate system (OCS) at stage position 0: X normal to the sheet, the
direction of a scan; Y along the stripe; Z along the laser's axis away from the sensor; the origin is the stand-off.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, model_validator
from scipy.spatial.transform import Rotation

from uwlts.errors import DescriptionError
from uwlts.library import find, names, read_table, validated
from uwlts.sensor import Description, NotNegative, Positive, Vector

Reflectance = Annotated[float, Field(ge=0, le=1)]


class Pose(Description):
    """Where something stands: rotated about the scene's X, then Y, then Z axis, then moved."""

    position_mm: Vector = (0.0, 0.0, 0.0)
    rotation_deg: Vector = (0.0, 0.0, 0.0)

    def matrix(self) -> np.ndarray:
        """Rigid transform (4, 4) from the object's own frame to the parent's."""
        transform = np.eye(4)
        transform[:3, :3] = Rotation.from_euler("xyz", self.rotation_deg, degrees=True).as_matrix()
        transform[:3, 3] = self.position_mm
        return transform


class Placed(Pose):
    """Base of all objects: a pose and a diffuse reflectance."""

    reflectance: Reflectance = 0.8


class Sphere(Placed):
    """A sphere about its own origin."""

    kind: Literal["sphere"]
    diameter_mm: Positive


class Plate(Placed):
    """A flat rectangle in its own x-y plane, facing -z (towards the sensor)."""

    kind: Literal["plate"]
    width_mm: Positive
    height_mm: Positive


class Block(Placed):
    """A box about its own origin."""

    kind: Literal["block"]
    size_mm: tuple[Positive, Positive, Positive]


class Pipe(Placed):
    """The outside of a pipe; its axis is its own x axis, its middle its origin."""

    kind: Literal["pipe"]
    diameter_mm: Positive
    length_mm: Positive


class Mesh(Placed):
    """Any surface from a file that trimesh reads, in mm; a relative path starts at the scene's folder."""

    kind: Literal["mesh"]
    path: str
    scale: Positive = 1.0


class CirclePlate(Placed):
    """Flat plate, facing -z, with a lattice of circles; three of them carry a dot and mark origin, X and Y.

    The lattice has ``columns`` along x and ``rows`` along y; ``origin`` is the marked origin's column and row, and
    ``marker_x`` and ``marker_y`` are the offsets (columns, rows) of the other two. The origin circle lies at the
    plate's own origin. ``reflectance`` is the ground's.
    """

    kind: Literal["circle_plate"]
    width_mm: Positive
    height_mm: Positive
    columns: Annotated[int, Field(ge=3)]
    rows: Annotated[int, Field(ge=3)]
    spacing_x_mm: Positive
    spacing_y_mm: Positive
    diameter_mm: Positive
    marker_diameter_mm: Positive
    origin: tuple[NotNegative, NotNegative]
    marker_x: tuple[int, int] = (2, 0)
    marker_y: tuple[int, int] = (0, 2)
    circle_reflectance: Reflectance = 0.85
    marker_reflectance: Reflectance = 0.05


AnyObject = Annotated[Sphere | Plate | Block | Pipe | Mesh | CirclePlate, Field(discriminator="kind")]


class Motion(Description):
    """Stage positions of a scan: ``count`` of them from ``start_mm`` in steps of ``step_mm`` along ``direction``.

    ``direction`` is where the stage truly carries the sensor; the capture records ``nominal_direction``. At every
    position the images in ``lights`` are taken in turn.
    """

    start_mm: float = 0.0
    step_mm: float = 1.0
    count: Annotated[int, Field(ge=1, le=100000)] = 1
    direction: Vector = (1.0, 0.0, 0.0)
    nominal_direction: Vector | None = None
    lights: tuple[Literal["lamp", "laser"], ...] = ("laser",)

    @model_validator(mode="after")
    def _has_direction(self) -> "Motion":
        for vector in (self.direction, self.nominal_direction):
            if vector is not None and np.linalg.norm(vector) < 1e-9:
                raise ValueError(f"direction {vector} has no length")
        if not self.lights:
            raise ValueError("lights is empty: name 'lamp', 'laser' or both")
        return self

    def unit_direction(self) -> np.ndarray:
        """True unit direction (3,) of the sensor's travel in the scene."""
        return np.array(self.direction) / np.linalg.norm(self.direction)

    def recorded_direction(self) -> tuple[float, float, float]:
        """Unit direction that the capture states."""
        vector = np.array(self.nominal_direction or self.direction)
        return tuple(float(x) for x in vector / np.linalg.norm(vector))

    def shots(self) -> Iterator["Shot"]:
        """Every image of the scan in its order."""
        for index in range(self.count):
            for light in self.lights:
                yield Shot(stage_mm=self.start_mm + index * self.step_mm, light=light)


@dataclass(frozen=True)
class Shot:
    """One image to take: stage position in mm and the light that is on."""

    stage_mm: float
    light: Literal["lamp", "laser"]


class Scene(Description):
    """A scene as read from TOML.

    ``placements`` are named poses of the whole set of objects (near, standoff, far); ``placement`` is the one in use.
    ``artefact`` and ``target`` are what an operator would note about the things before the sensor: calibrated values,
    lattice; they travel in the capture.
    """

    title: str
    medium: str = "water"
    motion: Motion = Motion()
    objects: Annotated[tuple[AnyObject, ...], Field(min_length=1)]
    placements: dict[str, Pose] = {"standoff": Pose()}
    placement: str = "standoff"
    window_mounted: bool = True
    artefact: dict[str, Any] | None = None
    target: dict[str, Any] | None = None

    @model_validator(mode="after")
    def _placement_known(self) -> "Scene":
        if self.placement not in self.placements:
            raise ValueError(f"placement '{self.placement}' is not one of {', '.join(self.placements)}")
        return self

    def object_poses(self) -> list[np.ndarray]:
        """Transforms (4, 4) from each object's own frame to the scene's."""
        whole = self.placements[self.placement].matrix()
        return [whole @ thing.matrix() for thing in self.objects]


def scene_names() -> list[str]:
    """Names of the scenes that ship with the package."""
    return names()


def load_scene(name_or_path: str | Path, *, changes: dict[str, Any] | None = None) -> Scene:
    """Scene by name (``spheres``) or path, with top-level ``changes`` such as ``placement`` laid over it."""
    path = find(name_or_path)
    table = read_table(path) | (changes or {})
    objects = table.get("objects", [])
    if not isinstance(objects, list) or not all(isinstance(thing, dict) for thing in objects):
        raise DescriptionError(f"{path}: objects must be written as [[objects]] tables")
    table["objects"] = [
        thing | {"path": str(path.parent / thing["path"])} if thing.get("kind") == "mesh" and "path" in thing else thing
        for thing in objects
    ]
    return validated(Scene, table, path)
