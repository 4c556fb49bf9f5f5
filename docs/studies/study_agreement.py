"""Comparison of formulas and rendering for very different designs: prints the table of docs/results/designs.md.

Run from the project's folder: ``python docs/studies/study_agreement.py`` (about half a minute per design on two cores).
With ``--turbid``, the designs are in turbid water instead.
"""

import sys
from typing import Any

import numpy as np
from cyclopts import App
from result_tables import publish, table

from twin.design.designs import EvaluatedDesign, HighlightedDesign
from twin.design.sensor_arrays import adjust_to_standoff, extract_parameters
from twin.design.study import Study
from twin.design.verification import verify_candidate
from twin.rendering_options import CPU
from uwlts.model.library import load_sensor, merge_tables, validate_description
from uwlts.model.sensor import Sensor

FOLLOW = ("focus", "waist", "volume")
CASES: tuple[tuple[str, str, dict[str, Any]], ...] = (
    ("the thesis's, focused on its stand-off", "water", {}),
    ("the same in air", "air", {}),
    ("baseline 200 mm, 30 deg", "water", {"laser": {"baseline_mm": 200.0, "triangulation_angle_deg": 30.0}}),
    ("baseline 390 mm, 41 deg", "water", {"laser": {"baseline_mm": 390.0, "triangulation_angle_deg": 41.0}}),
    ("lens of 8 mm", "water", {"camera": {"focal_length_mm": 8.0, "window": {"distance_mm": 30.0}}}),
    ("f / 2", "water", {"camera": {"f_number": 2.0}}),
    ("f / 8", "water", {"camera": {"f_number": 8.0}}),
    ("stripe along the height", "water", {"camera": {"stripe_along": "height"}}),
    ("green, 520 nm", "water", {"laser": {"wavelength_nm": 520.0}}),
    ("window tilted by 8 deg", "water", {"camera": {"window": {"tilt_x_deg": 8.0}}}),
    ("waist of 0.1 mm", "water", {"laser": {"waist_radius_mm": 0.1}}),
    ("clear water", "water", {"media": {"water": {"water": "clear"}}}),
    ("coastal water", "water", {"media": {"water": {"water": "coastal"}}}),
)


def _turbid(name: str, changes: dict[str, Any], **water: object) -> tuple[str, str, dict[str, Any]]:
    return name, "water", changes | {"media": {"water": {"water": "harbour"} | water}}


TURBID = (
    _turbid("harbour water", {}),
    _turbid("harbour, baseline 200 mm, 30 deg", CASES[2][2]),
    _turbid("harbour, lens of 8 mm", CASES[4][2]),
    _turbid("harbour, f / 2", CASES[5][2]),
    _turbid("harbour, green, 520 nm", CASES[8][2]),
    _turbid("scattering of 3 / m", {}, scattering_per_m=3.0, phase="petzold"),
    _turbid("scattering of 5 / m", {}, scattering_per_m=5.0, phase="petzold"),
)


def main(*, turbid: bool = False, write: bool = False) -> None:
    """Render and print; with `--write`, put the table into its page."""
    head = ["design", "rendered / formulas", "systematic, µm"]
    rows = []
    for number, (name, medium, changes) in enumerate(TURBID if turbid else CASES):
        sensor = validate_description(Sensor, merge_tables(load_sensor("thesis").model_dump(), changes), name)
        set_by = adjust_to_standoff(np, extract_parameters([sensor], [sensor.medium(medium)]), FOLLOW)
        set_up = {
            "camera": {"focus_distance_mm": set_by.focus_mm.item()},
            "laser": {"waist_distance_mm": set_by.waist_distance_mm.item()},
            "volume": {"near_mm": set_by.near_mm.item(), "far_mm": set_by.far_mm.item()},
        }
        built = validate_description(Sensor, merge_tables(sensor.model_dump(), set_up), name)
        study = Study.model_validate(
            {"title": name, "medium": medium, "variables": {"laser.power_mw": {"least": 1.0, "most": 10.0}}}
        )
        candidate = HighlightedDesign(name, built, EvaluatedDesign(number, {}, {}, 0.0, ""))
        found = verify_candidate(study, candidate, workers=2, variant=CPU)
        print(name, found.rendered_over_predicted, found.failure, file=sys.stderr, flush=True)
        if found.failure:
            rows.append([name, "", found.failure])
            continue
        rows.append([name, f"{found.rendered_over_predicted:.2f}", f"{1e3 * np.nanmax(np.abs(found.error_mm)):.0f}"])
    publish({"designs-turbid" if turbid else "designs": table(head, rows)}, write=write)


if __name__ == "__main__":
    App(help=__doc__, help_format="plaintext", default_command=main)()
