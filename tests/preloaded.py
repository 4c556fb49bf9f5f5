"""Processes of scans and of the desk that begin with the libraries imported: two seconds in each new interpreter."""

import multiprocessing
import os
import resource
import signal
import sys
from collections.abc import Callable
from threading import Timer
from typing import TextIO

from uwlts.cli import main

_CONTEXT = multiprocessing.get_context("forkserver")
_DESK = [f"uwlts.desk.{name}" for name in ("guided", "operator_page", "scan", "server")]
_CONTEXT.set_forkserver_preload(["pytest", "tests.preloaded", *_DESK])


class Preloaded:
    """A process that calls a function of a module, with pipes as its standard streams.

    Attributes and methods are those of `subprocess.Popen` that the tests use.
    """

    def __init__(self, function: Callable[..., None], *arguments: str):
        pipes = [_CONTEXT.Pipe(duplex=False) for _ in range(3)]
        (read_in, write_in), (read_out, write_out), (read_errors, write_errors) = pipes
        inner = (read_in, write_out, write_errors)
        self._process = _CONTEXT.Process(target=_call, args=(inner, function, arguments))
        self._process.start()
        for end in inner:
            end.close()
        self.stdin, self.stdout, self.stderr = _text(write_in, "w"), _text(read_out, "r"), _text(read_errors, "r")
        self._written = "", ""

    @property
    def pid(self) -> int:
        assert self._process.pid
        return self._process.pid

    def poll(self) -> int | None:
        """Return the exit code, None if the process runs."""
        return self._process.exitcode

    @property
    def returncode(self) -> int | None:
        return self.poll()

    def send_signal(self, number: signal.Signals) -> None:
        os.kill(self.pid, number)

    def kill(self) -> None:
        self._process.kill()

    def wait(self, seconds: float | None = None) -> int | None:
        """Wait for the end, and return the exit code."""
        self._process.join(seconds)
        return self.poll()

    def communicate(self, timeout: float | None = None) -> tuple[str, str]:
        """Wait for the end, and return what it wrote; a process that runs for longer than ``timeout`` s is killed."""
        late = Timer(timeout, self.kill) if timeout else None
        if late:
            late.start()
        if not self.stdout.closed:
            with self.stdin, self.stdout, self.stderr:
                self._written = self.stdout.read(), self.stderr.read()
        self.wait()
        if late:
            late.cancel()
        return self._written


def uwlts(*words: object) -> Preloaded:
    """Start the command ``uwlts``."""
    return Preloaded(run_uwlts, *map(str, words))


def run_uwlts(*words: str) -> None:
    """Run the command in this process, which ends by signals as in a terminal, and writes no core."""
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    for number in (signal.SIGHUP, signal.SIGQUIT):
        signal.signal(number, signal.SIG_DFL)
    sys.argv = ["uwlts", *words]
    main()


def _call(streams: tuple, function: Callable[..., None], arguments: tuple[str, ...]) -> None:
    for number, stream in enumerate(streams):
        os.dup2(stream.fileno(), number)
        stream.close()
    sys.stdin = os.fdopen(0)
    function(*arguments)


def _text(end, mode: str) -> TextIO:
    """Return a pipe's end as a text file."""
    file = os.fdopen(os.dup(end.fileno()), mode)
    end.close()
    return file
