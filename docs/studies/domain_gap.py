"""Domain gap between rendered data sets and real photographs.

    python docs/studies/domain_gap.py FOLDER [--write]

Data sets in the folder are kept.
"""

from pathlib import Path

from cyclopts import App
from result_tables import publish, table

import twin
from uwlts.radiometry.domain_gap import measure_domain_gap

PRESETS = "stripe-clean", "stripe-turbid", "stripe-shiny", "stripe-tank"
DATA = Path(__file__).resolve().parents[2] / "tests" / "data"
REAL = {
    "etna": DATA / "etna",
    "bust": DATA / "ciclop" / "bust" / "laser_x400_y0.png",
    "board": DATA / "ciclop" / "board" / "laser_x200_y440.png",
}


def main(folder: Path, *, scenes: int = 24, write: bool = False) -> None:
    """Render and print the table; with `--write`, put it into its page."""
    for preset in PRESETS:
        if not (folder / preset).exists():
            twin.dataset(preset, scenes=scenes, out=folder / preset)
    found = measure_domain_gap([folder / preset for preset in PRESETS], real=list(REAL.values()))
    pairs = {(each.name, each.real): each for each in found.gaps}
    rows = []
    for own in found.sets():
        cells = []
        for real in found.real:
            pair = pairs.get((own.name, real.name))
            cells += (
                [""] * 2
                if pair is None
                else [f"{pair.gap:.2f} ± {pair.std:.2f}", f"{100 * pair.covered_at_once:.0f} %"]
            )
        rows.append([own.name, f"{len(own.values)}", *cells])
    halves = [cell for floor in found.floors for cell in (f"{floor.gap:.2f} ± {floor.std:.2f}", "")]
    rows.append(["two halves of the set", "", *halves])
    head = [cell for name in REAL for cell in (f"gap: {name}", "covered at once")]
    publish({"domain gap": table(["set", "windows", *head], rows)}, write=write)


if __name__ == "__main__":
    App(help=__doc__, help_format="plaintext", default_command=main)()
