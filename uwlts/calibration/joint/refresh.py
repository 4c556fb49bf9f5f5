"""Refresh of a joint calibration by images in new water: its index, and the uncertainty of lengths in it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from pydantic import JsonValue

from uwlts.calibration.evidence import Progress
from uwlts.calibration.joint.consistency import Findings, findings
from uwlts.calibration.joint.derivatives import PARAMETERS as SHEET
from uwlts.calibration.joint.estimate import Estimate, Evidence, estimate
from uwlts.calibration.joint.evidence import StepProfileEvidence
from uwlts.calibration.joint.evidence_summary import joint_estimate, lens_and_window_figures, outline
from uwlts.calibration.joint.gathering import Gathered, gather_jointly, priors_of
from uwlts.calibration.joint.initial import line_start, step_profiles
from uwlts.calibration.joint.observability import Lengths, Region, estimate_in, lengths_over, regions
from uwlts.calibration.joint.parameters import EarlierEstimate, Parameters, View
from uwlts.calibration.joint.stored_estimate import StoredEstimate, found_estimate, require_joint
from uwlts.calibration.sequential import CalibrationOptions, sources_of
from uwlts.calibration.sheet import object_frame
from uwlts.model.any_calibration import calibration_digest, check_fits
from uwlts.model.calibration import Calibration, KnownMedium, KnownStage
from uwlts.model.errors import CalibrationError, RangeError
from uwlts.model.joint_estimate import CoveredRegion, JointEstimate, Origin
from uwlts.model.parameter_keys import MediumIndex
from uwlts.model.sensor import Medium, Sensor
from uwlts.optics.window import require_index
from uwlts.storage.calibration_file import read_calibration
from uwlts.storage.capture import Capture, opened_captures
from uwlts.stripe import StripeOptions


@dataclass(frozen=True)
class LengthChange:
    """The length over the volume that was known worst before.

    Attributes
    ----------
    before_mm, after_mm : standard uncertainty by the calibration
    longer_mm : by how much it is measured longer than by what was known before
    """

    length_mm: float
    before_mm: float
    after_mm: float
    longer_mm: float


@dataclass(frozen=True)
class WaterChange:
    """New water by its name, its index with its standard uncertainty before and after, and what a length gains."""

    name: str
    index_before: float
    std_before: float
    index: float
    std: float
    length: LengthChange | None

    def lines(self) -> list[str]:
        """The change in words."""
        lines = [
            f"index of {self.name}: {self.index_before:.5f} ± {self.std_before:.2g} before, {self.index:.5f} ± "
            f"{self.std:.2g} by the step (standard uncertainties)"
        ]
        if self.length is not None:
            length = self.length
            lines.append(
                f"a length of {length.length_mm:.0f} mm, the one known worst: ± {2 * length.before_mm:.4f} mm before, "
                f"± {2 * length.after_mm:.4f} mm now (k = 2, by the calibration); it is measured "
                f"{abs(length.longer_mm):.4f} mm {'longer' if length.longer_mm > 0 else 'shorter'}"
            )
        return lines


def water_changes(calibration: Calibration, result: Estimate) -> list[WaterChange]:
    """What an estimate to which an earlier one was known says of the media that are new in it and were seen.

    Parameters
    ----------
    calibration : that of the estimate
    """
    parameters, earlier = result.parameters, result.parameters.earlier
    if earlier is None:
        return []
    count, before = len(earlier.values), parameters.prior_mean()
    before[:count] = earlier.values
    covariance = np.diag(parameters.prior_std() ** 2)
    covariance[:count] = 0.0
    covariance[:count, :count] = earlier.covariance
    std_before, std = np.sqrt(np.diag(covariance)), result.std()
    seen = {region.view.medium: region for region in regions(calibration)}
    found = []
    for number, name in enumerate(parameters.media):
        key = MediumIndex(name)
        place = parameters.keys.index(key)
        if place < count or number not in seen:
            continue
        lengths = _lengths(calibration, seen[number])
        found.append(
            WaterChange(
                name,
                float(before[place]),
                float(std_before[place]),
                float(result.values[place]),
                std[key],
                None if lengths is None else _length_change(lengths, result, before, covariance),
            )
        )
    return found


def _lengths(calibration: Calibration, region: Region) -> Lengths | None:
    return lengths_over(calibration, estimate_in(calibration, region), region) if region.has_area() else None


def _length_change(lengths: Lengths, result: Estimate, before: np.ndarray, covariance: np.ndarray) -> LengthChange:
    std = lengths.std_mm(covariance)
    worst = int(np.argmax(std))
    return LengthChange(
        length_mm=float(lengths.length_mm[worst]),
        before_mm=float(std[worst]),
        after_mm=float(lengths.std_mm(result.covariance)[worst]),
        longer_mm=float(lengths.by_parameters[worst] @ (result.values - before)),
    )


def refreshed_calibration(
    earlier: Calibration,
    gathered: Gathered,
    result: Estimate,
    evidence: Sequence[Evidence],
    sources: Sequence[Mapping[int, str]],
    *,
    warnings: list[str],
) -> Calibration:
    """The calibration of an estimate to which an earlier one was known.

    Its figures are those of all evidence, earlier and new, the scatter of steps that of the new ones alone, and its
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
            | {name: earlier.figures(name) | figures for name, figures in lens_and_window_figures(result).items()},
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


def _provenance(earlier: Calibration, gathered: Gathered, warnings: list[str]) -> dict[str, JsonValue]:
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
_ANY_INDEX = 0.02  # standard uncertainty of the index of a liquid of which nothing is known
_TELLING = 4.0  # standard uncertainties by which steps contradict an index


@dataclass(frozen=True, eq=False)
class Refreshed:
    """A calibration for new water besides the old, and what that changed.

    Attributes
    ----------
    changes : one for each new water
    """

    calibration: Calibration
    changes: list[WaterChange]
    warnings: list[str]


def refresh(
    calibration: Calibration | str | Path,
    step: Sequence[Capture | str | Path],
    *,
    index: float | None = None,
    index_std: float | None = None,
    stripe: StripeOptions = StripeOptions(),
    progress: Progress | None = None,
) -> Refreshed:
    """Estimate all parameters again from a joint calibration and images of a step in new water.

    Parameters
    ----------
    calibration : Calibration or path
        All that it found, correlations included, is what is known before.
    step : sequence of Capture or path
        A step standard in water of another day. The index of that is a parameter of its own, even where water that is
        described alike was calibrated in.
    index : float, optional
        Refractive index of the new water as far as it is known, in place of the one that follows from the captures.
    index_std : float, optional
        Standard uncertainty of that index, in place of what follows from the sensor's description.
    stripe : StripeOptions, optional
        How stripes are found.
    progress : callable, optional
        Called with the name of the stage, the number of images done, and the number in all.

    Raises
    ------
    CalibrationError
        The calibration is not joint or has no window; a capture is of another sensor, in air, without the window, or
        was calibrated from already; no image shows both treads; the images contradict what is known.
    DescriptionError
        A capture does not describe its step.
    RangeError
        The index is not that of a medium, or its standard uncertainty is not positive.
    """
    if index is not None:
        require_index(index)
    if not isinstance(calibration, Calibration):
        calibration = read_calibration(calibration)
    _earlier(calibration)
    if not step:
        raise CalibrationError("no capture is given: take at least one image of a step in the new water")
    if index_std is not None and not index_std > 0:
        raise RangeError(f"the standard uncertainty of the index is {index_std:g}; it must be positive")
    options = CalibrationOptions(medium_index=index, stripe=stripe)
    with opened_captures(step) as captures:
        for capture in captures:
            _refuse_unsuitable(capture, calibration)
        gathered = gather_jointly([], captures, options=options, progress=progress)
    used = {source.sha256 for source in calibration.origin().captures()}
    again = [source.file for source in Origin.model_validate(gathered.provenance).captures() if source.sha256 in used]
    if again:
        raise CalibrationError(f"the calibration was made from {', '.join(again)} already: take a new image")
    return solve_refreshed(calibration, gathered, options=options, index_std=index_std)


def solve_refreshed(
    calibration: Calibration, gathered: Gathered, *, options: CalibrationOptions, index_std: float | None = None
) -> Refreshed:
    """The same from what the captures show, with the errors of `refresh`."""
    known = _earlier(calibration)
    gathered = _after(gathered, known.parameters.media)
    sensor, window = gathered.sensor, calibration.window
    profiles, left_out = step_profiles(gathered, calibration, window)
    warnings = [*gathered.warnings, *left_out]
    if not profiles:
        raise CalibrationError("; ".join(warnings))
    wavelength = calibration.wavelength_nm
    indices = [options.medium_index or medium.refractive_index(wavelength) for medium in gathered.media.values()]
    heights = {evidence.height: height for evidence, height in profiles}
    turns = known.values[[known.parameters.keys.index(key) for key in SHEET[:3]]]
    described = priors_of(gathered, window, indices, turns, heights, options)
    priors = known.parameters.priors | {k: p for k, p in described.items() if k not in known.parameters.priors}
    if index_std is not None:
        for name in gathered.media:
            priors[MediumIndex(name)] = replace(priors[MediumIndex(name)], std=index_std)
    earlier = EarlierEstimate(known.values, known.covariance)
    parameters = replace(
        known.parameters, media=(*known.parameters.media, *gathered.media), priors=priors, earlier=earlier
    )
    evidence = [profile for profile, _ in profiles]
    sources = [{profile.image: gathered.steps[profile.image][0].source} for profile in evidence]
    result, against = _judged(parameters, earlier, evidence, sources, sensor)
    if against.contradictions:
        raise CalibrationError(_other_water(parameters, earlier, evidence, sources, sensor) or against.refusal())
    warnings += against.doubts
    refreshed = refreshed_calibration(calibration, gathered, result, evidence, sources, warnings=warnings)
    return Refreshed(refreshed, water_changes(refreshed, result), warnings)


def _judged(
    parameters: Parameters,
    earlier: EarlierEstimate,
    evidence: Sequence[StepProfileEvidence],
    sources: Sequence[Mapping[int, str]],
    sensor: Sensor,
) -> tuple[Estimate, Findings]:
    global_values = parameters.start(earlier.values[: len(parameters.intrinsics.names)])
    local = [line_start(profile, parameters, global_values) for profile in evidence]
    result = estimate(parameters, evidence, global_values, local, uncertainty=sensor.uncertainty)
    return result, findings(result, evidence, sources, sensor=sensor)


def _other_water(
    parameters: Parameters,
    earlier: EarlierEstimate,
    evidence: Sequence[StepProfileEvidence],
    sources: Sequence[Mapping[int, str]],
    sensor: Sensor,
) -> str:
    """With which indices steps agree that contradict those described, in words; empty where with none."""
    new = [key for key in parameters.keys[len(earlier.values) :] if isinstance(key, MediumIndex)]
    free = {key: replace(parameters.priors[key], std=_ANY_INDEX) for key in new}
    without = replace(parameters, priors=parameters.priors | free)
    result, against = _judged(without, earlier, evidence, sources, sensor)
    if against.contradictions:
        return ""
    found = dict(zip(parameters.keys, result.values, strict=True))
    words = []
    for key in new:
        known, std = parameters.priors[key], result.std()[key]
        sigmas = abs(found[key] - known.mean) / np.hypot(std, known.std)
        if sigmas < _TELLING:
            continue
        words.append(
            f"the steps say that the {key.text} is {found[key]:.4f} +- {std:.2g}, {sigmas:.1f} standard uncertainties "
            f"from the {known.mean:.5f} +- {known.std:.2g} described"
        )
    advice = (
        ": check the step's height and the water's temperature and salinity in the captures, or give with --index and "
        "--index-std what is known of it; if they are right, the sensor has changed: calibrate again"
    )
    return "; ".join(words) + advice if words else ""


def _earlier(calibration: Calibration) -> StoredEstimate:
    known = found_estimate(calibration, _AIR)
    if calibration.window is None:
        raise CalibrationError(
            "the calibration has no window, through which new water would be seen: calibrate with images taken in "
            "water (--water, or --joint --step)"
        )
    return known


def _refuse_unsuitable(capture: Capture, calibration: Calibration) -> None:
    check_fits(capture.header, calibration, source=capture.path.name)
    header, name = capture.header, capture.path.name
    if header.sensor.name != calibration.sensor_name:
        raise CalibrationError(
            f"{name} was taken by the sensor '{header.sensor.name}', the calibration is that of "
            f"'{calibration.sensor_name}'"
        )
    if header.sensor.laser.wavelength_nm != calibration.wavelength_nm:
        raise CalibrationError(
            f"{name} was taken with a laser of {header.sensor.laser.wavelength_nm:g} nm, the calibration is for "
            f"{calibration.wavelength_nm:g} nm"
        )
    if header.medium.kind == "air":
        raise CalibrationError(f"{name} was taken in air: the index of new water shows in an image of a step in it")
    if not header.sensor.camera.window.mounted:
        raise CalibrationError(f"{name} was taken without the camera's window: new water is seen through that")


def _after(gathered: Gathered, media: Sequence[str]) -> Gathered:
    """The same with its media numbered after earlier ones, and named otherwise than those."""
    names: list[str] = []
    for name in gathered.media:
        taken = {*media, *names}
        numbered = (f"{name} {number}" for number in range(2, len(taken) + 3))
        names.append(name if name not in taken else next(other for other in numbered if other not in taken))
    steps = [
        (step, view if view.medium is None else View(view.window, len(media) + view.medium))
        for step, view in gathered.steps
    ]
    return replace(gathered, media=dict(zip(names, gathered.media.values(), strict=True)), steps=steps)
