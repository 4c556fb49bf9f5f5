"""The calibration that stands for an earlier one and what images in new water added to it."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from uwlts.calibration.any_calibration import calibration_digest
from uwlts.calibration.joint.estimate import Estimate, Evidence
from uwlts.calibration.joint.evidence_summary import joint_estimate, lens_and_window_figures, outline
from uwlts.calibration.joint.gathering import Gathered
from uwlts.calibration.joint.parameters import View
from uwlts.calibration.joint.stored import require_joint
from uwlts.calibration.joint_estimate import CoveredRegion, JointEstimate
from uwlts.calibration.model import Calibration, KnownMedium, KnownStage
from uwlts.calibration.procedure import sources_of
from uwlts.calibration.sheet import object_frame


def refreshed_calibration(
    earlier: Calibration, gathered: Gathered, result: Estimate, evidence: Sequence[Evidence],
    sources: Sequence[Mapping[int, str]], *, warnings: list[str],
) -> Calibration:  # fmt: skip
    """The calibration of an estimate to which an earlier one was known.

    Its figures tell of all evidence, earlier and new, the scatter of steps of the new ones alone, and its
    ``std_before`` of what was known before any. Where the camera's pixels were calibrated in earlier water they are in
    the new as well, so that the volume is the same. Directions of stages stay as they were found.
    """
    parameters, values = result.parameters, result.values
    sheet = parameters.sheet_model(values)
    frame = object_frame(sheet, laser_axis=parameters.sheet.axis)
    turned = frame[:3, :3].T @ earlier.object_transform()[:3, :3]
    media = [*(known.medium for known in earlier.media), *gathered.media.values()]
    return earlier.model_copy(
        update={
            "camera": parameters.camera(values),
            "window": parameters.window_model(values),
            "sheet": sheet,
            "camera_from_object": tuple(map(tuple, frame.tolist())),
            "stages": tuple(
                KnownStage(described=stage.described, direction=tuple((turned @ stage.direction).tolist()))
                for stage in earlier.stages
            ),
            "media": tuple(
                KnownMedium(medium=medium, index=parameters.medium_index(values, View(True, number)))
                for number, medium in enumerate(media)
            ),
            "residuals": earlier.residuals
            | {
                name: {**earlier.residuals.get(name, {}), **figures}
                for name, figures in lens_and_window_figures(result).items()
            },
            "joint": _joint(require_joint(earlier), joint_estimate(result, evidence, sources, frame)),
            "provenance": _provenance(earlier, gathered, warnings),
        }
    )


def _joint(before: JointEstimate, new: JointEstimate) -> JointEstimate:
    """The new estimate with what the earlier one knew of all evidence before."""
    fields = {name: getattr(new, name) for name in JointEstimate.model_fields}
    return before.model_copy(
        update=fields
        | {
            "std_before": before.std_before + new.std_before[len(before.std_before) :],
            "scatter_px": before.scatter_px | new.scatter_px,
            "shared_variance": before.shared_variance | new.shared_variance,
            "residual_count": before.residual_count + new.residual_count,
            "outlier_count": before.outlier_count + new.outlier_count,
            "images": before.images + new.images,
            "covered": before.covered + tuple(_with_earlier(region, before.covered) for region in new.covered),
        }
    )


def _with_earlier(region: CoveredRegion, covered: Sequence[CoveredRegion]) -> CoveredRegion:
    """What is covered in new water, with the largest region covered in earlier water through the window."""
    wet = [other for other in covered if other.window and other.medium is not None]
    if not wet:
        return region
    most = max(wet, key=lambda other: other.point_count)
    depths = (*region.camera_depth_mm, *most.camera_depth_mm)
    return region.model_copy(
        update={
            "point_count": region.point_count + most.point_count,
            "camera_depth_mm": (min(depths), max(depths)),
            "outline_mm": tuple(map(tuple, outline(np.array([*region.outline_mm, *most.outline_mm])).tolist())),
        }
    )


def _provenance(earlier: Calibration, gathered: Gathered, warnings: list[str]) -> dict[str, Any]:
    old, new = earlier.provenance, sources_of([], []) | gathered.provenance
    refreshed = {
        "digest": calibration_digest(earlier),
        **{key: old.get(key) for key in ("source", "date", "software")},
        "step_captures": [source["file"] for source in new["step_captures"]],
    }
    return old | {
        "source": "calibration refreshed in new water",
        "date": new["date"],
        "software": new["software"],
        "step_captures": [*old.get("step_captures", []), *new["step_captures"]],
        "refreshed": [*old.get("refreshed", []), refreshed],
        "warnings": [*old.get("warnings", []), *warnings],
    }
