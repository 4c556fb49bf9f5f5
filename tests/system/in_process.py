"""The command line run inside the test's process, as its entry point runs it: without the second that imports take."""

import subprocess
import sys
from contextlib import redirect_stderr, redirect_stdout
from io import StringIO

import pytest

from uwlts import cli
from uwlts.runtime import console


def uwlts(*arguments: object) -> subprocess.CompletedProcess[str]:
    """How ``uwlts`` with these arguments ended, and what it said."""
    words, said, errors = ["uwlts", *map(str, arguments)], StringIO(), StringIO()
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(said), redirect_stderr(errors):
        patch.setattr(sys, "argv", words)
        try:
            code = console.run(cli.app)
        except SystemExit as ended:
            code = ended.code
    return subprocess.CompletedProcess(words, code, said.getvalue(), errors.getvalue())
