"""Statistics of the stripe in windows of neighbouring profile lines: width, light, centre, surroundings and noise."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.signal import savgol_filter

from uwlts.fitting.least_squares import robust_std
from uwlts.model.stripe import Stripe
from uwlts.radiometry.image_sets import ImageSet
from uwlts.radiometry.stripe_images import LONGEST_GAP, SMOOTH_LINES
from uwlts.stripe import extract_stripe

WINDOW_LINES = 64
"""Lines of a window: several grains of a real stripe, and a surface that is smooth in most of it."""
_FEWEST = WINDOW_LINES // 2
"""Least number of stripe centres in a window."""
_STRIPE, _NEAR, _FAR = 1.5, (3.0, 5.0), (6.0, 20.0)
"""Distances from the centre, in full widths at half maximum, of the stripe, its halo and the background."""
_CLIPPED = 0.98
"""Fraction of full scale above which a pixel may be clipped."""
_LEAST_LIGHT = 0.2
"""Least smooth light, of its mean: where a parabola falls below it, the stripe ends in the window."""
_CROP_PX = 60
"""Half the height of the pictures of windows, px: the stripe and its halo."""
_PICTURES = 8
"""Largest number of pictures of an image: a page shows all of them."""


@dataclass(frozen=True)
class WindowStatistic:
    """Statistic of a window: name, unit and definition."""

    name: str
    unit: str
    meaning: str


STATISTICS = (
    WindowStatistic("width", "px", "full width at half maximum, median"),
    WindowStatistic("height", "%", "height above the background, median, of full scale"),
    WindowStatistic("contrast", "", "height, divided by height and twice the background"),
    WindowStatistic("scatter", "%", "standard deviation of the stripe's light along it, about a parabola"),
    WindowStatistic("correlation", "", "correlation of this light on neighbouring lines"),
    WindowStatistic("lowest", "%", "light that 5 % of the lines fall below, of the mean"),
    WindowStatistic("wander", "px", "scatter of the centres about a smooth curve"),
    WindowStatistic("halo", "%", "light 3 to 5 widths beside the stripe above the background, of the height"),
    WindowStatistic("background", "%", "grey value 6 to 20 widths beside the stripe, of full scale"),
    WindowStatistic("structure", "%", "scatter of the background beyond its noise, of full scale"),
    WindowStatistic("noise", "%", "scatter of neighbouring pixels of the background, of full scale"),
    WindowStatistic("gaps", "%", "lines without a stripe centre"),
    WindowStatistic("clipped", "%", "lines with clipped pixels"),
)


@dataclass(frozen=True, eq=False)
class StripeWindows:
    """Statistics of N windows of a set of images.

    Attributes
    ----------
    name : str
        Name of the set.
    values : (N, K)
        Values of `STATISTICS`.
    image : (N,) int
        Number of the window's image.
    pictures : tuple of (2 `_CROP_PX` + 1, `WINDOW_LINES`) float32
        Windows of each image, with the stripe along their width, as fractions of full scale.
    """

    name: str
    values: np.ndarray
    image: np.ndarray
    pictures: tuple[np.ndarray, ...]


def measure_windows(images: ImageSet, *, most_images: int) -> StripeWindows:
    """Measure the stripe in all windows of up to ``most_images`` images.

    A window has `WINDOW_LINES` consecutive lines of a stripe without a jump or a long gap, and stripe centres on half
    of them. Windows whose background is outside the image are left out.
    """
    values, numbers, pictures = [], [], []
    for number, image in enumerate(images.images(most_images)):
        stripe = extract_stripe(
            image, stripe_along=images.stripe_along, options=images.options, saturation=images.full_dn
        )
        profiles = (image if images.stripe_along == "height" else image.T).astype(np.float32) / images.full_dn
        own = []
        for lines in _windows(stripe, images.options.jump_px):
            found = _measure(profiles[lines], stripe, lines)
            if found is not None:
                values.append(found)
                numbers.append(number)
                own.append(lines)
        chosen = np.unique(np.linspace(0, max(len(own) - 1, 0), _PICTURES).astype(int))
        pictures += [_picture(profiles, stripe, own[k]) for k in chosen.tolist() if own]
    table = np.array(values).reshape(-1, len(STATISTICS))
    return StripeWindows(images.name, table, np.array(numbers, int), tuple(pictures))


def _windows(stripe: Stripe, jump_px: float) -> Iterator[np.ndarray]:
    """Yield the lines (`WINDOW_LINES`,) of all windows."""
    found = stripe.lines
    apart = (np.diff(found) > LONGEST_GAP + 1) | (np.abs(np.diff(stripe.centre_px[found])) > jump_px)
    for run in np.split(found, np.flatnonzero(apart) + 1):
        if len(run):
            for first in range(int(run[0]), int(run[-1]) + 2 - WINDOW_LINES, WINDOW_LINES):
                yield np.arange(first, first + WINDOW_LINES)


def _measure(profiles: np.ndarray, stripe: Stripe, lines: np.ndarray) -> list[float] | None:
    """Return `STATISTICS` of a window, or None; profiles (`WINDOW_LINES`, P) are fractions of full scale."""
    held = np.flatnonzero(np.isfinite(stripe.centre_px[lines]))
    if len(held) < _FEWEST:
        return None
    profiles, centre = profiles[held], stripe.centre_px[lines[held]]
    width = float(np.median(stripe.width_px[lines[held]]))
    away = np.abs(np.arange(profiles.shape[1]) - centre[:, None]) / width
    within, near, far = away <= _STRIPE, (away > _NEAR[0]) & (away < _NEAR[1]), (away > _FAR[0]) & (away < _FAR[1])
    if not near.any() or np.count_nonzero(far) < far.shape[0]:
        return None
    background, beside = float(np.median(profiles[far])), float(np.median(profiles[near]))
    peak = float(np.median(np.where(within, profiles, 0.0).max(axis=1)))
    height = max(peak - background, 1e-6)
    light = np.where(within, profiles - beside, 0.0).sum(axis=1)
    smooth = np.polynomial.Polynomial.fit(held, light, 2)(held)
    mean = float(light.mean())
    if mean <= 0:
        return None
    deviation = light / np.maximum(smooth, _LEAST_LIGHT * mean) - 1.0
    next_to = np.flatnonzero(np.diff(held) == 1)
    variance = float(np.mean(deviation**2))
    correlation = float(np.mean(deviation[next_to] * deviation[next_to + 1])) / max(variance, 1e-12)
    wander = robust_std(centre - np.asarray(savgol_filter(centre, SMOOTH_LINES, 2)))
    steps = np.diff(profiles, axis=1)[far[:, 1:] & far[:, :-1]]
    # The mean distance of two numbers with a normal distribution is 2 / sqrt(pi) standard deviations.
    noise = float(np.mean(np.abs(steps))) * np.sqrt(np.pi) / 2
    structure = np.sqrt(max(robust_std(profiles[far] - background) ** 2 - noise**2, 0.0))
    return [
        width,
        100 * height,
        height / (height + 2 * background),
        100 * np.sqrt(variance),
        float(np.clip(correlation, -1.0, 1.0)),
        100 * float(np.quantile(light, 0.05)) / mean,
        float(wander),
        100 * (float(np.mean(profiles[near])) - background) / height,
        100 * background,
        100 * float(structure),
        100 * noise,
        100 * (1 - len(held) / WINDOW_LINES),
        100 * float(np.mean(np.where(within, profiles, 0.0).max(axis=1) >= _CLIPPED)),
    ]


def _picture(profiles: np.ndarray, stripe: Stripe, lines: np.ndarray) -> np.ndarray:
    """Return a window (2 `_CROP_PX` + 1, `WINDOW_LINES`) about the stripe, which runs along the width."""
    middle = round(float(np.nanmedian(stripe.centre_px[lines])))
    place = middle + np.arange(-_CROP_PX, _CROP_PX + 1)
    inside = (place >= 0) & (place < profiles.shape[1])
    shown = np.where(inside, profiles[lines][:, np.clip(place, 0, profiles.shape[1] - 1)], 0.0)
    return shown.T.astype(np.float32)
