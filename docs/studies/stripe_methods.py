"""Comparison of methods for the centres of stripe and circles: tables of stripe-methods.md.

    python docs/studies/stripe_methods.py [--frames 4]

renders every place once, photographs it with fresh speckle and noise, and prints the tables. ``--write`` puts them into
the page.
"""

import argparse
import time
from functools import cache

import numpy as np
from circle_methods import circles_table
from method_limits import bound_px, spot_limit_px
from method_shots import LEVELS, Place, Spread, places, render
from result_tables import publish, table
from stripe_cases import MASS, METHODS

from twin.rendering_options import use_variant
from uwlts.runtime.console import progress_bar
from uwlts.stripe import StripeOptions, extract_stripe

FIT, FIT_FIVE, CROSSING = "profile fit", "profile fit, 5 lines averaged", "zero crossing"
ALL_METHODS = {
    FIT: StripeOptions(method="profile-fit"),
    FIT_FIVE: StripeOptions(method="profile-fit", smoothing_lines=5),
    **METHODS,
}
ONE_LINE = (FIT, MASS, CROSSING)


@cache
def spread(place: Place, method: str, frames: int, level: float = 1.0, speckle: bool = True) -> Spread:
    """Errors of one method over photographs of a place."""
    shot, options = render(place), ALL_METHODS[method]
    found = [
        extract_stripe(shot_image(place, n, level, speckle), stripe_along="width", options=options).centre_px
        for n in range(frames)
    ]
    return Spread.of(np.stack(found) - shot.truth_px, shot.mm_per_px)


@cache
def shot_image(place: Place, number: int, level: float, speckle: bool) -> np.ndarray:
    """A photograph, made once for all methods."""
    return render(place).image(number, level=level, speckle=speckle)


def spread_table(frames: int) -> str:
    """Standard deviation in mm by method and place, with all effects."""
    names = [name for name in ALL_METHODS if name != "quadratic"]
    rows = [[name, *(f"{spread(p, name, frames).std_mm:.4f}" for p in places().values())] for name in names]
    return table(["std in mm", *places()], rows)


def exposure_table(frames: int) -> str:
    """Standard deviation in px by exposure, on the plane at the stand-off."""
    place = places()["plane, stand-off"]
    row = [f"{FIT}, std px", *(f"{spread(place, FIT, frames, level).std_px:.3f}" for level in LEVELS)]
    return table(["exposure / automatic", *(f"{level:g}" for level in LEVELS)], [row])


def limits_table(frames: int) -> str:
    """Standard deviations on single lines beside the limits, px."""
    rows = []
    for name, place in places().items():
        if not name.startswith("plane"):
            continue
        shot = render(place)
        cells = [name, f"{bound_px(shot, speckle=False):.4f}"]
        cells += [f"{spread(place, FIT, frames, 1.0, False).std_px:.4f}"]
        cells += [f"{spot_limit_px(shot):.3f}", f"{bound_px(shot, speckle=True):.3f}"]
        cells += [f"{spread(place, m, frames).std_px:.3f}" for m in ONE_LINE]
        rows.append(cells)
    head = ["plane, std px", "bound by noise", f"{FIT}, noise only", "limit of a spot", "limit of a line"]
    return table([*head, *ONE_LINE], rows)


def main() -> None:
    """Render, measure, write."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--frames", type=int, default=4, help="photographs of a place (default 4)")
    parser.add_argument("--write", action="store_true", help="put the tables into their page of docs/results")
    given, start = parser.parse_args(), time.perf_counter()
    frames = given.frames
    use_variant()
    wanted = [*places().values()]
    with progress_bar("places") as progress:
        for number, place in enumerate(wanted, start=1):
            render(place)
            progress(number, len(wanted))
    tables = {
        "spread": spread_table(frames),
        "limits": limits_table(frames),
        "exposure": exposure_table(frames),
        "circles": circles_table(),
    }
    publish({f"stripe methods, {name}": text for name, text in tables.items()}, write=given.write)
    print(f"{len(wanted)} places, {frames} photographs each, in {time.perf_counter() - start:.0f} s")


if __name__ == "__main__":
    main()
