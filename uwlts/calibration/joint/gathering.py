"""Collection of evidence from captures, and of prior knowledge from descriptions, for the joint calibration."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np
from pydantic import JsonValue

from uwlts.calibration.camera.camera_parameters import DISTORTION, CameraOptions
from uwlts.calibration.camera.lens import LensChoice
from uwlts.calibration.capture_evidence import (
    AirEvidence,
    StepEvidence,
    common_sensor,
    explain_captures_without_stripe,
    find_air_evidence,
    find_approach,
    step_evidence,
)
from uwlts.calibration.joint.parameters import SHEET, Prior, ViewMedium, fan_priors, window_priors
from uwlts.calibration.joint.residuals import BENDS, SHIFT, STRETCH
from uwlts.calibration.joint.scanned_surfaces import SLOPES
from uwlts.calibration.sequential.sequential_calibration import CalibrationOptions, sources_of
from uwlts.errors import CalibrationError, DescriptionError, EvaluationError
from uwlts.model.artefacts import PipeStandard, PlaneStandard, SphereStandard, parse_artefact
from uwlts.model.calibration import CameraModel, WindowModel
from uwlts.model.parameter_keys import LensParameter, MediumIndex, ParameterKey, StageParameter, StepHeight
from uwlts.model.sensor import Medium, Sensor, Uncertainty
from uwlts.model.stripe import CaptureStripes
from uwlts.optics.brightness import fit_brightness_slopes, select_sharp_lines
from uwlts.runtime.progress import ProgressListener, ignore_progress
from uwlts.storage.capture import Capture
from uwlts.stripe import StripeSettings, find_stripes

_FEWEST_KEPT = 3  # images that must remain if some are rejected
_MOST_LEFT_OUT = 0.3  # fraction of the images: if more contradict the rest, it is unclear which are right
USUAL_DISTORTION: dict[ParameterKey, Prior] = {LensParameter.K1: Prior(0.0, 1 / 3), LensParameter.K2: Prior(0.0, 1.0)}
"""Size of the coefficients that every lens has: k1 is -1/3 for r = f angle, and smaller for most lenses. Images that do
not determine one then state what it does to the others: without it, a window or focal length takes its place."""
HELD = 1e-4
"""Standard uncertainty of the slopes of a held camera's rays: its focal length relative, 0.1 px of a centre at 1000 px.
A lens changes as much by two kelvins, and images that contradict it by ten times as much are noticed."""
Scanned = SphereStandard | PlaneStandard | PipeStandard


@dataclass(frozen=True, eq=False)
class Series:
    """Images of the target through the same window and medium.

    ``approaching`` says whether the stage moves the sensor towards the target; None if it moves in another direction.
    ``directions`` (3,) are the stage directions of the captures, OCS.
    """

    view: ViewMedium
    found: AirEvidence
    approaching: bool | None
    directions: Sequence[tuple[float, float, float]] = ()


@dataclass(frozen=True, eq=False)
class ScanStripes:
    """Stripe centres (N,) of a scan as ``found``, the stage's positions (F,), and the described object.

    ``blur_px`` (N,) is the possible shift by blur, ``slopes`` (N,) are those of the brightness
    (`uwlts.optics.brightness`).
    """

    source: str
    found: CaptureStripes
    blur_px: np.ndarray
    slopes: np.ndarray
    stage_mm: np.ndarray
    stage_direction: np.ndarray
    artefact: Scanned
    view: ViewMedium

    def image_names(self) -> list[str]:
        """Return capture and stage position of each of the F images."""
        return [f"{self.source}, at {position:g} mm" for position in self.stage_mm]

    def remove_images(self, sources: Collection[str]) -> "ScanStripes | None":
        """Remove images by name; return None if too few would remain."""
        left_out = np.array([name in sources for name in self.image_names()])
        seen = np.unique(self.found.frame)
        if not _remain_enough(int(np.sum(~left_out[seen])), len(seen)):
            return None
        kept = ~left_out[self.found.frame]
        return replace(self, found=self.found[kept], blur_px=self.blur_px[kept], slopes=self.slopes[kept])


@dataclass(frozen=True, eq=False)
class Gathered:
    """Evidence from all captures.

    ``sensor`` is described by the first capture, with the window as mounted in the medium of use. ``media`` maps names
    to media other than air. ``series`` are the target images for each window state and medium.
    """

    sensor: Sensor
    media: dict[str, Medium]
    series: list[Series]
    steps: list[tuple[StepEvidence, ViewMedium]]
    scans: list[ScanStripes]
    provenance: dict[str, JsonValue]
    warnings: list[str]

    def remove_images(self, sources: Collection[str]) -> "Gathered | None":
        """Remove images by name; return None if too few of a series, the steps or a scan would remain."""
        series = []
        for each in self.series:
            kept = [n for n, name in enumerate(each.found.names()) if name not in sources]
            if not _remain_enough(len(kept), len(each.found.images)):
                return None
            series.append(replace(each, found=each.found.only(np.array(kept), [each.found.images[n] for n in kept])))
        steps = [(step, view) for step, view in self.steps if step.source not in sources]
        scans = [kept for scan in self.scans if (kept := scan.remove_images(sources)) is not None]
        if not _remain_enough(len(steps), len(self.steps)) or len(scans) < len(self.scans):
            return None
        return replace(self, series=series, steps=steps, scans=scans)

    def indices(self, options: CalibrationOptions) -> list[float]:
        """Return the refractive indices of the media, as described or as given in the options."""
        wavelength = self.sensor.laser.wavelength_nm
        return [options.medium_index or medium.refractive_index(wavelength) for medium in self.media.values()]


def gather_jointly(
    targets: Sequence[Capture],
    steps: Sequence[Capture],
    scans: Sequence[Capture] = (),
    *,
    options: CalibrationOptions,
    progress: ProgressListener = ignore_progress,
) -> Gathered:
    """Find the target, the stripes on it, and the stripes on steps and scanned surfaces in all images.

    Raises CalibrationError if the captures are from different sensors, show no target or several targets, or use one
    name for different media. It is also raised if a capture is given twice (its noise would count twice), no step image
    shows a stripe, or a scan contains poses. Raises DescriptionError if a capture does not describe its target, step
    standard or scanned object correctly; CaptureError if a scan shows no stripe, or an image is damaged.
    """
    sensor, provenance = common_sensor([*targets, *steps, *scans]), sources_of(targets, steps, scans)
    media: dict[str, Medium] = {}
    views: dict[ViewMedium, list[Capture]] = {}
    for capture in targets:
        views.setdefault(_identify_view(capture, media), []).append(capture)
    series, on_steps, on_scans, warnings = [], [], [], []
    for view, captures in views.items():
        found = find_air_evidence(captures, stripe=options.stripe, progress=progress)
        warnings += found.warnings
        directions = [capture.header.stage_direction for capture in captures]
        series.append(Series(view, found, find_approach(captures), directions))
    for capture in steps:
        view, index = _identify_view(capture, media), options.medium_index
        found_steps, left_out = step_evidence([capture], medium_index=index, stripe=options.stripe, progress=progress)
        on_steps += [(step, view) for step in found_steps]
        warnings += left_out
    if steps and not on_steps:
        raise CalibrationError(explain_captures_without_stripe(steps))
    for capture in scans:
        same = options.same_water or options.earlier is not None
        name = capture.header.medium_name if same else f"{capture.header.medium_name} of the scans"
        on_scans.append(scan_stripes(capture, _identify_view(capture, media, name), stripe=options.stripe))
    seen = [capture.header.sensor for capture in [*steps, *targets, *scans]]
    sensor = next((each for each in seen if each.camera.window.mounted), sensor)
    return Gathered(sensor, media, series, on_steps, on_scans, provenance, warnings)


def _remain_enough(kept: int, images: int) -> bool:
    return kept == images or (kept >= _FEWEST_KEPT and images - kept <= _MOST_LEFT_OUT * images)


def scan_stripes(capture: Capture, view: ViewMedium, *, stripe: StripeSettings) -> ScanStripes:
    """Find the stripes of a scan.

    Raises DescriptionError if the capture does not describe spheres, a plane or a pipe; CaptureError if no image shows
    a stripe; CalibrationError if the images contain poses.
    """
    wanted = "a scan for calibration must describe spheres, a plane or a pipe as its artefact"
    if capture.header.artefact is None:
        raise DescriptionError(f"{capture.path.name} does not describe what it shows: {wanted}")
    try:
        artefact = parse_artefact(capture.header.artefact)
    except EvaluationError as error:
        raise DescriptionError(f"{capture.path.name} does not describe what it shows: {error}") from error
    if not isinstance(artefact, Scanned):
        raise DescriptionError(f"{capture.path.name} shows a {artefact.kind}: {wanted}")
    if np.isfinite(capture.pose).any():
        raise CalibrationError(
            f"{capture.path.name} contains poses. Scans for calibration must be moved by the stage only: use a capture "
            "without poses"
        )
    found = find_stripes(capture, options=stripe)
    sharp, blur = select_sharp_lines(found)
    found = found[sharp]
    stage = capture.stage_mm[:]
    return ScanStripes(
        source=capture.path.name,
        found=found,
        blur_px=blur,
        slopes=fit_brightness_slopes(found.frame, found.line, found.amplitude, stage, capture.exposure_ms[:]),
        stage_mm=stage,
        stage_direction=np.array(capture.header.stage_direction),
        artefact=artefact,
        view=view,
    )


def _identify_view(capture: Capture, media: dict[str, Medium], name: str | None = None) -> ViewMedium:
    """Return window state and medium of a capture; ``name`` replaces the medium's name."""
    header = capture.header
    window = header.sensor.camera.window.mounted
    if header.medium.kind == "air":
        return ViewMedium(window, None)
    name = name or header.medium_name
    if media.setdefault(name, header.medium) != header.medium:
        raise CalibrationError(f"the captures use '{name}' for different media: {media[name]} and {header.medium}")
    return ViewMedium(window, list(media).index(name))


def build_priors(
    gathered: Gathered,
    window: WindowModel | None,
    turns: np.ndarray,
    heights: dict[StepHeight, Prior],
    options: CalibrationOptions,
) -> dict[ParameterKey, Prior]:
    """Return priors of all global parameters except lens parameters without prior knowledge.

    ``turns`` (3,) are initial values of the sheet's rotations and shift; the window is as described, None without one.
    """
    sensor, known = gathered.sensor, gathered.sensor.uncertainty
    priors: dict[ParameterKey, Prior] = {}
    if window is not None:
        priors |= window_priors(window, known)
    for (name, medium), index in zip(gathered.media.items(), gathered.indices(options), strict=True):
        std = medium.index_uncertainty(sensor.laser.wavelength_nm, known)
        priors[MediumIndex(name)] = Prior(index, options.index_std or (known.index if options.medium_index else std))
    if known.focal_length == 0:
        described = CameraModel.from_description(sensor.camera)
        of_px = dict.fromkeys(DISTORTION, HELD)
        priors |= {
            key: Prior(described.parameters()[key.text], of_px.get(key.text, HELD * described.fx_px))
            for key in LensParameter
        }
    elif known.focal_length is not None and (window is not None or not gathered.media):
        focal, aspect = sensor.camera.focal_lengths_px(), options.camera.pixel_aspect
        keys = (LensParameter.FX, LensParameter.FY) if aspect is None else (LensParameter.F,)
        priors |= {key: Prior(px, known.focal_length * px) for key, px in zip(keys, focal, strict=False)}
    priors |= {key: Prior(float(value), np.inf) for key, value in zip(SHEET[:3], turns, strict=True)}
    priors |= fan_priors(sensor, wet=bool(gathered.media))
    if gathered.scans:
        priors |= dict.fromkeys(SLOPES, Prior(0.0, known.stage_lean()))
    if options.poses != "free" or gathered.scans:
        priors[StageParameter.SCALE] = Prior(0.0, known.stage_scale)
    if gathered.series:
        priors |= dict.fromkeys(BENDS, Prior(0.0, known.target_bow_mm))
        priors |= {key: Prior(0.0, std) for key, std in zip(STRETCH, known.stretch_by_axis(), strict=True)}
        priors[SHIFT] = Prior(0.0, known.target_stripe_px)
        priors |= dict.fromkeys(list_added_tangential(options.camera, known), Prior(0.0, known.tangential))
        if options.lens is not None and options.lens.distortion == "auto":
            priors |= usual_distortion(options.camera)
    return priors | heights


def hold_camera(gathered: Gathered, options: CalibrationOptions) -> CalibrationOptions:
    """Return options for a camera that is held if the description states it as exact, else the given ones.

    Raises DescriptionError if the options state what to estimate of it; CalibrationError without a window in a medium,
    which changes the lens.
    """
    if gathered.sensor.uncertainty.focal_length != 0 or options.earlier is not None:
        return options
    if options.lens not in (None, LensChoice()):
        raise DescriptionError("uncertainty.focal_length = 0 holds the camera: leave out `distortion` and `pixels`")
    if gathered.media and not gathered.sensor.camera.window.mounted:
        raise CalibrationError("a lens in contact with a medium is another one: a camera is held only behind a window")
    names = tuple(name for name, value in gathered.sensor.camera.distortion if value or name in ("p1", "p2"))
    return replace(options, lens=None, camera=CameraOptions(names))


def usual_distortion(camera: CameraOptions) -> dict[ParameterKey, Prior]:
    """Return prior knowledge of k1 and k2; none in a rational function, whose coefficients cancel each other."""
    return {} if "k4" in camera.distortion else USUAL_DISTORTION


def list_added_tangential(camera: CameraOptions, known: Uncertainty) -> tuple[LensParameter, ...]:
    """Return tangential distortion parameters that are estimated, with prior knowledge, although not requested."""
    asked = {"p1", "p2"} & {*camera.distortion} or known.tangential == 0
    return () if asked else (LensParameter.P1, LensParameter.P2)
