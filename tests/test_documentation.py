"""Documentation that can be checked without building it: links, the commands that it shows, and the README's length."""

import importlib.util
import os
import re
import subprocess
import tomllib
import types
from functools import cache
from pathlib import Path
from xml.etree import ElementTree

import cyclopts
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import twin
import uwlts
from tests.documented import PAGES, README, ROOT, blocks, mentioned_commands, name_of, words_of
from twin.cli import app as twin_app
from uwlts.cli import app as uwlts_app

MOST_README_LINES = 100
"""A README is an introduction; everything longer has a page under docs."""
MOST_HOW_TO_LINES = 80
COMMANDS = {"uwlts": uwlts_app, "twin": twin_app}
FOLDERS = ("uwlts", "twin", "tests", "docs", "scenes")
WRITTEN_LATER = {"docs/_build/html", "uwlts/targets/plain_circles.py"}
"""Files that the documentation names but its reader creates: the built site, and the example of a new target."""
PRESENT = [page for page in PAGES if page.name != "what-changed.md"]
"""Pages whose commands and options exist; the other one names former ones."""
EXTRAS = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["optional-dependencies"]


def _check(command: str, *, folder: Path = ROOT, abridged: bool = False) -> None:
    """Check that the program accepts a command line; an abridged one may lack arguments."""
    program, *words = words_of(command)
    match Path(program).name:
        case "uwlts" | "twin":
            try:
                COMMANDS[program].parse_args(words, exit_on_error=False, print_error=False)
            except cyclopts.MissingArgumentError:
                if not abridged:
                    raise
                known = {name for argument in _arguments(program, words[0]) for name in argument.names}
                assert {word.split("=")[0] for word in words if word.startswith("--")} <= known
        case "make":
            # A test that make has started must not hand on its settings.
            plain = {name: value for name, value in os.environ.items() if not name.startswith("MAKE")}
            done = subprocess.run(["make", "--dry-run", *words], cwd=ROOT, env=plain, capture_output=True, text=True)
            assert done.returncode == 0, done.stderr
        case "python" | "python3" if words[0] == "-m":
            assert importlib.util.find_spec(words[1]), f"no module {words[1]}"
        case "python" | "python3":
            assert (folder / words[0]).is_file(), f"no file {words[0]}"
        case "cd":
            assert (ROOT / words[0]).is_dir(), f"no folder {words[0]}"
        case "pip":
            assert set(re.findall(r"\[(\w+)\]", command)) <= set(EXTRAS)
        case "pytest":
            # Wrong options, or files that do not exist, end it before any test is collected.
            files = [word for word in words if word.endswith(".py")]
            assert all((ROOT / file).is_file() for file in files)
        case other:
            pytest.fail(f"no way to check calls of {other}")


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_links_lead_to_files(page):
    links = re.findall(r"\]\(([^)\s#]+)", page.read_text(encoding="utf-8"))
    missing = [link for link in links if "://" not in link and not (page.parent / link).exists()]
    assert not missing, f"{name_of(page)} links to files that do not exist: {missing}"


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_named_files_exist(page):
    named = re.findall(rf"`((?:{'|'.join(FOLDERS)})/[\w/.-]+)`", page.read_text(encoding="utf-8"))
    missing = [name for name in named if name not in WRITTEN_LATER and not (ROOT / name).exists()]
    assert not missing, f"{name_of(page)} names files that do not exist: {missing}"


def test_every_page_is_in_a_table_of_contents():
    listed = set()
    for page in PAGES:
        for block in re.findall(r"```\{toctree\}\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL):
            entries = [line for line in block.splitlines() if line and not line.startswith(":")]
            listed |= {path for entry in entries for path in page.parent.glob(f"{entry}.md")}
    pages = {path for path in PAGES if path.is_relative_to(ROOT / "docs")} - {ROOT / "docs" / "index.md"}
    assert pages == listed


@pytest.mark.parametrize("package", [uwlts, twin])
def test_every_public_name_is_on_one_page_of_the_api(package):
    pages = "".join(path.read_text(encoding="utf-8") for path in (ROOT / "docs" / "reference" / "api").glob("*.md"))
    names = [name for name in package.__all__ if not isinstance(getattr(package, name), types.ModuleType)]
    if f".. automodule:: {package.__name__}\n   :members:\n" in pages:
        hidden = re.search(rf"automodule:: {package.__name__}\n.*\n   :exclude-members: (.*)", pages)
        names = hidden[1].split(", ") if hidden else []
    counts = {name: len(re.findall(rf"auto(?:function|class):: {name}$", pages, re.MULTILINE)) for name in names}
    assert {
        name: count for name, count in counts.items() if count != 1 and name not in ("Error", "StripeOptions")
    } == {}


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_commands_are_complete(page):
    """Every option is known and every value of the right type; the slow tests run the commands."""
    for block in blocks(page):
        if block.kind != "commands":
            continue
        folder = ROOT
        for command in block.commands:
            try:
                _check(command, folder=folder)
            except (cyclopts.CycloptsError, AssertionError) as error:
                pytest.fail(f"{block}: '{command}': {error}")
            folder = ROOT / command.split()[1] if command.startswith("cd ") else folder


@pytest.mark.parametrize("page", PRESENT, ids=name_of)
def test_mentioned_commands_and_options_exist(page):
    for line, command in mentioned_commands(page):
        try:
            _check(command, abridged=True)
        except (cyclopts.CycloptsError, AssertionError) as error:
            pytest.fail(f"{name_of(page)}:{line}: '{command}': {error}")


@cache
def _arguments(program: str, command: str) -> cyclopts.ArgumentCollection:
    return COMMANDS[program][command].assemble_argument_collection()


def _accepts(program: str, command: str, words: list[str]) -> bool:
    """Return whether a command has an option and, if they are given, accepts its values."""
    arguments = _arguments(program, command)
    known = words[0].partition("=")[0] in {name for each in arguments for name in each.names}
    if len(words) == 1 or not known:
        return known
    needed = [each for each in arguments if each.required and not set(each.names) & set(words)]
    places = [f"{number}.h5" for number, each in enumerate(needed) if each.field_info.is_positional]
    options = [word for each in needed if not each.field_info.is_positional for word in (each.name, "1.h5")]
    try:
        COMMANDS[program].parse_args([command, *places, *words, *options], exit_on_error=False, print_error=False)
    except cyclopts.CycloptsError:
        return False
    return True


@pytest.mark.parametrize("page", PRESENT, ids=name_of)
def test_options_in_sentences_are_accepted_with_their_values(page):
    """Such as `--distortion k1 k2`: by a command, or, on pages of results, by a study's script."""
    commands = [(program, name) for program, app in COMMANDS.items() for name in app if not name.startswith("-")]
    studies = "".join(path.read_text(encoding="utf-8") for path in (ROOT / "docs" / "studies").glob("*.py"))
    for line, text in enumerate(page.read_text(encoding="utf-8").splitlines(), 1):
        for words in map(words_of, re.findall(r"`(--[a-z][^`]*)`", text)):
            if words == ["--help"] or any(word.isupper() or "[" in word for word in words):
                continue  # cyclopts adds it; the others are names of values, not values
            known = any(_accepts(program, name, words) for program, name in commands)
            assert known or f'"{words[0]}"' in studies, f"{name_of(page)}:{line}: no command accepts {' '.join(words)}"


@pytest.mark.parametrize("package", ["uwlts", "twin"])
def test_the_layers_are_those_of_the_contract(package):
    text = (ROOT / "docs" / "explanation" / "architecture.md").read_text(encoding="utf-8")
    rows = text.split(f"## Layers of {package}")[1].split("\n## ")[0].splitlines()
    documented = [re.findall(r"`(\w+)`", row.split("|")[1]) for row in rows if row.startswith("| `")]
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["importlinter"][
        "contracts"
    ]
    layers = next(contract["layers"] for contract in contracts if contract["id"] == f"layers-{package}")
    assert documented == [layer.split(" | ") for layer in layers]


def test_the_readme_shows_commands():
    shown = {command.split()[0] for block in blocks(README) if block.kind == "commands" for command in block.commands}
    assert shown == {"make", "twin", "uwlts"}


@pytest.mark.parametrize(
    "command",
    [
        "uwlts evaluate cloud.ply --out evaluation.json --colored cloud.ply",
        "uwlts evaluate",
        "uwlts verify step.h5 --calibration a.json --limit-mm wide",
        "uwlts info one.h5 two.h5 three.h5",
        "make testfull",
        "python -m tests.benches",
        "python docs/studies/nothing.py",
        "pip install 'uwlts[lidar]'",
    ],
)
def test_a_wrong_command_is_noticed(command):
    with pytest.raises((cyclopts.CycloptsError, AssertionError)):
        _check(command)


@pytest.mark.parametrize("command", ["uwlts calibrate --jointly", "twin render"])
def test_a_wrong_option_of_an_abridged_command_is_noticed(command):
    with pytest.raises((cyclopts.CycloptsError, AssertionError)):
        _check(command, abridged=True)


@pytest.mark.parametrize("app", COMMANDS.values(), ids=COMMANDS)
def test_all_commands_explain_themselves(app, capsys):
    for command in [name for name in app if not name.startswith("-")]:
        app([command, "--help"], exit_on_error=False, result_action="return_value")
        assert f"Usage: {app.name[0]} {command}" in capsys.readouterr().out


def test_the_launch_file_calls_a_command_with_options_that_exist():
    launch = ElementTree.parse(ROOT / "docs" / "how-to" / "uwlts.launch.xml").getroot()
    defaults = {each.attrib["name"]: each.attrib["default"] for each in launch.iter("arg")}
    (called,) = (each.attrib["cmd"] for each in launch.iter("executable"))
    _check(re.sub(r"\$\(var (\w+)\)", lambda found: defaults[found[1]], called))
    # Y of the points is to the right of a platform that moves along X with the sensor looking along -z.
    (placed,) = (each.attrib["args"].split() for each in launch.iter("node"))
    roll, pitch, yaw = (float(placed[placed.index(f"--{name}") + 1]) for name in ("roll", "pitch", "yaw"))
    axes = Rotation.from_euler("xyz", [roll, pitch, yaw]).as_matrix()
    assert np.allclose(axes, np.diag([1, -1, -1]), atol=1e-6)


def test_the_readme_and_how_to_pages_are_short():
    lines = {page: len(page.read_text(encoding="utf-8").splitlines()) for page in PAGES}
    assert lines[README] <= MOST_README_LINES
    assert [name_of(page) for page in PAGES if page.parent.name == "how-to" and lines[page] > MOST_HOW_TO_LINES] == []
