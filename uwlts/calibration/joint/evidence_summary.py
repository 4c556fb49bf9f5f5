"""The joint estimate as a calibration holds it, with a summary of its evidence: fit of each image, covered regions."""

from collections.abc import Mapping, Sequence

import numpy as np
from pydantic import JsonValue
from scipy.spatial import ConvexHull, QhullError

from uwlts.calibration.joint.estimate import Estimate, Evidence
from uwlts.calibration.joint.evidence import TARGET, StepProfileEvidence
from uwlts.calibration.joint.noise import outliers
from uwlts.calibration.joint.parameters import View
from uwlts.calibration.joint.scanned_surfaces import SurfaceScanEvidence
from uwlts.model.errors import CalibrationError
from uwlts.model.joint_estimate import CoveredRegion, ImageFit, JointEstimate
from uwlts.model.parameter_keys import LensParameter, WindowParameter


def joint_estimate(
    result: Estimate, evidence: Sequence[Evidence], sources: Sequence[Mapping[int, str]], object_frame: np.ndarray
) -> JointEstimate:
    """The estimate as a calibration holds it.

    Parameters
    ----------
    evidence : what it was made from
    sources : for every piece of evidence the names of its images by their numbers
    object_frame : (4, 4); ``T_camera_object`` of the OCS
    """
    images = []
    lit: dict[View, list[np.ndarray]] = {}
    for piece, parts, names in zip(evidence, result.residuals, sources, strict=True):
        for part in parts:
            left_out = outliers(part, result.noise[part.kind])
            used = part.values[~left_out]
            images.append(
                ImageFit(
                    source=names[part.image],
                    kind=part.kind,
                    rms_px=float(np.sqrt(np.mean(used**2))) if len(used) else None,
                    residual_count=len(part.values),
                    outlier_count=int(left_out.sum()),
                )
            )
            if part.kind != TARGET:
                lit.setdefault(piece.view, []).append(_stripe_pixels(piece, part.image)[~left_out])
    return JointEstimate(
        parameters=result.parameters.keys,
        values=tuple(result.values.tolist()),
        std=tuple(result.std().values()),
        std_before=tuple(float(std) if np.isfinite(std) else None for std in result.parameters.prior_std()),
        covariance=tuple(map(tuple, result.covariance.tolist())),
        nominal_sheet=result.parameters.sheet.nominal(),
        scatter_px={kind: noise.sigma_px for kind, noise in result.noise.items()},
        shared_variance={kind: noise.together for kind, noise in result.noise.items()},
        residual_count=sum(len(r.values) for parts in result.residuals for r in parts),
        outlier_count=result.outliers,
        rounds=result.rounds,
        stopped=result.stopped,
        images=tuple(images),
        covered=tuple(_covered(result, view, np.vstack(pixels), object_frame) for view, pixels in lit.items()),
    )


def lens_and_window_figures(result: Estimate) -> dict[str, dict[str, JsonValue]]:
    """Standard uncertainties of lens and window, by the names that sequential calibrations give them in files."""
    std, camera = result.std(), dict[str, JsonValue]()
    camera["std"] = {key.text: value for key, value in std.items() if isinstance(key, LensParameter)}
    if TARGET in result.noise:
        camera["sigma_px"] = result.noise[TARGET].sigma_px
    figures = {"camera": camera}
    if WindowParameter.DISTANCE in std:
        figures["window"] = {"std_mm": std[WindowParameter.DISTANCE]}
    return figures


def _stripe_pixels(evidence: Evidence, image: int) -> np.ndarray:
    if isinstance(evidence, StepProfileEvidence):
        return evidence.pixels
    if isinstance(evidence, SurfaceScanEvidence):
        return evidence.pixels[evidence.frame == image - evidence.image]
    return evidence.stripe_pixels[evidence.stripe_image == image]


def _covered(result: Estimate, view: View, pixels: np.ndarray, object_frame: np.ndarray) -> CoveredRegion:
    seen = result.parameters.on_sheet(result.values, view, pixels)
    if seen is None:
        raise CalibrationError("a stripe that was used meets no sheet by the joint estimate")
    points = seen.points
    at = (object_frame[:3, 1:3].T @ (points - object_frame[:3, 3:4])).T
    return CoveredRegion(
        medium=view.medium,
        name="air" if view.medium is None else result.parameters.media[view.medium],
        window=view.window,
        point_count=len(at),
        camera_depth_mm=(float(points[2].min()), float(points[2].max())),
        outline_mm=tuple(map(tuple, np.round(outline(at), 3).tolist())),
    )


def outline(at: np.ndarray) -> np.ndarray:
    """Corners (K, 2) of the convex hull; of points on a line its ends."""
    try:
        return at[ConvexHull(at).vertices]
    except QhullError:
        along = np.linalg.svd(at - at.mean(axis=0), full_matrices=False)[2][0]
        order = (at - at.mean(axis=0)) @ along
        return at[[int(np.argmin(order)), int(np.argmax(order))]]
