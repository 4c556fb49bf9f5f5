"""Compiled loops are kept on disk, and compiled anew when what they call has changed."""

import subprocess
import sys
from pathlib import Path

CALLER = """\
from uwlts.runtime.compiled import compiled
from inner.called import factor

@compiled
def scaled(x):
    return factor() * x

print(scaled(2.0), sum(scaled.stats.cache_hits.values()))
"""
CALLED = """\
from uwlts.runtime.compiled import compiled

@compiled
def factor():
    return {}
"""


def run(folder: Path) -> list[str]:
    code = f"import sys; sys.path.insert(0, {str(folder)!r}); import inner.caller"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return done.stdout.split()


def test_a_change_in_another_file_of_the_package_is_noticed(tmp_path: Path):
    package = tmp_path / "uwlts" / "inner"
    package.mkdir(parents=True)
    (package / "__init__.py").touch()
    (package / "caller.py").write_text(CALLER)
    (package / "called.py").write_text(CALLED.format("3.0"))
    assert run(package.parent) == ["6.0", "0"]
    assert run(package.parent) == ["6.0", "1"]
    (package / "called.py").write_text(CALLED.format("50.0"))
    assert run(package.parent) == ["100.0", "0"]
