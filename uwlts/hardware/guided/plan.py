"""Plan of a guided calibration: a TOML file with sensor, camera, stage, target, step and goals."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, model_validator

from uwlts.calibration.camera.target_poses import Poses
from uwlts.calibration.guidance.pose_advice import RecordedPose, Setting, Wanted, without_window
from uwlts.errors import DescriptionError
from uwlts.hardware.scan_plan import Direction, RigPlan, StageSettings, Table, plan_table
from uwlts.model.artefacts import StepStandard
from uwlts.model.library import validated
from uwlts.model.sensor import Description, NotNegative, Positive
from uwlts.storage.capture import CaptureHeader
from uwlts.targets import parse_target

_SAME_POSITION_MM = 0.02


class GuidedStage(StageSettings):
    """The stage, which also switches the laser; for free poses it stands still.

    The target is shown at ``positions_mm``, or at ``count`` positions from ``first_mm`` to ``last_mm``, in the stage's
    own coordinate. ``home`` finds the limit switch first; without it the position that the controller counts is taken
    as it is.
    """

    positions_mm: tuple[float, ...] = ()
    first_mm: float | None = None
    last_mm: float | None = None
    count: Annotated[int, Field(ge=2, le=1000)] = 12
    direction: Direction = (0.0, 0.0, 1.0)
    home: bool = False

    @model_validator(mode="after")
    def _one_way_to_give_them(self) -> "GuidedStage":
        ends = self.first_mm is not None, self.last_mm is not None
        if any(ends) != all(ends) or (self.positions_mm and any(ends)):
            raise ValueError("give positions_mm, or first_mm and last_mm with count, not parts of both")
        return self

    def places_mm(self) -> list[float]:
        """All positions in their order; empty where none are given."""
        if self.first_mm is None or self.last_mm is None:
            return list(self.positions_mm)
        return np.linspace(self.first_mm, self.last_mm, self.count).tolist()


class GuidedStep(Description):
    """The step standard in the medium of use: put up near, in the middle and far, each time seen at ``positions_mm``.

    Without positions the stage stands still. ``height_mm`` and the others are as `StepStandard` has them.
    """

    medium: str
    height_mm: Positive
    height_uncertainty_mm: NotNegative | None = None
    reference: Literal["lower", "upper"] = "lower"
    edge_mm: NotNegative = 1.0
    positions_mm: tuple[float, ...] = ()
    direction: Direction = (1.0, 0.0, 0.0)

    def standard(self) -> StepStandard:
        """The artefact."""
        return StepStandard.model_validate(self.model_dump(include=set(StepStandard.model_fields)))


class WantedPlan(Description):
    """When the target images are enough; tilts in deg."""

    focal_std_px: Positive = 0.5
    centre_std_px: Positive = 0.5
    coverage: Annotated[float, Field(gt=0, le=1)] = 0.85
    tilt_deg: NotNegative = 12.0
    fewest_images: Annotated[int, Field(ge=3)] = 8

    def wanted(self) -> Wanted:
        """The same in rad."""
        return Wanted(**self.model_dump(exclude={"tilt_deg"}), tilt_rad=float(np.radians(self.tilt_deg)))


class GuidedPlan(RigPlan):
    """A guided calibration as read from TOML.

    The target stands in ``medium``; ``window_mounted``: whether the camera sees it through its window, as it does
    in any medium but air. ``poses`` are as for `solve_camera`. A free pose is taken once the target has stood still for
    ``still_s``.
    """

    medium: str = "air"
    window_mounted: bool | None = None
    poses: Poses = "free"
    target: Table
    stage: GuidedStage | None = None
    step: GuidedStep | None = None
    wanted: WantedPlan = WantedPlan()
    most_images: Annotated[int, Field(ge=3)] = 40
    still_s: NotNegative = 0.8

    @model_validator(mode="after")
    def _stage_for_its_poses(self) -> "GuidedPlan":
        if self.poses != "free" and (self.stage is None or len(self.stage.places_mm()) < 2):
            raise ValueError(
                f"poses '{self.poses}' need a [stage] with two positions or more: positions_mm, or first_mm and last_mm"
            )
        return self

    def goal(self) -> Wanted:
        """When the target images are enough; no more of them than there are positions of the stage."""
        wanted = self.wanted.wanted()
        if self.poses == "free" or self.stage is None:
            return wanted
        return replace(wanted, fewest_images=min(wanted.fewest_images, len(self.stage.places_mm())))

    def places_left(self, recorded: Sequence[RecordedPose]) -> list[float]:
        """Stage positions that are not recorded yet; none for free poses."""
        if self.poses == "free" or self.stage is None:
            return []
        done = np.array([pose.stage_mm for pose in recorded])
        return [place for place in self.stage.places_mm() if not (np.abs(done - place) <= _SAME_POSITION_MM).any()]

    def connected(self, *, camera: str | None, port: str | None) -> "GuidedPlan":
        """The plan with another address of the camera, or another port of the stage, if these are given."""
        stage = self.stage if port is None else (self.stage or GuidedStage()).model_copy(update={"port": port})
        return self.model_copy(update={"camera": camera or self.camera, "stage": stage})

    def camera_address(self) -> str:
        """The camera's address; DescriptionError where that, or the port of a planned stage, is not given."""
        if self.camera is None:
            raise DescriptionError("the plan names no camera: give `camera`")
        if self.stage is not None and self.stage.port is None:
            raise DescriptionError("the plan names no serial port of the stage: give `stage`")
        return self.camera

    def target_in_air(self) -> bool:
        """Whether the target stands in air; DescriptionError where the sensor does not know the medium."""
        return self.described_sensor().medium(self.medium).kind == "air"

    def setting(self) -> Setting:
        """The plan as a setting; DescriptionError if sensor, medium or target are not valid."""
        sensor = self.described_sensor()
        medium = sensor.medium(self.medium)
        mounted = medium.kind != "air" if self.window_mounted is None else self.window_mounted
        return Setting(
            sensor=sensor if mounted else without_window(sensor),
            target=parse_target(self.target),
            medium=medium,
            poses=self.poses,
            approaching=self.stage is None or self.stage.direction[2] > 0,
        )

    def target_header(self, name: str) -> CaptureHeader:
        """Header of the capture of the target; errors as `setting`."""
        sensor, direction = self.setting().sensor, (self.stage or GuidedStage()).direction
        return self.capture_header(name, sensor, medium=self.medium, direction=direction, target=self.target)

    def step_header(self, name: str, step: GuidedStep) -> CaptureHeader:
        """Header of the capture of the step standard; DescriptionError where sensor or medium are not valid."""
        artefact = step.standard().model_dump(exclude_none=True)
        return self.capture_header(
            name, self.described_sensor(), medium=step.medium, direction=step.direction, artefact=artefact
        )


def load_guided_plan(path: Path) -> GuidedPlan:
    """Plan in a TOML file; a sensor beside it is found by its file name.

    DescriptionError where the file is missing, no TOML, or holds an unknown or wrong key, or where sensor, medium or
    target are not valid.
    """
    plan = validated(GuidedPlan, plan_table(path, wanted="sensor and target (docs/how-to/calibrate-live.md)"), path)
    plan.setting()
    if plan.step is not None:
        plan.described_sensor().medium(plan.step.medium)
        if not plan.target_in_air():
            raise DescriptionError(
                f"{path}: the target stands in {plan.medium} and a [step] is planned; a target there determines the "
                "window's distance itself: leave out [step], or set medium to air"
            )
    return plan
