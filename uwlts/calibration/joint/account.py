"""What a joint calibration keeps of its evidence: how well each image fits, and the region of the sheet it covers."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from uwlts.calibration.joint.estimate import Estimate, Evidence
from uwlts.calibration.joint.noise import strays
from uwlts.calibration.joint.observations import TARGET, StepProfileEvidence
from uwlts.calibration.joint.parameters import View
from uwlts.calibration.joint.surface_scans import SurfaceScanEvidence


def evidence_figures(
    result: Estimate, evidence: Sequence[Evidence], sources: Sequence[Mapping[int, str]], object_frame: np.ndarray
) -> dict[str, Any]:
    """Figures for the calibration's file.

    Parameters
    ----------
    result : Estimate
    evidence : sequence
        What it was made from.
    sources : sequence of mapping
        For every piece of evidence the names of its images by their numbers.
    object_frame : (4, 4)
        ``T_camera_object`` of the OCS.

    Returns
    -------
    dict
        ``images``: source, kind, rms in px of what was used, number of residuals and of strays. ``covered``: for each
        of what the camera looked through the outline of the stripes in Y and Z of the OCS.
    """
    images = []
    lit: dict[View, list[np.ndarray]] = {}
    for piece, parts, names in zip(evidence, result.residuals, sources, strict=True):
        for part in parts:
            left_out = strays(part, result.noise[part.kind])
            used = part.values[~left_out]
            images.append(
                {
                    "source": names[part.image],
                    "kind": part.kind,
                    "rms_px": float(np.sqrt(np.mean(used**2))) if len(used) else None,
                    "residuals": len(part.values),
                    "strays": int(left_out.sum()),
                }
            )
            if part.kind != TARGET:
                lit.setdefault(piece.view, []).append(_stripe_pixels(piece, part.image)[~left_out])
    covered = [_covered(result, view, np.vstack(pixels), object_frame) for view, pixels in lit.items()]
    return {"images": images, "covered": covered}


def _stripe_pixels(evidence: Evidence, image: int) -> np.ndarray:
    if isinstance(evidence, StepProfileEvidence):
        return evidence.pixels
    if isinstance(evidence, SurfaceScanEvidence):
        return evidence.pixels[evidence.frame == image - evidence.image]
    return evidence.stripe_pixels[evidence.stripe_image == image]


def _covered(result: Estimate, view: View, pixels: np.ndarray, object_frame: np.ndarray) -> dict[str, Any]:
    points = result.parameters.on_sheet(result.values, view, pixels).points
    at = (object_frame[:3, 1:3].T @ (points - object_frame[:3, 3:4])).T
    return {
        "medium": view.medium,
        "name": "air" if view.medium is None else result.parameters.media[view.medium],
        "window": view.window,
        "points": len(at),
        "camera_depth_mm": [float(points[2].min()), float(points[2].max())],
        "outline_mm": np.round(outline(at), 3).tolist(),
    }


def outline(at: np.ndarray) -> np.ndarray:
    """Corners (K, 2) of the convex hull; of points on a line its ends."""
    try:
        return at[ConvexHull(at).vertices]
    except QhullError:
        along = np.linalg.svd(at - at.mean(axis=0), full_matrices=False)[2][0]
        order = (at - at.mean(axis=0)) @ along
        return at[[int(np.argmin(order)), int(np.argmax(order))]]
