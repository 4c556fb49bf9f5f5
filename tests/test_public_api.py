"""The public functions of both packages: documented, imported when used, and with the parameters of their commands."""

import inspect
import subprocess
import sys
from pathlib import Path

import pytest

import twin
import twin.cli
import uwlts
import uwlts.cli

ROOT = Path(__file__).resolve().parents[1]
HEAVY = {"cv2", "scipy", "h5py", "mitsuba", "drjit", "matplotlib", "plotly", "optuna", "nicegui"}

WRITES = {"out", "overwrite"}
"""Options of commands that write what their function returns."""
METHOD = {"method", "stripe"}
"""Settings of the stripe, which functions take as their `stripe`: options, or a dict."""
LISTENS = {"progress", "report", "warn"}
"""Parameters by which functions show what they do; commands print it."""

# Command, its function, options of the command alone, and parameters of the function alone.
PAIRS: dict[str, tuple[str, set[str], set[str]]] = {
    # Guided options go to record_guided; --joint is method="joint".
    "uwlts calibrate": (
        "uwlts.calibrate",
        WRITES | METHOD | {"joint", "live", "camera", "stage", "port", "resume"},
        {"stripe", "method"},
    ),
    "uwlts camera": ("uwlts.calibrate_camera", WRITES, set()),
    # The times of arrays; files have a column of them.
    "uwlts mount": ("uwlts.calibrate_mount", WRITES, {"profile_times_s", "pose_times_s"}),
    "uwlts refresh": ("uwlts.refresh", WRITES | METHOD, {"stripe"}),
    "uwlts polynomials": ("uwlts.calibrate_polynomials", WRITES | METHOD, {"stripe"}),
    "uwlts design": ("uwlts.design", set(), set()),
    "uwlts nominal": ("uwlts.nominal", WRITES, set()),
    "uwlts info": ("uwlts.describe", set(), set()),
    "uwlts import": ("uwlts.import_images", set(), set()),
    "uwlts export": ("uwlts.export", set(), set()),
    # The trajectory is read by read_trajectory.
    "uwlts reconstruct": ("uwlts.reconstruct", WRITES | METHOD | {"peak", "pose_format", "pose_unit"}, {"stripe"}),
    "uwlts evaluate": ("uwlts.evaluate", WRITES | {"coloured"}, {"source"}),
    "uwlts compare": ("uwlts.compare_clouds", WRITES | {"coloured"}, set()),
    "uwlts mesh": ("uwlts.mesh", WRITES, set()),
    "uwlts inspect": ("uwlts.inspect", WRITES | {"coloured"}, set()),
    "uwlts findings-report": ("uwlts.write_findings", set(), set()),
    # The trajectory is read by read_trajectory.
    "uwlts align": ("uwlts.align_trajectory", WRITES | {"aligned", "pose_format", "pose_unit"}, set()),
    # The poses are read by read_poses.
    "uwlts register": ("uwlts.register", WRITES | {"page", "poses_out", "pose_format", "pose_unit"}, set()),
    "uwlts gauge": ("uwlts.gauge_study", WRITES, set()),
    "uwlts report": ("uwlts.write_report", set(), set()),
    "uwlts thesis": ("uwlts.evaluate_thesis", set(), set()),
    "uwlts models": ("uwlts.compare_models", WRITES | METHOD, {"stripe"}),
    "uwlts certificate": ("uwlts.write_certificate", {"check"}, set()),
    "uwlts verify": ("uwlts.verify", {"limit"}, {"limit_mm"}),
    "uwlts scan": ("uwlts.scan", set(), set()),
    "uwlts watch": ("uwlts.watch", set(), set()),
    "uwlts desk": ("uwlts.serve_desk", set(), set()),
    "uwlts doctor": ("uwlts.examine", set(), set()),
    "twin simulate": ("twin.simulate", set(), {"show_progress"}),
    "twin serve": ("twin.serve", set(), set()),
    "twin demo": ("twin.demo", set(), set()),
    "twin record": ("twin.record", set(), {"show_progress"}),
    "twin dataset": ("twin.dataset", set(), {"show_progress"}),
    "twin sweep": ("twin.sweep", set(), {"show_progress"}),
    # The evaluation is uwlts.evaluate_thesis, in a process of its own.
    "twin reproduce": ("twin.reproduce", set(), {"show_progress"}),
}
PACKAGES = {"uwlts": uwlts, "twin": twin}
APPS = {"uwlts": uwlts.cli.app, "twin": twin.cli.app}


def commands() -> set[str]:
    return {f"{program} {name}" for program, app in APPS.items() for name in app if not name.startswith("-")}


@pytest.mark.parametrize("package", [uwlts, twin], ids=["uwlts", "twin"])
def test_every_public_name_is_there_and_documented(package):
    assert set(package.__all__) == set(dir(package))
    for name in package.__all__:
        assert inspect.getdoc(getattr(package, name)), name


@pytest.mark.parametrize("package", ["uwlts", "twin"])
def test_importing_is_light(package: str):
    code = f"import sys, {package}; print(*sorted({HEAVY!r} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True, cwd=ROOT)
    assert done.stdout.strip() == ""


def test_unknown_names_are_refused():
    for package in (uwlts, twin):
        with pytest.raises(AttributeError, match="attribute nothing"):
            package.nothing  # noqa: B018


def test_every_command_has_a_function():
    assert commands() - set(PAIRS) == {"twin scenes"}


@pytest.mark.parametrize("line", PAIRS)
def test_commands_take_what_their_functions_take(line: str):
    function, of_command, of_function = PAIRS[line]
    program, name = line.split()
    package, attribute = function.split(".")
    assert attribute in PACKAGES[package].__all__
    given = inspect.signature(APPS[program][name].default_command).parameters
    taken = inspect.signature(getattr(PACKAGES[package], attribute)).parameters
    assert set(given) - of_command == set(taken) - of_function - LISTENS
    assert of_command <= set(given) and of_function <= set(taken)
    for shared in set(given) - of_command:
        # A word among several that an option takes is a tuple on the command line.
        default = taken[shared].default
        assert given[shared].default in (default, (default,)), shared


@pytest.mark.parametrize("line", ["serve plane", "reproduce", "demo", "sweep baseline-angle"])
def test_commands_run_with_their_defaults(line: str, monkeypatch: pytest.MonkeyPatch):
    """Parsing accepts each default as the function has it, and hands over nothing else."""
    name, *words = line.split()
    function, taken = getattr(twin, name), []

    def recorded(*positional: object, **named: object) -> None:
        taken.append(inspect.signature(function).bind(*positional, **named))
        raise uwlts.Error("as far as the test goes")

    monkeypatch.setattr(twin, name, recorded)
    with pytest.raises(uwlts.Error, match="as far as"):
        twin.cli.app([name, *words])
    taken[0].apply_defaults()
    given = {key: value for key, value in taken[0].arguments.items() if key not in ("show_progress", "report")}
    defaults = {key: one.default for key, one in inspect.signature(function).parameters.items() if key in given}
    assert given == defaults | dict(zip(defaults, words, strict=False))
