"""Plan of a guided calibration: a TOML file with sensor, camera, stage, target, step and goals."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field, model_validator

from uwlts.calibration.camera.target_poses import Poses
from uwlts.calibration.guidance import CompletionLimits, RecordedPose, Setting, remove_window
from uwlts.errors import DescriptionError
from uwlts.hardware.scan_plan import Direction, RigPlan, StageSettings, Table, read_plan_table
from uwlts.model.artefacts import StepStandard
from uwlts.model.library import validate_description
from uwlts.model.sensor import NotNegative
from uwlts.storage.capture import CaptureHeader
from uwlts.targets import parse_target

_SAME_POSITION_MM = 0.02  # above the stage's repeatability, below any step of a plan


class GuidedStage(StageSettings):
    """The stage, which also switches the laser; for free poses it does not move.

    The target is shown at ``positions_mm``, or at ``count`` positions from ``first_mm`` to ``last_mm``. Positions are
    in the stage's own coordinate. With ``home`` the stage is homed first; otherwise the controller's position is
    accepted.
    """

    positions_mm: tuple[float, ...] = ()
    first_mm: float | None = None
    last_mm: float | None = None
    count: Annotated[int, Field(ge=2, le=1000)] = 12
    direction: Direction = (0.0, 0.0, 1.0)
    home: bool = False

    @model_validator(mode="after")
    def _check_exclusive(self) -> "GuidedStage":
        ends = self.first_mm is not None, self.last_mm is not None
        if any(ends) != all(ends) or (self.positions_mm and any(ends)):
            raise ValueError("give either positions_mm, or first_mm and last_mm with count")
        return self

    def places_mm(self) -> list[float]:
        """Return all positions in order; empty if none are given."""
        if self.first_mm is None or self.last_mm is None:
            return list(self.positions_mm)
        return np.linspace(self.first_mm, self.last_mm, self.count).tolist()


class GuidedStep(StepStandard):
    """The step standard in the medium of use, shown near, in the middle and far, each time at ``positions_mm``.

    Without positions the stage does not move.
    """

    medium: str
    positions_mm: tuple[float, ...] = ()
    direction: Direction = (1.0, 0.0, 0.0)


class GuidedPlan(RigPlan):
    """A guided calibration as read from TOML.

    The target stands in ``medium``. ``window_mounted``: the camera looks through its window, which is the default in
    all media but air. ``poses`` are those of `solve_camera`. A free pose is taken once the target has stood still for
    ``still_s``.
    """

    medium: str = "air"
    window_mounted: bool | None = None
    poses: Poses = "free"
    target: Table
    stage: GuidedStage | None = None
    step: GuidedStep | None = None
    wanted: CompletionLimits = CompletionLimits()
    most_images: Annotated[int, Field(ge=3)] = 40
    still_s: NotNegative = 0.8

    @model_validator(mode="after")
    def _check_positions(self) -> "GuidedPlan":
        if self.poses != "free" and (self.stage is None or len(self.stage.places_mm()) < 2):
            raise ValueError(
                f"poses '{self.poses}' need a [stage] with two positions or more: positions_mm, or first_mm and last_mm"
            )
        return self

    def goal(self) -> CompletionLimits:
        """Return the goals, with at most as many images as the stage has positions."""
        if self.poses == "free" or self.stage is None:
            return self.wanted
        fewest = min(self.wanted.fewest_images, len(self.stage.places_mm()))
        return self.wanted.model_copy(update={"fewest_images": fewest})

    def places_left(self, recorded: Sequence[RecordedPose]) -> list[float]:
        """Return the stage positions that are not yet recorded; empty for free poses."""
        if self.poses == "free" or self.stage is None:
            return []
        done = np.array([pose.stage_mm for pose in recorded])
        return [place for place in self.stage.places_mm() if not (np.abs(done - place) <= _SAME_POSITION_MM).any()]

    def with_connection(self, *, camera: str | None, port: str | None) -> "GuidedPlan":
        """Return the plan with another camera address or stage port, if given."""
        stage = self.stage if port is None else (self.stage or GuidedStage()).model_copy(update={"port": port})
        return self.model_copy(update={"camera": camera or self.camera, "stage": stage})

    def camera_address(self) -> str:
        """Return the camera's address; raises DescriptionError if it, or the port of a planned stage, is missing."""
        if self.camera is None:
            raise DescriptionError("the plan names no camera: add `camera`, or give the address under Connect")
        if self.stage is not None and self.stage.port is None:
            raise DescriptionError(
                "the plan names no serial port of the stage: add `port`, or give the address under Connect"
            )
        return self.camera

    def target_in_air(self) -> bool:
        """Return whether the target stands in air; raises DescriptionError if the sensor has no such medium."""
        return self.described_sensor().medium(self.medium).kind == "air"

    def setting(self) -> Setting:
        """Return the plan as a setting; raises DescriptionError if sensor, medium or target are not valid."""
        sensor = self.described_sensor()
        medium = sensor.medium(self.medium)
        mounted = medium.kind != "air" if self.window_mounted is None else self.window_mounted
        return Setting(
            sensor=sensor if mounted else remove_window(sensor),
            target=parse_target(self.target),
            medium=medium,
            poses=self.poses,
            approaching=self.stage is None or self.stage.direction[2] > 0,
        )

    def target_header(self, name: str) -> CaptureHeader:
        """Return the header of the target's capture; raises the errors of `setting`."""
        sensor, direction = self.setting().sensor, (self.stage or GuidedStage()).direction
        return self.capture_header(name, sensor, medium=self.medium, direction=direction, target=self.target)

    def step_header(self, name: str, step: GuidedStep) -> CaptureHeader:
        """Return the header of the standard's capture; raises DescriptionError if sensor or medium are not valid."""
        artefact = step.model_dump(include=set(StepStandard.model_fields), exclude_none=True)
        return self.capture_header(
            name, self.described_sensor(), medium=step.medium, direction=step.direction, artefact=artefact
        )


def load_guided_plan(path: Path) -> GuidedPlan:
    """Read a plan from a TOML file, which may name a sensor file in its own folder.

    Raises DescriptionError if the file is missing, is not TOML, or has an unknown or wrong key, or if sensor, medium or
    target are not valid.
    """
    plan = validate_description(
        GuidedPlan, read_plan_table(path, wanted="sensor and target (docs/how-to/calibrate-live.md)"), path
    )
    plan.setting()
    if plan.step is not None:
        plan.described_sensor().medium(plan.step.medium)
        if not plan.target_in_air():
            raise DescriptionError(
                f"{path}: the target stands in {plan.medium} and a [step] is planned; a target there determines the "
                "window's distance itself: leave out [step], or set medium to air"
            )
    return plan
