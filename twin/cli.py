"""Command ``twin``: renders virtual recordings.

Each command calls a function of `twin`; its options, defaults and help texts are those of the function.
"""

import sys
from typing import Annotated, Any

from cyclopts import Parameter

import twin
from uwlts.runtime.command_line import JOBS, Call, command_from, make_program, say, show
from uwlts.runtime.console import run

app = make_program("twin", "Digital twin of an underwater laser triangulation sensor.")


@command_from(app, twin, "simulate", job="Simulate")
def simulate(call: Call) -> None:
    """Example: twin simulate spheres --sensor thesis --placement far --out spheres-far.h5"""
    call()


@command_from(app, twin, "serve", job="Simulate")
def serve(call: Call) -> None:
    """Stop with Ctrl-C.

    Example: twin serve plane --placement near --fault drop@20
    """
    with call() as served:
        say("\n".join([*served.lines(), "serving; stop with Ctrl-C"]))
        served.wait_for_end()
    say(f"ended after {served.bench.frames} frames")


@command_from(app, twin, "record", job="Simulate")
def record(call: Call) -> None:
    """Example: twin record demo --out runs/campaign"""
    say(f"wrote {call()}")


@command_from(app, twin, "dataset", job="Simulate")
def dataset(call: Call) -> None:
    """Example: twin dataset stripe-clean --scenes 20 --out runs/stripes"""
    say(f"wrote {call()}")


@command_from(app, twin, "reproduce", job="Simulate")
def reproduce(call: Call) -> None:
    """Example: twin reproduce --campaigns 1 --every 10 --out runs/quick"""
    say(f"wrote {_run_others(call)}")


@command_from(app, twin, "demo", job="Simulate")
def demo(call: Call) -> None:
    """Example: twin demo"""
    say(f"wrote {_run_others(call)}")


def _run_others(call: Call) -> Any:
    """Call a function that runs other commands; exit with the status of a failed one, which has printed its error."""
    from twin.experiments.runner import CommandFailed

    try:
        return call()
    except CommandFailed as error:
        sys.exit(error.returncode)


@command_from(app, twin, "predict", job="Design")
def predict(call: Call) -> None:
    """Example: twin predict thesis --campaigns 3 --out runs/predicted"""
    show(_run_others(call).lines())


@command_from(app, twin, "sweep", job="Design")
def sweep(call: Call) -> None:
    """Example: twin sweep baseline-angle --out runs/baseline-angle"""
    show(call().lines())


@app.command(group=JOBS["Design"])
def scenes(
    *, cameras: Annotated[bool, Parameter(negative="", help="Print image sensors and lenses for studies.")] = False
) -> None:
    """List scenes, sensors, campaigns, data sets, studies and their figures, waters, and window materials.

    Example: twin scenes
    """
    from twin.design.figures_of_merit import FIGURES
    from twin.scene.description import load_scene
    from uwlts.model.library import library_folder, list_names
    from uwlts.model.media import GLASSES, WATERS

    if cameras:
        return say((library_folder() / "parts" / "cameras.toml").read_text(encoding="utf-8"))
    for name in list_names():
        scene = load_scene(name)
        say(f"{name:24s} {scene.title}; placements: {', '.join(scene.placements)}")
    for folder in ("sensors", "campaigns", "datasets", "studies"):
        say(f"{folder}: {', '.join(list_names(folder))}")
    say(f"figures of studies: {', '.join(FIGURES)}")
    say(f"window materials: {', '.join(GLASSES)}; also by common names such as acrylic or float glass")
    say(f"waters: {', '.join(WATERS)}, or a turbidity from 0 to 3")
    for name, water in WATERS.items():
        say(f"  {name}: {water.sentence}")


def main() -> None:
    """Run the command."""
    sys.exit(run(app))
