"""Stripes on spheres as evidence: which sphere each point lies on, and where the estimate starts."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from uwlts.calibration.joint.parameters import View
from uwlts.calibration.joint.sphere_scans import SphereScanEvidence
from uwlts.calibration.model import Calibration
from uwlts.capture import Capture
from uwlts.errors import CalibrationError, DescriptionError, EvaluationError
from uwlts.evaluate import parse_artefact
from uwlts.metrology.artefact_descriptions import SphereStandard
from uwlts.metrology.sphere_evaluation import evaluate_spheres
from uwlts.reconstruction import reconstruct_pixels
from uwlts.scan import find_stripes
from uwlts.stripe import StripeOptions

# More points of a scan tell hardly more: neighbours err together.
_MOST_POINTS = 6000
_FEWEST_POINTS = 100
"""Of an image, before thinning."""


@dataclass(frozen=True, eq=False)
class SphereStripes:
    """The stripe centres (N,) of a scan of spheres, the stage's positions (F,), and what is known of the spheres."""

    source: str
    frame: np.ndarray
    line: np.ndarray
    centre_px: np.ndarray
    stage_mm: np.ndarray
    stage_direction: np.ndarray
    standard: SphereStandard
    view: View


def sphere_stripes(capture: Capture, view: View, *, stripe: StripeOptions) -> SphereStripes:
    """Find the stripes of a scan of spheres.

    Raises
    ------
    DescriptionError
        The capture does not describe spheres.
    CaptureError
        No image shows a stripe.
    """
    try:
        standard = parse_artefact(capture.header.artefact or {})
    except EvaluationError as error:
        raise DescriptionError(f"{capture.path.name} does not describe its spheres: {error}") from error
    if not isinstance(standard, SphereStandard):
        raise DescriptionError(f"{capture.path.name} shows a {standard.kind}, where spheres are expected")
    found = find_stripes(capture, options=stripe)
    return SphereStripes(
        capture.path.name, found.frame, found.line, found.centre_px, capture.stage_mm[:],
        np.array(capture.header.stage_direction), standard, view,
    )  # fmt: skip


def sphere_evidence(
    stripes: SphereStripes, start: Calibration, *, medium_index: float, sizes_known: bool, image: int
) -> tuple[SphereScanEvidence, np.ndarray]:
    """Evidence and the start of its own parameters, by a calibration nearly as sought.

    Raises
    ------
    EvaluationError
        The points do not show the spheres.
    """
    along_width = start.stripe_along == "width"
    pixels = np.stack((stripes.line, stripes.centre_px) if along_width else (stripes.centre_px, stripes.line), axis=1)
    points = reconstruct_pixels(
        start, pixels.astype(np.float64), medium_index=medium_index, stage_mm=stripes.stage_mm[stripes.frame],
        stage_direction=stripes.stage_direction,
    ).points_mm  # fmt: skip
    there = np.flatnonzero(np.isfinite(points).all(axis=1))
    standard = stripes.standard
    evaluation = evaluate_spheres(points[there], standard)
    centres = np.array([sphere.centre_mm for sphere in evaluation.spheres])
    diameters = np.array([sphere.diameter_mm for sphere in evaluation.spheres])
    used = np.flatnonzero(np.isfinite(evaluation.deviation_mm))
    # At the spheres' rims few points are left, and those are doubtful.
    often = np.bincount(stripes.frame[there][used])[stripes.frame[there][used]] >= _FEWEST_POINTS
    used = used[often][:: -(-int(often.sum()) // _MOST_POINTS)]
    off = np.abs(np.linalg.norm(points[there][used, None] - centres, axis=2) - diameters / 2)
    kept = there[used]
    frames, frame = np.unique(stripes.frame[kept], return_inverse=True)
    transform = start.object_transform()
    rotation = transform[:3, :3]
    nominal = np.array(standard.diameters_mm)
    stated = standard.diameter_uncertainty_mm
    known = sizes_known and stated is not None
    evidence = SphereScanEvidence(
        view=stripes.view, pixels=pixels[kept].astype(np.float64), sphere=np.argmin(off, axis=1), frame=frame,
        stage_mm=stripes.stage_mm[frames], direction=rotation @ stripes.stage_direction,
        across_stage=_across(stripes.stage_direction) @ rotation.T, diameters_mm=nominal,
        diameter_std_mm=np.full(len(nominal), stated / 2 if known else np.inf), across=1 if along_width else 0,
        image=image, source=stripes.source,
    )  # fmt: skip
    own = np.concatenate(
        [(centres @ rotation.T + transform[:3, 3]).ravel(), diameters - nominal, np.zeros(len(frames))]
    )
    return evidence, own


def sphere_scans(
    scans: Sequence[SphereStripes], start: Calibration, indices: Sequence[float], *, sizes_known: bool
) -> tuple[list[tuple[SphereScanEvidence, np.ndarray]], list[str]]:
    """Evidence of every scan with the start of its own parameters, and warnings about scans left out.

    Raises
    ------
    CalibrationError
        The scans move along different directions.
    """
    found, warnings, image = [], [], 0
    if any(not np.allclose(scan.stage_direction, scans[0].stage_direction) for scan in scans):
        raise CalibrationError("the scans of spheres move along different directions: calibrate with one of them")
    for stripes in scans:
        index = 1.0 if stripes.view.medium is None else indices[stripes.view.medium]
        through = start if stripes.view.window else start.model_copy(update={"window": None})
        try:
            evidence, own = sphere_evidence(stripes, through, medium_index=index, sizes_known=sizes_known, image=image)
        except EvaluationError as error:
            warnings.append(f"{stripes.source}: left out, {error}")
            continue
        found.append((evidence, own))
        image += len(evidence.stage_mm)
    return found, warnings


def _across(direction: np.ndarray) -> np.ndarray:
    """Two unit vectors (2, 3) across a direction of the OCS and each other; along Y and Z for a motion along X."""
    second = np.cross((0.0, 0.0, 1.0) if abs(direction[2]) < 0.9 else (1.0, 0.0, 0.0), direction)
    second /= np.linalg.norm(second)
    return np.stack([second, np.cross(direction, second)])
