"""Images of a guided calibration and attempts at poses of the target: taken, judged, accepted or refused."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

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
from uwlts.hardware.rig import START_MS, Rig
from uwlts.hardware.scan_plan import LIGHTS, Light, RigPlan
from uwlts.model.errors import CalibrationError, TargetError
from uwlts.storage.capture import Capture
from uwlts.targets import TargetView


class GuidedImages:
    """Takes images at the exposure of their light.

    ``known_ms`` are exposures already settled, as those of a recording that is continued.
    """

    def __init__(self, rig: Rig, plan: RigPlan, *, dtype: np.dtype, known_ms: dict[Light, float]):
        self.rig, self._plan, self._dtype = rig, plan, dtype
        planned_ms = {light: ms for light in LIGHTS if (ms := plan.planned_ms(light)) != "auto"}
        self._exposure_ms: dict[Light, float] = planned_ms | known_ms

    def take(self, light: Light) -> tuple[np.ndarray, float]:
        """Image (H, W) in a light, and its exposure in ms."""
        if light not in self._exposure_ms:
            self.settle(light)
        image, exposure_ms = self.rig.image(light, self._exposure_ms.get(light, START_MS))
        return image.astype(self._dtype, copy=False), exposure_ms

    def unlit(self) -> np.ndarray:
        """A short image (H, W) without laser, in whatever light there is."""
        return self.rig.image("lamp", START_MS)[0]

    def settle(self, light: Light) -> bool:
        """Find the exposure for what is seen now; whether there is one that was not planned: in the dark is none."""
        if self._plan.planned_ms(light) != "auto":
            return False
        found = self.rig.settled_exposure(light, start_ms=self._exposure_ms.get(light, START_MS))
        if found is not None:
            self._exposure_ms[light] = found
        return found is not None


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

    def line(self) -> str:
        """The reasons in a line."""
        return f"refused: {'; '.join(self.reasons)}"


@dataclass(frozen=True, eq=False)
class Accepted(Found):
    """A pose to be recorded, and the ``state`` of the calibration with it.

    ``lamp_ms`` is the exposure of the image; ``laser`` is the image (H, W) with the laser line, if that was on the
    target, with its exposure in ms.
    """

    quality: TargetQuality
    pose: RecordedPose
    lamp_ms: float
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

    def state(self, recorded: Sequence[RecordedPose]) -> State:
        """How far recorded poses lead; errors as `state_of`."""
        return state_of(recorded, self._setting, self._wanted)

    def recorded(self, path: Path) -> list[RecordedPose]:
        """The poses that a capture of the target holds, judged as when they were taken."""
        with Capture(path) as capture:
            stripes = {float(capture.stage_mm[k]): image for k, image in capture.frames(laser_on=True)}
            poses = []
            for frame, image in capture.frames(laser_on=False):
                view, stage_mm = self.find(image).view, float(capture.stage_mm[frame])
                if view is not None:
                    lit = stripes.get(stage_mm)
                    stripe = np.empty((0, 2)) if lit is None else self.stripe(lit, view).pixels
                    poses.append(RecordedPose(view, stripe, stage_mm))
        return poses

    def attempt(self, images: GuidedImages, before: State, stage_mm: float) -> Found:
        """Take the target as it stands, to be the next pose after those of ``before``; `Accepted`, or the reasons."""
        lamp, lamp_ms = images.take("lamp")
        found = self.find(lamp)
        view, quality = found.usable, found.quality
        if view is None or quality is None:
            return found
        if reasons := judge_novelty(view, [p.view for p in before.recorded], self.limits):
            return replace(found, reasons=reasons)
        laser = images.take("laser")
        stripe = self.stripe(laser[0], view)
        if stripe.reasons and images.settle("laser"):
            laser = images.take("laser")
            stripe = self.stripe(laser[0], view)
        after = self.find(images.take("lamp")[0])
        reasons = after.reasons if after.usable is None else judge_motion(view, after.usable, self.limits)
        if reasons or stripe.reasons:
            return replace(found, reasons=(*reasons, *stripe.reasons))
        shown = stripe.lines >= self.limits.fewest_lines
        pose = RecordedPose(view, stripe.pixels if shown else np.empty((0, 2)), stage_mm)
        try:
            state = self.state([*before.recorded, pose])
        except CalibrationError as error:
            return replace(found, reasons=(str(error),))
        if state.solution is not None:
            reasons = judge_residual(before.solution, state.solution)
        elif before.solution is not None:
            reasons = (f"contradicts the others: with it {state.undetermined}",)
        if reasons:
            return replace(found, reasons=reasons)
        return Accepted(lamp, view, quality, (), pose, lamp_ms, laser if shown else None, state)
