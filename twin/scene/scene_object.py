"""Common properties of all objects in a scene: pose, finish, and triangles of free forms."""

from abc import ABC, abstractmethod
from collections.abc import Hashable
from functools import lru_cache
from typing import Annotated, ClassVar, Literal, Self, cast

import numpy as np
from pydantic import AfterValidator, Field, model_validator
from scipy.spatial.transform import Rotation

from uwlts.model.sensor import Description, NotNegative, Positive, Vector

Reflectance = Annotated[float, Field(ge=0, le=1)]
Finish = Literal["diffuse", "painted", "pvc", "metal"]

TYPICAL_ALPHA = {"diffuse": 1.0, "painted": 0.3, "pvc": 0.15, "metal": 0.3}
"""GGX roughness of a satin paint, an extruded pipe, and ground steel."""
TYPICAL_ROUGHNESS_UM = {"diffuse": 5.0, "painted": 5.0, "pvc": 5.0, "metal": 1.0}
"""Rms heights in um; light from a diffuse body has travelled some um inside it, whatever the surface roughness."""


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

    ``finish`` selects the reflection model: "diffuse" is Lambertian; "painted" and "pvc" are a diffuse body under a
    clear, slightly rough coat; "metal" is rough steel. ``reflectance`` is the diffuse reflectance, that of the body
    under a coat, or the scale of a metal's reflection. It is multiplied by the grey values (0 to 1) of the picture
    ``texture``. The shape's uv coordinates map the picture, with its last row at v = 0; a relative path starts at the
    scene's folder. ``alpha`` is the GGX roughness of coat or metal (Walter et al. 2007), ``roughness_um``
    the rms height of the surface.
    """

    reflectance: Reflectance = 0.8
    finish: Finish = "diffuse"
    alpha: Annotated[float, Field(ge=0.02, le=1)] | None = None
    roughness_um: NotNegative | None = None
    texture: str | None = None

    _no_texture: ClassVar[str] = ""
    """Reason why objects of a class have no texture."""

    @model_validator(mode="after")
    def _has_what_its_finish_and_shape_take(self) -> Self:
        if self.texture is not None and self._no_texture:
            raise ValueError(f"texture {self.texture} {self._no_texture}")
        if self.finish == "diffuse" and self.alpha is not None:
            raise ValueError(f"alpha {self.alpha:g} is for glossy finishes, but finish is 'diffuse': omit alpha")
        return self

    def gloss_alpha(self) -> float:
        """Return the GGX roughness; the default depends on the finish."""
        return TYPICAL_ALPHA[self.finish] if self.alpha is None else self.alpha

    def rms_height_um(self) -> float:
        """Return the rms height of the surface in um; the default depends on the finish."""
        return TYPICAL_ROUGHNESS_UM[self.finish] if self.roughness_um is None else self.roughness_um

    def mirror_share(self) -> float:
        """Return the specular reflectance of a plane mirror."""
        return getattr(self, "mirror", 0.0)

    def polarisation(self) -> float:
        """Return the degree of polarisation of scattered laser light: 1 for metals and mirrors, else 0."""
        return 1.0 if self.finish == "metal" or self.mirror_share() > 0 else 0.0


class FlatObject(SceneObject):
    """Base of objects with flat faces, which may be mirrors.

    ``mirror`` is the specular reflectance of the faces, in addition to scattering. A small ``reflectance`` causes the
    weak stripe on a mirror.
    """

    mirror: Reflectance = 0.0

    @model_validator(mode="after")
    def _reflects_at_most_all(self) -> "FlatObject":
        if self.reflectance + self.mirror > 1:
            both = f"reflectance {self.reflectance:g} and mirror {self.mirror:g}"
            raise ValueError(f"{both} add up to more than 1: reduce one of them")
        if self.mirror > 0 and self.finish in ("painted", "pvc"):
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

    Each class is a module of `twin.scene.forms`, with its description, formula and triangles.
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
