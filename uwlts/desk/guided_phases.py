"""Phases of a guided calibration: attempts at poses of the target, then images of the step standard.

The target is shown at the stage's positions or held by hand.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from uwlts.calibration.camera.image_quality import (
    FEWEST_TARGET_LINES,
    LampFault,
    LaserFault,
    MotionFault,
    StripeQuality,
    TargetQuality,
    explain_missing_target,
    judge_motion,
    judge_novelty,
    judge_stripe,
    judge_target,
    measure_shift_px,
)
from uwlts.calibration.guidance import (
    RecordedPose,
    Setting,
    State,
    StepQuality,
    best_pose,
    compute_gain,
    describe_missing,
    describe_missing_sheet,
    estimate_pose,
    format_pose_advice,
    is_separate_depth,
    judge_residual,
    judge_step,
    least_separation_mm,
    next_depth_mm,
    solve_state,
)
from uwlts.desk.guided_plan import GuidedPlan, GuidedStep
from uwlts.desk.guided_screen import BoardScreen
from uwlts.desk.shown_state import Picture
from uwlts.errors import CalibrationError, TargetError
from uwlts.fitting.next_observation import Forecast
from uwlts.hardware.rig import START_MS, Rig
from uwlts.hardware.scan_plan import Light, RigPlan
from uwlts.model.calibration import Calibration, WindowModel
from uwlts.model.sensor import Sensor
from uwlts.storage.capture import Capture, Frame
from uwlts.storage.capture_writer import CaptureWriter
from uwlts.targets import TargetView

_TRIES = 3  # images of a position, until the target is found in one
# Largest motion of the points of a hand-held target that counts as standing still.
_STILL_PX = 0.5
# Free poses have no stage position; they are numbered in this unit, which does not look like a motion of the stage.
_NUMBER_MM = 1e-3
# A pose that was not requested is taken if its gain is at least this fraction of the best pose's gain.
_USEFUL = 0.25
_RESETTLE_S = 2.0
_STAGE_CHANGE_PX = 0.5  # least difference of poses at positions of the stage


class Session:
    """Recording in progress: takes images with the open camera and stage, and writes the capture.

    Images are taken at the exposure of their light. ``known_ms`` are the settled exposures, and ``before_s`` the time
    of the last image, of an interrupted recording.
    """

    def __init__(
        self,
        rig: Rig,
        plan: RigPlan,
        writer: CaptureWriter,
        screen: BoardScreen,
        *,
        dtype: np.dtype,
        known_ms: dict[Light, float],
        before_s: float,
    ):
        self.rig, self.screen = rig, screen
        self._plan, self._writer, self._dtype = plan, writer, dtype
        self._exposure_ms = plan.planned_ms() | known_ms
        self._start_s = time.monotonic() - before_s

    def take(self, light: Light) -> tuple[np.ndarray, float]:
        """Take an image (H, W) in a light; return it with its exposure in ms."""
        if light not in self._exposure_ms:
            self.settle(light)
        asked_ms = self._exposure_ms.get(light, START_MS)
        frame = self.rig.frame(light, asked_ms)
        return frame.image.astype(self._dtype, copy=False), asked_ms if frame.exposure_ms is None else frame.exposure_ms

    def take_unlit(self) -> np.ndarray:
        """Take a short image (H, W) without laser, in the ambient light."""
        return self.rig.frame("lamp", START_MS).image

    def settle(self, light: Light) -> bool:
        """Find the exposure for the present scene; return False if it is planned, or the scene is too dark."""
        if light in self._plan.planned_ms():
            return False
        found = self.rig.find_exposure(light, start_ms=self._exposure_ms.get(light, START_MS))
        if found is not None:
            self._exposure_ms[light] = found
        return found is not None

    def show(
        self, image: np.ndarray, remark: str, *, points: np.ndarray | None = None, stripe: np.ndarray | None = None
    ) -> None:
        """Show an image (H, W) with points (N, 2) and stripe pixels (N, 2) on the screen."""
        full = self._writer.header.saturation_dn
        self.screen.show(Picture(image, full_dn=full, caption=remark, stripe=stripe, points=points))

    def record(self, image: np.ndarray, exposure_ms: float, *, stage_mm: float, laser_on: bool) -> None:
        """Write an image (H, W) to the capture."""
        self._writer.append(Frame(image, stage_mm, laser_on, exposure_ms, time.monotonic() - self._start_s))


@dataclass(frozen=True, eq=False)
class Found:
    """Target found in a lamp image (H, W), or None, with the reasons that make it unusable.

    An accepted one has the ``pose`` to be recorded, and the calibration ``state`` that includes it. ``lamp_ms`` is the
    exposure of the image. ``laser`` is the image (H, W) with the laser line and its exposure in ms, if the line was on
    the target.
    """

    image: np.ndarray
    view: TargetView | None
    quality: TargetQuality | None
    reasons: tuple[str, ...]
    pose: RecordedPose | None = None
    state: State | None = None
    lamp_ms: float = 0.0
    laser: tuple[np.ndarray, float] | None = None

    @property
    def usable(self) -> TargetView | None:
        """The target, or None if there is a reason against it."""
        return None if self.reasons else self.view

    def line(self) -> str:
        """Return the quality of an accepted pose, or the reasons against it, as a line of text."""
        if self.quality is None or self.pose is None or self.state is None:
            return f"refused: {'; '.join(self.reasons)}"
        quality, state = self.quality, self.state
        stripe = f"stripe on {len(self.pose.stripe)} lines" if self.laser else "no stripe on the target"
        residual = "not yet" if state.solution is None else f"{state.solution.image_rms_px()[-1]:.2f} px"
        return (
            f"{quality.points} points, edges {quality.blur_px:.1f} px, coverage {100 * state.coverage.share:.0f} %, "
            f"{stripe}, residual {residual}"
        )


def list_missing(state: State) -> list[str]:
    """List the evidence that is still missing for camera and laser sheet."""
    return [*describe_missing(state), *describe_missing_sheet(state)]


class TargetPhase:
    """Recording of target poses until the goal is reached, and judgement of their images, new or recorded."""

    _session: Session

    def __init__(self, plan: GuidedPlan, setting: Setting):
        self._plan, self._setting, self._wanted = plan, setting, plan.goal()
        self._full = setting.sensor.detector.full_scale_dn()
        self._settled_s = -np.inf

    def find(self, image: np.ndarray) -> Found:
        """Find and judge the target in a lamp image (H, W)."""
        try:
            view = self._setting.target.detect(image)
        except TargetError as error:
            return Found(image, None, None, (explain_missing_target(image, str(error), full_dn=self._full),))
        quality = judge_target(image, view, self._setting.target, full_dn=self._full)
        return Found(image, view, quality, quality.reasons)

    def stripe(self, image: np.ndarray, view: TargetView) -> StripeQuality:
        """Judge the stripe in a laser image (H, W) on the target in a view."""
        return judge_stripe(
            image, view, self._setting.target, stripe_along=self._setting.sensor.camera.stripe_along, full_dn=self._full
        )

    def state(self, recorded: Sequence[RecordedPose]) -> State:
        """Return the state that recorded poses lead to; raises the errors of `solve_state`."""
        return solve_state(recorded, self._setting, self._wanted)

    def read_recorded(self, path: Path) -> list[RecordedPose]:
        """Read the poses in a capture of the target, judged like new ones."""
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

    def _attempt(self, before: State, stage_mm: float) -> Found:
        """Try to take the target as the next pose after those of ``before``; return it accepted, or with reasons."""
        session = self._session
        lamp, lamp_ms = session.take("lamp")
        found = self.find(lamp)
        if (view := found.usable) is None:
            return found
        if reasons := self._judge_novelty(view, [p.view for p in before.recorded]):
            return replace(found, reasons=reasons)
        laser = session.take("laser")
        stripe = self.stripe(laser[0], view)
        if stripe.reasons and session.settle("laser"):
            laser = session.take("laser")
            stripe = self.stripe(laser[0], view)
        after = self.find(session.take("lamp")[0])
        reasons = after.reasons if after.usable is None else judge_motion(view, after.usable)
        if reasons or stripe.reasons:
            return replace(found, reasons=(*reasons, *stripe.reasons))
        shown = stripe.lines >= FEWEST_TARGET_LINES
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
        return replace(found, pose=pose, state=state, lamp_ms=lamp_ms, laser=laser if shown else None)

    def _judge_novelty(self, view: TargetView, recorded: list[TargetView]) -> tuple[str, ...]:
        # The stage's steps may be small: its position distinguishes the poses.
        by_stage = {} if self._plan.poses == "free" else {"least_px": _STAGE_CHANGE_PX}
        return judge_novelty(view, recorded, **by_stage)

    def run(self, session: Session, state: State) -> State:
        """Continue from a state, and return the final state.

        Raises HardwareError if camera, stage or laser fail, and OutputError if the capture cannot be written.
        """
        self._session = session
        self._show_state(state)
        return self._record_by_hand(state) if self._plan.poses == "free" else self._record_by_stage(state)

    def _record_by_stage(self, state: State) -> State:
        places = self._plan.places_left(state.recorded)
        for number, place in enumerate(places):
            self._session.screen.request(f"the stage goes to {place:.2f} mm, {len(places) - number} positions left")
            answer = self._session.screen.answer()
            if answer == "done":
                break
            if answer == "skip":
                continue
            position = self._session.rig.move_to(place)
            for _ in range(_TRIES):
                found = self._attempt(state, position)
                state = self._record_accepted(found, state, f"{position:.2f} mm")
                # Another attempt may succeed once the target is at rest, or with another exposure.
                moved = any(isinstance(reason, MotionFault) for reason in found.reasons)
                if not (moved or self._improve_light(found.reasons)):
                    break
        return state

    def _record_by_hand(self, state: State) -> State:
        advice: Forecast | None = None
        refused: list[TargetView] = []
        still: TargetView | None = None
        since_s, skipped = time.monotonic(), 0
        while list_missing(state) and len(state.recorded) < self._plan.most_images:
            found = self.find(self._session.take("lamp")[0])
            if not advice:
                latest = state.poses[-1:] if found.usable is None else [estimate_pose(found.usable, state.camera)]
                spin_rad = float(np.arctan2(latest[0][1, 0], latest[0][0, 0])) if len(latest) else 0.0
                advice = best_pose(state, spin_rad=spin_rad, skipped=skipped)
            answer = self._session.screen.answer()
            if answer == "done":
                break
            if answer == "skip":
                advice, skipped = None, skipped + 1
                continue
            if found.view is None or still is None or measure_shift_px(still, found.view) > _STILL_PX:
                still, since_s = found.view, time.monotonic()
            self._improve_light(found.reasons)
            reasons = self._find_reasons(found, state, advice, [*(p.view for p in state.recorded), *refused])
            self._lead(found, state, advice, reasons)
            stands = still is not None and time.monotonic() - since_s >= self._plan.still_s
            if answer is None and (reasons or not stands):
                continue
            last = max((round(pose.stage_mm / _NUMBER_MM) for pose in state.recorded), default=0)
            found = self._attempt(state, _NUMBER_MM * (last + 1))
            state = self._record_accepted(found, state, f"image {len(state.recorded) + 1}")
            still, since_s = None, time.monotonic()
            if found.pose is not None:
                advice, skipped = None, 0
            else:
                refused = [] if found.view is None else [found.view]
        return state

    def _find_reasons(
        self, found: Found, state: State, advice: Forecast | None, known: list[TargetView]
    ) -> tuple[str, ...]:
        """Return the reasons not to record the target as it is."""
        view = found.usable
        if view is None:
            return found.reasons
        reasons = self._judge_novelty(view, known)
        if reasons or advice is None or describe_missing_sheet(state):
            return reasons
        gain = compute_gain(state, view, estimate_pose(view, state.camera))
        return () if gain >= _USEFUL * advice.gain else ("adds little to what there is",)

    def _lead(self, found: Found, state: State, advice: Forecast | None, reasons: tuple[str, ...]) -> None:
        """Show the image and the next request to the operator."""
        pose = None if found.usable is None else estimate_pose(found.usable, state.camera)
        sheet = describe_missing_sheet(state)
        request = "move the target" if advice is None else format_pose_advice(advice.candidate.pose, state, pose)
        if sheet and not describe_missing(state):
            request = f"move the target so that the laser line lies on it, nearer and farther: {sheet[0]}"
        self._session.screen.request(request if reasons else "hold it still")
        hint = request if advice is None or sheet else format_pose_advice(advice.candidate.pose, state, None)
        self._session.screen.hint(f"next: {hint}")
        points = None if found.view is None else found.view.pixels
        self._session.show(found.image, "; ".join(reasons) or "good", points=points)

    def _improve_light(self, reasons: tuple[str, ...]) -> bool:
        """Settle the lamp's exposure again if an image was too bright or dark; return whether it was changed."""
        light = any(isinstance(reason, LampFault) for reason in reasons)
        if not light or time.monotonic() - self._settled_s < _RESETTLE_S:
            return False
        changed = self._session.settle("lamp")
        self._settled_s = time.monotonic()
        return changed

    def _record_accepted(self, found: Found, state: State, name: str) -> State:
        """Record an accepted pose, report the result, and return the state after it."""
        stripe = None
        if found.pose is not None and found.state is not None:
            state, stripe, stage_mm = found.state, found.pose.stripe, found.pose.stage_mm
            self._session.record(found.image, found.lamp_ms, stage_mm=stage_mm, laser_on=False)
            if found.laser is not None:
                self._session.record(*found.laser, stage_mm=stage_mm, laser_on=True)
        line = f"{name}: {found.line()}"
        self._session.screen.say(line)
        points = None if found.view is None else found.view.pixels
        self._session.show(found.image, line, points=points, stripe=stripe)
        self._show_state(state)
        return state

    def _show_state(self, state: State) -> None:
        self._session.screen.show_coverage(state.coverage, [pose.view.pixels for pose in state.recorded])


@dataclass(frozen=True)
class StepPhase:
    """Recording of the step standard near, in the middle and far.

    Its laser images are judged with the ``calibration`` in air and the nominal ``window``.
    """

    step: GuidedStep
    sensor: Sensor
    calibration: Calibration
    window: WindowModel

    def _judge(self, image: np.ndarray) -> StepQuality:
        """Judge the step standard's stripe in an image (H, W)."""
        return judge_step(
            image,
            self.calibration,
            self.window,
            self.step,
            medium_index=self.sensor.medium(self.step.medium).refractive_index(self.sensor.laser.wavelength_nm),
            full_dn=self.sensor.detector.full_scale_dn(),
        )

    def depths_mm(self, path: Path) -> list[float]:
        """Return the standard's depths outside the window in a recording."""
        with Capture(path) as capture:
            qualities = [self._judge(image) for _, image in capture.frames(laser_on=True)]
        return [each.depth_mm for each in qualities if each.depth_mm is not None and not each.reasons]

    def run(self, session: Session, seen_mm: Sequence[float]) -> list[float]:
        """Continue after the recorded depths; return all depths. Raises the errors of `TargetPhase.run`."""
        seen, skipped = list(seen_mm), 0
        while (wanted := next_depth_mm(seen, self.sensor, skipped=skipped)) is not None:
            request = (
                f"put the step standard about {wanted:.0f} mm outside the window, with the laser line across its step"
            )
            session.screen.request(request)
            answer = session.screen.wait(request, lambda: session.show(session.take_unlit(), "the laser is off"))
            if answer == "done":
                break
            if answer == "skip":
                skipped += 1
                continue
            skipped = 0
            before = tuple(seen)
            for position in self.step.positions_mm or (None,):
                taken = self._take(session, position, before)
                seen += [] if taken is None else [taken]
        return seen

    def _take(self, session: Session, position: float | None, before_mm: Sequence[float]) -> float | None:
        """Take the standard as it is; return the recorded depth in mm, or None if it was refused."""
        stage_mm = 0.0 if position is None else session.rig.move_to(position)
        image, exposure_ms = session.take("laser")
        quality = self._judge(image)
        if any(isinstance(reason, LaserFault) for reason in quality.reasons) and session.settle("laser"):
            image, exposure_ms = session.take("laser")
            quality = self._judge(image)
        # The laser must be off while the standard is moved.
        session.take_unlit()
        depth_mm, reasons, sensor = quality.depth_mm, quality.reasons, self.sensor
        if depth_mm is not None and not reasons and not is_separate_depth(depth_mm, before_mm, sensor):
            nearest = min(before_mm, key=lambda other: abs(other - depth_mm))
            reasons = (
                f"too similar: it stands {depth_mm:.0f} mm outside the window and was seen at {nearest:.0f} mm; move "
                f"it by {least_separation_mm(sensor):.0f} mm or more",
            )
        if reasons:
            line = f"refused: {'; '.join(reasons)}"
        else:
            line = f"stripe on {len(quality.pixels)} lines, {depth_mm:.0f} mm outside the window"
        session.screen.say(f"step: {line}")
        session.show(image, line, stripe=quality.pixels)
        if reasons or depth_mm is None:
            return None
        session.record(image, exposure_ms, stage_mm=stage_mm, laser_on=True)
        return depth_mm
