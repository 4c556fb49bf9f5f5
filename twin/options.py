"""How a recording is rendered."""

from dataclasses import dataclass

from twin.effects import ALL, Effects
from uwlts.errors import DescriptionError


@dataclass(frozen=True)
class Options:
    """How to render: samples per lit pixel, seed of all that is random, and what the images show."""

    spp: int = 16
    seed: int = 0
    effects: Effects = ALL

    def __post_init__(self) -> None:
        if not 1 <= self.spp <= 65536:
            raise DescriptionError(f"spp is {self.spp}; take 1 to 65536 samples per lit pixel")
        if self.seed < 0:
            raise DescriptionError(f"seed is {self.seed}; it must not be negative")
