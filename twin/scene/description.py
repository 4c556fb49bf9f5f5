"""Description of a virtual scene: objects and their poses, and the motion of the sensor that scans them.

Scene coordinates are the sensor's object coordinate system (OCS) at stage position 0: X normal to the sheet, the
direction of a scan; Y along the stripe; Z along the laser's axis away from the sensor; the origin is the stand-off.
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, ClassVar, Literal, Self, TypeVar

import numpy as np
from pydantic import BeforeValidator, Discriminator, Field, SerializeAsAny, Tag, model_validator

from twin.scene.forms import AnyForm
from twin.scene.guide_and_table import LinearGuide, RotaryTable
from twin.scene.motion import Motion
from twin.scene.placed import Flat, Placed, Pose, Reflectance
from twin.scene.platforms import IdealPath, Platform
from twin.scene.robot import Robot
from twin.scene.vehicle import Vehicle
from uwlts.errors import DescriptionError
from uwlts.model.library import find, read_table, validated
from uwlts.model.sensor import Description, NotNegative, Positive, Table
from uwlts.targets import CircleTarget, Target, parse_target

Kind = TypeVar("Kind", bound=Description)


def altered(described: Kind, **changes: object) -> Kind:
    """A copy with values replaced, unvalidated; a table of changes goes to the description that it is meant for."""
    inner = {name: getattr(described, name) for name in changes}
    return described.model_copy(
        update={
            name: altered(inner[name], **change)
            if isinstance(change, dict) and isinstance(inner[name], Description)
            else change
            for name, change in changes.items()
        }
    )


class Sphere(Placed):
    """A sphere about its own origin."""

    kind: Literal["sphere"]
    diameter_mm: Positive


class Plate(Flat):
    """A flat rectangle in its own x-y plane, facing -z (towards the sensor)."""

    kind: Literal["plate"]
    width_mm: Positive
    height_mm: Positive


class Block(Flat):
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


class Printed(Placed, ABC):
    """Base of calibration targets on a flat plate that faces -z; its own frame is the target's.

    A real target differs from its description: every point of it (circle or corner) is off by ``centre_std_mm`` along x
    and y, and the middle of the plate stands ``bow_mm`` before its corners. ``detection_std_px`` shifts every point in
    every image anew, as errors of detection beyond those that the image itself leads to. ``errors_seed`` chooses these
    errors.
    """

    centre_std_mm: NotNegative = 0.0
    bow_mm: Annotated[float, Field(gt=-10, lt=10)] = 0.0
    detection_std_px: NotNegative = 0.0
    errors_seed: Annotated[int, Field(ge=0)] = 0

    _no_texture: ClassVar[str] = "on a plate with a printed pattern: put it on an object of kind 'plate'"

    @abstractmethod
    def described_target(self) -> Target:
        """The target without errors; its spacing may have the 32 bits of the renderer."""

    @abstractmethod
    def bounds_mm(self) -> np.ndarray:
        """Corners (2, 2) of the plate in its own x-y plane: the one with the smallest x and y, and the opposite one."""

    @abstractmethod
    def ink_and_gap_reflectance(self) -> tuple[float, float]:
        """Reflectance of the print's patches with ink and of those without."""

    def dimmed(self, scale: float) -> Self:
        """The same plate with every reflectance multiplied by ``scale``."""
        names = [name for name in type(self).model_fields if name.endswith("reflectance")]
        return self.model_copy(update={name: scale * getattr(self, name) for name in names})


class CirclePlate(Printed):
    """A lattice of circles; three of them carry a dot and mark origin, X and Y.

    The lattice has ``columns`` along x and ``rows`` along y; ``origin`` is the marked origin's column and row, and
    ``marker_x`` and ``marker_y`` are the offsets (columns, rows) of the other two. The origin circle lies in the
    plate's middle. ``reflectance`` is the ground's.
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
    origin: tuple[int, int]
    marker_x: tuple[int, int] = (2, 0)
    marker_y: tuple[int, int] = (0, 2)
    circle_reflectance: Reflectance = 0.85
    marker_reflectance: Reflectance = 0.05

    @model_validator(mode="after")
    def _shows_a_target(self) -> Self:
        self.described_target()
        return self

    def described_target(self) -> Target:
        """The target without errors; its spacing has the 32 bits of the renderer."""
        lattice = self.model_dump(include=set(CircleTarget.model_fields) - {"kind"})
        spacing = {key: float(np.float32(lattice[key])) for key in ("spacing_x_mm", "spacing_y_mm")}
        return parse_target({"kind": "circles"} | lattice | spacing)

    def bounds_mm(self) -> np.ndarray:
        """Corners (2, 2) of the plate, whose middle is its own origin."""
        return np.array([(-0.5, -0.5), (0.5, 0.5)]) * (self.width_mm, self.height_mm)

    def ink_and_gap_reflectance(self) -> tuple[float, float]:
        """Reflectance of circles and of dots."""
        return self.circle_reflectance, self.marker_reflectance


def _parsed(target: Target | Mapping[str, object]) -> Target:
    return target if isinstance(target, Target) else parse_target(target)


class TargetPlate(Printed):
    """A calibration target of any kind.

    ``target`` is a description as in a scene's ``[target]``, which is used if it is left out. ``reflectance`` is the
    ground's, ``ink_reflectance`` that of what is printed on it: dark squares, or circles, which may be brighter than
    the ground. The plate reaches ``rim_mm`` beyond the print on all sides.
    """

    kind: Literal["target_plate"]
    target: Annotated[SerializeAsAny[Target], BeforeValidator(_parsed)]
    ink_reflectance: Reflectance = 0.05
    rim_mm: NotNegative = 10.0

    def described_target(self) -> Target:
        """The target without errors."""
        return self.target

    def bounds_mm(self) -> np.ndarray:
        """Corners (2, 2) of the plate: those of the print with the rim around it."""
        boxes = np.array([(p.x_min_mm, p.y_min_mm, p.x_max_mm, p.y_max_mm) for p in self.target.patches()])
        return np.array([boxes[:, :2].min(axis=0) - self.rim_mm, boxes[:, 2:].max(axis=0) + self.rim_mm])

    def ink_and_gap_reflectance(self) -> tuple[float, float]:
        """Reflectance of the ink; without it the ground is seen."""
        return self.ink_reflectance, self.reflectance


AnyObject = Annotated[
    Sphere | Plate | Block | Pipe | Mesh | CirclePlate | TargetPlate | AnyForm, Field(discriminator="kind")
]


def _kind_of_motion(motion: object) -> str:
    return str(motion.get("kind", "") if isinstance(motion, Mapping) else getattr(motion, "kind", ""))


AnyMotion = Annotated[
    Annotated[Motion, Tag("")]
    | Annotated[IdealPath, Tag("path")]
    | Annotated[LinearGuide, Tag("linear_guide")]
    | Annotated[RotaryTable, Tag("rotary_table")]
    | Annotated[Robot, Tag("robot")]
    | Annotated[Vehicle, Tag("vehicle")],
    Discriminator(_kind_of_motion),
]
"""A stage's steps, or a platform that ``kind`` names."""


class Scene(Description):
    """A scene as read from TOML.

    ``placements`` are named poses of the whole set of objects (near, standoff, far); ``placement`` is the one in use.
    ``medium`` is one of the sensor's; ``water`` replaces what is dissolved and floats in it, by the name of a water or
    a turbidity from 0 (pure) to 3 (harbour).
    ``artefact`` and ``target`` are what an operator would note about the things before the sensor: calibrated values,
    the target's description; they travel in the capture.
    """

    title: str
    medium: str = "water"
    water: str | Annotated[float, Field(ge=0, le=3)] | None = None
    motion: AnyMotion = Motion()
    objects: Annotated[tuple[AnyObject, ...], Field(min_length=1)]
    placements: dict[str, Pose] = {"standoff": Pose()}
    placement: str = "standoff"
    window_mounted: bool = True
    artefact: Table | None = None
    target: Table | None = None

    @model_validator(mode="before")
    @classmethod
    def _targets_described(cls, table: object) -> object:
        """A target_plate without a description of its own shows the scene's target."""
        if not isinstance(table, dict) or table.get("target") is None or not isinstance(table.get("objects"), list):
            return table
        objects = list(table["objects"])
        for number, thing in enumerate(objects):
            if isinstance(thing, dict) and thing.get("kind") == "target_plate":
                objects[number] = {"target": table["target"]} | thing
        return table | {"objects": objects}

    @model_validator(mode="after")
    def _has_its_placement_and_one_target_with_detection_errors(self) -> "Scene":
        if self.placement not in self.placements:
            raise ValueError(f"placement '{self.placement}' is not one of {', '.join(self.placements)}")
        plates = [thing for thing in self.objects if isinstance(thing, Printed)]
        if len(plates) > 1 and any(plate.detection_std_px > 0 for plate in plates):
            raise ValueError("detection_std_px is for scenes with one target: leave it out, or the other targets")
        return self

    def object_poses(self) -> list[np.ndarray]:
        """Transforms (4, 4) from each object's own frame to the scene's."""
        whole = self.placements[self.placement].matrix()
        return [whole @ thing.matrix() for thing in self.objects]


def load_scene(
    name_or_path: str | Path,
    *,
    placement: str | None = None,
    medium: str | None = None,
    water: str | float | None = None,
    motion: Motion | Platform | Mapping[str, object] | None = None,
) -> Scene:
    """Scene by name (``spheres``) or path, with what is given in place of its own; a motion may be a table."""
    path = find(name_or_path)
    table: dict[str, object] = dict(read_table(path))
    motion = motion.model_dump() if isinstance(motion, Description) else motion
    given = {"placement": placement, "medium": medium, "water": water, "motion": motion}
    table |= {key: value for key, value in given.items() if value is not None}
    objects = table.get("objects", [])
    if not isinstance(objects, list) or not all(isinstance(thing, dict) for thing in objects):
        raise DescriptionError(f"{path}: objects must be written as [[objects]] tables")
    if isinstance(moved := table.get("motion"), Mapping) and isinstance(moved.get("trajectory"), str):
        table["motion"] = {**moved, "trajectory": str(path.parent / str(moved["trajectory"]))}
    table["objects"] = [_with_paths_from(path.parent, thing) for thing in objects]
    return validated(Scene, table, path)


def _with_paths_from(folder: Path, thing: Table) -> Table:
    """An object's table with relative paths of mesh and texture starting at a folder."""
    paths = {key: thing.get(key) for key in ("path", "texture")}
    return thing | {key: str(folder / path) for key, path in paths.items() if isinstance(path, str)}
