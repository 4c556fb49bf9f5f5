"""The ``twin`` command: renders virtual recordings.

Most commands are functions of `twin` on the command line: parameters, defaults and descriptions are the functions' own.
"""

import inspect
import re
import subprocess
import sys
from collections.abc import Callable, Sequence
from functools import reduce
from operator import or_
from pathlib import Path
from types import NoneType
from typing import Annotated, Any, Literal, cast, get_args, get_origin, get_type_hints

from cyclopts import App, Parameter

import twin
from twin.options import CPU
from twin.scene.description import load_scene
from uwlts._version import __version__
from uwlts.model.library import names
from uwlts.model.waters import WATERS
from uwlts.runtime.console import run

app = App(
    name="twin",
    help="Digital twin of an underwater laser triangulation sensor.",
    version=__version__,
    help_format="markdown",
)
_SHOWING = ("show_progress", "report")
"""Parameters of functions by which commands show their progress."""


def _command(function: Callable[..., object]) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Register what is decorated as a command with the parameters and the description of a function."""
    hints, described = get_type_hints(function), _descriptions(function)
    taken = {name: one for name, one in inspect.signature(function).parameters.items() if name not in _SHOWING}
    kinds = {name: _typed(hints[name], described[name]) for name in taken}

    def register(command: Callable[..., None]) -> Callable[..., None]:
        command.__doc__ = _sections(function)[0].replace("`", "") + f"{inspect.getdoc(command)}"
        command.__annotations__ = {**kinds, "return": None}
        parameters = [one.replace(annotation=kinds[name]) for name, one in taken.items()]
        cast(Any, command).__signature__ = inspect.Signature(parameters, return_annotation=None)
        app.command(command)
        return command

    return register


def _descriptions(function: Callable[..., object]) -> dict[str, str]:
    """The docstring's description of each parameter; "As for `another`" leads to that function's."""
    found = {}
    for listed, block in re.findall(r"^(\w.*)\n((?:    .*\n?)+)", _sections(function)[2], flags=re.MULTILINE):
        other = re.match(r"\s*As for `(\w+)`", block)
        elsewhere = _descriptions(getattr(twin, other[1])) if other else {}
        found |= {name: elsewhere.get(name, " ".join(block.split())) for name in listed.split(", ")}
    return found


def _sections(function: Callable[..., object]) -> list[str]:
    """The docstring's summary, then titles and texts of its sections in turn."""
    return re.split(r"^(\w+)\n-+\n", f"{inspect.getdoc(function)}\n", flags=re.MULTILINE)


def _typed(hint: Any, described: str) -> Any:
    """The annotation of a command's parameter: those of a function's types that can be given as text."""
    kinds = get_args(hint) or (hint,)
    text = described.replace("`", "")
    if Sequence[str] in (hint, *kinds):
        return Annotated[tuple[str, ...], Parameter(consume_multiple=True, negative="", help=text)]
    if hint is bool:
        return Annotated[bool, Parameter(negative="", help=text)]
    if get_origin(hint) is not Literal:
        hint = reduce(or_, (kind for kind in kinds if kind in (str, int, float, bool, NoneType)))
    return Annotated[hint, Parameter(help=text)]


@_command(twin.simulate)
def simulate(scene: str, **options: Any) -> None:
    """Example: twin simulate spheres --sensor thesis --placement far --out spheres-far.h5"""
    twin.simulate(scene, **options, show_progress=True, report=print)


@_command(twin.serve)
def serve(scene: str, **options: Any) -> None:
    """The command serves until Ctrl-C.

    Example: twin serve plane --placement near --fault drop@20
    """
    with twin.serve(scene, **options, report=lambda line: print(line, flush=True)) as served:
        print("\n".join([*served.lines(), "serving; Ctrl-C ends it"]), flush=True)
        served.wait_for_end()
    print(f"ended after {served.rates()}")


@_command(twin.record)
def record(campaign: str, **options: Any) -> None:
    """Example: twin record demo --out runs/campaign"""
    print(f"wrote {twin.record(campaign, **options, show_progress=True)}")


@_command(twin.dataset)
def dataset(description: str, **options: Any) -> None:
    """Example: twin dataset stripe-clean --scenes 20 --out runs/stripes"""
    print(f"wrote {twin.dataset(description, **options, show_progress=True)}")


@_command(twin.reproduce)
def reproduce(campaign: str | None = None, **options: Any) -> None:
    """Example: twin reproduce --campaigns 1 --every 10 --out runs/quick"""
    _run_others(lambda: twin.reproduce(campaign, **options, show_progress=True))


@_command(twin.demo)
def demo(*out: str) -> None:
    """Example: twin demo"""
    _run_others(lambda: twin.demo(*out))


def _run_others(work: Callable[[], object]) -> None:
    """Do what runs other commands, and exit as the one that fails, which has printed why."""
    try:
        work()
    except subprocess.CalledProcessError as error:
        sys.exit(error.returncode)


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
def scenes() -> None:
    """List the scenes, sensors, campaigns, data sets, studies and waters that ship with the program.

    Example: twin scenes
    """
    for name in names():
        scene = load_scene(name)
        print(f"{name:24s} {scene.title}; placements: {', '.join(scene.placements)}")
    for folder in ("sensors", "campaigns", "datasets", "studies"):
        print(f"{folder}: {', '.join(names(folder))}")
    print(f"waters: {', '.join(WATERS)}, or a turbidity from 0 to 3")
    for name, water in WATERS.items():
        print(f"  {name}: {water.sentence}")


def main() -> None:
    """Entry point."""
    sys.exit(run(app))


if __name__ == "__main__":
    main()
