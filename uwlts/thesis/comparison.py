"""What a reproduction leaves for its reader: summary.json, tables.csv, summary.md and report.html."""

import csv
import io
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from uwlts.files import written_aside
from uwlts.thesis.page import report_page
from uwlts.thesis.published import Published
from uwlts.thesis.tables import MEAN, TableRow, all_rows, headline_rows

_COLUMNS = ("table", "row", "quantity", "published", "ours_mean", "ours_min", "ours_max")


def write_comparison(
    folder: Path, results: Sequence[dict[str, Any]], published: Published, *, overwrite: bool = False
) -> list[TableRow]:
    """Write all four files into a folder, each whole or not at all; returns the rows of the tables.

    Raises
    ------
    OutputError
        A file exists and ``overwrite`` is not given, or cannot be written.
    """
    rows = all_rows(results, published)
    found = {
        "summary.json": json.dumps([row.as_dict() for row in rows], indent=1, allow_nan=False) + "\n",
        "tables.csv": _csv(rows),
        "summary.md": markdown(rows, results),
        "report.html": report_page(folder, results, rows, published),
    }
    for name, text in found.items():
        with written_aside(folder / name, overwrite=overwrite) as aside:
            aside.write_text(text, encoding="utf-8")
    return rows


def markdown(rows: Sequence[TableRow], results: Sequence[dict[str, Any]]) -> str:
    """The headline as a Markdown table."""
    campaigns = len(results)
    lines = [
        "| mean over the positions | | published, mm | ours, mm | range of "
        f"{campaigns} campaign{'s' if campaigns != 1 else ''} | ours / published |",
        "| --- | --- | --- | --- | --- | --- |",
    ]
    for row in headline_rows(rows):
        if row.ours:
            lines.append(
                f"| {row.table}: {row.row.replace(f', {MEAN},', ',')} | {row.quantity} | {row.published:.2f} | "
                f"{row.mean:.3f} | {min(row.ours):.3f} to {max(row.ours):.3f} | {row.ratio:.2f} |"
            )
    return "\n".join(lines) + "\n"


def _csv(rows: Sequence[TableRow]) -> str:
    text = io.StringIO()
    writer = csv.DictWriter(text, _COLUMNS, lineterminator="\n")
    writer.writeheader()
    writer.writerows(row.as_dict() for row in rows)
    return text.getvalue()
