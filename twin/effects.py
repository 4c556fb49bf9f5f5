"""What a rendered image shows besides the bare geometry; everything can be left out on its own."""

from dataclasses import dataclass, fields, replace

from uwlts.errors import DescriptionError


@dataclass(frozen=True)
class Effects:
    """Which effects are rendered. Geometry, refraction and extinction are always there."""

    defocus: bool = True
    """The lens's finite pupil: blur before and behind the focused plane, and the window's own aberration."""
    haze: bool = True
    """Light that the water scatters once out of the sheet towards the camera."""
    multiple_scattering: bool = True
    """Light scattered on the laser's and on the camera's way, once or more often."""
    secondary_light: bool = True
    """Light that goes from one surface to another, and the images in mirrors."""
    gloss: bool = True
    """Glossy, metallic and mirror finishes; without it every surface is diffuse."""
    motion: bool = True
    """The stage's travel during an exposure and the rows' delay of a rolling shutter."""
    ambient: bool = True
    """Daylight on top of the laser's light."""
    speckle: bool = True
    """Grain of the coherent light."""
    fixed_pattern: bool = True
    """Differences between the detector's pixels."""
    noise: bool = True
    """Shot noise, dark noise and read noise."""

    def names(self) -> list[str]:
        """The effects that are rendered, as a user writes them."""
        return [f.name.replace("_", "-") for f in fields(self) if getattr(self, f.name)]

    def without(self, *names: str) -> "Effects":
        """The same with some effects left out; DescriptionError for an unknown name."""
        known = ALL.names()
        for name in names:
            if name not in known:
                raise DescriptionError(f"unknown effect '{name}'; known are {', '.join(known)}")
        return replace(self, **{name.replace("-", "_"): False for name in names})


ALL = Effects()
NONE = ALL.without(*ALL.names())
