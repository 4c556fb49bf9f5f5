"""Plan of a scan with real hardware: a TOML file with sensor, camera, stage, positions, lights and exposures."""

from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, field_validator

from uwlts.model.artefacts import parse_artefact
from uwlts.model.errors import DescriptionError, DesignError, RangeError
from uwlts.model.library import load_sensor, read_table, validated
from uwlts.model.placement import check_design
from uwlts.model.sensor import Description, NotNegative, Positive, Sensor, Vector
from uwlts.storage.capture import CaptureHeader
from uwlts.targets import parse_target

Light = Literal["laser", "lamp"]


class StagePlan(Description):
    """Positions of the stage in its own coordinate: ``count`` of them from ``start_mm`` in steps of ``step_mm``.

    ``direction`` is the unit direction in which growing positions move the sensor, in the OCS. ``settle_s`` is how long
    the stage rests before an image, as the sensor's description says unless given.
    """

    port: str | None = None
    start_mm: float
    step_mm: float = 1.0
    count: Annotated[int, Field(ge=1, le=100000)] = 1
    direction: Vector = (1.0, 0.0, 0.0)
    feed_mm_per_min: Positive = 300.0
    settle_s: NotNegative | None = None

    @field_validator("direction")
    @classmethod
    def _unit(cls, value: Vector) -> Vector:
        length = float(np.linalg.norm(value))
        if length < 1e-9:
            raise ValueError(f"direction {value} has no length")
        x, y, z = value
        return x / length, y / length, z / length

    def positions_mm(self) -> list[float]:
        """All positions in their order."""
        return [self.start_mm + k * self.step_mm for k in range(self.count)]


class ScanPlan(Description):
    """A scan as read from TOML.

    ``camera`` is an address for `uwlts.hardware.camera_addresses.open_camera`. At every position the images in
    ``lights`` are taken in turn: "laser" with the laser on, "lamp" with it off, under whatever other light there is.
    With ``background`` an image without laser is taken before every laser image and subtracted from it. Exposures are
    in ms, or "auto". ``laser_power`` is the share of the laser's power. With ``check_steps`` an early position is
    visited again at the end, to see whether the stage has lost steps.
    """

    title: str
    sensor: str = "thesis"
    medium: str
    camera: str | None = None
    stage: StagePlan
    lights: Annotated[tuple[Light, ...], Field(min_length=1)] = ("laser",)
    background: bool = False
    laser_ms: Positive | Literal["auto"] = "auto"
    lamp_ms: Positive | Literal["auto"] = "auto"
    gain_db: float | None = None
    laser_power: Annotated[float, Field(gt=0, le=1)] = 1.0
    check_steps: bool = True
    target: dict[str, Any] | None = None
    artefact: dict[str, Any] | None = None

    def described_sensor(self) -> Sensor:
        """The sensor of the plan; DescriptionError where it is unknown or not valid."""
        return load_sensor(self.sensor)

    def header(self, name: str, *, provenance: dict[str, Any]) -> CaptureHeader:
        """Header of the capture.

        Raises
        ------
        DescriptionError, EvaluationError
            Sensor, medium, target or artefact are not valid.
        """
        sensor = self.described_sensor()
        if self.target is not None:
            parse_target(self.target)
        if self.artefact is not None:
            parse_artefact(self.artefact)
        full = sensor.detector.full_scale_dn()
        table = {
            "name": name,
            "sensor": sensor,
            "medium_name": self.medium,
            "medium": sensor.medium(self.medium),
            "stage_direction": self.stage.direction,
            "saturation_dn": full + self.zero_dn(sensor),
            "target": self.target,
            "artefact": self.artefact,
            "provenance": provenance,
        }
        return validated(CaptureHeader, table, f"the plan '{self.title}'")

    def zero_dn(self, sensor: Sensor) -> int:
        """What stands for no difference in laser images from which a background is subtracted; 0 without one."""
        return sensor.detector.full_scale_dn() + 1 if self.background else 0


def load_plan(path: Path) -> ScanPlan:
    """Plan in a TOML file; a sensor beside it is found by its file name.

    Raises
    ------
    DescriptionError
        The file is missing, no TOML, or holds an unknown or wrong key.
    """
    return validated(ScanPlan, plan_table(path, wanted="sensor, medium and stage (docs/how-to/scan.md)"), path)


def plan_table(path: Path, *, wanted: str) -> dict[str, Any]:
    """A plan's TOML with the path of a sensor that lies beside it; DescriptionError where it is missing or no TOML."""
    if not path.is_file():
        raise DescriptionError(f"no plan at {path}: write one that gives {wanted}")
    table = read_table(path)
    beside = path.parent / str(table.get("sensor", ""))
    if beside.suffix == ".toml" and beside.is_file():
        table["sensor"] = str(beside)
    return table


def check_plan(plan: ScanPlan, *, limits_mm: tuple[float, float], fastest_mm_per_min: float) -> None:
    """Refuse a plan that the stage or the sensor cannot do, before anything moves.

    Raises
    ------
    RangeError
        A position lies outside the travel, or the feed is too high.
    DesignError
        The sensor cannot work in the medium.
    """
    positions, (low, high) = plan.stage.positions_mm(), limits_mm
    if not (low <= min(positions) and max(positions) <= high):
        raise RangeError(
            f"the plan moves from {min(positions):g} to {max(positions):g} mm, the stage from {low:g} to {high:g} mm: "
            "change start_mm, step_mm or count"
        )
    if plan.stage.feed_mm_per_min > fastest_mm_per_min:
        raise RangeError(
            f"feed_mm_per_min is {plan.stage.feed_mm_per_min:g}, the stage does at most {fastest_mm_per_min:g}"
        )
    sensor = plan.described_sensor()
    try:
        check_design(sensor, sensor.medium(plan.medium))
    except DesignError as error:
        raise DesignError(f"the sensor '{sensor.name}' cannot work in {plan.medium}: {error}") from error
