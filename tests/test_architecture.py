"""Who may import whom, checked on the syntax trees.

The twin must not bend rays with the formulas it is meant to test, the sensor's software must run without a renderer,
and the oracles must be independent of both.
"""

import ast
import sys
from collections.abc import Iterable
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]

# What the twin may know of the sensor's software: what the sensor is (description, nominal media and placement, the
# library that finds descriptions), how a capture and its ground truth are stored, how files are written, the errors,
# how both commands speak on the terminal, how they work in several processes, how pages are made, and where the library
# of GigE Vision is found. Nothing of how the software computes:
# camera, refraction, sheet, stripe, detection of targets, calibration, reconstruction, metrology.
SHARED_WITH_TWIN = {
    "errors",
    "sensor",
    "media",
    "waters",
    "phase_functions",
    "placement",
    "library",
    "capture",
    "truth",
    "files",
    "hdf5_file",
    "console",
    "workers",
    "shared_library",
    "report.page_toolkit",
}

# Of the targets the twin knows the descriptions alone, which it draws.
DESCRIBED_TARGETS = {"targets.Patch", "targets.Target", "targets.parse_target"}

RENDERER = {"mitsuba", "drjit"}


def imported(source: str, module: str, *, is_package: bool = False) -> set[str]:
    """Full names of everything a module imports, wherever in the file, also by ``import_module("...")``.

    ``from a import b`` gives ``a.b``, as b may be a module; a star import gives ``a.*``.
    """
    package = module.split(".") if is_package else module.split(".")[:-1]
    found = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            above = package[: len(package) - node.level + 1] if node.level else []
            origin = ".".join([*above, node.module] if node.module else above)
            found |= {f"{origin}.{alias.name}" for alias in node.names}
        elif isinstance(node, ast.Call) and _name(node.func) in ("import_module", "__import__"):
            found |= {a.value for a in node.args if isinstance(a, ast.Constant) and isinstance(a.value, str)}
    return found


def _name(function: ast.expr) -> str | None:
    if isinstance(function, ast.Attribute):
        return function.attr
    return function.id if isinstance(function, ast.Name) else None


def tops(names: Iterable[str]) -> set[str]:
    """First parts of dotted names."""
    return {name.split(".")[0] for name in names}


def beyond_shared(names: Iterable[str]) -> set[str]:
    """Names from uwlts that the twin may not import; the package itself and its version are free."""
    foreign = {name for name in names if name.split(".")[0] == "uwlts"}
    shared = tuple(f"uwlts.{name}." for name in SHARED_WITH_TWIN | DESCRIBED_TARGETS)
    return {n for n in foreign - {"uwlts", "uwlts.__version__"} if not f"{n}.".startswith(shared)}


def imports_of(folder: str) -> dict[str, set[str]]:
    """Imports of every module under a folder of the project, by its path."""
    result = {}
    for path in sorted((ROOT / folder).rglob("*.py")):
        parts = path.relative_to(ROOT).with_suffix("").parts
        is_package = parts[-1] == "__init__"
        module = ".".join(parts[:-1] if is_package else parts)
        text = path.read_text(encoding="utf-8")
        result[str(path.relative_to(ROOT))] = imported(text, module, is_package=is_package)
    return result


def test_the_sensors_software_imports_neither_renderer_nor_twin():
    trees = imports_of("uwlts")
    assert len(trees) > 10
    assert not {path: bad for path, names in trees.items() if (bad := tops(names) & (RENDERER | {"twin"}))}


def test_the_twin_imports_only_what_it_may_share():
    trees = imports_of("twin")
    assert trees
    assert not {path: bad for path, names in trees.items() if (bad := beyond_shared(names))}


def test_what_the_twin_shares_does_not_lead_on_to_the_rest():
    trees = imports_of("uwlts")
    modules = [name.replace(".", "/") for name in SHARED_WITH_TWIN] + ["__init__", "report/__init__"]
    shared = {path: trees[path] for path in [f"uwlts/{module}.py" for module in modules]}
    assert not {path: bad for path, names in shared.items() if (bad := beyond_shared(names))}


def test_the_oracles_use_numpy_and_the_standard_library_alone():
    trees = imports_of("tests/oracles")
    assert len(trees) > 1
    allowed = {"numpy"} | sys.stdlib_module_names
    for path, names in trees.items():
        foreign = {n for n in names if n.split(".")[0] not in allowed and not n.startswith("tests.oracles")}
        assert not foreign, path


def test_the_twin_searches_for_no_target():
    for path in (ROOT / "twin").rglob("*.py"):
        calls = [node for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))) if isinstance(node, ast.Call)]
        assert "detect" not in {_name(call.func) for call in calls}, path


@pytest.mark.parametrize(
    "source",
    [
        "import uwlts.optics.window",
        "import numpy as np, uwlts.optics.camera as c",
        "from uwlts import sensor, refraction",
        "from uwlts import *",
        "from uwlts.optics.window import refract",
        "from uwlts.model.calibration import WindowModel",
        "def late():\n    from uwlts.optics.reconstruction import points_on_sheet",
        "try:\n    import uwlts.optics.camera\nexcept ImportError:\n    pass",
        "import importlib\nimportlib.import_module('uwlts.stripe')",
        "__import__('uwlts.stripe')",
        "from uwlts.targets import detection",
        "from uwlts.targets.detection import find_circles",
        "import uwlts.targets.circles",
    ],
)
def test_a_forbidden_import_is_detected(source):
    assert beyond_shared(imported(source, "twin.scene.description"))


@pytest.mark.parametrize(
    "source", ["import mitsuba as mi", "from drjit import auto", "from twin.scene.description import build"]
)
def test_a_renderer_in_the_software_is_detected(source):
    assert tops(imported(source, "uwlts.stripe")) & (RENDERER | {"twin"})


def test_relative_imports_are_resolved():
    assert imported("from . import camera", "uwlts.stripe") == {"uwlts.optics.camera"}
    assert imported("from . import model", "uwlts.calibration", is_package=True) == {"uwlts.model.calibration"}
    assert imported("from ..camera import project", "uwlts.calibration.sheet") == {"uwlts.optics.camera.project"}


def test_allowed_imports_pass():
    source = (
        "import uwlts\nfrom uwlts import __version__, sensor\nfrom uwlts.storage.capture import Capture\nimport mitsuba"
    )
    assert not beyond_shared(imported(source, "twin.scene.description"))
