"""Uncertainty of a spacing if more is known about the target: ``python -m docs.studies.known_target [--write]``.

Campaigns in water are simulated by Fermat's principle and calibrated jointly, each with a target that differs from its
description as stated. Measured quantities of the target are stated, and drawn, five times better.
"""

import numpy as np
from cyclopts import App

from docs.studies.result_tables import publish, table
from tests.bench.coverage import SPACING, Campaign, Variation, run_campaign
from uwlts.model.library import load_sensor

FIRST, COUNT = 7000, 12
BETTER = 5
KNOWN = {
    "nothing": (),
    "bow, saddle and twist": ("target_bow_mm",),
    "scale of the stage": ("stage_scale",),
    "shift of the stripe by its finish": ("target_stripe_px",),
    "lengths of rows and columns": ("target_stretch",),
    "lengths and finish": ("target_stretch", "target_stripe_px"),
}


def main(*, write: bool = False) -> None:
    """Measure each; with `--write`, put the table into its page."""
    rows, stated = [], load_sensor("thesis").uncertainty
    for what, names in KNOWN.items():
        known = {name: getattr(stated, name) / BETTER for name in names}
        variation = Variation(what, {"uncertainty": known} if known else {})
        campaigns = [Campaign(FIRST + n, wet=True, known_better=True, variation=variation) for n in range(COUNT)]
        found = [m for each in campaigns for m in run_campaign(each).measured if m.figure == SPACING]
        std, error = (1e3 * np.sqrt(np.mean(np.square([(m.std_mm, m.error_mm) for m in found]), axis=0))).tolist()
        values = " ".join(f"{name} = {value:.3g}" for name, value in known.items())
        rows.append([f"`{values}`" if values else what, f"{std:.1f}", f"{error:.1f}"])
        print(rows[-1], flush=True)
    head = ["known five times better", "stated, µm", "error, rms µm"]
    publish({"known target": table(head, rows)}, write=write)


if __name__ == "__main__":
    App(help=__doc__, help_format="plaintext", default_command=main)()
