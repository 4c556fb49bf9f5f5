"""Gauge study in the twin: steps of three heights, set up at three distances, scanned twice each.

    python docs/studies/gauge_twin.py runs/gauge
    uwlts gauge runs/gauge/heights.csv --tolerance 0.2

Each distance counts as an operator. Noise, speckle and stage positions are drawn for each scan. Writes the table of
docs/results/gauge.md and prints the study.
"""

from pathlib import Path

import tomli_w
from cyclopts import App

import twin
import uwlts

HEIGHTS_MM = {"low": 23.07, "middle": 23.17, "high": 23.27}
OPERATORS = "near", "standoff", "far"
REPEATS = 2


def step(height_mm: float) -> dict:
    """The step standard (scenes/step.toml) with another height."""
    lower = {"kind": "block", "size_mm": [60.0, 55.0, 40.0], "position_mm": [0.0, -27.5, 31.585], "finish": "metal"}
    middle = 51.585 - (40.0 + height_mm) / 2
    upper = {"kind": "block", "size_mm": [60.0, 55.0, 40.0 + height_mm], "position_mm": [0.0, 27.5, middle]}
    return {"base": "step", "title": "Step", "objects": [lower, upper | {"finish": "metal"}]}


def main(folder: Path) -> None:
    """Render, reconstruct, measure and evaluate."""
    folder.mkdir(parents=True, exist_ok=True)
    calibration = uwlts.nominal("thesis", medium="water")
    rows, seed = [], 0
    for part, height in HEIGHTS_MM.items():
        scene = folder / f"step-{part}.toml"
        scene.write_text(tomli_w.dumps(step(height)), encoding="utf-8")
        for operator in OPERATORS:
            for _ in range(REPEATS):
                seed += 1
                scan = folder / f"{part}-{operator}-{seed}.h5"
                if not scan.exists():
                    twin.simulate(scene, out=scan, placement=operator, seed=seed)
                measured = uwlts.inspect_step(uwlts.reconstruct(scan, calibration)).features[0]["height"]
                rows.append((part, operator, measured.value))
                print(*rows[-1], flush=True)
    lines = ["part,operator,value", *(f"{part},{operator},{value:.5f}" for part, operator, value in rows)]
    (folder / "heights.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    print("\n".join(uwlts.gauge_study(rows, tolerance=0.2).lines()))


if __name__ == "__main__":
    App(help=__doc__, help_format="plaintext", default_command=main)()
