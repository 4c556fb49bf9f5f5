"""Values of descriptions by their path: keys and places in lists joined by dots, as in ``objects.0.position_mm.2``."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, cast

from uwlts.errors import DescriptionError
from uwlts.model.sensor import Description

Value = float | int | str | bool


def value_at(described: Description, path: str, source: str | Path, *, called: str = "sensor") -> Value | None:
    """Value at a path of a description; DescriptionError where it does not exist or leads to a table or list.

    ``called`` is what is described, and ``source`` where the path stands, for the message.
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
    """A copy of a description's table in which values at paths are replaced; the table stays as it is."""
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
