"""The stripe centre's error by each effect, against truth: numbers, tables and plots of docs/stripe-errors.md.

    python docs/stripe_errors.py

renders every case, draws the plots into docs/pictures, and writes the tables between their markers in the page.
"""

import argparse
import math
import time
from pathlib import Path

import numpy as np
from scipy.stats import norm
from stripe_cases import DEFAULT, FILTERED, MASS, VERTEX, Frames, measure
from stripe_plan import (
    LEVELS,
    NAME_CORE,
    PLACES,
    PROFILES,
    THESIS_RANGE,
    THESIS_STD,
    Plan,
)
from stripe_tables import table, write_tables

from twin.variant import use_variant
from uwlts.console import progress_bar
from uwlts.metrology.fits import VDI_OUTLIER_SHARE, fit_robustly, fit_sphere
from uwlts.report.numbers import fixed

PAGE = Path(__file__).parent / "stripe-errors.md"
SHOWN = (DEFAULT, MASS, "quadratic", FILTERED, VERTEX)


def effects_table(plan: Plan, thing: str) -> str:
    """Bias and spread by effect and place; of spheres robust, with the share of centres that are far off beside it."""
    cases, robust = plan.effects(thing), thing == "spheres"
    columns = ("bias px", "robust std px", "robust std mm", "far off") if robust else ("bias px", "std px", "std mm")
    rows = []
    for name in dict.fromkeys(name for name, _ in cases):
        cells = [name]
        for place in PLACES[thing]:
            s = measure(cases[name, place]).spread()
            cells.append(fixed(s.bias_px, signed=True))
            if robust:
                cells += [f"{s.robust_px:.3f}", f"{s.robust_mm:.4f}", f"{100 * s.far_off:.2f} %"]
            else:
                cells += [f"{s.std_px:.3f} ± {s.std_px_error:.3f}", f"{s.std_mm:.4f}"]
        rows.append(cells)
    return table(["effects", *(f"{place}: {column}" for place in PLACES[thing] for column in columns)], rows)


def methods_table(plan: Plan) -> str:
    """Spread in mm by method of extraction: of all that spreads, then of noise alone."""
    cases = {(thing, place): plan.effects(thing)[NAME_CORE, place] for thing in PLACES for place in PLACES[thing]}
    cases["plane", "stand-off, only noise"] = plan.effects("plane")["only noise", "stand-off"]
    rows = [[name, *(f"{_spread(measure(case), name, thing):.4f}" for (thing, _), case in cases.items())]
            for name in SHOWN]  # fmt: skip
    return table(["method, std mm", *(f"{thing}, {place}" for thing, place in cases)], rows)


def _spread(frames: Frames, method: str, thing: str) -> float:
    """Standard deviation in mm; of spheres the robust one, as a few points at their limbs are far off."""
    spread = frames.spread(method)
    return spread.std_mm if thing == "plane" else spread.robust_mm


def unknown_table(plan: Plan) -> str:
    """Spread in mm with what the thesis does not say changed."""
    cases, rows = plan.unknown(), []
    head = [f"plane, {NAME_CORE}: std mm", *PLACES["plane"], *(f"stand-off, {name}" for name in (MASS, FILTERED))]
    for name in dict.fromkeys(name for name, _ in cases):
        values = [measure(cases[name, place]).spread().std_mm for place in PLACES["plane"]]
        values += [measure(cases[name, "stand-off"]).spread(method).std_mm for method in (MASS, FILTERED)]
        rows.append([name, *(f"{value:.3f}" for value in values)])
    return table(head, rows)


def exposure_table(plan: Plan) -> str:
    """Spread on the plane at the stand-off by exposure."""
    cases, rows = plan.exposure(), []
    for level in LEVELS:
        noise, core = (measure(cases[name, level]).spread() for name in ("only noise", NAME_CORE))
        mass = measure(cases[NAME_CORE, level]).spread(MASS)
        numbers = (f"{v:.3f}" for v in (noise.std_px, core.std_px, core.std_mm, mass.std_mm))
        rows.append([f"{level:g}", *numbers, fixed(core.bias_px, signed=True), f"{100 * core.found:.1f} %"])
    head = ["brightest light / full well", "only noise: std px", f"{NAME_CORE}: std px", "std mm"]
    return table([*head, f"{MASS}: std mm", "bias px", "lines found"], rows)


def gloss_table(plan: Plan) -> str:
    """Bias and spread on the step and the pipe."""
    head = ["object", "surface and light", "bias px", "robust std px", "std px", "lines found"]
    rows = []
    for (thing, name), case in plan.gloss().items():
        s = measure(case).spread()
        numbers = fixed(s.bias_px, 4, signed=True), f"{s.robust_px:.4f}", f"{s.std_px:.4f}"
        rows.append([thing, name, *numbers, f"{100 * s.found:.1f} %"])
    return table(head, rows)


def walks_table(plan: Plan) -> str:
    """Scatter alone in harbour water by samples per pixel."""
    rows = [[str(spp), fixed(s.bias_px, 4, signed=True), f"{s.std_px:.3f}", f"{s.std_px * math.sqrt(spp):.2f}"]
            for spp, s in ((spp, measure(case).spread()) for spp, case in plan.walks().items())]  # fmt: skip
    return table(["samples per pixel", "bias px", "std px", "std times root of samples"], rows)


def thesis_table(plan: Plan) -> str:
    """The twin's STD and range beside the thesis's; spheres in water are fitted as VDI/VDE 2634 asks."""
    head = ["object", "medium", "place", "thesis: polynomial / proposed", DEFAULT, MASS, FILTERED, VERTEX]
    head += [f"share of the variance, {name}" for name in (DEFAULT, FILTERED)]
    head.append(f"left, {FILTERED}")
    rows = []
    for (thing, medium, place), case in plan.thesis().items():
        polynomial, proposed = THESIS_STD[thing, medium][place]
        frames = measure(case)
        std = {name: _spread(frames, name, thing) for name in (DEFAULT, MASS, FILTERED, VERTEX)}
        if (thing, medium) == ("spheres", "water"):
            std = {name: max(fit.fit.std_mm for fit in sphere_fits(frames, name)) for name in std}
        shares = [(std[name] / proposed) ** 2 for name in (DEFAULT, FILTERED)]
        left = proposed * math.sqrt(max(0.0, 1 - shares[1]))
        cells = [*(f"{v:.3f}" for v in std.values()), *(f"{100 * share:.0f} %" for share in shares), f"{left:.3f}"]
        rows.append([thing, medium, place, f"{polynomial:.3g} / {proposed:.3g}", *cells])
    return table(head, rows)


def range_table(plan: Plan) -> str:
    """Ranges PE and RE: the thesis's, the twin's, and what normal noise of so many points has."""
    cases, rows = plan.thesis(), []
    cut = 2 * norm.ppf(1 - VDI_OUTLIER_SHARE / 2)
    for thing in PLACES:
        for place in PLACES[thing]:
            frames, twin = measure(cases[thing, "water", place]), ["", ""]
            if thing == "spheres":
                fits = sphere_fits(frames, DEFAULT)
                count = max(len(fit.distances_mm) for fit in fits)
                widest = max(fits, key=lambda fit: np.ptp(fit.fit.residuals_mm)).fit
                span = float(np.ptp(widest.residuals_mm))
                twin = [f"{span:.2f}", f"{span / widest.std_mm:.1f}"]
            else:
                count = round(PROFILES[thing] * np.isfinite(frames.error_px[DEFAULT]).mean() * frames.used.shape[1])
            # The largest of n normal numbers is in the median the quantile 0.5^(1 / n).
            full, published = 2 * norm.ppf(0.5 ** (1 / count)), THESIS_RANGE[thing][place]
            ratio = published / THESIS_STD[thing, "water"][place][1]
            numbers = [f"{published:.3g}", f"{ratio:.1f}", *twin, f"{full:.1f}", f"{cut:.1f}"]
            numbers.append(f"{published / full:.3f}")
            rows.append([f"{thing}, {place}", f"{count}", *numbers])
    head = ["water", "points", "thesis: range mm", "range / STD", f"twin, {DEFAULT}: range mm", "range / STD"]
    head += ["normal noise: range / STD", f"the same, {1e3 * VDI_OUTLIER_SHARE:g} permille left out"]
    return table([*head, "largest noise within the thesis's range, mm"], rows)


def sphere_fits(frames: Frames, method: str) -> list:
    """Robust fits to the two spheres' points: the truth moved by the centres' errors."""
    moved = frames.point_mm + frames.error_px[method][..., None] * frames.step_mm
    good = frames.used & np.isfinite(moved).all(axis=-1)
    return [fit_robustly(fit_sphere, moved[good & side]) for side in (moved[..., 1] < 0, moved[..., 1] >= 0)]


def main() -> None:
    """Measure, draw, write."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--frames", type=int, default=4, help="frames of a case (default 4)")
    plan, start = Plan(parser.parse_args().frames), time.perf_counter()
    use_variant()
    from stripe_figures import draw_all

    cases = plan.every_case()
    with progress_bar("cases") as progress:
        for number, case in enumerate(cases, start=1):
            measure(case)
            progress(number, len(cases))
    draw_all(plan, PAGE.parent / "pictures")
    tables = {f"effects-{thing}": effects_table(plan, thing) for thing in PLACES}
    tables |= {
        "methods": methods_table(plan), "unknown": unknown_table(plan), "gloss": gloss_table(plan),
        "walks": walks_table(plan), "exposure": exposure_table(plan), "thesis": thesis_table(plan),
        "range": range_table(plan),
    }  # fmt: skip
    write_tables(PAGE, tables)
    print(f"{len(cases)} cases, {sum(case.frames for case in cases)} frames in {time.perf_counter() - start:.0f} s")


if __name__ == "__main__":
    main()
