"""The images of circles' centres, in place of the centres of their images, as seen through the window."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from uwlts.calibration.joint.estimate import Evidence
from uwlts.calibration.joint.observations import TargetEvidence
from uwlts.calibration.joint.parameters import Parameters
from uwlts.camera import project_through_window
from uwlts.targets import circle_centre_bias


def centred(
    parameters: Parameters, diameter_mm: float, found: Sequence[Evidence], global_values: np.ndarray,
    local: Sequence[np.ndarray],
) -> list[Evidence]:  # fmt: skip
    """The evidence with the images of the circles' centres instead of the centres of the circles' images."""
    return [
        _with_centres(e, parameters, global_values, o, diameter_mm) if isinstance(e, TargetEvidence) else e
        for e, o in zip(found, local, strict=True)
    ]


def _with_centres(
    evidence: TargetEvidence, parameters: Parameters, global_values: np.ndarray, local: np.ndarray, diameter_mm: float
) -> TargetEvidence:
    view, placement = evidence.view, evidence.placement
    camera, index = parameters.camera(global_values), parameters.medium_index(global_values, view)
    window = parameters.window_model(global_values) if view.window else None
    pixels = placement.pixels.copy()
    for image in np.unique(placement.image):
        pose, here = evidence.pose(parameters, global_values, local, image), placement.image == image

        def project(points: np.ndarray, pose: np.ndarray = pose) -> np.ndarray:
            seen = points @ pose[:3, :3].T + pose[:3, 3]
            return project_through_window(camera, window, seen, medium_index=index)

        pixels[here] -= circle_centre_bias(
            project, placement.points_mm[here], diameter_mm=diameter_mm, axis_u=np.eye(3)[0], axis_v=np.eye(3)[1]
        )
    return replace(evidence, placement=replace(placement, pixels=pixels))
