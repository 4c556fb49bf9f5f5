"""The calibration that stands for an earlier one and what images in new water added to it."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from uwlts.calibration.any_calibration import calibration_digest
from uwlts.calibration.joint.account import evidence_figures, outline
from uwlts.calibration.joint.estimate import Estimate, Evidence
from uwlts.calibration.joint.figures import joint_figures
from uwlts.calibration.joint.gathering import Gathered
from uwlts.calibration.joint.parameters import View
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
            "residuals": _figures(earlier, result, evidence_figures(result, evidence, sources, frame)),
            "provenance": _provenance(earlier, gathered, warnings),
        }
    )


def _figures(earlier: Calibration, result: Estimate, evidence: Mapping[str, Any]) -> dict[str, Any]:
    old, new = earlier.residuals, joint_figures(result)
    before, joint = old["joint"], new["joint"]
    count = len(before["std_before"])
    joint["std_before"] = [*before["std_before"], *joint["std_before"][count:]]
    for key in ("scatter_px", "shared_variance"):
        joint[key] = before[key] | joint[key]
    for key in ("residuals", "strays"):
        joint[key] += before[key]
    covered = before.get("covered", [])
    joint["images"] = [*before.get("images", []), *evidence["images"]]
    joint["covered"] = [*covered, *(_with_earlier(entry, covered) for entry in evidence["covered"])]
    return (
        old
        | {key: {**old.get(key, {}), **figures} for key, figures in new.items() if key != "joint"}
        | {"joint": before | joint}
    )


def _with_earlier(entry: dict[str, Any], covered: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """What is covered in new water, with the largest region covered in earlier water through the window."""
    wet = [other for other in covered if other["window"] and other["medium"] is not None]
    if not wet:
        return entry
    most = max(wet, key=lambda other: other["points"])
    depths = [*entry["camera_depth_mm"], *most["camera_depth_mm"]]
    return entry | {
        "points": entry["points"] + most["points"],
        "camera_depth_mm": [min(depths), max(depths)],
        "outline_mm": outline(np.array([*entry["outline_mm"], *most["outline_mm"]])).tolist(),
    }


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
