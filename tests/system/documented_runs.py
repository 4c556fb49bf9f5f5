"""Run the blocks of a documentation page in order, with smaller versions of the descriptions that commands name."""

import glob
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import tomllib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
import tomli_w

from tests.documented import APPS, ROOT, Block, blocks, words_of
from tests.system.in_process import run_program
from twin.cli import app as twin_app
from uwlts.cli import app as uwlts_app
from uwlts.model.library import library_folder

_SIZE_PX = {"width_px": 640, "height_px": 512, "pixel_size_um": 10.6}
"""Half of the thesis's pixels along each side, with the same view: the smallest size with which targets are found."""
_PRINCIPAL_POINT_PX = [323.1, 252.95]
"""Half of that of `thesis-as-built`."""
_MOST_PLACES = {"target": 5, "target-through-window": 5, "step": 3}
"""Number of stage positions in a calibration; all other scans have `_PLACES`."""
_PLACES = 12
_SAMPLES = "2"
"""Samples per lit pixel: stripes and circles are found with as few."""
OVERWRITE = " --overwrite"


@dataclass(frozen=True)
class Page:
    """Instructions to run a page: required files, and differences from the page."""

    given: dict[str, str] = field(default_factory=dict)
    """File in the page's folder: file of the shared campaign."""
    texts: dict[str, str] = field(default_factory=dict)
    """Text of a file in the page's folder."""
    small_python: bool = False
    """True if Python blocks also use the smaller descriptions; tutorials are fast enough."""
    figures: str = ""
    """Statements that check the figures of the page's Python blocks, among their names."""
    before: str = ""
    """Command lines that create the other required files."""
    instead: dict[str, str] = field(default_factory=dict)
    """Words of the page: their replacements, shorter or existing ones, with the same options."""
    not_run: dict[str, str] = field(default_factory=dict)
    """Beginning of a command or Python block: why it is not run."""
    again: tuple[str, ...] = ()
    """Beginnings of commands that are alternatives to earlier ones and write the same files: run with --overwrite."""
    tables: dict[str, int] = field(default_factory=dict)
    """File in the page's folder: number of the TOML block of the page that is written to it, from 0."""
    prepare: dict[str, Callable[["Runner"], None]] = field(default_factory=dict)
    """Beginning of a command: preparation before it runs."""
    ready: dict[str, str] = field(default_factory=dict)
    """Beginning of a command that runs until Ctrl-C: words that it prints when it is ready."""


@dataclass(frozen=True)
class Campaign:
    """Commands that several pages take for granted or contain, run once in a folder, and the files of each."""

    folder: Path
    files: dict[str, list[Path]] = field(default_factory=dict)

    def run(self, commands: str, small: Path) -> None:
        """Run command lines in the folder."""
        runner = Runner(self.folder, small)
        for command in commands.strip().splitlines():
            before = set(self.folder.rglob("*"))
            runner.command(command)
            made = [path for path in self.folder.rglob("*") if path not in before and path.is_file()]
            self.files[command] = [path.relative_to(self.folder) for path in made]

    def copied(self, command: str, folder: Path) -> bool:
        """Copy the files of a command with the same words and the same inputs; False if there is none."""
        words = [word for word in words_of(command) if (self.folder / word).is_file()]
        inputs = [Path(word) for word in words if Path(word) not in self.files.get(command, [])]
        same = all((folder / path).exists() and (folder / path).samefile(self.folder / path) for path in inputs)
        if command not in self.files or not same:
            return False
        for path in self.files[command]:
            (folder / path).unlink(missing_ok=True)
            _copied(self.folder / path, folder / path)
        return True


def write_small_descriptions(folder: Path) -> None:
    """Write the thesis's sensors with fewer pixels and all scenes with fewer places of the stage, by their names."""
    for name in ("thesis", "thesis-as-built"):
        camera: dict[str, Any] = _SIZE_PX | ({"principal_point_px": _PRINCIPAL_POINT_PX} if name != "thesis" else {})
        _write(folder / f"{name}.toml", {"base": name, "name": name, "camera": camera})
    for path in library_folder().glob("*.toml"):
        motion = tomllib.loads(path.read_text(encoding="utf-8")).get("motion", {})
        changes: dict[str, Any] = {}
        if motion.get("kind") == "vehicle":
            changes = {"waypoints": motion["waypoints"][:3], "frame_rate_hz": 4.0}
        elif "step_mm" in motion:
            count = min(motion["count"], _MOST_PLACES.get(path.stem, _PLACES))
            changes = {"count": count, "step_mm": motion["step_mm"] * (motion["count"] - 1) / (count - 1)}
        _write(folder / path.name, {"base": path.stem} | ({"motion": changes} if changes else {}))
    for path in (library_folder() / "studies").glob("*.toml"):
        study = tomllib.loads(path.read_text(encoding="utf-8"))
        for values in study["variables"].values():
            values |= {"steps": 5} if "steps" in values else {}
        study["sampling"] |= {"designs": 64} if "designs" in study["sampling"] else {}
        _write(folder / path.name, study | {"verify": 0})


def _write(path: Path, table: dict[str, Any]) -> None:
    path.write_text(tomli_w.dumps(table), encoding="utf-8")


class Runner:
    """Runs command lines and Python in a folder; `small` holds the smaller descriptions.

    The project's own commands run in this process, unless `separate`: signals and terminals are as for a user then.
    Commands of the shared campaign are not run again.
    """

    def __init__(self, folder: Path, small: Path, *, shared: Campaign | None = None, separate: bool = False) -> None:
        self.folder, self.small, self.shared, self.separate = folder, small, shared, separate
        self.names: dict[str, Any] = {"__name__": "page"}
        self._going: list[subprocess.Popen[str]] = []

    def command(self, command: str, *, ready: str | None = None) -> str:
        """Run a command line, or start it until it has printed `ready`; return what it printed."""
        if self.shared and self.shared.copied(command.removesuffix(OVERWRITE), self.folder):
            return ""
        words = [name for word in words_of(command) for name in self._expanded(word)]
        if words[0] == "cd":
            # A copy: files written by the commands there do not belong in the project.
            shutil.copytree(ROOT / words[1], self.folder / words[1])
            self.folder = self.folder / words[1]
            return ""
        if words[0] in APPS:
            words = self._smaller(words)
        if ready is not None:
            return self._started(words, ready)
        if words[0] in APPS and not self.separate:
            with pytest.MonkeyPatch.context() as patch:
                patch.chdir(self.folder)
                done = run_program({"uwlts": uwlts_app, "twin": twin_app}[words[0]], *words)
        else:
            done = subprocess.run(
                _called(words), cwd=self.folder, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=600
            )
        # The doctor examines the machine, which tests do not know.
        expected = (0, 1) if words[:2] == ["uwlts", "doctor"] else (0,)
        assert done.returncode in expected, (
            f"{shlex.join(words)}: {done.returncode}\n{done.stdout[-2000:]}{done.stderr[-2000:]}"
        )
        return done.stdout

    def python(self, block: Block, text: str, *, smaller: bool) -> None:
        """Run a Python block among the names of the page's blocks before."""
        for name in ("thesis", "thesis-as-built", "spheres") if smaller else ():
            text = re.sub(f'(?<=[(=])"{name}"', repr(str(self.small / f"{name}.toml")), text)
        with pytest.MonkeyPatch.context() as patch:
            patch.chdir(self.folder)
            exec(compile("\n" * (block.line - 1) + text, block.page, "exec"), self.names)

    def end(self) -> None:
        """End running commands, as by Ctrl-C."""
        for process in reversed(self._going):
            process.send_signal(signal.SIGINT)
            said, errors = process.communicate(timeout=60)
            assert process.returncode in (0, 130), f"{process.args}: {said}{errors}"

    def _expanded(self, word: str) -> list[str]:
        found = sorted(glob.glob(word, root_dir=self.folder)) if "*" in word else []
        return found or [word]

    def _smaller(self, words: list[str]) -> list[str]:
        """Return the same words with the smaller descriptions and few samples."""
        small = {path.stem: str(path) for path in self.small.glob("*.toml")}
        match words:
            case ["twin", "simulate" | "serve" as command, scene, *rest]:
                rest = [small.get(word, word) for word in rest]
                sensor = [] if "--sensor" in rest else ["--sensor", small["thesis"]]
                samples = [] if "--spp" in rest else ["--spp", _SAMPLES]
                return ["twin", command, small.get(scene, scene), *rest, *sensor, *samples]
            case ["twin", "predict", *_] if "--spp" not in words:
                return [*words, "--spp", _SAMPLES]
            case ["twin", "sweep", study, *rest]:
                return ["twin", "sweep", small.get(study, study), *rest]
            case ["uwlts", "nominal", sensor, *rest]:
                return ["uwlts", "nominal", small.get(sensor, sensor), *rest]
        return words

    def _started(self, words: list[str], ready: str) -> str:
        process = subprocess.Popen(
            _called(words), cwd=self.folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        self._going.append(process)
        said = ""
        assert process.stdout
        while ready not in said:
            line = process.stdout.readline()
            if not line:
                pytest.fail(f"{shlex.join(words)}: {said}{process.communicate()[1]}")
            said += line
        return said


def run_page(
    page: Path, how: Page, *, shared: Campaign | None, folder: Path, small: Path, separate: bool = False
) -> int:
    """Run all blocks of a page in a folder, and return how many commands and Python blocks ran."""
    for name, source in how.given.items():
        assert shared
        _copied(shared.folder / source, folder / name)
    for name, text in how.texts.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text, encoding="utf-8")
    tables = [block.text for block in blocks(page) if block.kind == "toml"]
    for name, number in how.tables.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(_instead(tables[number], how.instead, set()), encoding="utf-8")
    # Entries for a table were searched for above.
    beginnings = {*how.not_run, *how.again, *how.prepare, *how.ready}
    unused = set(beginnings)
    unused |= {word for word in how.instead if not any(word in tables[number] for number in how.tables.values())}
    ran = 0
    with _running(Runner(folder, small, shared=shared, separate=separate)) as runner:
        for line in how.before.strip().splitlines():
            runner.command(line.strip())
        for block in blocks(page):
            if block.kind not in ("commands", "python"):
                continue
            for written in [block.text] if block.kind == "python" else block.commands:
                listed = {begin for begin in beginnings if written.startswith(begin)}
                unused -= listed
                if listed & set(how.not_run):
                    continue
                for begin in listed & set(how.prepare):
                    how.prepare[begin](runner)
                text = _instead(written, how.instead, unused)
                print(f"{block}: {text if block.kind == 'commands' else 'Python'}", flush=True)
                if block.kind == "python":
                    runner.python(block, text, smaller=how.small_python)
                else:
                    ready = next((words for begin, words in how.ready.items() if begin in listed), None)
                    runner.command(text + OVERWRITE * bool(listed & set(how.again)), ready=ready)
                ran += 1
        exec(compile(how.figures, f"figures of {page}", "exec"), runner.names)
    assert not unused, f"{page} does not say what is listed for it: {unused}"
    return ran


def _instead(text: str, instead: dict[str, str], unused: set[str]) -> str:
    """Replace the listed words of the text, and remove them from ``unused``."""
    for word, other in instead.items():
        unused -= {word} if word in text else set()
        text = text.replace(word, other)
    return text


@contextmanager
def _running(runner: Runner) -> Iterator[Runner]:
    try:
        yield runner
    finally:
        runner.end()


def _called(words: list[str]) -> list[str]:
    """Return words that call a program of this environment."""
    match words:
        case [("uwlts" | "twin") as program, *rest]:
            return [sys.executable, "-m", program, *rest]
        case ["python" | "python3" | ".venv/bin/python", *rest]:
            return [sys.executable, *rest]
        case ["pytest", *rest]:
            return [sys.executable, "-m", "pytest", *rest]
    return words


def _copied(source: Path, target: Path) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    if source.is_dir():
        shutil.copytree(source, target)
    else:
        os.link(source, target)
