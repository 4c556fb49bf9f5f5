"""Errors of the stripe centre by each effect, compared with the truth: numbers, tables and plots of stripe-errors.md.

    python docs/studies/stripe_errors.py

renders every case, draws the plots into docs/pictures, and prints the tables; ``--write`` puts them into the page.
"""

import argparse
import time
from pathlib import Path

from result_tables import publish, table
from stripe_cases import CROSSING, FILTERED, MASS, VERTEX, Frames, measure
from stripe_plan import NAME_CORE, PLACES, Plan

from twin.rendering_options import use_variant
from uwlts.pages.toolkit import format_fixed
from uwlts.runtime.console import progress_bar

PICTURES = Path(__file__).parents[1] / "pictures"
SHOWN = (CROSSING, MASS, "quadratic", FILTERED, VERTEX)


def effects_table(plan: Plan) -> str:
    """Bias and spread on the plane by effect and place."""
    cases, columns = plan.effects("plane"), ("bias px", "std px", "std mm")
    rows = []
    for name in dict.fromkeys(name for name, _ in cases):
        cells = [name]
        for place in PLACES["plane"]:
            s = measure(cases[name, place]).spread()
            cells += [format_fixed(s.bias_px, signed=True), f"{s.std_px:.3f} ± {s.std_px_error:.3f}", f"{s.std_mm:.4f}"]
        rows.append(cells)
    return table(["effects", *(f"{place}: {column}" for place in PLACES["plane"] for column in columns)], rows)


def methods_table(plan: Plan) -> str:
    """Spread in mm by method of extraction, with noise, speckle and defocus."""
    cases = {(thing, place): plan.effects(thing)[NAME_CORE, place] for thing in PLACES for place in PLACES[thing]}
    rows = [
        [name, *(f"{_spread(measure(case), name, thing):.3f}" for (thing, _), case in cases.items())] for name in SHOWN
    ]
    return table(["method", *(f"{thing}, {place}" for thing, place in cases)], rows)


def _spread(frames: Frames, method: str, thing: str) -> float:
    """Return the standard deviation in mm; for spheres the robust one, because of outliers at their limbs."""
    spread = frames.spread(method)
    return spread.std_mm if thing == "plane" else spread.robust_mm


def unknown_table(plan: Plan) -> str:
    """Return a table of the spread in mm by changes of parameters unknown from the thesis."""
    cases, rows = plan.unknown(), []
    head = [f"plane, {NAME_CORE}: std mm", *PLACES["plane"], *(f"stand-off, {name}" for name in (MASS, FILTERED))]
    for name in dict.fromkeys(name for name, _ in cases):
        values = [measure(cases[name, place]).spread().std_mm for place in PLACES["plane"]]
        values += [measure(cases[name, "stand-off"]).spread(method).std_mm for method in (MASS, FILTERED)]
        rows.append([name, *(f"{value:.3f}" for value in values)])
    return table(head, rows)


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
    tables = {"effects": effects_table(plan), "methods": methods_table(plan), "unknown": unknown_table(plan)}
    publish({f"stripe errors, {name}": text for name, text in tables.items()}, write=given.write)
    print(f"{len(cases)} cases, {sum(case.frames for case in cases)} frames in {time.perf_counter() - start:.0f} s")


if __name__ == "__main__":
    main()
