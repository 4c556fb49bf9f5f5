"""Description of a virtual scene: objects and their poses, and the motion of the sensor that scans them.

Scene coordinates are the sensor's object coordinate system (OCS) at stage position 0. X is normal to the sheet, in the
scan direction; Y is along the stripe; Z is along the laser's axis, away from the sensor. The origin is at the
stand-off.
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Self, TypeVar, cast

import numpy as np
from pydantic import BeforeValidator, Discriminator, Field, SerializeAsAny, Tag, model_validator

from twin.scene.forms import AnyForm
from twin.scene.platform_kinds import Robot, RotaryTable, Vehicle
from twin.scene.platforms import IdealPath, Motion, Platform
from twin.scene.scene_object import FlatObject, Pose, Reflectance, SceneObject
from uwlts.errors import DescriptionError
from uwlts.model.library import find_description, load_sensor, read_table, validate_description
from uwlts.model.sensor import Description, Medium, NotNegative, Positive, Sensor, Table, Vector
from uwlts.targets import CircleTarget, Target, parse_target

Kind = TypeVar("Kind", bound=Description)


def replace_values(described: Kind, **changes: object) -> Kind:
    """Return a copy with replaced values, unvalidated; a table of changes applies to the nested description."""
    inner = {name: getattr(described, name) for name in changes}
    return described.model_copy(
        update={
            name: replace_values(inner[name], **change)
            if isinstance(change, dict) and isinstance(inner[name], Description)
            else change
            for name, change in changes.items()
        }
    )


class Ball(SceneObject):
    """A sphere centred at its own origin."""

    kind: Literal["sphere"]
    diameter_mm: Positive


class Plate(FlatObject):
    """A flat rectangle in its own x-y plane, facing -z (towards the sensor)."""

    kind: Literal["plate"]
    width_mm: Positive
    height_mm: Positive

    _relief_has_uv: ClassVar[bool] = True


class Block(FlatObject):
    """A box centred at its own origin.

    Edges rounded with ``edge_radius_mm`` reflect glints on glossy finishes.
    """

    kind: Literal["block"]
    size_mm: tuple[Positive, Positive, Positive]
    edge_radius_mm: NotNegative = 0.0

    @model_validator(mode="after")
    def _check_edges(self) -> Self:
        if self.edge_radius_mm == 0:
            return self
        if 2 * self.edge_radius_mm >= min(self.size_mm):
            raise ValueError(f"edge_radius_mm {self.edge_radius_mm:g} is half of the least side or more: reduce it")
        for name, value in (("mirror", self.mirror), ("texture", self.texture)):
            if value:
                raise ValueError(f"{name} {value} on a block with rounded edges: use edge_radius_mm = 0")
        return self


class Pipe(SceneObject):
    """The outer surface of a pipe along its own x axis, centred at its origin."""

    kind: Literal["pipe"]
    diameter_mm: Positive
    length_mm: Positive


class Mesh(SceneObject):
    """A surface from a file in a format that trimesh reads, in mm; a relative path starts at the scene's folder."""

    kind: Literal["mesh"]
    path: str
    scale: Positive = 1.0

    _relief_has_uv: ClassVar[bool] = True


class PrintedPlate(SceneObject, ABC):
    """Base of calibration targets on a flat plate that faces -z; its own frame is the target's.

    A real target differs from its description: each point (circle or corner) has an error of ``centre_std_mm`` along x
    and y. The print is larger along x and y by the fractions ``stretch``. The plate's centre is ``bow_mm`` in front of
    its corners. ``detection_std_px`` shifts each point independently in each image, in addition to the detection
    errors that image noise causes. ``errors_seed`` is the seed of these errors.
    """

    centre_std_mm: NotNegative = 0.0
    stretch: tuple[Annotated[float, Field(gt=-0.1, lt=0.1)], Annotated[float, Field(gt=-0.1, lt=0.1)]] = (0.0, 0.0)
    bow_mm: Annotated[float, Field(gt=-10, lt=10)] = 0.0
    detection_std_px: NotNegative = 0.0
    errors_seed: Annotated[int, Field(ge=0)] = 0

    _no_texture: ClassVar[str] = "on a plate with a printed pattern: put it on an object of kind 'plate'"
    _no_mottle: ClassVar[str] = "on a plate with a printed pattern: use an object of kind 'plate', or"

    @abstractmethod
    def described_target(self) -> Target:
        """Return the target without errors; its spacing may be rounded to single precision, as in the renderer."""

    @abstractmethod
    def bounds_mm(self) -> np.ndarray:
        """Return the corners (2, 2) of the plate with the smallest and the largest x and y, in its own x-y plane."""

    @abstractmethod
    def ink_and_gap_reflectance(self) -> tuple[float, float]:
        """Return the reflectance of printed patches with ink and of patches without."""

    def background_reflectance(self) -> float:
        """Return the reflectance of the plate around the print."""
        return self.finish_properties().reflectance


class CirclePlate(PrintedPlate):
    """A lattice of circles; three of them have a dot and mark origin, X and Y.

    The lattice has ``columns`` along x and ``rows`` along y. ``origin`` is the column and row of the marked origin, at
    the plate's centre; ``marker_x`` and ``marker_y`` are the offsets (columns, rows) of the other two dots.
    ``reflectance`` is that of the background.
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
    def _check_target(self) -> Self:
        self.described_target()
        return self

    def described_target(self) -> Target:
        """Return the target without errors; its spacing is rounded to single precision, as in the renderer."""
        lattice = self.model_dump(include=set(CircleTarget.model_fields) - {"kind"})
        spacing = {key: float(np.float32(lattice[key])) for key in ("spacing_x_mm", "spacing_y_mm")}
        return parse_target({"kind": "circles"} | lattice | spacing)

    def bounds_mm(self) -> np.ndarray:
        """Return the corners (2, 2) of the plate, which is centred at its own origin."""
        return np.array([(-0.5, -0.5), (0.5, 0.5)]) * (self.width_mm, self.height_mm)

    def ink_and_gap_reflectance(self) -> tuple[float, float]:
        """Return the reflectance of circles and of dots."""
        return self.circle_reflectance, self.marker_reflectance


class TargetPlate(PrintedPlate):
    """A calibration target of any kind.

    ``target`` is a description as in a scene's ``[target]``, which is the default. ``reflectance`` is that of the
    background and ``ink_reflectance`` that of the print: dark squares, or circles, which may be brighter than the
    background. The plate extends ``rim_mm`` beyond the print on all sides.
    """

    kind: Literal["target_plate"]
    target: Annotated[
        SerializeAsAny[Target],
        BeforeValidator(lambda given: given if isinstance(given, Target) else parse_target(given)),
    ]
    ink_reflectance: Reflectance = 0.05
    rim_mm: NotNegative = 10.0

    def described_target(self) -> Target:
        """Return the target without errors."""
        return self.target

    def bounds_mm(self) -> np.ndarray:
        """Return the corners (2, 2) of the plate: the bounds of the print, extended by the rim."""
        boxes = np.array([(p.x_min_mm, p.y_min_mm, p.x_max_mm, p.y_max_mm) for p in self.target.patches()])
        return np.array([boxes[:, :2].min(axis=0) - self.rim_mm, boxes[:, 2:].max(axis=0) + self.rim_mm])

    def ink_and_gap_reflectance(self) -> tuple[float, float]:
        """Return the reflectance of the ink and of the background."""
        return self.ink_reflectance, self.background_reflectance()


AnyObject = Annotated[
    Ball | Plate | Block | Pipe | Mesh | CirclePlate | TargetPlate | AnyForm, Field(discriminator="kind")
]


AnyMotion = Annotated[
    Annotated[Motion, Tag("")]
    | Annotated[IdealPath, Tag("path")]
    | Annotated[RotaryTable, Tag("rotary_table")]
    | Annotated[Robot, Tag("robot")]
    | Annotated[Vehicle, Tag("vehicle")],
    Discriminator(
        lambda given: str(given.get("kind", "") if isinstance(given, Mapping) else getattr(given, "kind", ""))
    ),
]
"""The steps of a stage, or a platform selected by ``kind``."""


class Scene(Description):
    """A scene as read from TOML.

    ``placements`` are named poses of the whole set of objects (near, standoff, far); ``placement`` is the current one.
    ``medium`` is one of the sensor's media. ``water`` replaces its dissolved and suspended matter, by the name of a
    water or a turbidity from 0 (pure) to 3 (harbour). ``artefact`` and ``target`` are what an operator would record
    about the objects (calibrated values, the description of the target); they are stored in the capture.
    ``current_mm_per_s`` is the velocity of the water and its particles in scene coordinates. ``depth_m`` is the depth
    below the water surface, whose waves focus daylight (effect ``caustics``).
    """

    title: str
    medium: str = "water"
    water: str | Annotated[float, Field(ge=0, le=3)] | None = None
    current_mm_per_s: Vector = (0.0, 0.0, 0.0)
    depth_m: Positive = 1.0
    motion: AnyMotion = Motion()
    objects: Annotated[tuple[AnyObject, ...], Field(min_length=1)]
    placements: dict[str, Pose] = {"standoff": Pose()}
    placement: str = "standoff"
    window_mounted: bool = True
    artefact: Table | None = None
    target: Table | None = None

    @model_validator(mode="before")
    @classmethod
    def _fill_targets(cls, table: object) -> object:
        """Use the scene's target for each target_plate without a description."""
        if not isinstance(table, dict) or table.get("target") is None or not isinstance(table.get("objects"), list):
            return table
        objects = list(table["objects"])
        for number, thing in enumerate(objects):
            if isinstance(thing, dict) and thing.get("kind") == "target_plate":
                objects[number] = {"target": table["target"]} | thing
        return table | {"objects": objects}

    @model_validator(mode="after")
    def _check_placement_and_targets(self) -> "Scene":
        if self.placement not in self.placements:
            raise ValueError(f"placement '{self.placement}' is not one of {', '.join(self.placements)}")
        plates = [thing for thing in self.objects if isinstance(thing, PrintedPlate)]
        if len(plates) > 1 and any(plate.detection_std_px > 0 for plate in plates):
            raise ValueError("detection_std_px is for scenes with one target: omit it, or the other targets")
        return self

    def object_poses(self) -> list[np.ndarray]:
        """Return the transforms (4, 4) from each object's own frame to the scene."""
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
    """Read a scene by the name of a shipped one (``spheres``) or by path; the given values replace its own.

    ``placement`` and ``medium`` are names of the scene's placements and of the sensor's media. ``water`` is a name or a
    turbidity from 0 (pure) to 3 (harbour). A table of the motion is validated like one of the file.
    """
    path = find_description(name_or_path)
    table: dict[str, object] = dict(read_table(path))
    motion = motion.model_dump() if isinstance(motion, Description) else motion
    given = {"placement": placement, "medium": medium, "water": water, "motion": motion}
    table |= {key: value for key, value in given.items() if value is not None}
    objects = table.get("objects", [])
    if not isinstance(objects, list) or not all(isinstance(thing, dict) for thing in objects):
        raise DescriptionError(f"{path}: objects must be written as [[objects]] tables")
    if isinstance(moved := table.get("motion"), Mapping) and isinstance(moved.get("trajectory"), str):
        table["motion"] = {**moved, "trajectory": str(path.parent / str(moved["trajectory"]))}
    table["objects"] = [
        thing | {key: str(path.parent / thing[key]) for key in ("path", "texture") if isinstance(thing.get(key), str)}
        for thing in objects
    ]
    return validate_description(Scene, table, path)


def medium_of(sensor: Sensor, scene: Scene) -> Medium:
    """Return the sensor's medium that the scene names, with the scene's water if it defines one."""
    medium = sensor.medium(scene.medium)
    if scene.water is None:
        return medium
    kind = {"water": scene.water} if isinstance(scene.water, str) else {"turbidity": scene.water}
    kept = medium.model_dump(include={"kind", "temperature_c", "salinity_g_kg", "index"})
    return validate_description(Medium, kept | kind, f"{scene.title}, water = {scene.water!r}")


Value = float | int | str | bool
NamedSensor = Annotated[Sensor, BeforeValidator(lambda value: load_sensor(value) if isinstance(value, str) else value)]
"""Sensor that a description may state by name or path."""


def value_at(described: Description, path: str, source: str | Path, *, called: str = "sensor") -> Value | None:
    """Return the value at a path of a description.

    ``called`` names the described thing, and ``source`` the origin of the path, for error messages. DescriptionError if
    the path does not exist, or leads to a table or list.
    """
    found: object = described.model_dump()
    for key in path.split("."):
        if isinstance(found, list | tuple) and key.isdecimal() and int(key) < len(found):
            found = found[int(key)]
            continue
        if not isinstance(found, dict) or key not in found:
            there = f"but {_describe_places(found)}" if isinstance(found, dict | list | tuple) else "and nothing below"
            missing = f"the {called}'s description has no '{path}': there is no '{key}', {there}"
            raise DescriptionError(f"{source}: {missing}")
        found = found[key]
    if isinstance(found, dict | list | tuple):
        kind = "table" if isinstance(found, dict) else "list"
        raise DescriptionError(f"{source}: '{path}' is a {kind}; name one of its values: {_describe_places(found)}")
    return cast("Value | None", found)


def with_values(table: dict[str, Any], changes: Mapping[str, Value]) -> dict[str, Any]:
    """Return a copy of a description's table with the values at paths replaced."""
    changed = dict(table)
    for path, value in changes.items():
        *parents, last = path.split(".")
        place: Any = changed
        for parent in parents:
            key = _read_key(place, parent)
            below = place[key] if isinstance(place, list) else place.get(key, {})
            place[key] = below = list(below) if isinstance(below, list | tuple) else dict(below)
            place = below
        place[_read_key(place, last)] = value
    return changed


def _read_key(place: Any, text: str) -> Any:
    return int(text) if isinstance(place, list) else text


def _describe_places(found: object) -> str:
    if isinstance(found, dict):
        return ", ".join(map(str, found))
    return f"0 to {len(found) - 1}" if isinstance(found, list | tuple) and found else "nothing"
