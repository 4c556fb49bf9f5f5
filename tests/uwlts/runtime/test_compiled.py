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
from {}.called import factor

@compiled
def scaled(x):
    return factor() * x

print(scaled(2.0), sum(scaled.stats.cache_hits.values()))
"""
CALLED = """\
from uwlts.runtime.compiled import {0}

@{0}
def factor():
    return {1}
"""


def run(folder: Path) -> list[str]:
    code = f"import sys; sys.path.insert(0, {str(folder)!r}); import inner.caller"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return done.stdout.split()


@pytest.mark.parametrize(
    ("other", "kind"), [("inner", "compiled_part"), ("beside", "compiled_part"), ("beside", "compiled_inline")]
)
def test_a_change_in_another_file_that_is_called_is_noticed(tmp_path: Path, other, kind):
    packages = tmp_path / "uwlts"
    for name in ("inner", "beside"):
        (packages / name).mkdir(parents=True)
        (packages / name / "__init__.py").touch()
    (packages / "inner" / "caller.py").write_text(CALLER.format(other))
    called = packages / other / "called.py"
    called.write_text(CALLED.format(kind, "3.0"))
    assert run(packages) == ["6.0", "0"]
    assert run(packages) == ["6.0", "1"]
    called.write_text(CALLED.format(kind, "50.0"))
    assert run(packages) == ["100.0", "0"]


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
