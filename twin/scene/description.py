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

from twin.scene.motion import Motion, Pose
from twin.scene.platforms import IdealPath, LinearGuide, Platform, Robot, RotaryTable, Vehicle
from uwlts.model.errors import DescriptionError
from uwlts.model.library import find, read_table, validated
from uwlts.model.sensor import Description, NotNegative, Positive, Table
from uwlts.targets import CircleTarget, Target, parse_target

Kind = TypeVar("Kind", bound=Description)
Reflectance = Annotated[float, Field(ge=0, le=1)]
Finish = Literal["diffuse", "painted", "pvc", "metal"]

TYPICAL_ALPHA = {"diffuse": 1.0, "painted": 0.3, "pvc": 0.15, "metal": 0.3}
"""GGX roughness: a satin paint, an extruded pipe, ground steel."""
TYPICAL_ROUGHNESS_UM = {"diffuse": 5.0, "painted": 5.0, "pvc": 5.0, "metal": 1.0}
"""Rms heights in um. Light out of a diffuse body has run through some um of it, whatever its surface."""


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


class Placed(Pose):
    """Base of all objects: a pose and a finish.

    ``finish`` says how the surface reflects: "diffuse" as Lambert's law says; "painted" and "pvc" as a diffuse body
    under a clear, slightly rough coat; "metal" as rough steel. ``reflectance`` is the diffuse reflectance, that of the
    body under a coat, and scales the reflection of a metal. The grey values (0 to 1) of picture ``texture`` multiply
    it, laid out by the shape's own uv coordinates with the picture's last row at v = 0; a relative path starts at the
    scene's folder. ``alpha`` is the GGX roughness of coat or metal (Walter et al. 2007), ``roughness_um`` the surface's
    rms height.
    """

    reflectance: Reflectance = 0.8
    finish: Finish = "diffuse"
    alpha: Annotated[float, Field(ge=0.02, le=1)] | None = None
    roughness_um: NotNegative | None = None
    texture: str | None = None

    _no_texture: ClassVar[str] = ""
    """Reason for which objects of a class have no texture."""

    @model_validator(mode="after")
    def _has_what_its_finish_and_shape_take(self) -> Self:
        if self.texture is not None and self._no_texture:
            raise ValueError(f"texture {self.texture} {self._no_texture}")
        if self.finish == "diffuse" and self.alpha is not None:
            raise ValueError(f"alpha {self.alpha:g} roughens a gloss, but finish 'diffuse' has none: leave alpha out")
        return self

    def gloss_alpha(self) -> float:
        """GGX roughness, the finish's usual one unless given."""
        return TYPICAL_ALPHA[self.finish] if self.alpha is None else self.alpha

    def rms_height_um(self) -> float:
        """Rms height of the surface in um, the finish's usual one unless given."""
        return TYPICAL_ROUGHNESS_UM[self.finish] if self.roughness_um is None else self.roughness_um

    def mirror_share(self) -> float:
        """Share of light that is reflected as by a plane mirror."""
        return getattr(self, "mirror", 0.0)

    def polarisation(self) -> float:
        """Degree of polarisation of scattered laser light: 1 from a metal or mirror, 0 out of a diffuse body."""
        return 1.0 if self.finish == "metal" or self.mirror_share() > 0 else 0.0


class Flat(Placed):
    """Base of objects with flat faces, which may be mirrors.

    ``mirror`` is the share of light that the faces reflect as plane mirrors do, beside what they scatter: the weak
    stripe on a mirror comes from a small ``reflectance``.
    """

    mirror: Reflectance = 0.0

    @model_validator(mode="after")
    def _reflects_at_most_all(self) -> "Flat":
        if self.reflectance + self.mirror > 1:
            both = f"reflectance {self.reflectance:g} and mirror {self.mirror:g}"
            raise ValueError(f"{both} add up to more than all light: lower one of them")
        if self.mirror > 0 and self.finish in ("painted", "pvc"):
            raise ValueError(f"mirror {self.mirror:g} under a coat: a mirror's finish is 'diffuse' or 'metal'")
        return self


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


class FreeForm(Placed):
    """Base of free-form surfaces of a shape of their own. They have no uv coordinates for a texture."""

    _no_texture: ClassVar[str] = "on a surface without uv coordinates: leave it out, or use a mesh"


class Head(FreeForm):
    """A dummy head with the stub of its neck, about its own origin; its face looks along -z, its crown lies at +y.

    ``height_mm`` runs from the neck's cut to the crown.
    """

    kind: Literal["head"]
    height_mm: Positive = 160.0


class Weld(FreeForm):
    """Rippled weld beads on the front of a plate in its own x-y plane, facing -z (towards the sensor).

    The beads run along the plate's x or y axis (``along``), side by side, ``spacing_mm`` from middle to middle;
    ``length_mm``, ``width_mm`` and ``height_mm`` are those of one bead, ``ripple_height_mm`` is that from trough to
    crest. ``irregularity`` is how much width and height change on the way, as a share of them, and how far the path
    and the ripples' places wander, in widths and pitches; ``seed`` chooses how. Grooves of ``undercut_depth_mm`` and
    ``undercut_width_mm`` run along both toes of each bead.
    """

    kind: Literal["weld"]
    plate_mm: tuple[Positive, Positive] = (80.0, 120.0)
    beads: Annotated[int, Field(ge=1, le=100)] = 3
    spacing_mm: Positive = 18.0
    along: Literal["x", "y"] = "x"
    length_mm: Positive = 56.0
    width_mm: Positive = 10.0
    height_mm: Positive = 2.0
    ripple_pitch_mm: Positive = 3.0
    ripple_height_mm: NotNegative = 0.25
    irregularity: Annotated[float, Field(ge=0, le=0.3)] = 0.06
    undercut_depth_mm: NotNegative = 0.0
    undercut_width_mm: Positive = 1.5
    seed: Annotated[int, Field(ge=0)] = 0

    def bead_reach_mm(self) -> float:
        """Largest distance that a bead reaches sideways from its straight middle line, irregularities included."""
        groove = 0.5 * self.undercut_width_mm if self.undercut_depth_mm else 0.0
        return self.width_mm * (0.5 + 1.5 * self.irregularity) + groove

    @model_validator(mode="after")
    def _beads_have_room(self) -> "Weld":
        plate = self.plate_mm if self.along == "x" else self.plate_mm[::-1]
        wide = (self.beads - 1) * self.spacing_mm + 2 * self.bead_reach_mm()
        if self.length_mm < self.width_mm:
            raise ValueError(f"a bead of length_mm {self.length_mm:g} is shorter than its width_mm {self.width_mm:g}")
        if self.beads > 1 and self.spacing_mm < 2 * self.bead_reach_mm():
            touching = f"lets beads touch that may be {2 * self.bead_reach_mm():g} mm wide"
            raise ValueError(f"spacing_mm {self.spacing_mm:g} {touching}")
        if self.length_mm > plate[0] or wide > plate[1]:
            raise ValueError(
                f"beads of {self.length_mm:g} mm along {self.along} and {wide:g} mm together across it do not fit on "
                f"plate_mm {self.plate_mm[0]:g} x {self.plate_mm[1]:g}"
            )
        if self.ripple_height_mm > 2 * (1 - self.irregularity) * self.height_mm:
            raise ValueError(
                f"ripple_height_mm {self.ripple_height_mm:g} lets troughs dip into the plate under a bead of height_mm "
                f"{self.height_mm:g}"
            )
        return self


class PittedPipe(FreeForm):
    """The outside of a corroded pipe, not quite round; its axis is its own x axis, its middle its origin.

    The diameter along z is the largest, that square to it the smallest: ``ovality`` is their difference over
    ``diameter_mm``, their mean. ``pits`` pits of ``pit_diameter_mm`` and ``pit_depth_mm`` lie within 60 deg of -z;
    ``seed`` chooses where (`twin.scene.shapes.pit_places`).
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
    Sphere | Plate | Block | Pipe | Mesh | Head | Weld | PittedPipe | CirclePlate | TargetPlate,
    Field(discriminator="kind"),
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
