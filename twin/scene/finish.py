"""Surface finishes under water as Mitsuba BSDFs, without specular mirror reflection.

Patterns of calibration targets and random fields are textures that are evaluated exactly at every point: the texels of
a bitmap would blur their edges.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import cast

import drjit as dr
import mitsuba as mi
import numpy as np
from pydantic import TypeAdapter

from twin.backend.arrays import Bool, Float, Point3f, SurfaceInteraction3f, UInt32, opaque, to_jit
from twin.scene.description import AnyObject, FlatObject, PrintedPlate, SceneObject
from twin.scene.surfaces import (
    WAVES,
    FinishProperties,
    LateralSpread,
    draw_patches,
    draw_waves,
    lateral_spread,
    log_deviation,
    move_waves,
)
from uwlts.errors import DescriptionError, ImageError
from uwlts.model.media import check_range
from uwlts.storage.image_file import read_image

_LUMINANCE = np.array([0.0722, 0.7152, 0.2126], np.float32)
"""Weights of linear blue, green and red: ITU-R BT.709-6, item 3.2."""
_SHIFT = "point_shift_mm"
_CELLS_PER_PATCH = 9
"""Number of grid cells per patch: enough that no cell overlaps two circles of a target."""
_PATCH_VALUES = 8  # columns of the table of patches; the last two are padding, as values are read in groups of four
_WAVES_AT_ONCE = 4
"""Number of waves read together, which takes a third less time than one by one; more are not read faster."""
_ROUNDING_MM = 1e-3  # bound of the single-precision rounding error of positions on a plate of 1 m
COAT_INDEX = {"painted": 1.50, "pvc": 1.54}  # refractive indices in air of an alkyd or acrylic binder, and of rigid PVC

# Wavelength in nm, n and k of iron at room temperature: Johnson and Christy 1974, Phys. Rev. B 9:5056.
_IRON = np.array(
    [
        (397, 2.24, 2.58),
        (413, 2.35, 2.65),
        (431, 2.48, 2.71),
        (451, 2.59, 2.77),
        (471, 2.67, 2.82),
        (496, 2.74, 2.88),
        (521, 2.86, 2.91),
        (549, 2.95, 2.93),
        (582, 2.94, 2.99),
        (617, 2.88, 3.05),
        (659, 2.92, 3.10),
        (704, 2.86, 3.19),
    ]
).T


def iron_index(*, wavelength_nm: float) -> complex:
    """Return the refractive index n + i k of iron, for steel, in air; interpolated linearly.

    RangeError if the wavelength is outside the visible part of the table.
    """
    wavelength, n, k = _IRON
    source = "the table of Johnson and Christy (1974)"
    check_range("wavelength_nm", wavelength_nm, wavelength[0], wavelength[-1], source)
    return complex(np.interp(wavelength_nm, wavelength, n), np.interp(wavelength_nm, wavelength, k))


def finish_bsdf(
    thing: SceneObject,
    *,
    medium_index: float,
    wavelength_nm: float,
    gloss: bool = True,
    pose: np.ndarray | None = None,
    seed: Sequence[int] = (0,),
) -> mi.BSDF:
    """Return the BSDF of an object in a medium, without its mirror reflection.

    Without ``gloss`` all surfaces are diffuse: a body without its coat, and a metal with the reflectance |(m - 1) / (m
    + 1)|^2 of its smooth surface at normal incidence (Fresnel). A random reflectance is drawn from ``seed`` and fixed
    to the object at its ``pose`` (4, 4) in the scene, by default the identity. DescriptionError if the texture is
    missing, unreadable, or has values outside 0 to 1; RangeError if the wavelength is outside the table of iron.
    """
    finish, scale = thing.finish_properties(), 1.0
    field = _make_random_field(finish, np.eye(4) if pose is None else pose, seed)
    if gloss and finish.reflection != "diffuse":
        reflectance = _make_reflectance(thing, scale, field)
        return _make_glossy(thing, reflectance, medium_index=medium_index, wavelength_nm=wavelength_nm)
    if finish.reflection == "metal":
        index = iron_index(wavelength_nm=wavelength_nm) / medium_index
        scale = abs((index - 1) / (index + 1)) ** 2
    return mi.load_dict({"type": "diffuse", "reflectance": _make_reflectance(thing, scale, field)})


def _make_glossy(
    thing: SceneObject, reflectance: float | mi.Texture, *, medium_index: float, wavelength_nm: float
) -> mi.BSDF:
    """Return the BSDF of a metal or coated body; indices are relative to the surrounding medium."""
    finish = thing.finish_properties()
    rough = {"distribution": "ggx", "alpha": finish.alpha}
    if finish.reflection == "metal":
        index = iron_index(wavelength_nm=wavelength_nm) / medium_index
        metal = {"type": "roughconductor", "eta": index.real, "k": index.imag, "sample_visible": True}
        return mi.load_dict(metal | rough | {"specular_reflectance": reflectance})
    coat = {"type": "roughplastic", "int_ior": COAT_INDEX[finish.reflection], "ext_ior": medium_index}
    return mi.load_dict(coat | rough | {"nonlinear": False, "diffuse_reflectance": reflectance})


def _make_random_field(finish: FinishProperties, pose: np.ndarray, seed: Sequence[int]) -> dict[str, object]:
    """Return the waves of mottle and patches in the scene, and the level of the patches; empty if there are none."""
    field: dict[str, object] = {}
    if finish.mottle > 0 and finish.reflectance > 0:
        waves = draw_waves(np.random.default_rng([*seed, 0]), finish.mottle_mm)
        field["mottle_waves"] = move_waves(waves, pose).tolist()
    if finish.patch_share > 0:
        waves, level = draw_patches(
            np.random.default_rng([*seed, 1]), share=finish.patch_share, length_mm=finish.patch_length_mm
        )
        field |= {"patch_waves": move_waves(waves, pose).tolist(), "level": level}
    return field


def _make_reflectance(thing: SceneObject, scale: float, field: dict[str, object]) -> float | mi.Texture:
    """Return the reflectance of an object, a number or a texture, multiplied by ``scale``.

    ``field`` describes its random variation in the scene.
    """
    if isinstance(thing, PrintedPlate):
        return pattern_texture(thing, scale)
    finish = thing.finish_properties()
    if field:
        numbers = {
            "mean": finish.reflectance,
            "mottle": finish.mottle,
            "patch": finish.patch_reflectance,
            "share": finish.patch_share,
        }
        return mi.load_dict({"type": "random_reflectance", "table": json.dumps(field | numbers | {"scale": scale})})
    if thing.texture is None:
        return scale * finish.reflectance
    # Texture coordinate v starts at the last row of the picture, but Mitsuba's rows start at the first.
    grey = scale * finish.reflectance * read_grey(thing.texture)[::-1]
    picture = mi.Bitmap(np.ascontiguousarray(grey[..., None], dtype=np.float32))
    wrap_mode = "clamp" if isinstance(thing, FlatObject) else "repeat"
    return mi.load_dict({"type": "bitmap", "bitmap": picture, "raw": True, "wrap_mode": wrap_mode})


def read_grey(path: str | Path) -> np.ndarray:
    """Read the grey values (H, W) of a picture, relative to full scale and without gamma correction.

    Colours are converted to luminance (ITU-R BT.709). DescriptionError if the file is missing, damaged, or not a PNG,
    JPEG, TIFF or BMP of 8 or 16 bits without transparency.
    """
    try:
        picture = read_image(Path(path))
    except ImageError as error:
        raise DescriptionError(f"texture: {error}") from error
    grey = picture / np.float32(np.iinfo(picture.dtype).max)
    return grey if grey.ndim == 2 else grey @ _LUMINANCE


def directional_albedo(bsdf: mi.BSDF, cosines: np.ndarray) -> np.ndarray:
    """Return the directional-hemispherical reflectance (N,) of a surface for cosines (N,) of the incidence angle.

    As BSDFs are reciprocal, it is also the radiance towards that direction under a uniform sky of radiance 1. The
    integral is the mean of Mitsuba's sample weights over a rank-1 lattice with the generalised golden ratio (Roberts
    2018), accurate to 1e-3.
    """
    samples = 4096
    index = dr.arange(mi.UInt32, len(cosines) * samples)
    sample = cast(Float, mi.Float(index % samples))
    si = dr.zeros(mi.SurfaceInteraction3f, len(cosines) * samples)
    cosine = dr.gather(mi.Float, mi.Float(np.asarray(cosines, np.float32)), index // samples)
    si.wi = mi.Vector3f(dr.safe_sqrt(1 - dr.square(cosine)), 0, cosine)
    scaled = [sample * step for step in (0.7548776662, 0.5698402910)]
    lattice = mi.Point2f(*(place - dr.floor(place) for place in scaled))
    _, weight = bsdf.sample(mi.BSDFContext(), si, (sample + 0.5) / samples, lattice)
    return dr.block_sum(weight[0], samples).numpy().astype(float) / samples


def albedo_parts(
    thing: SceneObject, cosines: np.ndarray, *, medium_index: float, wavelength_nm: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return the directional albedo (N,) of a glossy finish over a black body, and its increase per unit reflectance.

    The albedo of coated bodies and of metals is linear in ``reflectance``, so the two parts apply to textures too.
    """
    black, white = (
        _make_glossy(thing, grey, medium_index=medium_index, wavelength_nm=wavelength_nm) for grey in (0.0, 1.0)
    )
    # For a metal, without diffuse reflectance, Mitsuba returns pi times its BSDF at normal incidence.
    square = view_along_normal(dr.zeros(mi.SurfaceInteraction3f))
    unit = float(cast(Float, white.eval_diffuse_reflectance(square))[0][0])
    without = directional_albedo(black, cosines)
    return without, (directional_albedo(white, cosines) - without) / unit


def body_spread(thing: SceneObject, *, medium_index: float) -> LateralSpread:
    """Return the lateral spread of light in an object's body in a medium."""
    finish = thing.finish_properties()
    return lateral_spread(
        mean_free_path_mm=finish.mean_free_path_mm,
        reflectance=finish.reflectance,
        index=COAT_INDEX.get(finish.reflection, medium_index) / medium_index,
    )


def view_along_normal(si: mi.SurfaceInteraction3f) -> mi.SurfaceInteraction3f:
    """Return the same surface points viewed along their normals from outside."""
    straight = mi.SurfaceInteraction3f(si)
    straight.wi = mi.Vector3f(0.0, 0.0, 1.0)
    return straight


def pattern_texture(plate: PrintedPlate, scale: float = 1.0) -> mi.Texture:
    """Return the texture of a printed plate, multiplied by ``scale``.

    `register_textures` must have been called for the variant.
    """
    return mi.load_dict({"type": "target_pattern", "plate": plate.model_dump_json(), "scale": scale})


def register_textures() -> None:
    """Register the textures ``target_pattern`` and ``random_reflectance`` with the selected Mitsuba variant."""

    class ExactTexture(mi.Texture):
        """Texture of the selected variant that `eval_1` evaluates; ``average`` is its mean."""

        average: float | Float

        def eval(self, si: SurfaceInteraction3f, active: Bool = True) -> Float:
            return self.eval_1(si, active)

        def mean(self) -> Float:
            return mi.Float(self.average)

        def is_spatially_varying(self) -> bool:
            return True

        def to_string(self) -> str:
            return f"{type(self).__name__}[]"

    class TargetPattern(ExactTexture):
        """Reflectance of a printed plate whose uv coordinates run from 0 to 1 over its bounds.

        The print is shifted locally by the error of the nearest target point. Points are assumed to be on a lattice
        along x and y.
        """

        def __init__(self, props: mi.Properties):
            ExactTexture.__init__(self, props)
            plate = cast(PrintedPlate, TypeAdapter(AnyObject).validate_json(str(props["plate"])))
            scale = cast(float, props["scale"])
            self.average = scale * plate.background_reflectance()
            target, (first, last) = plate.described_target(), plate.bounds_mm()
            self.middle, self.size, self.first = ((first + last) / 2).tolist(), (last - first).tolist(), first.tolist()
            self.points_end = target.indices.max(axis=0).tolist()
            corner, beside = target.points_at(np.array([(0, 0), (1, 1)]))[:, :2]
            self.corner_point, self.spacing = corner.tolist(), (beside - corner).tolist()
            self.shift_mm = to_jit(draw_print_errors(plate).ravel())
            patches = _draw_patches(plate, scale)
            lists, self.cell_mm = _list_patches_by_cell(patches, first, last)
            self.rows, self.columns, self.depth = lists.shape
            self.patches = to_jit(patches[lists])

        def traverse(self, cb: mi.TraversalCallback) -> None:
            cb.put(_SHIFT, self.shift_mm, mi.ParamFlags.NonDifferentiable)

        def eval_1(self, si: SurfaceInteraction3f, active: Bool = True) -> Float:
            x = self.middle[0] + (si.uv.x - 0.5) * self.size[0]
            y = self.middle[1] + (0.5 - si.uv.y) * self.size[1]
            i, j = (
                dr.clip(dr.round((place - first) / step), 0, end)
                for place, first, step, end in zip(
                    (x, y), self.corner_point, self.spacing, self.points_end, strict=True
                )
            )
            point = mi.UInt32(j * (self.points_end[0] + 1) + i)
            shift = dr.gather(mi.Point2f, self.shift_mm, point, active)
            x, y = x - shift.x, y - shift.y
            column = dr.clip(dr.floor((x - self.first[0]) / self.cell_mm), 0, self.columns - 1)
            row = dr.clip(dr.floor((y - self.first[1]) / self.cell_mm), 0, self.rows - 1)
            start = 2 * mi.UInt32((row * self.columns + column) * self.depth)
            value = mi.Float(self.average)
            for k in range(self.depth):
                # Adjacent values are read together, in a quarter of the time.
                middle_x, middle_y, half_width, aspect = dr.gather(mi.Vector4f, self.patches, start + 2 * k, active)
                is_round, reflectance, _, _ = dr.gather(mi.Vector4f, self.patches, start + 2 * k + 1, active)
                u, v = x - middle_x, aspect * (y - middle_y)
                in_box = (dr.abs(u) <= half_width) & (dr.abs(v) <= half_width)
                inside = dr.select(is_round > 0, dr.norm(mi.Vector2f(u, v)) < half_width, in_box)
                value = dr.select(inside, reflectance, value)
            return value

    class RandomReflectance(ExactTexture):
        """Log-normal reflectance, limited to 1, with patches of another mean, times a scale.

        Both follow from Gaussian fields of plane waves in the scene.
        """

        def __init__(self, props: mi.Properties):
            ExactTexture.__init__(self, props)
            table = json.loads(str(props["table"]))
            mottle, patches = table.get("mottle_waves"), table.get("patch_waves")
            self.mottle_waves = None if mottle is None else to_jit(np.array(mottle))
            self.patch_waves = None if patches is None else to_jit(np.array(patches))
            mean, share, scale = table["mean"], table["share"], table["scale"]
            deviation = log_deviation(table["mottle"])
            self.gain, self.most = opaque(deviation * math.sqrt(2 / WAVES)), opaque(scale)
            self.middle, self.patch = (opaque(each * math.exp(-(deviation**2) / 2)) for each in (mean, table["patch"]))
            self.level = opaque(table.get("level", 0.0) * math.sqrt(WAVES / 2))
            self.average = opaque(scale * (mean + share * (table["patch"] - mean)))

        def eval_1(self, si: SurfaceInteraction3f, active: Bool = True) -> Float:
            value = mi.Float(self.middle)
            if self.patch_waves is not None:
                value = dr.select(_sum_waves(self.patch_waves, si.p, active) > self.level, self.patch, value)
            if self.mottle_waves is not None:
                value *= dr.exp(self.gain * _sum_waves(self.mottle_waves, si.p, active))
            return self.most * dr.minimum(value, 1.0)

    mi.register_texture("target_pattern", TargetPattern)
    mi.register_texture("random_reflectance", RandomReflectance)


def _sum_waves(waves: Float, p: Point3f, active: Bool) -> Float:
    """Return the sum of cos(k p + phase) of plane waves at points of the scene; ``waves`` are k and phase, flat."""

    kind = cast(type, mi.ArrayXf)

    def add(number: UInt32, total: Float) -> tuple[UInt32, Float]:
        read = dr.gather(kind, waves, number, active, shape=(4 * _WAVES_AT_ONCE, dr.width(p)))
        for x, y, z, phase in zip(*(iter(read),) * 4, strict=True):
            total = total + dr.cos(dr.fma(x, p.x, dr.fma(y, p.y, dr.fma(z, p.z, phase))))
        return number + 1, total

    # Skip the search for loop invariants, as in `Walker`.
    with dr.scoped_set_flag(dr.JitFlag.OptimizeLoops, False):
        _, total = dr.while_loop(
            (dr.zeros(mi.UInt32, dr.width(p)), dr.zeros(mi.Float, dr.width(p))),
            lambda number, total: number < WAVES // _WAVES_AT_ONCE,
            add,
            mode="symbolic",
            label="waves",
        )
    return total


def _draw_patches(plate: PrintedPlate, scale: float) -> np.ndarray:
    """Return centre, half width, aspect ratio, roundness and reflectance (N + 1, 8) of patches.

    Reflectances are multiplied by ``scale``. The last row is a patch that is never hit.
    """
    ink, gap = (scale * each for each in plate.ink_and_gap_reflectance())
    patches = plate.described_target().patches()
    low, high = (
        np.array([(getattr(p, f"x_{end}_mm"), getattr(p, f"y_{end}_mm")) for p in patches]) for end in ("min", "max")
    )
    width, height = (high - low).T
    kinds = [(p.round, ink if p.ink else gap) for p in patches]
    table = np.zeros((len(patches) + 1, _PATCH_VALUES))
    table[:-1, :6] = np.column_stack([(low + high) / 2, width / 2, width / height, kinds])
    table[-1, 2:4] = -1.0, 1.0
    return table


def _list_patches_by_cell(patches: np.ndarray, first: np.ndarray, last: np.ndarray) -> tuple[np.ndarray, float]:
    """Return indices (rows, columns, depth) of the patches that overlap each grid cell, and the cell size in mm.

    They are in printing order; lists are padded with the patch that is never hit.
    """
    middle, half = patches[:-1, :2], patches[:-1, 2:3] / np.column_stack([np.ones(len(patches) - 1), patches[:-1, 3]])
    cell_mm = float(np.sqrt(np.prod(last - first) / (_CELLS_PER_PATCH * len(middle))))
    columns, rows = np.ceil((last - first) / cell_mm).astype(int).tolist()
    start = np.floor((middle - half - first - _ROUNDING_MM) / cell_mm).astype(int).clip(min=0)
    stop = np.floor((middle + half - first + _ROUNDING_MM) / cell_mm).astype(int) + 1
    found: list[list[int]] = [[] for _ in range(rows * columns)]
    for number, ((i, j), (k, m)) in enumerate(zip(start, stop, strict=True)):
        for row in range(j, min(m, rows)):
            for column in range(i, min(k, columns)):
                found[row * columns + column].append(number)
    lists = np.full((rows * columns, max(map(len, found))), len(middle))
    for cell, numbers in zip(lists, found, strict=True):
        cell[: len(numbers)] = numbers
    return lists.reshape(rows, columns, -1), cell_mm


def draw_print_errors(plate: PrintedPlate) -> np.ndarray:
    """Return the print errors (rows, columns, 2) in mm of a target's points along x and y."""
    drawn, target = _draw_normal(plate, 0), plate.described_target()
    rows, columns = np.indices(drawn.shape[:2])
    places = target.points_at(np.column_stack([columns.ravel(), rows.ravel()]))[:, :2].reshape(drawn.shape)
    return plate.centre_std_mm * drawn + np.array(plate.stretch) * places


def shift_points(scene: mi.Scene, plate: PrintedPlate, *, mm_per_px: float, image: int) -> None:
    """Shift the points of a scene's only target by their print errors and their detection errors in one image."""
    noise = mm_per_px * plate.detection_std_px * _draw_normal(plate, 1, image)
    parameters = mi.traverse(scene)
    (key,) = (key for key in dict(parameters) if key.endswith(_SHIFT))
    parameters[key] = to_jit((draw_print_errors(plate) + noise).ravel())
    parameters.update()


def _draw_normal(plate: PrintedPlate, *stream: int) -> np.ndarray:
    """Return random numbers (rows, columns, 2) for the errors of a target's points."""
    columns, rows = plate.described_target().indices.max(axis=0) + 1
    return np.random.default_rng([plate.errors_seed, *stream]).standard_normal((rows, columns, 2))
