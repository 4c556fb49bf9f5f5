"""Waiting for results of other threads and processes."""

import os
import signal
import time
from collections.abc import Callable
from pathlib import Path


def within(seconds: float, condition: Callable[[], bool]) -> bool:
    """Return True if a condition becomes true within ``seconds``; test it every 0.01 s, at least twice."""
    deadline = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > deadline:
            return False
        time.sleep(0.01)
    return True


def suspend(pid: int) -> None:
    """Suspend a process and wait until all its threads are: on a busy machine one may run for some ms."""
    os.kill(pid, signal.SIGSTOP)

    def states() -> set[str]:
        # The state follows the name, which is in parentheses.
        lines = (path.read_text() for path in Path(f"/proc/{pid}/task").glob("*/stat"))
        return {line.rpartition(")")[2].split()[0] for line in lines}

    assert within(20.0, lambda: states() == {"T"}), states()
