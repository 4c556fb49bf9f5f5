"""Rendering of scenes given by name or description: into arrays (`render`) or capture and truth files (`simulate`).

Mitsuba is imported when the first scene is rendered, after its variant and libLLVM are chosen.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from twin.rendering_options import CPU, Options, Variant, use_variant
from twin.scene.campaign import AnySensor, choose_sensors
from twin.scene.description import Scene, load_scene
from uwlts.errors import DescriptionError
from uwlts.files.writing import require_ending
from uwlts.model.library import validate_description
from uwlts.model.sensor import Medium, Sensor
from uwlts.model.short_text import Brief
from uwlts.runtime.progress import ProgressListener, ignore_progress
from uwlts.storage.capture import CAPTURES
from uwlts.storage.truth import Truth

AnyScene = str | Path | Scene
FRAME_DATA = ("stage_mm", "laser_on", "exposure_ms", "time_s")


@dataclass(frozen=True, repr=False)
class Recording(Brief):
    """Rendered images of a scan with their ground truth; F images of H x W pixels.

    Attributes
    ----------
    images
        Grey values (F, H, W), uint8 or uint16.
    stage_mm
        Recorded stage positions (F,).
    laser_on
        Whether the laser (True) or the lamp (False) is on, (F,).
    exposure_ms, time_s
        Exposure and time since the first image of the scan, (F,).
    truth
        Ground truth of every profile line; its depth map is that of the first image here.
    sensor, medium, scene
        The rendered sensor, the medium in front of it, and the scene.
    """

    images: np.ndarray
    stage_mm: np.ndarray
    laser_on: np.ndarray
    exposure_ms: np.ndarray
    time_s: np.ndarray
    truth: Truth
    sensor: Sensor
    medium: Medium
    scene: Scene


def render(
    scene: AnyScene,
    *,
    sensor: AnySensor = "thesis",
    as_built: AnySensor | None = None,
    placement: str | None = None,
    medium: str | None = None,
    spp: int = 16,
    seed: int = 0,
    water: float | str | None = None,
    effects: Sequence[str] = (),
    without: Sequence[str] = (),
    ideal: bool = False,
    frames: Sequence[int] | None = None,
    variant: Variant = CPU,
) -> Recording:
    """Render a scene into arrays; the images are those that `simulate` writes with the same arguments.

    Parameters
    ----------
    frames
        Numbers of the scan's images to render, from 0; default: all.
    effects
        As for `simulate`.
    scene, sensor, as_built, placement, medium, spp, seed, water, without, ideal, variant
        As for `simulate`; scene and sensors may also be descriptions, and there is one placement.

    Returns
    -------
    Recording
        Images (F, H, W) in grey levels, their metadata, and the truth.

    Raises
    ------
    DescriptionError, DesignError, SetupError
        As for `simulate`.
    """
    described = choose_scene(scene, placement=placement, medium=medium, water=water)
    _, built = choose_sensors(sensor, as_built)
    options = Options.from_names(spp=spp, seed=seed, effects=effects, without=without, ideal=ideal)
    shots = list(enumerate(described.motion.shots()))
    if frames is not None:
        if not frames or not all(0 <= number < len(shots) for number in frames):
            raise DescriptionError(f"frames is {list(frames)}; give numbers from 0 to {len(shots) - 1}")
        shots = [shots[number] for number in frames]
    use_variant(variant)
    from twin.recording.record_scene import truth_of_recording
    from twin.recording.sensor_simulator import SensorSimulator

    simulator = SensorSimulator(built, described, options)
    # The truth of each frame after its light, which it uses.
    pairs = [(simulator.frame(shot, number), simulator.truth(shot)) for number, shot in shots]
    taken, truths = zip(*pairs, strict=True)
    return Recording(
        np.stack([frame.image for frame in taken]),
        *(np.array([getattr(frame, name) for frame in taken]) for name in FRAME_DATA),
        truth=truth_of_recording(simulator, truths, shots=[shot for _, shot in shots]),
        sensor=simulator.sensor,
        medium=simulator.medium,
        scene=described,
    )


def simulate(
    scene: AnyScene,
    *,
    out: str | Path,
    sensor: AnySensor = "thesis",
    as_built: AnySensor | None = None,
    placement: str | Sequence[str] = (),
    medium: str | None = None,
    spp: int = 16,
    seed: int = 0,
    water: float | str | None = None,
    effects: Sequence[str] = (),
    without: Sequence[str] = (),
    ideal: bool = False,
    resume: bool = False,
    overwrite: bool = False,
    variant: Variant = CPU,
    progress: ProgressListener = ignore_progress,
    report: Callable[[str], object] = lambda line: None,
) -> list[Path]:
    """Render a scene into a capture, with the ground truth in a file beside it.

    Parameters
    ----------
    scene
        Name of a scene (see: twin scenes) or path of its TOML file.
    out
        Capture to write, such as capture.h5; the truth goes to capture.truth.h5. With several placements the name
        must contain {placement}.
    sensor
        Name or path of the sensor description that the capture states.
    as_built
        Name or path of the sensor to render, if it differs from the description.
    placement
        Named position of the objects, such as near, standoff or far; several are recorded in turn.
    medium
        Name of one of the sensor's media, instead of the scene's.
    spp
        Samples per lit pixel.
    seed
        Seed of all noise; the same seed gives the same capture.
    water
        Optical properties of the water, instead of the medium's: pure, clear, coastal, harbour, jerlov-I to
        jerlov-9C, or a turbidity: 0 (pure), 1 (clear), 2 (coastal), 3 (harbour), or between.
    effects
        Effects of real images to add, NAME of typical strength or NAME=STRENGTH: glare=0.02, ghost=0.003,
        vignetting=0.4, uneven-lamp=0.6, particles=1000 and bubbles=200 (per litre), caustics=2 (wind in m/s),
        stray-light=0.02, side-lobes=0.01, lamp-reflection=0.001, dirt=0.1, lamp-and-laser, pixel-aspect=1.002,
        tangential=0.001, rolling-shutter=10 (us per row), row-noise=5 (electrons), jpeg=90, colour-filter.
    without
        Effects to leave out: defocus, haze, multiple-scattering, secondary-light, gloss, motion, ambient, speckle,
        fixed-pattern, noise.
    ideal
        Leave out all of these: the sharp image of a pinhole without noise.
    resume
        Resume an interrupted run.
    overwrite
        Replace existing files.
    variant
        Mitsuba variant: llvm_ad_mono (CPU) or cuda_ad_mono (NVIDIA GPU).
    progress
        Called with the number of images done, the total number, and the name of the stage.
    report
        Called with a line of text for each file that is written.

    Returns
    -------
    list of Path
        The captures.

    Raises
    ------
    DescriptionError
        A description, name or option is wrong.
    DesignError
        The sensor cannot measure the scene.
    SetupError
        Mitsuba cannot use the variant on this machine.
    OutputError
        A file exists already, or cannot be written.
    """
    out = Path(out)
    require_ending(out, CAPTURES)
    places = (placement,) if isinstance(placement, str) else tuple(placement) or (None,)
    if len(places) > 1 and "{placement}" not in out.name:
        raise DescriptionError(f"several placements, but one output {out}: put {{placement}} into its name")
    described = [choose_scene(scene, placement=place, medium=medium, water=water) for place in places]
    nominal, built = choose_sensors(sensor, as_built)
    options = Options.from_names(spp=spp, seed=seed, effects=effects, without=without, ideal=ideal)
    use_variant(variant)
    from twin.recording.record_scene import record_scene

    files, paths = {"overwrite": overwrite, "resume": resume}, []
    for each in described:
        path = out.with_name(out.name.replace("{placement}", each.placement))
        stage = partial(progress, stage=each.placement)
        record_scene(each, nominal, path, as_built=built, options=options, progress=stage, **files)
        report(f"wrote {path}")
        paths.append(path)
    return paths


def choose_scene(scene: AnyScene, *, placement: str | None, medium: str | None, water: float | str | None) -> Scene:
    """Return the scene, with the given placement, medium and water instead of its own."""
    if not isinstance(scene, Scene):
        return load_scene(scene, placement=placement, medium=medium, water=water)
    given = {"placement": placement, "medium": medium, "water": water}
    changes = {key: value for key, value in given.items() if value is not None}
    return validate_description(Scene, scene.model_dump() | changes, scene.title)
