"""Stripe on a flat target, separated from other bright structures, and moves of the sheet between two images."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from scipy import special

from uwlts.fitting.least_squares import DEFAULT_K, MAD_TO_STD
from uwlts.stripe import Stripe, StripeOptions, StripeStatus, extract_stripe
from uwlts.targets import Target, TargetView

_DEGREE = 4  # degree for the bends of lens, window, line optics and plate; a higher one would follow outliers
_TRIALS = 300  # parabolas through three points; with half the points outliers, one in eight contains no outlier
_BEYOND = 0.025  # fraction of the plate's size by which distortion may shift its border in the image
_LEAST_LIMIT_PX = 1.0  # smallest inlier limit, independent of the scatter
_FEWEST = 20  # points of a curve
_LOST = 0.05  # fraction of the lines on the plate that may have no point on the curve without a second search


@dataclass(frozen=True, eq=False)
class TargetStripe:
    """Stripe pixels (N, 2) on a target's plate, and the number of pixels on it that are off the curve."""

    pixels: np.ndarray
    outliers: int


def stripe_on_target(
    image: np.ndarray,
    view: TargetView,
    target: Target,
    *,
    stripe_along: str,
    saturation: float,
    options: StripeOptions = StripeOptions(),
) -> TargetStripe:
    """Find the stripe on a flat target that was detected at the same position.

    The stripe is the smooth curve with most points. Lines with another structure are searched a second time near the
    curve. Points off the curve (such as reflections) and outside the plate are rejected.
    Parameters and errors are those of `extract_stripe`.
    """
    stripe = extract_stripe(image, stripe_along=stripe_along, saturation=saturation, options=options)
    to_plate, pixels = _find_homography(view), stripe.pixels()
    on_plate = _mask_plate(pixels, to_plate, target)
    lines = stripe.lines[on_plate]
    across = stripe.centre_px[lines]
    if len(lines) < _FEWEST:
        return TargetStripe(pixels[on_plate], 0)
    width = float(np.median(stripe.width_px[lines]))
    curve = _Curve.fit_through(lines, across, tolerance_px=max(2.0, 0.25 * width))
    if curve is None:
        return TargetStripe(np.empty((0, 2)), len(lines))
    near = curve.holds(lines, across)
    along_curve = np.arange(len(stripe.status))
    expected = _mask_plate(_list_pixels(along_curve, curve.polynomial(along_curve), stripe_along), to_plate, target)
    missing = np.setdiff1d(along_curve[expected], lines[near])
    outliers = int(np.count_nonzero(~near))
    lines, across = lines[near], across[near]
    if len(missing) > _LOST * np.count_nonzero(expected):
        width = float(np.median(stripe.width_px[lines]))
        more_lines, more_across = _find_near_curve(image, curve, missing, stripe_along, saturation, options, width)
        lines, across = np.concatenate([lines, more_lines]), np.concatenate([across, more_across])
        curve = curve.refine(lines, across)
        near = curve.holds(lines, across)
        lines, across = lines[near], across[near]
    order = np.argsort(lines)
    return TargetStripe(_list_pixels(lines[order], across[order], stripe_along), outliers)


def _list_pixels(lines: np.ndarray, across: np.ndarray, stripe_along: str) -> np.ndarray:
    """Return image coordinates (N, 2) of positions on profile lines."""
    return np.column_stack((across, lines) if stripe_along == "height" else (lines, across)).astype(np.float64)


def _find_homography(view: TargetView) -> np.ndarray:
    """Return the homography (3, 3) from pixels to the target's plane; its third coordinate is positive on the plate."""
    inverse = np.linalg.inv(cv2.findHomography(view.points_mm[:, :2], view.pixels)[0])
    return inverse * np.sign(inverse[2] @ [*view.pixels[0], 1.0])


def _mask_plate(pixels: np.ndarray, to_plate: np.ndarray, target: Target) -> np.ndarray:
    """Return a mask (N,) of pixels (N, 2) on a target's plate, or slightly outside."""
    seen = np.column_stack([pixels, np.ones(len(pixels))]) @ to_plate.T
    with np.errstate(divide="ignore", invalid="ignore"):
        places = seen[:, :2] / seen[:, 2:]
    # Beyond the plane's horizon, the third coordinate is negative.
    return (seen[:, 2] > 0) & target.is_on_plate(places, beyond=_BEYOND)


@dataclass(frozen=True, eq=False)
class _Curve:
    """Polynomial of the position across the stripe as a function of the line number, with an inlier limit."""

    polynomial: np.polynomial.Polynomial
    limit_px: float

    @classmethod
    def fit_through(cls, lines: np.ndarray, across: np.ndarray, *, tolerance_px: float) -> "_Curve | None":
        """Find the curve with most points near it; None if there are too few."""
        middle, half = 0.5 * (lines.max() + lines.min()), max(0.5 * np.ptp(lines), 1.0)
        powers = ((lines - middle) / half)[:, None] ** np.arange(3)
        chosen = np.sort(np.random.default_rng(0).integers(len(lines), size=(_TRIALS, 3)), axis=1)
        # Three different lines determine one parabola.
        spacing = np.diff(lines[chosen], axis=1)
        chosen = chosen[(spacing != 0).all(axis=1) & (np.ptp(lines[chosen], axis=1) >= 0.1 * half)]
        if not len(chosen):
            return None
        parabolas = np.linalg.solve(powers[chosen], across[chosen][:, :, None])[:, :, 0]
        near = np.abs(across - parabolas @ powers.T) <= tolerance_px
        best = near[near.sum(axis=1).argmax()]
        if best.sum() < _FEWEST:
            return None
        parabola = np.polynomial.Polynomial.fit(lines[best], across[best], 2)
        return cls(parabola, tolerance_px).refine(lines, across)

    def refine(self, lines: np.ndarray, across: np.ndarray) -> "_Curve":
        """Fit the curve with full degree to the points near this one, repeated until they are stable."""
        curve, near = self, self.holds(lines, across)
        for _ in range(10):
            polynomial = np.polynomial.Polynomial.fit(lines[near], across[near], _DEGREE)
            deviation = np.abs(across[near] - polynomial(lines[near]))
            limit = max(DEFAULT_K * MAD_TO_STD * float(np.median(deviation)), _LEAST_LIMIT_PX)
            curve = _Curve(polynomial, limit)
            before, near = near, curve.holds(lines, across)
            if (near == before).all():
                break
        return curve

    def holds(self, lines: np.ndarray, across: np.ndarray) -> np.ndarray:
        """Return a mask of the points on the curve."""
        return np.abs(across - self.polynomial(lines)) <= self.limit_px


def _find_near_curve(
    image: np.ndarray,
    curve: _Curve,
    lines: np.ndarray,
    stripe_along: str,
    saturation: float,
    options: StripeOptions,
    width_px: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Return those ``lines`` (M,) with a stripe in a band around the curve, and its centres."""
    while options.half_window_px < min(width_px, options.widest_window_px):
        options = options.double_width()
    profiles = image if stripe_along == "height" else image.T
    start = np.rint(curve.polynomial(np.arange(len(profiles)))).astype(int) - 2 * options.half_window_px
    columns = start[:, None] + np.arange(4 * options.half_window_px + 1)
    band = np.take_along_axis(profiles, columns.clip(0, profiles.shape[1] - 1), axis=1)
    found: Stripe = extract_stripe(band, stripe_along="height", saturation=saturation, options=options)
    good = lines[found.status[lines] == StripeStatus.OK]
    across = found.centre_px[good] + start[good]
    inside = (across >= 0) & (across <= profiles.shape[1] - 1)
    return good[inside], across[inside]


# --- moves of the sheet -----------------------------------------------------------------------------------------------


_FEWEST_IMAGES = 3  # images on either side of a move: a wrong image at an end also looks like one
_FALSE_ALARM = 1e-3  # probability of a warning for a capture with a sheet at rest and normal errors
_LEAST_SHARE = 0.75
"""Share of the variance about a parabola that a step must explain. In smooth curves, from errors of lens, target and
stage, it explains at most 0.51: polynomials of degrees 3 to 6 in 7 to 50 images."""


def doubt_sheet_at_rest(
    names: Sequence[str], pixels: Sequence[np.ndarray], off: Sequence[np.ndarray], *, across: int, unit: str
) -> list[str]:
    """Return a warning for each capture in which the sheet moved from one image to the next.

    ``names`` are capture and frame of each image. Its stripe is given in pixels or on any other scale (N, 2), and by
    distances ``off`` (N,) from the sheet of all, with their ``unit``. ``across`` is the coordinate across the stripe.
    """
    captures: dict[str, list[int]] = {}
    for number, name in enumerate(names):
        if len(pixels[number]) > 1:
            captures.setdefault(name.rsplit(", frame ", 1)[0], []).append(number)
    texts = []
    for stripes in captures.values():
        places = np.array([np.median(pixels[number][:, across]) for number in stripes])
        halves = [np.array_split(off[number][np.argsort(pixels[number][:, 1 - across])], 2) for number in stripes]
        if (found := find_step(places, np.array([[np.median(half) for half in each] for each in halves]))) is not None:
            image, size = found
            texts.append(
                f"{names[stripes[image]]}: the laser sheet moved by {size:.2g} {unit} before this image: fix the "
                "laser, and calibrate from images before the move only, or from those after it only"
            )
    return texts


def find_step(places: np.ndarray, distances: np.ndarray) -> tuple[int, float] | None:
    """Return the first image after a step of distances (F, 2), and its size; None if there is no significant one.

    Without a step, the mean and the difference of both columns are parabolas of the stripe's place (F,) with normal
    errors. Each possible moment is tested by Student's t, with a significance divided by the number of tests.
    """
    count = len(places)
    moments = np.arange(_FEWEST_IMAGES, count - _FEWEST_IMAGES + 1)
    if len(moments) < 2:
        return None
    smooth = np.linalg.qr(np.vander((places - places.mean()) / (np.ptp(places) or 1.0), 3))[0]
    modes = distances @ np.array([[0.5, -1.0], [0.5, 1.0]])
    left, steps = (each - smooth @ (smooth.T @ each) for each in (modes, np.arange(count)[:, None] >= moments))
    squares = np.maximum(np.sum(steps**2, axis=0), np.finfo(float).eps)[:, None]
    jumps = steps.T @ left / squares
    share = jumps**2 * squares / np.maximum(np.sum(left**2, axis=0), np.finfo(float).tiny)
    best = int(np.argmax(share.max(axis=1)))
    least = special.stdtrit(count - 4, _FALSE_ALARM / (2 * share.size)) ** 2
    if share[best].max() < max(_LEAST_SHARE, least / (least + count - 4)):
        return None
    return int(moments[best]), float(abs(jumps[best, 0]) + abs(jumps[best, 1]) / 2)
