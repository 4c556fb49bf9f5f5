"""Light of a sheet after its spread in the translucent bodies of objects (`twin.scene.subsurface`).

The surface is treated as its tangent plane within the spread, with the irradiance of the sheet's centre. Shadows and
edges are those of the point where the light leaves, so light does not pass around an edge inside the body.
"""

from __future__ import annotations

from collections.abc import Sequence

import drjit as dr
import mitsuba as mi

from twin.backend.arrays import Float, SurfaceInteraction3f, Vector3f
from twin.light.sheet import Part, SheetLight
from twin.scene.objects import Objects


def spread_irradiance(
    objects: Objects, si: SurfaceInteraction3f, normal: Vector3f, here: SheetLight, parts: Sequence[Part]
) -> Float:
    """Return the irradiance in W/mm2 that light leaving the bodies at surface points ``si`` stands for.

    Along the surface, the distance from the sheet changes by the sine of the angle between surface and sheet normal.
    Each Gaussian of the spread thus adds its variance times the squared sine to that of the sheet, the Gaussians
    ``parts``. The mean exit point is displaced along the tangential part of the light's direction. ``normal`` is the
    unit normal in the OCS, ``here`` the light of the sheet there.
    """
    across = dr.dot(normal, here.normal)
    tilted, variance = 1 - dr.square(across), dr.square(here.sigma_mm)
    cosine = dr.dot(here.direction, normal)
    ahead = dr.dot(here.direction, here.normal) - cosine * across
    distance = here.distance_mm - objects.spread_ahead_mm(si, cosine) * ahead
    total = mi.Float(0.0)
    for share, offset, radius in parts:
        squared, narrow = dr.square(distance - offset * here.sigma_mm), variance * dr.square(radius)
        for weight, added in objects.spread_parts(si):
            wide = narrow + added * tilted
            total += share * weight * dr.sqrt(variance / wide) * dr.exp(-0.5 * squared / wide)
    return here.in_middle * total


def lit_sigma_mm(objects: Objects, si: SurfaceInteraction3f, normal: Vector3f, here: SheetLight) -> Float:
    """Return the standard deviation that bounds the light at surface points, as that of a sheet without spread would.

    The widest Gaussian holds so little of the light that half its standard deviation is enough.
    """
    tilted = 1 - dr.square(dr.dot(normal, here.normal))
    _, widest = objects.spread_parts(si)[-1]
    return dr.sqrt(dr.square(here.sigma_mm) + 0.25 * widest * tilted)
