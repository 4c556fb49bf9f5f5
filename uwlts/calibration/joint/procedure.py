"""Joint calibration from any mix of captures: target images in air and in water, stripes on targets, steps, scans."""

from collections.abc import Sequence
from dataclasses import dataclass

from pydantic import JsonValue

from uwlts.calibration.joint.estimate import Estimate
from uwlts.calibration.joint.gathering import Gathered, gather_jointly
from uwlts.calibration.joint.policy import solve_consistently
from uwlts.calibration.joint.scanned_surfaces import ScannedPlane, SurfaceScanEvidence
from uwlts.calibration.joint.stored_estimate import build_calibration
from uwlts.calibration.sequential.sequential_calibration import CalibrationOptions
from uwlts.errors import CalibrationError
from uwlts.fitting.least_squares import robust_std
from uwlts.model.calibration import Calibration, KnownStage
from uwlts.runtime.progress import ProgressListener, ignore_progress
from uwlts.storage.capture import Capture


@dataclass(frozen=True, eq=False)
class JointResult:
    """Joint calibration with the data of its report."""

    calibration: Calibration
    estimate: Estimate
    warnings: list[str]


def calibrate_jointly(
    targets: Sequence[Capture],
    steps: Sequence[Capture] = (),
    scans: Sequence[Capture] = (),
    *,
    options: CalibrationOptions | None = None,
    progress: ProgressListener = ignore_progress,
) -> JointResult:
    """Calibrate a sensor from all captures at once.

    Each capture of a target, in air or in a medium, with or without the camera's window, is a separate placement,
    unless the poses are free. Its images with the laser on at the same stage positions show the sheet, too. In scans of
    spheres, a plane or a pipe the stage moves the sensor. The option ``refractions`` is ignored: windows are glass
    plates as described.

    Raises CalibrationError if no target is among the captures; the evidence does not determine the calibration or
    contradicts it; DescriptionError, CaptureError as for `gather_jointly`.
    """
    options = CalibrationOptions() if options is None else options
    return solve_jointly(gather_jointly(targets, steps, scans, options=options, progress=progress), options=options)


def solve_jointly(gathered: Gathered, *, options: CalibrationOptions) -> JointResult:
    """Calibrate from gathered evidence; errors as `calibrate_jointly`."""
    off_px: dict[str, list[float]] = {}
    try:
        problem, result, against, changes = solve_consistently(gathered, options)
        if against.all_against():
            for piece, parts in zip(problem.evidence, result.residuals, strict=True):
                for part in parts:
                    off_px.setdefault(piece.sources[part.image], []).append(robust_std(part.values))
            raise CalibrationError(against.refusal())
    except CalibrationError as error:
        table = "".join(series.found.table(off_px) for series in gathered.series)
        raise CalibrationError(f"{error}{table}") from error
    sensor, warnings = gathered.sensor, [*problem.warnings, *changes, *against.doubts]
    provenance: dict[str, JsonValue] = {
        **gathered.provenance,
        "poses": options.poses,
        "medium_index": options.medium_index,
        "known_before": sensor.uncertainty.model_dump(),
        "target": gathered.series[0].found.target.model_dump(mode="json"),
        "warnings": [*warnings],
    }
    calibration = build_calibration(result, problem.evidence, sensor, list(gathered.media.values()), provenance)
    scans = [
        e for e in problem.evidence if isinstance(e, SurfaceScanEvidence) and not isinstance(e.surface, ScannedPlane)
    ]
    if scans:
        direction = scans[0].stage_direction(problem.parameters, result.values)[0]
        stage = KnownStage(
            described=gathered.scans[0].stage_direction.tolist(),
            direction=(direction @ calibration.object_transform()[:3, :3]).tolist(),
        )
        calibration = calibration.model_copy(update={"stages": (stage,)})
    return JointResult(calibration, result, warnings)
