"""The ``twin`` command: renders virtual recordings."""

import subprocess
import sys
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import App, Parameter

import twin
import uwlts
from twin.options import CPU, use_variant
from twin.recording.demonstration import FOLDER
from twin.recording.recording import choose_options, choose_scene, choose_sensors
from twin.scene.campaign import campaign_names
from twin.scene.description import load_scene, scene_names
from uwlts.model.errors import DescriptionError
from uwlts.model.library import names
from uwlts.model.waters import WATERS
from uwlts.runtime.console import run

app = App(
    name="twin",
    help="Digital twin of an underwater laser triangulation sensor.",
    version=uwlts.__version__,
    help_format="plaintext",
)


@app.command
def simulate(
    scene: str,
    *,
    sensor: str = "thesis",
    out: Path,
    as_built: str | None = None,
    placement: Annotated[tuple[str, ...], Parameter(consume_multiple=True, negative="")] = (),
    medium: str | None = None,
    spp: int = 16,
    seed: int = 0,
    water: float | str | None = None,
    without: Annotated[tuple[str, ...], Parameter(consume_multiple=True, negative="")] = (),
    ideal: Annotated[bool, Parameter(negative="")] = False,
    resume: Annotated[bool, Parameter(negative="")] = False,
    overwrite: Annotated[bool, Parameter(negative="")] = False,
    variant: Literal["llvm_ad_mono", "cuda_ad_mono"] = CPU,
) -> None:
    """Render a scene into a capture, with the ground truth in a file beside it.

    Example: twin simulate spheres --sensor thesis --placement far --out spheres-far.h5

    Parameters
    ----------
    scene
        Name of a scene (see: twin scenes) or path of its TOML file.
    sensor
        Name or path of the sensor description that the capture states.
    out
        Capture to write, such as capture.h5; the truth goes to capture.truth.h5. With several placements the name
        holds {placement}.
    as_built
        Name or path of the sensor that is really rendered, if it differs from the description.
    placement
        Named place of the objects, such as near, standoff or far; several are recorded one after the other.
    medium
        Name of one of the sensor's media, in place of the scene's.
    spp
        Samples per lit pixel.
    seed
        Seed of all noise; the same seed gives the same capture.
    water
        What floats in the water, in place of the medium's own: pure, clear, coastal, harbour, jerlov-I to jerlov-9C,
        or a turbidity from 0 (pure) over 1 (clear) and 2 (coastal) to 3 (harbour).
    without
        Effects to leave out: defocus, haze, multiple-scattering, secondary-light, gloss, motion, ambient, speckle,
        fixed-pattern, noise.
    ideal
        Leave out all of these effects: a pinhole's sharp image without noise.
    resume
        Go on with an interrupted run.
    overwrite
        Replace existing files.
    variant
        Mitsuba variant: llvm_ad_mono (CPU) or cuda_ad_mono (NVIDIA GPU).
    """
    twin.simulate(
        scene,
        sensor=sensor,
        out=out,
        as_built=as_built,
        placement=placement,
        medium=medium,
        spp=spp,
        seed=seed,
        water=water,
        without=without,
        ideal=ideal,
        resume=resume,
        overwrite=overwrite,
        variant=variant,
        show_progress=True,
        report=print,
    )


@app.command
def serve(
    scene: str,
    *,
    sensor: str = "thesis",
    as_built: str | None = None,
    placement: str | None = None,
    medium: str | None = None,
    water: float | str | None = None,
    spp: int = 16,
    seed: int = 0,
    without: Annotated[tuple[str, ...], Parameter(consume_multiple=True, negative="")] = (),
    ideal: Annotated[bool, Parameter(negative="")] = False,
    stage_start: float | None = None,
    lamp: bool | None = None,
    speed_up: float = 1.0,
    fault: Annotated[tuple[str, ...], Parameter(consume_multiple=True, negative="")] = (),
    variant: Literal["llvm_ad_mono", "cuda_ad_mono"] = CPU,
) -> None:
    """Serve a scene as hardware: a GigE Vision camera and a Grbl controller with stage and laser, until Ctrl-C.

    A frame shows what the camera sees where the stage stands, with the laser as it is. Camera and controller can be
    reached from this machine only.

    Example: twin serve plane --placement near --fault drop@20

    Parameters
    ----------
    scene
        Name of a scene (see: twin scenes) or path of its TOML file.
    sensor
        Name or path of the sensor description that the sensor's software will be given.
    as_built
        Name or path of the sensor that is really rendered, if it differs from the description.
    placement
        Named place of the objects, such as near, standoff or far.
    medium
        Name of one of the sensor's media, in place of the scene's.
    water
        What floats in the water, in place of the medium's own: a name or a turbidity, as in twin simulate.
    spp
        Samples per lit pixel.
    seed
        Seed of all noise.
    without
        Effects to leave out, as in twin simulate; a moving stage does not blur the image in any case.
    ideal
        Leave out all effects: a pinhole's sharp image without noise.
    stage_start
        Stage position in mm at which the scene's motion starts; the middle of the travel is used unless given.
    lamp
        Whether the lamp is on while the laser is off; if the scene's motion has lamp images unless given.
    speed_up
        How much faster than real the stage moves.
    fault
        Faults as NAME[:ARGUMENT][@FRAME], each with the frame of that number, else with the first: drop, repeat or cut
        (so many frames), delay (s), camera-disconnect, stage-disconnect, mute, stall, stop-short or lose-steps (steps),
        alarm (number), hold, restart, garbage, break-laser.
    variant
        Mitsuba variant: llvm_ad_mono (CPU) or cuda_ad_mono (NVIDIA GPU).
    """
    description = choose_scene(scene, placement=placement, medium=medium, water=water)
    options = choose_options(spp=spp, seed=seed, without=without, ideal=ideal)
    if not speed_up > 0:
        raise DescriptionError(f"speed_up is {speed_up:g}; it must be positive")
    _, built = choose_sensors(sensor, as_built)
    use_variant(variant)
    from twin.devices.bench import parse_fault
    from twin.devices.serve import serve as serve_twin
    from twin.devices.serve import wait_for_end

    faults = [parse_fault(text) for text in fault]
    with serve_twin(
        description,
        built,
        options=options,
        stage_start_mm=stage_start,
        lamp=lamp,
        faults=faults,
        speed_up=speed_up,
        report=lambda line: print(line, flush=True),
    ) as served:
        print("\n".join([*served.lines(), "serving; Ctrl-C ends it"]), flush=True)
        wait_for_end(served)
    print(f"ended after {served.rates()}")


@app.command
def reproduce(
    campaign: str | None = None,
    *,
    joint: Annotated[bool, Parameter(negative="")] = False,
    out: Path | None = None,
    campaigns: int = 2,
    first: int = 0,
    every: int = 1,
    spp: int = 16,
    trials: int = 100,
    workers: int | None = None,
    overwrite: Annotated[bool, Parameter(negative="")] = False,
    variant: Literal["llvm_ad_mono", "cuda_ad_mono"] = CPU,
) -> None:
    """Render the thesis's whole evaluation, evaluate it by all its methods, and set its tables beside the results.

    Every campaign has imperfections and noise of its own. Run again, it goes on where it was stopped, and adds
    campaigns if more are asked for. The report is OUT/report.html.

    Example: twin reproduce --campaigns 1 --every 10 --out runs/quick

    Parameters
    ----------
    campaign
        Name or path of the campaign's description; "thesis" unless given, or "joint" with --joint.
    joint
        Compare the joint calibration with the thesis's two ways on the same images; writes OUT/report.html and
        summary.json.
    out
        Folder for campaigns and report; runs/CAMPAIGN unless given.
    campaigns
        How many campaigns there shall be.
    first
        Seed of the first one; the others follow.
    every
        Take only every n-th profile of the scans; calibrations keep all their images.
    spp
        Samples per lit pixel.
    trials
        Trials of the Monte-Carlo propagation of every campaign, 0 for none.
    workers
        Recordings rendered at a time; as many as there are processors unless given.
    overwrite
        Render and evaluate everything anew.
    variant
        Mitsuba variant: llvm_ad_mono (CPU) or cuda_ad_mono (NVIDIA GPU).
    """
    try:
        twin.reproduce(
            campaign,
            joint=joint,
            out=out,
            campaigns=campaigns,
            first=first,
            every=every,
            spp=spp,
            trials=trials,
            workers=workers,
            overwrite=overwrite,
            variant=variant,
            show_progress=True,
        )
    except subprocess.CalledProcessError as error:
        sys.exit(error.returncode)  # the command has printed why


@app.command
def sweep(
    study: str,
    *,
    out: Path | None = None,
    designs: int | None = None,
    verify: int | None = None,
    workers: int | None = None,
    scheduler: str | None = None,
    overwrite: Annotated[bool, Parameter(negative="")] = False,
    variant: Literal["llvm_ad_mono", "cuda_ad_mono"] = CPU,
) -> None:
    """Find the sensor to build: judge many designs by formulas, improve the best, and render some to make sure.

    Run again, it goes on where it was stopped; several machines may run it on one folder at the same time. OUT holds
    report.html, designs.csv, summary.json and the winning design as winner.toml, which twin simulate takes as --sensor.

    Example: twin sweep baseline-angle --out runs/baseline-angle

    Parameters
    ----------
    study
        Name (see: twin scenes) or path of the study's description.
    out
        Folder for all results; runs/STUDY unless given.
    designs
        How many designs a random, Sobol or optimised study judges, in place of what the study says.
    verify
        How many designs are rendered beside the base sensor, 0 for none at all, in place of what the study says.
    workers
        Processes of this machine; as many as there are processors unless given.
    scheduler
        Address of a Dask scheduler, such as tcp://host:8786, whose workers are used in place of this machine's.
    overwrite
        Remove what an earlier sweep has left in the folder.
    variant
        Mitsuba variant for rendering: llvm_ad_mono (CPU) or cuda_ad_mono (NVIDIA GPU).
    """
    result = twin.sweep(
        study,
        out=out,
        designs=designs,
        verify=verify,
        workers=workers,
        scheduler=scheduler,
        overwrite=overwrite,
        variant=variant,
        show_progress=True,
    )
    print("\n".join(result.lines()))


@app.command
def demo(*, out: Path = FOLDER) -> None:
    """Do the main job in a row of commands: record a virtual campaign, calibrate, reconstruct, judge, report.

    Runs exactly the commands that it prints, two at a time; each could be typed by hand. The report is OUT/report.html.

    Example: twin demo

    Parameters
    ----------
    out
        Folder for all results.
    """
    try:
        twin.demo(out)
    except subprocess.CalledProcessError as error:
        sys.exit(error.returncode)  # the command has printed why


@app.command
def scenes() -> None:
    """List the scenes, sensors, campaigns, studies and waters that ship with the program.

    Example: twin scenes
    """
    for name in scene_names():
        scene = load_scene(name)
        print(f"{name:24s} {scene.title}; placements: {', '.join(scene.placements)}")
    print(f"sensors: {', '.join(names('sensors'))}")
    print(f"campaigns: {', '.join(campaign_names())}")
    print(f"studies: {', '.join(names('studies'))}")
    print(f"waters: {', '.join(WATERS)}, or a turbidity from 0 to 3")
    for name, water in WATERS.items():
        print(f"  {name}: {water.sentence}")


def main() -> None:
    """Entry point."""
    sys.exit(run(app))


if __name__ == "__main__":
    main()
