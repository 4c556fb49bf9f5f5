"""Rules of the packages: permitted imports (contracts of import-linter), and unique class names."""

import ast
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import FrameType

import numpy as np

import uwlts
from tests.uwlts.evaluation.test_artefact_figures import DUMBBELL, cloud_of, dumbbell
from uwlts.argument_types import _read_hints

ROOT = Path(__file__).resolve().parents[1]

# Each would break a contract of pyproject.toml: late, conditional, relative and indirect imports.
FORBIDDEN = {
    "twin/scene/bent_a.py": "import uwlts.optics.window",
    "twin/scene/bent_b.py": "import numpy as np, uwlts.optics.camera as c",
    "twin/scene/bent_c.py": "from uwlts.optics import camera, window",
    "twin/light/bent_d.py": "from uwlts.optics.window import refract",
    "twin/light/bent_e.py": "def late():\n    from uwlts.reconstruction.reconstruct import reconstruct",
    "twin/light/bent_f.py": "try:\n    import uwlts.stripe\nexcept ImportError:\n    pass",
    "twin/sensor/bent_g.py": "from uwlts.targets.detection import blobs",
    "uwlts/optics/bent_h.py": "import mitsuba as mi",
    "uwlts/stripe/bent_i.py": "def late():\n    from drjit import auto",
    "uwlts/model/bent_j.py": "from twin.scene import description",
    "uwlts/model/bent_k.py": "from ..calibration import calibrate",
    "uwlts/storage/bent_l.py": "from uwlts.report import plot",
    "uwlts/hardware/bent_m.py": "def late():\n    from uwlts.desk.server import DeskServer",
}


def contracts(folder: Path) -> subprocess.CompletedProcess[str]:
    """Run import-linter on the packages of a folder."""
    code = "import sys; sys.path.insert(0, '.'); from importlinter.cli import lint_imports; sys.exit(lint_imports())"
    return subprocess.run(
        [sys.executable, "-c", code], cwd=folder, capture_output=True, text=True, check=False, env={"COLUMNS": "200"}
    )


def copied(folder: Path) -> Path:
    """The sources of both packages and their settings, copied into a folder."""
    for package in ("uwlts", "twin"):
        shutil.copytree(ROOT / package, folder / package, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(ROOT / "pyproject.toml", folder)
    return folder


def test_the_contracts_hold(tmp_path: Path):
    done = contracts(copied(tmp_path))
    assert done.returncode == 0, done.stdout + done.stderr
    assert "0 broken" in done.stdout


def test_the_contracts_notice_forbidden_imports(tmp_path: Path):
    folder = copied(tmp_path)
    for path, source in FORBIDDEN.items():
        (folder / path).write_text(source + "\n", encoding="utf-8")
    done = contracts(folder)
    assert done.returncode == 1
    unnoticed = [path for path in FORBIDDEN if path.removesuffix(".py").replace("/", ".") not in done.stdout]
    assert not unnoticed, done.stdout


def test_no_module_is_imported_by_a_name_in_quotes():
    """A module imported by `import_module("...")` is invisible to the contracts; lazy faces may do so."""
    faces = {"uwlts/targets/__init__.py", "uwlts/stripe/methods/__init__.py"}
    allowed = faces | {"uwlts/runtime/optional_library.py"}
    found = set()
    for package in ("uwlts", "twin"):
        for path in (ROOT / package).rglob("*.py"):
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                if isinstance(node, ast.Call):
                    function = node.func
                    name = function.attr if isinstance(function, ast.Attribute) else getattr(function, "id", "")
                    if name in ("import_module", "__import__") and not _external(node):
                        found.add(str(path.relative_to(ROOT)))
    assert found <= allowed


def test_no_two_public_classes_have_one_name():
    places: dict[str, list[str]] = {}
    for package in ("uwlts", "twin"):
        for path in (ROOT / package).rglob("*.py"):
            for node in ast.parse(path.read_text(encoding="utf-8")).body:
                if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                    places.setdefault(node.name, []).append(str(path.relative_to(ROOT)))
    assert len(places) > 300
    assert {name: where for name, where in places.items() if len(where) > 1} == {}


def _external(call: ast.Call) -> bool:
    """Return True if the call's first argument is a literal name outside the two packages."""
    first = call.args[0] if call.args else None
    return isinstance(first, ast.Constant) and str(first.value).split(".")[0] not in ("uwlts", "twin")


def test_the_oracles_use_numpy_and_the_standard_library_alone():
    allowed = {"numpy"} | sys.stdlib_module_names
    paths = sorted((ROOT / "tests/oracles").rglob("*.py"))
    assert len(paths) > 1
    for path in paths:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                names = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom):
                assert not node.level, path
                names = [node.module or ""]
            else:
                continue
            foreign = {n for n in names if n.split(".")[0] not in allowed and not n.startswith("tests.oracles")}
            assert not foreign, path


def test_the_citation_names_the_version():
    assert f"\nversion: {uwlts.__version__}\n" in (ROOT / "CITATION.cff").read_text(encoding="utf-8")


def test_folders_of_tests_are_packages():
    folders = {path.parent.relative_to(ROOT / "tests") for path in (ROOT / "tests").rglob("test_*.py")}
    mirrored = {folder for folder in folders if folder.parts[:1] in (("uwlts",), ("twin",))}
    assert len(mirrored) > 20
    assert {str(folder) for folder in mirrored if not (ROOT / folder / "__init__.py").exists()} == set()


def silent_numbers(source: str) -> list[str]:
    """Named numbers of a module without words: a comment in the line or above the group, or a text below the group."""
    lines, silent, group, commented = source.splitlines(), [], [], False
    for node in ast.parse(source).body:
        match node:
            case ast.Expr(value=ast.Constant()):
                group = []
                continue
            case ast.Assign(targets=[ast.Name(id=name)]) | ast.AnnAssign(target=ast.Name(id=name)):
                pass
            case _:
                name = ""
        above = lines[node.lineno - 2] if node.lineno > 1 else ""
        if above.startswith("#"):
            commented = True
        elif not above or above.endswith('"""') or not name:
            commented = False
        if not above or not name:
            silent, group = [*silent, *group], []
        value = node.value if isinstance(node, ast.Assign | ast.AnnAssign) else None
        is_number = isinstance(value, ast.Constant | ast.BinOp | ast.UnaryOp | ast.Tuple) and any(
            isinstance(each, ast.Constant) and type(each.value) in (int, float) for each in ast.walk(value)
        )
        if name.isupper() and is_number and not commented and "#" not in lines[(node.end_lineno or node.lineno) - 1]:
            group.append(name)
    return [*silent, *group]


REASON = re.compile(
    r"\d|[`/;:]|\b(because|since|so that|than|as|otherwise|if|where|which|enough|would|could|may|cannot|needs?|chosen|"
    r"beyond|reach(es|ed)?|one|two|three|four|five|half|third|quarter|tenth|hundred|thousand|million|twice)\b"
)
"""A reason, number, source or path in the text about a number."""
MOST_WITHOUT_REASON = 400
"""Named numbers whose texts only say what they are: 397 of 1,237 on 2026-11-30. Lower it; a new number has a reason."""


def numbers_without_reason(source: str) -> list[str]:
    """Named numbers of a module whose text, beside, below or above them, contains no reason."""
    lines, body, found = source.splitlines(), ast.parse(source).body, []
    for place, node in enumerate(body):
        match node:
            case ast.Assign(targets=[ast.Name(id=name)], value=value) | ast.AnnAssign(ast.Name(id=name), value=value):
                pass
            case _:
                continue
        is_number = isinstance(value, ast.Constant | ast.BinOp | ast.UnaryOp | ast.Tuple) and any(
            isinstance(each, ast.Constant) and type(each.value) in (int, float) for each in ast.walk(value)
        )
        if not name.isupper() or not is_number:
            continue
        _, _, text = lines[node.end_lineno - 1].partition("#")
        for below in body[place + 1 :] if not text else ():
            if isinstance(below, ast.Expr) and isinstance(below.value, ast.Constant):
                text = str(below.value.value)
            if not isinstance(below, ast.Assign | ast.AnnAssign) or not lines[below.lineno - 2]:
                break
        for above in reversed(lines[: node.lineno - 1] if not text else []):
            text += above if above.startswith("#") else ""
            if not above:
                break
        if not REASON.search(text):
            found.append(name)
    return found


def test_new_numbers_have_more_than_a_definition():
    assert numbers_without_reason("A = 1\n\n# Size.\nB = 2\nC = 3\nD = 4  # size of D\n") == ["A", "B", "C", "D"]
    assert numbers_without_reason('E = 5\n"""Size, so that no two touch."""\nF = 6  # more take 2 s\n') == []
    found = [
        (str(path.relative_to(ROOT)), name)
        for package in ("twin", "uwlts")
        for path in (ROOT / package).rglob("*.py")
        for name in numbers_without_reason(path.read_text(encoding="utf-8"))
    ]
    assert 300 < len(found) <= MOST_WITHOUT_REASON, found


def test_named_numbers_have_a_reason():
    assert silent_numbers("A = 1\n\n# Why.\nB = 2\nC = 3\nD = 4  # why\n\nE = 5\n") == ["A", "E"]
    assert silent_numbers('F = 1\nG = 2\n"""Why both."""\nH = 3\n') == ["H"]
    silent = {
        str(path.relative_to(ROOT)): names
        for package in ("twin", "uwlts")
        for path in (ROOT / package).rglob("*.py")
        if (names := silent_numbers(path.read_text(encoding="utf-8")))
    }
    assert not silent


MOST_STOPS = {"file": (47, 84), "cloud": (16, 56)}
"""Functions of the product that a reader of `evaluate` meets before the search of the spheres, and in all.

For a PLY file of two spheres, and for a cloud in memory. Of those of the file, 8 check the arguments, 34 read the file
and check its content, 5 resolve the artefact, 26 find and fit the spheres, and 11 compute the figures. Each checks or
computes what no other one does. Lower the numbers when a simpler rule replaces some; none is raised.
"""


def stops(function: Callable[..., object], *args: object) -> list[str]:
    """Return the functions of the product that a call enters, in the order of their first entry.

    Lambdas and comprehensions belong to the function that they stand in.
    """
    found: dict[str, None] = {}

    def note(frame: FrameType, event: str, _: object) -> None:
        code = frame.f_code
        path = Path(code.co_filename)
        if event == "call" and code.co_name[0] != "<" and path.is_relative_to(ROOT):
            place = path.relative_to(ROOT)
            if place.parts[0] in ("uwlts", "twin"):
                found[f"{place}:{code.co_qualname}"] = None

    sys.setprofile(note)
    try:
        function(*args)
    finally:
        sys.setprofile(None)
    return list(found)


def test_evaluating_a_cloud_makes_few_stops(tmp_path: Path):
    cloud = cloud_of(dumbbell(np.random.default_rng(0)))
    cloud.save(tmp_path / "spheres.ply")
    for kind, given in (("file", tmp_path / "spheres.ply"), ("cloud", cloud)):
        _read_hints.cache_clear()
        found = stops(uwlts.evaluate, given, DUMBBELL)
        before = found.index("uwlts/evaluation/artefact_figures.py:evaluate_spheres")
        assert any(each.endswith(":Sphere.fit") for each in found[before:])
        most_before, most = MOST_STOPS[kind]
        assert before <= most_before and len(found) <= most, (before, len(found), found)
