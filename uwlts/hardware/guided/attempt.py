"""The images of a guided calibration: lamp and laser, with exposures that are settled when they are first needed."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from uwlts.calibration.camera_poses import CameraSolution
from uwlts.calibration.guidance.quality import (
    QualityLimits,
    StripeQuality,
    TargetQuality,
    judge_motion,
    judge_novelty,
    judge_stripe,
    judge_target,
    why_not_found,
)
from uwlts.calibration.guidance.solution import RecordedPose, Setting, judge_residual
from uwlts.calibration.guidance.wishes import State, Wanted, state_of
from uwlts.errors import CalibrationError, TargetError
from uwlts.hardware.rig import START_MS, Rig, settled_exposure
from uwlts.hardware.scan_plan import Light, ScanPlan
from uwlts.sensor import Sensor
from uwlts.targets import TargetView


class GuidedImages:
    """Takes images at the exposure of their light.

    Parameters
    ----------
    dtype : dtype
        Of the images.
    known_ms : dict
        Exposures already settled, as those of a recording that is gone on with.
    """

    def __init__(self, rig: Rig, plan: ScanPlan, sensor: Sensor, *, dtype: np.dtype, known_ms: dict[Light, float]):
        self._rig, self._sensor, self._dtype = rig, sensor, dtype
        self._planned = {"lamp": plan.lamp_ms, "laser": plan.laser_ms}
        self._exposure_ms: dict[Light, float] = dict(known_ms)

    def move_to(self, position_mm: float) -> float:
        """Move and let the stage settle; the position read back in mm."""
        return self._rig.move_to(position_mm)

    def take(self, light: Light) -> tuple[np.ndarray, float]:
        """Image (H, W) in a light, and its exposure in ms."""
        known = light in self._exposure_ms or self.settle(light)
        image, exposure_ms = self._rig.image(light, self._exposure_ms[light] if known else START_MS)
        return image.astype(self._dtype, copy=False), exposure_ms

    def unlit(self) -> np.ndarray:
        """A short image (H, W) without laser, in whatever light there is."""
        return self._rig.image("lamp", START_MS)[0]

    def settle(self, light: Light) -> bool:
        """Find the exposure for what is seen now; whether there is one: in the dark there is none."""
        planned = self._planned[light]
        if planned != "auto":
            self._exposure_ms[light] = planned
            return True
        found = settled_exposure(
            lambda exposure_ms: self._rig.image(light, exposure_ms)[0], sensor=self._sensor, light=light,
            start_ms=self._exposure_ms.get(light, START_MS),
        )  # fmt: skip
        if found is not None:
            self._exposure_ms[light] = found
        return found is not None

    def resettle(self, light: Light) -> bool:
        """Find the exposure anew; whether that can change anything."""
        return self._planned[light] == "auto" and self.settle(light)


# The stage's steps may be small; the poses are told apart by its position.
_STAGE_CHANGE_PX = 0.5


@dataclass(frozen=True, eq=False)
class Found:
    """A lamp image (H, W) with what it shows: the target, or None and the reasons."""

    image: np.ndarray
    view: TargetView | None
    quality: TargetQuality | None
    reasons: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class Attempt:
    """What became of an attempt.

    ``reasons`` are why it was refused, empty if it was not; then ``pose`` is to be recorded, with its lamp image and,
    if the laser line was on the target, its laser image, each (H, W) with its exposure in ms, and ``state`` is how far
    the calibration has come with it.
    """

    found: Found
    reasons: tuple[str, ...]
    pose: RecordedPose | None = None
    lamp: tuple[np.ndarray, float] | None = None
    laser: tuple[np.ndarray, float] | None = None
    state: State | None = None

    def line(self) -> str:
        """Quality in a line."""
        if self.reasons:
            return f"refused: {'; '.join(self.reasons)}"
        quality, state = self.found.quality, self.state
        stripe = f"stripe on {len(self.pose.stripe)} lines" if self.laser else "no stripe on the target"
        residual = "not yet" if state.solution is None else f"{state.solution.image_rms_px()[-1]:.2f} px"
        return (
            f"{quality.points} points, edges {quality.blur_px:.1f} px, coverage {100 * state.coverage.share:.0f} %, "
            f"{stripe}, residual {residual}"
        )


class Attempts:
    """Takes and judges poses.

    Parameters
    ----------
    full_dn : int
        Grey value at which pixels clip.
    """

    def __init__(self, images: GuidedImages, setting: Setting, wanted: Wanted, *, full_dn: int):
        self._images, self._setting, self._wanted, self._full = images, setting, wanted, full_dn
        limits = QualityLimits()
        self.limits = limits if setting.poses == "free" else replace(limits, smallest_change_px=_STAGE_CHANGE_PX)

    def look(self) -> Found:
        """What the lamp shows now."""
        return self.find(self._images.take("lamp")[0])

    def find(self, image: np.ndarray) -> Found:
        """The target in a lamp image (H, W), judged."""
        try:
            view = self._setting.target.detect(image)
        except TargetError as error:
            return Found(image, None, None, (why_not_found(image, str(error), full_dn=self._full),))
        quality = judge_target(image, view, self._setting.target, full_dn=self._full, limits=self.limits)
        return Found(image, view, quality, quality.reasons)

    def stripe(self, image: np.ndarray, view: TargetView) -> StripeQuality:
        """The stripe in a laser image (H, W) on the target where a view shows it."""
        return judge_stripe(
            image, view, self._setting.target, stripe_along=self._setting.sensor.camera.stripe_along,
            full_dn=self._full, limits=self.limits,
        )  # fmt: skip

    def attempt(self, before: State, stage_mm: float) -> Attempt:
        """Take the target as it stands, to be the next pose after those of ``before``."""
        lamp, lamp_ms = self._images.take("lamp")
        found = self.find(lamp)
        reasons = found.reasons or judge_novelty(found.view, [p.view for p in before.recorded], self.limits)
        if reasons:
            return Attempt(found, reasons)
        laser, stripe = self._laser(found.view)
        after = self.look()
        reasons = after.reasons or judge_motion(found.view, after.view, self.limits)
        if reasons or stripe.reasons:
            return Attempt(found, (*reasons, *stripe.reasons))
        shown = stripe.lines >= self.limits.fewest_lines
        pose = RecordedPose(found.view, stripe.pixels if shown else np.empty((0, 2)), stage_mm)
        state, reasons = self.with_pose(before, pose)
        return Attempt(found, reasons, pose, (lamp, lamp_ms), laser if shown else None, state)

    def with_pose(self, before: State, pose: RecordedPose) -> tuple[State | None, tuple[str, ...]]:
        """How far one more pose leads, and why it does not fit the others."""
        try:
            state = state_of([*before.recorded, pose], self._setting, self._wanted)
        except CalibrationError as error:
            return None, (str(error),)
        return state, _contradiction(before.solution, state)

    def state(self, recorded: Sequence[RecordedPose]) -> State:
        """How far recorded poses lead; errors as `state_of`."""
        return state_of(recorded, self._setting, self._wanted)

    def _laser(self, view: TargetView) -> tuple[tuple[np.ndarray, float], StripeQuality]:
        """Laser image with its exposure, taken anew with another exposure if the stripe is saturated."""
        laser = self._images.take("laser")
        stripe = self.stripe(laser[0], view)
        if stripe.reasons and self._images.resettle("laser"):
            laser = self._images.take("laser")
            stripe = self.stripe(laser[0], view)
        return laser, stripe


def _contradiction(before: CameraSolution | None, state: State) -> tuple[str, ...]:
    if state.solution is None:
        return () if before is None else (f"contradicts the others: with it {state.undetermined}",)
    return judge_residual(before, state.solution)
