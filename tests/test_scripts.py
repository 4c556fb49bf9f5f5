"""Scripts of benchmarks, tests and studies: each has a help text, and rejects a wrong option before any work."""

import ast
import runpy
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]


def _is_script(path: Path) -> bool:
    """Return True if a module has an `if __name__ == "__main__"` block."""
    text = path.read_text(encoding="utf-8")
    # Parsing all modules would take a second.
    return "\nif __name__ ==" in text and any(
        isinstance(each, ast.If) and ast.unparse(each.test) == "__name__ == '__main__'" for each in ast.parse(text).body
    )


PROCESSES = {"tests/fuzz/running.py", "tests/uwlts/stripe/test_unchanged.py"}
"""Scripts that users do not run: a child process, and a test that can rewrite its data."""
SCRIPTS = [
    path
    for folder in ("docs/studies", "tests")
    for path in sorted((ROOT / folder).rglob("*.py"))
    if str(path.relative_to(ROOT)) not in PROCESSES and _is_script(path)
]


def test_scripts_are_found():
    assert {"coverage.py", "soak.py", "inspection.py"} <= {path.name for path in SCRIPTS}


def test_importing_a_script_does_not_load_drjit():
    """Dr.Jit may be loaded only after its libLLVM has been chosen."""
    folders = [ROOT, ROOT / "docs" / "studies"]
    code = (
        f"import importlib, sys; sys.path[:0] = {[*map(str, folders)]!r}\n"
        f"for name in {sorted(path.stem for path in folders[1].glob('*.py'))!r}:\n"
        "    importlib.import_module(name)\n"
        "    assert 'drjit' not in sys.modules, name\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(
    "module, left_out",
    [
        ("uwlts.desk.scan", ("nicegui", "fastapi", "scipy.stats", "uwlts.recalibration.recalibrate")),
        ("uwlts.calibration.calibrate", ("scipy.stats", "scipy.signal", "nicegui")),
        ("twin.recording.render", ("trimesh", "scipy.stats", "scipy.signal")),
        ("twin.recording.sensor_simulator", ("trimesh", "scipy.stats", "scipy.signal")),
        ("twin.design.sweep", ("plotly", "matplotlib", "scipy.stats")),
    ],
)
def test_a_command_starts_without_libraries_that_few_runs_need(module, left_out):
    """Each of them takes a second or more to import."""
    code = f"import {module}, sys\nprint(sorted({set(left_out)!r} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


@pytest.mark.filterwarnings("ignore:Cyclopts application invoked without tokens")
@pytest.mark.parametrize("path", SCRIPTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_help_and_a_wrong_option(path, tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [str(path.parent), *sys.path])
    # A broad terminal, so that nothing is broken within words.
    monkeypatch.setenv("COLUMNS", "1000")
    codes, texts = [], []
    for option in ("--help", "--no-such-option"):
        monkeypatch.setattr(sys, "argv", [str(path), option])
        with pytest.raises(SystemExit) as ended:
            runpy.run_path(str(path), run_name="__main__")
        codes.append(ended.value.code)
        texts.append(capfd.readouterr())
    assert codes[0] in (0, None) and codes[1] not in (0, None)
    assert texts[0].out.lower().startswith("usage: ")
    assert "error" in texts[1].err.lower() and "Traceback" not in texts[1].err
    assert list(tmp_path.iterdir()) == []
