"""Worker processes on this machine, or workers of a Dask cluster, for many jobs in parallel.

`run_jobs` runs a list of jobs in processes that it starts and ends. `open_workers` keeps processes (or the workers
of a Dask scheduler) for several rounds of jobs, and survives jobs whose process dies. These processes
always end with their command, and stopped jobs remove their incomplete files. `concurrent.futures` completes running
jobs before a command ends, and leaves processes behind if the command is killed; loky kills processes amid their jobs.
"""

import gc
import multiprocessing
import os
import pickle
import signal
import threading
import time
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, CancelledError, Future, ThreadPoolExecutor, wait as wait_for_futures
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from itertools import islice
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from queue import SimpleQueue
from typing import Any, Literal, TypeVar, assert_never

from uwlts.errors import Error, SetupError
from uwlts.files.writing import remove_incomplete
from uwlts.runtime.optional_library import pip_install, read_requirements
from uwlts.runtime.progress import preserve_interrupts

Item = TypeVar("Item")
Job = TypeVar("Job")
Result = TypeVar("Result")
Send = Callable[[Any], None]

_THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMEXPR_NUM_THREADS")
_STARTING = threading.Lock()  # the environment belongs to all threads

_GRACE_S = 5.0  # time for a stopped process to clean up; afterwards its incomplete files are removed and it ends
_LEAVE_S = 5.0  # further time, for a busy machine, before the process is killed

_WAIT_S = 0.2  # interval at which the caller may end jobs

_PATIENCE_S = 20.0  # time limit of a scheduler's answer
_AHEAD = 2
"""Jobs submitted to a cluster per worker: one running and one queued, so that no worker waits for this process."""


@dataclass(frozen=True)
class Lost:
    """A job whose process ended first, with the reason; ``by_error``: a program error, whose traceback was printed."""

    reason: str
    by_error: bool = False


class Workers(ABC):
    """Workers that run ``count`` jobs in parallel, for any number of rounds; made by `open_workers`."""

    count: int

    @abstractmethod
    def processes_for(self, jobs: int) -> int:
        """Return the number of processes that each of ``jobs`` jobs may start itself."""

    @abstractmethod
    def map_unordered(
        self, function: Callable[[Job], Result], jobs: Iterable[Job]
    ) -> Iterator[tuple[Job, Result | Lost]]:
        """Iterate over jobs and results of ``function(job)``, in the order of completion.

        Jobs are taken from ``jobs`` shortly before they start. A job whose process dies is run again; if its process
        dies again, its result is `Lost`. Exceptions of jobs are raised here.

        Raises SetupError if the cluster is gone, or a job fails unexpectedly; its traceback is on standard error.
        """


@contextmanager
def open_workers(*, workers: int | None = None, scheduler: str | None = None) -> Iterator[Workers]:
    """Open ``workers`` processes on this machine (default: one per processor), or the workers of a Dask scheduler.

    Processes share the machine's threads. If an exception
    leaves the body, running jobs are stopped by KeyboardInterrupt; no process is left.

    Raises SetupError if Dask is not installed, no scheduler answers at the address, or it has no workers.
    """
    if scheduler is not None:
        with _cluster(scheduler) as cluster:
            yield cluster
        return
    count = workers or count_processors()
    with _Processes(count, threads=max(1, count_processors() // count)) as pool:
        yield pool


def run_jobs(
    work: Callable[[Job, Send], Result],
    jobs: Sequence[Job],
    *,
    workers: int | None = None,
    on_message: Send = lambda message: None,
    on_wait: Callable[[], None] = lambda: None,
) -> list[Result]:
    """Return the results of ``work(job, send)`` for all jobs, in order, from several processes.

    Jobs start in order. Messages that a job passes to ``send`` are passed to ``on_message`` in this process. Several
    times a second ``on_wait`` is called, which may end the jobs by an exception. If an exception leaves this function,
    running jobs are stopped by KeyboardInterrupt, and no process is left. ``workers`` is the number of processes
    (default: one per processor); with 1, jobs run in this process, without ``on_wait``. Each process uses one thread
    for linear algebra, unless the environment sets another number.

    Raises the Error or OSError of the first job that fails; SetupError if a process ends before its job.
    """
    if workers == 1:
        return [work(job, on_message) for job in jobs]
    results: dict[int, Result] = {}
    with _Processes(max(1, min(len(jobs), workers or count_processors())), threads=1) as pool:
        for number, _, result in pool.run(work, jobs, on_message, on_wait):
            if isinstance(result, Lost):
                raise SetupError(result.reason)
            results[number] = result
    return [results[number] for number in range(len(jobs))]


def map_in_threads(function: Callable[[Item], Result], items: Iterable[Item]) -> Iterator[tuple[Item, Result]]:
    """Iterate over items and ``function(item)``, in order, computed in one thread per processor.

    For functions that spend their time outside the interpreter, in OpenCV, NumPy or compiled code. Items are taken in
    this thread, shortly before their turn. Exceptions of the function are raised here. With one processor, this thread
    does all the work.
    """
    if (threads := count_processors()) == 1:
        yield from ((item, function(item)) for item in items)
        return
    with ThreadPoolExecutor(threads) as pool:
        waiting: deque[tuple[Item, Future[Result]]] = deque()
        for item in items:
            waiting.append((item, pool.submit(function, item)))
            if len(waiting) > threads:
                done, result = waiting.popleft()
                yield done, result.result()
        for done, result in waiting:
            yield done, result.result()


def count_processors() -> int:
    """Return the number of processors that this process may use."""
    # Only Linux reports a restriction of the process to some processors.
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class _Processes(Workers, AbstractContextManager["_Processes"]):
    """Processes on this machine, started with the first jobs.

    At its end the context stops them, by KeyboardInterrupt after an exception; after a time limit they are killed.
    """

    def __init__(self, count: int, *, threads: int):
        self.count, self._threads = count, threads
        self._processes: set[_Process] = set()

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        for process in self._processes:
            process.stop(at_once=kind is not None)
        deadline = time.monotonic() + _GRACE_S + _LEAVE_S
        for process in self._processes:
            process.end(deadline)

    def processes_for(self, jobs: int) -> int:
        """Return more than one if there are more processes than jobs."""
        return max(1, self.count // max(jobs, 1))

    def map_unordered(
        self, function: Callable[[Job], Result], jobs: Iterable[Job]
    ) -> Iterator[tuple[Job, Result | Lost]]:
        """See `Workers.map_unordered`."""
        silent, lost = partial(_silence, function), []
        for _, job, result in self.run(silent, jobs):
            if isinstance(result, Lost):
                if result.by_error:
                    raise SetupError(result.reason)
                lost.append(job)
            else:
                yield job, result
        # One at a time: a process that died due to lack of memory now has all of it.
        for job in lost:
            yield from ((job, result) for _, _, result in self.run(silent, [job]))

    def run(
        self,
        work: Callable[[Job, Send], Result],
        jobs: Iterable[Job],
        on_message: Send = lambda message: None,
        on_wait: Callable[[], None] = lambda: None,
    ) -> Iterator[tuple[int, Job, Result | Lost]]:
        """Iterate over number, job and result of each job as it is completed; its process has the next job by then."""
        waiting = enumerate(jobs)
        busy: dict[object, tuple[_Process, int, Job]] = {}
        idle = deque(self._processes)

        def hand_out() -> None:
            for number, job in islice(waiting, self.count - len(busy)):
                process = idle.popleft() if idle else _Process(self._threads)
                self._processes.add(process)
                busy[process.connection] = process, number, job
                process.give(work, job)

        hand_out()
        while busy:
            on_wait()
            for connection in wait([process.connection for process, _, _ in busy.values()], _WAIT_S):
                process, number, job = busy[connection]
                match process.message():
                    case ("message", message):
                        on_message(message)
                        continue
                    case ("raised", error):
                        raise error
                    case ("done", result):
                        idle.append(process)
                    case Lost() as result:
                        self._processes.remove(process)
                        process.end(0.0)
                    case _ as never:
                        assert_never(never)
                del busy[connection]
                hand_out()
                yield number, job, result


def _silence(function: Callable[[Job], Result], job: Job, send: Send) -> Result:
    return function(job)


class _Process:
    """A process, which starts with its first job, and the connection to it."""

    def __init__(self, threads: int):
        context = multiprocessing.get_context("spawn")
        self.connection, self._theirs = context.Pipe()
        # Not a daemon, because daemons cannot start processes; it watches its parent itself.
        self._process = context.Process(target=_serve, args=(self._theirs,))
        self._threads = threads

    def give(self, work: Callable[[Any, Send], Any], job: Any) -> None:
        """Send a job and its function."""
        if self._process.pid is None:
            with _STARTING:
                _start(self._process, self._threads)
            self._theirs.close()
        # If the process has ended, `message` reports it.
        with suppress(BrokenPipeError):
            self.connection.send((work, job))

    def message(self) -> tuple[Literal["message", "raised", "done"], Any] | Lost:
        """Receive a message of the job, its result ("done"), its error ("raised"), or the end of the process."""
        try:
            return self.connection.recv()
        except (EOFError, ConnectionResetError):
            self._process.join(_GRACE_S)
            code = self._process.exitcode
            how = f"signal {signal.Signals(-code).name}" if code is not None and code < 0 else f"exit code {code}"
            why = "perhaps due to lack of memory: run fewer workers at a time"
            if by_error := code == 1:  # Python's exit code after an exception.
                why = 'by the error printed above; a script must call this under `if __name__ == "__main__":`'
            return Lost(f"a worker process has ended unexpectedly ({how}), {why}", by_error)

    def stop(self, *, at_once: bool) -> None:
        """Ask the process to end, after its job or at once."""
        if at_once:
            self.connection.close()
        else:
            with suppress(OSError):
                self.connection.send(None)

    def end(self, deadline: float) -> None:
        """Wait until a time of the monotonic clock for the process to end, then kill it."""
        if self._process.pid is not None:
            self._process.join(max(0.0, deadline - time.monotonic()))
            self._process.kill()
            self._process.join()
        self.connection.close()


def _start(process: BaseProcess, threads: int) -> None:
    """Start a process that uses ``threads`` threads for linear algebra, unless the environment sets another number.

    With one thread per processor in every process, the threads delay each other: two joint calibrations in parallel
    took 17 to 25 s instead of 6 to 8 s on two processors. SIGINT is blocked during the start, so that only the command,
    and never the process, receives Ctrl-C.
    """
    given = {name: os.environ[name] for name in _THREADS if name in os.environ}
    # Started here, because starting Python's resource tracker later would unblock interrupts.
    resource_tracker.ensure_running()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    os.environ.update(dict.fromkeys(_THREADS, str(threads)) | given)
    try:
        process.start()
    finally:
        for name in set(_THREADS) - set(given):
            del os.environ[name]
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _serve(connection: Connection) -> None:
    """Run one job after another in a process, until there are no more or it is stopped."""
    stopped = threading.Event()

    def stop(*_: object) -> None:
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        stopped.set()
        raise KeyboardInterrupt

    def send(kind: str, content: Any) -> None:
        try:
            connection.send((kind, content))
        except BrokenPipeError:
            stop()

    jobs, frozen = SimpleQueue[bytes](), False
    try:
        signal.signal(signal.SIGTERM, stop)
        threading.Thread(target=_receive, args=(connection, jobs), daemon=True).start()
        with preserve_interrupts():
            while (given := pickle.loads(jobs.get())) is not None:
                work, job = given
                try:
                    result = work(job, partial(send, "message"))
                except (Error, OSError) as error:
                    send("raised", error)
                else:
                    send("done", result)
                    if not frozen:
                        # Modules imported by now are kept, so the garbage collector need not scan them again.
                        gc.freeze()
                        frozen = True
    finally:
        # Whatever a library has made of the interrupt, there is nothing to report.
        if stopped.is_set():
            os._exit(1)


def _receive(connection: Connection, jobs: SimpleQueue[bytes]) -> None:
    """Pass on pickled jobs, and stop the process when its parent closes the connection or ends.

    In a thread, because no handler of a signal runs while a library computes.
    """
    with suppress(EOFError, OSError):
        while True:
            jobs.put(connection.recv_bytes())
    os.kill(os.getpid(), signal.SIGTERM)
    time.sleep(_GRACE_S)
    remove_incomplete()
    os._exit(1)


class _Cluster(Workers):
    """Workers of a Dask cluster, which repeats the jobs of lost workers itself."""

    def __init__(self, executor: Any, count: int, killed: type[Exception]):
        self._executor, self.count, self._killed = executor, count, killed

    def processes_for(self, jobs: int) -> int:
        """Return 1: a worker of a cluster may not start processes."""
        return 1

    def map_unordered(
        self, function: Callable[[Job], Result], jobs: Iterable[Job]
    ) -> Iterator[tuple[Job, Result | Lost]]:
        """See `Workers.map_unordered`."""
        waiting, running = iter(jobs), dict[Future[Result], Job]()
        while True:
            for job in islice(waiting, self.count * _AHEAD - len(running)):
                running[self._executor.submit(function, job)] = job
            if not running:
                return
            done, _ = wait_for_futures(running, return_when=FIRST_COMPLETED)
            for future in done:
                job = running.pop(future)
                try:
                    result = future.result()
                except self._killed as error:
                    yield job, Lost(str(error))
                except CancelledError as error:
                    raise SetupError("the Dask cluster is gone: start it, and run the sweep again") from error
                else:
                    yield job, result


@contextmanager
def _cluster(address: str) -> Iterator[_Cluster]:
    try:
        from distributed import Client
        from distributed.scheduler import KilledWorker
    except ImportError as error:
        needed = pip_install(read_requirements()[2]["cluster"])
        raise SetupError(f"a scheduler needs the library distributed, which is not installed: {needed}") from error
    try:
        client: Any = Client(address, timeout=_PATIENCE_S, set_as_default=False)
    except (OSError, ValueError) as error:
        raise SetupError(f"no Dask scheduler answers at {address}: {error}") from error
    with client:
        count = sum(client.nthreads().values())
        if count == 0:
            raise SetupError(f"the scheduler at {address} has no workers: start some with 'dask worker {address}'")
        executor = client.get_executor(pure=False)
        try:
            yield _Cluster(executor, count, KilledWorker)
        finally:
            # Queued jobs are not started.
            executor.shutdown(wait=False)
