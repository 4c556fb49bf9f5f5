"""Maps from pixels to the target's plane by the target's points in the same image, and the stripe points on it."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.polynomial import legendre
from scipy.spatial import ConvexHull

from uwlts.calibration.camera.target_images import TargetImage
from uwlts.calibration.capture_evidence import AirEvidence
from uwlts.errors import CalibrationError
from uwlts.model.placement import laser_pose
from uwlts.optics.nominal import nominal_calibration
from uwlts.optics.triangulation import reconstruct_pixels
from uwlts.optics.window import RayStatus
from uwlts.storage.capture import Capture, CaptureHeader
from uwlts.targets.detection.ellipse_bias import circle_centre_bias

# What a lens and a flat window leave of a plane beside its homography is smooth: the fifth degree describes it to a
# micrometre over a view 200 mm wide. Fewer points than three for each coefficient would be fitted, not smoothed.
_HIGHEST_DEGREE = 5
_LOWEST_DEGREE = 3
_POINTS_PER_TERM = 3
_X, _Y = np.eye(3)[:2]


@dataclass(frozen=True, eq=False)
class SmoothMap:
    """Smooth map from one plane to another: a homography and a polynomial for what it leaves."""

    homography: np.ndarray  # (3, 3)
    low: np.ndarray  # (2,); first corner of the box of the points it was fitted to: the polynomial's arguments are -1
    high: np.ndarray  # (2,); opposite corner, the arguments are 1
    degree: int  # total degree of the polynomial
    coefficients: np.ndarray  # (terms, 2); Legendre coefficients
    residuals: np.ndarray  # (N, 2); of the points it was fitted to

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """Images (M, 2) of points (M, 2)."""
        return self.coarsely(points) + _terms(points, self.low, self.high, self.degree) @ self.coefficients

    def coarsely(self, points: np.ndarray) -> np.ndarray:
        """Images (M, 2) by the homography alone, which stays sensible far outside the box."""
        return _project(self.homography, points)


@dataclass(frozen=True, eq=False)
class PlateMap(SmoothMap):
    """Map from pixels to the plane of the target (plate) in mm, fitted to the target's points.

    ``hull`` (K, 3) are the sides of the points' convex hull on the plate: outward normal and offset in mm.
    """

    hull: np.ndarray

    def beyond_mm(self, pixels: np.ndarray) -> np.ndarray:
        """Distances (M,) in mm at which pixels (M, 2) look outside the hull of the target's points; negative inside."""
        return np.max(self.coarsely(pixels) @ self.hull[:, :2].T + self.hull[:, 2], axis=1)

    def rms_mm(self) -> float:
        """Root mean square length of the residuals."""
        return float(np.sqrt(np.mean(np.sum(self.residuals**2, axis=1))))


def fit_plate_map(image: TargetImage, *, circle_diameter_mm: float | None = None) -> PlateMap:
    """Map from pixels to the plate through the points of one image.

    Where the points are circles of a diameter, their pixels are centres of the circles' images; the offsets from the
    images of their centres are taken out by the map itself: refraction that stretches the image outwards shifts the
    centres as much as perspective does.

    Raises
    ------
    CalibrationError
        There are too few points, or they determine no homography.
    RangeError
        A circle's image is no ellipse.
    """
    points, pixels = image.points_mm, image.pixels
    if circle_diameter_mm is not None:
        to_image = fit_smooth_map(points[:, :2], pixels)
        pixels = pixels - circle_centre_bias(
            lambda rim: to_image(rim[:, :2]), points, diameter_mm=circle_diameter_mm, axis_u=_X, axis_v=_Y
        )
    return PlateMap(**vars(fit_smooth_map(pixels, points[:, :2])), hull=ConvexHull(points[:, :2]).equations)


def fit_smooth_map(start: np.ndarray, end: np.ndarray) -> SmoothMap:
    """Smooth map from points (N, 2) to points (N, 2), by least squares.

    Raises CalibrationError: there are too few points, or they determine no homography.
    """
    counts = {d: (d + 1) * (d + 2) // 2 for d in range(_LOWEST_DEGREE, _HIGHEST_DEGREE + 1)}
    degree = max((d for d, count in counts.items() if _POINTS_PER_TERM * count <= len(start)), default=None)
    if degree is None:
        raise CalibrationError(
            f"only {len(start)} points of the target are seen; at least {_POINTS_PER_TERM * counts[_LOWEST_DEGREE]} "
            "are needed to find where on the target the stripe lies"
        )
    found = cv2.findHomography(np.ascontiguousarray(start), np.ascontiguousarray(end), method=0)[0]
    if found is None or not np.isfinite(found).all():
        raise CalibrationError(f"the {len(start)} points of the target determine no homography of image and target")
    low, high = start.min(axis=0), start.max(axis=0)
    left, terms = end - _project(found, start), _terms(start, low, high, degree)
    coefficients = np.linalg.lstsq(terms, left, rcond=None)[0]
    return SmoothMap(found, low, high, degree, coefficients, left - terms @ coefficients)


def _project(homography: np.ndarray, points: np.ndarray) -> np.ndarray:
    mapped = np.column_stack([points, np.ones(len(points))]) @ homography.T
    return mapped[:, :2] / mapped[:, 2:]


def _terms(points: np.ndarray, low: np.ndarray, high: np.ndarray, degree: int) -> np.ndarray:
    """Products of Legendre polynomials in both coordinates up to a total degree, (M, terms)."""
    first, second = ((2 * points - low - high) / (high - low)).T
    products = legendre.legvander2d(first, second, [degree, degree])
    powers = np.add.outer(np.arange(degree + 1), np.arange(degree + 1)).ravel()
    return products[:, powers <= degree]


_SAME_POSITION_MM = 1e-6  # rounding of positions stored as floating-point numbers
_ALONG_Z = 0.9  # cosine of the angle between the stage's direction and the laser's axis
_ORIGIN_POINTS = 100  # stripe points about the camera's axis on which the origin of the OCS rests


@dataclass(frozen=True, eq=False)
class PlateStripes:
    """Stripe points of all images on the plate: N points."""

    pixels: np.ndarray  # (N, 2)
    lines: np.ndarray  # (N,) int; profile line of each point
    centres_px: np.ndarray  # (N,); stripe's centre on the line
    plate_mm: np.ndarray  # (N, 2); place on the plate, in the target's frame
    pose: np.ndarray  # (N,) int; number of the image
    stage_mm: np.ndarray  # (N,); where the stage stood


def common_header(captures: Sequence[Capture]) -> CaptureHeader:
    """The first capture's header.

    Raises CalibrationError: there is no capture, one has no target, the others describe another arrangement, or the
    stage does not move along Z.
    """
    if not captures:
        raise CalibrationError("no capture of a target is given: the polynomials are fitted to nothing else")
    first = captures[0]

    def arrangement(capture: Capture) -> dict[str, Any]:
        header, camera = capture.header, capture.header.sensor.camera
        return {
            "image size": (camera.width_px, camera.height_px),
            "stripe_along": camera.stripe_along,
            "wavelength": header.sensor.laser.wavelength_nm,
            "medium": header.medium,
            "window mounted": camera.window.mounted,
            "stage_direction": header.stage_direction,
            "target": header.target,
        }

    for capture in captures:
        if capture.header.target is None:
            raise CalibrationError(f"{capture.path.name} does not describe its target: its header has none")
        for (name, own), other in zip(arrangement(capture).items(), arrangement(first).values(), strict=True):
            if own != other:
                raise CalibrationError(
                    f"{capture.path.name} does not belong to {first.path.name}: {name} is {own} against {other}"
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
    """Stripe points on the plate among or next to the target's points in the same image, the maps, and warnings.

    A point counts up to one spacing outside the hull of the target's points in the image, and up to half of one outside
    the pattern. Images without such points have no map.

    Raises CalibrationError: there are fewer positions than a polynomial of this degree has coefficients.
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
            warnings.append(f"stage position {image.stage_mm:g} mm: left out, the stripe does not fall on the target")
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
    """Z and Y (N,) of the stripe points in the OCS.

    The plate stands still, so in the OCS it moves against the stage. Y runs along the stripe on the plate, in the sense
    in which the described fan runs through the image. The origin is where the sensor as described sees the stripe
    points next to its camera's axis.
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
            "the sensor as described sees the sheet at none of the stripe points: check baseline, angle and "
            "stripe_along"
        )
    _, along_nominal, depth_nominal = seen.points_mm[known].T
    nominal_motion, motion = (values - np.median(values) for values in (depth_nominal, depth[known]))
    if np.sum(nominal_motion * motion) <= 0:
        raise CalibrationError(
            "the stripe moves through the image the other way than the stage's positions say: check the sign of the "
            f"captures' stage_direction, {header.stage_direction}, on which side the laser stands, and that the images "
            "are not turned by 180 deg or mirrored"
        )
    from_axis = np.hypot(*(stripes.pixels[known] - camera.principal_point()).T)
    middle = np.argsort(from_axis, kind="stable")[:_ORIGIN_POINTS]
    depth_shift = np.median(depth_nominal[middle] - depth[known][middle])
    return depth + depth_shift, along + np.median(along_nominal[middle] - along[known][middle])
