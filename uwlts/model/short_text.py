"""Short text representations of results: sizes in place of the contents of arrays and lists, and aligned tables."""

import dataclasses
import html
from collections.abc import Collection, Mapping, Sequence, Set

from pydantic import BaseModel

_LONGEST = 70  # largest number of characters of a value that is shown completely
_MOST = 8  # largest number of items of a value that is shown completely


class Brief:
    """Base of results with texts that fit on a screen, and a table for notebooks; names contain the units."""

    def summarise_fields(self) -> dict[str, str]:
        """Return short texts of the fields' values by name."""
        known = getattr(type(self), "model_fields", None)
        names = known or [each.name for each in dataclasses.fields(self)]  # pyright: ignore[reportArgumentType]
        return {name: summarise_value(getattr(self, name)) for name in names}

    def __repr__(self) -> str:
        """Return the type and one line for each field."""
        return "\n".join(
            [f"{type(self).__name__}:", *(f"  {name}: {text}" for name, text in self.summarise_fields().items())]
        )

    def __str__(self) -> str:
        """Return the same: pydantic's models would print all their contents."""
        return repr(self)

    def _repr_html_(self) -> str:
        """Return the fields as an HTML table."""
        rows = "".join(
            f"<tr><th>{name}</th><td>{html.escape(text)}</td></tr>" for name, text in self.summarise_fields().items()
        )
        return f"<table><caption>{type(self).__name__}</caption>{rows}</table>"


def summarise_value(value: object) -> str:
    """Return a short text of a value."""
    if (shape := getattr(value, "shape", ())) and (dtype := getattr(value, "dtype", None)):
        return f"{' x '.join(map(str, shape))} {dtype}"
    if isinstance(value, Mapping | Sequence | Set) and not isinstance(value, str):
        if len(value) <= _MOST and len(text := repr(value)) <= _LONGEST and "\n" not in text:
            return text
        return f"{len(value)} {'entries' if isinstance(value, Mapping) else 'items'}"
    stated = value.model_dump(exclude_defaults=True).items() if isinstance(value, BaseModel) else ()
    text = ", ".join(f"{name}={each}" for name, each in stated) or " ".join(str(value).split())
    return text if len(text) <= _LONGEST else f"{text[:_LONGEST]}..."


def align_columns(rows: Sequence[Sequence[str]], *, right: Collection[int] = ()) -> list[str]:
    """Return the cells of a table as lines with aligned columns; those with a number in ``right`` end together."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [
        "  ".join(f"{cell:{'>' if k in right else '<'}{widths[k]}}" for k, cell in enumerate(row)).rstrip()
        for row in rows
    ]
