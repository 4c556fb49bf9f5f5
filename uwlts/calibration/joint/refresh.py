"""Refresh a joint calibration with images in new water: its index, and the uncertainty of lengths in it."""

import itertools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from pydantic import JsonValue

from uwlts.calibration.joint.diagnose import format_deviation
from uwlts.calibration.joint.estimate import Estimate, Evidence
from uwlts.calibration.joint.gathering import Gathered, build_priors, gather_jointly
from uwlts.calibration.joint.initial import build_step_evidence, estimate_line_start
from uwlts.calibration.joint.observability import compute_mesh_lengths, list_regions, read_region_estimate
from uwlts.calibration.joint.parameters import SHEET, EarlierEstimate, ViewMedium
from uwlts.calibration.joint.policy import solve_and_check
from uwlts.calibration.joint.problem import JointProblem
from uwlts.calibration.joint.stored_estimate import (
    StoredEstimate,
    append_independent,
    build_calibration,
    convex_outline,
    read_original_estimate,
    require_joint,
)
from uwlts.calibration.sequential.sequential_calibration import CalibrationOptions, sources_of
from uwlts.errors import CalibrationError, RangeError
from uwlts.model.calibration import Calibration, KnownStage, calibration_digest
from uwlts.model.joint_estimate import CoveredRegion, JointEstimate, Origin
from uwlts.model.parameter_keys import MediumIndex
from uwlts.model.sensor import Medium
from uwlts.model.short_text import Brief
from uwlts.optics.fitness import check_fits
from uwlts.optics.window import require_index
from uwlts.runtime.progress import ProgressListener, ignore_progress
from uwlts.storage.calibration_file import read_calibration
from uwlts.storage.capture import Capture, open_captures
from uwlts.stripe import StripeSettings


@dataclass(frozen=True)
class LengthChange:
    """The length in the volume with the largest previous uncertainty, and its change.

    ``before_mm`` and ``after_mm`` are its standard uncertainty from the calibration. ``longer_mm`` is the increase of
    its measured value.
    """

    length_mm: float
    before_mm: float
    after_mm: float
    longer_mm: float


@dataclass(frozen=True)
class WaterChange:
    """Index of a new water before and after the refresh, with standard uncertainties, and the change of a length."""

    name: str
    index_before: float
    std_before: float
    index: float
    std: float
    length: LengthChange | None

    def lines(self) -> list[str]:
        """Describe the change."""
        lines = [
            f"index of {self.name}: {self.index_before:.5f} ± {self.std_before:.2g} before, {self.index:.5f} ± "
            f"{self.std:.2g} from the step (standard uncertainties)"
        ]
        if (length := self.length) is not None:
            lines.append(
                f"least certain length, {length.length_mm:.0f} mm: ± {2 * length.before_mm:.4f} mm before, "
                f"± {2 * length.after_mm:.4f} mm now (k = 2, from the calibration); its measured value is "
                f"{abs(length.longer_mm):.4f} mm {'longer' if length.longer_mm > 0 else 'shorter'}"
            )
        return lines


def compute_water_changes(calibration: Calibration, result: Estimate, earlier: EarlierEstimate) -> list[WaterChange]:
    """Return the changes of the media that a calibration has in addition to an earlier one, if they were observed."""
    parameters, count = result.parameters, len(earlier.values)
    before = np.append(earlier.values, parameters.prior_mean()[count:])
    covariance = append_independent(earlier.covariance, parameters.prior_std()[count:].tolist())
    std_before, std = np.sqrt(np.diag(covariance)), result.std()
    seen = {region.view.medium: region for region in list_regions(calibration)}
    found = []
    for number, name in enumerate(parameters.media):
        key = MediumIndex(name)
        place = parameters.keys.index(key)
        if place < count or number not in seen:
            continue
        length = None
        if seen[number].has_area():
            lengths = compute_mesh_lengths(read_region_estimate(calibration, seen[number]), seen[number])
            known, now = lengths.std_mm(covariance), lengths.std_mm(result.covariance)
            worst = int(np.argmax(known))
            longer = lengths.by_parameters[worst] @ (result.values - before)
            figures = (lengths.length_mm[worst], known[worst], now[worst], longer)
            length = LengthChange(*map(float, figures))
        was, std_was, found_index = (float(each[place]) for each in (before, std_before, result.values))
        found.append(WaterChange(name, was, std_was, found_index, std[key], length))
    return found


def build_refreshed_calibration(
    earlier: Calibration, gathered: Gathered, result: Estimate, evidence: Sequence[Evidence], *, warnings: list[str]
) -> Calibration:
    """Build the calibration of an estimate that used an earlier one as prior knowledge.

    Its figures cover earlier and new evidence, except that the scatter of steps is from the new images only.
    ``std_before`` is the prior uncertainty before any evidence. The covered region in the new water includes that of
    earlier water, as it shows where the camera was calibrated. Stage directions are kept.
    """
    media = [*(known.medium for known in earlier.media), *gathered.media.values()]
    new = build_calibration(result, evidence, gathered.sensor, media, _extend_provenance(earlier, gathered, warnings))
    turned = new.object_transform()[:3, :3].T @ earlier.object_transform()[:3, :3]
    found = ("camera", "window", "sheet", "camera_from_object", "media", "provenance")
    figures = {name: earlier.figures(name) | new.figures(name) for name in new.residuals}
    return earlier.model_copy(
        update={name: getattr(new, name) for name in found}
        | {
            "stages": tuple(
                KnownStage(described=stage.described, direction=tuple((turned @ stage.direction).tolist()))
                for stage in earlier.stages
            ),
            "residuals": earlier.residuals | figures,
            "joint": _merge_estimates(require_joint(earlier), require_joint(new)),
        }
    )


def _merge_estimates(before: JointEstimate, new: JointEstimate) -> JointEstimate:
    """Merge the new estimate with the earlier estimate's record of its evidence."""
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
            "covered": before.covered + tuple(_extend_region(region, before.covered) for region in new.covered),
        }
    )


def _extend_region(region: CoveredRegion, covered: Sequence[CoveredRegion]) -> CoveredRegion:
    """Extend a region covered in new water by the largest region covered in earlier water through the window."""
    wet = [other for other in covered if other.window and other.medium is not None]
    if not wet:
        return region
    most = max(wet, key=lambda other: other.point_count)
    depths = (*region.camera_depth_mm, *most.camera_depth_mm)
    return region.model_copy(
        update={
            "point_count": region.point_count + most.point_count,
            "camera_depth_mm": (min(depths), max(depths)),
            "outline_mm": tuple(map(tuple, convex_outline(np.array([*region.outline_mm, *most.outline_mm])).tolist())),
        }
    )


def _extend_provenance(earlier: Calibration, gathered: Gathered, warnings: list[str]) -> dict[str, JsonValue]:
    old, new = earlier.provenance, sources_of([], []) | gathered.provenance
    sources = Origin.model_validate(new).captures()
    refreshed = {
        "digest": calibration_digest(earlier),
        **{key: old.get(key) for key in ("source", "date", "software")},
        "step_captures": [source.file for source in sources],
    }

    def more(key: str, added: Sequence[JsonValue]) -> list[JsonValue]:
        before = old.get(key)
        return [*(before if isinstance(before, list) else []), *added]

    return old | {
        "source": "calibration refreshed in new water",
        "date": new["date"],
        "software": new["software"],
        "step_captures": more("step_captures", [source.in_file() for source in sources]),
        "refreshed": more("refreshed", [refreshed]),
        "warnings": more("warnings", warnings),
    }


_AIR = Medium(kind="air")
_ANY_INDEX = 0.02  # standard uncertainty of the index of an unknown liquid
_CONTRADICTED = 4.0  # standard uncertainties beyond which steps contradict an index


@dataclass(frozen=True, eq=False, repr=False)
class Refreshed(Brief):
    """Calibration with new water in addition to the old, and the change for each new water."""

    calibration: Calibration
    changes: list[WaterChange]
    warnings: list[str]


def refresh(
    calibration: Calibration | str | Path,
    step: Sequence[Capture | str | Path],
    *,
    index: float | None = None,
    index_std: float | None = None,
    stripe: StripeSettings = None,
    progress: ProgressListener = ignore_progress,
) -> Refreshed:
    """Adapt a joint calibration to new water, or to another water temperature, with images of a step.

    The complete earlier estimate with its correlations is prior knowledge, and the new water's index is estimated. The
    images of the earlier calibration are not needed.

    Parameters
    ----------
    calibration : Calibration or path
        Joint calibration of the sensor.
    step : sequence of Capture or path
        Captures of the step standard in the new water. Its index is a new parameter, even if a calibrated water has the
        same description.
    index : float, optional
        Approximate refractive index of the new water. Default: the index that follows from the captures.
    index_std : float, optional
        Standard uncertainty of that index. Default: the value from the sensor's description. Use 0.001 if little is
        known about the water.
    stripe : StripeOptions or dict, optional
        As for `reconstruct`.
    progress : callable, optional
        Called with the number of images done, the total, and the name of the stage.

    Returns
    -------
    Refreshed
        Calibration with the new water in addition to the old, the change for each new water, and warnings.

    Raises
    ------
    CalibrationError
        The calibration is not joint or has no window; a capture is from another sensor, in air, without the window, or
        was already used; no image shows both faces; the images contradict the prior knowledge.
    DescriptionError
        A capture does not describe its step.
    RangeError
        The index is out of range, or its standard uncertainty is not positive.
    """
    if index is not None:
        require_index(index)
    if not isinstance(calibration, Calibration):
        calibration = read_calibration(calibration)
    _require_earlier(calibration)
    if not step:
        raise CalibrationError("`step` is empty: give at least one image of a step in the new water")
    if index_std is not None and not index_std > 0:
        raise RangeError(f"the standard uncertainty of the index is {index_std:g}; it must be positive")
    options = CalibrationOptions(medium_index=index, stripe=stripe)
    with open_captures(step) as captures:
        for capture in captures:
            _refuse_unsuitable(capture, calibration)
        gathered = gather_jointly([], captures, options=options, progress=progress)
    used = {source.sha256 for source in calibration.origin().captures()}
    again = [source.file for source in Origin.model_validate(gathered.provenance).captures() if source.sha256 in used]
    if again:
        raise CalibrationError(f"{', '.join(again)} was already used for this calibration: take a new image")
    return solve_refreshed(calibration, gathered, options=options, index_std=index_std)


def solve_refreshed(
    calibration: Calibration, gathered: Gathered, *, options: CalibrationOptions, index_std: float | None = None
) -> Refreshed:
    """Refresh a calibration from gathered evidence; errors as `refresh`."""
    known = _require_earlier(calibration)
    old = known.parameters
    gathered = _renumber_media(gathered, old.media)
    profiles, heights, left_out = build_step_evidence(gathered, calibration, calibration.window)
    warnings = [*gathered.warnings, *left_out]
    if not profiles:
        raise CalibrationError("; ".join(warnings))
    turns = known.values[[old.keys.index(key) for key in SHEET[:3]]]
    described = build_priors(gathered, calibration.window, turns, heights, options)
    priors = old.priors | {key: prior for key, prior in described.items() if key not in old.keys}
    if index_std is not None:
        priors |= {key: replace(priors[key], std=index_std) for key in map(MediumIndex, gathered.media)}
    earlier = EarlierEstimate(known.values, known.covariance)
    parameters = replace(old, media=(*old.media, *gathered.media), priors=priors, earlier=earlier)
    start = parameters.start(earlier.values[: len(parameters.intrinsics.names)])
    lines = [estimate_line_start(profile, parameters, start) for profile in profiles]
    problem = JointProblem(parameters, profiles, start, lines, gathered.sensor, None, warnings)
    result, against = solve_and_check(problem)
    if against.all_against():
        raise CalibrationError(_explain_by_index(problem, gathered.media) or against.refusal())
    warnings += against.doubts
    refreshed = build_refreshed_calibration(calibration, gathered, result, profiles, warnings=warnings)
    return Refreshed(refreshed, compute_water_changes(refreshed, result, earlier), warnings)


def _explain_by_index(problem: JointProblem, media: Iterable[str]) -> str:
    """Describe an index of new media that makes contradicting steps consistent, or return an empty text."""
    known = {key: problem.parameters.priors[key] for key in map(MediumIndex, media)}
    free = problem.parameters.priors | {key: replace(prior, std=_ANY_INDEX) for key, prior in known.items()}
    result, against = solve_and_check(replace(problem, parameters=replace(problem.parameters, priors=free)))
    found, std = dict(zip(result.parameters.keys, result.values.tolist(), strict=True)), result.std()
    off = {key: abs(found[key] - prior.mean) / float(np.hypot(std[key], prior.std)) for key, prior in known.items()}
    return "; ".join(
        format_deviation(key, found[key], prior.mean, prior.std, sigmas=off[key])
        for key, prior in known.items()
        if off[key] >= _CONTRADICTED and not against.all_against()
    )


def _require_earlier(calibration: Calibration) -> StoredEstimate:
    known = read_original_estimate(calibration, _AIR)
    if calibration.window is None:
        raise CalibrationError(
            "the calibration has no window, so it cannot be refreshed for new water: calibrate with images taken in "
            "water (`water`, or `joint` and `step`)"
        )
    return known


def _refuse_unsuitable(capture: Capture, calibration: Calibration) -> None:
    if doubts := check_fits(capture.header, calibration, source=capture.path.name):
        raise CalibrationError("; ".join(doubts))
    sensor, wavelength = capture.header.sensor, capture.header.sensor.laser.wavelength_nm
    if wavelength != calibration.wavelength_nm:
        reason = f"with a laser of {wavelength:g} nm; the calibration is for {calibration.wavelength_nm:g} nm"
    elif capture.header.medium.kind == "air":
        reason = "in air; expected an image of a step in the new water"
    elif not sensor.camera.window.mounted:
        reason = "without the camera's window; expected an image through it"
    else:
        return
    raise CalibrationError(f"{capture.path.name} was taken {reason}")


def _renumber_media(gathered: Gathered, media: Sequence[str]) -> Gathered:
    """Renumber the media after earlier ones, and rename those with an earlier name."""
    renamed: dict[str, Medium] = {}
    for name, medium in gathered.media.items():
        names = itertools.chain([name], (f"{name} {number}" for number in itertools.count(2)))
        renamed[next(other for other in names if other not in {*media, *renamed})] = medium
    steps = [
        (step, view if view.medium is None else ViewMedium(view.window, len(media) + view.medium))
        for step, view in gathered.steps
    ]
    return replace(gathered, media=renamed, steps=steps)
