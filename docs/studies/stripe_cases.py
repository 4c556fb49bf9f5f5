"""One case of the study: frames of an object with some effects, and the errors of the stripe's centres."""

import math
from dataclasses import dataclass
from functools import cache
from typing import Any

import cv2
import numpy as np
from numpy.polynomial import polynomial

from twin.rendering_options import ALL, NONE, Effects, Options
from twin.scene.description import Scene, load_scene
from uwlts.fitting.least_squares import MAD_TO_STD
from uwlts.model.library import load_sensor
from uwlts.model.sensor import Sensor
from uwlts.stripe import StripeOptions, extract_stripe

CROSSING, MASS, FILTERED = "zero crossing", "centre of mass", "5x5 mean, quadratic"
METHODS = {
    CROSSING: StripeOptions(method="zero-crossing"),
    MASS: StripeOptions(method="centre-of-mass"),
    "quadratic": StripeOptions(method="quadratic"),
    # A mean of five pixels has a standard deviation of sqrt((25 - 1) / 12) px.
    FILTERED: StripeOptions(method="quadratic", smoothing_px=math.sqrt(2), smoothing_lines=5),
}
VERTEX = "5x5 mean, parabola through 3 px"
PLATE = {"kind": "plate", "width_mm": 200.0, "height_mm": 300.0, "finish": "painted"}
"""The thesis's painted plane, large enough that both ends of the stripe are out of view."""
FACING = math.cos(math.radians(60))
"""Surfaces with a larger angle of incidence are left out, because the stripe ends there."""
CROP_PX, FAR_OFF_PX = 28, 2.0
_SCALE_Z, _SCALE_DEGREE = np.arange(-80.0, 131.0, 15.0), 5


@dataclass(frozen=True, kw_only=True)
class Case:
    """Rendered case: an object of the thesis at Z, the effects, and changes of the thesis's sensor.

    ``level`` is the brightest light as a fraction of the full well; by default, that of the automatic exposure.
    ``camera`` and ``laser`` are pairs of a description's key and value.
    """

    thing: str = "plane"
    z_mm: float = 0.0
    effects: Effects = ALL
    frames: int = 5
    spp: int = 64
    medium: str = "water"
    water: str | float | None = None
    level: float | None = None
    camera: tuple[tuple[str, float], ...] = ()
    laser: tuple[tuple[str, float], ...] = ()

    def scene(self) -> Scene:
        """Return the shipped scene, moved to Z, with `frames` positions evenly spread over its scan."""
        shipped = load_scene(self.thing).motion
        step = shipped.count * shipped.step_mm / self.frames
        start = shipped.start_mm + (step - shipped.step_mm) / 2
        motion = {"start_mm": start, "step_mm": step, "count": self.frames}
        changes: dict[str, Any] = {"motion": motion, "medium": self.medium, "placement": "here"}
        changes["placements"] = {"here": {"position_mm": [0.0, 0.0, self.z_mm]}}
        if self.water is not None:
            changes["water"] = self.water
        if self.thing == "plane":
            changes["objects"] = [PLATE]
        return Scene.model_validate(load_scene(self.thing).model_dump() | changes)

    def sensor(self) -> Sensor:
        """The thesis's sensor with this case's changes."""
        sensor = load_sensor("thesis")
        parts = {"camera": dict(self.camera), "laser": dict(self.laser)}
        return sensor.model_copy(
            update={name: getattr(sensor, name).model_copy(update=change) for name, change in parts.items()}
        )


@dataclass(frozen=True, eq=False)
class Frames:
    """Errors of a case by method: centre minus truth in px (F, L), NaN if either is missing.

    ``step_mm`` (F, L, 3) is the displacement of a point for one px, and ``mm_per_px`` (F, L) its component along the
    outward normal of the surface. ``point_mm`` (F, L, 3) is the true point. ``used`` (F, L) marks surfaces that face
    the laser. ``width_px`` is the median full width at half maximum. ``crop`` is a part of the first image about the
    middle of the stripe, with its first row and column.
    """

    error_px: dict[str, np.ndarray]
    mm_per_px: np.ndarray
    step_mm: np.ndarray
    point_mm: np.ndarray
    used: np.ndarray
    truth_px: np.ndarray
    width_px: float
    exposure_ms: float
    crop: np.ndarray
    crop_at: tuple[int, int]

    def spread(self, method: str = CROSSING) -> "Spread":
        """Bias and spread over all used lines."""
        error = np.where(self.used, self.error_px[method], np.nan)
        return Spread.of(error, error * self.mm_per_px, found=float(np.isfinite(error)[self.used].mean()))


@dataclass(frozen=True)
class Spread:
    """Bias (median), standard deviation and its standard error from frame to frame; px, and mm along the normal.

    ``robust`` is the standard deviation from the median absolute deviation. ``found`` is the fraction of lines found,
    and ``far_off`` the fraction of centres more than `FAR_OFF_PX` from the truth.
    """

    bias_px: float
    bias_mm: float
    std_px: float
    std_mm: float
    std_px_error: float
    std_mm_error: float
    robust_px: float
    robust_mm: float
    found: float
    far_off: float

    @classmethod
    def of(cls, error_px: np.ndarray, error_mm: np.ndarray, *, found: float) -> "Spread":
        numbers: dict[str, float] = {}
        for unit, error in (("px", error_px), ("mm", error_mm)):
            middle = np.nanmedian(error)
            each = np.array([np.nanstd(line) for line in error if np.isfinite(line).any()])
            numbers[f"bias_{unit}"] = float(middle)
            numbers[f"std_{unit}"] = float(np.nanstd(error))
            numbers[f"std_{unit}_error"] = float(each.std(ddof=1) / math.sqrt(len(each))) if len(each) > 1 else math.nan
            numbers[f"robust_{unit}"] = float(MAD_TO_STD * np.nanmedian(np.abs(error - middle)))
        far_off = float((np.abs(error_px[np.isfinite(error_px)]) > FAR_OFF_PX).mean())
        return cls(**numbers, found=found, far_off=far_off)


@cache
def measure(case: Case) -> Frames:
    """Render the case's frames, find the stripe in them, and compare with the truth."""
    # Mitsuba needs its variant when it is imported.
    from twin.recording.frame_truth import find_true_stripe
    from twin.recording.sensor_simulator import SensorSimulator

    sensor, scene = case.sensor(), case.scene()
    studio = SensorSimulator(sensor, scene, Options(spp=case.spp, effects=case.effects))
    if case.level is not None:
        fixed = studio.exposure_ms["laser"] * case.level / sensor.exposure.auto_level
        exposure = sensor.exposure.model_copy(update={"laser_ms": fixed})
        studio = SensorSimulator(sensor.model_copy(update={"exposure": exposure}), scene, studio.options)
    truths, centres, widths, crop, corner = [], [], [], None, (0, 0)
    for index, shot in enumerate(scene.motion.shots()):
        truth, image = find_true_stripe(studio.renderer, studio.pose(shot)), studio.frame(shot, index).image
        truths.append(truth)
        found = {name: extract_stripe(image, stripe_along="width", options=wanted) for name, wanted in METHODS.items()}
        widths.append(found[CROSSING].width_px)
        centres.append({name: stripe.centre_px for name, stripe in found.items()})
        centres[-1][VERTEX] = np.where(np.isfinite(found[CROSSING].centre_px), _vertex(image), np.nan)
        if crop is None:
            middle = image.shape[1] // 2
            corner = (int(np.nan_to_num(truth.centre_px[middle])) - CROP_PX // 2, middle)
            crop = image[corner[0] : corner[0] + CROP_PX, corner[1] : corner[1] + CROP_PX].copy()
    truth_px, point, normal = (
        np.stack([getattr(truth, name) for truth in truths]) for name in ("centre_px", "point_mm", "normal")
    )
    step = step_per_px(case, point[..., 2])
    used = np.isfinite(truth_px) & (-normal[..., 2] >= FACING)
    return Frames(
        error_px={name: np.stack([found[name] for found in centres]) - truth_px for name in centres[0]},
        mm_per_px=(step * normal).sum(axis=-1),
        step_mm=step,
        point_mm=point,
        used=used,
        truth_px=truth_px,
        width_px=float(np.nanmedian(np.where(used, widths, np.nan))),
        exposure_ms=studio.exposure_ms["laser"],
        crop=crop,
        crop_at=corner,
    )


def _vertex(image: np.ndarray) -> np.ndarray:
    """Vertex (L,) of the parabola through each column's highest pixel and its neighbours, after a 5x5 mean."""
    smooth = cv2.blur(image.astype(np.float32), (5, 5))
    top, column = smooth.argmax(axis=0).clip(1, len(smooth) - 2), np.arange(smooth.shape[1])
    before, here, after = (smooth[top + shift, column] for shift in (-1, 0, 1))
    return top + 0.5 * (after - before) / np.maximum(2 * here - before - after, np.finfo(np.float32).tiny)


def step_per_px(case: Case, z_mm: np.ndarray) -> np.ndarray:
    """Return the displacements (F, L, 3) in mm of points at Z (F, L) in the sheet for one px on their line."""
    row_of_z, y_of_z = _scale(case.medium)
    per_row = 1 / polynomial.polyval(z_mm, polynomial.polyder(row_of_z)[:, None], tensor=False)
    along = polynomial.polyval(z_mm, polynomial.polyder(y_of_z)[:, None], tensor=False)
    return np.stack([np.zeros_like(per_row), along * per_row, per_row], axis=-1)


@cache
def _scale(medium: str) -> tuple[np.ndarray, np.ndarray]:
    """Polynomials (degree + 1, L) in Z of every line's row and Y, from the truth of plates all over the volume."""
    from twin.recording.frame_truth import find_true_stripe
    from twin.recording.sensor_simulator import SensorSimulator

    studio = SensorSimulator(load_sensor("thesis"), Case(medium=medium).scene(), Options(effects=NONE))
    rows, places = [], []
    for z in _SCALE_Z:
        pose = np.eye(4)
        pose[2, 3] = -z
        truth = find_true_stripe(studio.renderer, pose)
        rows.append(truth.centre_px)
        places.append(truth.point_mm[:, 1])
    return tuple(polynomial.polyfit(_SCALE_Z, np.stack(values), _SCALE_DEGREE) for values in (rows, places))
