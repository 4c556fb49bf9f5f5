"""No command or public function replaces one of its inputs."""

import inspect
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal, get_args, get_origin, get_type_hints

import numpy as np
import pytest

import twin.cli
import uwlts
import uwlts.cli
from tests.system.in_process import run_program
from uwlts.argument_types import OUTPUTS
from uwlts.errors import OutputError
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
            value = str(given.get(each, "1" if "float" in str(parameter.annotation) else "other"))
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
        "uwlts polynomials",
        "uwlts certificate",
        "uwlts nominal",
        "uwlts import",
        "uwlts export",
        "uwlts scan",
        "twin simulate",
        "twin record",
        "twin sweep",
    }
    assert len(PAIRS) > 40


@pytest.mark.parametrize(
    ("program", "name", "output", "source", "same"),
    [*((*pair, "name") for pair in PAIRS), (*PAIRS[0], "hard link"), (*PAIRS[-1], "symbolic link")],
)
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
