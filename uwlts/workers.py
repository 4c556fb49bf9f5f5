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
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from typing import Any, TypeVar

from uwlts.errors import SetupError, UwltsError

Job = TypeVar("Job")
Result = TypeVar("Result")
Tell = Callable[[Any], None]

_GRACE_S = 5.0
"""How long a process may take to leave its files in order before it is killed."""
_TOLD, _DONE, _FAILED = range(3)


def work_through(
    work: Callable[[Job, Tell], Result],
    jobs: Sequence[Job],
    *,
    workers: int | None = None,
    heard: Tell = lambda message: None,
) -> list[Result]:
    """Results of ``work(job, tell)`` for all jobs, in their order; each runs in one of several processes.

    Jobs are begun in their order. What they ``tell`` on the way is passed to ``heard`` in this process. Whatever
    exception leaves this function, no process is left behind; a job that is under way is stopped by KeyboardInterrupt.
    ``workers`` is the number of processes, that of the processors unless given.

    Raises
    ------
    UwltsError, OSError
        As the first job that fails raises it; all others are stopped.
    SetupError
        A process has ended before its job.
    """
    workers = min(len(jobs), workers or len(os.sched_getaffinity(0)))
    waiting = deque(enumerate(jobs))
    results: dict[int, Result] = {}
    begun: list[_Worker] = []
    try:
        for _ in range(workers):
            begun.append(_begun(work))
            begun[-1].connection.send(waiting.popleft())
        busy = {worker.connection: worker for worker in begun}
        while busy:
            for connection in wait(list(busy)):
                number, kind, content = busy[connection].message()
                if kind == _FAILED:
                    raise content
                if kind == _TOLD:
                    heard(content)
                    continue
                results[number] = content
                connection.send(waiting.popleft() if waiting else None)
                if not waiting and len(results) + len(busy) > len(jobs):
                    del busy[connection]
    finally:
        _end(begun, at_once=len(results) < len(jobs))
    return [results[number] for number in range(len(jobs))]
