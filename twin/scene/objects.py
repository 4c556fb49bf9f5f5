"""The objects of a scene as shapes of one static Mitsuba scene; frames differ only in where the sensor stands."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, assert_never, cast

import drjit as dr
import mitsuba as mi
import numpy as np
import trimesh

from twin.backend.arrays import Bool, Float, Int32, SurfaceInteraction3f, UInt32, scalar_transform, to_jit
from twin.scene.description import AnyObject, Block, CirclePlate, Mesh, Pipe, Plate, Scene, Sphere, TargetPlate
from twin.scene.finish import albedo_parts, finish_bsdf, register_pattern, square_on
from twin.scene.forms.triangles import bowed_plate
from twin.scene.placed import FreeForm
from uwlts.errors import DescriptionError
from uwlts.files.reading import require_regular_file

_MOST_MESH_BYTES = 2**28
"""Five million triangles of a binary STL file."""
_FACING_SENSOR = np.diag([1.0, -1.0, -1.0, 1.0])
_BLOCK_FACES = [np.roll(np.eye(3), shift, axis=1) @ np.diag([1, sign, sign]) for shift in range(3) for sign in (1, -1)]
"""Right-handed axes (3, 3) of a block's faces, the third one pointing outwards."""
_CYLINDER_AXIS_TO_X = np.array([[0, 0, 1, 0], [0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 0, 1.0]])
# At a cosine of 0 no light is sampled; the albedo's limit there is that of a small one.
_ALBEDO_COSINES = np.maximum(np.linspace(0.0, 1.0, 65), 1e-3)


@dataclass(frozen=True)
class MirrorFace:
    """A flat face that reflects ``share`` of the light as a mirror does.

    ``pose`` (4, 4) takes the face's frame to the scene's: origin in the face's middle, z along its outward normal, x
    and y along its sides, of which ``half_size_mm`` (2,) are the halves.
    """

    pose: np.ndarray
    half_size_mm: np.ndarray
    share: float


@dataclass(frozen=True)
class Objects:
    """All objects in scene coordinates, with properties of the places hit that Mitsuba's shapes do not provide.

    ``scene`` holds what scatters light; ``mirrors`` are the faces that reflect beside that. Tables give a fact of each
    shape at its number in Dr.Jit's registry, which counts through all scenes of the process. With ``coherent``, rays
    that lie side by side are faster followed together: among facets, not among spheres and cylinders. ``glossy`` says
    whether any object's albedo depends on the direction.
    """

    scene: mi.Scene
    mirrors: tuple[MirrorFace, ...]
    coherent: Bool
    glossy: bool
    _facts: dict[str, Float]

    def mirror_share(self, si: SurfaceInteraction3f) -> Float:
        """Share of light that the place hit reflects as a mirror; 0 on backs and where nothing is hit."""
        return dr.select(si.wi.z > 0, self._fact("mirror", si), 0.0)

    def polarisation(self, si: SurfaceInteraction3f) -> Float:
        """Degree of polarisation of laser light that the object hit scatters, 0 where nothing is hit."""
        return self._fact("polarisation", si)

    def roughness_um(self, si: SurfaceInteraction3f) -> Float:
        """Rms height of the object hit, 0 where nothing is hit."""
        return self._fact("roughness_um", si)

    def number(self, shape: mi.ShapePtr, active: Bool) -> Int32:
        """Number of the object of a shape among the scene's objects, -1 where not ``active``."""
        number = dr.gather(mi.Float, self._facts["number"], _registry_number(shape), active)
        return dr.select(active, mi.Int32(number), -1)

    def albedo(self, si: SurfaceInteraction3f, active: Bool = True) -> Float:
        """Radiance towards the viewer from surfaces under a sky of radiance 1 all around, mirror images aside.

        It is the share of light from the viewer's direction that the surface scatters: a diffuse surface's reflectance;
        of a gloss it depends on the direction. 0 on the back of surfaces that have only a front.
        """
        active = active & si.is_valid() & ((si.wi.z > 0) | (self._fact("two_sided", si) > 0))
        reflectance = si.bsdf().eval_diffuse_reflectance(square_on(si), active)[0]
        if not self.glossy:
            return dr.select(active, reflectance, 0.0)
        last = len(_ALBEDO_COSINES) - 1
        place = dr.minimum(dr.abs(si.wi.z), 1.0) * last
        below = mi.UInt32(dr.minimum(dr.floor(place), last - 1))
        start = _registry_number(si.shape) * (last + 1) + below
        black, per_unit = (
            dr.lerp(
                dr.gather(mi.Float, self._facts[key], start, active),
                dr.gather(mi.Float, self._facts[key], start + 1, active),
                place - below,
            )
            for key in ("albedo_black", "albedo_per_unit")
        )
        return dr.select(active, black + per_unit * reflectance, 0.0)

    def _fact(self, key: str, si: SurfaceInteraction3f) -> Float:
        return dr.gather(mi.Float, self._facts[key], _registry_number(si.shape), si.is_valid())


def build_objects(scene: Scene, *, medium_index: float, wavelength_nm: float, gloss: bool = True) -> Objects:
    """All objects of a scene in a medium, seen in the laser's light; without ``gloss`` diffuse and without mirrors.

    DescriptionError where a mesh or texture file is missing, unreadable or empty; RangeError where the wavelength lies
    outside the table of a metal.
    """
    register_pattern()
    optics = {"medium_index": medium_index, "wavelength_nm": wavelength_nm}
    things = scene.objects
    placed = list(zip(things, scene.object_poses(), strict=True))
    shapes = [_shape(thing, pose, finish_bsdf(thing, gloss=gloss, **optics)) for thing, pose in placed]
    flat = np.zeros_like(_ALBEDO_COSINES), np.ones_like(_ALBEDO_COSINES)
    glossy = [gloss and thing.finish != "diffuse" for thing in things]
    parts = [
        albedo_parts(thing, _ALBEDO_COSINES, **optics) if shines else flat
        for thing, shines in zip(things, glossy, strict=True)
    ]
    facts = {
        "mirror": [thing.mirror_share() if gloss else 0.0 for thing in things],
        "polarisation": [thing.polarisation() for thing in things],
        "roughness_um": [thing.rms_height_um() for thing in things],
        "number": list(range(len(things))),
        "two_sided": [isinstance(thing, (Mesh, FreeForm)) for thing in things],
        "albedo_black": [black for black, _ in parts],
        "albedo_per_unit": [per_unit for _, per_unit in parts],
    }
    # Optimised, Mitsuba would merge meshes of equal BSDF into one shape, whatever else differs between the objects.
    # Embree's faster test lets one ray in some ten thousand slip through the seam between two facets.
    whole = {"type": "scene", "embree_use_robust_intersections": True}
    whole = mi.load_dict(whole | {f"object_{i}": shape for i, shape in enumerate(shapes)}, optimize=False)
    return Objects(
        scene=whole,
        coherent=mi.Bool(any(shape.is_mesh() for shape in shapes)),
        glossy=any(glossy),
        mirrors=tuple(face for thing, pose in placed if gloss for face in _mirror_faces(thing, pose)),
        _facts={key: _by_registry(shapes, np.array(values, float)) for key, values in facts.items()},
    )


def _registry_number(shape: mi.ShapePtr) -> UInt32:
    """Numbers of shapes in Dr.Jit's registry."""
    return cast(Any, dr.reinterpret_array(mi.UInt32, shape))


def _by_registry(shapes: list[mi.Shape], values: np.ndarray) -> Float:
    """Values (objects,) or (objects, N) at the places of the objects' shapes in Dr.Jit's registry."""
    number = [int(_registry_number(mi.ShapePtr(shape))[0]) for shape in shapes]
    table = np.zeros((max(number) + 1, *values.shape[1:]), np.float32)
    table[number] = values
    flat = to_jit(mi.Float, table)
    dr.eval(flat)
    return flat


def _shape(thing: AnyObject, pose: np.ndarray, bsdf: mi.BSDF) -> mi.Shape:
    """An object at its pose (4, 4) in the scene."""
    match thing:
        case Sphere():
            matrix = pose.copy()
            if thing.texture is None:
                matrix[:3, :3] = np.eye(3)  # Mitsuba takes a turned sphere's rounding for shear
            matrix, kind = matrix @ _scaled(*[thing.diameter_mm / 2] * 3), "sphere"
        case Block():
            matrix, kind = pose @ _scaled(*(side / 2 for side in thing.size_mm)), "cube"
        case Pipe():
            matrix = _CYLINDER_AXIS_TO_X @ _scaled(thing.diameter_mm / 2, thing.diameter_mm / 2, thing.length_mm)
            matrix[0, 3] = -thing.length_mm / 2
            matrix, kind = pose @ matrix, "cylinder"
        case CirclePlate() | TargetPlate() if thing.bow_mm != 0:
            return _mesh(thing, pose, bsdf)
        case CirclePlate() | TargetPlate():
            first, last = thing.bounds_mm()
            matrix = _FACING_SENSOR @ _scaled(*(last - first) / 2, 1)
            matrix[:2, 3] = (first + last) / 2
            matrix, kind = pose @ matrix, "rectangle"
        case Mesh() | FreeForm():
            return _mesh(thing, pose, mi.load_dict({"type": "twosided", "bsdf": bsdf}))
        case Plate():
            matrix, kind = pose @ _FACING_SENSOR @ _scaled(thing.width_mm / 2, thing.height_mm / 2, 1), "rectangle"
        case _:
            assert_never(thing)
    return mi.load_dict({"type": kind, "to_world": scalar_transform(matrix), "bsdf": bsdf})


def _mesh(thing: Mesh | FreeForm | CirclePlate | TargetPlate, pose: np.ndarray, bsdf: mi.BSDF) -> mi.Mesh:
    """A surface of triangles with its vertices already in scene coordinates."""
    vertices, faces, uv = _surface(thing)
    vertices = vertices @ pose[:3, :3].T + pose[:3, 3]
    properties = mi.Properties()
    properties["bsdf"] = bsdf
    mesh = mi.Mesh(type(thing).__name__, len(vertices), len(faces), properties, has_vertex_texcoords=uv is not None)
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = np.ravel(vertices).astype(np.float32)
    parameters["faces"] = np.ravel(faces).astype(np.uint32)
    if uv is not None:
        parameters["vertex_texcoords"] = np.ravel(uv).astype(np.float32)
    parameters.update()
    return mesh


def _surface(thing: Mesh | FreeForm | CirclePlate | TargetPlate) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """Vertices (V, 3) in the object's own frame, faces (F, 3) and, if it has them, texture coordinates (V, 2)."""
    match thing:
        case FreeForm():
            return *thing.surface(), None
        case CirclePlate() | TargetPlate():
            return bowed_plate(*thing.bounds_mm(), bow_mm=thing.bow_mm)
        case Mesh():
            return _surface_from_file(thing)
        case _:
            assert_never(thing)


def _surface_from_file(thing: Mesh) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """Vertices (V, 3), faces (F, 3) and, if every part has them, texture coordinates (V, 2) of all parts of a file.

    The parts are joined here, as trimesh copies their materials to join them, which needs an imaging library.
    """
    path = thing.path
    require_regular_file(path, most_bytes=_MOST_MESH_BYTES, error=DescriptionError, called="mesh")
    try:
        loaded = trimesh.load(path, force="scene")
    # trimesh passes on whatever its readers of two dozen formats stumble over.
    except Exception as error:
        raise DescriptionError(f"trimesh cannot read {path}: {error}") from error
    assert isinstance(loaded, trimesh.Scene)  # as it was forced to be
    vertices, faces, count = [np.zeros((0, 3))], [np.zeros((0, 3), int)], 0
    uv: list[np.ndarray | None] = [np.zeros((0, 2))]
    for node in loaded.graph.nodes_geometry:
        transform, name = loaded.graph[node]
        part = loaded.geometry[name]
        if isinstance(part, trimesh.Trimesh):
            _require_surface(part, path)
            vertices.append(part.vertices @ transform[:3, :3].T + transform[:3, 3])
            faces.append(part.faces + count)
            uv.append(getattr(part.visual, "uv", None))
            count += len(part.vertices)
    corners, triangles = np.concatenate(vertices), np.concatenate(faces)
    if len(triangles) == 0 or not np.isfinite(corners).all():
        raise DescriptionError(f"{path} holds no usable surface: {len(triangles)} faces")
    known = [coordinates for coordinates in uv if coordinates is not None]
    everywhere = len(known) == len(uv)
    if thing.texture is not None and not everywhere:
        raise DescriptionError(f"{path} has no texture coordinates for {thing.texture}: add them, or leave it out")
    return thing.scale * corners, triangles, np.concatenate(known) if everywhere else None


def _require_surface(part: trimesh.Trimesh, path: str) -> None:
    """DescriptionError where a part has no vertices (V, 3) and faces (F, 3) of them."""
    vertices, faces = np.asarray(part.vertices), np.asarray(part.faces)
    shaped = [each.ndim == 2 and each.shape[1] == 3 for each in (vertices, faces)]
    if not all(shaped) or (faces.size and not 0 <= faces.min() <= faces.max() < len(vertices)):
        raise DescriptionError(
            f"{path} holds no usable surface: its vertices are of the shape {vertices.shape}, its faces {faces.shape}, "
            "expected three coordinates of each vertex and three existing vertices of each face"
        )


def _mirror_faces(thing: AnyObject, pose: np.ndarray) -> Iterator[MirrorFace]:
    """The mirrors of one object at its pose (4, 4) in the scene."""
    if thing.mirror_share() == 0:
        return
    match thing:
        case Block():
            half = np.array(thing.size_mm) / 2
            for axes in _BLOCK_FACES:
                face = np.eye(4)
                face[:3, :3], face[:3, 3] = axes, axes[:, 2] * half
                yield MirrorFace(pose @ face, np.abs(axes.T @ half)[:2], thing.mirror_share())
        case Plate():
            half = np.array([thing.width_mm, thing.height_mm]) / 2
            yield MirrorFace(pose @ _FACING_SENSOR, half, thing.mirror_share())
        case Sphere() | Pipe() | Mesh() | CirclePlate() | TargetPlate() | FreeForm():
            raise NotImplementedError(f"a {thing.kind} has no flat face that could be a mirror")
        case _:
            assert_never(thing)


def _scaled(*factors: float) -> np.ndarray:
    """The transform (4, 4) that scales by factors along x, y and z."""
    return np.diag([*factors, 1.0])
