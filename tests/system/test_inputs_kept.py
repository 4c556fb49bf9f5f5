"""No command replaces one of its inputs, and no two commands write one output at the same time."""

import inspect
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, Literal, get_args, get_origin, get_type_hints

import cv2
import h5py
import numpy as np
import pytest

import twin.cli
import uwlts
import uwlts.cli
from tests.system.in_process import run_program
from uwlts.errors import OutputError
from uwlts.files.inputs import OUTPUTS, protect_inputs
from uwlts.files.reading import read_text
from uwlts.files.writing import lock_output, refuse_unsuitable, write_atomically
from uwlts.runtime.command_line import PathText
from uwlts.storage.cloud import PointCloud

ROOT = Path(__file__).resolve().parents[2]
APPS = {"uwlts": uwlts.cli.app, "twin": twin.cli.app}


def _takes_text(hint: Any) -> bool:
    """Return whether a parameter's value can be the name of a file."""
    if get_origin(hint) is Literal:
        return False
    return hint in (Path, PathText, str) or any(_takes_text(part) for part in get_args(hint) if part is not Ellipsis)


def _pairs() -> Iterator[tuple[str, str, str, str]]:
    """Program, command, output parameter, and parameter that can name a file: all there are."""
    for program, app in APPS.items():
        for name in app:
            if name.startswith("-"):
                continue
            function = app[name].default_command
            parameters, hints = inspect.signature(function).parameters, get_type_hints(function)
            texts = [each for each in parameters if _takes_text(hints[each])]
            for output in sorted(OUTPUTS.intersection(texts)):
                yield from ((program, name, output, each) for each in texts if each not in OUTPUTS)


PAIRS = list(_pairs())


def _arguments(program: str, name: str, given: dict[str, Path]) -> list[str]:
    """Command line with some parameters, and the required ones by some text."""
    words: list[str] = []
    function = APPS[program][name].default_command
    for each, parameter in inspect.signature(function).parameters.items():
        required = parameter.default is inspect.Parameter.empty
        if each in given or (required and parameter.kind is not inspect.Parameter.VAR_POSITIONAL):
            value = str(given.get(each, "other"))
            by_name = parameter.kind is inspect.Parameter.KEYWORD_ONLY
            words += [f"--{each.replace('_', '-')}", value] if by_name else [value]
    has_overwrite = "overwrite" in inspect.signature(function).parameters
    return [name, *words, *(["--overwrite"] if has_overwrite else [])]


def test_all_commands_with_outputs_are_covered():
    covered = {f"{program} {name}" for program, name, _, _ in PAIRS}
    assert covered >= {
        "uwlts reconstruct",
        "uwlts evaluate",
        "uwlts calibrate",
        "uwlts camera",
        "uwlts refresh",
        "uwlts polynomials",
        "uwlts certificate",
        "uwlts nominal",
        "uwlts import",
        "uwlts export",
        "uwlts report",
        "uwlts scan",
        "twin simulate",
        "twin record",
        "twin sweep",
    }
    assert len(PAIRS) > 40


@pytest.mark.parametrize("same", ["name", "hard link", "symbolic link"])
@pytest.mark.parametrize(("program", "name", "output", "source"), PAIRS)
def test_an_output_that_is_an_argument_is_refused(tmp_path, program, name, output, source, same):
    existing = tmp_path / "existing.h5"
    existing.write_bytes(b"precious")
    other = existing
    if same != "name":
        other = tmp_path / "other.h5"
        (os.link if same == "hard link" else os.symlink)(existing, other)
    # If a pair of arguments becomes one option, all values are of the same parameter.
    ended = run_program(APPS[program], program, *_arguments(program, name, {source: existing, output: other}))
    assert ended.returncode == 2, ended
    assert f"cannot write {other}: it is an input of this command" in ended.stderr, ended.stderr
    assert existing.read_bytes() == b"precious"
    assert {path.name for path in tmp_path.iterdir()} == {existing.name, other.name}


def _photographs(folder: Path) -> Path:
    folder.mkdir()
    for number in range(3):
        image = np.full((60, 80), 20, np.uint8)
        image[30 + number] = 200
        assert cv2.imwrite(str(folder / f"laser{number}.png"), image)
    (folder / "import.toml").write_text(
        'sensor = "sensor.toml"\nmedium = "water"\nlaser = "laser*.png"\n'
        "[stage]\nstart_mm = 0.0\nstep_mm = 1.0\ndirection = [1.0, 0.0, 0.0]\n",
        encoding="utf-8",
    )
    (folder / "sensor.toml").write_text(
        'base = "base.toml"\nname = "small"\n[camera]\nwidth_px = 80\nheight_px = 60\npixel_size_um = 84.8\n',
        encoding="utf-8",
    )
    (folder / "base.toml").write_text('base = "thesis"\n', encoding="utf-8")
    (folder / "target.toml").write_text(
        'kind = "chessboard"\ncolumns = 8\nrows = 6\nsquare_mm = 5.0\n', encoding="utf-8"
    )
    return folder


def _contents(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize("named", ["laser1.png", "sensor.toml", "base.toml", "import.toml"])
def test_what_a_folder_or_a_description_leads_to_is_an_input(tmp_path, named):
    folder = _photographs(tmp_path / "photographs")
    # Another name, because a file with another ending is refused for that.
    os.link(folder / named, tmp_path / "out.h5")
    before = _contents(tmp_path)
    ended = run_program(APPS["uwlts"], "uwlts", "import", folder, "--out", tmp_path / "out.h5", "--overwrite")
    assert ended.returncode == 2, ended
    assert "is an input of this command" in ended.stderr, ended.stderr
    assert _contents(tmp_path) == before


def test_a_photograph_is_not_replaced_by_the_camera(tmp_path):
    folder = _photographs(tmp_path / "photographs")
    os.link(folder / "laser0.png", tmp_path / "out.yaml")
    before = _contents(tmp_path)
    ended = run_program(APPS["uwlts"], "uwlts", "camera", folder, "--out", tmp_path / "out.yaml", "--overwrite")
    assert ended.returncode == 2, ended
    assert "is an input of this command" in ended.stderr, ended.stderr
    assert _contents(tmp_path) == before


@pytest.fixture(scope="module")
def nominal(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("nominal") / "nominal.json"
    uwlts.nominal("thesis", medium="water").save(path)
    return path


def test_an_output_beside_the_named_one_is_checked_too(tmp_path, nominal):
    calibration = tmp_path / "a.json"
    calibration.write_bytes(nominal.read_bytes())
    ended = run_program(APPS["uwlts"], "uwlts", "certificate", calibration, "--out", tmp_path / "a.html", "--overwrite")
    assert ended.returncode == 2, ended
    assert f"cannot write {calibration}: it is an input of this command" in ended.stderr, ended.stderr
    assert calibration.read_bytes() == nominal.read_bytes()


def test_functions_keep_their_inputs_too(tmp_path, nominal):
    calibration = tmp_path / "a.json"
    calibration.write_bytes(nominal.read_bytes())
    with pytest.raises(OutputError, match="is an input"):
        uwlts.report.write_certificate(calibration, out=tmp_path / "a.html", overwrite=True)
    cloud = tmp_path / "cloud.ply"
    PointCloud(np.eye(3), np.ones(3), np.zeros(3), np.arange(3)).save(cloud)
    before = cloud.read_bytes()
    with pytest.raises(OutputError, match="is an input"):
        uwlts.export(cloud, cloud, overwrite=True)
    assert cloud.read_bytes() == before
    # A program that reads and writes in its own steps is responsible for itself.
    uwlts.read(cloud).save(cloud, overwrite=True)


def test_what_is_read_meanwhile_is_not_replaced_but_what_was_made_may_be_read_and_replaced(tmp_path):
    out, other = tmp_path / "out.txt", tmp_path / "other.txt"
    out.write_text("old", encoding="utf-8")
    os.link(out, other)
    with protect_inputs():
        with pytest.raises(OutputError, match="is an input"), write_atomically(out, overwrite=True) as aside:
            aside.write_text(read_text(other, most_bytes=10), encoding="utf-8")
        assert out.samefile(other)
    with protect_inputs():
        for words in ("new", "newer"):
            with write_atomically(out, overwrite=True) as aside:
                aside.write_text(words, encoding="utf-8")
            assert read_text(out, most_bytes=10) == words
            assert read_text(other, most_bytes=10) == "old"


def test_a_file_in_a_reported_folder_is_not_replaced_by_the_report(tmp_path, nominal):
    calibration = tmp_path / "calibration.json"
    calibration.write_bytes(nominal.read_bytes())
    os.link(calibration, tmp_path / "out.html")
    ended = run_program(APPS["uwlts"], "uwlts", "report", tmp_path, "--out", tmp_path / "out.html", "--overwrite")
    assert ended.returncode == 2, ended
    assert "is an input" in ended.stderr
    assert calibration.read_bytes() == nominal.read_bytes()
    (tmp_path / "out.html").unlink()
    for _ in range(2):
        ended = run_program(APPS["uwlts"], "uwlts", "report", tmp_path, "--overwrite")
        assert ended.returncode == 0, ended
    assert {path.name for path in tmp_path.iterdir()} == {"calibration.json", "report.html", "summary.json"}


# --- one writer

_HOLDER = """
import sys, time
from pathlib import Path
from uwlts.files.writing import lock_output
with lock_output(Path(sys.argv[1])):
    print("held", flush=True)
    sys.stdin.read()
"""


@pytest.fixture
def holder(tmp_path) -> Iterator[subprocess.Popen[str]]:
    """Another process that writes a.json."""
    command = [sys.executable, "-c", _HOLDER, str(tmp_path / "a.json")]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=os.environ | {"PYTHONPATH": str(ROOT)}
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "held\n"
        yield process
        process.kill()


def test_a_second_writer_is_refused_at_once(tmp_path, holder):
    out = tmp_path / "a.json"
    begun = time.monotonic()
    with pytest.raises(OutputError, match=rf"a\.json: process {holder.pid} on .* is writing it"), lock_output(out):
        pass
    assert time.monotonic() - begun < 1.0
    with lock_output(tmp_path / "b.json"):
        pass
    holder.stdin.close()
    holder.wait()
    assert list(tmp_path.iterdir()) == []
    with lock_output(out):
        assert [path.name for path in tmp_path.iterdir()] == [".a-json.lock"]
    assert list(tmp_path.iterdir()) == []


def test_a_killed_writer_holds_nothing(tmp_path, holder):
    holder.send_signal(signal.SIGKILL)
    holder.wait()
    with write_atomically(tmp_path / "a.json") as aside:
        aside.write_text("{}")
    assert [path.name for path in tmp_path.iterdir()] == ["a.json"]


def test_a_command_claims_its_output_before_the_work(tmp_path, holder, nominal):
    """The first is still running when the second starts; no work is wasted."""
    command = ["certificate", nominal, "--out", tmp_path / "a.html"]
    begun = time.monotonic()
    ended = run_program(APPS["uwlts"], "uwlts", *command)
    assert ended.returncode == 2, ended
    assert f"cannot write {tmp_path / 'a.json'}: process {holder.pid}" in ended.stderr
    assert time.monotonic() - begun < 5.0, "it waited"
    assert [path.name for path in tmp_path.iterdir()] == [".a-json.lock"]


def test_without_a_command_asking_claims_nothing(tmp_path):
    refuse_unsuitable(tmp_path / "a.json", overwrite=False)
    assert list(tmp_path.iterdir()) == []


def test_a_locked_hdf5_output_can_be_written(tmp_path):
    """HDF5 locks its own output; this lock is on another file."""
    with write_atomically(tmp_path / "a.h5") as aside, h5py.File(aside, "w") as file:
        file["a"] = 1
    assert [path.name for path in tmp_path.iterdir()] == ["a.h5"]


def test_the_works_of_a_program_that_goes_on_are_apart(tmp_path):
    path = tmp_path / "notes.txt"
    path.write_text("old", encoding="utf-8")

    def read_and_replace() -> None:
        with protect_inputs():
            read_text(path, most_bytes=10)
            with pytest.raises(OutputError, match="it is an input of this command"):
                refuse_unsuitable(path, overwrite=True)

    def replace() -> None:
        with protect_inputs():
            refuse_unsuitable(path, overwrite=True)
            with write_atomically(path, overwrite=True) as aside:
                aside.write_text("new", encoding="utf-8")
            assert writer_elsewhere(path) == "another"

    with protect_inputs(), ThreadPoolExecutor(1) as thread:
        thread.submit(read_and_replace).result()
        # A file that one task has read may be replaced by another, and outputs are held until the end of their task
        # only.
        thread.submit(replace).result()
        assert writer_elsewhere(path) == "none"
    assert path.read_text(encoding="utf-8") == "new"


def writer_elsewhere(path: Path) -> str:
    """Result of another process's attempt to write a path."""
    program = (
        "import sys\nfrom pathlib import Path\nfrom uwlts.errors import OutputError\n"
        "from uwlts.files.writing import lock_output\n"
        "try:\n    with lock_output(Path(sys.argv[1])):\n        print('none')\n"
        "except OutputError:\n    print('another')\n"
    )
    done = subprocess.run([sys.executable, "-c", program, str(path)], capture_output=True, text=True, check=True)
    return done.stdout.strip()
