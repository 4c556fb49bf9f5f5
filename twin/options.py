"""Options of rendering: samples, seed, the effects and flaws that are shown, and Mitsuba's variant.

Call `use_variant` before importing any module of the twin that renders: Mitsuba and Dr.Jit look for libLLVM when they
are imported.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, Literal

from twin.backend.llvm import prepare_llvm
from uwlts.errors import DescriptionError, SetupError

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
        return [_written(f.name) for f in fields(self) if getattr(self, f.name)]

    def without(self, *names: str) -> "Effects":
        """The same with some effects left out; DescriptionError for an unknown name."""
        known = ALL.names()
        for name in names:
            if name not in known:
                raise DescriptionError(f"unknown effect '{name}'; known are {', '.join(known)}")
        return replace(self, **{name.replace("-", "_"): False for name in names})


def _flaw(*, off: float, typical: float, least: float, most: float) -> Any:
    return field(default=off, metadata={"typical": typical, "range": (least, most)})


@dataclass(frozen=True)
class Flaws:
    """Effects of real recordings that are rendered only where they are asked for, most with a strength.

    DescriptionError where a strength is out of its range.
    """

    glare: float = _flaw(off=0.0, typical=0.02, least=0.0, most=0.5)
    """Share of an image's light that lens and window spread widely over it: veiling glare (ISO 9358)."""
    vignetting: float = _flaw(off=0.0, typical=0.4, least=0.0, most=0.99)
    """Relative loss of light at the image's farthest corner, beyond that by the cosine's fourth power."""
    uneven_lamp: float = _flaw(off=0.0, typical=0.6, least=0.0, most=0.99)
    """Relative loss of the lamp's light half the view's diagonal away from its spot, which lies beside the middle."""
    particles: float = _flaw(off=0.0, typical=1000.0, least=0.0, most=1e5)
    """Grains of marine snow larger than 0.1 mm in a litre, each seen on its own in the laser's sheet."""
    bubbles: float = _flaw(off=0.0, typical=200.0, least=0.0, most=1e5)
    """Air bubbles larger than 0.1 mm in diameter in a litre, which glint in the sheet."""
    caustics: float = _flaw(off=0.0, typical=0.3, least=0.0, most=1.0)
    """Strength of the pattern that a wavy water surface makes of the daylight on surfaces."""
    dirt: float = _flaw(off=0.0, typical=0.1, least=0.0, most=0.9)
    """Share of the camera's window that is covered with spots, which take light in blurred patches of the image."""
    lamp_and_laser: bool = False
    """Lamp and laser on in every image: stripe and board in one."""
    pixel_aspect: float = _flaw(off=1.0, typical=1.002, least=0.9, most=1.1)
    """Focal length in px along y over that along x: pixels so much wider than high."""
    tangential: float = _flaw(off=0.0, typical=1e-3, least=-0.1, most=0.1)
    """Added to the tangential distortion p1 of the lens as built."""
    rolling_shutter: float = _flaw(off=0.0, typical=10.0, least=0.0, most=1000.0)
    """Delay in us from row to row of a rolling shutter, which shows while the stage moves."""
    jpeg: int = _flaw(off=0, typical=90, least=1, most=100)
    """Quality of lossy compression; 8-bit images only."""
    colour_filter: bool = False
    """A colour image sensor (RGGB) in place of a grey one; its red channel is recorded."""
    camera_3d: int = _flaw(off=0, typical=16, least=1, most=32)
    """Steps per pixel of a 3D camera, which finds the stripe itself: laser images are recorded as centre lines."""

    def __post_init__(self) -> None:
        for each in fields(self):
            value, (least, most) = getattr(self, each.name), each.metadata.get("range", (False, True))
            if value != each.default and not least <= value <= most:
                raise DescriptionError(f"{_written(each.name)} is {value:g}; it must be from {least:g} to {most:g}")

    def names(self) -> list[str]:
        """The flaws that are rendered, as a user writes them."""
        present = {f.name: getattr(self, f.name) for f in fields(self) if getattr(self, f.name) != f.default}
        return [_written(name) + ("" if value is True else f"={value:.9g}") for name, value in present.items()]

    @classmethod
    def of(cls, *texts: str) -> "Flaws":
        """Flaws written as NAME, of typical strength, or NAME=STRENGTH.

        DescriptionError for an unknown name, or a strength that is no number, out of its range, or not asked for.
        """
        known = {_written(each.name): each for each in fields(cls)}
        strengths: dict[str, Any] = {}
        for text in texts:
            name, equals, value = text.partition("=")
            if name not in known:
                raise DescriptionError(f"unknown effect '{name}' to add; known are {', '.join(known)}")
            flaw = known[name]
            if "typical" not in flaw.metadata and equals:
                raise DescriptionError(f"{name} takes no strength; found '{text}'")
            try:
                strength = type(flaw.default)(value) if equals else flaw.metadata.get("typical", True)
            except ValueError as error:
                kind = "a whole number" if isinstance(flaw.default, int) else "a number"
                raise DescriptionError(
                    f"the strength of {name} is '{value}'; expected {kind}, as in {name}={flaw.metadata['typical']:g}"
                ) from error
            strengths[flaw.name] = strength
        return cls(**strengths)


def _written(field_name: str) -> str:
    """The name of an effect as a user writes it."""
    return field_name.replace("_", "-")


ALL = Effects()
NONE = ALL.without(*ALL.names())


@dataclass(frozen=True)
class Options:
    """Rendering options: samples per lit pixel, seed of all that is random, and what the images show."""

    spp: int = 16
    seed: int = 0
    effects: Effects = ALL
    flaws: Flaws = Flaws()

    def __post_init__(self) -> None:
        if not 1 <= self.spp <= 65536:
            raise DescriptionError(f"spp is {self.spp}; take 1 to 65536 samples per lit pixel")
        if self.seed < 0:
            raise DescriptionError(f"seed is {self.seed}; it must not be negative")

    @classmethod
    def chosen(cls, *, spp: int, seed: int, effects: Sequence[str], without: Sequence[str], ideal: bool) -> "Options":
        """Options with flaws added by ``effects``, and some effects, or with ``ideal`` all of them, left out."""
        return cls(spp, seed, (NONE if ideal else ALL).without(*without), Flaws.of(*effects))

    def names(self) -> list[str]:
        """All that is rendered beside geometry, refraction and extinction, as a user writes it."""
        return [*self.effects.names(), *self.flaws.names()]


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
