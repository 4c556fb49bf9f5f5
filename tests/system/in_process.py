"""Run the command line inside the test's process, through its entry point; this saves a second of imports."""

import subprocess
import sys
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext, redirect_stderr, redirect_stdout
from io import StringIO

import pytest
from cyclopts import App

from uwlts import cli
from uwlts.runtime import console
from uwlts.runtime.workers import Workers, open_workers


def uwlts(*arguments: object) -> subprocess.CompletedProcess[str]:
    """Exit code and output of ``uwlts`` with these arguments."""
    return run_program(cli.app, "uwlts", *arguments)


def run_program(app: App, program: str, *arguments: object) -> subprocess.CompletedProcess[str]:
    """Exit code and output of a program with these arguments."""
    words, said, errors = [program, *map(str, arguments)], StringIO(), StringIO()
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(said), redirect_stderr(errors):
        patch.setattr(sys, "argv", words)
        try:
            code = console.run(app)
        except SystemExit as ended:
            code = ended.code
    return subprocess.CompletedProcess(words, code, said.getvalue(), errors.getvalue())


@contextmanager
def shared_workers() -> Iterator[Workers]:
    """Let all sweeps of this process share workers, unless they state the number or address of their own."""
    with open_workers() as pool, pytest.MonkeyPatch.context() as patch:

        def opened(*, workers: int | None = None, scheduler: str | None = None) -> AbstractContextManager[Workers]:
            usual = workers is None and scheduler is None
            return nullcontext(pool) if usual else open_workers(workers=workers, scheduler=scheduler)

        patch.setattr("twin.design.sweep.open_workers", opened)
        yield pool
