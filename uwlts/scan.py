"""From a capture to a point cloud: the stripe of every laser image, sent back through the window onto the sheet."""

import hashlib
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from uwlts.calibration.model import Calibration
from uwlts.capture import Capture
from uwlts.cloud import PointCloud
from uwlts.errors import CalibrationError, CaptureError, RangeError
from uwlts.reconstruction import reconstruct_pixels
from uwlts.refraction import RayStatus
from uwlts.stripe import StripeOptions, StripeStatus, extract_stripe


@dataclass(frozen=True)
class Scan:
    """A reconstructed capture: its cloud, and what became of the profile lines of all laser images."""

    cloud: PointCloud
    lines_by_status: dict[str, int]
    rays_by_status: dict[str, int]


def calibration_digest(calibration: Calibration) -> str:
    """Short digest that tells which calibration a cloud was made with."""
    return hashlib.sha256(calibration.model_dump_json().encode()).hexdigest()[:16]


def check_fits(capture: Capture, calibration: Calibration) -> None:
    """Refuse a calibration that cannot belong to the capture.

    Raises
    ------
    CalibrationError
        Image size or stripe orientation differ, or the capture was made in water and the calibration has no window.
    """
    camera, model = capture.header.sensor.camera, calibration.camera
    if (camera.width_px, camera.height_px) != (model.width_px, model.height_px):
        raise CalibrationError(
            f"{capture.path.name} has images of {camera.width_px} x {camera.height_px} pixels, the calibration is for "
            f"{model.width_px} x {model.height_px}"
        )
    if camera.stripe_along != calibration.stripe_along:
        raise CalibrationError(
            f"in {capture.path.name} the stripe runs along the image's {camera.stripe_along}, in the calibration along "
            f"its {calibration.stripe_along}"
        )
    if capture.header.medium.kind != "air" and calibration.window is None:
        raise CalibrationError(
            f"{capture.path.name} was made in {capture.header.medium_name}, but the calibration is for air only: "
            "calibrate again with step images taken in the medium (--step)"
        )


def require_index(index: float) -> None:
    """Refuse a refractive index, relative to air, that no medium to measure in has; RangeError."""
    if not 1 <= index < 2:
        raise RangeError(f"the refractive index is {index:g}; expected that of a medium relative to air, from 1 to 2")


def medium_index(capture: Capture, calibration: Calibration) -> float:
    """Refractive index of the capture's medium at the sensor's wavelength, relative to air."""
    return capture.header.medium.refractive_index(calibration.wavelength_nm)


def reconstruct_capture(
    capture: Capture,
    calibration: Calibration,
    *,
    options: StripeOptions = StripeOptions(),
    index: float | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Scan:
    """Point cloud of a capture in the OCS, with the stage's motion added (or the pose, where a frame has one).

    ``index`` replaces the refractive index that follows from the capture's medium. Without a window in the light's way
    the calibration's window is left out.

    Raises
    ------
    CalibrationError
        The calibration does not fit the capture.
    CaptureError
        The capture holds no laser image, or none of them shows a stripe.
    RangeError
        The refractive index is none of a medium.
    """
    check_fits(capture, calibration)
    header = capture.header
    if not header.sensor.camera.window.mounted:
        calibration = calibration.model_copy(update={"window": None})
    index = medium_index(capture, calibration) if index is None else index
    require_index(index)
    pixels, frames, lines, intensities = [], [], [], []
    statuses = np.zeros(len(StripeStatus), int)
    for number, image in capture.frames(laser_on=True):
        stripe = extract_stripe(
            image, stripe_along=calibration.stripe_along, options=options, saturation=header.saturation_dn
        )
        statuses += np.bincount(stripe.status, minlength=len(StripeStatus))
        good = stripe.lines
        pixels.append(stripe.pixels())
        lines.append(good)
        frames.append(np.full(len(good), number))
        intensities.append(stripe.amplitude[good])
        progress(number + 1, len(capture))
    if not pixels:
        raise CaptureError(f"{capture.path.name} holds no image with the laser on: nothing to reconstruct")
    by_status = {status.name.lower(): int(statuses[status]) for status in StripeStatus}
    if statuses[StripeStatus.OK] == 0:
        found = ", ".join(f"{count} {name}" for name, count in by_status.items() if count)
        raise CaptureError(
            f"no stripe in any of the {len(pixels)} laser images of {capture.path.name} (lines: {found})"
        )
    frame, line, intensity = (np.concatenate(parts) for parts in (frames, lines, intensities))
    found = reconstruct_pixels(
        calibration, np.concatenate(pixels), medium_index=index,
        stage_mm=capture.stage_mm[frame], stage_direction=np.array(header.stage_direction),
    )  # fmt: skip
    points = _posed(found.points_mm, capture, frame)
    good = found.status == RayStatus.OK
    cloud = PointCloud(
        points_mm=points[good], intensity=intensity[good], frame=frame[good], line=line[good],
        metadata={
            "capture": capture.path.name, "sensor": calibration.sensor_name, "medium": header.medium_name,
            "medium_index": index, "artefact": header.artefact, "calibration": calibration_digest(calibration),
        },
    )  # fmt: skip
    rays = np.bincount(found.status, minlength=len(RayStatus))
    return Scan(cloud, by_status, {status.name.lower(): int(rays[status]) for status in RayStatus})


def _posed(points: np.ndarray, capture: Capture, frame: np.ndarray) -> np.ndarray:
    """Points of frames that carry a full pose ``T_scene_object`` are placed by it instead of by the stage."""
    posed = np.isfinite(capture.pose).all(axis=(1, 2))
    if not posed.any():
        return points
    points = points.copy()
    for number in np.flatnonzero(posed):
        own = frame == number
        at_stage = capture.stage_mm[number] * np.array(capture.header.stage_direction)
        pose = capture.pose[number]
        points[own] = (points[own] - at_stage) @ pose[:3, :3].T + pose[:3, 3]
    return points
