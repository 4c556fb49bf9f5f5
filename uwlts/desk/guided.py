"""Guided calibration: leads through poses of the target and of the step standard, and records accepted images.

The captures are ordinary ones, so that the calibration can be repeated. However the recording ends, accepted images
are kept and the laser goes off.
"""

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from nicegui import ui

from uwlts.calibration.camera.target_poses import Poses
from uwlts.calibration.guidance import PLACES, Setting, State, next_depth_mm, select_separate_depths
from uwlts.calibration.sequential.sequential_calibration import CalibrationOptions, calibrate_sequentially
from uwlts.desk.guided_phases import Session, StepPhase, TargetPhase, list_missing
from uwlts.desk.guided_plan import GuidedPlan, GuidedStage
from uwlts.desk.guided_screen import ANSWERS, BoardScreen
from uwlts.desk.shown_state import Board
from uwlts.hardware.grbl import GrblStage
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


def guide(plan: GuidedPlan, out: Path, screen: BoardScreen, *, resume: bool, overwrite: bool) -> GuidedRecording:
    """Lead through the images of a calibration on a screen, and record accepted images in captures beside it.

    The captures have the name ``out`` of the calibration with ``-target.h5`` and ``-step.h5``. ``resume`` continues
    an earlier recording, also a finished capture that does not suffice. ``overwrite`` replaces captures otherwise.

    Raises
    ------
    DescriptionError, RangeError
        The plan cannot be carried out; nothing has moved.
    HardwareError
        Camera, stage or laser fail.
    CalibrationError
        The target does not determine a calibration to judge the step standard.
    OutputError
        A capture exists, or cannot be written.
    """
    phases = _Phases(plan, plan.setting(), plan.camera_address(), screen, resume, overwrite and not resume)
    target, step = (out.with_name(f"{out.stem}-{shown}.h5") for shown in ("target", "step"))
    missing = list_missing(phases.target(target))
    if plan.step is not None:
        with Capture(target) as capture:
            known = calibrate_sequentially([capture], (), options=CalibrationOptions(poses=plan.poses)).calibration
        sensor = plan.described_sensor()
        window = WindowModel.from_description(sensor.camera.window, sensor.laser.wavelength_nm, refractions=2)
        missing += phases.step(step, StepPhase(plan.step, sensor, known, window))
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
    screen: BoardScreen
    resume: bool
    overwrite: bool

    def _find_unfinished(self, path: Path) -> Path | None:
        """Return the recording to continue: an interrupted one, or a finished one that may not suffice."""
        return next((each for each in (part_path(path), path) if each.is_file()), None) if self.resume else None

    def target(self, path: Path) -> State:
        """Record the target, and return the final state."""
        plan = self.plan
        phase, left = TargetPhase(plan, self.setting), self._find_unfinished(path)
        state = phase.state([] if left is None else phase.read_recorded(left))
        if left == path:
            if plan.poses == "free":
                more = bool(list_missing(state)) and len(state.recorded) < plan.most_images
            else:
                more = bool(plan.places_left(state.recorded))
            if not more:
                self.screen.say(f"{path.name} is complete: {len(state.recorded)} poses")
                return state
            os.replace(path, part_path(path))
        positions = plan.places_left([])
        with self._session(path, positions, plan.target_header(path.stem)) as session:
            return phase.run(session, state)

    def step(self, path: Path, phase: StepPhase) -> list[str]:
        """Record the step standard, and return the missing evidence."""
        step, left = phase.step, self._find_unfinished(path)
        seen = [] if left is None else phase.depths_mm(left)
        if left == path:
            if next_depth_mm(seen, phase.sensor) is None:
                self.screen.say(f"{path.name} is complete")
                return []
            os.replace(path, part_path(path))
        request = f"bring the sensor into {step.medium}, with its window, and the step standard before it"
        self.screen.request(request)
        self.screen.wait(request)
        with self._session(path, list(step.positions_mm), self.plan.step_header(path.stem, step)) as session:
            seen = phase.run(session, seen)
        count = len(select_separate_depths(seen, phase.sensor))
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
                yield Session(rig, self.plan, writer, self.screen, dtype=dtype, known_ms=known, before_s=before_s)

    @contextmanager
    def _stage(self, positions_mm: list[float]) -> Iterator[LaserStage]:
        planned = self.plan.stage
        if planned is None or planned.port is None:
            yield HandSwitchedLaser(self.screen.wait)
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


def answer_buttons(board: Board, press: Callable[[str], None]) -> Callable[[], None]:
    """Build the request to the operator with a button for each answer; return a function that updates it."""
    with ui.column().classes("p-3 gap-2") as asked:
        request = ui.label().classes("text-lg font-bold").props('role="status" aria-live="polite"')
        with ui.row():
            for answer in ANSWERS:
                ui.button(answer, on_click=partial(press, answer))
        ui.label("take: record it as it is; skip: ask for another pose; done: continue with what is recorded").classes(
            "text-xs"
        )

    def refresh() -> None:
        request.set_text(board.request)
        asked.set_visibility(bool(board.request))

    return refresh
