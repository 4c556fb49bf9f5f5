"""The command line run inside the test's process, as its entry point runs it: without the second that imports take."""

import subprocess
import sys
from contextlib import redirect_stderr, redirect_stdout
from io import StringIO

import pytest
from cyclopts import App

from uwlts import cli
from uwlts.runtime import console


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
