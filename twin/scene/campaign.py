"""Campaigns of many recordings, with deviations of the real things from their descriptions drawn for each seed."""

from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from twin.scene.description import Block, Printed, Scene, altered, load_scene
from twin.scene.motion import Motion
from twin.scene.platforms import Platform
from uwlts.errors import DescriptionError
from uwlts.model.library import find, load_sensor, read_table, validated
from uwlts.model.sensor import Description, NotNegative, Sensor

FOLDER = "campaigns"


class Imperfections(Description):
    """Deviations of real things from their descriptions: standard deviations if normal, half widths if even.

    Of the target: ``circle_centre_std_mm`` of every printed circle or corner along x and y; ``target_bow_std_mm`` by
    which its middle stands before or behind its corners; ``circle_detection_std_px`` of every circle or corner in every
    image, beyond what the image's noise does; ``target_tilt_std_deg`` about X and about Y, against the stage's travel.
    Of the stage: ``stage_position_std_mm`` of every position and ``stage_lead_std`` as a share of its travel;
    ``stage_misalignment_std_deg`` of the travel against the sheet's normal in scans and against the laser's axis before
    the target, about each of two axes. ``temperature_half_width_c`` is the water's, one for the calibration and another
    for the measurements; ``window_tilt_std_deg`` the camera's window's about x and about y; ``sheet_bow_std_deg`` the
    beam's tilt into the line optics, which bends the sheet; ``step_height_half_width_mm`` the step standard's height.
    """

    circle_centre_std_mm: NotNegative = 0.0
    target_bow_std_mm: NotNegative = 0.0
    circle_detection_std_px: NotNegative = 0.0
    target_tilt_std_deg: NotNegative = 0.0
    stage_position_std_mm: NotNegative = 0.0
    stage_lead_std: NotNegative = 0.0
    stage_misalignment_std_deg: NotNegative = 0.0
    temperature_half_width_c: NotNegative = 0.0
    window_tilt_std_deg: NotNegative = 0.0
    sheet_bow_std_deg: NotNegative = 0.0
    step_height_half_width_mm: NotNegative = 0.0


class CampaignRecording(Description):
    """A scene to record in each of some media and at each of some placements.

    ``scene`` is a name, or a path that starts at the campaign's folder if it is relative. Files are called ``name``, or
    SCENE-PLACEMENT-MEDIUM unless a name is given. ``motion`` changes the scene's. ``stripe_along`` turns the camera.
    ``as_described`` records with the sensor as described, free of imperfections.
    """

    scene: str
    name: str | None = None
    media: tuple[str, ...] = ()
    placements: tuple[str, ...] = ()
    motion: dict[str, object] = {}
    stripe_along: Literal["width", "height"] | None = None
    as_described: bool = False


class Campaign(Description):
    """Recordings with one sensor. ``as_built`` is the sensor to which the imperfections are added.

    Sensors are names, or paths that start at the campaign's folder if they are relative.
    """

    title: str
    sensor: str
    as_built: str
    imperfections: Imperfections = Imperfections()
    recordings: Annotated[tuple[CampaignRecording, ...], Field(min_length=1)]


@dataclass(frozen=True)
class Take:
    """One recording, ready to be rendered: the sensor as described and as built, the scene as it really is."""

    name: str
    scene: Scene
    sensor: Sensor
    built: Sensor
    seed: int


def load_campaign(name_or_path: str | Path) -> Campaign:
    """Campaign by name (``thesis``) or path; DescriptionError where it is none."""
    path = find(name_or_path, FOLDER)
    campaign = validated(Campaign, read_table(path, FOLDER), path)

    def from_folder(name_or_path: str) -> str:
        return str(path.parent / name_or_path) if name_or_path.endswith(".toml") else name_or_path

    recordings = tuple(altered(each, scene=from_folder(each.scene)) for each in campaign.recordings)
    sensor, as_built = from_folder(campaign.sensor), from_folder(campaign.as_built)
    return altered(campaign, sensor=sensor, as_built=as_built, recordings=recordings)


def takes(campaign: Campaign, *, seed: int, every: int = 1) -> list[Take]:
    """All recordings of a campaign with the imperfections of a seed; scans are thinned to every n-th profile.

    DescriptionError where a scene, placement or sensor is unknown, or two recordings have the same name.
    """
    drawn = _Drawn(campaign, seed)
    found = [
        _take(recording, place, medium, drawn, every=every)
        for recording in campaign.recordings
        for place in recording.placements or (None,)
        for medium in recording.media or (None,)
    ]
    doubled = sorted(name for name, count in Counter(take.name for take in found).items() if count > 1)
    if doubled:
        raise DescriptionError(f"several recordings would be called {', '.join(doubled)}: give them names")
    return found


def _take(recording: CampaignRecording, place: str | None, medium: str | None, drawn: "_Drawn", *, every: int) -> Take:
    motion = load_scene(recording.scene, placement=place, medium=medium).motion.model_dump() | recording.motion
    scene = load_scene(recording.scene, placement=place, medium=medium, motion=motion)
    name = recording.name or f"{Path(recording.scene).stem}-{scene.placement}-{scene.medium}"
    sensor = drawn.described
    built = sensor if recording.as_described else drawn.sensor
    if recording.stripe_along is not None:
        turned = {"stripe_along": recording.stripe_along}
        sensor, built = altered(sensor, camera=turned), altered(built, camera=turned)
    # A calibration keeps all its images, and a scan at least a few profiles.
    stage = scene.motion
    if isinstance(stage, Motion) and scene.target is None and stage.count >= 5 * every and every > 1:
        scene = _with_motion(scene, step_mm=stage.step_mm * every, count=-(-stage.count // every))
    rng = np.random.default_rng([drawn.seed, *name.encode()])
    if not recording.as_described:
        scene = drawn.as_it_really_is(scene, rng)
        built = drawn.with_true_water(built, calibrating=scene.target is not None or _shows_step(scene))
    return Take(name, scene, sensor, built, int(rng.integers(2**31)))


def _with_motion(scene: Scene, **changes: object) -> Scene:
    motion = validated(type(scene.motion), scene.motion.model_dump() | changes, scene.title)
    return scene.model_copy(update={"motion": motion})


class _Drawn:
    """The imperfections of one campaign, drawn from their distributions."""

    def __init__(self, campaign: Campaign, seed: int):
        self.seed, self._size = seed, campaign.imperfections
        size, rng = self._size, np.random.default_rng([seed, 0])
        self.described, built = load_sensor(campaign.sensor), load_sensor(campaign.as_built)
        window = built.camera.window
        tilt_x, tilt_y = (size.window_tilt_std_deg * rng.standard_normal(2)).tolist()
        bow = size.sheet_bow_std_deg * rng.standard_normal()
        tilts = {"tilt_x_deg": window.tilt_x_deg + tilt_x, "tilt_y_deg": window.tilt_y_deg + tilt_y}
        self.sensor = altered(built, camera={"window": tilts}, laser={"bow_deg": built.laser.bow_deg + bow})
        self._lead = size.stage_lead_std * rng.standard_normal()
        self._scan_angles = size.stage_misalignment_std_deg * rng.standard_normal(2)
        self._warmer_calibrating, self._warmer_measuring = size.temperature_half_width_c * rng.uniform(-1, 1, 2)
        self._target = {
            "centre_std_mm": size.circle_centre_std_mm,
            "bow_mm": size.target_bow_std_mm * rng.standard_normal(),
            "detection_std_px": size.circle_detection_std_px,
            "errors_seed": seed,
        }
        self._lower_step = size.step_height_half_width_mm * rng.uniform(-1, 1)

    def with_true_water(self, sensor: Sensor, *, calibrating: bool) -> Sensor:
        """The sensor in water of the true temperature."""
        warmer = self._warmer_calibrating if calibrating else self._warmer_measuring
        media = {key: each if each.kind == "air" else each.warmer_by(warmer) for key, each in sensor.media.items()}
        return altered(sensor, media=media)

    def as_it_really_is(self, scene: Scene, rng: np.random.Generator) -> Scene:
        """The scene with its target's, step's and stage's errors; ``rng`` draws those of this recording alone."""
        size, motion, objects = self._size, scene.motion, list(scene.objects)
        for number, thing in enumerate(objects):
            if isinstance(thing, Printed):
                tilt = size.target_tilt_std_deg * rng.standard_normal(2)
                turned = np.array(thing.rotation_deg) + (*tilt, 0.0)
                objects[number] = altered(thing, **self._target, rotation_deg=tuple(turned.tolist()))
        if self._lower_step != 0 and _shows_step(scene):
            number = _lower_block(scene)
            x, y, z = objects[number].position_mm
            objects[number] = altered(objects[number], position_mm=(x, y, z + self._lower_step))
        scene = altered(scene, objects=tuple(objects))
        if isinstance(motion, Platform):
            # Platforms know their own errors.
            return _with_motion(scene, errors_seed=int(rng.integers(2**31)))
        positions = np.array([motion.start_mm + index * motion.step_mm for index in range(motion.count)])
        errors = self._lead * positions + size.stage_position_std_mm * rng.standard_normal(motion.count)
        angles = self._scan_angles
        if scene.target is not None:
            # The sensor is mounted anew before the target.
            angles = size.stage_misalignment_std_deg * rng.standard_normal(2)
        return _with_motion(
            scene,
            direction=_turned_slightly(motion.unit_direction(), angles),
            nominal_direction=motion.recorded_direction(),
            position_errors_mm=tuple(errors.tolist()),
        )


def _shows_step(scene: Scene) -> bool:
    """Whether the step standard stands before the sensor."""
    return (scene.artefact or {}).get("kind") == "step"


def _lower_block(scene: Scene) -> int:
    """Number of the block whose face towards the sensor lies farthest away; DescriptionError where there are none."""
    blocks = {
        number: thing.position_mm[2] - thing.size_mm[2] / 2
        for number, thing in enumerate(scene.objects)
        if isinstance(thing, Block)
    }
    if len(blocks) < 2:
        raise DescriptionError(
            f"{scene.title}: a step standard of {len(blocks)} blocks has no height to change: build it of two, or set "
            "step_height_half_width_mm to 0"
        )
    return max(blocks, key=lambda number: blocks[number])


def _turned_slightly(direction: np.ndarray, angles_deg: np.ndarray) -> tuple[float, float, float]:
    """A unit direction (3,) turned by two small angles about two axes square to it."""
    least = np.eye(3)[np.argmin(np.abs(direction))]
    first = np.cross(direction, least)
    first /= np.linalg.norm(first)
    by_first, by_second = np.tan(np.radians(angles_deg))
    turned = direction + by_first * first + by_second * np.cross(direction, first)
    return tuple((turned / np.linalg.norm(turned)).tolist())
