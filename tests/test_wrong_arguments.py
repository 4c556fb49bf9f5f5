"""Wrong types given to public functions: an error that names the argument, and no traceback from inside."""

import inspect
import pickle
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest

import twin
import uwlts
import uwlts.thesis
from uwlts.argument_types import check_arguments
from uwlts.errors import ArgumentError

PLOTS = ["cloud", "stripe", "residuals"]
SERVERS = {"uwlts.desk.serve_desk", "uwlts.examine", "twin.demo", "twin.predict", "twin.reproduce", "twin.serve"}
"""Functions that work without any file: for minutes, or until they are ended. No fitting argument is given to them."""
WRONG = [None, 3, -2.5, True, "no such thing", Path("nothing"), np.zeros((2, 3, 3)), [1, 2], ["a"], {"a": 1}, object()]
NO_FILE = "nothing.h5"
SEVERAL = {"clouds", "target", "step"}
"""Required parameters that take a list."""


def functions_of(package: str) -> dict[str, Callable[..., Any]]:
    """Return the public functions of a package, whose modules are imported here."""
    module = {"uwlts": uwlts, "twin": twin}.get(package) or getattr(uwlts, package.removeprefix("uwlts."))
    names = PLOTS if package == "uwlts.plot" else module.__all__
    found = {f"{package}.{name}": getattr(module, name) for name in names}
    return {name: each for name, each in found.items() if inspect.isroutine(each)}


def call_with(function: Callable[..., Any], parameter: str, value: object) -> None:
    """Call a function with a value for one parameter, and something for the others without a default."""
    parameters = inspect.signature(function).parameters
    required = [
        name
        for name, one in parameters.items()
        if one.default is one.empty and one.kind not in (one.VAR_KEYWORD, one.VAR_POSITIONAL)
    ]
    named: dict[str, Any] = {name: [NO_FILE] if name in SEVERAL else NO_FILE for name in required}
    if parameters[parameter].kind is inspect.Parameter.VAR_POSITIONAL:
        function(value, **named)
    else:
        function(**named | {parameter: value})


@pytest.mark.parametrize(
    ("package", "least"),
    [("uwlts", 23), ("uwlts.desk", 2), ("uwlts.thesis", 1), ("uwlts.report", 8), ("uwlts.plot", 3), ("twin", 9)],
)
def test_wrong_types_raise_errors_that_name_the_argument(
    package: str, least: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """Whatever is given for a parameter: the files named for the others do not exist."""
    monkeypatch.chdir(tmp_path)
    wrong, functions = [], functions_of(package)
    for name, function in functions.items():
        for parameter, one in inspect.signature(function).parameters.items():
            for value in WRONG if one.kind is not one.VAR_KEYWORD else ():
                if type(value) is not object and name in SERVERS:
                    continue
                try:
                    call_with(function, parameter, value)
                    wrong.append(f"{name}: {parameter}={value!r} is taken")
                except ArgumentError as error:
                    # Results of other functions, which some functions need, are not made here.
                    if not str(error).startswith(f"`{parameter}` is ") and NO_FILE not in str(error):
                        wrong.append(f"{name}: {parameter}={value!r}: {error}")
                except uwlts.Error:
                    if type(value) is object:
                        wrong.append(f"{name}: {parameter} takes any object")
                except Exception as error:
                    wrong.append(f"{name}: {parameter}={value!r}: {type(error).__name__}: {error}")
    assert wrong == []
    assert len(functions) >= least


@pytest.mark.parametrize("value", [3, None, b"cloud.ply", ["cloud.ply"]])
def test_results_are_saved_only_to_paths(value: object):
    cloud = uwlts.PointCloud(np.zeros((1, 3)), np.zeros(1), np.zeros(1), np.zeros(1))
    for save in (cloud.save, uwlts.nominal("thesis", medium="water").save, uwlts.Capture):
        with pytest.raises(ArgumentError, match=r"`path` is .*expected a path$"):
            save(value)


def test_a_cloud_needs_numbers():
    with pytest.raises(uwlts.Error, match="`points_mm` of a cloud needs an array of numbers"):
        uwlts.PointCloud("cloud.ply", np.zeros(1), np.zeros(1), np.zeros(1))


# --- what fits


@check_arguments
def measure(
    cloud: uwlts.PointCloud | str | Path = "a",
    *more: float,
    number: float | None = None,
    count: int = 1,
    unit: Literal["mm", "m"] | None = None,
    points: np.ndarray | Path | None = None,
    corners: tuple[tuple[float, float], tuple[float, float]] = ((0, 0), (1, 1)),
    names: tuple[str, ...] = (),
    steps: Sequence[float] = (),
    named: Mapping[str, float] | None = None,
    report: Callable[[str], None] = print,
    **others: Any,
) -> dict[str, Any]:
    return locals()


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("number", 3),
        ("number", np.float32(3.5)),
        ("number", None),
        ("count", np.int64(3)),
        ("unit", "mm"),
        ("points", np.eye(3)),
        ("points", Path("a")),
        ("steps", [1, 2.5]),
        ("steps", np.arange(3)),
        ("report", [].append),
        ("others", object()),
    ],
)
def test_fitting_arguments_arrive_as_they_are(name: str, value: Any):
    found = measure(**{name: value})
    assert (found["others"] if name == "others" else found)[name] is value


def test_lists_become_arrays_and_tuples_where_those_belong():
    found = measure("a", 1, 2.5, points=[[1, 2, 3]], corners=[np.zeros(2), [1, 2]], names=["b"])
    assert found["points"].shape == (1, 3)
    assert found["more"] == (1, 2.5)
    assert found["corners"] == ((0, 0), (1, 2))
    assert found["names"] == ("b",)


@pytest.mark.parametrize(
    ("name", "value", "expected"),
    [
        ("number", True, "a number"),
        ("number", "3", "a number"),
        ("count", 2.0, "a whole number"),
        ("unit", "cm", "'mm' or 'm'"),
        ("points", "cloud.ply", "an array of numbers or a path"),
        ("points", [["a"]], "an array of numbers or a path"),
        ("corners", ((1, 2, 3), (1, 2)), "2 values (2 values (a number))"),
        ("names", "abc", "a list (entries: text); give a single one as ['abc']"),
        ("steps", 1.5, "a list (entries: a number); give a single one as [1.5]"),
        ("report", "print", "a function"),
        ("cloud", None, "a PointCloud or a path"),
        ("named", {"a": "b"}, "a dictionary (values: a number)"),
    ],
)
def test_messages_say_what_was_expected(name: str, value: Any, expected: str):
    with pytest.raises(ArgumentError) as caught:
        measure(**{name: value})
    assert str(caught.value).endswith(f", expected {expected}")


def test_missing_and_unknown_arguments_are_python_errors():
    with pytest.raises(TypeError, match=r"design\(\) missing 1 required keyword-only argument: 'medium'"):
        uwlts.design("thesis")
    with pytest.raises(TypeError, match="unexpected keyword argument 'colour'"):
        uwlts.design("thesis", medium="water", colour="red")


def test_public_functions_can_be_sent_to_other_processes():
    for function in (uwlts.reconstruct, uwlts.report.write_change, twin.record):
        assert pickle.loads(pickle.dumps(function)) is function
