"""Errors of the stripe centre by each effect, compared with the truth: numbers, tables and plots of stripe-errors.md.

    python docs/studies/stripe_errors.py

renders every case, draws the plots into docs/pictures, and prints the tables; ``--write`` puts them into the page.
"""

import argparse
import time
from pathlib import Path

from result_tables import publish, table
from stripe_cases import measure
from stripe_plan import NAME_CORE, PLACES, Plan

from twin.rendering_options import use_variant
from uwlts.pages.toolkit import format_fixed
from uwlts.runtime.console import progress_bar

PICTURES = Path(__file__).parents[1] / "pictures"


def effects_table(plan: Plan) -> str:
    """Spread on the plane by effect and place, and the bias of largest size."""
    cases, rows = plan.effects("plane"), []
    for name in dict.fromkeys(name for name, _ in cases):
        spreads = [measure(cases[name, place]).spread() for place in PLACES["plane"]]
        bias = max((each.bias_px for each in spreads), key=abs)
        rows.append([name, *(f"{each.std_mm:.4f}" for each in spreads), format_fixed(bias, signed=True)])
    return table(["effects", *(f"std mm, {place}" for place in PLACES["plane"]), "largest bias px"], rows)


def unknown_table(plan: Plan) -> str:
    """Return a table of the spread in mm by changes of parameters unknown from the thesis."""
    cases, rows = plan.unknown(), []
    for name in dict.fromkeys(name for name, _ in cases):
        values = [measure(cases[name, place]).spread().std_mm for place in PLACES["plane"]]
        rows.append([name, *(f"{value:.3f}" for value in values)])
    return table([f"plane, {NAME_CORE}: std mm", *PLACES["plane"]], rows)


def main() -> None:
    """Measure, draw, write."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--frames", type=int, default=4, help="frames of a case (default 4)")
    parser.add_argument("--write", action="store_true", help="put the tables into their page of docs/results")
    given, start = parser.parse_args(), time.perf_counter()
    plan = Plan(given.frames)
    use_variant()
    from stripe_figures import draw_all

    cases = plan.every_case()
    with progress_bar("cases") as progress:
        for number, case in enumerate(cases, start=1):
            measure(case)
            progress(number, len(cases))
    draw_all(plan, PICTURES)
    tables = {"effects": effects_table(plan), "unknown": unknown_table(plan)}
    publish({f"stripe errors, {name}": text for name, text in tables.items()}, write=given.write)
    print(f"{len(cases)} cases, {sum(case.frames for case in cases)} frames in {time.perf_counter() - start:.0f} s")


if __name__ == "__main__":
    main()
