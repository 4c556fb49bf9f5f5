"""Evidence of captures and prior knowledge from descriptions, as the joint calibration needs them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from pydantic import JsonValue

from uwlts.calibration.evidence import AirEvidence, Progress, StepEvidence, air_evidence, no_stripe_in, step_evidence
from uwlts.calibration.joint.derivatives import PARAMETERS as SHEET
from uwlts.calibration.joint.initial_scans import ScanStripes, scan_stripes
from uwlts.calibration.joint.parameters import Prior, View
from uwlts.calibration.joint.scanned_surfaces import SLOPES
from uwlts.calibration.sequential import CalibrationOptions, common_sensor, sources_of
from uwlts.calibration.target_images import Placement, placements
from uwlts.model.calibration import WindowModel
from uwlts.model.errors import CalibrationError
from uwlts.model.joint_estimate import Origin
from uwlts.model.parameter_keys import (
    MediumIndex,
    ParameterKey,
    SheetParameter,
    StageParameter,
    StepHeight,
    TargetParameter,
    WindowParameter,
)
from uwlts.model.sensor import Medium, Sensor
from uwlts.storage.capture import Capture


@dataclass(frozen=True, eq=False)
class Series:
    """Images of the target seen through the same.

    Attributes
    ----------
    approaching : whether the stage moves the sensor towards the target; None where it moves otherwise
    names : of the captures
    """

    view: View
    found: AirEvidence
    approaching: bool | None
    names: list[str]

    def placements(self, *, free: bool) -> list[Placement]:
        """The images joined by the stage's motion, or one by one."""
        return placements(self.found.images, approaching=None if free else self.approaching)


@dataclass(frozen=True, eq=False)
class Gathered:
    """All that the captures show.

    Attributes
    ----------
    sensor : as the first capture describes it, with the window as mounted in the medium of use
    media : media other than air by their names
    series : target images, by what they were seen through
    steps : list of (StepEvidence, View)
    """

    sensor: Sensor
    media: dict[str, Medium]
    series: list[Series]
    steps: list[tuple[StepEvidence, View]]
    scans: list[ScanStripes]
    provenance: dict[str, JsonValue]
    warnings: list[str]

    def views(self) -> list[View]:
        """Through what each series of target images, each step image and each scan was seen."""
        return [s.view for s in [*self.series, *self.scans]] + [view for _, view in self.steps]

    def sources(self, *, free: bool) -> list[dict[int, str]]:
        """Capture and frame of every target image of every placement, in the order of `series_start`."""
        return [
            {
                int(image): f"{part.names[part.found.frames[image][0]]}, frame {part.found.frames[image][1]}"
                for image in np.unique(placement.image)
            }
            for part in self.series
            for placement in part.placements(free=free)
        ]


def gather_jointly(
    targets: Sequence[Capture],
    steps: Sequence[Capture],
    scans: Sequence[Capture] = (),
    *,
    options: CalibrationOptions,
    progress: Progress | None = None,
) -> Gathered:
    """Find the target, the stripes on it and those on steps and scanned surfaces in all images.

    Raises
    ------
    CalibrationError
        The captures come from different sensors, show no target or several, mean different media by one name, or one
        is given twice; no step image shows a stripe, or a scan carries poses.
    DescriptionError
        A capture describes its target wrongly, or not its step standard or what it scans.
    CaptureError
        A scan shows no stripe, or an image is damaged.
    """
    sensor = common_sensor([*targets, *steps, *scans])
    provenance = sources_of(targets, steps, scans)
    _refuse_twice(provenance)
    media: dict[str, Medium] = {}
    views: dict[View, list[Capture]] = {}
    for capture in targets:
        views.setdefault(_view(capture, media), []).append(capture)
    series, warnings = [], []
    for view, captures in views.items():
        found = air_evidence(captures, stripe=options.stripe, progress=progress)
        warnings += found.warnings
        series.append(Series(view, found, _approaching(captures), [c.path.name for c in captures]))
    on_steps = []
    for capture in steps:
        view = _view(capture, media)
        found_steps, left_out = step_evidence(
            [capture], medium_index=options.medium_index, stripe=options.stripe, progress=progress
        )
        on_steps += [(step, view) for step in found_steps]
        warnings += left_out
    if steps and not on_steps:
        raise CalibrationError(no_stripe_in(steps))
    on_scans = []
    for capture in scans:
        name = capture.header.medium_name if options.same_water else f"{capture.header.medium_name} of the scans"
        on_scans.append(scan_stripes(capture, _view(capture, media, name), stripe=options.stripe))
    windowed = [c for c in [*steps, *targets, *scans] if c.header.sensor.camera.window.mounted]
    return Gathered(
        sensor=windowed[0].header.sensor if windowed else sensor,
        media=media,
        series=series,
        steps=on_steps,
        scans=on_scans,
        provenance=provenance,
        warnings=warnings,
    )


def refuse_two_lenses(gathered: Gathered) -> None:
    """CalibrationError where a lens that looks straight into a medium would have to be the one seen otherwise."""
    views = gathered.views()
    for view in views:
        if view.medium is None or view.window or all(other == view for other in views):
            continue
        raise CalibrationError(
            f"some captures in {list(gathered.media)[view.medium]} were taken without a window and others were not: a "
            "lens that touches the medium is another lens; calibrate it by itself, or set window.mounted"
        )


def _refuse_twice(provenance: Mapping[str, JsonValue]) -> None:
    """CalibrationError where two captures are the same, as their noise would count as two independent ones."""
    names: dict[str, str] = {}
    for source in Origin.model_validate(provenance).captures():
        if source.sha256 in names:
            raise CalibrationError(f"{names[source.sha256]} and {source.file} are the same capture: give it once")
        names[source.sha256] = source.file


def _view(capture: Capture, media: dict[str, Medium], name: str | None = None) -> View:
    """Through what a capture was taken; ``name`` is the medium's own unless given."""
    header = capture.header
    window = header.sensor.camera.window.mounted
    if header.medium.kind == "air":
        return View(window, None)
    name = name or header.medium_name
    if media.setdefault(name, header.medium) != header.medium:
        raise CalibrationError(f"the captures mean different media by '{name}': {media[name]} and {header.medium}")
    return View(window, list(media).index(name))


def _approaching(captures: Sequence[Capture]) -> bool | None:
    """Whether the stage moves the sensor towards the target; None where it does not move along the OCS's Z."""
    along = {float(capture.header.stage_direction[2]) for capture in captures}
    return min(along) > 0 if min(map(abs, along)) >= 0.9 and min(along) * max(along) > 0 else None


def priors_of(
    gathered: Gathered,
    window: WindowModel | None,
    indices: list[float],
    turns: np.ndarray,
    heights: dict[StepHeight, Prior],
    options: CalibrationOptions,
) -> dict[ParameterKey, Prior]:
    """What is known of all global parameters but the lens's.

    Parameters
    ----------
    window : as described
    indices : of the media, as described
    turns : (3,); where the sheet's turns and shift start
    heights : of the step standards
    """
    sensor, known = gathered.sensor, gathered.sensor.uncertainty
    priors: dict[ParameterKey, Prior] = {}
    if window is not None:
        tilt = float(np.tan(np.radians(known.window_tilt_deg)))
        normal = np.array(window.normal) / window.normal[2]
        priors |= {
            WindowParameter.DISTANCE: Prior(window.distance_mm, known.window_distance_mm),
            WindowParameter.SLOPE_X: Prior(float(normal[0]), tilt),
            WindowParameter.SLOPE_Y: Prior(float(normal[1]), tilt),
            WindowParameter.THICKNESS: Prior(window.thickness_mm, known.glass_thickness_mm),
            WindowParameter.GLASS_INDEX: Prior(window.glass_index, known.glass_index),
        }
    for (name, medium), index in zip(gathered.media.items(), indices, strict=True):
        std = medium.index_uncertainty(sensor.laser.wavelength_nm, known)
        priors[MediumIndex(name)] = Prior(index, known.index if options.medium_index else std)
    priors |= {key: Prior(float(value), np.inf) for key, value in zip(SHEET[:3], turns, strict=True)}
    bow, turn = np.radians([known.bow_deg, known.laser_window_tilt_deg])
    priors[SheetParameter.BOW] = Prior(float(np.radians(sensor.laser.bow_deg)), float(bow))
    if gathered.media and sensor.laser.window.mounted:
        priors[SheetParameter.WINDOW_TURN] = Prior(float(np.arcsin(sensor.laser.window.normal()[0])), float(turn))
    if gathered.scans:
        lean = float(np.tan(np.radians(known.stage_alignment_deg)))
        priors |= dict.fromkeys(SLOPES, Prior(0.0, lean))
    if options.poses != "free" or gathered.scans:
        priors[StageParameter.SCALE] = Prior(0.0, known.stage_scale)
    priors[TargetParameter.BOW] = Prior(0.0, known.target_bow_mm)
    return priors | heights
