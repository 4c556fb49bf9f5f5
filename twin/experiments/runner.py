"""Runner of experiments: command lines of the sensor's software calibrate, reconstruct and measure recorded campaigns.

The twin shares no mathematics with the sensor's software, so an experiment consists of the commands that a user would
type. Each one is skipped if its output is newer than its inputs: an interrupted experiment is resumed.
"""

import io
import runpy
import shlex
import subprocess
import sys
from collections.abc import Mapping, Sequence
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

from twin.scene.campaign import Take
from twin.scene.description import Scene
from twin.scene.forms import PittedPipe, Weld
from uwlts.errors import DescriptionError, Error, SetupError
from uwlts.runtime.console import INTERRUPTED
from uwlts.runtime.progress import ProgressListener, ignore_progress
from uwlts.runtime.workers import Lost, open_workers

AT_ONCE = 2  # number of parallel commands of a stage: only rendering uses all processors by itself
_STEP_IMAGES = 5  # fewer images of a step standard belong to a calibration; a scan has at least this many profiles

COLOURED = "coloured.ply"  # end of the names of clouds with the colours of their deviations

THESIS = "thesis"  # begin of the name of a file with figures of `uwlts thesis`

Inspected = Literal["pipe", "weld"]  # kind of object for `uwlts inspect`


class CommandFailed(Error):
    """A command run by a function has failed and printed the reason; ``returncode`` is its exit code."""

    def __init__(self, line: str, returncode: int):
        super().__init__(f"{line} ended with exit code {returncode}")
        self.returncode = returncode


@dataclass(frozen=True)
class Method:
    """Calibration of a sensor, and the scans that are measured with it.

    ``evidence`` are names of recordings by option of `uwlts calibrate`, or of another ``command``; ``options`` its
    other options. ``suffix`` ends the names of files, so that several methods can share a folder, ``made`` that of the
    calibration if it is another method's. ``detection`` are options of `uwlts reconstruct`. Objects are inspected
    unless ``inspected`` is False. ``with_truth`` compares all scans with the ground truth of their recordings, so that
    scans of any scene count. ``thesis`` are names of recordings by option of `uwlts thesis`.
    """

    name: str
    evidence: Mapping[str, Sequence[str]]
    scans: Sequence[str]
    options: str = ""
    suffix: str = ""
    command: str = "calibrate"
    made: str | None = None
    detection: str = ""
    inspected: bool = True
    with_truth: bool = True
    thesis: Mapping[str, Sequence[str]] = field(default_factory=dict)

    def calibration(self, folder: Path) -> Path:
        """Return the calibration's file in a campaign's folder."""
        return folder / f"calibration{self.suffix if self.made is None else self.made}.json"

    def result(self, folder: Path, scan: str, kind: str) -> Path:
        """Return a scan's file of a kind: cloud.h5, evaluation.json, inspection.json or `COLOURED`."""
        return folder / f"{scan}{self.suffix}.{kind}"

    def restrict_to(self, takes: Mapping[str, Take]) -> "Method":
        """Return the method with the scans of a campaign; DescriptionError if it lacks a recording for the calibration.

        A method without scans needs no calibration.
        """
        known = {option: [name for name in names if name in takes] for option, names in self.thesis.items()}
        of_campaign = replace(self, scans=[scan for scan in self.scans if scan in takes], thesis=known)
        wanted = [name for names in self.evidence.values() for name in names]
        if of_campaign.scans and (missing := [name for name in wanted if name not in takes]):
            raise DescriptionError(
                f"the campaign has no recording {', '.join(missing)}, which the calibration {self.name!r} needs"
            )
        return of_campaign


@dataclass(frozen=True)
class CommandLine:
    """Command line of a stage, with the files that it reads and the one that it writes."""

    stage: str
    text: str
    reads: tuple[Path, ...]
    writes: Path

    def is_done(self) -> bool:
        """Return whether the output is there and no older than the inputs."""
        if not self.writes.is_file():
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
    kinds: dict[type, Inspected] = {PittedPipe: "pipe", Weld: "weld"}
    return next((kind for thing in scene.objects for of, kind in kinds.items() if isinstance(thing, of)), None)


def plan_lines(
    folder: Path, takes: Mapping[str, Take], methods: Sequence[Method], *, coloured: bool = False
) -> list[CommandLine]:
    """Return the command lines that calibrate, reconstruct and measure in a campaign's folder, by stage.

    With ``coloured``, clouds of the first method are also written with the colours of their deviations.
    """
    lines: dict[Path, CommandLine] = {}
    for method in methods:
        made = method.calibration(folder)
        arguments = (*_give(folder, method.evidence), *shlex.split(method.options), "--out", made)
        lines[made] = _plan("calibrate", made, method.command, *arguments)
    for method in methods:
        calibration = method.calibration(folder)
        if any(method.thesis.values()):
            made = method.result(folder, THESIS, "json")
            lines[made] = _plan("evaluate", made, "thesis", calibration, *_give(folder, method.thesis), "--out", made)
        for scan in method.scans:
            capture, cloud = folder / f"{scan}.h5", method.result(folder, scan, "cloud.h5")
            arguments = (capture, "--calibration", calibration, "--out", cloud, *shlex.split(method.detection))
            lines[cloud] = _plan("reconstruct", cloud, "reconstruct", *arguments)
            if method.with_truth or takes[scan].scene.artefact is not None:
                made = method.result(folder, scan, "evaluation.json")
                compared = ["--truth", str(capture.with_suffix(".truth.h5"))] if method.with_truth else []
                if method.with_truth and coloured and method is methods[0]:
                    compared += ["--coloured", str(method.result(folder, scan, COLOURED))]
                lines[made] = _plan("evaluate", made, "evaluate", cloud, "--out", made, *compared)
            if method.inspected and (kind := inspected_as(takes[scan].scene)) is not None:
                made = method.result(folder, scan, "inspection.json")
                lines[made] = _plan("evaluate", made, "inspect", cloud, kind, "--out", made)
    return sorted(lines.values(), key=lambda line: ("calibrate", "reconstruct", "evaluate").index(line.stage))


def _plan(stage: str, writes: Path, *words: str | Path) -> CommandLine:
    """Return the command line of some words; it reads the paths among them that it does not write."""
    text = shlex.join(["uwlts", *map(str, words), "--overwrite"])
    return CommandLine(stage, text, tuple(one for one in words if isinstance(one, Path) and one != writes), writes)


def _give(folder: Path, recordings: Mapping[str, Sequence[str]]) -> list[str | Path]:
    """Return the words that give recordings by options."""
    given = {option: [folder / f"{name}.h5" for name in names] for option, names in recordings.items() if names}
    return [word for option, paths in given.items() for word in (f"--{option}", *paths)]


def run_stages(
    lines: Sequence[CommandLine], *, scheduler: str | None = None, progress: ProgressListener = ignore_progress
) -> None:
    """Run command lines by stage, those of a stage in parallel; lines that are done are skipped.

    With ``scheduler``, the address of a Dask scheduler, its workers run them; they need the same folder.

    Raises CommandFailed if one fails; its output, which has been printed, gives the reason. Raises SetupError if a
    worker ended unexpectedly, or the scheduler does not answer.
    """
    done, total = 0, len(lines)
    with open_workers(workers=AT_ONCE, scheduler=scheduler) as workers:
        for stage in dict.fromkeys(line.stage for line in lines):
            of_stage = [line for line in lines if line.stage == stage]
            waiting = [line.text for line in of_stage if not line.is_done()]
            done += len(of_stage) - len(waiting)
            progress(done, total, stage)
            for line, ended in workers.map_unordered(run_apart if scheduler else run_line, waiting):
                if isinstance(ended, Lost):
                    raise SetupError(f"{line}: {ended.reason}")
                code, output = ended
                if code:
                    print(output, end="", flush=True)
                    raise CommandFailed(line, code)
                done += 1
                progress(done, total, stage)


def run_line(line: str) -> tuple[int, str]:
    """Run a command as ``python -m`` does, and return its exit code and output with errors.

    The command runs in this process: importing the shared modules takes most commands longer than their work.
    """
    program, *arguments = shlex.split(line)
    output = io.StringIO()
    sys.argv = [program, *arguments]
    code = 0
    with redirect_stdout(output), redirect_stderr(output):
        try:
            runpy.run_module(program, run_name="__main__", alter_sys=True)
        except SystemExit as end:
            code = int(end.code or 0)
    if code == INTERRUPTED:
        raise KeyboardInterrupt
    return code, output.getvalue()


def run_apart(line: str) -> tuple[int, str]:
    """Run a command as a separate program, and return its exit code and output with errors.

    Several threads of a process can do so at the same time.
    """
    arguments = [sys.executable, "-m", *shlex.split(line)]
    done = subprocess.run(arguments, check=False, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    return done.returncode, done.stdout
