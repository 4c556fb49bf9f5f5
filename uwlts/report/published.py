"""Published values to set beside the measured ones."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from uwlts.errors import DescriptionError
from uwlts.library import find, read_table

CALIBRATION = "calibration"


@dataclass(frozen=True)
class Reference:
    """Published values in mm: by measurement, then by figure; several where several were published."""

    title: str
    figures: dict[str, dict[str, tuple[float, ...]]]

    def values(self, measurements: tuple[str, ...], figure: str) -> tuple[float, ...]:
        """Values of a figure under the first of these names that has any; none are an empty tuple."""
        return next((v for name in measurements if (v := self.figures.get(name, {}).get(figure))), ())


def load_reference(name_or_path: str | Path) -> Reference:
    """Published values by name (``thesis``) or path of a TOML file.

    Raises
    ------
    DescriptionError
        Nothing has this name, or the file does not hold lists of numbers by measurement and figure.
    """
    path = find(name_or_path, "references")
    table = read_table(path, "references")
    title = table.pop("title", path.stem)
    if not isinstance(title, str):
        raise DescriptionError(f"{path}: title is {title!r}; expected text")
    return Reference(title, {name: _figures(path, name, found) for name, found in table.items()})


def _figures(path: Path, name: str, found: Any) -> dict[str, tuple[float, ...]]:
    if not isinstance(found, dict):
        raise DescriptionError(f'{path}: {name} is {found!r}; expected a table ["{name}"] of figures')
    return {figure: _numbers(f"{path}: {name}.{figure}", values) for figure, values in found.items()}


def _numbers(place: str, found: Any) -> tuple[float, ...]:
    values = found if isinstance(found, list) else [found]
    for value in values:
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            raise DescriptionError(f"{place} holds {value!r}; expected finite numbers in mm")
    return tuple(map(float, values))
