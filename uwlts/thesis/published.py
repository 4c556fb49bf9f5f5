"""The thesis's published tables, from the description that ships with the package."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from uwlts.errors import DescriptionError
from uwlts.library import find, read_table


@dataclass(frozen=True)
class Published:
    """Published values by the names of the file; see ``scenes/references/thesis-tables.toml``."""

    title: str
    content: dict[str, Any]

    def value(self, *keys: str | int) -> float | None:
        """The value at a path of keys and list places, None where nothing was published."""
        found: Any = self.content
        for key in keys:
            try:
                found = found[key]
            except (KeyError, IndexError, TypeError):
                return None
        return float(found) if isinstance(found, int | float) else None

    def positions(self, thing: str) -> list[str]:
        """Placements of the spheres or the plane in the order of the published lists."""
        return list(self.content["positions"][thing])


def load_published(name_or_path: str | Path = "thesis-tables") -> Published:
    """Published tables by name or path; DescriptionError where the file holds none."""
    path = find(name_or_path, "references")
    table = read_table(path, "references")
    if not isinstance(table.get("positions"), dict) or not {"spheres", "plane"} <= table["positions"].keys():
        raise DescriptionError(f"{path} holds no published tables: it needs [positions] with spheres and plane")
    return Published(str(table.pop("title", path.stem)), table)
