"""Compiled loops are cached on disk, and compiled again when a function that they call has changed."""

import gc
import subprocess
import sys
from pathlib import Path

import pytest
from numba.core import event
from numba.core.errors import TypingError

from uwlts.runtime.compiled import compiled_part

CALLER = """\
from uwlts.runtime.compiled import compiled
from inner.called import part as near
from beside.called import part
from beside.called import inline

@compiled
def by_near(x):
    return near() * x

@compiled
def by_part(x):
    return part() * x

@compiled
def by_inline(x):
    return inline() * x

for each in (by_near, by_part, by_inline):
    print(each(2.0), sum(each.stats.cache_hits.values()))
"""
CALLED = """\
from uwlts.runtime.compiled import compiled_inline, compiled_part

@compiled_part
def part():
    return {0}

@compiled_inline
def inline():
    return {0}
"""


def run(folder: Path) -> list[str]:
    code = f"import sys; sys.path.insert(0, {str(folder)!r}); import inner.caller"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return done.stdout.splitlines()


def test_a_change_in_another_file_that_is_called_is_noticed(tmp_path: Path):
    """In the caller's own package and in another one; a function that is inlined, and one that is not."""
    packages = tmp_path / "uwlts"
    for name in ("inner", "beside"):
        (packages / name).mkdir(parents=True)
        (packages / name / "__init__.py").touch()
        (packages / name / "called.py").write_text(CALLED.format("3.0"))
    (packages / "inner" / "caller.py").write_text(CALLER)
    assert run(packages) == ["6.0 0"] * 3
    assert run(packages) == ["6.0 1"] * 3
    # A change in the caller's package is noticed by all; one beside it only by those that call it.
    (packages / "beside" / "called.py").write_text(CALLED.format("50.0"))
    assert run(packages) == ["6.0 1", "100.0 0", "100.0 0"]
    (packages / "inner" / "called.py").write_text(CALLED.format("50.0"))
    assert run(packages)[0] == "100.0 0"


@pytest.mark.parametrize("collects", [True, False])
def test_garbage_is_collected_after_compilation_as_before_it(collects):
    """Also if a function cannot be compiled."""
    seen = []

    class Listener(event.Listener):
        def on_start(self, event):
            seen.append(gc.isenabled())

        def on_end(self, event):
            pass

    def doubled(x):
        return x + x

    def unknown(x):
        return x.nothing

    (gc.enable if collects else gc.disable)()
    try:
        with event.install_listener("numba:compile", Listener()):
            assert compiled_part(doubled).compile("float64(float64)") is not None
            with pytest.raises(TypingError):
                compiled_part(unknown).compile("float64(float64)")
        assert gc.isenabled() == collects
    finally:
        gc.enable()
    assert seen == [False, False]
