"""Evidence in captures for a calibration: target points, stripes on the target, stripes on the step standard."""

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
from pydantic import ValidationError

from uwlts.calibration.camera.camera_parameters import TargetImage
from uwlts.calibration.camera.image_quality import explain_missing_target
from uwlts.calibration.target_stripes import TargetStripe, stripe_on_target
from uwlts.errors import CalibrationError, DescriptionError, ImageError, TargetError, describe_problems
from uwlts.model.artefacts import StepStandard
from uwlts.model.sensor import CaptureHeader, Sensor
from uwlts.runtime.progress import ProgressListener, ignore_progress
from uwlts.runtime.workers import map_in_threads
from uwlts.storage.capture import Capture
from uwlts.stripe import StripeOptions, StripeSettings, explain_missing_stripe, extract_stripe
from uwlts.stripe.capture_stripes import FEWEST_LINES, find_stripe_direction
from uwlts.targets import Target, TargetView, parse_target

ALONG_Z = 0.9  # least cosine of the angle between the stage's direction and the laser's axis (OCS Z)
SAME_POSITION_MM = 1e-6  # rounding of positions stored as floating-point numbers
_MANY_OUTLIERS = 0.05  # fraction of a capture's stripe points above which rejected points give a warning
_MOST_ROWS = 30  # of the table of images in a refusal
_LOOKED_AT = 15  # images of a capture that are searched for the reason of a missing stripe


@dataclass(frozen=True, eq=False)
class AirEvidence:
    """Target points and stripes in the captures in air."""

    target: Target
    images: list[TargetImage]  # images with the target, one placement per capture
    frames: list[tuple[int, int]]  # capture and frame of each of them
    stripes: list[np.ndarray]  # (N, 2) each; stripe pixels on the target at the position of the image, or empty
    warnings: list[str]  # rejected images, with the reason
    no_stripe: str = ""  # reason why there is no stripe at all; else empty
    outliers: list[int] = field(default_factory=list)  # rejected stripe pixels of each, off the curve
    captures: list[str] = field(default_factory=list)  # their names

    def names(self) -> list[str]:
        """Return capture and frame of each image."""
        return [f"{self.captures[capture]}, frame {frame}" for capture, frame in self.frames]

    def table(self, off_px: Mapping[str, Sequence[float]]) -> str:
        """Return lines on the images, the worst first; ``off_px`` lists the scatter of points and stripe by name."""
        rows = [*zip(self.names(), self.images, self.stripes, strict=True)]
        rows.sort(key=lambda row: -max(off_px.get(row[0], (0.0,))))
        lines = [f"{'image':<32}{'stage, mm':>10}{'points':>8}{'stripe':>8}  scatter of both, px"]
        for name, image, stripe in rows[:_MOST_ROWS]:
            off = ", ".join(f"{each:.2f}" for each in off_px.get(name, ()))
            lines.append(f"{name:<32}{image.stage_mm:>10g}{len(image.pixels):>8}{len(stripe):>8}  {off or '-'}")
        return "\n".join(["", *lines, *([f"and {len(rows) - _MOST_ROWS} more"] if len(rows) > _MOST_ROWS else [])])

    def only(self, chosen: np.ndarray, images: list[TargetImage]) -> "AirEvidence":
        """Return the chosen images, with their points replaced."""
        some = chosen.tolist()
        return replace(
            self,
            images=images,
            frames=[self.frames[n] for n in some],
            stripes=[self.stripes[n] for n in some],
            outliers=[self.outliers[n] for n in some],
        )


@dataclass(frozen=True, eq=False)
class StepEvidence:
    """Stripe (N, 2) on a step standard, with the standard, the medium's index and the source.

    ``index_std`` is the index's standard uncertainty, ``travel_mm`` the displacement of the sensor by the stage, OCS.
    """

    pixels: np.ndarray
    standard: StepStandard
    medium_index: float
    source: str
    travel_mm: tuple[float, float, float] = (0.0, 0.0, 0.0)
    index_std: float = 0.0

    def capture(self) -> str:
        """Return the name of the capture."""
        return self.source.rsplit(", frame ", 1)[0]


def find_air_evidence(
    captures: Sequence[Capture], *, stripe: StripeSettings = None, progress: ProgressListener = ignore_progress
) -> AirEvidence:
    """Find the target in images with the laser off, and the stripe in images with it on at the same positions.

    Raises CalibrationError if the captures describe no target, or different ones, or no image shows it;
    DescriptionError if a target's description cannot be read.
    """
    targets = [parse_target(capture.header.target) for capture in captures if capture.header.target is not None]
    if len(targets) < len(captures) or not captures:
        raise CalibrationError("a capture for the calibration in air must describe its target, but its header does not")
    if any(target != targets[0] for target in targets):
        raise CalibrationError("the captures in air show different targets: calibrate with one target at a time")
    total, done = sum(map(len, captures)), 0
    images, frames, views, stripes, outliers, warnings = [], [], [], [], [], []
    reasons: Counter[str] = Counter()
    for number, capture in enumerate(captures):
        first = len(images)
        detect = partial(detect_target, capture, targets[0], number)
        for (frame, _), found in map_in_threads(detect, capture.frames(laser_on=False)):
            if isinstance(found, str):
                reasons[found] += 1
                warnings.append(f"{capture.path.name}, frame {frame}: left out, {found}")
            else:
                view, target_image = found
                images.append(target_image)
                frames.append((number, frame))
                views.append(view)
                stripes.append(np.empty((0, 2)))
                outliers.append(0)
            done = _report(progress, "target", done, total)
        positions = np.array([image.stage_mm for image in images[first:]])
        on_target = partial(_find_target_stripe, capture, stripe, first, views[first:], positions, targets[0])
        for (frame, _), found in map_in_threads(on_target, capture.frames(laser_on=True)):
            if isinstance(found, str):
                warnings.append(f"{capture.path.name}, frame {frame}: stripe left out, {found}")
            else:
                place, on = found
                stripes[place] = np.vstack([stripes[place], on.pixels])
                outliers[place] += on.outliers
            done = _report(progress, "target", done, total)
        rejected, kept = sum(outliers[first:]), sum(map(len, stripes[first:]))
        if rejected > _MANY_OUTLIERS * (rejected + kept):
            share = 100 * rejected / (rejected + kept)
            warnings.append(
                f"{capture.path.name}: {share:.0f} % of the stripe on the target was left out, as it is off the curve "
                "of the rest: reflections, a second line, or a plate that is not flat"
            )
    if not images:
        why = _explain_missing_target(captures, targets[0], reasons)
        raise CalibrationError(f"the target was found in no image of {_list_names(captures)}: {why}")
    names = [capture.path.name for capture in captures]
    no_stripe = "" if any(map(len, stripes)) else explain_captures_without_stripe(captures)
    return AirEvidence(targets[0], images, frames, stripes, warnings, no_stripe, outliers, names)


def common_sensor(
    captures: Sequence[Capture], *, also: Callable[[CaptureHeader], Mapping[str, object]] = lambda header: {}
) -> Sensor:
    """Return the first capture's sensor; ``also`` returns further values by name that all captures must share.

    Raises CalibrationError if another capture has other optics or values, or there is no capture.
    """
    if not captures:
        raise CalibrationError("no capture is given: a calibration needs one of a target")
    sensor = captures[0].header.sensor

    def shared(capture: Capture) -> dict[str, object]:
        camera, laser = capture.header.sensor.camera, capture.header.sensor.laser
        return {
            "image size": f"{camera.width_px} x {camera.height_px} px",
            "image offset": camera.offset_px,
            "stripe_along": camera.stripe_along,
            "wavelength": f"{laser.wavelength_nm:g} nm",
            **also(capture.header),
        }

    for capture in captures[1:]:
        own, other = shared(capture), shared(captures[0])
        differ = ", ".join(
            f"its {name} is {own[name]} instead of {other[name]}"
            for name in own
            if own[name] != other[name] and None not in (own[name], other[name])
        )
        if differ:
            camera = capture.header.sensor.camera
            turned = (camera.height_px, camera.width_px) == (sensor.camera.width_px, sensor.camera.height_px)
            raise CalibrationError(
                f"{capture.path.name} does not fit {captures[0].path.name}: {differ}"
                + ("; the images of one are rotated by 90 deg" if turned and "size" in differ else "")
            )
    return sensor


def find_approach(captures: Sequence[Capture]) -> bool | None:
    """Return whether the stage moves the sensor towards the target, which is perpendicular to the OCS's Z.

    None if it does not move the sensor along Z, or in opposite directions in different captures.
    """
    along = [capture.header.stage_direction[2] for capture in captures]
    return min(along) > 0 if min(map(abs, along)) >= ALONG_Z and min(along) * max(along) > 0 else None


def step_evidence(
    captures: Sequence[Capture],
    *,
    medium_index: float | None = None,
    stripe: StripeSettings = None,
    progress: ProgressListener = ignore_progress,
) -> tuple[list[StepEvidence], list[str]]:
    """Find stripes on the step standard in all images with the laser on; return them with warnings.

    ``medium_index`` replaces the index of the captures' medium at the laser's wavelength.

    Raises DescriptionError if a capture does not describe its step standard.
    """
    total, done = sum(int(np.count_nonzero(capture.laser_on)) for capture in captures), 0
    found, warnings = [], []
    for capture in captures:
        try:
            standard = StepStandard.model_validate(capture.header.artefact)
        except ValidationError as error:
            problems = describe_problems(error).removeprefix(": ")
            raise DescriptionError(f"{capture.path.name} does not describe its step standard: {problems}") from error
        wavelength, known = capture.header.sensor.laser.wavelength_nm, capture.header.sensor.uncertainty
        index, index_std = medium_index, known.index
        if index is None:
            index = capture.header.medium.refractive_index(wavelength)
            index_std = capture.header.medium.index_uncertainty(wavelength, known)
        for (frame, _), pixels in map_in_threads(partial(_find_stripe, capture, stripe), capture.frames(laser_on=True)):
            if isinstance(pixels, str):
                warnings.append(f"{capture.path.name}, frame {frame}: stripe left out, {pixels}")
            else:
                x, y, z = (float(capture.stage_mm[frame]) * np.array(capture.header.stage_direction)).tolist()
                source = f"{capture.path.name}, frame {frame}"
                found.append(StepEvidence(pixels, standard, index, source, (x, y, z), index_std))
            done = _report(progress, "step", done, total)
    return found, warnings


def explain_captures_without_stripe(captures: Sequence[Capture]) -> str:
    """Return the reason why no stripe was found in captures; for captures of a target, none on the target."""
    header, count = captures[0].header, sum(int(np.count_nonzero(capture.laser_on)) for capture in captures)
    if not count:
        return f"{_list_names(captures)}: no image with the laser on; take one at every position"
    along, where = header.sensor.camera.stripe_along, f"laser images of {_list_names(captures)}"
    lit = [image for capture in captures for image in _choose_laser_images(capture, _LOOKED_AT)]
    full_dn = header.saturation_dn
    if any(find_stripe_direction(image, stripe_along=along, saturation=full_dn) == "along" for image in lit):
        return f"the {where} with a stripe were taken at other stage positions than the images with the target"
    reason = explain_missing_stripe(lit, stripe_along=along, full_dn=full_dn)
    return f"no stripe in any of the {count} {where}: {reason}"


def _list_names(captures: Sequence[Capture]) -> str:
    return ", ".join(capture.path.name for capture in captures)


def _explain_missing_target(captures: Sequence[Capture], target: Target, reasons: Counter[str]) -> str:
    """Return the reason why no image shows the target; ``reasons`` counts the faults of images with the laser off."""
    if not any(map(len, captures)):
        return "there are no images in it"
    for image in [image for capture in captures for image in _choose_laser_images(capture, 3)]:
        with suppress(TargetError, CalibrationError):
            target.detect(image)
            return (
                "images marked as taken with the laser on show it instead: lamp and laser images are exchanged, or "
                "no image is marked as a lamp image"
            )
    count = reasons.total()
    if not count:
        return "all of them were taken with the laser on; also take one with the lamp at every position"
    return "; ".join(f"{reason} ({times} of {count} images)" for reason, times in reasons.most_common(2))


def _choose_laser_images(capture: Capture, most: int) -> Iterator[np.ndarray]:
    """Yield at most ``most`` images with the laser on, evenly chosen."""
    lit = np.flatnonzero(capture.laser_on)
    for place in np.unique(np.linspace(0, len(lit) - 1, most).astype(int)) if len(lit) else ():
        yield capture.image(int(lit[place]))


def detect_target(
    capture: Capture, target: Target, placement: int, numbered: tuple[int, np.ndarray]
) -> tuple[TargetView, TargetImage] | str:
    """Find the target in an image with the laser off, or return the reason for rejection."""
    frame, image = numbered
    try:
        view = target.detect(image)
        return view, TargetImage(view.points_mm, view.pixels, float(capture.stage_mm[frame]), placement)
    except (TargetError, CalibrationError) as error:
        return explain_missing_target(image, str(error), full_dn=capture.header.saturation_dn)


def _find_target_stripe(
    capture: Capture,
    settings: StripeSettings,
    first: int,
    views: Sequence[TargetView],
    positions_mm: np.ndarray,
    target: Target,
    numbered: tuple[int, np.ndarray],
) -> tuple[int, TargetStripe] | str:
    """Find the stripe on the target, and the number of the target's image at this position, or return the reason."""
    frame, image = numbered
    here = np.flatnonzero(np.abs(positions_mm - capture.stage_mm[frame]) <= SAME_POSITION_MM)
    if not len(here):
        return f"no target was found at {capture.stage_mm[frame]:g} mm"
    place = int(here[0])
    along, options, clip = _read_stripe_settings(capture, settings)
    try:
        found = stripe_on_target(image, views[place], target, stripe_along=along, options=options, saturation=clip)
    except ImageError as error:
        return str(error)
    return _explain_short_stripe(found.pixels) or (first + place, found)


def _find_stripe(capture: Capture, settings: StripeSettings, numbered: tuple[int, np.ndarray]) -> np.ndarray | str:
    """Find the stripe (N, 2) of a laser frame, or return the reason for rejection."""
    along, options, clip = _read_stripe_settings(capture, settings)
    try:
        pixels = extract_stripe(numbered[1], stripe_along=along, options=options, saturation=clip).pixels()
    except ImageError as error:
        return str(error)
    return _explain_short_stripe(pixels) or pixels


def _read_stripe_settings(capture: Capture, settings: StripeSettings) -> tuple[str, StripeOptions, float]:
    sensor = capture.header.sensor
    return sensor.camera.stripe_along, StripeOptions.resolve(sensor, settings), capture.header.saturation_dn


def _explain_short_stripe(pixels: np.ndarray) -> str:
    enough = len(pixels) >= FEWEST_LINES
    return "" if enough else f"found on {len(pixels)} lines only; at least {FEWEST_LINES} are needed"


def _report(progress: ProgressListener, name: str, done: int, total: int) -> int:
    progress(done + 1, total, name)
    return done + 1
