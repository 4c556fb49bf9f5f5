"""Acceptance test of the thesis's sensor in the twin, and of the same sensor with flyers.

    python docs/studies/acceptance.py runs/acceptance --write

Renders the calibration and the 17 positions of docs/studies/acceptance.toml (about ten minutes), judges them, and
writes the tables of docs/results/acceptance.md. Other tests have the same clouds of spheres and planes, with a share
of their points moved by up to 1 mm along Z.
"""

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import numpy as np
import tomli_w
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
SHARES = (0.0, 0.001, 0.003, 0.01, 0.03)
"""Shares of points that are moved."""
FLYER_MM = 1.0
"""Largest distance by which a point is moved."""


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


def flyers_table(folder: Path) -> str:
    """Return PF, F and the decisions on them after moving a share of the points of all spheres and planes."""
    plan = load_plan(PLAN).model_dump(mode="json", exclude_none=True)
    plan["positions"] = [each for each in plan["positions"] if each["artefact"] != "step"]
    clouds = {}
    for position in plan["positions"]:
        capture = folder / position["file"]
        with uwlts.read(capture) as scan:
            clouds[capture.stem] = uwlts.reconstruct(scan, folder / "calibration.json", with_uncertainty=False)
        position["file"] = f"{capture.stem}.flyers.cloud.h5"
    (folder / "flyers.toml").write_text(tomli_w.dumps(plan), encoding="utf-8")
    rows = []
    for share in SHARES:
        rng = np.random.default_rng(58)
        for name, cloud in clouds.items():
            points = cloud.points_mm.copy()
            moved = rng.random(len(points)) < share
            points[moved, 2] += rng.uniform(-FLYER_MM, FLYER_MM, np.count_nonzero(moved))
            replace(cloud, points_mm=points).save(folder / f"{name}.flyers.cloud.h5", overwrite=True)
        found = uwlts.accept(folder / "flyers.toml")
        judged = {each.symbol: each for each in found.characteristics}
        cells = [f"{100 * share:g} %"]
        for symbol in ("PF", "F"):
            worst = judged[symbol].worst
            assert worst is not None
            cells += [f"{worst.value_mm:.3f}", judged[symbol].decision]
        rows.append(cells)
    return table(["points moved", "PF, mm", "decision", "F, mm", "decision"], rows)


def main(folder: Path, *, write: Annotated[bool, Parameter(negative="")] = False) -> None:
    """Render, judge the tests, and print or write the tables.

    Parameters
    ----------
    folder
        Folder of captures and results; captures that are there are used.
    write
        Write the tables into docs/results/acceptance.md.
    """
    folder.mkdir(parents=True, exist_ok=True)
    render(folder)
    shutil.copy(PLAN, folder)
    found = uwlts.accept(folder / PLAN.name)
    uwlts.report.write_acceptance(folder / "acceptance.html", found, overwrite=True)
    print("\n".join(found.lines()))
    publish({"acceptance": characteristics_table(found), "acceptance flyers": flyers_table(folder)}, write=write)


if __name__ == "__main__":
    App(help=__doc__, help_format="plaintext", default_command=main)()
