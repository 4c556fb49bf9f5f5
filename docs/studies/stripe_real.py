"""Scatter of the stripe methods on real stripes by others (tests/data): python docs/studies/stripe_real.py [--write].

The scatter is the root mean square distance, px, of a centre from the parabola through the centres on the twelve lines
on either side, on the lines that all methods find. Distances above 3 px, at edges of the objects, are left out.
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from cyclopts import App
from result_tables import publish, table

from uwlts.storage.image_file import read_image
from uwlts.stripe import PeakRule, StripeOptions, extract_stripe, method_names

DATA = Path(__file__).resolve().parents[2] / "tests" / "data"
REACH, LARGEST_PX, SAME_PX = 12, 3.0, 12.0


def stripes() -> Iterator[tuple[str, np.ndarray, PeakRule]]:
    """Yield a name, an image (H, W) with a stripe along its height, and the rule."""
    for folder, corner, rules in (
        ("board", "x200_y440", (PeakRule.FIRST, PeakRule.LAST)),
        ("bust", "x400_y0", (PeakRule.STRONGEST,)),
    ):
        lit = np.ascontiguousarray(read_image(DATA / "ciclop" / folder / f"laser_{corner}.png")[:, :, 2])
        for rule in rules:
            yield f"{folder}, {rule}", lit, rule
    for number in range(1, 17):
        image = read_image(DATA / "etna" / f"frame{number:04d}.jpg")
        yield "16 saturated views, mean", image, PeakRule.STRONGEST


def scatter(centre: np.ndarray) -> float:
    """Return the scatter, px, of centres (L,); NaN where there is none."""
    apart = []
    for line in np.flatnonzero(np.isfinite(centre)):
        near = np.arange(max(line - REACH, 0), min(line + REACH + 1, len(centre)))
        near = near[(near != line) & (np.abs(centre[near] - centre[line]) < SAME_PX)]
        if len(near) >= REACH:
            apart.append(centre[line] - np.polyval(np.polyfit(near - line, centre[near], 2), 0))
    values = np.array(apart)
    return float(np.sqrt(np.mean(np.square(values[np.abs(values) < LARGEST_PX]))))


def main(*, write: bool = False) -> None:
    """Print the table; with `--write`, put it into its page."""
    names, default = method_names(), StripeOptions().method
    rows: dict[str, list[list[float]]] = {}
    for called, image, rule in stripes():
        centres = {
            name: extract_stripe(image, stripe_along="height", options=StripeOptions(method=name, peak=rule)).centre_px
            for name in names
        }
        both = np.isfinite(list(centres.values())).all(axis=0)
        found = {name: scatter(np.where(both, values, np.nan)) for name, values in centres.items()}
        best = min(value for name, value in found.items() if name != default)
        rows.setdefault(called, []).append([100 * both.mean(), found[default], found[default] / best])
    cells = []
    for called, values in rows.items():
        lines, own, ratio = np.mean(values, axis=0)
        cells.append([called, f"{lines:.0f}", f"{own:.3f}", f"{ratio:.2f}"])
    head = ["stripe", "lines found %", f"{default} px", f"{default} / best other"]
    publish({"real stripes": table(head, cells)}, write=write)


if __name__ == "__main__":
    App(help=__doc__, help_format="plaintext", default_command=main)()
