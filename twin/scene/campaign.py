"""Campaigns of many recordings, with deviations of the real hardware drawn for each seed."""

import math
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import BaseModel, Field

from twin.scene.description import Block, PrintedPlate, Scene, load_scene, replace_values
from twin.scene.platforms import Motion, Platform
from uwlts.errors import DescriptionError
from uwlts.model.artefacts import StepStandard, parse_artefact
from uwlts.model.library import find_description, load_sensor, read_levels, validate_description
from uwlts.model.sensor import Description, NotNegative, Sensor

FOLDER = "campaigns"
AnySensor = str | Path | Sensor


class Imperfections(Description):
    """Deviations of the real hardware: standard deviations of normal, half widths of uniform distributions.

    Target: ``circle_centre_std_mm`` of each printed circle or corner along x and y; ``target_stretch_std`` of the
    print's size along x and along y, relative; ``target_bow_std_mm`` of the centre's height over the corners;
    ``circle_detection_std_px`` of each circle or corner in each image, in addition to image noise;
    ``target_tilt_std_deg`` about X and Y, relative to the stage.

    Stage: ``stage_position_std_mm`` of each position; ``stage_lead_std`` relative to the travel;
    ``stage_misalignment_std_deg`` of the travel about two axes, relative to the sheet's normal in scans and to the
    laser's axis for targets.

    Sensor: ``window_tilt_std_deg`` of the camera's window about x and y; ``glass_thickness_std_mm`` and
    ``glass_index_std`` of this window; ``focus_std_mm`` of the camera's focus distance; ``sheet_bow_std_deg`` of the
    beam's tilt at the line optics, which bends the sheet; ``waist_std`` of the logarithm of the sheet's waist radius,
    and ``waist_distance_std_mm`` of the waist's distance.

    Others: ``temperature_half_width_c`` of the water, drawn once for calibrations and once for measurements;
    ``step_height_half_width_mm`` of the step standard. Depths of pits and undercuts given as a range are drawn again.
    """

    circle_centre_std_mm: NotNegative = 0.0
    target_stretch_std: NotNegative = 0.0
    target_bow_std_mm: NotNegative = 0.0
    circle_detection_std_px: NotNegative = 0.0
    target_tilt_std_deg: NotNegative = 0.0
    stage_position_std_mm: NotNegative = 0.0
    stage_lead_std: NotNegative = 0.0
    stage_misalignment_std_deg: NotNegative = 0.0
    temperature_half_width_c: NotNegative = 0.0
    window_tilt_std_deg: NotNegative = 0.0
    glass_thickness_std_mm: NotNegative = 0.0
    glass_index_std: NotNegative = 0.0
    focus_std_mm: NotNegative = 0.0
    sheet_bow_std_deg: NotNegative = 0.0
    waist_std: NotNegative = 0.0
    waist_distance_std_mm: NotNegative = 0.0
    step_height_half_width_mm: NotNegative = 0.0


class CampaignRecording(Description):
    """A scene to record in several media and at several placements.

    ``scene`` is a name or a path; relative paths start at the campaign's folder. Files are called ``name`` (default:
    SCENE-PLACEMENT-MEDIUM). ``motion`` changes the scene's motion. ``stripe_along`` rotates the camera.
    ``as_described`` records with the sensor as described, without imperfections.
    """

    scene: str
    name: str | None = None
    media: tuple[str, ...] = ()
    placements: tuple[str, ...] = ()
    motion: dict[str, object] = {}
    stripe_along: Literal["width", "height"] | None = None
    as_described: bool = False


class Campaign(Description):
    """Recordings with one sensor. The imperfections are added to ``as_built``; files may omit it, if it is ``sensor``.

    Sensors are names or paths; relative paths start at the campaign's folder. ``water`` replaces that of all scenes in
    water, by the name of a water or a turbidity from 0 (pure) to 3 (harbour).
    """

    title: str
    sensor: str
    as_built: str
    water: str | Annotated[float, Field(ge=0, le=3)] | None = None
    imperfections: Imperfections = Imperfections()
    recordings: Annotated[tuple[CampaignRecording, ...], Field(min_length=1)]


@dataclass(frozen=True)
class Take:
    """One recording to be rendered: the sensor as described and as built, and the actual scene."""

    name: str
    scene: Scene
    sensor: Sensor
    built: Sensor
    seed: int


def choose_sensors(sensor: AnySensor, as_built: AnySensor | None) -> tuple[Sensor, Sensor]:
    """Return the sensor as described and as built; DescriptionError if their image formats differ."""
    nominal = sensor if isinstance(sensor, Sensor) else load_sensor(sensor)
    if as_built is None:
        return nominal, nominal
    built = as_built if isinstance(as_built, Sensor) else load_sensor(as_built)
    shared = {"width_px", "height_px", "stripe_along"}
    if built.camera.model_dump(include=shared) != nominal.camera.model_dump(include=shared):
        names = [each.name if isinstance(each, Sensor) else str(each) for each in (as_built, sensor)]
        raise DescriptionError(f"'{names[0]}' and '{names[1]}' differ in image size or stripe orientation")
    return nominal, built


def load_campaign(name_or_path: str | Path) -> Campaign:
    """Read a campaign by name (``thesis``) or path; DescriptionError if it does not exist or is invalid."""
    path = find_description(name_or_path, FOLDER)
    levels = read_levels(path, FOLDER)
    # A base's sensor as built is no variation of another sensor.
    naming = next((each.stated for each in levels[::-1] if {"sensor", "as_built"} & each.stated.keys()), {})
    table = levels[-1].merged | {"as_built": naming.get("as_built", naming.get("sensor", ""))}
    campaign = validate_description(Campaign, table, path)

    def from_folder(name_or_path: str) -> str:
        return str(path.parent / name_or_path) if name_or_path.endswith(".toml") else name_or_path

    recordings = tuple(replace_values(each, scene=from_folder(each.scene)) for each in campaign.recordings)
    sensor, as_built = from_folder(campaign.sensor), from_folder(campaign.as_built)
    return replace_values(campaign, sensor=sensor, as_built=as_built, recordings=recordings)


def list_takes(campaign: Campaign, *, seed: int, every: int = 1) -> list[Take]:
    """Return all recordings of a campaign with the imperfections of a seed; scans keep every n-th profile.

    DescriptionError if a scene, placement or sensor is unknown, or two recordings have the same name.
    """
    drawn = _SampledImperfections(campaign, seed)
    found = [
        _take(recording, place, medium, drawn, water=campaign.water, every=every)
        for recording in campaign.recordings
        for place in recording.placements or (None,)
        for medium in recording.media or (None,)
    ]
    doubled = sorted(name for name, count in Counter(take.name for take in found).items() if count > 1)
    if doubled:
        raise DescriptionError(f"several recordings would be called {', '.join(doubled)}: give each its own name")
    return found


def _take(
    recording: CampaignRecording,
    place: str | None,
    medium: str | None,
    drawn: "_SampledImperfections",
    *,
    water: str | float | None,
    every: int,
) -> Take:
    plain = load_scene(recording.scene, placement=place, medium=medium)
    in_water = water is not None and drawn.described.medium(plain.medium).kind != "air"
    scene = load_scene(
        recording.scene,
        placement=place,
        medium=medium,
        water=water if in_water else None,
        motion=plain.motion.model_dump() | recording.motion,
    )
    name = recording.name or f"{Path(recording.scene).stem}-{scene.placement}-{scene.medium}"
    sensor = drawn.described
    built = sensor if recording.as_described else drawn.sensor
    if recording.stripe_along is not None:
        turned = {"stripe_along": recording.stripe_along}
        sensor, built = replace_values(sensor, camera=turned), replace_values(built, camera=turned)
    # Calibrations keep all images, and scans at least five profiles.
    stage = scene.motion
    if isinstance(stage, Motion) and scene.target is None and stage.count >= 5 * every and every > 1:
        scene = _change_motion(scene, step_mm=stage.step_mm * every, count=-(-stage.count // every))
    rng = np.random.default_rng([drawn.seed, *name.encode()])
    if not recording.as_described:
        scene = drawn.apply_imperfections(scene, rng)
        warmer = drawn.warmer_k[scene.target is not None or _shows_step(scene)]
        media = {key: each if each.kind == "air" else each.warmer_by(warmer) for key, each in built.media.items()}
        built = replace_values(built, media=media)
    return Take(name, scene, sensor, built, int(rng.integers(2**31)))


def _change_motion(scene: Scene, **changes: object) -> Scene:
    motion = validate_description(type(scene.motion), scene.motion.model_dump() | changes, scene.title)
    return scene.model_copy(update={"motion": motion})


class _SampledImperfections:
    """Imperfections of one campaign, drawn from their distributions."""

    def __init__(self, campaign: Campaign, seed: int):
        self.seed, self._size = seed, campaign.imperfections
        size, rng = self._size, np.random.default_rng([seed, 0])
        self.described, built = choose_sensors(campaign.sensor, campaign.as_built)
        window = built.camera.window
        tilt_x, tilt_y = (size.window_tilt_std_deg * rng.standard_normal(2)).tolist()
        bow = size.sheet_bow_std_deg * rng.standard_normal()
        changed = {"tilt_x_deg": window.tilt_x_deg + tilt_x, "tilt_y_deg": window.tilt_y_deg + tilt_y}
        # By a second generator, so that the other imperfections of a seed do not change.
        thicker, denser, farther, wider, later, *stretch = np.random.default_rng([seed, 1]).standard_normal(7).tolist()
        changed["thickness_mm"] = window.thickness_mm + size.glass_thickness_std_mm * thicker
        if size.glass_index_std > 0:
            changed["glass"] = window.index(built.laser.wavelength_nm) + size.glass_index_std * denser
            changed["absorption_per_m"] = 1e3 * window.absorption_per_mm()
        focus = built.camera.focus_distance_mm + size.focus_std_mm * farther
        laser = {
            "bow_deg": built.laser.bow_deg + bow,
            "waist_radius_mm": built.laser.waist_radius_mm * float(np.exp(size.waist_std * wider)),
            "waist_distance_mm": built.laser.waist_distance_mm + size.waist_distance_std_mm * later,
        }
        self.sensor = replace_values(built, camera={"window": changed, "focus_distance_mm": focus}, laser=laser)
        self._lead = size.stage_lead_std * rng.standard_normal()
        self._scan_angles = size.stage_misalignment_std_deg * rng.standard_normal(2)
        # By whether the water is that of the calibration.
        self.warmer_k = dict(zip((True, False), size.temperature_half_width_c * rng.uniform(-1, 1, 2), strict=True))
        self._target = {
            "centre_std_mm": size.circle_centre_std_mm,
            "stretch": tuple(size.target_stretch_std * each for each in stretch),
            "bow_mm": size.target_bow_std_mm * rng.standard_normal(),
            "detection_std_px": size.circle_detection_std_px,
            "errors_seed": seed,
        }
        self._lower_step = size.step_height_half_width_mm * rng.uniform(-1, 1)

    def apply_imperfections(self, scene: Scene, rng: np.random.Generator) -> Scene:
        """Return the scene with the errors of target, step and stage; ``rng`` draws the errors of this recording."""
        size, motion, objects = self._size, scene.motion, list(scene.objects)
        for number, thing in enumerate(objects):
            if isinstance(thing, PrintedPlate):
                tilt = size.target_tilt_std_deg * rng.standard_normal(2)
                turned = np.array(thing.rotation_deg) + (*tilt, 0.0)
                objects[number] = replace_values(thing, **self._target, rotation_deg=tuple(turned.tolist()))
            elif thing.draws_depths():
                objects[number] = replace_values(thing, seed=int(rng.integers(2**31)))
        if self._lower_step != 0 and _shows_step(scene):
            number = _find_lower_block(scene)
            x, y, z = objects[number].position_mm
            objects[number] = replace_values(objects[number], position_mm=(x, y, z + self._lower_step))
        scene = replace_values(scene, objects=tuple(objects))
        if isinstance(motion, Platform):
            # Platforms draw their own errors.
            return _change_motion(scene, errors_seed=int(rng.integers(2**31)))
        positions = np.array([motion.start_mm + index * motion.step_mm for index in range(motion.count)])
        errors = self._lead * positions + size.stage_position_std_mm * rng.standard_normal(motion.count)
        angles = self._scan_angles
        if scene.target is not None:
            # The sensor is mounted again for each target.
            angles = size.stage_misalignment_std_deg * rng.standard_normal(2)
        return _change_motion(
            scene,
            direction=_rotate_direction(motion.unit_direction(), angles),
            nominal_direction=motion.recorded_direction(),
            position_errors_mm=tuple(errors.tolist()),
        )


def _shows_step(scene: Scene) -> bool:
    """Return whether the scene contains the step standard."""
    return (scene.artefact or {}).get("kind") == "step"


def _find_lower_block(scene: Scene) -> int:
    """Return the index of the block whose front face is farthest from the sensor.

    DescriptionError if there are fewer than two blocks.
    """
    blocks = {
        number: thing.position_mm[2] - thing.size_mm[2] / 2
        for number, thing in enumerate(scene.objects)
        if isinstance(thing, Block)
    }
    if len(blocks) < 2:
        raise DescriptionError(
            f"{scene.title}: a step standard of {len(blocks)} blocks has no step height: use two blocks, or set "
            "step_height_half_width_mm to 0"
        )
    return max(blocks, key=lambda number: blocks[number])


def _rotate_direction(direction: np.ndarray, angles_deg: np.ndarray) -> tuple[float, float, float]:
    """Return a unit direction (3,) rotated by two small angles about two axes perpendicular to it."""
    least = np.eye(3)[np.argmin(np.abs(direction))]
    first = np.cross(direction, least)
    first /= np.linalg.norm(first)
    by_first, by_second = np.tan(np.radians(angles_deg))
    turned = direction + by_first * first + by_second * np.cross(direction, first)
    return tuple((turned / np.linalg.norm(turned)).tolist())


# --- comparison with the sensor's stated uncertainties ----------------------------------------------------------------


_NORMAL = 1.96  # half width that contains 95 % of normal deviations (unit: standard deviation)
_UNIFORM = 0.95  # the same for uniform deviations (unit: half width of their distribution)
_DIFFERENCE = 2.0 * (1.0 - math.sqrt(0.05))
"""The same for the difference of two independent uniform deviations, whose distribution is a triangle."""


class Understated(BaseModel, frozen=True):
    """Deviation of a campaign that is larger than stated, so that stated uncertainties of measurements are too small.

    Attributes
    ----------
    quantity, unit : str
        What deviates.
    key : str
        Key of the statement in the sensor's table ``[uncertainty]``, or in the artefact of a scene.
    deviation : float
        Half width that contains 95 % of the campaign's deviations, plus the deviation of the sensor as built.
    expanded : float
        Stated expanded uncertainty (k = 2).
    """

    quantity: str
    unit: str
    key: str
    deviation: float
    expanded: float

    def text(self) -> str:
        """Return the deviation and the statement as a sentence."""
        unit = f" {self.unit}" if self.unit else ""
        return (
            f"{self.quantity}: 95 % of the campaign's deviations are within ±{self.deviation:.2g}{unit}, the "
            f"description states ±{self.expanded:.2g}{unit} (`{self.key}`, k = 2)"
        )


def find_understated(campaign: Campaign, takes: Sequence[Take]) -> tuple[Understated, ...]:
    """Return the deviations of a campaign that exceed the uncertainties (k = 2) stated for the sensor.

    ``takes`` are the recordings of one seed. Errors of lattice, detected circles, camera's focus and waist's distance
    are not in the sensor's table: residuals show them, or positions do not depend on them.
    """
    described, built = choose_sensors(campaign.sensor, campaign.as_built)
    found = [*_compare_hardware(campaign, described, built), *_compare_media(campaign, takes, built)]
    found += _compare_steps(campaign, takes)
    # Stated values are rounded, as 2.9 K for a half width of 5 K.
    return tuple(each for each in dict.fromkeys(found) if each.deviation > 1.02 * each.expanded)


def _compare_hardware(campaign: Campaign, described: Sensor, built: Sensor) -> Iterator[Understated]:
    """Yield deviations of the sensor, those of the sensor as built included, and of stage and target."""
    drawn, stated, wavelength = campaign.imperfections, described.uncertainty, described.laser.wavelength_nm
    nominal, real = described.camera.window, built.camera.window
    plain, laser, lens = described.laser, built.laser, built.camera.distortion
    thicker = math.log(laser.waist_radius_mm / plain.waist_radius_mm)
    turned = max(abs(real.tilt_x_deg - nominal.tilt_x_deg), abs(real.tilt_y_deg - nominal.tilt_y_deg))
    tangential = max(abs(lens.p1 - described.camera.distortion.p1), abs(lens.p2 - described.camera.distortion.p2))
    # Only a turn about the line changes the direction of the sheet.
    sheet_turned = laser.window.tilt_y_deg - plain.window.tilt_y_deg
    # Both turn the travel relative to the target's normal.
    misaligned = math.hypot(drawn.stage_misalignment_std_deg, drawn.target_tilt_std_deg)
    window, denser = "the camera's window", real.index(wavelength) - nominal.index(wavelength)
    rows: tuple[tuple[str, str, float, float], ...] = (
        (f"distance of {window}", "window_distance_mm", real.distance_mm - nominal.distance_mm, 0.0),
        (f"tilt of {window}", "window_tilt_deg", turned, drawn.window_tilt_std_deg),
        (
            f"glass thickness of {window}",
            "glass_thickness_mm",
            real.thickness_mm - nominal.thickness_mm,
            drawn.glass_thickness_std_mm,
        ),
        (f"glass index of {window}", "glass_index", denser, drawn.glass_index_std),
        ("tilt of the laser's window", "laser_window_tilt_deg", sheet_turned, 0.0),
        ("tilt of the beam at the line optics", "bow_deg", laser.bow_deg - plain.bow_deg, drawn.sheet_bow_std_deg),
        ("relative thickness of the sheet", "sheet_thickness", thicker, drawn.waist_std),
        ("tangential distortion", "tangential", tangential, 0.0),
        ("position of the stage", "stage_position_mm", 0.0, drawn.stage_position_std_mm),
        ("scale of the stage", "stage_scale", 0.0, drawn.stage_lead_std),
        ("direction of the stage", "stage_alignment_deg", 0.0, misaligned),
        ("bow of the target", "target_bow_mm", 0.0, drawn.target_bow_std_mm),
        ("stretch of the target", "target_stretch", 0.0, drawn.target_stretch_std),
    )
    for quantity, key, known, std in rows:
        within = min(stated.stretch_by_axis()) if key == "target_stretch" else getattr(stated, key)
        yield _compare(quantity, key, abs(known) + _NORMAL * std, within)


def _compare_media(campaign: Campaign, takes: Sequence[Take], built: Sensor) -> Iterator[Understated]:
    """Yield deviations of the temperature, for the recorded media whose index follows from it."""
    half = campaign.imperfections.temperature_half_width_c
    for take in takes:
        name, stated = take.scene.medium, take.sensor.uncertainty
        medium = take.sensor.medium(name)
        if medium.index_per_kelvin(take.sensor.laser.wavelength_nm) != 0 and take.built is not take.sensor:
            warmer = abs(built.medium(name).temperature_c - medium.temperature_c)
            both = f"temperature of the {name}"
            yield _compare(both, "temperature_k", warmer + _UNIFORM * half, stated.temperature_k)
            changed = f"{both}, from calibration to measurement"
            yield _compare(changed, "drift_k", _DIFFERENCE * half, stated.drift_k)


def _compare_steps(campaign: Campaign, takes: Sequence[Take]) -> Iterator[Understated]:
    """Yield deviations of step standards from their certificates, or from the sensor's statement without one."""
    for take in takes:
        artefact = None if take.scene.artefact is None else parse_artefact(take.scene.artefact)
        if isinstance(artefact, StepStandard):
            certified = artefact.height_uncertainty_mm
            key = "height_uncertainty_mm" if certified else "step_height_mm"
            std = certified / 2 if certified else take.sensor.uncertainty.step_height_mm
            deviation = _UNIFORM * campaign.imperfections.step_height_half_width_mm
            yield _compare("height of the step standard", key, deviation, std)


def _compare(quantity: str, key: str, deviation: float, std: float) -> Understated:
    units = {"mm": "mm", "deg": "deg", "k": "K"}
    unit = units.get(key.rsplit("_", 1)[-1], "")
    return Understated(quantity=quantity, unit=unit, key=key, deviation=deviation, expanded=2 * std)
