"""Executors of a sweep's jobs: processes of this machine, or the workers of a Dask cluster, by the same calls."""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, CancelledError, Executor, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, TypeVar

from uwlts.errors import SetupError

Job = TypeVar("Job")
Result = TypeVar("Result")

_AHEAD = 2
"""Jobs handed over per worker: one in work, one waiting, so that nobody waits for this process."""
_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMEXPR_NUM_THREADS")


@dataclass(frozen=True)
class Lost:
    """A job whose workers ended before it did, with the reason."""

    reason: str


class Crew:
    """Workers that do jobs, one after the other or many at a time, until the crew is closed.

    Attributes
    ----------
    workers : int
        How many work at the same time.
    """

    def __init__(
        self, workers: int, executor: Callable[[], Executor], *, alone: bool, killed: tuple[type[Exception], ...] = ()
    ):
        self.workers, self._alone = workers, alone
        self._make, self._killed = executor, killed
        self._executor = executor()

    def processes_for(self, jobs: int) -> int:
        """How many processes each of so many jobs may use: on this machine, where there are more processors than jobs.

        A worker of a cluster may not start processes of its own.
        """
        return max(1, self.workers // max(jobs, 1)) if self._alone else 1

    def close(self) -> None:
        """End the workers; what waits is not begun."""
        if self._alone:
            self._executor.shutdown(wait=True, cancel_futures=True)
        else:
            self._executor.shutdown(wait=False)

    def work(self, function: Callable[[Job], Result], jobs: Iterable[Job]) -> Iterator[tuple[Job, Result | Lost]]:
        """Pairs of a job and its result, in the order in which they are done.

        Jobs are taken from ``jobs`` only shortly before they are begun. A process that dies takes those with it that
        work at the same time: all of them are done again, one at a time, and only the one under which a process dies
        again is `Lost`. A Dask cluster does that by itself.

        Raises
        ------
        SetupError
            The cluster is gone.
        """
        waiting, suspects, running = iter(jobs), deque[Job](), dict[Future, Job]()
        while True:
            alone = bool(suspects)
            while len(running) < (1 if alone else self.workers * _AHEAD):
                job = suspects.popleft() if alone else next(waiting, None)
                if job is None:
                    break
                running[self._submitted(function, job)] = job
            if not running:
                return
            done, _ = wait(running, return_when=FIRST_COMPLETED)
            for future in done:
                job = running.pop(future)
                try:
                    result = future.result()
                except BrokenProcessPool:
                    self._begin_anew()
                    if alone:
                        yield job, Lost("its process has ended unexpectedly, perhaps for want of memory")
                    suspects.extend([*(() if alone else (job,)), *running.values()])
                    running.clear()
                    break
                except self._killed as error:
                    yield job, Lost(str(error))
                except CancelledError as error:
                    raise SetupError("the Dask cluster is gone: start it, and run the sweep again") from error
                else:
                    yield job, result

    def _submitted(self, function: Callable[[Job], Result], job: Job) -> Future:
        try:
            return self._executor.submit(function, job)
        except BrokenProcessPool:
            self._begin_anew()
            return self._executor.submit(function, job)

    def _begin_anew(self) -> None:
        self._executor.shutdown(wait=False)
        self._executor = self._make()


@contextmanager
def crew(*, workers: int | None = None, scheduler: str | None = None, patience_s: float = 20.0) -> Iterator[Crew]:
    """The workers: so many processes of this machine (one per processor unless given), or those of a Dask scheduler.

    ``patience_s`` is how long a scheduler may take to answer.

    Raises
    ------
    SetupError
        Dask is not installed, or no scheduler answers at the address, or it has no workers.
    """
    if scheduler is not None:
        yield from _cluster(scheduler, patience_s)
        return
    processors = len(os.sched_getaffinity(0))
    count = workers or processors
    before = {name: os.environ.get(name) for name in _THREADS}
    os.environ.update(dict.fromkeys(_THREADS, str(max(1, processors // count))))
    context = multiprocessing.get_context("spawn")
    hands = Crew(count, lambda: ProcessPoolExecutor(count, mp_context=context, initializer=_begin), alone=True)
    try:
        yield hands
    except BaseException:
        for process in multiprocessing.active_children():
            process.terminate()
        raise
    finally:
        hands.close()
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


def _begin() -> None:
    """Ctrl-C is the command's business alone, and a worker ends with its command however that ends.

    A worker that is to end at once leaves its job by an exception, so that nothing of it stays behind.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, _leave)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _leave(*_: object) -> None:
    sys.exit(1)


def _end_with_parent() -> None:
    multiprocessing.parent_process().join()
    os._exit(1)


def _cluster(address: str, patience_s: float) -> Iterator[Crew]:
    try:
        from distributed import Client
        from distributed.scheduler import KilledWorker
    except ImportError as error:
        raise SetupError("a scheduler needs Dask: pip install 'dask[distributed]'") from error
    try:
        client: Any = Client(address, timeout=patience_s, set_as_default=False)
    except (OSError, ValueError) as error:
        raise SetupError(f"no Dask scheduler answers at {address}: {error}") from error
    with client:
        count = sum(client.nthreads().values())
        if count == 0:
            raise SetupError(f"the scheduler at {address} has no workers: start some with 'dask worker {address}'")
        hands = Crew(count, lambda: client.get_executor(pure=False), alone=False, killed=(KilledWorker,))
        try:
            yield hands
        finally:
            hands.close()
