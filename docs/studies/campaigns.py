"""Rendered campaigns of the thesis, calibrated by several methods.

    python docs/studies/campaigns.py thesis FOLDER --campaigns 3 [--write]
    python docs/studies/campaigns.py joint FOLDER --campaigns 10 --every 3 [--write]

Campaigns are those of `twin reproduce`. Complete recordings in the folder are kept.
"""

from pathlib import Path

import numpy as np
from cyclopts import App
from result_tables import name_once, publish, table

import twin
from twin.experiments.figures import draw_means, select_means
from twin.experiments.result import RESULT, ExperimentResult
from uwlts.storage.figure_table import MeasuredFigure

PICTURE = Path(__file__).parents[1] / "pictures" / "thesis-comparison.svg"
PROPOSED = "Table 6", "Table 7"
"""Tables of the thesis's proposed method."""
POOLED = {
    "sphere spacing": ("SSE",),
    "sphere diameter": ("diameter error sphere",),
    "position of all points, per axis": ("mean error",),
    "step height": ("height error",),
    "pipe diameter": ("diameter error",),
}
"""Names of figures by what they are; the first that fits counts."""


def read(folder: Path) -> ExperimentResult:
    """Return the result of an experiment."""
    return ExperimentResult.model_validate_json((folder / RESULT).read_text(encoding="utf-8"))


def pooled(rows: tuple[MeasuredFigure, ...]) -> dict[str, dict[str, list[MeasuredFigure]]]:
    """Return the rows of scans in water with a known true value by figure and method."""
    found: dict[str, dict[str, list[MeasuredFigure]]] = {}
    for row in rows:
        name = next((name for name, some in POOLED.items() if row.figure.startswith(some)), None)
        known = row.true_mm is not None and "known" not in row.figure
        if name is not None and known and not row.scan.endswith("-air"):
            found.setdefault(name, {}).setdefault(row.method, []).append(row)
    return found


def errors_table(result: ExperimentResult) -> str:
    """Return the table of mean and largest errors and of the coverage, by figure and method."""
    groups = pooled(result.table.rows)
    methods = list(dict.fromkeys(method for some in groups.values() for method in some))
    rows = []
    for name, some in groups.items():
        sizes = {method: np.abs([row.error_mm for row in own]) for method, own in some.items()}
        within = {
            method: np.mean([abs(row.error_mm) <= row.expanded_mm for row in own])
            for method, own in some.items()
            if all(row.expanded_mm is not None for row in own)
        }
        count = max(len(each) for each in sizes.values())
        cells = [
            [name, "mean error", *(f"{sizes[m].mean():.4f}" if m in sizes else "" for m in methods)],
            ["", f"largest of {count}", *(f"{sizes[m].max():.4f}" if m in sizes else "" for m in methods)],
            ["", "within U", *(f"{100 * within[m]:.0f} %" if m in within else "" for m in methods)],
        ]
        rows += cells if within else cells[:2]
    return table([f"{len(result.seeds)} campaigns, water, mm", "", *methods], rows)


app = App(help=__doc__, help_format="plaintext")


@app.command
def joint(folder: Path, *, campaigns: int, every: int = 1, write: bool = False) -> None:
    """Compare the joint calibration with the methods of the thesis; with `--write`, put the table into its page."""
    twin.reproduce(joint=True, out=folder, campaigns=campaigns, every=every)
    publish({"joint calibration": errors_table(read(folder))}, write=write)


@app.command
def thesis(folder: Path, *, campaigns: int, write: bool = False) -> None:
    """Compare the means of the thesis's tables; with `--write`, put the table into its page, and draw the picture."""
    twin.reproduce(out=folder, campaigns=campaigns)
    published = read(folder).published
    rows = []
    for row in [row for row in select_means(published) if row.table.startswith(PROPOSED)]:
        values = f"{row.published:g}", f"{row.mean:.3f}", f"{row.ratio:.2f}"
        rows.append([row.table, row.figure, *values])
    head = ["mean over the positions", "", "published, mm", "reproduced, mm", "ratio"]
    publish({"thesis": table(head, name_once(rows))}, write=write)
    if write:
        draw_means(published).savefig(PICTURE)


if __name__ == "__main__":
    app()
