"""Stripes of all kinds are found as before: a regression test of rules and thresholds without a theoretical reference.

The images are drawn here; the stripes found in them are stored in tests/data/stripes-found.npz. After an intended
change, write it again: ``python -m tests.uwlts.stripe.test_unchanged``.
"""

from pathlib import Path

import numpy as np
import pytest

from uwlts.stripe import PeakRule, Stripe, StripeOptions, extract_stripe, method_names

FOUND = Path(__file__).parents[2] / "data" / "stripes-found.npz"
LINES, LENGTH = 800, 128
WAYS = {
    **{method: StripeOptions(method=method, end_lines=0) for method in method_names()},
    **{f"{rule}": StripeOptions(peak=rule, end_lines=0) for rule in (PeakRule.FIRST, PeakRule.LAST)},
    "smoothed along": StripeOptions(smoothing_lines=5, end_lines=0),
    "smoothed across": StripeOptions(smoothing_px=2.0, end_lines=0),
    "narrow window": StripeOptions(half_window_px=12, end_lines=0),
    "ends left out": StripeOptions(),
}


def the_same_rng(seed: int) -> np.random.Generator:
    """Return random numbers that do not depend on ``--noise``."""
    return np.random.Generator(np.random.PCG64(seed))


def drawn() -> np.ndarray:
    """Draw (L, N) float: up to two stripes per line, of all widths and heights, over slopes, edges and hot pixels."""
    rng, x = the_same_rng(5), np.arange(LENGTH)

    def some(share: float) -> np.ndarray:
        return (rng.random(LINES) < share)[:, None]

    def stripes(share: float) -> np.ndarray:
        centre, sigma = rng.uniform(-4, LENGTH + 4, (LINES, 1)), np.exp(rng.uniform(-0.8, 2.3, (LINES, 1)))
        height = np.exp(rng.uniform(1.5, 6.0, (LINES, 1)))
        light = height * np.exp(-0.5 * ((x - centre) / sigma) ** 2) * (1 + 0.2 * rng.standard_normal((LINES, LENGTH)))
        return light * some(share)

    slope = rng.uniform(5, 20, (LINES, 1)) + rng.uniform(-0.2, 0.2, (LINES, 1)) * x * some(0.5)
    edge = rng.uniform(-20, 40, (LINES, 1)) * (x > rng.uniform(0, LENGTH, (LINES, 1))) * some(0.2)
    hot = 200.0 * (rng.random((LINES, LENGTH)) < 0.002)
    noise = np.repeat(rng.uniform(0.5, 3.0, LINES // 100), 100)[:, None] * rng.standard_normal((LINES, LENGTH))
    return slope + edge + hot + noise + stripes(0.9) + stripes(0.4)


def a_long_stripe() -> np.ndarray:
    """Draw (L, N) float: a stripe that continues from line to line, with jumps and gaps."""
    rng, line = the_same_rng(6), np.arange(LINES)
    centre = 60 + 30 * np.sin(line / 60) + 25 * (line % 190 > 140)
    lit = (line % 83 > 5) & (rng.random(LINES) > 0.03)
    light = 150 * lit[:, None] * np.exp(-0.5 * ((np.arange(LENGTH) - centre[:, None]) / 2.0) ** 2)
    return 10 + light + rng.standard_normal(light.shape)


def found(way: str) -> Stripe:
    """Return the stripe for a key of `ALL`: options of `WAYS`, or images of other types and with a background."""
    lines = a_long_stripe() if way == "ends left out" else drawn()
    options = WAYS.get(way, StripeOptions(end_lines=0))
    grey = np.clip(np.rint(lines), 0, 255).astype(np.uint8)
    if way == "ten bits":
        wide = np.clip(np.rint(4 * lines), 0, 1023).astype(np.uint16)
        return extract_stripe(wide, stripe_along="height", options=options, saturation=1023)
    if way == "floating point":
        return extract_stripe(lines.astype(np.float32), stripe_along="height", options=options)
    if way == "less a background":
        behind = np.clip(np.rint(0.1 * lines[::-1] + 5), 0, 255).astype(np.uint8)
        return extract_stripe(grey.T.copy(), stripe_along="width", options=options, background=behind.T.copy())
    return extract_stripe(grey, stripe_along="height", options=options)


ALL = (*WAYS, "ten bits", "floating point", "less a background")


@pytest.mark.parametrize("way", ALL)
def test_stripes_are_found_as_before(way):
    stripe, before = found(way), np.load(FOUND)
    # Rounding on other processors changes at most some lines in a thousand.
    same = stripe.status == before[f"{way}, status"]
    assert np.mean(same) >= 0.997
    good = np.flatnonzero(same & np.isfinite(stripe.centre_px))
    assert len(good) > 0.35 * LINES
    for name, allowed in {"centre_px": 1e-3, "width_px": 1e-3, "amplitude": 0.02}.items():
        off = np.abs(getattr(stripe, name)[good] - before[f"{way}, {name}"][good])
        assert np.mean(off <= allowed) >= 0.997, name


def write() -> None:
    """Store the current results."""
    kept = {}
    for way in ALL:
        stripe = found(way)
        kept[f"{way}, status"] = stripe.status
        for name in ("centre_px", "width_px", "amplitude"):
            kept[f"{way}, {name}"] = getattr(stripe, name).astype(np.float32)
    np.savez_compressed(FOUND, **kept)


if __name__ == "__main__":
    write()
