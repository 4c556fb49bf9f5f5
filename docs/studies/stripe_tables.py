"""Tables of a study as Markdown, put between their markers in a page."""

import re
from pathlib import Path


def table(head: list[str], rows: list[list[str]]) -> str:
    """Markdown table."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(cells) + " |" for cells in lines)


def write_tables(path: Path, tables: dict[str, str]) -> None:
    """Put each table between its markers ``<!-- name -->`` and ``<!-- end -->``."""
    page = path.read_text(encoding="utf-8")
    for name, text in tables.items():
        marked = re.compile(rf"(<!-- {name} -->\n).*?(<!-- end -->)", re.DOTALL)
        page, count = marked.subn(lambda m, text=text: f"{m[1]}\n{text}\n\n{m[2]}", page)
        if count != 1:
            raise SystemExit(f"{path.name} has {count} places for the table '{name}'; expected one")
    path.write_text(page, encoding="utf-8")
