"""Phases of a guided calibration: the target at the stage's positions or held by hand, then the step standard."""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from uwlts.calibration.guidance.pose_advice import (
    PoseAdvice,
    State,
    best_pose,
    format_pose_advice,
    gain_of,
    missing,
    missing_sheet,
)
from uwlts.calibration.guidance.solution import pose_of
from uwlts.calibration.guidance.step import StepQuality, is_new, judge_step, least_apart_mm, next_depth_mm
from uwlts.calibration.image_quality import LampFault, LaserFault, MotionFault, judge_novelty, way_px
from uwlts.hardware.guided.attempt import Accepted, Found, GuidedImages, PoseJudge
from uwlts.hardware.guided.operator import GuidedPage, Operator
from uwlts.hardware.guided.plan import GuidedPlan, GuidedStep
from uwlts.model.calibration import Calibration, WindowModel
from uwlts.model.sensor import Sensor
from uwlts.storage.capture import Capture, CaptureWriter, Frame
from uwlts.targets import TargetView

_TRIES = 3
_SAME_POSITION_MM = 0.02
# A target held by hand stands still while its points move by no more than this.
_STILL_PX = 0.5
# Free poses have no stage position; this numbers their images without looking like a motion of the stage.
_NUMBER_MM = 1e-3
# A pose is taken without being asked for if it helps this much of what the best one would.
_USEFUL = 0.25
_RESETTLE_S = 2.0


def still_missing(state: State) -> list[str]:
    """What camera and laser sheet still lack."""
    return [*missing(state), *missing_sheet(state)]


def places_left(plan: GuidedPlan, state: State) -> list[float]:
    """Stage positions of a plan that are not recorded yet; none for free poses."""
    if plan.poses == "free" or plan.stage is None:
        return []
    done = np.array([pose.stage_mm for pose in state.recorded])
    return [place for place in plan.stage.places_mm() if not (np.abs(done - place) <= _SAME_POSITION_MM).any()]


class Session:
    """A recording with camera and stage open: takes images, talks to the operator, and writes the capture.

    ``before_s`` is the time of the last image of an interrupted recording.
    """

    def __init__(
        self, images: GuidedImages, operator: Operator, page: GuidedPage, writer: CaptureWriter, *, before_s: float
    ):
        self.images, self.operator, self.page = images, operator, page
        self._writer, self._start_s = writer, time.monotonic() - before_s

    def show(
        self, image: np.ndarray, remark: str, *, points: np.ndarray | None = None, stripe: np.ndarray | None = None
    ) -> None:
        """Show an image (H, W) with points (N, 2) and stripe pixels (N, 2) on the page."""
        full = self._writer.header.saturation_dn
        self.page.live(image, full_dn=full, points=points, stripe=stripe, remark=remark)

    def report(self, line: str) -> None:
        """Say a line, and add it to the page's list of images."""
        self.operator.say(line)
        self.page.add(line)

    def record(self, image: np.ndarray, exposure_ms: float, *, stage_mm: float, laser_on: bool) -> None:
        """Write an image (H, W) to the capture."""
        self._writer.append(Frame(image, stage_mm, laser_on, exposure_ms, time.monotonic() - self._start_s))


class TargetPhase:
    """Records poses of the target until what is wanted is reached."""

    def __init__(self, plan: GuidedPlan, session: Session, judge: PoseJudge):
        self._plan, self._session, self._judge = plan, session, judge
        self._images, self._operator, self._page = session.images, session.operator, session.page
        self._settled_s = -np.inf

    def run(self, state: State) -> State:
        """Go on from a state; how far it came.

        HardwareError where camera, stage or laser fail; OutputError where the capture cannot be written.
        """
        self._show_state(state)
        return self._free(state) if self._plan.poses == "free" else self._by_stage(state)

    def _by_stage(self, state: State) -> State:
        places = places_left(self._plan, state)
        for number, place in enumerate(places):
            self._page.request(f"the stage goes to {place:.2f} mm, {len(places) - number} positions left")
            position = self._images.rig.move_to(place)
            for _ in range(_TRIES):
                found = self._judge.attempt(self._images, state, position)
                state = self._done(found, state, f"{position:.2f} mm")
                # Another attempt may be better once the target has come to rest, or with another exposure.
                moved = any(isinstance(reason, MotionFault) for reason in found.reasons)
                if not (moved or self._improve_light(found.reasons)):
                    break
        return state

    def _free(self, state: State) -> State:
        advice: PoseAdvice | None = None
        refused: list[TargetView] = []
        still: TargetView | None = None
        since_s = time.monotonic()
        while still_missing(state) and len(state.recorded) < self._plan.most_images:
            found = self._judge.find(self._images.take("lamp")[0])
            advice = advice or best_pose(state, spin_rad=_spin(found.usable, state))
            answer = self._operator.answer()
            if answer == "done":
                break
            if found.view is None or still is None or way_px(still, found.view) > _STILL_PX:
                still, since_s = found.view, time.monotonic()
            self._improve_light(found.reasons)
            reasons = self._why_wait(found, state, advice, [*(p.view for p in state.recorded), *refused])
            self._lead(found, state, advice, reasons)
            stands = still is not None and time.monotonic() - since_s >= self._plan.still_s
            if answer is None and (reasons or not stands):
                continue
            last = max((round(pose.stage_mm / _NUMBER_MM) for pose in state.recorded), default=0)
            found = self._judge.attempt(self._images, state, _NUMBER_MM * (last + 1))
            state = self._done(found, state, f"image {len(state.recorded) + 1}")
            still, since_s = None, time.monotonic()
            if isinstance(found, Accepted):
                advice = None
            else:
                refused = [] if found.view is None else [found.view]
        return state

    def _why_wait(
        self, found: Found, state: State, advice: PoseAdvice | None, known: list[TargetView]
    ) -> tuple[str, ...]:
        """Why the target as it stands need not be taken."""
        view = found.usable
        if view is None:
            return found.reasons
        reasons = judge_novelty(view, known, self._judge.limits)
        if reasons or advice is None or missing_sheet(state):
            return reasons
        gain = gain_of(state, view, pose_of(view, state.camera))
        return () if gain >= _USEFUL * advice.gain else ("adds little to what there is",)

    def _lead(self, found: Found, state: State, advice: PoseAdvice | None, reasons: tuple[str, ...]) -> None:
        """Show the image, and say what to do next."""
        pose = None if found.usable is None else pose_of(found.usable, state.camera)
        sheet = missing_sheet(state)
        request = "move the target" if advice is None else format_pose_advice(advice, state, pose)
        if sheet and not missing(state):
            request = f"move the target so that the laser line lies on it, nearer and farther: {sheet[0]}"
        self._page.request(request if reasons else "hold it still")
        self._operator.hint(f"next: {request if advice is None or sheet else format_pose_advice(advice, state, None)}")
        points = None if found.view is None else found.view.pixels
        self._session.show(found.image, "; ".join(reasons) or "good", points=points)

    def _improve_light(self, reasons: tuple[str, ...]) -> bool:
        """Settle the lamp's exposure again where an image was too bright or too dark, but not all the time."""
        light = any(isinstance(reason, LampFault) for reason in reasons)
        if not light or time.monotonic() - self._settled_s < _RESETTLE_S:
            return False
        changed = self._images.settle("lamp")
        self._settled_s = time.monotonic()
        return changed

    def _done(self, found: Found, state: State, name: str) -> State:
        """Record what was accepted, and say what became of it; the state after it."""
        stripe = None
        if isinstance(found, Accepted):
            state, stripe, stage_mm = found.state, found.pose.stripe, found.pose.stage_mm
            self._session.record(found.image, found.lamp_ms, stage_mm=stage_mm, laser_on=False)
            if found.laser is not None:
                self._session.record(*found.laser, stage_mm=stage_mm, laser_on=True)
        line = f"{name}: {found.line()}"
        self._session.report(line)
        points = None if found.view is None else found.view.pixels
        self._session.show(found.image, line, points=points, stripe=stripe)
        self._show_state(state)
        return state

    def _show_state(self, state: State) -> None:
        self._page.recorded(state.coverage, [pose.view.pixels for pose in state.recorded])


def _spin(view: TargetView | None, state: State) -> float:
    """How the target is turned in the image, as it was last seen."""
    if view is not None:
        pose = pose_of(view, state.camera)
    elif len(state.poses):
        pose = state.poses[-1]
    else:
        return 0.0
    return float(np.arctan2(pose[1, 0], pose[0, 0]))


@dataclass(frozen=True)
class StepJudge:
    """Judges laser images of the standard by the calibration in air and the nominal window."""

    step: GuidedStep
    sensor: Sensor
    calibration: Calibration
    window: WindowModel

    def judge(self, image: np.ndarray) -> StepQuality:
        """What an image (H, W) shows."""
        return judge_step(
            image,
            self.calibration,
            self.window,
            self.step.standard(),
            medium_index=self.sensor.medium(self.step.medium).refractive_index(self.sensor.laser.wavelength_nm),
            full_dn=self.sensor.detector.full_scale_dn(),
        )

    def depths_mm(self, path: Path) -> list[float]:
        """Depths outside the window at which a recording shows the standard."""
        with Capture(path) as capture:
            qualities = [self.judge(image) for _, image in capture.frames(laser_on=True)]
        return [each.depth_mm for each in qualities if each.depth_mm is not None and not each.reasons]


class StepPhase:
    """Records images of the standard until it was seen near, in the middle and far."""

    def __init__(self, judge: StepJudge, session: Session):
        self._judge, self._session, self._images = judge, session, session.images

    def run(self, seen_mm: Sequence[float]) -> list[float]:
        """Go on after the depths that are recorded; all depths then. Errors as `TargetPhase.run`."""
        seen, session = list(seen_mm), self._session
        while (wanted := next_depth_mm(seen, self._judge.sensor)) is not None:
            request = (
                f"put the step standard about {wanted:.0f} mm outside the window, with the laser line across its step"
            )
            session.page.request(request)
            if session.operator.wait(request, lambda: session.show(self._images.unlit(), "the laser is off")) == "done":
                break
            before = tuple(seen)
            for position in self._judge.step.positions_mm or (None,):
                taken = self._take(position, before)
                seen += [] if taken is None else [taken]
        return seen

    def _take(self, position: float | None, before_mm: Sequence[float]) -> float | None:
        """Take the standard as it stands; at which depth it was recorded, None if it was refused."""
        stage_mm = 0.0 if position is None else self._images.rig.move_to(position)
        image, exposure_ms = self._images.take("laser")
        quality = self._judge.judge(image)
        if any(isinstance(reason, LaserFault) for reason in quality.reasons) and self._images.settle("laser"):
            image, exposure_ms = self._images.take("laser")
            quality = self._judge.judge(image)
        # Nobody moves the standard while the laser is on.
        self._images.unlit()
        depth_mm, reasons, sensor = quality.depth_mm, quality.reasons, self._judge.sensor
        if depth_mm is not None and not reasons and not is_new(depth_mm, before_mm, sensor):
            nearest = min(before_mm, key=lambda other: abs(other - depth_mm))
            reasons = (
                f"too similar: it stands {depth_mm:.0f} mm outside the window and was seen at {nearest:.0f} mm; move "
                f"it by {least_apart_mm(sensor):.0f} mm or more",
            )
        if reasons:
            line = f"refused: {'; '.join(reasons)}"
        else:
            line = f"stripe on {len(quality.pixels)} lines, {depth_mm:.0f} mm outside the window"
        self._session.report(f"step: {line}")
        self._session.show(image, line, stripe=quality.pixels)
        if reasons or depth_mm is None:
            return None
        self._session.record(image, exposure_ms, stage_mm=stage_mm, laser_on=True)
        return depth_mm
