"""The objects of a scene as shapes of one static Mitsuba scene; frames differ only in the sensor's pose."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any, assert_never, cast

import drjit as dr
import mitsuba as mi
import numpy as np

from twin.backend.arrays import Bool, Float, Int32, SurfaceInteraction3f, UInt32, to_jit
from twin.scene.description import AnyObject, Ball, Block, CirclePlate, Mesh, Pipe, Plate, Scene, TargetPlate
from twin.scene.finish import albedo_parts, body_spread, finish_bsdf, register_textures, view_along_normal
from twin.scene.forms.triangles import add_relief, bowed_plate, rounded_box, tube
from twin.scene.scene_object import FreeForm
from twin.scene.surfaces import GAUSSIANS, LateralSpread
from uwlts.errors import DescriptionError
from uwlts.files.reading import require_regular_file

if TYPE_CHECKING:
    import trimesh  # takes a second to import, and few scenes need it

_MOST_MESH_BYTES = 2**28  # size of a binary STL file with five million triangles
_FACING_SENSOR = np.diag([1.0, -1.0, -1.0, 1.0])
_BLOCK_FACES = [np.roll(np.eye(3), shift, axis=1) @ np.diag([1, sign, sign]) for shift in range(3) for sign in (1, -1)]
"""Right-handed axes (3, 3) of a block's faces; the third one is the outward normal."""
_CYLINDER_AXIS_TO_X = np.array([[0, 0, 1, 0], [0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 0, 1.0]])
_SURFACE_STREAM = 11
_RELIEF_STREAM = 12
"""Random number streams of reflectances and reliefs, separate from those of print errors."""
# At a cosine of 0 no light is sampled: use the albedo at a small cosine instead.
_ALBEDO_COSINES = np.maximum(np.linspace(0.0, 1.0, 65), 1e-3)


@dataclass(frozen=True)
class MirrorFace:
    """A flat face with the specular reflectance ``share``.

    ``pose`` (4, 4) transforms from the face's frame to the scene. The origin is the centre of the face, z its outward
    normal, and x and y its sides with the half lengths ``half_size_mm`` (2,).
    """

    pose: np.ndarray
    half_size_mm: np.ndarray
    share: float


@dataclass(frozen=True)
class Objects:
    """All objects in scene coordinates, with surface properties that Mitsuba's shapes do not provide.

    ``scene`` contains what scatters light and ``mirrors`` the specular faces. Tables list a property of each shape at
    its number in Dr.Jit's registry, which is common to all scenes of the process. ``coherent`` is True if adjacent rays
    are traced faster together, as for meshes but not for spheres and cylinders. ``glossy`` is True if the albedo of any
    object depends on direction. ``translucent`` is True if light spreads in the body of any object,
    and ``retroreflects`` if any returns the lamp's light.
    """

    scene: mi.Scene
    mirrors: tuple[MirrorFace, ...]
    coherent: Bool
    glossy: bool
    translucent: bool
    retroreflects: bool
    _facts: dict[str, Float]

    def mirror_share(self, si: SurfaceInteraction3f) -> Float:
        """Return the specular reflectance at surface points; 0 on back sides and without a hit."""
        return dr.select(si.wi.z > 0, self._gather_fact("mirror", si), 0.0)

    def polarisation(self, si: SurfaceInteraction3f) -> Float:
        """Return the degree of polarisation of laser light scattered by the objects hit; 0 without a hit."""
        return self._gather_fact("polarisation", si)

    def roughness_um(self, si: SurfaceInteraction3f) -> Float:
        """Return the rms height of the objects hit; 0 without a hit."""
        return self._gather_fact("roughness_um", si)

    def lamp_albedo(self, si: SurfaceInteraction3f) -> Float:
        """Return the radiance of surfaces lit from the camera with the radiance 1 of a uniform sky, as `albedo`.

        A retroreflecting front adds pi times its coefficient of retroreflected luminance.
        """
        if not self.retroreflects:
            return self.albedo(si)
        return self.albedo(si) + math.pi * dr.select(si.wi.z > 0, self._gather_fact("retroreflection", si), 0.0)

    def spread_ahead_mm(self, si: SurfaceInteraction3f, cosine: Float) -> Float:
        """Return the mean way of light in the bodies hit, per sine of its incidence angle of the given cosine.

        See `twin.scene.surfaces.LateralSpread`; the way is along the surface.
        """
        index = dr.maximum(self._gather_fact("spread_index", si), 1.0)
        inside = dr.safe_sqrt(1 - (1 - dr.square(cosine)) / dr.square(index))
        return self._gather_fact("spread_path_mm", si) / (index * (1 + self._gather_fact("spread_decay", si) * inside))

    def spread_parts(self, si: SurfaceInteraction3f) -> list[tuple[Float, Float]]:
        """Return weights and variances in mm2 of the Gaussians that spread light in the bodies hit."""
        start, valid = GAUSSIANS * _read_registry_number(si.shape), si.is_valid()
        weights, variances = self._facts["spread_weights"], self._facts["spread_variances_mm2"]
        return [
            (dr.gather(mi.Float, weights, start + k, valid), dr.gather(mi.Float, variances, start + k, valid))
            for k in range(GAUSSIANS)
        ]

    def number(self, shape: mi.ShapePtr, active: Bool) -> Int32:
        """Return the index of the objects that shapes belong to; -1 where not ``active``."""
        number = dr.gather(mi.Float, self._facts["number"], _read_registry_number(shape), active)
        return dr.select(active, mi.Int32(number), -1)

    def albedo(self, si: SurfaceInteraction3f, active: Bool = True) -> Float:
        """Return the radiance of surfaces under a uniform sky of radiance 1, without mirror images.

        It equals the fraction of light from the viewer's direction that the surface scatters: the reflectance of a
        diffuse surface; for glossy surfaces it depends on direction. It is 0 on the back of one-sided surfaces.
        """
        active = active & si.is_valid() & ((si.wi.z > 0) | (self._gather_fact("two_sided", si) > 0))
        reflectance = si.bsdf().eval_diffuse_reflectance(view_along_normal(si), active)[0]
        if not self.glossy:
            return dr.select(active, reflectance, 0.0)
        last = len(_ALBEDO_COSINES) - 1
        place = dr.minimum(dr.abs(si.wi.z), 1.0) * last
        below = mi.UInt32(dr.minimum(dr.floor(place), last - 1))
        start = _read_registry_number(si.shape) * (last + 1) + below
        black, per_unit = (
            dr.lerp(
                dr.gather(mi.Float, self._facts[key], start, active),
                dr.gather(mi.Float, self._facts[key], start + 1, active),
                place - below,
            )
            for key in ("albedo_black", "albedo_per_unit")
        )
        return dr.select(active, black + per_unit * reflectance, 0.0)

    def _gather_fact(self, key: str, si: SurfaceInteraction3f) -> Float:
        return dr.gather(mi.Float, self._facts[key], _read_registry_number(si.shape), si.is_valid())


def build_objects(
    scene: Scene, *, medium_index: float, wavelength_nm: float, gloss: bool = True, seed: int = 0
) -> Objects:
    """Build all objects of a scene in a medium for the laser's wavelength; without ``gloss`` diffuse, without mirrors.

    Random reflectances are drawn from ``seed`` and the objects' numbers. DescriptionError if a mesh or texture file is
    missing, unreadable or empty; RangeError if the wavelength is outside the table of a metal.
    """
    register_textures()
    optics = {"medium_index": medium_index, "wavelength_nm": wavelength_nm}
    things = scene.objects
    placed = list(zip(things, scene.object_poses(), strict=True))
    shapes = [
        _make_shape(
            thing,
            pose,
            finish_bsdf(thing, gloss=gloss, pose=pose, seed=(seed, number, _SURFACE_STREAM), **optics),
            seed=(seed, number, _RELIEF_STREAM),
        )
        for number, (thing, pose) in enumerate(placed)
    ]
    flat = np.zeros_like(_ALBEDO_COSINES), np.ones_like(_ALBEDO_COSINES)
    glossy = [gloss and thing.finish_properties().reflection != "diffuse" for thing in things]
    parts = [
        albedo_parts(thing, _ALBEDO_COSINES, **optics) if shines else flat
        for thing, shines in zip(things, glossy, strict=True)
    ]
    spreads = [body_spread(thing, medium_index=medium_index) for thing in things]
    facts = {
        "mirror": [thing.mirror_share() if gloss else 0.0 for thing in things],
        "polarisation": [thing.polarisation() for thing in things],
        "roughness_um": [thing.finish_properties().roughness_um for thing in things],
        "number": list(range(len(things))),
        "two_sided": [_is_two_sided(thing) for thing in things],
        "albedo_black": [black for black, _ in parts],
        "albedo_per_unit": [per_unit for _, per_unit in parts],
        "retroreflection": [thing.retroreflection for thing in things],
        **{f"spread_{each.name}": [getattr(spread, each.name) for spread in spreads] for each in fields(LateralSpread)},
    }
    # With optimisation, Mitsuba would merge meshes of equal BSDF into one shape. Without robust intersections, one ray
    # in about ten thousand would pass through the edge between two facets.
    whole = {"type": "scene", "embree_use_robust_intersections": True}
    whole = mi.load_dict(whole | {f"object_{i}": shape for i, shape in enumerate(shapes)}, optimize=False)
    return Objects(
        scene=whole,
        coherent=mi.Bool(any(shape.is_mesh() for shape in shapes)),
        glossy=any(glossy),
        retroreflects=any(thing.retroreflection > 0 for thing in things),
        translucent=any(spread.path_mm > 0 for spread in spreads),
        mirrors=tuple(face for thing, pose in placed if gloss for face in _mirror_faces(thing, pose)),
        _facts={key: _arrange_by_registry(shapes, np.array(values, float)) for key, values in facts.items()},
    )


def _read_registry_number(shape: mi.ShapePtr) -> UInt32:
    """Return the numbers of shapes in Dr.Jit's registry."""
    return cast(Any, dr.reinterpret_array(mi.UInt32, shape))


def _arrange_by_registry(shapes: list[mi.Shape], values: np.ndarray) -> Float:
    """Arrange values (objects,) or (objects, N) by the shapes' numbers in Dr.Jit's registry."""
    number = [int(_read_registry_number(mi.ShapePtr(shape))[0]) for shape in shapes]
    table = np.zeros((max(number) + 1, *values.shape[1:]), np.float32)
    table[number] = values
    flat = to_jit(table)
    dr.eval(flat)
    return flat


def _make_shape(thing: AnyObject, pose: np.ndarray, bsdf: mi.BSDF, *, seed: tuple[int, ...]) -> mi.Shape:
    """Return the shape of an object at its pose (4, 4) in the scene; ``seed`` is that of its relief."""
    surface = _triangulate(thing)
    if surface is None:
        assert not isinstance(thing, Mesh | FreeForm)
        kind, matrix = _place_primitive(thing, pose)
        return mi.load_dict({"type": kind, "to_world": mi.ScalarTransform4f(matrix), "bsdf": bsdf})
    if thing.finish_properties().relief_mm > 0:
        surface = add_relief(surface, thing.finish_properties(), np.random.default_rng(seed))
    return _make_mesh(surface, pose, mi.load_dict({"type": "twosided", "bsdf": bsdf}) if _is_two_sided(thing) else bsdf)


def _triangulate(thing: AnyObject) -> tuple[np.ndarray, ...] | None:
    """Return the mesh of an object in its own frame, as for `_make_mesh`; None if one of Mitsuba's primitives shows it.

    Under a relief, facets of spheres and pipes deviate by less than 2e-4 of the diameter.
    """
    rough = thing.finish_properties().relief_mm > 0
    match thing:
        case Mesh():
            return _load_surface(thing)
        case FreeForm():
            return thing.surface()
        case CirclePlate() | TargetPlate() if thing.bow_mm != 0:
            return bowed_plate(*thing.bounds_mm(), bow_mm=thing.bow_mm)
        case Block() if thing.edge_radius_mm > 0:
            return rounded_box(np.array(thing.size_mm), radius_mm=thing.edge_radius_mm)
        case Block() | Ball() if rough:
            from trimesh.creation import box, icosphere

            solid = icosphere(5, thing.diameter_mm / 2) if isinstance(thing, Ball) else box(thing.size_mm)
            return solid.vertices, solid.faces
        case Pipe() if rough:
            around = np.linspace(0, 2 * np.pi, 360, endpoint=False)
            return tube(np.array([-0.5, 0.5]) * thing.length_mm, around, np.full((2, 360), thing.diameter_mm / 2))
        case Plate() if rough:
            half = np.array([thing.width_mm, thing.height_mm]) / 2
            return bowed_plate(-half, half, bow_mm=0.0, cells=1)
    return None


def _place_primitive(
    thing: Ball | Block | Pipe | CirclePlate | TargetPlate | Plate, pose: np.ndarray
) -> tuple[str, np.ndarray]:
    """Return the name of Mitsuba's primitive for an object, and its transform (4, 4) to the scene."""
    match thing:
        case Ball():
            if thing.texture is None:
                # Mitsuba mistakes rounding errors of a rotated sphere for shear.
                pose = np.block([[np.eye(3), pose[:3, 3:]], [pose[3:]]])
            return "sphere", pose @ _make_scaling(*[thing.diameter_mm / 2] * 3)
        case Block():
            return "cube", pose @ _make_scaling(*(side / 2 for side in thing.size_mm))
        case Pipe():
            matrix = _CYLINDER_AXIS_TO_X @ _make_scaling(thing.diameter_mm / 2, thing.diameter_mm / 2, thing.length_mm)
            matrix[0, 3] = -thing.length_mm / 2
            return "cylinder", pose @ matrix
        case CirclePlate() | TargetPlate():
            first, last = thing.bounds_mm()
            matrix = _FACING_SENSOR @ _make_scaling(*(last - first) / 2, 1)
            matrix[:2, 3] = (first + last) / 2
            return "rectangle", pose @ matrix
        case Plate():
            return "rectangle", pose @ _FACING_SENSOR @ _make_scaling(thing.width_mm / 2, thing.height_mm / 2, 1)
        case _:
            assert_never(thing)


def _is_two_sided(thing: AnyObject) -> bool:
    return isinstance(thing, (Mesh, FreeForm)) or thing.finish_properties().relief_mm > 0


def _make_mesh(surface: tuple[np.ndarray, ...], pose: np.ndarray, bsdf: mi.BSDF) -> mi.Mesh:
    """Return a triangle mesh with its vertices in scene coordinates.

    ``surface`` has vertices (V, 3) in the object's own frame and faces (F, 3), and may have texture coordinates (V, 2).
    """
    vertices, faces, *uv = surface
    vertices = vertices @ pose[:3, :3].T + pose[:3, 3]
    properties = mi.Properties()
    properties["bsdf"] = bsdf
    mesh = mi.Mesh("mesh", len(vertices), len(faces), properties, has_vertex_texcoords=bool(uv))
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = np.ravel(vertices).astype(np.float32)
    parameters["faces"] = np.ravel(faces).astype(np.uint32)
    if uv:
        parameters["vertex_texcoords"] = np.ravel(uv[0]).astype(np.float32)
    parameters.update()
    return mesh


def _load_surface(thing: Mesh) -> tuple[np.ndarray, ...]:
    """Read vertices (V, 3), faces (F, 3) and, if every part has them, texture coordinates (V, 2) of a mesh file.

    Parts are concatenated here: trimesh would also copy their materials, which requires an imaging library.
    """
    import trimesh

    path = thing.path
    require_regular_file(path, most_bytes=_MOST_MESH_BYTES, error=DescriptionError, called="mesh")
    try:
        loaded = trimesh.load(path, force="scene")
    # trimesh passes on any exception of its many readers.
    except Exception as error:
        raise DescriptionError(f"trimesh cannot read {path}: {error}") from error
    assert isinstance(loaded, trimesh.Scene)  # by force="scene"
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
        raise DescriptionError(f"{path} contains no usable surface: {len(triangles)} faces")
    known = [coordinates for coordinates in uv if coordinates is not None]
    everywhere = len(known) == len(uv)
    if thing.texture is not None and not everywhere:
        raise DescriptionError(f"{path} has no texture coordinates for {thing.texture}: add them, or omit the texture")
    return thing.scale * corners, triangles, *([np.concatenate(known)] if everywhere else [])


def _require_surface(part: trimesh.Trimesh, path: str) -> None:
    """Check that a part has vertices (V, 3) and faces (F, 3) of existing vertices; DescriptionError if not."""
    vertices, faces = np.asarray(part.vertices), np.asarray(part.faces)
    shaped = [each.ndim == 2 and each.shape[1] == 3 for each in (vertices, faces)]
    if not all(shaped) or (faces.size and not 0 <= faces.min() <= faces.max() < len(vertices)):
        raise DescriptionError(
            f"{path} contains no usable surface: its vertices are of shape {vertices.shape}, its faces {faces.shape}; "
            "expected three coordinates per vertex and three existing vertices per face"
        )


def _mirror_faces(thing: AnyObject, pose: np.ndarray) -> Iterator[MirrorFace]:
    """Yield the mirrors of one object at its pose (4, 4) in the scene; only flat objects have any."""
    if isinstance(thing, Block) and thing.mirror > 0:
        half = np.array(thing.size_mm) / 2
        for axes in _BLOCK_FACES:
            face = np.eye(4)
            face[:3, :3], face[:3, 3] = axes, axes[:, 2] * half
            yield MirrorFace(pose @ face, np.abs(axes.T @ half)[:2], thing.mirror)
    elif isinstance(thing, Plate) and thing.mirror > 0:
        yield MirrorFace(pose @ _FACING_SENSOR, np.array([thing.width_mm, thing.height_mm]) / 2, thing.mirror)


def _make_scaling(*factors: float) -> np.ndarray:
    """Return the transform (4, 4) that scales along x, y and z."""
    return np.diag([*factors, 1.0])
