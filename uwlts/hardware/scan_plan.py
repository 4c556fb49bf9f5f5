"""Plan of a scan with real hardware (a TOML file), and the parts it shares with the plan of a guided calibration."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import AfterValidator, Field, model_validator

from uwlts.errors import DescriptionError, DesignError, RangeError
from uwlts.files.reading import is_regular_file
from uwlts.hardware.grbl import GrblStage
from uwlts.model.artefacts import parse_artefact
from uwlts.model.library import load_sensor, read_table, validate_description
from uwlts.model.placement import check_design
from uwlts.model.sensor import Bracket, Description, NotNegative, Positive, Sensor, Table, Vector
from uwlts.storage.capture import CaptureHeader
from uwlts.targets import parse_target

Light = Literal["laser", "lamp"]


def _normalise(value: Vector) -> Vector:
    length = float(np.linalg.norm(value))
    if length < 1e-9:
        raise ValueError(f"direction {value} has no length")
    x, y, z = value
    return x / length, y / length, z / length


Direction = Annotated[Vector, AfterValidator(_normalise)]  # vector normalised to a unit vector


class StageSettings(Description):
    """A stage and its motion.

    ``direction`` is the sensor's motion for growing positions, a unit vector in the OCS. ``settle_s`` is the rest
    before an image, by default that of the sensor's description.
    """

    port: str | None = None
    direction: Direction = (1.0, 0.0, 0.0)
    feed_mm_per_min: Positive = 300.0
    settle_s: NotNegative | None = None

    def check(self, positions_mm: Sequence[float], stage: GrblStage) -> None:
        """Raise RangeError if a position is outside the travel, or the feed is too high; nothing moves."""
        low, high = stage.limits_mm
        first, last = min(positions_mm, default=low), max(positions_mm, default=low)
        if not low <= first <= last <= high:
            raise RangeError(
                f"the plan goes from {first:g} to {last:g} mm, the stage moves from {low:g} to {high:g} mm: change the "
                "plan's positions"
            )
        fastest = stage.settings.max_feed_mm_per_min
        if self.feed_mm_per_min > fastest:
            raise RangeError(f"feed_mm_per_min is {self.feed_mm_per_min:g}, the stage does at most {fastest:g}")


class RigPlan(Description):
    """Camera, lights and laser of a plan.

    ``camera`` is an address for `uwlts.hardware.scanning.open_camera`. Exposures are in ms, or "auto".
    ``laser_power`` is a fraction of the full power.
    """

    title: str
    sensor: str = "thesis"
    camera: str | None = None
    laser_ms: Positive | Literal["auto"] = "auto"
    lamp_ms: Positive | Literal["auto"] = "auto"
    gain_db: float | None = None
    laser_power: Annotated[float, Field(gt=0, le=1)] = 1.0

    def described_sensor(self) -> Sensor:
        """Return the plan's sensor with its window; raises DescriptionError if it is unknown or not valid."""
        return load_sensor(self.sensor)

    def planned_ms(self) -> dict[Light, float]:
        """Return the given exposures in ms by light."""
        exposures: tuple[tuple[Light, float | str], ...] = ("laser", self.laser_ms), ("lamp", self.lamp_ms)
        return {light: ms for light, ms in exposures if not isinstance(ms, str)}

    def capture_header(
        self, name: str, sensor: Sensor, *, medium: str, direction: Vector, zero_dn: int = 0, **shown: Table | None
    ) -> CaptureHeader:
        """Return the header of a capture.

        ``direction`` is the unit vector of the stage's motion in the OCS. ``zero_dn`` is the grey value of zero
        difference in images with a subtracted background. ``shown`` describes the ``target`` or ``artefact``.

        Raises DescriptionError if target or artefact is not valid.
        """
        table = {
            "name": name,
            "sensor": sensor,
            "medium_name": medium,
            "medium": sensor.medium(medium),
            "stage_direction": direction,
            "saturation_dn": sensor.detector.full_scale_dn() + zero_dn,
        }
        return validate_description(CaptureHeader, table | shown, f"the plan '{self.title}'")


class StagePlan(StageSettings):
    """Positions of the stage in its own coordinate: ``count`` positions from ``start_mm`` in steps of ``step_mm``."""

    start_mm: float
    step_mm: float = 1.0
    count: Annotated[int, Field(ge=1, le=100000)] = 1

    def positions_mm(self) -> list[float]:
        """Return all positions in order."""
        return [self.start_mm + k * self.step_mm for k in range(self.count)]


class Continuous(Description):
    """A scan without stops: the stage travels at a constant speed, and the camera takes one frame per step.

    With ``both_ways`` the stage also travels back, which measures the latency between camera and stage. Alternatively
    ``latency_ms`` gives the age of the stage's positions relative to the frames. ``mm_per_count`` assigns positions by
    an encoder that is wired to the camera and sent with the frames (GenICam's ChunkEncoderValue), a counter of
    ``encoder_bits`` (`uwlts.storage.numbering`).
    """

    speed_mm_per_s: Positive
    both_ways: bool = True
    latency_ms: float | None = None
    mm_per_count: float | None = None
    encoder_bits: Annotated[int, Field(ge=8, le=52)] | None = None


class ScanPlan(RigPlan):
    """A scan as read from TOML.

    At every position the images in ``lights`` are taken in turn: "laser" with the laser on, "lamp" with the laser off
    in the ambient light. With ``background`` an image without laser is taken before every laser image and subtracted
    from it. Laser images are taken at every multiple of their exposure in ``bracket``, and fused into one that shows
    bright and dark surfaces (`uwlts.stripe.exposures`). With ``check_steps`` an early position is revisited at the end,
    to detect lost steps. With ``continuous`` the stage does not stop.
    """

    medium: str
    stage: StagePlan
    lights: Annotated[tuple[Light, ...], Field(min_length=1)] = ("laser",)
    background: bool = False
    bracket: Bracket = (1.0,)
    check_steps: bool = True
    target: Table | None = None
    artefact: Table | None = None
    continuous: Continuous | None = None

    @model_validator(mode="after")
    def _check_light(self) -> "ScanPlan":
        if self.continuous is not None and (self.images() != [("laser", 1.0)] or self.background):
            raise ValueError(
                "a continuous scan takes one laser image per step and no others: leave out lamp, bracket and background"
            )
        return self

    def devices(self, *, camera: str | None, stage: str | None) -> tuple[str, str]:
        """Return the addresses of camera and stage, given or planned; raises DescriptionError if one is missing."""
        address, port = camera or self.camera, stage or self.stage.port
        if address is None or port is None:
            what = "camera" if address is None else "stage"
            raise DescriptionError(f"the plan names no {what}: give `{what}`")
        return address, port

    def images(self) -> list[tuple[Light, float]]:
        """Return the light, and the multiple of its exposure, of each image at a position."""
        return [(light, each) for light in self.lights for each in (self.bracket if light == "laser" else (1.0,))]

    def header(self, name: str) -> CaptureHeader:
        """Return the capture's header; raises DescriptionError or EvaluationError if the plan is not valid."""
        sensor = self.described_sensor()
        if self.target is not None:
            parse_target(self.target)
        if self.artefact is not None:
            parse_artefact(self.artefact)
        return self.capture_header(
            name,
            sensor,
            medium=self.medium,
            direction=self.stage.direction,
            zero_dn=self.zero_dn(sensor),
            target=self.target,
            artefact=self.artefact,
        )

    def make_record(self) -> Table:
        """Return the part of the plan that determines the images, as JSON, without addresses and motion settings."""
        table = self.model_dump(mode="json", exclude={"title", "sensor", "camera", "check_steps"})
        for key in ("port", "feed_mm_per_min", "settle_s"):
            del table["stage"][key]
        return table

    def zero_dn(self, sensor: Sensor) -> int:
        """Return the grey value of zero difference in laser images with a subtracted background; 0 without one."""
        return sensor.detector.full_scale_dn() + 1 if self.background else 0

    def check(self, stage: GrblStage) -> None:
        """Check that stage and sensor can do what is planned; nothing moves.

        Raises RangeError if a position is outside the travel or the feed is too high, and DesignError if the sensor
        cannot work in the medium.
        """
        self.stage.check(self.stage.positions_mm(), stage)
        sensor = self.described_sensor()
        try:
            check_design(sensor, sensor.medium(self.medium))
        except DesignError as error:
            raise DesignError(f"the sensor '{sensor.name}' cannot work in {self.medium}: {error}") from error


def load_plan(path: Path) -> ScanPlan:
    """Read a plan from a TOML file, which may name a sensor file in its own folder.

    Raises DescriptionError if the file is missing, is not TOML, or has an unknown or wrong key.
    """
    return validate_description(
        ScanPlan, read_plan_table(path, wanted="sensor, medium and stage (docs/how-to/scan.md)"), path
    )


def read_plan_table(path: Path, *, wanted: str) -> Table:
    """Read a plan's TOML and resolve the path of a sensor file beside it; raises DescriptionError if it cannot."""
    if not is_regular_file(path):
        raise DescriptionError(f"no plan at {path}: write one that gives {wanted}")
    table = read_table(path)
    beside = path.parent / str(table.get("sensor", ""))
    if beside.suffix == ".toml" and is_regular_file(beside):
        table["sensor"] = str(beside)
    return table
