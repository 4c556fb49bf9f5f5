"""Guided calibration: leads through poses of the target and of the step standard, and records accepted images.

The captures are ordinary ones, so that the calibration can be repeated. However the recording ends, accepted images
are kept and the laser goes off.
"""

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from uwlts.calibration.camera.camera_parameters import CameraOptions
from uwlts.calibration.camera.target_poses import Poses
from uwlts.calibration.guidance.pose_advice import Setting, State
from uwlts.calibration.guidance.step import PLACES, next_depth_mm, select_separate_depths
from uwlts.calibration.sequential.sequential_calibration import CalibrationOptions, calibrate_sequentially
from uwlts.hardware.grbl import GrblStage
from uwlts.hardware.guided.guided_plan import GuidedPlan, GuidedStage, GuidedStep
from uwlts.hardware.guided.operator import Operator, Screen
from uwlts.hardware.guided.phases import PoseJudge, Session, StepJudge, StepPhase, TargetPhase, list_missing
from uwlts.hardware.rig import HandSwitchedLaser, LaserStage, Rig, add_provenance
from uwlts.hardware.scanning import check_camera, open_camera, read_unfinished
from uwlts.model.calibration import WindowModel
from uwlts.storage.capture import Capture, CaptureHeader, part_path
from uwlts.storage.capture_writer import CaptureWriter


@dataclass(frozen=True)
class GuidedRecording:
    """Captures of target and step standard, the kind of poses, and the missing evidence."""

    air: tuple[Path, ...]
    water: tuple[Path, ...]
    step: tuple[Path, ...]
    poses: Poses
    missing: tuple[str, ...]


def guide(
    plan: GuidedPlan,
    out: Path,
    screen: Screen,
    *,
    refractions: Literal[1, 2] = 2,
    distortion: tuple[str, ...] = ("k1", "k2"),
    resume: bool = False,
    overwrite: bool = False,
    report: Callable[[str], None] = print,
    answers: int | None = None,
) -> GuidedRecording:
    """Lead through the images of a calibration on a screen. The errors are those of `uwlts.desk.record_guided`.

    The captures are written beside ``out``, the calibration; ``resume`` continues interrupted ones. ``refractions`` and
    ``distortion`` are those of the calibration that judges the images. ``answers`` is the file descriptor of the
    operator's answers, by default standard input.
    """
    camera = plan.camera_address()
    options = CalibrationOptions(refractions=refractions, poses=plan.poses, camera=CameraOptions(distortion=distortion))
    setting = replace(plan.setting(), camera=options.camera)
    operator = Operator(report, screen, answers=answers)
    phases = _Phases(plan, setting, camera, screen, operator, resume, overwrite and not resume)
    target, step = (out.with_name(f"{out.stem}-{shown}.h5") for shown in ("target", "step"))
    missing = list_missing(phases.target(target))
    if plan.step is not None:
        with Capture(target) as capture:
            known = calibrate_sequentially([capture], (), options=options).calibration
        sensor = plan.described_sensor()
        window = WindowModel.from_description(sensor.camera.window, sensor.laser.wavelength_nm, refractions=refractions)
        missing += phases.step(step, plan.step, StepJudge(plan.step, sensor, known, window))
    return GuidedRecording(
        air=(target,) if plan.target_in_air() else (),
        water=() if plan.target_in_air() else (target,),
        step=(step,) if plan.step is not None else (),
        poses=plan.poses,
        missing=tuple(missing),
    )


@dataclass(frozen=True)
class _Phases:
    """Both phases of the recording; each opens camera and stage, because in between the tank is worked at."""

    plan: GuidedPlan
    setting: Setting
    camera: str
    screen: Screen
    operator: Operator
    resume: bool
    overwrite: bool

    def _find_unfinished(self, path: Path) -> Path | None:
        """Return the recording to continue: an interrupted one, or a finished one that may not suffice."""
        return next((each for each in (part_path(path), path) if each.is_file()), None) if self.resume else None

    def target(self, path: Path) -> State:
        """Record the target, and return the final state."""
        plan = self.plan
        judge = PoseJudge(self.setting, plan.goal(), full_dn=self.setting.sensor.detector.full_scale_dn())
        left = self._find_unfinished(path)
        state = judge.state([] if left is None else judge.read_recorded(left))
        if left == path:
            if plan.poses == "free":
                more = bool(list_missing(state)) and len(state.recorded) < plan.most_images
            else:
                more = bool(plan.places_left(state.recorded))
            if not more:
                self.operator.say(f"{path.name} is complete: {len(state.recorded)} poses")
                return state
            os.replace(path, part_path(path))
        positions = plan.places_left([])
        with self._session(path, positions, plan.target_header(path.stem)) as session:
            return TargetPhase(plan, session, judge).run(state)

    def step(self, path: Path, step: GuidedStep, judge: StepJudge) -> list[str]:
        """Record the step standard, and return the missing evidence."""
        left = self._find_unfinished(path)
        seen = [] if left is None else judge.depths_mm(left)
        if left == path:
            if next_depth_mm(seen, judge.sensor) is None:
                self.operator.say(f"{path.name} is complete")
                return []
            os.replace(path, part_path(path))
        request = f"bring the sensor into {step.medium}, with its window, and the step standard before it"
        self.screen.request(request)
        self.operator.wait(request)
        with self._session(path, list(step.positions_mm), self.plan.step_header(path.stem, step)) as session:
            seen = StepPhase(judge, session).run(seen)
        count = len(select_separate_depths(seen, judge.sensor))
        return [] if count >= PLACES else [f"the step standard was seen at {count} depths, expected {PLACES}"]

    @contextmanager
    def _session(self, path: Path, positions_mm: list[float], header: CaptureHeader) -> Iterator[Session]:
        """Open camera and stage for the recording of a capture."""
        sensor = self.setting.sensor
        with self._stage(positions_mm) as stage, open_camera(self.camera) as camera:
            check_camera(camera, sensor)
            version = f"Grbl {stage.version}" if isinstance(stage, GrblStage) else "none"
            header = add_provenance(header, self.plan, camera, source="guided calibration", stage=version)
            dtype = np.dtype(np.uint16 if camera.info.bits > 8 else np.uint8)
            ahead = positions_mm[-1] - positions_mm[0] if positions_mm else 1.0
            rig = Rig(self.plan, self.plan.stage or GuidedStage(), sensor, camera, stage, ahead=ahead)
            known, before_s = read_unfinished(path) if self.resume else ({}, 0.0)
            with CaptureWriter(path, header, dtype=dtype, overwrite=self.overwrite, resume=self.resume) as writer:
                yield Session(
                    rig, self.plan, writer, self.operator, self.screen, dtype=dtype, known_ms=known, before_s=before_s
                )

    @contextmanager
    def _stage(self, positions_mm: list[float]) -> Iterator[LaserStage]:
        planned = self.plan.stage
        if planned is None or planned.port is None:
            yield HandSwitchedLaser(self.operator.wait)
            return
        with GrblStage(planned.port) as stage:
            try:
                self.screen.set_stage(stage)
                planned.check(positions_mm, stage)
                if planned.home:
                    stage.home()
                elif not stage.position_known:
                    stage.unlock()
                yield stage
            finally:
                self.screen.set_stage(None)
