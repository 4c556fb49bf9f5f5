"""Designs that the studies of the project choose: `twin sweep` of each, verified by rendering.

python docs/studies/chosen_designs.py FOLDER [--write]
"""

from pathlib import Path

from cyclopts import App
from result_tables import publish, table

import twin

STUDIES = "baseline-angle", "camera-lens"


def main(folder: Path, *, verify: int | None = None, write: bool = False) -> None:
    """Sweep and print the table; with `--write`, put it into its page."""
    rows = []
    for name in STUDIES:
        found = twin.sweep(name, out=folder / name, verify=verify)
        rendered = {each.label: each for each in found.agreements}
        for each in (found.marked[0], found.winner):
            laser, lens = each.sensor.laser, each.sensor.camera.focal_length_mm
            values = f"{laser.baseline_mm:.0f}", f"{laser.triangulation_angle_deg:.1f}", f"{lens:g}"
            scatter = f"{each.design.figures['sigma_z_rms_mm']:.4f}"
            ratio = f"{rendered[each.label].rendered_over_predicted:.2f}" if each.label in rendered else ""
            rows.append([name, each.label, *values, scatter, ratio])
    head = ["study", "design", "baseline mm", "angle deg", "lens mm", "scatter along Z, rms mm", "rendered / formulas"]
    publish({"chosen designs": table(head, rows)}, write=write)


if __name__ == "__main__":
    App(help=__doc__, help_format="plaintext", default_command=main)()
