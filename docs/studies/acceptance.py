"""Acceptance test of the thesis's sensor in the twin.

    python docs/studies/acceptance.py runs/acceptance --write

Renders the calibration and the 17 positions of docs/studies/acceptance.toml (about ten minutes), judges them, and
writes the table of docs/results/acceptance.md.
"""

import shutil
from pathlib import Path
from typing import Annotated

from cyclopts import App, Parameter
from result_tables import publish, table

import twin
import uwlts
from uwlts.acceptance.accept import Acceptance
from uwlts.acceptance.acceptance_plan import load_plan

PLAN = Path(__file__).with_name("acceptance.toml")
AS_BUILT = "thesis-as-built"
SCENES = {"bar": "ball-bar", "plane": "plane", "height": "step-scan"}
"""Scene of each file, by the beginning of its name."""


def render(folder: Path) -> None:
    """Render the calibration and all positions that are not there yet, and calibrate."""

    def simulate(scene: str, name: str, **options: object) -> str:
        out = folder / name
        if not out.exists():
            twin.simulate(scene, out=out, as_built=AS_BUILT, **options)
        return str(out)

    air = simulate("target", "target-air.h5")
    water = simulate("target-through-window", "target-water.h5", medium="water")
    steps = [simulate("step", f"step-{place}.h5", placement=place) for place in ("near", "far")]
    if not (folder / "calibration.json").exists():
        uwlts.calibrate(air=[air], water=[water], step=steps).save(folder / "calibration.json")
    for seed, position in enumerate(load_plan(PLAN).positions, start=10):
        kind, _, place = Path(position.file).stem.partition("-")
        simulate(SCENES[kind], position.file, placement=place, seed=seed)


def characteristics_table(found: Acceptance) -> str:
    """Return the table of characteristics."""
    rows = []
    for each in found.characteristics:
        assert each.worst is not None
        value, u = each.worst.value_mm, each.worst.expanded_mm
        rows.append([each.symbol, f"{value:.4f}", f"{u:.4f}", f"{each.mpe_mm:g}", each.decision])
    return table(["characteristic", "worst value, mm", "U (k = 2), mm", "MPE, mm", "decision"], rows)


def main(folder: Path, *, write: Annotated[bool, Parameter(negative="")] = False) -> None:
    """Render, judge the test, and print or write the table.

    Parameters
    ----------
    folder
        Folder of captures and results; captures that are there are used.
    write
        Write the table into docs/results/acceptance.md.
    """
    folder.mkdir(parents=True, exist_ok=True)
    render(folder)
    shutil.copy(PLAN, folder)
    found = uwlts.accept(folder / PLAN.name)
    uwlts.report.write_acceptance(folder / "acceptance.html", found, overwrite=True)
    print("\n".join(found.lines()))
    publish({"acceptance": characteristics_table(found)}, write=write)


if __name__ == "__main__":
    App(help=__doc__, help_format="plaintext", default_command=main)()
