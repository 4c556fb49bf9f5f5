"""Command lines as help and documentation show them: options that take several values, and names of outputs."""

import re
import shlex
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

import pytest
from cyclopts import App

from tests.system.in_process import run_program, uwlts
from tests.uwlts.desk.test_scan_service import write_images
from twin.cli import app as twin_app
from uwlts.argument_types import OUTPUTS
from uwlts.cli import app as uwlts_app
from uwlts.pages.toolkit import json_beside
from uwlts.runtime.command_line import PathText

ROOT = Path(__file__).resolve().parents[2]
APPS = {"uwlts": uwlts_app, "twin": twin_app}


COMMANDS = [(program, command, app) for program, app in APPS.items() for command in app if not command.startswith("-")]


def _several(app: App, command: str) -> Iterator[tuple[str, Any]]:
    """Options of a command that take a tuple of any length, each with the type of its elements."""
    for argument in app[command].assemble_argument_collection():
        # With None left out, and whatever a union hides.
        for kind in (argument.hint, *get_args(argument.hint)):
            if get_origin(kind) is tuple and argument.name.startswith("--") and get_args(kind)[1:] == (...,):
                yield argument.name, get_args(kind)[0]


def _values(kind: Any) -> list[tuple[list[str], object]]:
    """Two values of a kind: their words on the command line, and what they mean."""
    if get_origin(kind) is Literal:
        return [([word], word) for word in get_args(kind)[1:3]]
    if kind in (str, PathText, Path):
        return [(["one"], kind("one")), (["two"], kind("two"))]
    assert set(get_args(kind)) == {float}, f"no example of {kind}: add one"
    numbers = [[float(start + number) for number in range(len(get_args(kind)))] for start in (-1, 5)]
    return [([f"{number:g}" for number in each], tuple(each)) for each in numbers]


def _required(app: App, command: str, option: str) -> list[str]:
    """Return words for all required arguments of a command except an option."""
    words = []
    for argument in app[command].assemble_argument_collection():
        if argument.required and argument.name != option:
            name = "x.h5" if argument.name == "--out" else "1" if argument.hint is float else "x"
            words += [name] if argument.field_info.is_positional else [argument.name, name]
    return words


def _parsed(app: App, command: str, option: str, words: list[str]) -> object:
    required = _required(app, command, option)
    _, bound, _ = app.parse_args([command, *required, *words], exit_on_error=False, print_error=False)
    return bound.arguments[option.removeprefix("--").replace("-", "_")]


def test_an_option_may_be_repeated_or_takes_several_values_at_once():
    parsed = {}
    for program, command, app in COMMANDS:
        for option, kind in _several(app, command):
            (one, first), (two, second) = _values(kind)
            repeated = _parsed(app, command, option, [option, *one, option, *two]) == (first, second)
            at_once = get_origin(kind) is tuple or _parsed(app, command, option, [option, *one, *two]) == (
                first,
                second,
            )
            parsed[f"{program} {command} {option}"] = repeated, at_once
    assert len(parsed) >= 25  # 27 when this was written
    assert [name for name, each in parsed.items() if each != (True, True)] == []


def test_a_region_takes_its_six_numbers():
    words = ["--region-mm", "-1", "-2", "-3", "1", "2", "3"]
    assert _parsed(uwlts_app, "export", "--region-mm", words) == ((-1, -2, -3), (1, 2, 3))


@pytest.mark.parametrize("command", ["camera", "calibrate"])
def test_distortion_is_auto_or_each_coefficient_once(command, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    named = {"x.h5": {"camera": "x.yaml", "calibrate": "x.json"}[command]}
    required = [named.get(word, word) for word in _required(uwlts_app, command, "--distortion")]
    for wrong, words in (
        ("auto k1", " is ('auto', 'k1') (tuple), expected 'auto' or a list"),
        ("k1 k1", " k1 k1: expected only auto"),
    ):
        ended = uwlts(command, *required, "--distortion", *wrong.split())
        assert ended.returncode == 2
        assert f"--distortion{words}" in ended.stderr
    assert _parsed(uwlts_app, command, "--distortion", ["--distortion", "auto"]) == ("auto",)
    # The coefficients are accepted: something else is missing next.
    ended = uwlts(command, *required, "--distortion", "k1", "k2")
    assert ended.returncode == 2 and "distortion" not in ended.stderr


FOLDERS = {
    "twin record --out",
    "twin dataset --out",
    "twin reproduce --out",
    "twin predict --out",
    "twin demo --out",
    "twin sweep --out",
}
"""Outputs that are folders, whose names need no ending."""


def _outputs(program: str, command: str, app: App) -> list[str]:
    """Options of a command that name files to write."""
    return [
        argument.name
        for argument in app[command].assemble_argument_collection()
        if argument.name.removeprefix("--").replace("-", "_") in OUTPUTS
        and f"{program} {command} {argument.name}" not in FOLDERS
    ]


ENDINGS = {
    "align": "x.csv",
    "compare": "x.html",
    "evaluate": "x.json",
    "inspect": "x.json",
    "register": "x.ply",
    "radiometry": "x.toml",
}
"""Names of OUT for the commands that write more than one file."""


def test_what_is_described_as_written_counts_as_an_output():
    # Otherwise it would be refused as an input that is to be replaced.
    described = {
        argument.name.lower().removeprefix("--").replace("-", "_")
        for program, command, app in COMMANDS
        for argument in app[command].assemble_argument_collection()
        if program == "uwlts"
        and re.search(r"\bto write\b|^(Also w|W)rite |default: not written", argument.parameter.help)
    }
    assert described >= {"out", "coloured", "aligned", "page", "poses_out"}
    assert described <= OUTPUTS


def test_outputs_of_many_commands_are_looked_at():
    assert sum(len(_outputs(*each)) for each in COMMANDS) >= 25  # 28 when this was written


@pytest.mark.parametrize(("program", "command", "app"), COMMANDS, ids=[f"{each[0]} {each[1]}" for each in COMMANDS])
def test_an_ending_that_names_no_format_is_refused_before_the_work(program, command, app, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for option in _outputs(program, command, app):
        words = [ENDINGS.get(command, "x.h5") if word == "x.h5" else word for word in _required(app, command, option)]
        # No input exists: reading one first would be reported.
        words = ["x.ply" if word == "x" and command == "export" else word for word in words]
        ended = run_program(app, program, command, *words, option, "wrong.ending")
        assert ended.returncode == 2
        assert "wrong.ending ends with none of ." in ended.stderr, ended.stderr
        assert list(tmp_path.iterdir()) == []


def test_a_capture_is_not_exported_under_the_name_of_a_cloud(tmp_path, thesis):
    write_images(tmp_path / "scan.h5", thesis, (True,))
    ended = uwlts("export", tmp_path / "scan.h5", "--out", tmp_path / "scan.laz")
    assert ended.returncode == 2
    assert "is a capture" in ended.stderr


def _blocks() -> Iterator[tuple[str, list[str]]]:
    """Indented blocks of the documentation with several command lines: what a reader runs one after the other."""
    for page in [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]:
        for number, block in enumerate(re.split(r"\n(?!    )", page.read_text(encoding="utf-8"))):
            lines = [line.strip().split(" #")[0] for line in block.splitlines() if line.startswith("    ")]
            lines = [line for line in lines if line.split(" ")[0] in APPS and "..." not in line]
            if len(lines) > 1:
                yield f"{page.relative_to(ROOT)}-{number}", lines


def _written(line: str) -> list[str]:
    """Return the names of the files that a command line writes, including those beside them."""
    program, *words = shlex.split(line)
    command, bound, _ = APPS[program].parse_args(words, exit_on_error=False, print_error=False)
    given = bound.arguments
    if given.get("resume") or given.get("overwrite") or given.get("live"):
        return []
    names = [str(path) for name in OUTPUTS if (path := given.get(name)) is not None and f"{path}" not in ("()", "")]
    kind = {"register": "registration", "findings_report": "findings"}.get(command.__name__, "")
    pages = [Path(name) for name in names if name.endswith(".html")]
    beside = [str(json_beside(page, kind)) for page in pages]
    return names + beside + ([str(page.with_suffix(".pdf")) for page in pages] if given.get("pdf") else [])


def test_commands_of_one_block_write_different_files():
    blocks = dict(_blocks())
    assert len(blocks) >= 15  # 18 when this was written
    for block, lines in blocks.items():
        written = [name for line in lines for name in _written(line) if not name.startswith("runs/")]
        assert not [name for name, times in Counter(written).items() if times > 1], block


def test_inspection_and_report_of_one_pipe_write_different_files():
    page = (ROOT / "docs" / "how-to" / "inspect-a-pipe.md").read_text(encoding="utf-8")
    lines = [line.strip() for line in page.splitlines() if line.startswith("   uwlts ")]
    written = [name for line in lines for name in _written(line)]
    assert {"pipe.json", "pipe.html", "pipe.findings.json", "pipe.pdf"} <= set(written)
    assert len(set(written)) == len(written)
