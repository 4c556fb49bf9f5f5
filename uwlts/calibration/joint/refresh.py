"""A joint calibration carried over to new water by images of a step in it; what it found is what is known before."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from uwlts.calibration.any_calibration import check_fits
from uwlts.calibration.evidence import Progress
from uwlts.calibration.joint.contradictions import Findings, findings
from uwlts.calibration.joint.earlier import EarlierEstimate
from uwlts.calibration.joint.estimate import Estimate, estimate
from uwlts.calibration.joint.gathering import Gathered, gather_jointly
from uwlts.calibration.joint.observations import StepProfileEvidence
from uwlts.calibration.joint.parameters import Parameters, View
from uwlts.calibration.joint.priors import priors_of
from uwlts.calibration.joint.refreshed_calibration import refreshed_calibration
from uwlts.calibration.joint.sheet_derivatives import PARAMETERS as SHEET
from uwlts.calibration.joint.step_start import line_start, step_profiles
from uwlts.calibration.joint.stored import StoredEstimate, found_estimate
from uwlts.calibration.joint.water_change import WaterChange, water_changes
from uwlts.calibration.model import Calibration
from uwlts.calibration.parameter_keys import MediumIndex
from uwlts.calibration.procedure import CalibrationOptions
from uwlts.calibration.sources import captures_in
from uwlts.capture import Capture
from uwlts.errors import CalibrationError, RangeError
from uwlts.sensor import Medium, Sensor

_AIR = Medium(kind="air")
_ANY_INDEX = 0.02
"""Standard uncertainty of the index of a liquid of which nothing is known."""
_TELLING = 4.0
"""Standard uncertainties by which steps must contradict an index to be told as doing so."""


@dataclass(frozen=True, eq=False)
class Refreshed:
    """A calibration for new water besides the old, and what that changed.

    Attributes
    ----------
    calibration : Calibration
    changes : list of WaterChange
        One for each new water.
    warnings : list of str
    """

    calibration: Calibration
    changes: list[WaterChange]
    warnings: list[str]


def refresh(
    calibration: Calibration,
    steps: Sequence[Capture],
    *,
    options: CalibrationOptions | None = None,
    index_std: float | None = None,
    progress: Progress | None = None,
) -> Refreshed:
    """Estimate all parameters again from a joint calibration and images of a step in new water.

    Parameters
    ----------
    calibration : Calibration
        All that it found, correlations included, is what is known before.
    steps : sequence of Capture
        A step standard in water of another day. The index of that is a parameter of its own, even where water that is
        described alike was calibrated in.
    options : CalibrationOptions
        Of these ``stripe`` and ``medium_index`` count.
    index_std : float, optional
        How well the new water's index is known before, in place of what follows from the sensor's description.
    progress : callable, optional

    Raises
    ------
    CalibrationError
        The calibration is not joint or has no window; a capture is of another sensor, in air, without the window, or
        was calibrated from already; no image shows both treads; the images contradict what is known.
    DescriptionError
        A capture does not describe its step.
    RangeError
        The index's standard uncertainty is not positive.
    """
    _earlier(calibration)
    if not steps:
        raise CalibrationError("no capture is given: take at least one image of a step in the new water")
    if index_std is not None and not index_std > 0:
        raise RangeError(f"the standard uncertainty of the index is {index_std:g}; it must be positive")
    for capture in steps:
        _refuse_unsuitable(capture, calibration)
    options = CalibrationOptions() if options is None else options
    gathered = gather_jointly([], steps, options=options, progress=progress)
    used = {source.sha256 for source in calibration.origin().captures()}
    again = [source["file"] for source in captures_in(gathered.provenance) if source["sha256"] in used]
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
        ": check the step's height and the water's temperature and salinity in the captures, or tell with --index and "
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
