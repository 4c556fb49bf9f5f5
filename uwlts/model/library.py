"""Library of descriptions: find them by name or path, read their TOML, and report invalid keys.

Names belong to the library that ships with the package: ``scenes/sensors`` for sensors, ``scenes`` for scenes. A
description can name a ``base`` of its own kind and contain only the differences.
"""

import re
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any, TypeVar, get_args

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from uwlts.errors import DescriptionError, DescriptionWarning, Error, list_problems
from uwlts.files.reading import is_regular_file, read_toml, shorten
from uwlts.model.inheritance import Level, find_misfits
from uwlts.model.sensor import Description, Sensor, Table

AnyDescription = TypeVar("AnyDescription", bound=Description)


_MOST_PROBLEMS = 30  # of a description that a message lists
_MOST_BASES = 16
"""Largest length of a chain of bases; the shipped descriptions have two."""


def library_folder() -> Path:
    """Return the folder of the shipped descriptions: inside the wheel, or beside the package in a source checkout."""
    package = Path(__file__).resolve().parents[1]
    inside = package / "scenes"
    return inside if inside.is_dir() else package.parent / "scenes"


def list_names(folder: str = "") -> list[str]:
    """Return the names of the shipped descriptions in a folder of the library."""
    return sorted(path.stem for path in (library_folder() / folder).glob("*.toml"))


def find_description(name_or_path: str | Path, folder: str = "") -> Path:
    """Return the path of a description given by file or name; DescriptionError with the known names."""
    path = Path(name_or_path)
    if path.suffix == ".toml":
        if not is_regular_file(path):
            raise DescriptionError(f"no description at {shorten(str(path))}")
        return path
    shipped = library_folder() / folder / f"{name_or_path}.toml"
    if not is_regular_file(shipped):
        known = f"known are {', '.join(list_names(folder))}, or give the path of a .toml file"
        raise DescriptionError(f"nothing is called '{shorten(str(name_or_path))}'; {known}")
    return shipped


def read_table(path: Path, folder: str = "") -> Table:
    """Read a TOML file and merge it with its ``base``: tables are merged, all other values replaced."""
    return read_levels(path, folder)[-1].merged


def read_levels(path: Path, folder: str = "", *, seen: tuple[Path, ...] = ()) -> tuple[Level, ...]:
    """Read a TOML file and its chain of bases, each merged with those before it; the first base is first."""
    table = read_toml(path, called="description", error=DescriptionError)
    if path.resolve() in seen:
        raise DescriptionError(f"{path} is its own base: {' -> '.join(p.name for p in (*seen, path))}")
    if len(seen) == _MOST_BASES:
        raise DescriptionError(f"{path}: more than {_MOST_BASES} bases in a chain; use fewer")
    base = table.pop("base", None)
    if base is None:
        return (Level(path.stem, table, table),)
    if not isinstance(base, str):
        raise DescriptionError(f"{path}: base is {base!r}; expected the name or path of another description")
    beside = path.parent / f"{base.removesuffix('.toml')}.toml"
    # A description can have the same name as its shipped base.
    base_path = (
        beside if is_regular_file(beside) and beside.resolve() != path.resolve() else find_description(base, folder)
    )
    levels = read_levels(base_path, folder, seen=(*seen, path.resolve()))
    return *levels, Level(path.stem, table, merge_tables(levels[-1].merged, table))


_EITHER_OR = (({"baseline_mm", "triangulation_angle_deg"}, {"origin_mm", "axis"}), ({"water"}, {"turbidity"}))
"""Alternative keys for the same information: placement of the laser, and properties of a medium."""


def merge_tables(base: Table, changes: Table) -> Table:
    """Merge ``changes`` into a copy of ``base``, nested tables key by key.

    Keys of the base are dropped if the changes give the same information with alternative keys, such as the laser's
    placement.
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
        result[key] = merge_tables(below, value) if isinstance(below, dict) and isinstance(value, dict) else value
    return result


def validate_description(model: type[AnyDescription], table: object, source: str | Path) -> AnyDescription:
    """Validate a table as a description; DescriptionError with each invalid key, its value and the expected one."""
    try:
        return model.model_validate(table)
    except ValidationError as error:
        words = re.sub(r"(?<=[a-z])(?=[A-Z])", " ", model.__name__).lower()
        known = [_explain(each, model) for each in list_problems(error, _MOST_PROBLEMS)]
        left = error.error_count() - len(known)
        more = [f"  {left:,} {'more ' if known else ''}values are wrong"] if left else []
        raise DescriptionError("\n".join([f"{source} is not a valid {words}:", *known, *more])) from error
    except Error as error:
        raise type(error)(f"{source}: {error}") from error
    except ArithmeticError as error:
        raise DescriptionError(f"{source} contains numbers outside the range of calculations: {error}") from error


def _explain(problem: ErrorDetails, model: type[Description]) -> str:
    # The default kind of a tagged union has an empty tag.
    key = ".".join(str(part) for part in problem["loc"] if part != "") or "(whole description)"
    if problem["type"] == "extra_forbidden":
        keys = ", ".join(_list_keys(model, problem["loc"][:-1]))
        return f"  {key}: unknown key (check its spelling and its unit suffix; the keys here are {keys})"
    if problem["type"] == "missing":
        return f"  {key}: missing"
    found = "" if isinstance(problem["input"], dict) else f" (found {shorten(repr(problem['input']))})"
    return f"  {key}: {problem['msg'].removeprefix('Value error, ')}{found}"


def _list_keys(model: type[BaseModel], location: Sequence[int | str]) -> list[str]:
    """Return the keys that a description has at a location, which consists of keys, indices and kinds."""
    models: list[type[BaseModel]] = [model]
    for part in location:
        fields = [each.model_fields[str(part)] for each in models if part in each.model_fields]
        if fields:
            models = [each for field in fields for each in _list_models(field.annotation)]
        else:
            kinds = [(each, each.model_fields.get("kind")) for each in models]
            models = [each for each, kind in kinds if part in (get_args(kind.annotation) if kind else ("",))] or models
    return list(dict.fromkeys(key for each in models for key in each.model_fields))


def _list_models(annotation: Any) -> list[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [each for part in get_args(annotation) for each in _list_models(part)]


def load_sensor(name_or_path: str | Path) -> Sensor:
    """Read a sensor description: a shipped one by name, such as "thesis", or a TOML file, which can have a ``base``.

    Parameters
    ----------
    name_or_path : str or Path
        Name of a shipped description, or path of a TOML file.

    Returns
    -------
    Sensor
        Nominal data of camera, laser, windows, detector, stage, measuring volume and media.

    Raises
    ------
    DescriptionError
        The name is unknown, or the file is missing, not TOML, or has an unknown key or an invalid value.

    Warns
    -----
    DescriptionWarning
        A value of the base does not fit what the description changes, such as the focus after another stand-off.

    Examples
    --------
    >>> sensor = uwlts.load_sensor("thesis")
    >>> sensor.medium("water").refractive_index(sensor.laser.wavelength_nm)
    """
    path = find_description(name_or_path, "sensors")
    return validate_sensor(read_levels(path, "sensors"), path)


def validate_sensor(levels: Sequence[Level], source: str | Path) -> Sensor:
    """Validate a chain of descriptions as a sensor; DescriptionWarning for inherited values that no longer fit."""
    sensor = validate_description(Sensor, levels[-1].merged, source)
    for text in find_misfits(levels, sensor):
        warnings.warn(text, DescriptionWarning, stacklevel=3)
    return sensor
