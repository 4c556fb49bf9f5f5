"""Acceptance test of the thesis's sensor in the twin, and of the same sensor on a stage with a known error.

    python docs/studies/acceptance.py runs/acceptance --write

Renders the calibration and the 17 positions of docs/studies/acceptance.toml (about ten minutes), judges them, and
writes the tables of docs/results/acceptance.md. The second test has the same clouds with an error of the stage's lead
added: each point is moved along X by 500 µm/m of the stage's position.
"""

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Annotated

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
LEAD_ERROR = 5e-4


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


def judge_wrong_lead(folder: Path) -> Acceptance:
    """Judge the clouds after adding the error of the stage's lead."""
    plan = load_plan(PLAN).model_dump(mode="json", exclude_none=True)
    plan["title"] += ", with a wrong lead of the stage"
    for position in plan["positions"]:
        capture = folder / position["file"]
        position["file"] = f"{capture.stem}.lead.cloud.h5"
        with uwlts.read(capture) as scan:
            cloud = uwlts.reconstruct(scan, folder / "calibration.json", with_uncertainty=False)
            travel = scan.stage_mm[cloud.frame]
        points = cloud.points_mm.copy()
        points[:, 0] += LEAD_ERROR * travel
        replace(cloud, points_mm=points).save(folder / position["file"], overwrite=True)
    (folder / "lead.toml").write_text(tomli_w.dumps(plan), encoding="utf-8")
    return uwlts.accept(folder / "lead.toml")


def characteristics_table(found: Acceptance) -> str:
    """Return the table of characteristics."""
    rows = []
    for each in found.characteristics:
        assert each.worst is not None
        place = f"{each.worst.position}, {each.worst.label}"
        value, u = each.worst.value_mm, each.worst.expanded_mm
        rows.append(
            [each.symbol, f"{value:.4f}", f"{u:.4f}", f"{each.mpe_mm:g}", f"{each.count}", place, each.decision]
        )
    return table(["characteristic", "worst value, mm", "U (k = 2), mm", "MPE, mm", "measured", "at", "decision"], rows)


def shares_table(found: Acceptance, wrong: Acceptance) -> str:
    """Return the table of scales and shears of both tests."""
    assert found.scale is not None and wrong.scale is not None
    rows = []
    for own, other in zip(found.scale.components, wrong.scale.components, strict=True):
        values = [f"{1e6 * (each.value or 0):+.0f} ± {1e6 * (each.half_interval or 0):.0f}" for each in (own, other)]
        rows.append([own.words, own.share, *values])
    scatter = [f"{1e3 * (each.scale.scatter_mm or 0):.1f} µm" for each in (found, wrong) if each.scale is not None]
    rows.append(["scatter of the lengths (standard deviation)", "not known", *scatter])
    return table(["component", "share", "µm/m, as rendered", "µm/m, stage 500 µm/m too long"], rows)


def main(folder: Path, *, write: Annotated[bool, Parameter(negative="")] = False) -> None:
    """Render, judge both tests, and print or write the tables.

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
    wrong = judge_wrong_lead(folder)
    print("\n".join([*found.lines(), *wrong.lines()]))
    tables = {"acceptance": characteristics_table(found), "acceptance shares": shares_table(found, wrong)}
    publish(tables, write=write)


if __name__ == "__main__":
    App(help=__doc__, help_format="plaintext", default_command=main)()
