"""Rendering options: samples, seed, effects, flaws, and Mitsuba's variant.

Call `use_variant` before importing any rendering module of the twin, because Mitsuba and Dr.Jit search for libLLVM
during import.
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
    """Rendered effects. Geometry, refraction and extinction are always rendered."""

    defocus: bool = True
    """Finite pupil of the lens: defocus blur, and the window's aberration."""
    haze: bool = True
    """Light of the sheet that is scattered once in the water towards the camera."""
    multiple_scattering: bool = True
    """Light that is scattered once or more on the laser's or the camera's path."""
    secondary_light: bool = True
    """Light that is reflected between surfaces, and images in mirrors."""
    gloss: bool = True
    """Glossy, metallic and mirror finishes; without it, all surfaces are diffuse."""
    motion: bool = True
    """Motion of the stage during an exposure, and the row delay of a rolling shutter."""
    ambient: bool = True
    """Daylight in addition to the laser's light."""
    speckle: bool = True
    """Speckle of coherent light."""
    fixed_pattern: bool = True
    """Fixed differences between the detector's pixels."""
    noise: bool = True
    """Shot noise, dark noise and read noise."""

    def names(self) -> list[str]:
        """Return the names of the rendered effects, as in commands."""
        return [_name_option(f.name) for f in fields(self) if getattr(self, f.name)]

    def remove(self, *names: str) -> "Effects":
        """Return the effects without some of them; DescriptionError for an unknown name."""
        known = ALL.names()
        for name in names:
            if name not in known:
                raise DescriptionError(f"unknown effect '{name}'; known are {', '.join(known)}")
        return replace(self, **{name.replace("-", "_"): False for name in names})


def _make_flaw(*, off: float, typical: float, least: float, most: float) -> Any:
    return field(default=off, metadata={"typical": typical, "range": (least, most)})


@dataclass(frozen=True)
class Flaws:
    """Effects of real recordings that are rendered only on request, most of them with a strength.

    Raises DescriptionError if a strength is out of its range.
    """

    glare: float = _make_flaw(off=0.0, typical=0.02, least=0.0, most=0.5)
    """Fraction of an image's light that lens and window spread over it: veiling glare (ISO 9358)."""
    vignetting: float = _make_flaw(off=0.0, typical=0.4, least=0.0, most=0.99)
    """Relative loss of light at the image's farthest corner, in addition to the cosine-fourth law."""
    uneven_lamp: float = _make_flaw(off=0.0, typical=0.6, least=0.0, most=0.99)
    """Relative loss of the lamp's light at half the view's diagonal from its spot, which is off-centre."""
    particles: float = _make_flaw(off=0.0, typical=1000.0, least=0.0, most=1e5)
    """Number of grains of marine snow above 0.1 mm per litre, rendered individually in the laser's sheet."""
    bubbles: float = _make_flaw(off=0.0, typical=200.0, least=0.0, most=1e5)
    """Number of air bubbles above 0.1 mm in diameter per litre, which glint in the sheet."""
    caustics: float = _make_flaw(off=0.0, typical=2.0, least=0.0, most=15.0)
    """Wind speed in m/s over the water, whose waves focus daylight to moving filaments on surfaces."""
    stray_light: float = _make_flaw(off=0.0, typical=0.02, least=0.0, most=0.3)
    """Fraction of the laser's power in a wide pedestal of the sheet, which its optics scatter."""
    side_lobes: float = _make_flaw(off=0.0, typical=0.01, least=0.0, most=0.1)
    """Fraction of the laser's power in the two first side lobes of a beam that its aperture cuts."""
    lamp_reflection: float = _make_flaw(off=0.0, typical=0.001, least=0.0, most=0.05)
    """Reflectance of the camera's window for a ring lamp around the lens, which appears out of focus."""
    dirt: float = _make_flaw(off=0.0, typical=0.1, least=0.0, most=0.9)
    """Fraction of the camera's window that is covered with spots, which darken blurred patches of the image."""
    ghost: float = _make_flaw(off=0.0, typical=0.003, least=0.0, most=0.1)
    """Fraction of an image's light that image sensor and lens reflect to a blurred image, mirrored at the axis."""
    lamp_and_laser: bool = False
    """Lamp and laser are on in every image, so that it shows stripe and board."""
    pixel_aspect: float = _make_flaw(off=1.0, typical=1.002, least=0.9, most=1.1)
    """Width of a pixel divided by its height: ratio of the focal lengths in px along y and x."""
    tangential: float = _make_flaw(off=0.0, typical=1e-3, least=-0.1, most=0.1)
    """Increment of the tangential distortion p1 of the lens as built."""
    rolling_shutter: float = _make_flaw(off=0.0, typical=10.0, least=0.0, most=1000.0)
    """Delay in us between rows of a rolling shutter; visible while the stage moves."""
    row_noise: float = _make_flaw(off=0.0, typical=5.0, least=0.0, most=1000.0)
    """Standard deviation in electrons of an offset that all pixels of a row share, different in each image."""
    jpeg: int = _make_flaw(off=0, typical=90, least=1, most=100)
    """Quality of JPEG compression; 8-bit images only."""
    colour_filter: bool = False
    """Colour image sensor (RGGB) instead of a monochrome one; its red channel is recorded."""

    def __post_init__(self) -> None:
        for each in fields(self):
            value, (least, most) = getattr(self, each.name), each.metadata.get("range", (False, True))
            if value != each.default and not least <= value <= most:
                raise DescriptionError(f"{_name_option(each.name)} is {value:g}; it must be from {least:g} to {most:g}")

    def names(self) -> list[str]:
        """Return the names of the rendered flaws, as in commands."""
        present = {f.name: getattr(self, f.name) for f in fields(self) if getattr(self, f.name) != f.default}
        return [_name_option(name) + ("" if value is True else f"={value:.9g}") for name, value in present.items()]

    @classmethod
    def parse(cls, *texts: str) -> "Flaws":
        """Parse flaws from NAME, with typical strength, or NAME=STRENGTH.

        Raises DescriptionError if a name is unknown, or a strength is not a number, out of its range, or not allowed.
        """
        known = {_name_option(each.name): each for each in fields(cls)}
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


def _name_option(field_name: str) -> str:
    """Return the name of an effect as in commands."""
    return field_name.replace("_", "-")


ALL = Effects()
NONE = ALL.remove(*ALL.names())


@dataclass(frozen=True)
class Options:
    """Rendering options: samples per lit pixel, seed of all random numbers, effects and flaws."""

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
    def from_names(
        cls, *, spp: int, seed: int, effects: Sequence[str], without: Sequence[str], ideal: bool
    ) -> "Options":
        """Make options from the names of effects to omit (``without``) and flaws to add (``effects``), as in commands.

        ``spp`` is the number of samples per lit pixel; ``ideal`` omits all effects.
        """
        return cls(spp, seed, (NONE if ideal else ALL).remove(*without), Flaws.parse(*effects))

    def names(self) -> list[str]:
        """Return the names of all rendered effects and flaws, as in commands."""
        return [*self.effects.names(), *self.flaws.names()]


def use_variant(name: str = CPU) -> str:
    """Select a monochromatic variant, ``llvm_ad_mono`` or ``cuda_ad_mono``, and return its name.

    Raises SetupError if libLLVM is missing or too old, no CUDA device is available, or the variant is not supported.
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
