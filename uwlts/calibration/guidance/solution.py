"""The camera as far as the recorded poses of the target determine it, and whether a new one fits the others."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from uwlts.calibration.camera import CameraSolution, Poses, solve_camera
from uwlts.calibration.intrinsics import CameraOptions, Intrinsics
from uwlts.calibration.target_images import TargetImage
from uwlts.model.calibration import CameraModel
from uwlts.model.errors import CalibrationError, RangeError
from uwlts.model.sensor import Medium, Sensor
from uwlts.targets import Target, TargetView

# A residual this many times that of the others, and this much beyond what noise alone may do, contradicts them.
_CONTRADICTION, _ALLOWANCE_PX = 3.0, 0.1


@dataclass(frozen=True, eq=False)
class RecordedPose:
    """A pose of the target as recorded: what the lamp showed, the stripe (N, 2) on the target, the stage's position."""

    view: TargetView
    stripe: np.ndarray
    stage_mm: float


@dataclass(frozen=True)
class Setting:
    """What the poses are taken with: sensor, target, the medium it stands in, and how the poses belong together."""

    sensor: Sensor
    target: Target
    medium: Medium
    poses: Poses
    approaching: bool = True
    camera: CameraOptions = CameraOptions()

    def intrinsics(self) -> Intrinsics:
        """The camera parameters that are estimated."""
        camera = self.sensor.camera
        return Intrinsics(self.camera, width_px=camera.width_px, height_px=camera.height_px)


def nominal_camera(setting: Setting) -> CameraModel:
    """The described camera; through a window into a medium its focal length grows by the medium's index."""
    camera = setting.sensor.camera
    index = setting.medium.refractive_index(setting.sensor.laser.wavelength_nm) if camera.window.mounted else 1.0
    return CameraModel.described(camera, magnified=index)


def pose_of(view: TargetView, camera: CameraModel) -> np.ndarray:
    """``T_camera_target`` (4, 4) of a view by a known camera.

    Raises CalibrationError: no pose explains the points.
    """
    found, rotation, translation = cv2.solvePnP(view.points_mm, view.pixels, camera.matrix(), camera.coefficients())
    if not found or not np.isfinite(translation).all():
        raise CalibrationError("no pose of the target explains its image: is it the described target?")
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = cv2.Rodrigues(rotation)[0], translation[:, 0]
    return pose


def solve_recorded(recorded: Sequence[RecordedPose], setting: Setting) -> CameraSolution:
    """Camera and poses from what is recorded; CalibrationError where that does not determine them yet."""
    camera = setting.sensor.camera
    try:
        return solve_camera(
            [TargetImage(pose.view.points_mm, pose.view.pixels, pose.stage_mm) for pose in recorded],
            width_px=camera.width_px,
            height_px=camera.height_px,
            poses=setting.poses,
            approaching=setting.approaching,
            options=setting.camera,
            circle_diameter_mm=setting.target.circle_diameter_mm,
        )
    except RangeError as error:
        raise CalibrationError(str(error)) from error


def judge_residual(before: CameraSolution | None, after: CameraSolution) -> tuple[str, ...]:
    """Why the last image of ``after`` contradicts those before it, which ``before`` was solved from; empty if not."""
    if before is None:
        return ()
    rms, usual = after.image_rms_px(), before.rms_px()
    limit = _CONTRADICTION * usual + _ALLOWANCE_PX
    # A wrong image pulls the others along, so they are looked at too.
    worst = max(float(rms[-1]), float(np.sqrt(np.mean(rms[:-1] ** 2))))
    reason = (
        f"contradicts the others: with it the residual is {worst:.2f} px, without it {usual:.2f} px, at most "
        f"{limit:.2f} px is plausible; did the target bend, the stage slip, the lens turn?"
    )
    return () if worst <= limit else (reason,)


def without_window(sensor: Sensor) -> Sensor:
    """The sensor with its camera's window taken off."""
    window = sensor.camera.window.model_copy(update={"mounted": False})
    return sensor.model_copy(update={"camera": sensor.camera.model_copy(update={"window": window})})
