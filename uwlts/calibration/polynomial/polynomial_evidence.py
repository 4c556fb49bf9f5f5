"""Maps from pixels to the target's plane, from the target's points in the same image, and stripe points on it."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.polynomial import legendre
from scipy.spatial import ConvexHull

from uwlts.calibration.camera.camera_parameters import TargetImage
from uwlts.calibration.capture_evidence import AirEvidence
from uwlts.errors import CalibrationError
from uwlts.model.placement import laser_pose
from uwlts.optics.nominal import nominal_calibration
from uwlts.optics.triangulation import reconstruct_pixels
from uwlts.optics.window import RayStatus
from uwlts.storage.capture import Capture, CaptureHeader
from uwlts.targets.detection.ellipses import circle_centre_bias

# The deviation of a plane's image from a homography, by lens and window, is smooth: the fifth degree describes it to a
# micrometre in a view 200 mm wide. With fewer than three points for each coefficient, noise would be fitted.
_HIGHEST_DEGREE = 5
_LOWEST_DEGREE = 3
_POINTS_PER_TERM = 3


@dataclass(frozen=True, eq=False)
class SmoothMap:
    """Smooth map from one plane to another: a homography and a correcting polynomial."""

    homography: np.ndarray  # (3, 3)
    low: np.ndarray  # (2,); first corner of the box of the fitted points: the polynomial's arguments are -1
    high: np.ndarray  # (2,); opposite corner, the arguments are 1
    degree: int  # total degree of the polynomial
    coefficients: np.ndarray  # (terms, 2); Legendre coefficients
    residuals: np.ndarray  # (N, 2); of the fitted points

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """Map points (M, 2); return (M, 2)."""
        return self.coarsely(points) + _terms(points, self.low, self.high, self.degree) @ self.coefficients

    def coarsely(self, points: np.ndarray) -> np.ndarray:
        """Map points (M, 2) with the homography only, which extrapolates well."""
        return cv2.perspectiveTransform(points[:, None], self.homography)[:, 0]


@dataclass(frozen=True, eq=False)
class PlateMap(SmoothMap):
    """Map from pixels to the plane of the target (plate) in mm, fitted to the target's points.

    ``hull`` (K, 3) contains the sides of the points' convex hull on the plate: outward normal and offset in mm.
    """

    hull: np.ndarray

    def beyond_mm(self, pixels: np.ndarray) -> np.ndarray:
        """Return the distances (M,) in mm of pixels (M, 2) outside the hull of the target's points; negative inside."""
        return np.max(self.coarsely(pixels) @ self.hull[:, :2].T + self.hull[:, 2], axis=1)

    def rms_mm(self) -> float:
        """Return the root mean square length of the residuals."""
        return float(np.sqrt(np.mean(np.sum(self.residuals**2, axis=1))))


def fit_plate_map(image: TargetImage, *, circle_diameter_mm: float | None = None) -> PlateMap:
    """Fit the map from pixels to the plate to the points of one image.

    For circles, the pixels are centres of the circles' images. The offsets from the images of the circles' centres are
    corrected with the map itself, as refraction can shift the centres as much as perspective.

    Raises CalibrationError if there are too few points, or they determine no homography; RangeError if a circle's image
    is not an ellipse.
    """
    points, pixels = image.points_mm, image.pixels
    if circle_diameter_mm is not None:
        to_image = fit_smooth_map(points[:, :2], pixels)
        pixels = pixels - circle_centre_bias(lambda rim: to_image(rim[:, :2]), points, diameter_mm=circle_diameter_mm)
    return PlateMap(**vars(fit_smooth_map(pixels, points[:, :2])), hull=ConvexHull(points[:, :2]).equations)


def fit_smooth_map(start: np.ndarray, end: np.ndarray) -> SmoothMap:
    """Fit a smooth map from points (N, 2) to points (N, 2) by least squares.

    Raises CalibrationError if there are too few points, or they determine no homography.
    """
    counts = {d: (d + 1) * (d + 2) // 2 for d in range(_LOWEST_DEGREE, _HIGHEST_DEGREE + 1)}
    degree = max((d for d, count in counts.items() if _POINTS_PER_TERM * count <= len(start)), default=None)
    if degree is None:
        raise CalibrationError(
            f"{len(start)} points of the target were found; at least {_POINTS_PER_TERM * counts[_LOWEST_DEGREE]} "
            "are needed to find the stripe's place on the target"
        )
    found = cv2.findHomography(np.ascontiguousarray(start), np.ascontiguousarray(end), method=0)[0]
    if found is None or not np.isfinite(found).all():
        raise CalibrationError(f"the {len(start)} points of the target determine no homography from image to target")
    low, high = start.min(axis=0), start.max(axis=0)
    left, terms = end - cv2.perspectiveTransform(start[:, None], found)[:, 0], _terms(start, low, high, degree)
    coefficients = np.linalg.lstsq(terms, left, rcond=None)[0]
    return SmoothMap(found, low, high, degree, coefficients, left - terms @ coefficients)


def _terms(points: np.ndarray, low: np.ndarray, high: np.ndarray, degree: int) -> np.ndarray:
    """Return products of Legendre polynomials in both coordinates up to a total degree, (M, terms)."""
    first, second = ((2 * points - low - high) / (high - low)).T
    products = legendre.legvander2d(first, second, [degree, degree])
    powers = np.add.outer(np.arange(degree + 1), np.arange(degree + 1)).ravel()
    return products[:, powers <= degree]


_SAME_POSITION_MM = 1e-6  # rounding of positions stored as floating-point numbers
_ALONG_Z = 0.9  # cosine of the angle between the stage's direction and the laser's axis
_ORIGIN_POINTS = 100  # stripe points near the camera's axis that define the origin of the OCS


@dataclass(frozen=True, eq=False)
class PlateStripes:
    """Stripe points of all images on the plate (N points)."""

    pixels: np.ndarray  # (N, 2)
    lines: np.ndarray  # (N,) int; profile line of each point
    centres_px: np.ndarray  # (N,); stripe's centre on the line
    plate_mm: np.ndarray  # (N, 2); place on the plate, in the target's frame
    pose: np.ndarray  # (N,) int; number of the image
    stage_mm: np.ndarray  # (N,); stage position


def common_header(captures: Sequence[Capture]) -> CaptureHeader:
    """Return the first capture's header.

    Raises CalibrationError if there is no capture, one has no target, the captures differ in their arrangement, or the
    stage does not move along Z.
    """
    if not captures:
        raise CalibrationError("no capture of a target is given: polynomials are fitted to these")
    first = captures[0]

    def arrangement(capture: Capture) -> dict[str, Any]:
        header, camera = capture.header, capture.header.sensor.camera
        return {
            "image size": (camera.width_px, camera.height_px),
            "offset_px": camera.offset_px,
            "stripe_along": camera.stripe_along,
            "wavelength": header.sensor.laser.wavelength_nm,
            "medium": header.medium,
            "window mounted": camera.window.mounted,
            "stage_direction": header.stage_direction,
            "target": header.target,
        }

    for capture in captures:
        if capture.header.target is None:
            raise CalibrationError(f"{capture.path.name} does not describe its target in its header")
        for (name, own), other in zip(arrangement(capture).items(), arrangement(first).values(), strict=True):
            if own != other:
                raise CalibrationError(
                    f"{capture.path.name} does not match {first.path.name}: {name} is {own} instead of {other}"
                )
    direction = first.header.stage_direction
    if abs(direction[2]) < _ALONG_Z:
        raise CalibrationError(
            f"the stage must move the sensor along the laser's axis (OCS Z); stage_direction is {direction}"
        )
    return first.header


def stripes_on_plate(
    evidence: AirEvidence, header: CaptureHeader, degree: int
) -> tuple[PlateStripes, list[PlateMap], list[str]]:
    """Return stripe points on the plate near the target's points in the same image, the maps, and warnings.

    Points are used up to one spacing outside the hull of the target's points in the image, and up to half a spacing
    outside the pattern. Images without such points have no map.

    Raises CalibrationError if there are fewer positions than coefficients of a polynomial of this degree.
    """
    target = evidence.target
    spacing, extent = target.spacing_mm, target.extent_mm
    along = 0 if header.sensor.camera.stripe_along == "width" else 1
    maps, parts, warnings = [], [], []
    for number, (image, pixels) in enumerate(zip(evidence.images, evidence.stripes, strict=True)):
        if not len(pixels):
            warnings.append(f"no stripe at the stage position {image.stage_mm:g} mm, where the target was found")
            continue
        try:
            plate_map = fit_plate_map(image, circle_diameter_mm=target.circle_diameter_mm)
        except CalibrationError as error:
            warnings.append(f"stage position {image.stage_mm:g} mm: left out, {error}")
            continue
        plate = plate_map(pixels)
        in_pattern = (plate >= extent.min(axis=0) - spacing / 2) & (plate <= extent.max(axis=0) + spacing / 2)
        on_plate = in_pattern.all(axis=1) & (plate_map.beyond_mm(pixels) <= spacing)
        if on_plate.any():
            maps.append(plate_map)
            parts.append((pixels[on_plate], plate[on_plate], number, image.stage_mm))
        else:
            warnings.append(f"stage position {image.stage_mm:g} mm: left out, the stripe is not on the target")
    positions = np.sort([stage for *_, stage in parts])
    different = int(np.count_nonzero(np.diff(positions) > _SAME_POSITION_MM)) + 1 if len(positions) else 0
    if evidence.no_stripe:
        raise CalibrationError(evidence.no_stripe)
    if different <= degree:
        raise CalibrationError(
            f"target and stripe were found together at {different} stage positions; polynomials of degree {degree} "
            f"need at least {degree + 1}, better twice as many: {'; '.join([*evidence.warnings, *warnings][:3])}"
        )
    each_pixels, each_plate, numbers, stage_mm = zip(*parts, strict=True)
    pixels, counts = np.vstack(each_pixels), [len(part) for part in each_pixels]
    stripes = PlateStripes(
        pixels=pixels,
        lines=np.rint(pixels[:, along]).astype(int),
        centres_px=pixels[:, 1 - along],
        plate_mm=np.vstack(each_plate),
        pose=np.repeat(numbers, counts),
        stage_mm=np.repeat(stage_mm, counts),
    )
    return stripes, maps, warnings


def object_coordinates(stripes: PlateStripes, header: CaptureHeader) -> tuple[np.ndarray, np.ndarray]:
    """Return Z and Y (N,) of the stripe points in the OCS.

    The plate is at rest, so in the OCS it moves opposite to the stage. Y is along the stripe on the plate, with the
    sign of the described fan in the image. The origin is where the described sensor sees the stripe points nearest to
    its camera's axis.
    """
    camera = header.sensor.camera
    direction = np.array(header.stage_direction)
    depth = -direction[2] * stripes.stage_mm
    _, number, count = np.unique(stripes.pose, return_inverse=True, return_counts=True)
    means = np.column_stack([np.bincount(number, column) / count for column in stripes.plate_mm.T])
    centred = stripes.plate_mm - means[number]
    along_stripe = np.linalg.svd(centred, full_matrices=False)[2][0]
    along = stripes.plate_mm @ along_stripe
    with_lines = np.sum(centred @ along_stripe * (stripes.lines - stripes.lines.mean()))
    fan = laser_pose(header.sensor).fan[0 if camera.stripe_along == "width" else 1]
    along = along * np.sign(with_lines * fan) - direction[1] * stripes.stage_mm

    nominal = nominal_calibration(header.sensor, header.medium)
    index = header.medium.refractive_index(nominal.wavelength_nm)
    seen = reconstruct_pixels(
        nominal, stripes.pixels, medium_index=index, stage_mm=0.0, stage_direction=np.array([0.0, 0.0, 1.0])
    )
    known = np.flatnonzero(seen.status == RayStatus.OK)
    if not len(known):
        raise CalibrationError(
            "the described sensor sees the sheet at none of the stripe points: check baseline, angle and stripe_along"
        )
    _, along_nominal, depth_nominal = seen.points_mm[known].T
    nominal_motion, motion = (values - np.median(values) for values in (depth_nominal, depth[known]))
    if np.sum(nominal_motion * motion) <= 0:
        raise CalibrationError(
            "the stripe moves through the image opposite to the stage positions: check the sign of the captures' "
            f"stage_direction, {header.stage_direction}, the laser's side, and that the images are not rotated by 180 "
            "deg or mirrored"
        )
    from_axis = np.hypot(*(stripes.pixels[known] - camera.principal_point()).T)
    middle = np.argsort(from_axis, kind="stable")[:_ORIGIN_POINTS]
    depth_shift = np.median(depth_nominal[middle] - depth[known][middle])
    return depth + depth_shift, along + np.median(along_nominal[middle] - along[known][middle])
