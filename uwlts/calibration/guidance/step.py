"""Quality of laser images of the step standard, and depths of images that are still needed."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from uwlts.calibration.camera.image_quality import LaserFault
from uwlts.calibration.capture_evidence import StepEvidence
from uwlts.calibration.sequential.step_images import label_step
from uwlts.errors import EvaluationError, ImageError
from uwlts.model.artefacts import StepStandard
from uwlts.model.calibration import Calibration, WindowModel
from uwlts.model.sensor import Sensor
from uwlts.optics.triangulation import points_on_sheet
from uwlts.stripe import StripeStatus, extract_stripe
from uwlts.stripe.capture_stripes import FEWEST_LINES

PLACES = 3  # number of depths of the standard that are needed: near, middle and far
_APART = 1 / 7  # fraction of the volume's depth
_MOST_SATURATED = 0.05  # fraction of the lines; outlier tests tolerate this many wrong centres


@dataclass(frozen=True, eq=False)
class StepQuality:
    """Stripe pixels (N, 2) on the step standard, their depth outside the nominal window, and reasons for rejection."""

    pixels: np.ndarray
    depth_mm: float | None
    reasons: tuple[str, ...]


def next_depth_mm(seen_mm: Sequence[float], sensor: Sensor, *, skipped: int = 0) -> float | None:
    """Return the depth for the standard's next image, mm outside the window; None after three separate depths.

    Candidates are the centres of three equal parts of the measuring volume; the one farthest from previous depths is
    returned. After ``skipped`` skipped depths, the next candidates follow in turn.
    """
    if len(select_separate_depths(seen_mm, sensor)) >= PLACES:
        return None
    near, far = sensor.volume.near_mm, sensor.volume.far_mm
    middles = [near + (far - near) * (2 * k + 1) / (2 * PLACES) for k in range(PLACES)]
    middles.sort(key=lambda middle: min((abs(middle - depth) for depth in seen_mm), default=np.inf), reverse=True)
    return middles[skipped % PLACES]


def select_separate_depths(seen_mm: Sequence[float], sensor: Sensor) -> list[float]:
    """Return those depths that are far from each other."""
    chosen: list[float] = []
    for depth in seen_mm:
        chosen += [depth] if is_separate_depth(depth, chosen, sensor) else []
    return chosen


def is_separate_depth(depth_mm: float, seen_mm: Sequence[float], sensor: Sensor) -> bool:
    """Return whether a depth differs from all others by more than a seventh of the measuring volume's depth."""
    return all(abs(depth_mm - other) >= least_separation_mm(sensor) for other in seen_mm)


def least_separation_mm(sensor: Sensor) -> float:
    """Return the smallest difference between two depths of the standard, mm."""
    return _APART * (sensor.volume.far_mm - sensor.volume.near_mm)


def judge_step(
    image: np.ndarray,
    calibration: Calibration,
    window: WindowModel,
    standard: StepStandard,
    *,
    medium_index: float,
    full_dn: int,
) -> StepQuality:
    """Assess a laser image (H, W) of the step standard.

    ``calibration`` is that of camera and sheet in air, the window is the nominal one, and the index is relative to air.
    ``full_dn`` is the grey value of saturation.
    """
    along = calibration.stripe_along
    try:
        stripe = extract_stripe(image, stripe_along=along, saturation=full_dn)
    except ImageError as error:
        return StepQuality(np.empty((0, 2)), None, (str(error),))
    pixels, reasons = stripe.pixels(), []
    if len(pixels) < FEWEST_LINES:
        reason = f"the laser line is found on {len(pixels)} lines only; at least {FEWEST_LINES} are needed"
        return StepQuality(pixels, None, (f"{reason}; is the laser on, is the standard in the sheet?",))
    clipped = (image.max(axis=0 if along == "width" else 1) >= full_dn) & (stripe.status != StripeStatus.NO_STRIPE)
    saturated = float(clipped.sum()) / len(pixels)
    if saturated > _MOST_SATURATED:
        reasons.append(LaserFault(f"stripe saturated on {100 * saturated:.0f} % of its lines; shorten laser_ms"))
    try:
        label_step(calibration, window, StepEvidence(pixels, standard, medium_index, "this image"))
    except EvaluationError as error:
        reasons.append(f"no step: {error}")
    placed = calibration.model_copy(update={"window": window})
    depths = points_on_sheet(placed, pixels, medium_index=medium_index).points_mm[:, 2]
    if not np.isfinite(depths).any():
        return StepQuality(pixels, None, (*reasons, "the laser line is not on the sheet"))
    depth = float(np.median(depths[np.isfinite(depths)])) - window.distance_mm - window.thickness_mm
    return StepQuality(pixels, depth, tuple(reasons))
