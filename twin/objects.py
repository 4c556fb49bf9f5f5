"""The objects of a scene as shapes of one static Mitsuba scene; frames differ only in where the sensor stands."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import trimesh

from twin.pattern import register_circle_pattern
from twin.scene import AnyObject, Block, CirclePlate, Mesh, Pipe, Scene, Sphere
from uwlts.errors import DescriptionError

_FACING_SENSOR = np.diag([1.0, -1.0, -1.0, 1.0])
_CYLINDER_AXIS_TO_X = np.array([[0, 0, 1, 0], [0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 0, 1.0]])


def _to_world(matrix: np.ndarray) -> mi.ScalarTransform4f:
    return mi.ScalarTransform4f(matrix)


def _scaled(x: float, y: float, z: float) -> np.ndarray:
    return np.diag([x, y, z, 1.0])


def _mesh(thing: Mesh, pose: np.ndarray, bsdf: dict[str, Any]) -> mi.Mesh:
    """A trimesh surface with its vertices already in scene coordinates."""
    if not Path(thing.path).is_file():
        raise DescriptionError(f"no mesh at {thing.path}")
    try:
        surface = trimesh.load(thing.path, force="mesh")
    except (ValueError, NotImplementedError, OSError) as error:
        raise DescriptionError(f"trimesh cannot read {thing.path}: {error}") from error
    if len(surface.faces) == 0 or not np.isfinite(surface.vertices).all():
        raise DescriptionError(f"{thing.path} holds no usable surface: {len(surface.faces)} faces")
    vertices = thing.scale * np.asarray(surface.vertices) @ pose[:3, :3].T + pose[:3, 3]
    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict(bsdf)
    mesh = mi.Mesh(Path(thing.path).stem, len(vertices), len(surface.faces), properties)
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = np.ravel(vertices).astype(np.float32)
    parameters["faces"] = np.ravel(surface.faces).astype(np.uint32)
    parameters.update()
    return mesh


def _shape(thing: AnyObject, pose: np.ndarray) -> Any:
    """Mitsuba's description of one object at its pose (4, 4) in the scene."""
    bsdf: dict[str, Any] = {"type": "diffuse", "reflectance": thing.reflectance}
    match thing:
        case Sphere():
            matrix = pose @ _scaled(*[thing.diameter_mm / 2] * 3)
            return {"type": "sphere", "to_world": _to_world(matrix), "bsdf": bsdf}
        case Block():
            matrix = pose @ _scaled(*(side / 2 for side in thing.size_mm))
            return {"type": "cube", "to_world": _to_world(matrix), "bsdf": bsdf}
        case Pipe():
            along = _CYLINDER_AXIS_TO_X @ _scaled(thing.diameter_mm / 2, thing.diameter_mm / 2, thing.length_mm)
            along[0, 3] = -thing.length_mm / 2
            return {"type": "cylinder", "to_world": _to_world(pose @ along), "bsdf": bsdf}
        case Mesh():
            return _mesh(thing, pose, {"type": "twosided", "bsdf": bsdf})
        case CirclePlate():
            bsdf = {"type": "diffuse", "reflectance": {"type": "circle_pattern", "plate": thing.model_dump_json()}}
    matrix = pose @ _FACING_SENSOR @ _scaled(thing.width_mm / 2, thing.height_mm / 2, 1)
    return {"type": "rectangle", "to_world": _to_world(matrix), "bsdf": bsdf}


def build_objects(scene: Scene) -> mi.Scene:
    """Mitsuba scene of all objects in scene coordinates.

    Raises
    ------
    DescriptionError
        A mesh file is missing, unreadable or empty.
    """
    register_circle_pattern()
    shapes = {
        f"object_{index}": _shape(thing, pose)
        for index, (thing, pose) in enumerate(zip(scene.objects, scene.object_poses(), strict=True))
    }
    return mi.load_dict({"type": "scene"} | shapes)
