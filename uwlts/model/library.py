"""Finds descriptions by name or path, reads their TOML, and turns validation failures into clear errors.

Names are looked up in the library that ships with the package: ``scenes/sensors`` for sensors, ``scenes`` for scenes.
A description may name a ``base`` of its own kind and give only what differs from it.
"""

import re
from pathlib import Path
from typing import TypeVar

from pydantic import ValidationError
from pydantic_core import ErrorDetails

from uwlts.errors import DescriptionError, Error, first_problems
from uwlts.files.reading import MOST_TOML_BYTES, is_regular_file, parsed_toml, read_text, shortened
from uwlts.model.sensor import Description, Sensor, Table

AnyDescription = TypeVar("AnyDescription", bound=Description)


_MOST_PROBLEMS = 30
_NO_TOML = "is not valid TOML"
_MOST_BASES = 16
"""Descriptions of which each is the base of the next; the shipped ones have two."""


def library_folder() -> Path:
    """Folder of the descriptions that ship with the package: inside the wheel, or beside it in a source checkout."""
    package = Path(__file__).resolve().parents[1]
    inside = package / "scenes"
    return inside if inside.is_dir() else package.parent / "scenes"


def names(folder: str = "") -> list[str]:
    """Names of the shipped descriptions in a folder of the library."""
    return sorted(path.stem for path in (library_folder() / folder).glob("*.toml"))


def find(name_or_path: str | Path, folder: str = "") -> Path:
    """Path of a description given by file or by name; raises DescriptionError with the known names."""
    path = Path(name_or_path)
    if path.suffix == ".toml":
        if not is_regular_file(path):
            raise DescriptionError(f"no description at {shortened(str(path))}")
        return path
    shipped = library_folder() / folder / f"{name_or_path}.toml"
    if not is_regular_file(shipped):
        known = f"known are {', '.join(names(folder))}, or give the path of a .toml file"
        raise DescriptionError(f"nothing is called '{shortened(str(name_or_path))}'; {known}")
    return shipped


def read_table(path: Path, folder: str = "", *, seen: tuple[Path, ...] = ()) -> Table:
    """Table of a TOML file with its ``base`` filled in; nested tables are merged, everything else is replaced."""
    text = read_text(path, most_bytes=MOST_TOML_BYTES, error=DescriptionError, called="description", foreign=_NO_TOML)
    if path.resolve() in seen:
        raise DescriptionError(f"{path} is its own base: {' -> '.join(p.name for p in (*seen, path))}")
    if len(seen) == _MOST_BASES:
        raise DescriptionError(f"{path} is the base of {_MOST_BASES} descriptions one after another: give fewer")
    try:
        table = parsed_toml(text)
    except ValueError as error:
        raise DescriptionError(f"{path} {_NO_TOML}: {error}") from error
    base = table.pop("base", None)
    if base is None:
        return table
    if not isinstance(base, str):
        raise DescriptionError(f"{path}: base is {base!r}; expected the name or path of another description")
    beside = path.parent / f"{base.removesuffix('.toml')}.toml"
    # A description may be called like the shipped one on which it is based.
    base_path = beside if is_regular_file(beside) and beside.resolve() != path.resolve() else find(base, folder)
    return merged(read_table(base_path, folder, seen=(*seen, path.resolve())), table)


_EITHER_OR = (({"baseline_mm", "triangulation_angle_deg"}, {"origin_mm", "axis"}), ({"water"}, {"turbidity"}))
"""Keys that say the same in two ways: of the laser's place, and of a medium."""


def merged(base: Table, changes: Table) -> Table:
    """A new table: ``base`` with ``changes`` laid over it, tables merged key by key.

    What the changes say in another way, as where the laser stands, the base says no longer.
    """
    replaced = {
        key
        for ways in _EITHER_OR
        for said, other in (ways, ways[::-1])
        if said & changes.keys() and not other & changes.keys()
        for key in other
    }
    result = {key: value for key, value in base.items() if key not in replaced}
    for key, value in changes.items():
        below = base.get(key)
        result[key] = merged(below, value) if isinstance(below, dict) and isinstance(value, dict) else value
    return result


def validated(model: type[AnyDescription], table: object, source: str | Path) -> AnyDescription:
    """The table as a description; DescriptionError names each wrong key, what was found and what is expected."""
    try:
        return model.model_validate(table)
    except ValidationError as error:
        words = re.sub(r"(?<=[a-z])(?=[A-Z])", " ", model.__name__).lower()
        known = [*map(_explained, first_problems(error, _MOST_PROBLEMS))]
        left = error.error_count() - len(known)
        more = [f"  {left:,} {'more ' if known else ''}values are wrong"] if left else []
        raise DescriptionError("\n".join([f"{source} is not a valid {words}:", *known, *more])) from error
    except Error as error:
        raise type(error)(f"{source}: {error}") from error
    except ArithmeticError as error:
        raise DescriptionError(f"{source} holds numbers that nothing can be calculated with: {error}") from error


def _explained(problem: ErrorDetails) -> str:
    # The kind that is meant where none is named has an empty tag.
    key = ".".join(str(part) for part in problem["loc"] if part != "") or "(whole description)"
    if problem["type"] == "extra_forbidden":
        return f"  {key}: unknown key (check its spelling and its unit suffix, such as _mm or _deg)"
    if problem["type"] == "missing":
        return f"  {key}: missing"
    found = "" if isinstance(problem["input"], dict) else f" (found {shortened(repr(problem['input']))})"
    return f"  {key}: {problem['msg'].removeprefix('Value error, ')}{found}"


def load_sensor(name_or_path: str | Path) -> Sensor:
    """Read a sensor description: a shipped one by name, such as "thesis", or a TOML file, which may name a ``base``.

    Returns the nominal data of camera, laser, windows, detector, stage, measuring volume and media. DescriptionError
    where no sensor has this name, or the file is missing, not TOML, or has an unknown or wrong key.

    Examples
    --------
    >>> sensor = uwlts.load_sensor("thesis")
    >>> sensor.medium("water").refractive_index(sensor.laser.wavelength_nm)
    """
    path = find(name_or_path, "sensors")
    return validated(Sensor, read_table(path, "sensors"), path)
