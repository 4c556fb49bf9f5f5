"""Options of rendering: samples, seed, the effects that are shown, and Mitsuba's variant.

Call `use_variant` before importing any module of the twin that renders: Mitsuba and Dr.Jit look for libLLVM when they
are imported.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Literal

from twin.backend.llvm import prepare_llvm
from uwlts.model.errors import DescriptionError, SetupError

CPU = "llvm_ad_mono"
GPU = "cuda_ad_mono"
Variant = Literal["llvm_ad_mono", "cuda_ad_mono"]


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


@dataclass(frozen=True)
class Options:
    """Rendering options: samples per lit pixel, seed of all that is random, and what the images show."""

    spp: int = 16
    seed: int = 0
    effects: Effects = ALL

    def __post_init__(self) -> None:
        if not 1 <= self.spp <= 65536:
            raise DescriptionError(f"spp is {self.spp}; take 1 to 65536 samples per lit pixel")
        if self.seed < 0:
            raise DescriptionError(f"seed is {self.seed}; it must not be negative")

    @classmethod
    def chosen(cls, *, spp: int, seed: int, without: Sequence[str], ideal: bool) -> "Options":
        """Options with some effects, or with ``ideal`` all of them, left out."""
        return cls(spp, seed, (NONE if ideal else ALL).without(*without))


def use_variant(name: str = CPU) -> str:
    """Select a monochromatic variant, ``llvm_ad_mono`` or ``cuda_ad_mono``; returns its name.

    Raises
    ------
    SetupError
        libLLVM is missing or too old, there is no CUDA device, or the variant is not one of the two.
    """
    if name not in (CPU, GPU):
        raise SetupError(f"variant '{name}' is not supported; use {CPU} or {GPU}")
    if name == CPU:
        prepare_llvm()
    import mitsuba as mi

    try:
        mi.set_variant(name)
        mi.Float(0.0)
    except (ImportError, RuntimeError) as error:
        raise SetupError(f"Mitsuba cannot use {name} on this machine: {error}") from error
    return name
