"""Campaigns of many recordings, with deviations of the real things from their descriptions drawn for each seed."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from twin.scene.description import AnyObject, Block, Motion, Printed, Scene, load_scene
from uwlts.model.errors import DescriptionError
from uwlts.model.library import find, load_sensor, names, read_table, validated
from uwlts.model.sensor import Description, NotNegative, Sensor

FOLDER = "campaigns"


class Imperfections(Description):
    """Deviations of real things from their descriptions: standard deviations if normal, half widths if even.

    ``circle_centre_std_mm``
        every printed circle or corner of the target, along x and y.
    ``target_bow_std_mm``
        how far the target's middle stands before or behind its corners.
    ``circle_detection_std_px``
        every circle or corner in every image, beyond what the image's noise does.
    ``target_tilt_std_deg``
        the target about X and about Y, against the stage's travel.
    ``stage_position_std_mm``, ``stage_lead_std``
        every position of the stage, and a share of its travel.
    ``stage_misalignment_std_deg``
        the stage's travel against the sheet's normal in scans and against the laser's axis before the target, about
        each of two axes.
    ``temperature_half_width_c``
        the water's temperature; one for the calibration, another for the measurements.
    ``window_tilt_std_deg``
        the camera's window about x and about y.
    ``sheet_bow_std_deg``
        the beam's tilt into the line optics, which bends the sheet.
    ``step_height_half_width_mm``
        the step standard's height.
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


class Recording(Description):
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
    recordings: Annotated[tuple[Recording, ...], Field(min_length=1)]


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
    recordings = tuple(
        recording.model_copy(update={"scene": _from_folder(path.parent, recording.scene)})
        for recording in campaign.recordings
    )
    sensors = {key: _from_folder(path.parent, getattr(campaign, key)) for key in ("sensor", "as_built")}
    return campaign.model_copy(update=sensors | {"recordings": recordings})


def _from_folder(folder: Path, name_or_path: str) -> str:
    return str(folder / name_or_path) if name_or_path.endswith(".toml") else name_or_path


def campaign_names() -> list[str]:
    """Names of the campaigns that ship with the package."""
    return names(FOLDER)


def takes(campaign: Campaign, *, seed: int, every: int = 1) -> list[Take]:
    """All recordings of a campaign with the imperfections of a seed; scans are thinned to every n-th profile.

    Raises
    ------
    DescriptionError
        A scene, placement or sensor is unknown, or two recordings have the same name.
    """
    drawn = _Drawn(campaign, seed)
    found = [
        _take(recording, scene, drawn, every=every) for recording in campaign.recordings for scene in _scenes(recording)
    ]
    doubled = {take.name for take in found if sum(other.name == take.name for other in found) > 1}
    if doubled:
        raise DescriptionError(f"several recordings would be called {', '.join(sorted(doubled))}: give them names")
    return found


def _scenes(recording: Recording) -> Iterator[Scene]:
    for place in recording.placements or (None,):
        for medium in recording.media or (None,):
            scene = load_scene(recording.scene, placement=place, medium=medium)
            motion = scene.motion.model_dump() | recording.motion
            yield load_scene(recording.scene, placement=place, medium=medium, motion=motion)


def _take(recording: Recording, scene: Scene, drawn: "_Drawn", *, every: int) -> Take:
    name = recording.name or f"{Path(recording.scene).stem}-{scene.placement}-{scene.medium}"
    sensor = drawn.described
    built = sensor if recording.as_described else drawn.sensor
    if recording.stripe_along is not None:
        sensor, built = (
            each.model_copy(update={"camera": each.camera.model_copy(update={"stripe_along": recording.stripe_along})})
            for each in (sensor, built)
        )
    # A calibration keeps all its images, and a scan at least a few profiles.
    scan = scene.target is None and scene.motion.count >= 5 * every
    if scan and every > 1:
        scene = _with_motion(scene, step_mm=scene.motion.step_mm * every, count=-(-scene.motion.count // every))
    rng = np.random.default_rng([drawn.seed, *name.encode()])
    if not recording.as_described:
        scene = drawn.as_it_really_is(scene, rng)
        calibrating = scene.target is not None or _shows_step(scene)
        built = drawn.with_true_water(built, calibrating=calibrating)
    return Take(name, scene, sensor, built, int(rng.integers(2**31)))


def _with_motion(scene: Scene, **changes: object) -> Scene:
    motion = validated(Motion, scene.motion.model_dump() | changes, scene.title)
    return scene.model_copy(update={"motion": motion})


class _Drawn:
    """The imperfections of one campaign, drawn from their distributions."""

    def __init__(self, campaign: Campaign, seed: int):
        self.seed, self._size = seed, campaign.imperfections
        self.described = load_sensor(campaign.sensor)
        self._rng = np.random.default_rng([seed, 0])
        size = self._size
        tilt_x, tilt_y = (size.window_tilt_std_deg * self._rng.standard_normal(2)).tolist()
        bow = size.sheet_bow_std_deg * self._rng.standard_normal()
        built = load_sensor(campaign.as_built)
        window, laser = built.camera.window, built.laser
        window = window.model_copy(
            update={"tilt_x_deg": window.tilt_x_deg + tilt_x, "tilt_y_deg": window.tilt_y_deg + tilt_y}
        )
        self.sensor = built.model_copy(
            update={
                "camera": built.camera.model_copy(update={"window": window}),
                "laser": laser.model_copy(update={"bow_deg": laser.bow_deg + bow}),
            }
        )
        self._lead = size.stage_lead_std * self._rng.standard_normal()
        self._scan_angles = size.stage_misalignment_std_deg * self._rng.standard_normal(2)
        self._warmer_calibrating, self._warmer_measuring = size.temperature_half_width_c * self._rng.uniform(-1, 1, 2)
        self._target = {
            "centre_std_mm": size.circle_centre_std_mm,
            "bow_mm": size.target_bow_std_mm * self._rng.standard_normal(),
            "detection_std_px": size.circle_detection_std_px,
            "errors_seed": seed,
        }
        self._lower_step = size.step_height_half_width_mm * self._rng.uniform(-1, 1)

    def with_true_water(self, sensor: Sensor, *, calibrating: bool) -> Sensor:
        """The sensor in water of the true temperature."""
        warmer = self._warmer_calibrating if calibrating else self._warmer_measuring
        media = {
            name: medium if medium.kind == "air" else medium.warmer_by(warmer) for name, medium in sensor.media.items()
        }
        return sensor.model_copy(update={"media": media})

    def as_it_really_is(self, scene: Scene, rng: np.random.Generator) -> Scene:
        """The scene with its target's, step's and stage's errors; ``rng`` draws those of this recording alone."""
        objects = [self._real(thing, rng) for thing in scene.objects]
        if self._lower_step != 0 and _shows_step(scene):
            number = _lower_block(scene)
            x, y, z = objects[number].position_mm
            objects[number] = objects[number].model_copy(update={"position_mm": (x, y, z + self._lower_step)})
        motion = scene.motion
        positions = np.array([motion.start_mm + index * motion.step_mm for index in range(motion.count)])
        errors = self._lead * positions + self._size.stage_position_std_mm * rng.standard_normal(motion.count)
        angles = self._scan_angles
        if scene.target is not None:
            # The sensor is mounted anew before the target.
            angles = self._size.stage_misalignment_std_deg * rng.standard_normal(2)
        changes = {
            "direction": _turned_slightly(motion.unit_direction(), angles),
            "nominal_direction": motion.recorded_direction(),
            "position_errors_mm": tuple(errors.tolist()),
        }
        return _with_motion(scene.model_copy(update={"objects": tuple(objects)}), **changes)

    def _real(self, thing: AnyObject, rng: np.random.Generator) -> AnyObject:
        if not isinstance(thing, Printed):
            return thing
        tilt = self._size.target_tilt_std_deg * rng.standard_normal(2)
        turned = np.array(thing.rotation_deg) + (*tilt, 0.0)
        return thing.model_copy(update=self._target | {"rotation_deg": tuple(turned.tolist())})


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
    second = np.cross(direction, first)
    turned = direction + np.tan(np.radians(angles_deg[0])) * first + np.tan(np.radians(angles_deg[1])) * second
    return tuple((turned / np.linalg.norm(turned)).tolist())
