"""The mount of a laser profiler on a moving platform, as `uwlts.calibrate_mount` finds it and `mount.json` holds it."""

from pathlib import Path
from typing import Annotated, Literal, assert_never

import numpy as np
from pydantic import Field, model_validator

from uwlts.files.json_files import write_model
from uwlts.model.brief import Brief
from uwlts.model.calibration import is_rigid
from uwlts.model.sensor import Description, NotNegative, Positive, Vector

FORMAT, VERSION = "uwlts-mount", 1

Rows = tuple[tuple[float, ...], ...]


class MountPose(Description):
    """One pose of the platform and what its profile or image says.

    ``rms_mm`` is the root mean square distance of its points from the artefact (of a target's middle from its common
    place), ``held_out_mm`` the same where the mount was calculated without this pose. A pose that was not used has a
    ``reason``.
    """

    name: str
    points: Annotated[int, Field(ge=0)]
    points_left_out: Annotated[int, Field(ge=0)]
    rms_mm: NotNegative | None = None
    held_out_mm: NotNegative | None = None
    reason: str | None = None


class NextPose(Description):
    """The candidate pose that would lower the uncertainty most, in words and as ``T_base_platform``.

    ``before_mm`` and ``after_mm`` are the standard uncertainty of a point in the middle of the field of view.
    """

    words: str
    T_base_platform: Rows
    before_mm: NotNegative
    after_mm: NotNegative


class SphereFound(Description):
    """The sphere: centre in the base frame, and its radius, given or found."""

    kind: Literal["sphere"] = "sphere"
    centre_mm: Vector
    radius_mm: Positive
    radius_std_mm: NotNegative | None = None


class PlaneFound(Description):
    """The plane: the points p of the base frame with normal . p = distance_mm."""

    kind: Literal["plane"] = "plane"
    normal: Vector
    distance_mm: float


class StepFound(Description):
    """The step: its face at smaller z of the profiles as `PlaneFound`, and how far along the normal the other lies."""

    kind: Literal["step"] = "step"
    normal: Vector
    distance_mm: float
    height_mm: float
    height_std_mm: NotNegative | None = None


class RingFound(Description):
    """The ring: axis of its cylinder, centre and radius of the circle in which that meets the plane of the face."""

    kind: Literal["ring"] = "ring"
    axis: Vector
    centre_mm: Vector
    radius_mm: Positive
    radius_std_mm: NotNegative | None = None


class BoardFound(Description):
    """The target: ``T_base_target`` (4, 4), mm."""

    kind: Literal["board"] = "board"
    T_base_target: Rows


class SensorShare(Description):
    """What a mount has in common with the points of the sensor with whose calibration it was found.

    ``calibration`` is that calibration's digest. ``by_parameters`` (6, P) are the derivatives of the mount, ordered as
    `Mount.covariance`, by the parameters of its joint estimate, for the sensor's frame as the calibration's file places
    it beside the camera. ``covariance_apart`` (6, 6) is the mount's covariance by all else.
    """

    calibration: str
    by_parameters: Rows
    covariance_apart: Rows


class Mount(Brief, Description):
    """Transform from the sensor to the platform that carries it, with its uncertainty and the evidence.

    ``T_platform_sensor`` (4, 4) maps points of the sensor's frame (x and z of the profiles, y = z x x across the sheet)
    to the frame of the platform (a robot's flange), mm. ``covariance`` (6, 6) is of the translation (mm), then of a
    further rotation (rad) about the platform's axes, R_true = exp(rotation) R. ``coverage_factor`` times a standard
    uncertainty is half of the 95 % interval (Student's t). ``point_std_mm`` is the noise of a point of a profile,
    ``pose_std_mm`` that of the platform's position for each coordinate; both are estimated from the profiles.
    On a rotary table (``table``) the platform's z axis is the table's; shift along it and turn about it are chosen, and
    have no variance. ``sensor`` says which part of the covariance the calibration of the sensor makes, where that is
    known by a joint estimate; else the profiles count as exact but for their noise. ``inputs`` holds the SHA-256 of
    every file that was read.
    """

    T_platform_sensor: Rows
    covariance: Rows
    coverage_factor: Positive
    artefact: Annotated[SphereFound | PlaneFound | StepFound | RingFound | BoardFound, Field(discriminator="kind")]
    robot_scale: Positive | None = None
    robot_scale_std: NotNegative | None = None
    time_offset_s: float | None = None
    time_offset_std_s: NotNegative | None = None
    point_std_mm: NotNegative
    pose_std_mm: NotNegative
    rms_mm: NotNegative
    held_out_rms_mm: NotNegative
    table: bool = False
    sensor: SensorShare | None = None
    poses: tuple[MountPose, ...]
    weaknesses: tuple[str, ...] = ()
    next_pose: NextPose | None = None
    inputs: dict[str, str] = {}

    @model_validator(mode="after")
    def _consistent(self) -> "Mount":
        if [*map(len, self.T_platform_sensor)] != [4] * 4 or not is_rigid(self.transform(), within=1e-6):
            raise ValueError("T_platform_sensor must be a rigid 4x4 matrix")
        if [*map(len, self.covariance)] != [6] * 6:
            raise ValueError("covariance must be a symmetric 6x6 matrix")
        covariance = np.array(self.covariance)
        if np.abs(covariance - covariance.T).max() > 1e-9 * np.abs(covariance).max():
            raise ValueError("covariance must be a symmetric 6x6 matrix")
        if self.sensor is not None:
            by, apart = self.sensor.by_parameters, self.sensor.covariance_apart
            if len(by) != 6 or len({*map(len, by)}) != 1 or [*map(len, apart)] != [6] * 6:
                raise ValueError("sensor must have by_parameters (6, P) and covariance_apart (6, 6)")
        if not np.all(np.delete(np.diag(covariance), (2, 5) if self.table else ()) > 0):
            raise ValueError("covariance must have positive variances")
        return self

    def save(self, path: str | Path, *, overwrite: bool = False) -> None:
        """Write the mount as JSON, whole or not at all; OutputError if that fails."""
        write_model(path, self, format=FORMAT, version=VERSION, overwrite=overwrite)

    def transform(self) -> np.ndarray:
        """``T_platform_sensor`` as an array (4, 4), mm."""
        return np.array(self.T_platform_sensor)

    def std(self) -> np.ndarray:
        """Standard uncertainties (6,): translation, mm, and rotation about the platform's axes, rad."""
        return np.sqrt(np.diag(np.array(self.covariance)))

    def size_mm(self) -> float:
        """Radius or height of the artefact; 0 of one without a size."""
        match self.artefact:
            case SphereFound() | RingFound():
                return self.artefact.radius_mm
            case StepFound():
                return abs(self.artefact.height_mm)
            case PlaneFound() | BoardFound():
                return 0.0
            case _:
                assert_never(self.artefact)

    def apart_from(self, calibration: str) -> tuple[np.ndarray, np.ndarray | None]:
        """Covariance (6, 6) that is independent of points by a calibration of the sensor, given by its digest.

        Where the mount was found with that calibration, there are also the mount's derivatives (6, P) by the parameters
        of its joint estimate.
        """
        if self.sensor is None or self.sensor.calibration != calibration:
            return np.array(self.covariance), None
        return np.array(self.sensor.covariance_apart), np.array(self.sensor.by_parameters)
