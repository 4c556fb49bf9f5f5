"""Processes that work for a command, several jobs at a time. They end when it ends, however that happens.

Python's own pool of processes finishes what it has begun and what it has queued before it lets a command end, and
leaves its processes behind where the command is killed.
"""

import multiprocessing
import os
import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from typing import Any, TypeVar

from uwlts.errors import SetupError, UwltsError

Job = TypeVar("Job")
Result = TypeVar("Result")
Tell = Callable[[Any], None]

_THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")

_GRACE_S = 5.0
"""How long a process may take to leave its files in order before it is killed."""


def work_through(
    work: Callable[[Job, Tell], Result],
    jobs: Sequence[Job],
    *,
    workers: int | None = None,
    heard: Tell = lambda message: None,
) -> list[Result]:
    """Results of ``work(job, tell)`` for all jobs, in their order, from several processes.

    Jobs are begun in their order. What one of them tells on the way is passed to ``heard`` in this process. When an
    exception leaves this function, KeyboardInterrupt stops the jobs that are under way, and no process is left.
    ``workers`` is the number of processes, that of the processors unless given; one works in this process.

    Raises
    ------
    UwltsError, OSError
        As the first job that fails raises it.
    SetupError
        A process has ended before its job.
    """
    if workers == 1:
        return [work(job, heard) for job in jobs]
    waiting, results = deque(enumerate(jobs)), {}
    begun: list[_Worker] = []
    try:
        for _ in range(min(len(jobs), workers or len(os.sched_getaffinity(0)))):
            begun.append(_Worker(work))
            begun[-1].give(waiting.popleft())
        busy = {worker.connection: worker for worker in begun}
        while busy:
            for connection in wait(list(busy)):
                number, ended, content = busy[connection].message()
                if not ended:
                    heard(content)
                elif number is None:
                    raise content
                else:
                    results[number] = content
                    if waiting:
                        busy[connection].give(waiting.popleft())
                    else:
                        busy.pop(connection).give(None)
    finally:
        _end(begun, at_once=len(results) < len(jobs))
    return [results[number] for number in range(len(jobs))]


class _Worker:
    """A process and the connection to it."""

    def __init__(self, work: Callable[[Any, Tell], Any]):
        context = multiprocessing.get_context("spawn")
        self.connection, theirs = context.Pipe()
        self.process = context.Process(target=_serve, args=(theirs, work), daemon=True)
        with _interrupts_held(), _one_thread():
            self.process.start()
        theirs.close()

    def give(self, job: tuple[int, Any] | None) -> None:
        """Hand over a job with its number, or None when there are no more."""
        try:
            self.connection.send(job)
        except BrokenPipeError as error:
            raise self._ended() from error

    def message(self) -> tuple[int | None, bool, Any]:
        """Number of the job, None if it failed; whether it has ended; what it tells, its result, or its error."""
        try:
            return self.connection.recv()
        except (EOFError, ConnectionResetError) as error:
            raise self._ended() from error

    def _ended(self) -> SetupError:
        self.process.join(_GRACE_S)
        code = self.process.exitcode
        how = f"signal {signal.Signals(-code).name}" if code is not None and code < 0 else f"exit code {code}"
        return SetupError(
            f"a working process has ended unexpectedly ({how}), perhaps for want of memory: run fewer workers at a time"
        )


@contextmanager
def _one_thread() -> Iterator[None]:
    """Processes started meanwhile do linear algebra in one thread, unless told otherwise.

    With a thread for each processor in each of as many processes they wait for each other: two joint calibrations at a
    time took 17 to 25 s instead of 6 to 8 s on two processors.
    """
    given = {name: os.environ[name] for name in _THREADS if name in os.environ}
    os.environ.update(dict.fromkeys(_THREADS, "1") | given)
    try:
        yield
    finally:
        for name in _THREADS:
            if name not in given:
                del os.environ[name]


@contextmanager
def _interrupts_held() -> Iterator[None]:
    """Ctrl-C is the command's business alone: a process that is started meanwhile never hears of it."""
    # Starting Python's tracker of shared resources would let interrupts through again.
    resource_tracker.ensure_running()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _end(workers: list[_Worker], *, at_once: bool) -> None:
    if at_once:
        for worker in workers:
            worker.process.terminate()
    deadline = time.monotonic() + _GRACE_S
    for worker in workers:
        worker.process.join(max(0.0, deadline - time.monotonic()))
        worker.process.kill()
        worker.process.join()
        worker.connection.close()


def _serve(connection: Connection, work: Callable[[Any, Tell], Any]) -> None:
    """What a process does: one job after the other, until there are no more or it is stopped."""
    stopped = threading.Event()

    def stop(*_: object) -> None:
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        stopped.set()
        raise KeyboardInterrupt

    def send(number: int | None, ended: bool, content: Any) -> None:
        try:
            connection.send((number, ended, content))
        except BrokenPipeError:
            stop()

    try:
        signal.signal(signal.SIGTERM, stop)
        threading.Thread(target=_end_with_parent, daemon=True).start()
        while (given := connection.recv()) is not None:
            number, job = given
            try:
                result = work(job, lambda message, number=number: send(number, False, message))
            except (UwltsError, OSError) as error:
                send(None, True, error)
            else:
                send(number, True, result)
    finally:
        # Whatever the interrupt has become on its way through a library, there is nothing to say about it.
        if stopped.is_set():
            os._exit(1)


def _end_with_parent() -> None:
    multiprocessing.parent_process().join()
    os.kill(os.getpid(), signal.SIGTERM)
    time.sleep(_GRACE_S)
    os._exit(1)
