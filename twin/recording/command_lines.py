"""Command lines of the sensor's software and of the twin, run two at a time, as a user would type them."""

import io
import runpy
import shlex
import sys
from collections.abc import Iterable, Iterator
from contextlib import redirect_stderr, redirect_stdout
from functools import partial

from uwlts.errors import CommandFailed, SetupError
from uwlts.runtime.console import INTERRUPTED
from uwlts.runtime.workers import Lost, Workers

AT_ONCE = 2
"""Number of parallel commands of a stage: only rendering uses all processors by itself."""


def run_lines(workers: Workers, lines: Iterable[str], *, quiet: bool = False) -> None:
    """Run independent command lines of ``uwlts`` and ``twin`` in parallel, and print each one and its output.

    With ``quiet``, only the output of a command that fails is printed. Raises CommandFailed if one fails; its output,
    which has been printed, gives the reason. Raises SetupError if a worker process ended unexpectedly.
    """
    run = partial(_run, quiet=quiet)
    for line, ended in workers.map_unordered(run, lines if quiet else _announce(lines)):
        if isinstance(ended, Lost):
            raise SetupError(f"{line}: {ended.reason}")
        code, output = ended
        if code or not quiet:
            print(output, end="", flush=True)
        if code:
            raise CommandFailed(line, code)


def _announce(lines: Iterable[str]) -> Iterator[str]:
    """Yield the commands; print each one when it starts."""
    for line in lines:
        print(f"$ {line}", flush=True)
        yield line


class _PlainErrors(io.TextIOBase):
    """Standard error of a command that runs beside others: it is no terminal, so that it gets lines and no bars."""

    def write(self, text: str, /) -> int:
        assert sys.__stderr__ is not None
        sys.__stderr__.write(text)
        sys.__stderr__.flush()
        return len(text)


def _run(line: str, *, quiet: bool) -> tuple[int, str]:
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
