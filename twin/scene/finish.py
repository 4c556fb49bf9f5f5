"""Finishes of surfaces under water as Mitsuba's BSDFs of all but the mirror image."""

from __future__ import annotations

from pathlib import Path
from typing import cast

import drjit as dr
import mitsuba as mi
import numpy as np

from twin.backend.arrays import Float
from twin.scene.description import Flat, Placed, Printed
from twin.scene.pattern import pattern_texture
from uwlts.model.errors import DescriptionError
from uwlts.model.media import check_range

COAT_INDEX = {"painted": 1.50, "pvc": 1.54}
"""Relative to air: an alkyd or acrylic binder, and rigid PVC."""

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
    """Refractive index n + i k of iron, for steel, relative to air; linear between the table's wavelengths.

    RangeError where the wavelength lies outside the table's visible part.
    """
    wavelength, n, k = _IRON
    source = "the table of Johnson and Christy (1974)"
    check_range("wavelength_nm", wavelength_nm, wavelength[0], wavelength[-1], source)
    return complex(np.interp(wavelength_nm, wavelength, n), np.interp(wavelength_nm, wavelength, k))


def finish_bsdf(thing: Placed, *, medium_index: float, wavelength_nm: float, gloss: bool = True) -> mi.BSDF:
    """BSDF of an object in a medium, without its mirror share.

    Without ``gloss`` everything is diffuse: a body without its coat, and a metal with the reflectance |(m - 1) /
    (m + 1)|^2 of its smooth face at normal incidence (Fresnel). DescriptionError where the texture is missing,
    unreadable, or its values lie outside 0 to 1; RangeError where the wavelength lies outside the table of iron.
    """
    if gloss and thing.finish != "diffuse":
        return _glossy(thing, _reflectance(thing), medium_index=medium_index, wavelength_nm=wavelength_nm)
    scale = 1.0
    if thing.finish == "metal":
        index = iron_index(wavelength_nm=wavelength_nm) / medium_index
        scale = abs((index - 1) / (index + 1)) ** 2
    return mi.load_dict({"type": "diffuse", "reflectance": _reflectance(thing, scale)})


def _glossy(thing: Placed, reflectance: float | mi.Texture, *, medium_index: float, wavelength_nm: float) -> mi.BSDF:
    """A metal or coated body of a given reflectance; indices are those relative to the medium around it."""
    rough = {"distribution": "ggx", "alpha": thing.gloss_alpha()}
    if thing.finish == "metal":
        index = iron_index(wavelength_nm=wavelength_nm) / medium_index
        metal = {"type": "roughconductor", "eta": index.real, "k": index.imag, "sample_visible": True}
        return mi.load_dict(metal | rough | {"specular_reflectance": reflectance})
    coat = {"type": "roughplastic", "int_ior": COAT_INDEX[thing.finish], "ext_ior": medium_index, "nonlinear": False}
    return mi.load_dict(coat | rough | {"diffuse_reflectance": reflectance})


def _reflectance(thing: Placed, scale: float = 1.0) -> float | mi.Texture:
    """Reflectance of an object, a number or a texture, times ``scale``."""
    if isinstance(thing, Printed):
        return pattern_texture(thing.dimmed(scale))
    if thing.texture is None:
        return scale * thing.reflectance
    # Texture coordinates count v upwards from a picture's last row; Mitsuba counts its rows from the first.
    grey = scale * thing.reflectance * read_grey(thing.texture)[::-1]
    picture = mi.Bitmap(np.ascontiguousarray(grey[..., None], dtype=np.float32))
    wrap_mode = "clamp" if isinstance(thing, Flat) else "repeat"
    return mi.load_dict({"type": "bitmap", "bitmap": picture, "raw": True, "wrap_mode": wrap_mode})


def read_grey(path: str | Path) -> np.ndarray:
    """Grey values (H, W) of a picture, full scale as 1, taken as they are: they are linear, not gamma-coded.

    DescriptionError where the file is missing, no picture that Mitsuba reads, or its values lie outside 0 to 1.
    """
    if not Path(path).is_file():
        raise DescriptionError(f"no texture at {path}")
    try:
        picture = mi.Bitmap(str(path))
        # A picture marked as gamma-coded would be made linear by the conversion.
        picture.set_srgb_gamma(False)
        grey = np.array(picture.convert(mi.Bitmap.PixelFormat.Y, mi.Struct.Type.Float32, False))
    except RuntimeError as error:
        readable = "picture that Mitsuba reads as a texture (PNG, JPEG, EXR, ...)"
        raise DescriptionError(f"{path} is no {readable}: {error}") from error
    grey = grey.reshape(grey.shape[:2])
    if grey.size == 0 or not (np.isfinite(grey).all() and grey.min() >= 0 and grey.max() <= 1):
        raise DescriptionError(f"{path} has grey values outside 0 to 1; a texture multiplies the reflectance")
    return grey


def directional_albedo(bsdf: mi.BSDF, cosines: np.ndarray, *, samples: int = 4096) -> np.ndarray:
    """Share (N,) of light from a direction that a surface scatters into its hemisphere, for cosines (N,) to the normal.

    As BSDFs are reciprocal, it is also the radiance towards that direction under a sky of radiance 1 all around. The
    integral is the mean of Mitsuba's sample weights over a rank-1 lattice with the golden ratio's generalisation
    (Roberts 2018), good to 1e-3.
    """
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
    thing: Placed, cosines: np.ndarray, *, medium_index: float, wavelength_nm: float
) -> tuple[np.ndarray, np.ndarray]:
    """Directional albedo (N,) of a glossy finish over a black body, and what a unit of Mitsuba's reflectance adds.

    The albedo of coated bodies and of metals is linear in ``reflectance``, so the two give it for textures too.
    """
    black, white = (_glossy(thing, grey, medium_index=medium_index, wavelength_nm=wavelength_nm) for grey in (0.0, 1.0))
    # A metal does not have a diffuse reflectance; Mitsuba returns pi times its BSDF at normal incidence instead.
    square = square_on(dr.zeros(mi.SurfaceInteraction3f))
    unit = float(cast(Float, white.eval_diffuse_reflectance(square))[0][0])
    without = directional_albedo(black, cosines)
    return without, (directional_albedo(white, cosines) - without) / unit


def square_on(si: mi.SurfaceInteraction3f) -> mi.SurfaceInteraction3f:
    """The same places seen along their normals from outside."""
    straight = mi.SurfaceInteraction3f(si)
    straight.wi = mi.Vector3f(0.0, 0.0, 1.0)
    return straight
