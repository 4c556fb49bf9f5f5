"""Mount of a laser profiler on a moving platform: the result of `uwlts.calibrate_mount`, stored in `mount.json`."""

from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, model_validator

from uwlts.argument_types import check_arguments
from uwlts.files.json_files import write_model
from uwlts.model.sensor import Description, NotNegative, Positive, RigidTransform, Rows, Vector
from uwlts.model.short_text import Brief

FORMAT, VERSION = "uwlts-mount", 1


class MountPose(Description):
    """Pose of the platform and residuals of its profile or image.

    ``rms_mm`` is the root mean square distance of its points from the artefact; for a target, the distance of its
    centre from the common position. ``held_out_mm`` is the same for a mount that was calculated without this pose. A
    rejected pose has a ``reason``.
    """

    name: str
    points: Annotated[int, Field(ge=0)]
    points_left_out: Annotated[int, Field(ge=0)]
    rms_mm: NotNegative | None = None
    held_out_mm: NotNegative | None = None
    reason: str | None = None


class NextPose(Description):
    """Candidate pose that would reduce the uncertainty most, as a text and as ``T_base_platform``.

    ``before_mm`` and ``after_mm`` are the standard uncertainties of a point in the middle of the field of view.
    """

    words: str
    T_base_platform: Rows
    before_mm: NotNegative
    after_mm: NotNegative


class SphereFound(Description):
    """Estimated sphere: centre in the base frame, and radius, given or estimated."""

    kind: Literal["sphere"] = "sphere"
    centre_mm: Vector
    radius_mm: Positive
    radius_std_mm: NotNegative | None = None


class PlaneFound(Description):
    """Estimated plane: points p in the base frame with normal . p = distance_mm."""

    kind: Literal["plane"] = "plane"
    normal: Vector
    distance_mm: float


class BoardFound(Description):
    """Estimated target: ``T_base_target`` (4, 4), mm."""

    kind: Literal["board"] = "board"
    T_base_target: Rows


class SensorShare(Description):
    """Correlation of a mount with the points of the sensor, through the calibration of the sensor.

    ``calibration`` is the digest of the calibration. ``by_parameters`` (6, P) are the derivatives of the mount, ordered
    as in `Mount.covariance`, with respect to the parameters of the calibration's joint estimate. They apply to the
    sensor's frame that the calibration's file defines relative to the camera. ``covariance_apart`` (6, 6) is the
    mount's covariance from all other sources.
    """

    calibration: str
    by_parameters: Rows
    covariance_apart: Rows


class Mount(Brief, Description):
    """Transform from the sensor to its moving platform, with uncertainty and evidence.

    ``T_platform_sensor`` (4, 4) maps points from the sensor's frame (x and z of the profiles, y = z x x across the
    sheet) to the frame of the platform (a robot's flange), mm. ``covariance`` (6, 6) belongs to the translation (mm)
    and a small rotation (rad) about the platform's axes, R_true = exp(rotation) R. ``coverage_factor`` times a standard
    uncertainty is half of the 95 % interval (Student's t). ``point_std_mm`` is the noise of a profile's point, and
    ``pose_std_mm`` that of each coordinate of the platform's position; both are estimated from the profiles.

    On a rotary table (``table``), the platform's z axis is the table's axis. Translation along it and rotation about it
    are conventions and have zero variance. ``clock_covariance`` (6,) is that of the clock's offset with the mount from
    all sources but the sensor's calibration; without it, the offset is independent. ``sensor`` contains the
    contribution of the sensor's calibration to the covariance, if the calibration has a joint estimate. Otherwise the
    profiles are assumed exact apart from noise.
    ``inputs`` holds the SHA-256 of every input file. ``edited`` is set if its file was edited by hand.
    """

    T_platform_sensor: RigidTransform
    covariance: Rows
    coverage_factor: Positive
    artefact: Annotated[SphereFound | PlaneFound | BoardFound, Field(discriminator="kind")]
    robot_scale: Positive | None = None
    robot_scale_std: NotNegative | None = None
    time_offset_s: float | None = None
    time_offset_std_s: NotNegative | None = None
    clock_covariance: tuple[float, float, float, float, float, float] | None = None
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
    edited: bool = False

    @model_validator(mode="after")
    def _check_consistency(self) -> "Mount":
        covariance = np.array(self.covariance) if [*map(len, self.covariance)] == [6] * 6 else np.full((6, 6), np.nan)
        if not np.abs(covariance - covariance.T).max() <= 1e-9 * np.abs(covariance).max():
            raise ValueError("covariance must be a symmetric 6x6 matrix")
        if self.sensor is not None:
            by, independent = self.sensor.by_parameters, self.sensor.covariance_apart
            if len(by) != 6 or len({*map(len, by)}) != 1 or [*map(len, independent)] != [6] * 6:
                raise ValueError("sensor must have by_parameters (6, P) and covariance_apart (6, 6)")
        if not np.all(np.delete(np.diag(covariance), (2, 5) if self.table else ()) > 0):
            raise ValueError("covariance must have positive variances")
        return self

    @check_arguments
    def save(self, path: str | Path, *, overwrite: bool = False) -> None:
        """Write the mount as JSON, completely or not at all; OutputError if that fails."""
        write_model(path, self, file_format=FORMAT, version=VERSION, overwrite=overwrite)

    def transform(self) -> np.ndarray:
        """Return ``T_platform_sensor`` as an array (4, 4), mm."""
        return np.array(self.T_platform_sensor)

    def std(self) -> np.ndarray:
        """Return the standard uncertainties (6,) of the translation, mm, and of the rotation, rad."""
        return np.sqrt(np.diag(np.array(self.covariance)))

    def radius_mm(self) -> float:
        """Return the radius of the sphere; 0 for a plane or target."""
        return self.artefact.radius_mm if isinstance(self.artefact, SphereFound) else 0.0

    def independent_covariance(self, calibration: str) -> tuple[np.ndarray, np.ndarray | None]:
        """Return the part (6, 6) of the covariance that is independent of a sensor calibration, given by its digest.

        If the mount was estimated with that calibration, also return the derivatives (6, P) of the mount with respect
        to the parameters of the joint estimate.
        """
        if self.sensor is None or self.sensor.calibration != calibration:
            return np.array(self.covariance), None
        return np.array(self.sensor.covariance_apart), np.array(self.sensor.by_parameters)

    def clock_errors(self, root: np.ndarray) -> tuple[np.ndarray, float]:
        """Return the error of the clock's offset, s, by independent components (K,) of the mount's, and the remainder.

        ``root`` (6, K) are the mount's errors by these components; the remainder is a standard uncertainty.
        """
        std, of_mount = self.time_offset_std_s or 0.0, np.linalg.norm(root, axis=1)
        if self.clock_covariance is None or not std:
            return np.zeros(root.shape[1]), std
        scale = np.where(of_mount > 0, of_mount, 1.0)
        by = np.linalg.lstsq(root / scale[:, None], np.array(self.clock_covariance) / scale / std, rcond=None)[0]
        return std * by, std * float(np.sqrt(max(1.0 - by @ by, 0.0)))
