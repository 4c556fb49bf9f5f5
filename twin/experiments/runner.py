"""Runner of experiments: command lines of the sensor's software calibrate, reconstruct and measure recorded campaigns.

The twin shares no mathematics with the sensor's software, so an experiment consists of the commands that a user would
type. Each one is skipped if its output is newer than its inputs: an interrupted experiment is resumed.
"""

import shlex
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Literal

from twin.experiments.command_lines import run_apart, run_line
from twin.scene.campaign import Take
from twin.scene.description import Scene
from twin.scene.forms import PittedPipe, Weld
from uwlts.errors import CommandFailed, SetupError
from uwlts.runtime.progress import ProgressListener, ignore_progress
from uwlts.runtime.workers import Lost, Workers, open_workers

AT_ONCE = 2
"""Number of parallel commands of a stage: only rendering uses all processors by itself."""
_STEP_IMAGES = 5
"""Fewer images of a step standard belong to a calibration; a scan has at least this many profiles."""

Inspected = Literal["flange", "pipe", "weld"]
"""Kind of object for `uwlts inspect`; a plane is the face of a flange."""


@dataclass(frozen=True)
class Method:
    """Calibration of a sensor, and the scans that are measured with it.

    ``evidence`` are names of recordings by option of `uwlts calibrate`, ``options`` its other options. ``suffix`` ends
    the names of files, so that several methods can share a folder.
    """

    name: str
    evidence: Mapping[str, Sequence[str]]
    scans: Sequence[str]
    options: str = ""
    suffix: str = ""

    def calibration(self, folder: Path) -> Path:
        """Return the calibration's file in a campaign's folder."""
        return folder / f"calibration{self.suffix}.json"

    def result(self, folder: Path, scan: str, kind: str) -> Path:
        """Return a scan's file of a kind: cloud.h5, evaluation.json or inspection.json."""
        return folder / f"{scan}{self.suffix}.{kind}"


@dataclass(frozen=True)
class CommandLine:
    """Command line of a stage, with the files that it reads and the one that it writes; without one, it always runs."""

    stage: str
    text: str
    reads: tuple[Path, ...]
    writes: Path | None

    def is_done(self) -> bool:
        """Return whether the output is there and no older than the inputs."""
        if self.writes is None or not self.writes.is_file():
            return False
        made = self.writes.stat().st_mtime_ns
        return all(path.stat().st_mtime_ns <= made for path in self.reads)


def evidence_of(take: Take) -> str | None:
    """Return the option of the calibration for which a recording was made; None for a scan."""
    if take.scene.target is not None:
        return "air" if take.sensor.medium(take.scene.medium).kind == "air" else "water"
    is_step = (take.scene.artefact or {}).get("kind") == "step"
    return "step" if is_step and take.scene.motion.images() < _STEP_IMAGES else None


def inspected_as(scene: Scene) -> Inspected | None:
    """Return the kind of object for the inspection of a scene; None if it is not inspected."""
    if (scene.artefact or {}).get("kind") == "plane":
        return "flange"
    kinds: dict[type, Inspected] = {PittedPipe: "pipe", Weld: "weld"}
    return next((kind for thing in scene.objects for of, kind in kinds.items() if isinstance(thing, of)), None)


def is_evaluated(scene: Scene) -> bool:
    """Return whether a scene shows an artefact with a calibrated size."""
    return (scene.artefact or {}).get("kind") not in (None, "plane")


def plan_lines(
    folder: Path, takes: Mapping[str, Take], methods: Sequence[Method], *, with_truth: bool, coloured: bool = False
) -> list[CommandLine]:
    """Return the command lines that calibrate, reconstruct and measure in a campaign's folder, by stage.

    ``with_truth`` compares all clouds with the ground truth of their recordings, too; ``coloured`` also writes clouds
    with the colours of their deviations.
    """
    lines = [_calibrate(folder, method) for method in methods]
    for method in methods:
        for scan in method.scans:
            lines += _measure(folder, method, takes[scan], with_truth=with_truth, coloured=coloured)
    return sorted(lines, key=lambda line: ("calibrate", "reconstruct", "evaluate").index(line.stage))


def _calibrate(folder: Path, method: Method) -> CommandLine:
    given = {option: [folder / f"{name}.h5" for name in names] for option, names in method.evidence.items() if names}
    words = " ".join(f"--{option} {' '.join(map(_quoted, paths))}" for option, paths in given.items())
    more = f" {method.options}" if method.options else ""
    made = method.calibration(folder)
    text = f"uwlts calibrate {words}{more} --out {_quoted(made)} --overwrite"
    return CommandLine("calibrate", text, tuple(path for paths in given.values() for path in paths), made)


def _measure(folder: Path, method: Method, take: Take, *, with_truth: bool, coloured: bool) -> Iterator[CommandLine]:
    capture, calibration = folder / f"{take.name}.h5", method.calibration(folder)
    cloud = method.result(folder, take.name, "cloud.h5")
    known = f"--calibration {_quoted(calibration)} --out {_quoted(cloud)}"
    yield CommandLine(
        "reconstruct", f"uwlts reconstruct {_quoted(capture)} {known} --overwrite", (capture, calibration), cloud
    )
    if with_truth or is_evaluated(take.scene):
        made, words = method.result(folder, take.name, "evaluation.json"), ""
        if with_truth:
            words = f" --truth {_quoted(capture.with_suffix('.truth.h5'))}"
        if coloured:
            words += f" --coloured {_quoted(folder / f'{take.name}{method.suffix}-coloured.ply')}"
        text = f"uwlts evaluate {_quoted(cloud)} --out {_quoted(made)}{words} --overwrite"
        yield CommandLine("evaluate", text, (cloud,), made)
    if (kind := inspected_as(take.scene)) is not None:
        made = method.result(folder, take.name, "inspection.json")
        yield CommandLine(
            "evaluate", f"uwlts inspect {_quoted(cloud)} {kind} --out {_quoted(made)} --overwrite", (cloud,), made
        )


def _quoted(path: Path) -> str:
    return shlex.quote(str(path))


def run_stages(
    lines: Sequence[CommandLine],
    *,
    scheduler: str | None = None,
    quiet: bool = True,
    progress: ProgressListener = ignore_progress,
) -> dict[str, float]:
    """Run command lines by stage, those of a stage in parallel, and return the seconds of each stage.

    Lines that are done are skipped. With ``scheduler``, the address of a Dask scheduler, its workers run them; they
    need the same folder. Without ``quiet``, lines are printed as they start, and their output as they end.

    Raises CommandFailed if one fails; its output, which has been printed, gives the reason. Raises SetupError if a
    worker ended unexpectedly, or the scheduler does not answer.
    """
    seconds: dict[str, float] = {}
    done, total = 0, len(lines)
    with open_workers(workers=AT_ONCE, scheduler=scheduler) as workers:
        run = partial(run_apart if scheduler else run_line, quiet=quiet)
        for stage in dict.fromkeys(line.stage for line in lines):
            start = time.perf_counter()
            of_stage = [line for line in lines if line.stage == stage]
            waiting = [line for line in of_stage if not line.is_done()]
            done += len(of_stage) - len(waiting)
            progress(done, total, stage)
            for _ in run_lines(workers, [line.text for line in waiting], run=run, quiet=quiet):
                done += 1
                progress(done, total, stage)
            seconds[stage] = round(time.perf_counter() - start, 2)
    return seconds


def run_lines(
    workers: Workers, lines: Iterable[str], *, run: Callable[[str], tuple[int, str]], quiet: bool
) -> Iterator[str]:
    """Run independent command lines in parallel; yield each one when it has ended. Raises as `run_stages`."""
    for line, ended in workers.map_unordered(run, lines if quiet else _announce(lines)):
        if isinstance(ended, Lost):
            raise SetupError(f"{line}: {ended.reason}")
        code, output = ended
        if code or not quiet:
            print(output, end="", flush=True)
        if code:
            raise CommandFailed(line, code)
        yield line


def _announce(lines: Iterable[str]) -> Iterator[str]:
    """Yield the commands; print each one when it starts."""
    for line in lines:
        print(f"$ {line}", flush=True)
        yield line
