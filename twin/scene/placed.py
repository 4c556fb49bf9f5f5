"""What all objects of a scene have: a pose, a finish, and the triangles of free forms."""

from abc import ABC, abstractmethod
from collections.abc import Hashable
from functools import lru_cache
from typing import Annotated, ClassVar, Literal, Self, cast

import numpy as np
from pydantic import Field, model_validator
from scipy.spatial.transform import Rotation

from uwlts.model.sensor import Description, NotNegative, Vector

Reflectance = Annotated[float, Field(ge=0, le=1)]
Finish = Literal["diffuse", "painted", "pvc", "metal"]

TYPICAL_ALPHA = {"diffuse": 1.0, "painted": 0.3, "pvc": 0.15, "metal": 0.3}
"""GGX roughness: a satin paint, an extruded pipe, ground steel."""
TYPICAL_ROUGHNESS_UM = {"diffuse": 5.0, "painted": 5.0, "pvc": 5.0, "metal": 1.0}
"""Rms heights in um. Light out of a diffuse body has run through some um of it, whatever its surface."""


class Pose(Description):
    """Placement of an object: rotated about the scene's X, then Y, then Z axis, then moved."""

    position_mm: Vector = (0.0, 0.0, 0.0)
    rotation_deg: Vector = (0.0, 0.0, 0.0)

    def matrix(self) -> np.ndarray:
        """Rigid transform (4, 4) from the object's own frame to the parent's."""
        transform = np.eye(4)
        transform[:3, :3] = Rotation.from_euler("xyz", self.rotation_deg, degrees=True).as_matrix()
        transform[:3, 3] = self.position_mm
        return transform


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


class FreeForm(Placed, ABC):
    """Base of free-form surfaces, known in closed form. They have no uv coordinates for a texture.

    Such an object is one module of `twin.scene.forms`: its description, its formula and its triangles.
    """

    _no_texture: ClassVar[str] = "on a surface without uv coordinates: leave it out, or use a mesh"

    @abstractmethod
    def triangles(self) -> tuple[np.ndarray, np.ndarray]:
        """Vertices (V, 3) in mm in the object's own frame and faces (F, 3), anticlockwise seen from outside."""

    def surface(self) -> tuple[np.ndarray, np.ndarray]:
        """The same arrays, kept for the next caller: they cannot be written to."""
        # Frozen models are hashable, which type checkers do not see.
        return _kept(cast(Hashable, self))


@lru_cache(maxsize=4)
def _kept(form: FreeForm) -> tuple[np.ndarray, np.ndarray]:
    vertices, faces = form.triangles()
    vertices.flags.writeable = faces.flags.writeable = False
    return vertices, faces
