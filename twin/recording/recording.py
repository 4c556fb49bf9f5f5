"""Renders scenes by name or description: into arrays (`render`) or into capture and truth files (`simulate`).

Mitsuba is imported when the first scene is rendered, after its variant and libLLVM are chosen.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from twin.options import ALL, CPU, NONE, Options, use_variant
from twin.scene.description import Scene, load_scene
from uwlts.model.errors import DescriptionError
from uwlts.model.library import load_sensor, validated
from uwlts.model.sensor import Medium, Sensor
from uwlts.runtime.console import progress_bar
from uwlts.storage.truth import Truth


@dataclass(frozen=True)
class Recording:
    """Images of a scan with what truly is to be seen in them; F images of H x W pixels.

    Attributes
    ----------
    images
        Grey values (F, H, W), uint8 or uint16.
    stage_mm
        Recorded stage positions (F,).
    laser_on
        Whether the laser (True) or the lamp (False) lights an image, (F,).
    exposure_ms, time_s
        Exposure and time since the first image of the scan, (F,).
    truth
        What every profile line truly shows; its depth map is that of the first image here.
    sensor, medium, scene
        The sensor as rendered, the medium before it, and the scene in use.
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
    scene: str | Path | Scene,
    *,
    sensor: str | Path | Sensor = "thesis",
    as_built: str | Path | Sensor | None = None,
    placement: str | None = None,
    medium: str | None = None,
    spp: int = 16,
    seed: int = 0,
    water: str | float | None = None,
    without: Sequence[str] = (),
    ideal: bool = False,
    frames: Sequence[int] | None = None,
    variant: str = CPU,
) -> Recording:
    """Render a scene into arrays; the images are those that `simulate` writes with the same arguments.

    Parameters
    ----------
    scene
        Name of a scene, path of its TOML file, or the scene itself.
    sensor
        Name, path or description of the sensor.
    as_built
        The sensor that is really rendered, if it differs from the description.
    placement
        Named place of the objects, such as "near", in place of the scene's.
    medium
        Name of one of the sensor's media, in place of the scene's.
    spp
        Samples per lit pixel.
    seed
        Seed of all noise; the same seed gives the same images.
    water
        What floats in the water, in place of the medium's own: the name of a water, or a turbidity from 0 to 3.
    without
        Effects to leave out, by the names of `twin.options.Effects` ("multiple-scattering").
    ideal
        Leave out all effects: a pinhole's sharp image without noise.
    frames
        Numbers of the scan's images to render, from 0 on; all of them unless given.
    variant
        Mitsuba variant, "llvm_ad_mono" (CPU) or "cuda_ad_mono" (NVIDIA GPU).

    Raises
    ------
    DescriptionError
        A description, name or option is wrong.
    DesignError
        The sensor cannot measure the scene.
    SetupError
        Mitsuba cannot use the variant on this machine.
    """
    described = choose_scene(scene, placement=placement, medium=medium, water=water)
    _, built = choose_sensors(sensor, as_built)
    options = choose_options(spp=spp, seed=seed, without=without, ideal=ideal)
    shots = list(enumerate(described.motion.shots()))
    if frames is not None:
        if not frames or not all(0 <= number < len(shots) for number in frames):
            raise DescriptionError(f"frames is {list(frames)}; give numbers from 0 to {len(shots) - 1}")
        shots = [shots[number] for number in frames]
    use_variant(variant)
    from twin.recording.studio import Studio, truth_of_recording

    studio = Studio(built, described, options)
    taken = [studio.frame(shot, number) for number, shot in shots]
    truths = [studio.truth(shot) for _, shot in shots]
    return Recording(
        images=np.stack([frame.image for frame in taken]),
        stage_mm=np.array([frame.stage_mm for frame in taken]),
        laser_on=np.array([frame.laser_on for frame in taken]),
        exposure_ms=np.array([frame.exposure_ms for frame in taken]),
        time_s=np.array([frame.time_s for frame in taken]),
        truth=truth_of_recording(studio, truths, first=shots[0][1]),
        sensor=studio.sensor,
        medium=studio.medium,
        scene=described,
    )


def simulate(
    scene: str | Path | Scene,
    *,
    out: str | Path,
    sensor: str | Path | Sensor = "thesis",
    as_built: str | Path | Sensor | None = None,
    placement: str | Sequence[str] = (),
    medium: str | None = None,
    spp: int = 16,
    seed: int = 0,
    water: str | float | None = None,
    without: Sequence[str] = (),
    ideal: bool = False,
    resume: bool = False,
    overwrite: bool = False,
    variant: str = CPU,
    show_progress: bool = False,
    report: Callable[[str], object] = lambda line: None,
) -> list[Path]:
    """Render a scene into a capture, with the ground truth in a file beside it; returns the captures' paths.

    Parameters
    ----------
    out
        Capture to write, such as capture.h5; the truth goes to capture.truth.h5. With several placements the name
        holds ``{placement}``.
    placement
        Named place of the objects, or several, which are recorded one after the other.
    resume
        Go on with an interrupted run.
    overwrite
        Replace existing files.
    show_progress
        Draw a progress bar on the terminal.
    report
        Called with a line of text for each file that is written.
    scene, sensor, as_built, medium, spp, seed, water, without, ideal, variant
        As for `render`; the capture states ``sensor``.

    Raises
    ------
    DescriptionError, DesignError, SetupError
        As for `render`.
    OutputError
        A file exists already, or cannot be written.
    """
    out = Path(out)
    places = (placement,) if isinstance(placement, str) else tuple(placement) or (None,)
    if len(places) > 1 and "{placement}" not in out.name:
        raise DescriptionError(f"several placements would all be written to {out}: put {{placement}} into its name")
    described = [choose_scene(scene, placement=place, medium=medium, water=water) for place in places]
    paths = [out.with_name(out.name.replace("{placement}", each.placement)) for each in described]
    nominal, built = choose_sensors(sensor, as_built)
    options = choose_options(spp=spp, seed=seed, without=without, ideal=ideal)
    use_variant(variant)
    from twin.recording.studio import record_scene

    for each, path in zip(described, paths, strict=True):
        bar = (
            progress_bar(f"{each.title}, {each.placement}") if show_progress else nullcontext(lambda done, total: None)
        )
        with bar as progress:
            record_scene(
                each,
                nominal,
                path,
                as_built=built,
                options=options,
                overwrite=overwrite,
                resume=resume,
                progress=progress,
            )
        report(f"wrote {path}")
    return paths


def choose_scene(
    scene: str | Path | Scene,
    *,
    placement: str | None = None,
    medium: str | None = None,
    water: str | float | None = None,
) -> Scene:
    """The scene with what is given in place of its own placement, medium and water."""
    if not isinstance(scene, Scene):
        return load_scene(scene, placement=placement, medium=medium, water=water)
    given = {"placement": placement, "medium": medium, "water": water}
    changes = {key: value for key, value in given.items() if value is not None}
    return validated(Scene, scene.model_dump() | changes, scene.title)


def choose_sensors(sensor: str | Path | Sensor, as_built: str | Path | Sensor | None) -> tuple[Sensor, Sensor]:
    """The sensor as described and as built, whose images must fit each other; DescriptionError where they do not."""
    nominal = sensor if isinstance(sensor, Sensor) else load_sensor(sensor)
    if as_built is None:
        return nominal, nominal
    built = as_built if isinstance(as_built, Sensor) else load_sensor(as_built)
    shared = {"width_px", "height_px", "stripe_along"}
    if built.camera.model_dump(include=shared) != nominal.camera.model_dump(include=shared):
        names = [each.name if isinstance(each, Sensor) else str(each) for each in (as_built, sensor)]
        raise DescriptionError(f"'{names[0]}' has another image size or stripe orientation than '{names[1]}'")
    return nominal, built


def choose_options(*, spp: int, seed: int, without: Sequence[str], ideal: bool) -> Options:
    """Options of rendering, with some effects or all of them left out."""
    return Options(spp=spp, seed=seed, effects=(NONE if ideal else ALL).without(*without))
