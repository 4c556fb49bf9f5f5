"""Values in descriptions by path: keys and list indices joined by dots, as in ``objects.0.position_mm.2``."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, cast

from uwlts.errors import DescriptionError
from uwlts.model.sensor import Description

Value = float | int | str | bool


def value_at(described: Description, path: str, source: str | Path, *, called: str = "sensor") -> Value | None:
    """Return the value at a path of a description.

    ``called`` names the described thing, and ``source`` the origin of the path, for error messages. DescriptionError if
    the path does not exist, or leads to a table or list.
    """
    found: object = described.model_dump()
    for key in path.split("."):
        if isinstance(found, list | tuple) and key.isdecimal() and int(key) < len(found):
            found = found[int(key)]
            continue
        if not isinstance(found, dict) or key not in found:
            there = f"but {_places(found)}" if isinstance(found, dict | list | tuple) else "and nothing below"
            missing = f"the {called}'s description has no '{path}': there is no '{key}', {there}"
            raise DescriptionError(f"{source}: {missing}")
        found = found[key]
    if isinstance(found, dict | list | tuple):
        kind = "table" if isinstance(found, dict) else "list"
        raise DescriptionError(f"{source}: '{path}' is a {kind}; name one of its values: {_places(found)}")
    return cast("Value | None", found)


def with_values(table: dict[str, Any], changes: Mapping[str, Value]) -> dict[str, Any]:
    """Return a copy of a description's table with the values at paths replaced."""
    changed = dict(table)
    for path, value in changes.items():
        *parents, last = path.split(".")
        place: Any = changed
        for parent in parents:
            key = _key(place, parent)
            below = place[key] if isinstance(place, list) else place.get(key, {})
            place[key] = below = list(below) if isinstance(below, list | tuple) else dict(below)
            place = below
        place[_key(place, last)] = value
    return changed


def _key(place: Any, text: str) -> Any:
    return int(text) if isinstance(place, list) else text


def _places(found: object) -> str:
    if isinstance(found, dict):
        return ", ".join(map(str, found))
    return f"0 to {len(found) - 1}" if isinstance(found, list | tuple) and found else "nothing"
