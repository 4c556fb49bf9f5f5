"""Entry of the commands: signals, progress without a terminal, and options of all commands."""

import signal
import subprocess
import sys
import time

import pytest

from uwlts.errors import Error
from uwlts.runtime import console
from uwlts.runtime.command_line import make_program, show, warn

_PROGRAM = """
import sys, time
from cyclopts import App
from uwlts.runtime.console import run
app = App()

@app.command
def wait():
    print("begun", flush=True)
    time.sleep(60)

sys.argv = ["x", "wait"]
sys.exit(run(app))
"""


def test_a_command_that_was_started_with_interrupts_ignored_ends_by_one():
    """As a shell starts a script's background commands."""
    with subprocess.Popen(
        [sys.executable, "-c", _PROGRAM],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_IGN),
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "begun\n"
        begun = time.monotonic()
        process.send_signal(signal.SIGINT)
        _, said = process.communicate(timeout=30)
    assert (process.returncode, time.monotonic() - begun < 20) == (130, True)
    assert said.startswith("interrupted")


def _said(monkeypatch: pytest.MonkeyPatch, *words: str) -> int:
    app = make_program("x", "A program.")

    @app.command
    def count() -> None:
        print("a result")
        with console.progress_bar("counting") as progress:
            for done in range(101):
                clock[0] += 1.0
                progress(done, 100, "images")

    @app.command
    def fail() -> None:
        raise Error("something is wrong")

    @app.command
    def load(*, memory: bool) -> None:
        raise MemoryError("Unable to allocate 24 MiB") if memory else ImportError("a.so: failed to map segment")

    @app.command
    def doubt(*, cloud_std_mm: float = 0.0) -> None:
        warn("give `cloud_std_mm`, see `uwlts.compare_clouds`")
        show(["a result", "warning: `cloud_std_mm`"])

    clock = [0.0]
    monkeypatch.setattr(console.time, "monotonic", lambda: clock[0])
    monkeypatch.setattr(sys, "argv", ["x", *words])
    return console.run(app)


def test_without_a_terminal_progress_is_a_line_every_ten_seconds(monkeypatch, capsys):
    assert _said(monkeypatch, "count") == 0
    lines = capsys.readouterr().err.splitlines()
    # 101 calls, a second apart from 1 s on: at 10 s, 20 s, ..., 100 s.
    assert lines == [f"counting images: {10 * k - 1} of 100 after {10 * k} s" for k in range(1, 11)]


@pytest.mark.parametrize("words", [("count", "-q"), ("--quiet", "count")])
def test_quiet_prints_neither_results_nor_progress(monkeypatch, capsys, words):
    assert _said(monkeypatch, *words) == 0
    assert capsys.readouterr() == ("", "")
    assert _said(monkeypatch, "count") == 0
    assert capsys.readouterr().out == "a result\n", "the next run is not quiet"
    assert _said(monkeypatch, "fail", "-q") == 2
    assert capsys.readouterr().err == "error: something is wrong\n"


def test_verbose_prints_the_traceback_of_an_error(monkeypatch, capsys):
    assert _said(monkeypatch, "fail", "-v") == 2
    said = capsys.readouterr().err
    assert said.startswith("Traceback") and said.endswith("error: something is wrong\n")


@pytest.mark.parametrize(
    ("option", "found"), [("--memory", "Unable to allocate 24 MiB"), ("--no-memory", "a.so: failed to map segment")]
)
def test_too_little_memory_for_data_or_libraries_is_a_users_error(monkeypatch, capsys, option, found):
    assert _said(monkeypatch, "load", option) == 2
    assert capsys.readouterr().err == f"error: {found}: too little memory? See also `uwlts doctor`\n"
    assert _said(monkeypatch, "load", option, "-v") == 2
    assert capsys.readouterr().err.startswith("Traceback")


def test_warnings_name_the_options_of_the_command_that_runs(monkeypatch, capsys):
    assert _said(monkeypatch, "doubt") == 0
    assert capsys.readouterr() == (
        "a result\nwarning: --cloud-std-mm\n",
        "warning: give --cloud-std-mm, see `uwlts.compare_clouds`\n",
    )
    assert _said(monkeypatch, "count") == 0
    warn("`cloud_std_mm` is no parameter here")
    assert capsys.readouterr().err.endswith("warning: `cloud_std_mm` is no parameter here\n")
