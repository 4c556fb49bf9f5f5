"""The public functions of both packages: documented, imported when used, and with the parameters of their commands."""

import inspect
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, get_args, get_type_hints

import pytest
from numpydoc.validate import validate

import twin
import twin.cli
import uwlts
import uwlts.cli
import uwlts.thesis
from uwlts.argument_types import OUTPUTS
from uwlts.runtime.command_line import DerivedCommand, Job, option_type

ROOT = Path(__file__).resolve().parents[1]
HEAVY = {"cv2", "scipy", "h5py", "mitsuba", "drjit", "matplotlib", "plotly", "optuna", "nicegui"}
LISTENS = {"progress", "report", "warn"}
"""Parameters for callbacks that report progress; commands print the reports instead."""
APPS = {"uwlts": uwlts.cli.app, "twin": twin.cli.app}
MOST_NAMES = 45
"""Largest number of public names of `uwlts`: functions of its commands, their savable results, and their arguments."""


def commands() -> Iterator[tuple[str, str]]:
    for program, app in APPS.items():
        yield from (
            (program, name) for name in app if not name.startswith("-") and (program, name) != ("twin", "scenes")
        )


COMMANDS = [pytest.param(*each, id=" ".join(each)) for each in commands()]


@pytest.mark.parametrize("package", [uwlts, twin, uwlts.report, uwlts.desk, uwlts.thesis])
def test_every_public_name_is_there_and_documented(package):
    assert set(package.__all__) == set(dir(package))
    for name in package.__all__:
        assert inspect.getdoc(getattr(package, name)), name


LEFT_OUT = {
    "ES01": "a summary can be enough",
    "EX01": "examples are in the documentation",
    "SA01": "related functions are in the documentation",
    "PR03": "options that many functions share are described after their own",
    "PR04": "types are in the signature",
    "PR08": "a description can begin with a name",
    "YD01": "the docstring of a context manager says what it yields",
}
"""Disabled checks of numpydoc, with the reason."""


@pytest.mark.parametrize("package", [uwlts, twin, uwlts.report, uwlts.desk, uwlts.thesis])
def test_public_docstrings_are_complete(package):
    """Functions describe all parameters and results. The fields of a class are described beside them."""
    wrong = []
    for name in package.__all__:
        thing = getattr(package, name)
        if not inspect.ismodule(thing):
            left_out = LEFT_OUT.keys() | ({"PR01", "PR02"} if inspect.isclass(thing) else set())
            errors = validate(f"{package.__name__}.{name}")["errors"]
            wrong += [f"{name}: {text}" for code, text in errors if code not in left_out]
    assert wrong == []


def test_there_are_few_public_names():
    assert len(uwlts.__all__) <= MOST_NAMES


@pytest.mark.parametrize("package", ["uwlts", "twin"])
def test_importing_is_light(package: str):
    code = f"import sys, {package}; print(*sorted({HEAVY!r} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True, cwd=ROOT)
    assert done.stdout.strip() == ""


@pytest.mark.parametrize("program", APPS)
def test_the_list_of_commands_needs_no_libraries_of_theirs(program: str):
    code = f"import sys; from {program}.cli import app; app('--help', result_action='return_value')\n"
    code += f"print(*sorted({HEAVY | {'numpy'}!r} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True, cwd=ROOT)
    assert done.stdout.splitlines()[-1] == ""


def test_unknown_names_are_refused():
    for package in (uwlts, twin):
        with pytest.raises(AttributeError, match="attribute nothing"):
            package.nothing  # noqa: B018


@pytest.mark.parametrize(("program", "name"), COMMANDS)
def test_commands_take_what_their_functions_take(program: str, name: str):
    """Everything that can be given as text, with the functions' defaults."""
    command = APPS[program][name].default_command
    assert isinstance(command, DerivedCommand)
    given, hints = inspect.signature(command).parameters, get_type_hints(command.function)
    for parameter, one in inspect.signature(command.function).parameters.items():
        if parameter in LISTENS or one.kind is one.VAR_KEYWORD or option_type(hints[parameter]) is None:
            continue
        # An option with several words is a tuple on the command line, also if it is empty.
        several = tuple in (option_type(hints[parameter]), getattr(option_type(hints[parameter]), "__origin__", None))
        default = () if several and one.default is None else one.default
        if type(None) in get_args(option_type(hints[parameter])):
            default = one.default
        assert given[parameter].default in (default, (default,)), parameter


@pytest.mark.parametrize(("program", "name"), COMMANDS)
def test_every_option_is_explained(program: str, name: str):
    arguments = APPS[program][name].assemble_argument_collection()
    assert len(arguments) > 0
    for argument in arguments:
        assert argument.parameter.help, argument.name
        assert "`" not in argument.parameter.help, argument.name


@pytest.mark.parametrize("line", ["serve plane", "reproduce", "demo", "sweep baseline-angle"])
def test_commands_run_with_their_defaults(line: str, monkeypatch: pytest.MonkeyPatch):
    """Parsing passes the given arguments on, and no others."""
    name, *words = line.split()
    function, taken = getattr(twin, name), []
    assert inspect.signature(twin.cli.app[name].default_command).parameters

    def recorded(*positional: object, **named: object) -> None:
        taken.append(inspect.signature(function).bind(*positional, **named))
        raise uwlts.Error("as far as the test goes")

    monkeypatch.setattr(twin, name, recorded)
    with pytest.raises(uwlts.Error, match="as far as"):
        twin.cli.app([name, *words])
    given: dict[str, Any] = {key: value for key, value in taken[0].arguments.items() if key not in LISTENS}
    assert list(given.values()) == words


def test_messages_name_options():
    from uwlts.runtime.console import replace_by_options

    names = inspect.signature(uwlts.cli.app["calibrate"].default_command).parameters
    assert (
        replace_by_options("give `new_water` with ``scan``, not `this`", names)
        == "give --new-water with --scan, not `this`"
    )


@pytest.mark.parametrize("program", APPS)
def test_packages_run_as_programs(program: str):
    done = subprocess.run([sys.executable, "-m", program, "--version"], check=True, capture_output=True, text=True)
    assert done.stdout.strip() == uwlts.__version__


@pytest.mark.parametrize("program", APPS)
def test_every_command_has_a_job(program: str):
    jobs = {name: {group.name for group in APPS[program][name].group} for name in APPS[program]}
    assert {name for name, groups in jobs.items() if name.startswith("-") != (groups == {"Program"})} == set()
    assert all(len(groups) == 1 and groups <= {*get_args(Job), "Program"} for groups in jobs.values())


@pytest.mark.parametrize(("program", "name"), COMMANDS)
def test_common_options_are_those_of_the_examples(program: str, name: str):
    command = APPS[program][name].default_command
    examples = " ".join(line for line in command.__doc__.splitlines() if "Example:" in line).split()
    for argument in APPS[program][name].assemble_argument_collection():
        advanced = any(group.name == "Advanced" for group in argument.parameter.group)
        if argument.required or argument.name in examples:
            assert not advanced, argument.name
        elif not argument.field_info.is_positional and argument.name not in ("--overwrite", "--out"):
            assert advanced or argument.name.removeprefix("--").replace("-", "_") in OUTPUTS, argument.name


@pytest.mark.parametrize(("program", "name"), COMMANDS)
def test_help_names_no_file_of_the_repository(program: str, name: str):
    command = APPS[program][name]
    texts = [command.default_command.__doc__, *(each.parameter.help for each in command.assemble_argument_collection())]
    assert not [text for text in texts if "docs/" in text]
