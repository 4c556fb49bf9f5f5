"""From a capture to a point cloud: the stripe of every laser image, turned into points by a calibration of any kind."""

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from uwlts.brightness import MOST_BLUR_PX, beside_sheet, moved_by_blur_px, slopes_of_brightness
from uwlts.calibration.joint.stored import is_joint
from uwlts.calibration.model import Calibration
from uwlts.calibration.polynomial_model import PolynomialCalibration
from uwlts.capture import Capture
from uwlts.cloud import PointCloud
from uwlts.errors import CalibrationError, CaptureError, RangeError
from uwlts.polynomial_reconstruction import reconstruct_by_polynomials
from uwlts.reconstruction import ObjectPoints, reconstruct_profile
from uwlts.refraction import RayStatus
from uwlts.stripe import StripeOptions, StripeStatus, extract_stripe, why_no_stripe
from uwlts.uncertainty.propagation import point_uncertainty

AnyCalibration = Calibration | PolynomialCalibration

# Polynomials hold the refraction they were made with: so much more, as from 20 to 30 degC, moves a point 300 mm away by
# 0.2 mm.
_LARGEST_INDEX_CHANGE = 1e-3


@dataclass(frozen=True)
class Scan:
    """A reconstructed capture: its cloud, and what became of the profile lines of all laser images.

    ``stripe`` (N,) tells from which of the capture's `FoundStripes` each point of the cloud comes.
    """

    cloud: PointCloud
    stripe: np.ndarray
    lines_by_status: dict[str, int]
    rays_by_status: dict[str, int]


def calibration_digest(calibration: AnyCalibration) -> str:
    """Short digest that tells which calibration a cloud was made with."""
    return hashlib.sha256(calibration.model_dump_json().encode()).hexdigest()[:16]


def check_fits(capture: Capture, calibration: AnyCalibration) -> None:
    """Refuse a calibration that cannot belong to the capture.

    Raises
    ------
    CalibrationError
        Image size or stripe orientation differ; the capture was made in water and the calibration has no window; or
        the calibration is one by polynomials and the capture was made in another medium, or with the window on in one
        and off in the other.
    """
    camera = capture.header.sensor.camera
    model = calibration if isinstance(calibration, PolynomialCalibration) else calibration.camera
    if (camera.width_px, camera.height_px) != (model.width_px, model.height_px):
        raise CalibrationError(
            f"{capture.path.name} has images of {camera.width_px} x {camera.height_px} pixels, the calibration is for "
            f"{model.width_px} x {model.height_px}"
            + (
                ": the images are turned by a quarter turn, turn them back"
                if (camera.height_px, camera.width_px) == (model.width_px, model.height_px)
                else ": calibrate with images of this size, or use the calibration of the camera that took these"
            )
        )
    if camera.stripe_along != calibration.stripe_along:
        raise CalibrationError(
            f"in {capture.path.name} the stripe runs along the image's {camera.stripe_along}, in the calibration along "
            f"its {calibration.stripe_along}"
        )
    if isinstance(calibration, PolynomialCalibration):
        _check_same_refraction(capture, calibration)
    elif capture.header.medium.kind not in ("air", calibration.medium_kind) and calibration.window is None:
        raise CalibrationError(
            f"{capture.path.name} was made in {capture.header.medium_name}, but the calibration is for "
            f"{calibration.medium_kind} only: calibrate again with step images taken in the medium (--step)"
        )
    elif capture.header.medium.kind == "air" and calibration.medium_kind != "air":
        raise CalibrationError(
            f"{capture.path.name} was made in air, but the calibration is that of a single viewpoint in water "
            f"({calibration.medium_kind}): its camera holds the refraction; calibrate in air"
        )


def _check_same_refraction(capture: Capture, calibration: PolynomialCalibration) -> None:
    header, own = capture.header, calibration.medium
    index, own_index = medium_index(capture, calibration), own.refractive_index(calibration.wavelength_nm)
    if header.medium.kind != own.kind or abs(index - own_index) > _LARGEST_INDEX_CHANGE:
        raise CalibrationError(
            f"{capture.path.name} was made in {header.medium_name} ({header.medium.kind}, n {index:.4f}), the "
            f"polynomials in {calibration.medium_name} ({own.kind}, n {own_index:.4f}): they hold in the medium they "
            "were made in only; calibrate again in this one"
        )
    if header.sensor.camera.window.mounted != calibration.window_mounted:
        with_window, without = "with the camera's window", "without the camera's window"
        here, there = (with_window, without) if not calibration.window_mounted else (without, with_window)
        raise CalibrationError(f"{capture.path.name} was made {here}, the polynomials {there}: calibrate again")


def require_index(index: float) -> None:
    """Refuse a refractive index, relative to air, that no medium to measure in has; RangeError."""
    if not 1 <= index < 2:
        raise RangeError(f"the refractive index is {index:g}; expected that of a medium relative to air, from 1 to 2")


def medium_index(capture: Capture, calibration: AnyCalibration) -> float:
    """Refractive index of the capture's medium at the sensor's wavelength, relative to air."""
    medium = capture.header.medium
    if isinstance(calibration, PolynomialCalibration):
        return medium.refractive_index(calibration.wavelength_nm)
    return calibration.index_of(medium)


@dataclass(frozen=True, eq=False)
class FoundStripes:
    """Stripe centres of all laser images of a capture, joined: N of them.

    Attributes
    ----------
    frame, line : (N,) int
        Image and profile line of each centre.
    centre_px, amplitude, width_px : (N,)
        Place on the line, height in grey levels and full width at half maximum.
    lines_by_status : dict
        What became of the profile lines of all images.
    """

    frame: np.ndarray
    line: np.ndarray
    centre_px: np.ndarray
    amplitude: np.ndarray
    width_px: np.ndarray
    lines_by_status: dict[str, int]

    def __getitem__(self, some: np.ndarray) -> "FoundStripes":
        """Those that an index array or mask chooses."""
        chosen = (self.frame[some], self.line[some], self.centre_px[some], self.amplitude[some], self.width_px[some])
        return FoundStripes(*chosen, self.lines_by_status)


def find_stripes(
    capture: Capture,
    *,
    options: StripeOptions = StripeOptions(),
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> FoundStripes:
    """Find the stripe in all laser images of a capture.

    Raises
    ------
    CaptureError
        The capture holds no laser image, or none of them shows a stripe.
    """
    header = capture.header
    frames, lines, centres, amplitudes, widths = [], [], [], [], []
    statuses = np.zeros(len(StripeStatus), int)
    for number, image in capture.frames(laser_on=True):
        stripe = extract_stripe(
            image, stripe_along=header.sensor.camera.stripe_along, options=options, saturation=header.saturation_dn
        )
        statuses += np.bincount(stripe.status, minlength=len(StripeStatus))
        good = stripe.lines
        centres.append(stripe.centre_px[good])
        lines.append(good)
        frames.append(np.full(len(good), number))
        amplitudes.append(stripe.amplitude[good])
        widths.append(stripe.width_px[good])
        progress(number + 1, len(capture))
    if not centres:
        raise CaptureError(
            f"{capture.path.name} holds no image with the laser on among {len(capture)}: nothing to reconstruct"
        )
    by_status = {status.name.lower(): int(statuses[status]) for status in StripeStatus}
    if statuses[StripeStatus.OK] == 0:
        lit = (image for _, image in capture.frames(laser_on=True))
        reason = why_no_stripe(lit, stripe_along=header.sensor.camera.stripe_along, full_dn=header.saturation_dn)
        raise CaptureError(f"no stripe in any of the {len(centres)} laser images of {capture.path.name}: {reason}")
    return FoundStripes(*(np.concatenate(parts) for parts in (frames, lines, centres, amplitudes, widths)), by_status)


def sharp_lines(stripes: FoundStripes) -> tuple[np.ndarray, np.ndarray]:
    """Numbers (M,) of the stripe centres that blur hardly moves, and by how much it may, px; see `uwlts.brightness`."""
    if len(stripes.line) == 0:
        return np.empty(0, np.intp), np.empty(0)
    moved = moved_by_blur_px(stripes.frame, stripes.line, stripes.centre_px, stripes.amplitude, stripes.width_px)
    sharp = np.flatnonzero(np.abs(moved) < MOST_BLUR_PX)
    return sharp, moved[sharp]


def reconstruct_capture(
    capture: Capture,
    calibration: AnyCalibration,
    *,
    options: StripeOptions = StripeOptions(),
    index: float | None = None,
    with_uncertainty: bool = False,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Scan:
    """Point cloud of a capture: `find_stripes`, then `reconstruct_stripes`, with the errors of both."""
    check_fits(capture, calibration)
    stripes = find_stripes(capture, options=options, progress=progress)
    return reconstruct_stripes(capture, stripes, calibration, index=index, with_uncertainty=with_uncertainty)


def reconstruct_stripes(
    capture: Capture,
    stripes: FoundStripes,
    calibration: AnyCalibration,
    *,
    index: float | None = None,
    with_uncertainty: bool = False,
) -> Scan:
    """Point cloud of a capture in the OCS, with the stage's motion added (or the pose, where a frame has one).

    ``index`` replaces the refractive index that follows from the capture's medium. ``with_uncertainty`` tells how well
    the points are known by a joint calibration; in the OCS, whatever the poses. Without a window in the light's way
    the calibration's window is left out. Points that a calibration by polynomials does not reach are left out and
    counted in ``rays_by_status``.

    By a joint calibration points are taken where the light comes from, beside the sheet's middle where the surface
    shines brighter there (`uwlts.brightness`), and lines are left out, counted as ``blurred``, where blur may move the
    stripe's centre more than noise does.

    Raises
    ------
    CalibrationError
        The calibration does not fit the capture, or an index is given for a calibration by polynomials.
    RangeError
        The refractive index is none of a medium.
    """
    check_fits(capture, calibration)
    if index is not None and isinstance(calibration, PolynomialCalibration):
        raise CalibrationError(
            "polynomials hold the refraction of the medium they were made in: a refractive index cannot replace it"
        )
    index = medium_index(capture, calibration) if index is None else index
    require_index(index)
    lines = stripes.lines_by_status
    sharp, blur = np.arange(len(stripes.line)), np.zeros(len(stripes.line))
    exact = isinstance(calibration, Calibration) and is_joint(calibration)
    if exact:
        sharp, blur = sharp_lines(stripes)
        blurred = len(stripes.line) - len(sharp)
        lines = lines | {"ok": lines.get("ok", 0) - blurred, "blurred": blurred}
        stripes = stripes[sharp]
    found = _points(capture, calibration, stripes, index)
    beside = _beside(capture, calibration, stripes, index) if exact else np.zeros((len(sharp), 3))
    points = _posed(found.points_mm + beside, capture, stripes.frame)
    good = np.flatnonzero(found.status == RayStatus.OK)
    kept = stripes[good]
    cloud = PointCloud(
        points_mm=points[good], intensity=kept.amplitude, frame=kept.frame, line=kept.line,
        metadata={
            "capture": capture.path.name, "sensor": calibration.sensor_name, "medium": capture.header.medium_name,
            "medium_index": index, "artefact": capture.header.artefact, "calibration": calibration_digest(calibration),
        },
    )  # fmt: skip
    if with_uncertainty:
        known = point_uncertainty(
            capture, calibration, kept.frame, kept.line, kept.centre_px, blur_px=blur[good], beside_mm=beside[good]
        )
        cloud = replace(cloud, uncertainty=known)
    rays = np.bincount(found.status, minlength=len(RayStatus))
    by_status = {status.name.lower(): int(rays[status]) for status in RayStatus}
    return Scan(cloud, sharp[good], lines, by_status)


def _points(capture: Capture, calibration: AnyCalibration, stripes: FoundStripes, index: float) -> ObjectPoints:
    """Points in the OCS of stripe centres, by whichever kind of calibration, with the stage's motion added."""
    stage, direction = capture.stage_mm[stripes.frame], np.array(capture.header.stage_direction)
    line, centre = stripes.line, stripes.centre_px
    if isinstance(calibration, PolynomialCalibration):
        return reconstruct_by_polynomials(calibration, line, centre, stage_mm=stage, stage_direction=direction)
    direction = np.array(calibration.stage_direction_of(capture.header.stage_direction))
    if not capture.header.sensor.camera.window.mounted:
        calibration = calibration.model_copy(update={"window": None})
    return reconstruct_profile(calibration, line, centre, medium_index=index, stage_mm=stage, stage_direction=direction)


def _beside(capture: Capture, calibration: Calibration, stripes: FoundStripes, index: float) -> np.ndarray:
    """From points on the sheet's middle to where their light comes from (N, 3), OCS."""
    if np.isfinite(capture.pose).any():
        return np.zeros((len(stripes.line), 3))
    slopes = slopes_of_brightness(
        stripes.frame, stripes.line, stripes.amplitude, capture.stage_mm[:], capture.exposure_ms[:]
    )
    header = capture.header
    return beside_sheet(
        calibration, header.sensor, stripes.line, stripes.centre_px, stripes.width_px, slopes, medium_index=index,
        stage_direction=header.stage_direction,
    )  # fmt: skip


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
