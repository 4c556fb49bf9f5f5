"""Stripes on spheres, a plane or a pipe as evidence: where these are, and where the estimate starts."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import assert_never

import numpy as np

from uwlts.calibration.joint.parameters import View
from uwlts.calibration.joint.scanned_surfaces import Cylinder, Plane, Spheres, Surface, SurfaceScanEvidence, across_of
from uwlts.metrology.artefacts import evaluate_pipe, evaluate_plane
from uwlts.metrology.spheres import evaluate_spheres
from uwlts.model.artefacts import Pipe, PlaneStandard, SphereStandard, parse_artefact
from uwlts.model.calibration import Calibration
from uwlts.model.errors import CalibrationError, DescriptionError, EvaluationError
from uwlts.model.sensor import Sensor
from uwlts.optics.brightness import beside_sheet, sharp_lines, slopes_of_brightness
from uwlts.optics.reconstruction import reconstruct_pixels
from uwlts.storage.capture import Capture
from uwlts.stripe import StripeOptions, find_stripes

Scanned = SphereStandard | PlaneStandard | Pipe

_MOST_POINTS = 2000  # more points of a scan add little: neighbours err together
_FEWEST_POINTS = 100  # of an image, before thinning
_STEEPEST = 0.3
"""Slope of the brightness, per mm of the stage, beyond which the place that the light comes from is uncertain."""


@dataclass(frozen=True, eq=False)
class ScanStripes:
    """The stripe centres (N,) of a scan, the stage's positions (F,), and what is known of what was scanned.

    ``slopes`` (N,) are those of the brightness (`uwlts.optics.brightness.slopes_of_brightness`).
    """

    source: str
    frame: np.ndarray
    line: np.ndarray
    centre_px: np.ndarray
    width_px: np.ndarray
    slopes: np.ndarray
    stage_mm: np.ndarray
    stage_direction: np.ndarray
    artefact: Scanned
    view: View


def scan_stripes(capture: Capture, view: View, *, stripe: StripeOptions) -> ScanStripes:
    """Find the stripes of a scan.

    Raises
    ------
    DescriptionError
        The capture does not describe spheres, a plane or a pipe.
    CaptureError
        No image shows a stripe.
    CalibrationError
        The images carry poses of their own.
    """
    wanted = "a scan to calibrate from shows spheres, a plane or a pipe, described as its artefact"
    if capture.header.artefact is None:
        raise DescriptionError(f"{capture.path.name} does not say what it shows: {wanted}")
    try:
        artefact = parse_artefact(capture.header.artefact)
    except EvaluationError as error:
        raise DescriptionError(f"{capture.path.name} does not describe what it shows: {error}") from error
    if not isinstance(artefact, Scanned):
        raise DescriptionError(f"{capture.path.name} shows a {artefact.kind}: {wanted}")
    if np.isfinite(capture.pose).any():
        raise CalibrationError(
            f"the images of {capture.path.name} carry poses: in a scan to calibrate from the stage alone moves the "
            "sensor, take one without poses"
        )
    found = find_stripes(capture, options=stripe)
    found = found[sharp_lines(found)[0]]
    stage = capture.stage_mm[:]
    return ScanStripes(
        capture.path.name,
        found.frame,
        found.line,
        found.centre_px,
        found.width_px,
        slopes_of_brightness(found.frame, found.line, found.amplitude, stage, capture.exposure_ms[:]),
        stage,
        np.array(capture.header.stage_direction),
        artefact,
        view,
    )


def surface_scan(
    stripes: ScanStripes, start: Calibration, sensor: Sensor, *, medium_index: float, sizes_known: bool, image: int
) -> tuple[SurfaceScanEvidence, np.ndarray]:
    """Evidence and the start of its local parameters, by a calibration nearly as sought.

    Raises EvaluationError: the points do not show what was scanned.
    """
    along_width = start.stripe_along == "width"
    pixels = np.stack((stripes.line, stripes.centre_px) if along_width else (stripes.centre_px, stripes.line), axis=1)
    points = reconstruct_pixels(
        start,
        pixels.astype(np.float64),
        medium_index=medium_index,
        stage_mm=stripes.stage_mm[stripes.frame],
        stage_direction=stripes.stage_direction,
    ).points_mm
    beside = beside_sheet(
        start,
        sensor,
        stripes.line,
        stripes.centre_px,
        stripes.width_px,
        stripes.slopes,
        medium_index=medium_index,
        stage_direction=stripes.stage_direction.tolist(),
    )
    points = points + beside
    # At the rims few points are left, and those are doubtful, as are those where the brightness changes fast.
    often = np.bincount(stripes.frame)[stripes.frame] >= _FEWEST_POINTS
    good = often & (np.abs(stripes.slopes) < _STEEPEST) & np.isfinite(points).all(axis=1)
    if not good.any():
        raise EvaluationError(f"no image shows it on {_FEWEST_POINTS} profile lines, sharp and evenly bright")
    there = np.flatnonzero(good)
    there = there[:: -(-len(there) // _MOST_POINTS)]
    transform = start.object_transform()
    used, surface, local = _surface(stripes.artefact, points[there], transform, sizes_known=sizes_known)
    kept = there[used]
    frames, frame = np.unique(stripes.frame[kept], return_inverse=True)
    rotation, direction = transform[:3, :3], stripes.stage_direction
    evidence = SurfaceScanEvidence(
        view=stripes.view,
        pixels=pixels[kept].astype(np.float64),
        beside_mm=rotation @ beside[kept].T,
        surface=surface,
        frame=frame,
        stage_mm=stripes.stage_mm[frames],
        direction=rotation @ direction,
        across_stage=across_of(direction) @ rotation.T,
        across=1 if along_width else 0,
        image=image,
        source=stripes.source,
    )
    return evidence, np.append(local, np.zeros(len(frames)))


def surface_scans(
    scans: Sequence[ScanStripes], start: Calibration, sensor: Sensor, indices: Sequence[float], *, sizes_known: bool
) -> tuple[list[tuple[SurfaceScanEvidence, np.ndarray]], list[str]]:
    """Evidence of every scan with the start of its local parameters, and warnings about scans left out.

    Raises CalibrationError: the scans move along different directions.
    """
    found, warnings, image = [], [], 0
    if any(not np.allclose(scan.stage_direction, scans[0].stage_direction) for scan in scans):
        raise CalibrationError("the scans move along different directions: calibrate with those along one of them")
    for stripes in scans:
        index = 1.0 if stripes.view.medium is None else indices[stripes.view.medium]
        through = start if stripes.view.window else start.model_copy(update={"window": None})
        try:
            evidence, local = surface_scan(
                stripes, through, sensor, medium_index=index, sizes_known=sizes_known, image=image
            )
        except EvaluationError as error:
            warnings.append(f"{stripes.source}: left out, {error}")
            continue
        found.append((evidence, local))
        image += len(evidence.stage_mm)
    return found, warnings


def _surface(
    artefact: Scanned, points: np.ndarray, transform: np.ndarray, *, sizes_known: bool
) -> tuple[np.ndarray, Surface, np.ndarray]:
    """The surface through points (N, 3) of the OCS, in the camera frame.

    Returns
    -------
    used : (N,) bool
        Points that lie on it.
    surface : Surface
    local : (k,)
        Start of its local parameters.

    Raises EvaluationError: the points do not show what was scanned.
    """
    rotation = transform[:3, :3]

    def std(expanded_mm: float | None) -> float:
        """Standard uncertainty of a certificate's expanded one; infinite where it states none."""
        return expanded_mm / 2 if sizes_known and expanded_mm else np.inf

    def in_camera(point_mm: Sequence[float]) -> np.ndarray:
        return rotation @ point_mm + transform[:3, 3]

    match artefact:
        case SphereStandard():
            spheres = evaluate_spheres(points, artefact)
            used = np.isfinite(spheres.deviation_mm)
            centres = np.array([sphere.centre_mm for sphere in spheres.spheres])
            diameters = np.array([sphere.diameter_mm for sphere in spheres.spheres])
            off = np.abs(np.linalg.norm(points[used][:, None] - centres, axis=2) - diameters / 2)
            nominal, spacings = np.array(artefact.diameters_mm), np.array(artefact.spacings_mm)
            surface = Spheres(
                diameters_mm=nominal,
                diameter_std_mm=np.full(len(nominal), std(artefact.diameter_uncertainty_mm)),
                spacings_mm=spacings,
                spacing_std_mm=np.full(len(spacings), std(artefact.spacing_uncertainty_mm)),
                sphere=np.argmin(off, axis=1),
            )
            return used, surface, np.append((centres @ rotation.T + transform[:3, 3]).ravel(), diameters - nominal)
        case PlaneStandard():
            plane = evaluate_plane(points, artefact)
            normal = np.array(plane.normal)
            surface = Plane(in_camera(plane.point_mm), rotation @ normal, across_of(normal) @ rotation.T)
            return np.isfinite(plane.deviation_mm), surface, np.zeros(3)
        case Pipe():
            pipe = evaluate_pipe(points, artefact)
            axis = np.array(pipe.axis)
            surface = Cylinder(
                point_mm=in_camera(pipe.point_mm),
                axis=rotation @ axis,
                across=across_of(axis) @ rotation.T,
                diameter_mm=artefact.diameter_mm,
                diameter_std_mm=std(artefact.diameter_uncertainty_mm),
            )
            return np.isfinite(pipe.deviation_mm), surface, np.array([0.0, 0.0, 0.0, 0.0, pipe.diameter_error_mm])
        case _:
            assert_never(artefact)
