"""Laser sheet as a plane: stripe points on the target at known poses, the plane through them, and the OCS."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from pydantic import JsonValue
from scipy.spatial import ConvexHull

from uwlts.calibration.camera.target_poses import turned_like
from uwlts.errors import CalibrationError, EvaluationError
from uwlts.fitting.least_squares import fit_robustly
from uwlts.model.calibration import CameraModel, SheetModel, rigid_transform
from uwlts.optics.camera import directions
from uwlts.shapes.flat import Plane

# Smallest spread of the points along the shorter direction of the sheet, relative to their scatter across it, and
# to their spread along the longer direction: below, the scatter rotates the plane. A single stripe scatters within
# the target's plane, which could be mistaken for the sheet.
_LEAST_SPREAD = 20.0
_LEAST_SHAPE = 0.01
_LARGEST_REJECTED = 0.2  # outliers are few; if more points are off the plane, there is none
_LARGEST_TURN = np.radians(60)  # descriptions are rough; beyond this, axes are exchanged or signs wrong
_OTHER_UNIT = 5.0  # descriptions are rough, but not by this factor
_LEAST_OFFSET_MM = 10.0  # for a smaller offset from the camera, the factor is meaningless
_CROSSING = 0.3  # cosine above which the sheet's intersection with an axis is reported


@dataclass(frozen=True, eq=False)
class StripePoints:
    """Stripe points on the target: (N, 3) in mm, camera frame, and the image number (N,) of each."""

    points_mm: np.ndarray
    image: np.ndarray


@dataclass(frozen=True, eq=False)
class SheetSolution:
    """Calibrated sheet."""

    model: SheetModel
    residuals_mm: np.ndarray  # (N,); signed distances of all points from the plane
    used: np.ndarray  # (N,) bool; inliers
    rms_mm: float  # over the inliers
    max_mm: float  # over the inliers
    rejected_share: float  # fraction of rejected points
    normal_std_rad: float  # largest standard deviation of the normal's direction
    turn_rad: float  # angle between the normal and the nominal one

    def figures(self, points: StripePoints, halves_apart_rad: float | None) -> dict[str, JsonValue]:
        """Return distances of the stripe points from the sheet, and the angle between half-sample sheets, for files."""
        return {
            "images": len(np.unique(points.image)),
            "points": len(points.points_mm),
            "rms_mm": self.rms_mm,
            "max_mm": self.max_mm,
            "rejected_share": self.rejected_share,
            "normal_std_deg": float(np.degrees(self.normal_std_rad)),
            "halves_apart_deg": None if halves_apart_rad is None else float(np.degrees(halves_apart_rad)),
            "turn_from_nominal_deg": float(np.degrees(self.turn_rad)),
        }


def points_on_target(
    camera: CameraModel, stripes: Sequence[np.ndarray], target_poses: np.ndarray, *, plate_mm: np.ndarray
) -> StripePoints:
    """Intersect the camera rays of stripe pixels with the target's plane (thesis, section 4.8).

    ``stripes`` (N, 2) are the pixels (u, v) of each image, ``target_poses`` (F, 4, 4) its ``T_camera_target``. Points
    outside the convex hull of ``plate_mm`` (V, 2), points (x, y) of the target's plane, are not on the target.

    Raises CalibrationError if no stripe pixel is on the target, or a pose is not finite; RangeError if a pixel is not
    finite.
    """
    if not np.isfinite(target_poses).all():
        raise CalibrationError("a pose of the target is not finite")
    hull = ConvexHull(np.asarray(plate_mm, dtype=np.float64)).equations
    kept, images = [], []
    for index, (pixels, pose) in enumerate(zip(stripes, target_poses, strict=True)):
        rays = directions(camera, pixels)
        normal, origin = pose[:3, 2], pose[:3, 3]
        with np.errstate(divide="ignore"):
            length = normal @ origin / (rays @ normal)
        ahead = np.isfinite(length) & (length > 0)
        points = rays[ahead] * length[ahead, None]
        on_plate = (points - origin) @ pose[:3, :2] @ hull[:, :2].T + hull[:, 2] <= 0
        kept.append(points[on_plate.all(axis=1)])
        images.append(np.full(len(kept[-1]), index))
    if not any(map(len, stripes)):
        raise CalibrationError(f"no stripe was found in any of {len(stripes)} images of the target")
    if not sum(map(len, kept)):
        raise CalibrationError(
            f"none of the stripes in {len(stripes)} images is on the target: check the target's description and the "
            "stage positions"
        )
    return StripePoints(np.vstack(kept), np.concatenate(images))


def fit_sheet(
    points_mm: np.ndarray,
    *,
    nominal_normal: np.ndarray,
    nominal_offset_mm: float | None = None,
    largest_rejected: float = _LARGEST_REJECTED,
) -> SheetSolution:
    """Fit a plane to points (N, 3) by orthogonal distances, without outliers (five robust standard deviations).

    The normal is oriented to the side of ``nominal_normal`` (3,), a unit vector, all in the camera frame.
    ``largest_rejected`` is the permitted fraction of outliers.

    CalibrationError if the points do not determine a plane or are not on one, or its normal is far from the nominal
    one. The same if its distance from the camera differs from ``nominal_offset_mm`` as by wrong units.
    """
    try:
        robust = fit_robustly(Plane.fit, points_mm, towards=nominal_normal)
    except EvaluationError as error:
        raise CalibrationError(f"no laser sheet through the stripe points: {error}") from error
    plane, used = robust.fit, robust.inliers
    longer, shorter = np.sqrt(np.mean(((points_mm[used] - plane.point_mm) @ plane.axes.T) ** 2, axis=0))
    if shorter < max(_LEAST_SPREAD * plane.std_mm, _LEAST_SHAPE * longer):
        raise CalibrationError(
            f"the stripe points extend only {shorter:.3g} mm (rms) along the shorter side of the sheet, with "
            f"{longer:.3g} mm along the longer one and a scatter of {plane.std_mm:.3g} mm: move the target further "
            "between the images"
        )
    if robust.rejected_share > largest_rejected:
        raise CalibrationError(
            f"{100 * robust.rejected_share:.0f} % of the stripe points are not on the plane of the others: check "
            "the stage positions, and that the stripe is on the target"
        )
    offset = float(plane.normal @ plane.point_mm)
    turn = float(np.arccos(np.clip(plane.normal @ nominal_normal, -1, 1)))
    _require_orientation(plane.normal, offset, nominal_normal, turn)
    if nominal_offset_mm is not None and abs(nominal_offset_mm) > _LEAST_OFFSET_MM:
        _require_offset(offset, nominal_offset_mm)
    return SheetSolution(
        model=SheetModel(normal=tuple(plane.normal.tolist()), offset_mm=offset),
        residuals_mm=robust.distances_mm,
        used=used,
        rms_mm=float(np.sqrt(np.mean(plane.residuals_mm**2))),
        max_mm=float(np.max(np.abs(plane.residuals_mm))),
        rejected_share=robust.rejected_share,
        normal_std_rad=float(np.sqrt(np.max(np.diag(plane.covariance)[1:]))),
        turn_rad=turn,
    )


def _require_orientation(normal: np.ndarray, offset: float, nominal_normal: np.ndarray, turn: float) -> None:
    """Raise CalibrationError if the sheet's normal (3,) is far from the nominal one, by ``turn`` rad."""
    advice = None
    if how := turned_like(normal, nominal_normal, either_way=True):
        advice = (
            f". This occurs if the images are {how}, or the laser is on the camera's other side: correct the images, "
            "or the description"
        )
    elif turn > _LARGEST_TURN:
        advice = ": check stripe_along, the laser's position, and whether the images are rotated or mirrored"
    if advice:
        found = f"the sheet found has the normal {np.round(normal, 3).tolist()}"
        axis = int(np.argmax(np.abs(normal[:2])))
        if abs(normal[axis]) > _CROSSING:
            found += f" and crosses the camera's {'xy'[axis]} axis at {offset / normal[axis]:.0f} mm"
        raise CalibrationError(
            f"the sheet's normal is turned by {np.degrees(turn):.0f} deg against the sensor's description{advice}; "
            + found
        )


def _require_offset(offset: float, nominal_offset_mm: float) -> None:
    """Raise CalibrationError if the sheet's distance from the camera indicates another side or unit."""
    times = offset / nominal_offset_mm
    if times < 0:
        raise CalibrationError(
            f"the sheet passes the camera at {offset:.1f} mm; expected {nominal_offset_mm:.1f} mm from the "
            "sensor's description, on the other side: the images are turned by 180 deg or mirrored, or the laser "
            "is on the camera's other side; correct the images, or the description"
        )
    if not 1 / _OTHER_UNIT < times < _OTHER_UNIT:
        raise CalibrationError(
            f"the sheet passes the camera at {offset:.1f} mm; expected {nominal_offset_mm:.1f} mm from the "
            "sensor's description: the target's measures must be in mm (not cm, m or inches), and the laser's "
            "position must be that of this sensor"
        )


def object_frame(sheet: SheetModel, *, laser_axis: np.ndarray) -> np.ndarray:
    """Return ``T_camera_object`` (4, 4) of the OCS of a sheet.

    X is the sheet's normal, Z the laser's axis (3,), camera frame, made perpendicular to X, and Y = Z x X. The origin
    is the intersection of the camera's axis with the sheet.

    Raises CalibrationError if the laser's axis is parallel to the normal, or the camera's axis does not meet the sheet
    in front of the camera.
    """
    x = np.array(sheet.normal)
    z = laser_axis - (laser_axis @ x) * x
    if np.linalg.norm(z) < 0.1 * np.linalg.norm(laser_axis):
        raise CalibrationError(
            "the laser's nominal axis is perpendicular to the calibrated sheet: check the description"
        )
    z = z / np.linalg.norm(z)
    if not (abs(x[2]) > 1e-9 and sheet.offset_mm / x[2] > 0):
        raise CalibrationError("the camera's axis does not meet the calibrated sheet in front of the camera")
    return rigid_transform(np.stack([x, np.cross(z, x), z], axis=1), np.array([0.0, 0.0, sheet.offset_mm / x[2]]))
