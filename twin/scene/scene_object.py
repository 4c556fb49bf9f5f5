"""Common properties of all objects in a scene: pose, finish, and triangles of free forms."""

from abc import ABC, abstractmethod
from collections.abc import Hashable
from dataclasses import fields, replace
from functools import lru_cache
from typing import Annotated, ClassVar, Self, cast

import numpy as np
from pydantic import AfterValidator, Field, model_validator
from scipy.spatial.transform import Rotation

from twin.scene.surfaces import FINISHES, LARGEST_CLIPPED, Finish, FinishProperties, clipped_share
from uwlts.model.sensor import Description, NotNegative, Positive, Vector

Reflectance = Annotated[float, Field(ge=0, le=1)]


class Pose(Description):
    """Pose of an object: rotation about the scene's X, then Y, then Z axis, then translation."""

    position_mm: Vector = (0.0, 0.0, 0.0)
    rotation_deg: Vector = (0.0, 0.0, 0.0)

    def matrix(self) -> np.ndarray:
        """Return the rigid transform (4, 4) from the object's own frame to the parent frame."""
        transform = np.eye(4)
        transform[:3, :3] = Rotation.from_euler("xyz", self.rotation_deg, degrees=True).as_matrix()
        transform[:3, 3] = self.position_mm
        return transform


class SceneObject(Pose):
    """Base of all objects: a pose and a finish.

    ``finish`` names a row of `twin.scene.surfaces.FINISHES`, from which the properties are taken that are not given. It
    selects the reflection model: "diffuse" is Lambertian; "painted" and "pvc" are a diffuse body under a clear,
    slightly rough coat; "metal" is rough steel. ``reflectance`` is the diffuse reflectance, that of the body under a
    coat, or the scale of a metal's reflection. ``alpha`` is the GGX roughness of coat or metal (Walter et al. 2007),
    ``roughness_um`` the rms height of the surface.

    The reflectance is multiplied by the grey values (0 to 1) of the picture ``texture``, or by a random field. The
    shape's uv coordinates map the picture, with its last row at v = 0; a relative path starts at the scene's folder.
    The random field is log-normal with mean 1 and the standard deviation ``mottle``; products are limited to 1. Its
    autocorrelation falls to 1 / e at the distance ``mottle_mm``, one length or one along each of the object's axes
    (`twin.scene.surfaces.draw_waves`). It is fixed to the object, and drawn from the seed of the recording.

    Random patches of the diffuse reflectance ``patch_reflectance``, such as growth or stains, cover the fraction
    ``patch_share`` of the surface. A line on the surface is within a patch for ``patch_length_mm`` on average.

    ``mean_free_path_mm`` is the transport mean free path of light in a translucent body, which widens the stripe and
    shifts it ahead along the laser's direction (`twin.scene.surfaces`); 0 for an opaque one.

    The surface is displaced along its normals by random heights of the rms ``relief_mm``, so that slopes, shadows and
    the stripe's path follow; ``relief_length_mm`` is the correlation length, one or one along each axis, and
    ``relief_exponent`` the Hurst exponent (`twin.scene.forms.triangles.add_relief`).

    ``retroreflection`` is the coefficient of retroreflected luminance in cd/m2/lx (CIE 17-24-104), for tapes and marks
    that return the light of the lamp beside the camera. The laser is too far beside: its stripe shows ``reflectance``.
    """

    reflectance: Reflectance | None = None
    finish: Finish = "diffuse"
    alpha: Annotated[float, Field(ge=0.02, le=1)] | None = None
    roughness_um: NotNegative | None = None
    texture: str | None = None
    mottle: Annotated[float, Field(ge=0, le=1)] | None = None
    mottle_mm: Positive | tuple[Positive, Positive, Positive] | None = None
    mean_free_path_mm: Annotated[float, Field(ge=0, le=10)] | None = None
    patch_share: Annotated[float, Field(ge=0, le=0.8)] | None = None
    patch_length_mm: Positive | None = None
    patch_reflectance: Reflectance | None = None
    relief_mm: NotNegative | None = None
    relief_length_mm: Positive | tuple[Positive, Positive, Positive] | None = None
    relief_exponent: Annotated[float, Field(gt=0, le=1)] | None = None
    retroreflection: NotNegative = 0.0

    _no_texture: ClassVar[str] = ""
    """Reason why objects of a class have no picture as texture."""
    _no_mottle: ClassVar[str] = ""
    """Reason why the reflectance of objects of a class does not vary."""
    _relief_has_uv: ClassVar[bool] = False  # whether a picture can be on a relief

    @model_validator(mode="after")
    def _check_finish(self) -> Self:
        finish = self.finish_properties()
        if self.texture is not None and self._no_texture:
            raise ValueError(f"texture {self.texture} {self._no_texture}")
        if finish.reflection == "diffuse" and self.alpha is not None:
            raise ValueError(f"alpha {self.alpha:g} is for glossy finishes, but finish is '{self.finish}': omit alpha")
        for name in ("mottle", "patch_share", "relief_mm"):
            value = getattr(finish, name)
            if value > 0 and self._no_mottle:
                raise ValueError(f"{name} {value:g} of the finish '{self.finish}' {self._no_mottle} {name} = 0")
            if value > 0 and self.texture is not None and not (name == "relief_mm" and self._relief_has_uv):
                raise ValueError(f"texture {self.texture} and {name} {value:g}: use one of them, or {name} = 0")
        if finish.mean_free_path_mm > 0 and finish.reflection == "metal":
            raise ValueError(f"mean_free_path_mm {finish.mean_free_path_mm:g} in a metal: light does not enter it")
        if (lost := clipped_share(finish.reflectance, finish.mottle)) > LARGEST_CLIPPED:
            raise ValueError(
                f"reflectance {finish.reflectance:g} with mottle {finish.mottle:g} would often exceed 1, and lose "
                f"{100 * lost:.1f} % of its mean: reduce one of them"
            )
        return self

    def finish_properties(self) -> FinishProperties:
        """Return the properties of the object's finish, with the given ones in place of those of its row."""
        row = FINISHES[self.finish]
        given = {each.name: getattr(self, each.name, None) for each in fields(row)}
        return replace(row, **{name: value for name, value in given.items() if value is not None})

    def mirror_share(self) -> float:
        """Return the specular reflectance of a plane mirror."""
        return getattr(self, "mirror", 0.0)

    def draws_depths(self) -> bool:
        """Return whether the object has flaws of drawn depths; each campaign draws them again."""
        return False

    def polarisation(self) -> float:
        """Return the degree of polarisation of scattered laser light: 1 for metals and mirrors, else 0."""
        return 1.0 if self.finish_properties().reflection == "metal" or self.mirror_share() > 0 else 0.0


class FlatObject(SceneObject):
    """Base of objects with flat faces, which may be mirrors.

    ``mirror`` is the specular reflectance of the faces, in addition to scattering. A small ``reflectance`` causes the
    weak stripe on a mirror.
    """

    mirror: Reflectance = 0.0

    @model_validator(mode="after")
    def _check_reflectances(self) -> "FlatObject":
        finish = self.finish_properties()
        if finish.reflectance + self.mirror > 1:
            both = f"reflectance {finish.reflectance:g} and mirror {self.mirror:g}"
            raise ValueError(f"{both} add up to more than 1: reduce one of them")
        if self.mirror > 0 and finish.relief_mm > 0:
            raise ValueError(f"mirror {self.mirror:g} on a relief of {finish.relief_mm:g} mm: use one of them")
        if self.mirror > 0 and finish.reflection in ("painted", "pvc"):
            raise ValueError(f"mirror {self.mirror:g} under a coat: use the finish 'diffuse' or 'metal' for a mirror")
        return self


def _check_range(ends: tuple[float, float]) -> tuple[float, float]:
    if ends[0] > ends[1]:
        raise ValueError(f"the range [{ends[0]:g}, {ends[1]:g}] must begin with its smaller end")
    return ends


Range = Annotated[tuple[Positive, Positive], AfterValidator(_check_range)]
"""Least and largest value of a size that is drawn."""


class FreeForm(SceneObject, ABC):
    """Base of free-form surfaces given by closed-form equations. They have no uv coordinates for a texture.

    The classes are in `twin.scene.forms`.
    """

    _no_texture: ClassVar[str] = "on a surface without uv coordinates: leave it out, or use a mesh"

    @abstractmethod
    def triangles(self) -> tuple[np.ndarray, np.ndarray]:
        """Return vertices (V, 3) in mm in the object's own frame and faces (F, 3), anticlockwise seen from outside."""

    def surface(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the arrays of `triangles`, cached and read-only."""
        # Frozen models are hashable, which type checkers do not see.
        return _cache_triangles(cast(Hashable, self))


@lru_cache(maxsize=4)
def _cache_triangles(form: FreeForm) -> tuple[np.ndarray, np.ndarray]:
    vertices, faces = form.triangles()
    vertices.flags.writeable = faces.flags.writeable = False
    return vertices, faces
