"""Command lines of the sensor's software and of the twin, run in a process or as a separate program."""

import io
import runpy
import shlex
import subprocess
import sys
from contextlib import redirect_stderr, redirect_stdout

from uwlts.runtime.console import INTERRUPTED


class _PlainErrors(io.TextIOBase):
    """Standard error of a command that runs beside others: it is no terminal, so that it gets lines and no bars."""

    def write(self, text: str, /) -> int:
        assert sys.__stderr__ is not None
        sys.__stderr__.write(text)
        sys.__stderr__.flush()
        return len(text)


def run_line(line: str, *, quiet: bool) -> tuple[int, str]:
    """Run a command as ``python -m`` does, and return its exit code and output.

    Errors and progress appear at once, or are a part of the output if ``quiet``. The command runs in this process:
    importing the shared modules takes most commands longer than their work.
    """
    program, *arguments = shlex.split(line)
    output = io.StringIO()
    sys.argv = [program, *arguments]
    code = 0
    with redirect_stdout(output), redirect_stderr(output if quiet else _PlainErrors()):
        try:
            runpy.run_module(program, run_name="__main__", alter_sys=True)
        except SystemExit as end:
            code = int(end.code or 0)
    if code == INTERRUPTED:
        raise KeyboardInterrupt
    return code, output.getvalue()


def run_apart(line: str, *, quiet: bool) -> tuple[int, str]:
    """Run a command as a separate program, and return its exit code and output.

    Several threads of a process can do so at the same time. Errors and progress appear at once unless ``quiet``.
    """
    errors = subprocess.STDOUT if quiet else None
    words = [sys.executable, "-m", *shlex.split(line)]
    done = subprocess.run(words, check=False, stdout=subprocess.PIPE, stderr=errors, text=True)
    return done.returncode, done.stdout
