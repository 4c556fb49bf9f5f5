"""Quality of images of the target and of the laser line on it, with reasons for rejection."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from uwlts.errors import ImageError
from uwlts.stripe import StripeStatus, extract_stripe
from uwlts.targets import Target, TargetView

# The edge of a Gaussian blur s has the slope 0.4 / s times its contrast.
_SLOPE_TIMES_BLUR = 0.4
_JUDGED_POINTS = 80  # points for the median sharpness
_FEWEST_COMMON = 4  # common points that two images need for a comparison
_FEWEST_POINTS = 12  # points of the target in an image, unless it has fewer
_SMALLEST_SHARE = 0.1  # fraction of the target's points; a target larger than the image is partly visible
_LARGEST_BLUR_PX = 2.5  # Gaussian blur (standard deviation) of the edges, median over the points
_SMALLEST_CONTRAST = 0.08  # bright minus dark, median over the points, relative to full scale
_LARGEST_SATURATED = 0.02  # fraction of the target's pixels at full scale
_LARGEST_MOTION_PX = 0.5  # shift of the points between two images of one pose, see `measure_shift_px`
FEWEST_TARGET_LINES = 20  # profile lines with the stripe on the target


class LampFault(str):
    """Reason for rejection that another lamp exposure may remove."""


class LaserFault(str):
    """Reason for rejection that another laser exposure may remove."""


class MotionFault(str):
    """Reason for rejection that disappears when the target is at rest."""


@dataclass(frozen=True)
class TargetQuality:
    """Quality of an image of the target; ``reasons`` for rejection are empty for a good image.

    ``points`` is the number of points found, ``blur_px`` the Gaussian blur of the edges.
    """

    points: int
    blur_px: float
    reasons: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class StripeQuality:
    """Quality of a laser image: stripe pixels (N, 2) on the target, and reasons for rejection."""

    pixels: np.ndarray
    reasons: tuple[str, ...]

    @property
    def lines(self) -> int:
        """Number of profile lines with the stripe on the target."""
        return len(self.pixels)


def judge_target(image: np.ndarray, view: TargetView, target: Target, *, full_dn: int) -> TargetQuality:
    """Assess an image (H, W) in which the points of ``view`` were found; ``full_dn`` is the value of saturation."""
    count, of_all = len(view.pixels), len(target.indices)
    blur = edge_blur_px(image, view.pixels, half_px=_measure_spacing_px(view, target) / 2)
    contrast = float(np.median(view.quality["contrast"])) / full_dn
    covered = np.zeros(image.shape, np.uint8)
    cv2.fillConvexPoly(covered, np.rint(_find_hull(view.pixels)).astype(np.int32), 1)
    saturated = float(np.mean(image[covered > 0] >= full_dn))
    reasons = {
        f"partial: {count} of {of_all} points found; bring more of the target into the image": (
            count < min(_FEWEST_POINTS, of_all) or count < _SMALLEST_SHARE * of_all
        ),
        f"blurred: edges are {blur:.1f} px wide, at most {_LARGEST_BLUR_PX:g} are allowed; focus, or change the "
        "distance": blur > _LARGEST_BLUR_PX,
        LampFault(
            f"faint: {100 * contrast:.0f} % of the full scale between bright and dark, at least "
            f"{100 * _SMALLEST_CONTRAST:.0f} % are needed; use more light or a longer lamp_ms"
        ): contrast < _SMALLEST_CONTRAST,
        LampFault(
            f"saturated: {100 * saturated:.0f} % of the target's pixels are at the full scale, at most "
            f"{100 * _LARGEST_SATURATED:.0f} % are allowed; use less light or a shorter lamp_ms"
        ): saturated > _LARGEST_SATURATED,
    }
    return TargetQuality(count, blur, tuple(reason for reason, applies in reasons.items() if applies))


def edge_blur_px(image: np.ndarray, pixels: np.ndarray, *, half_px: float) -> float:
    """Estimate the median Gaussian blur of the edges around the points (N, 2) from steepest slope and contrast.

    The window of ``half_px`` on every side of a point includes bright and dark far from the edge: levels near a blurred
    edge would make it look sharp.
    """
    grey = image.astype(np.float32)
    slope = np.hypot(cv2.Sobel(grey, cv2.CV_32F, 1, 0), cv2.Sobel(grey, cv2.CV_32F, 0, 1)) / 8
    half = max(3, round(half_px))
    blurs = []
    for u, v in np.rint(pixels[:: max(1, len(pixels) // _JUDGED_POINTS)]).astype(int).tolist():
        around = np.s_[max(v - half, 0) : v + half + 1, max(u - half, 0) : u + half + 1]
        dark, bright = np.quantile(grey[around], (0.05, 0.95))
        blurs.append(_SLOPE_TIMES_BLUR * (bright - dark) / max(float(np.quantile(slope[around], 0.99)), 1e-6))
    return float(np.median(blurs))


def explain_missing_target(image: np.ndarray, error: str, *, full_dn: int) -> str:
    """Return the reason why no target was found: too dark, too bright, or the detector's error."""
    brightest = float(np.quantile(image, 0.995)) / full_dn
    clipped = float(np.mean(image >= full_dn))
    if brightest < 0.1:
        reached = f"the image reaches {100 * brightest:.0f} % of the full scale"
        return LampFault(f"too dark: {reached}; use more light or a longer lamp_ms")
    if clipped > 0.3:
        filled = f"{100 * clipped:.0f} % of the image is at the full scale"
        return LampFault(f"saturated: {filled}; use less light or a shorter lamp_ms")
    return error


def measure_shift_px(one: TargetView, other: TargetView) -> float:
    """Return the 90 % quantile of the shifts in px of common points of two views; infinite for few points.

    A target that rotates about its middle moves its outer points only, so the median would not show it.
    """
    places = {tuple(place): k for k, place in enumerate(one.indices.tolist())}
    pairs = [(places[tuple(p)], k) for k, p in enumerate(other.indices.tolist()) if tuple(p) in places]
    if len(pairs) < _FEWEST_COMMON:
        return float("inf")
    first, second = np.array(pairs).T
    return float(np.quantile(np.linalg.norm(one.pixels[first] - other.pixels[second], axis=1), 0.9))


def judge_motion(before: TargetView, after: TargetView) -> tuple[str, ...]:
    """Return a reason if the target moved between two images of one pose; else empty."""
    way, most = measure_shift_px(before, after), _LARGEST_MOTION_PX
    reason = MotionFault(f"moved: the target moved {way:.1f} px between its images, at most {most:g} are allowed")
    return () if way <= most else (reason,)


def judge_novelty(view: TargetView, recorded: Sequence[TargetView], *, least_px: float = 5.0) -> tuple[str, ...]:
    """Return a reason if the points are less than ``least_px`` from those of a recorded pose; else empty."""
    ways = [measure_shift_px(view, old) for old in recorded]
    if not ways or min(ways) >= least_px:
        return ()
    return (f"too similar to image {int(np.argmin(ways)) + 1}: differs by {min(ways):.1f} px; move or tilt the target",)


def judge_stripe(
    image: np.ndarray, view: TargetView, target: Target, *, stripe_along: str, full_dn: int
) -> StripeQuality:
    """Assess a laser image (H, W) of the target.

    A stripe that misses the target is not an error: the result then has no lines and no reasons.

    ``view`` holds the points in the lamp image of the same pose, ``full_dn`` is the grey value of saturation.
    """
    try:
        stripe = extract_stripe(image, stripe_along=stripe_along, saturation=full_dn)
    except ImageError as error:
        return StripeQuality(np.empty((0, 2)), (str(error),))
    found, pixels = stripe.status == StripeStatus.OK, stripe.pixels()
    outline = _find_hull(view.pixels, margin_px=_measure_spacing_px(view, target)).astype(np.float32)
    on_target = [cv2.pointPolygonTest(outline, (float(u), float(v)), False) >= 0 for u, v in pixels]
    brightest = image.max(axis=0 if stripe_along == "width" else 1)
    clipped = (brightest >= full_dn) & (found | (stripe.status == StripeStatus.SATURATED))
    lit = max(int(found.sum()), int(clipped.sum()), 1)
    saturated, reasons = float(clipped.sum()) / lit, ()
    if lit >= FEWEST_TARGET_LINES and saturated > 0.05:
        share = f"{100 * saturated:.0f} % of its lines, at most 5 % are allowed"
        reasons = (LaserFault(f"stripe saturated on {share}; shorten laser_ms"),)
    return StripeQuality(pixels[np.array(on_target, dtype=bool)], reasons)


def _find_hull(pixels: np.ndarray, *, margin_px: float = 0.0) -> np.ndarray:
    """Return the corners (K, 2) of the points' convex hull, expanded by a margin."""
    hull = cv2.convexHull(pixels.astype(np.float32))[:, 0]
    outward = hull - hull.mean(axis=0)
    return hull + margin_px * outward / np.maximum(np.linalg.norm(outward, axis=1, keepdims=True), 1e-9)


def _measure_spacing_px(view: TargetView, target: Target) -> float:
    """Return the approximate distance of neighbouring points in the image."""
    size_px, size_mm = np.ptp(view.pixels, axis=0).max(), np.ptp(view.points_mm[:, :2], axis=0).max()
    return float(target.spacing_mm * size_px / max(size_mm, 1e-9))
