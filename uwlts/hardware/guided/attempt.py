"""Images of a guided calibration and attempts at poses of the target: taken, judged, accepted or refused."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from uwlts.calibration.camera import CameraSolution
from uwlts.calibration.guidance.pose_advice import State, Wanted, state_of
from uwlts.calibration.guidance.solution import RecordedPose, Setting, judge_residual
from uwlts.calibration.image_quality import (
    QualityLimits,
    StripeQuality,
    TargetQuality,
    judge_motion,
    judge_novelty,
    judge_stripe,
    judge_target,
    why_not_found,
)
from uwlts.hardware.rig import START_MS, Rig, settled_exposure
from uwlts.hardware.scan_plan import Light, RigPlan
from uwlts.model.errors import CalibrationError, TargetError
from uwlts.model.sensor import Sensor
from uwlts.targets import TargetView


class GuidedImages:
    """Takes images at the exposure of their light.

    ``known_ms`` are exposures already settled, as those of a recording that is continued.
    """

    def __init__(self, rig: Rig, plan: RigPlan, sensor: Sensor, *, dtype: np.dtype, known_ms: dict[Light, float]):
        self._rig, self._plan, self._sensor, self._dtype = rig, plan, sensor, dtype
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
        planned = self._plan.planned_ms(light)
        if planned != "auto":
            self._exposure_ms[light] = planned
            return True
        found = settled_exposure(
            lambda exposure_ms: self._rig.image(light, exposure_ms)[0],
            sensor=self._sensor,
            light=light,
            start_ms=self._exposure_ms.get(light, START_MS),
        )
        if found is not None:
            self._exposure_ms[light] = found
        return found is not None

    def resettle(self, light: Light) -> bool:
        """Find the exposure again; whether that can change anything."""
        return self._plan.planned_ms(light) == "auto" and self.settle(light)


# The stage's steps may be small; the poses are distinguished by its position.
_STAGE_CHANGE_PX = 0.5


@dataclass(frozen=True, eq=False)
class Found:
    """A lamp image (H, W) with the target in it, None where there is none, and the reasons why it is of no use."""

    image: np.ndarray
    view: TargetView | None
    quality: TargetQuality | None
    reasons: tuple[str, ...]

    @property
    def usable(self) -> TargetView | None:
        """The target, None where there is a reason against it."""
        return None if self.reasons else self.view


@dataclass(frozen=True, eq=False)
class Refused:
    """An attempt at a pose that is not to be recorded, and why."""

    found: Found
    reasons: tuple[str, ...]

    def line(self) -> str:
        """The reasons in a line."""
        return f"refused: {'; '.join(self.reasons)}"


@dataclass(frozen=True, eq=False)
class Accepted:
    """A pose to be recorded, and the ``state`` of the calibration with it.

    ``lamp`` and, if the laser line was on the target, ``laser`` are the images (H, W) with their exposures in ms.
    """

    found: Found
    quality: TargetQuality
    pose: RecordedPose
    lamp: tuple[np.ndarray, float]
    laser: tuple[np.ndarray, float] | None
    state: State

    def line(self) -> str:
        """Quality in a line."""
        quality, state = self.quality, self.state
        stripe = f"stripe on {len(self.pose.stripe)} lines" if self.laser else "no stripe on the target"
        residual = "not yet" if state.solution is None else f"{state.solution.image_rms_px()[-1]:.2f} px"
        return (
            f"{quality.points} points, edges {quality.blur_px:.1f} px, coverage {100 * state.coverage.share:.0f} %, "
            f"{stripe}, residual {residual}"
        )


Attempt = Refused | Accepted


class PoseJudge:
    """Judges images of the target, taken now or read from a recording; pixels clip at the grey value ``full_dn``."""

    def __init__(self, setting: Setting, wanted: Wanted, *, full_dn: int):
        self._setting, self._wanted, self._full = setting, wanted, full_dn
        limits = QualityLimits()
        self.limits = limits if setting.poses == "free" else replace(limits, smallest_change_px=_STAGE_CHANGE_PX)

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
            image,
            view,
            self._setting.target,
            stripe_along=self._setting.sensor.camera.stripe_along,
            full_dn=self._full,
            limits=self.limits,
        )

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


class Attempts:
    """Takes poses and judges them."""

    def __init__(self, images: GuidedImages, judge: PoseJudge):
        self._images, self._judge = images, judge
        self.limits = judge.limits

    def look(self) -> Found:
        """The target in a lamp image taken now."""
        return self._judge.find(self._images.take("lamp")[0])

    def attempt(self, before: State, stage_mm: float) -> Attempt:
        """Take the target as it stands, to be the next pose after those of ``before``."""
        lamp, lamp_ms = self._images.take("lamp")
        found = self._judge.find(lamp)
        view, quality = found.usable, found.quality
        if view is None or quality is None:
            return Refused(found, found.reasons)
        if reasons := judge_novelty(view, [p.view for p in before.recorded], self.limits):
            return Refused(found, reasons)
        laser, stripe = self._laser(view)
        after = self.look()
        reasons = after.reasons if after.usable is None else judge_motion(view, after.usable, self.limits)
        if reasons or stripe.reasons:
            return Refused(found, (*reasons, *stripe.reasons))
        shown = stripe.lines >= self.limits.fewest_lines
        pose = RecordedPose(view, stripe.pixels if shown else np.empty((0, 2)), stage_mm)
        state, reasons = self._judge.with_pose(before, pose)
        if state is None or reasons:
            return Refused(found, reasons)
        return Accepted(found, quality, pose, (lamp, lamp_ms), laser if shown else None, state)

    def _laser(self, view: TargetView) -> tuple[tuple[np.ndarray, float], StripeQuality]:
        """Laser image with its exposure, taken again with another exposure if the stripe is saturated."""
        laser = self._images.take("laser")
        stripe = self._judge.stripe(laser[0], view)
        if stripe.reasons and self._images.resettle("laser"):
            laser = self._images.take("laser")
            stripe = self._judge.stripe(laser[0], view)
        return laser, stripe


def _contradiction(before: CameraSolution | None, state: State) -> tuple[str, ...]:
    if state.solution is None:
        return () if before is None else (f"contradicts the others: with it {state.undetermined}",)
    return judge_residual(before, state.solution)
