"""Ctrl-C that is never lost, for the commands and the processes they start; imports nothing that takes time."""

import _thread
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

_AGAIN_S = 0.01
"""Callbacks of weak references take microseconds."""


@contextmanager
def interrupts_kept() -> Iterator[None]:
    """Deliver an interrupt that Python or a library has changed into something else.

    One that falls into the callback of a weak reference is reported and dropped by Python; one that falls into a loop
    that Dr.Jit records is the cause of a RuntimeError.
    """
    plain = sys.unraisablehook

    def report(dropped: Any) -> None:
        if isinstance(dropped.exc_value, KeyboardInterrupt):
            # Not from here, where it would be dropped too.
            threading.Timer(_AGAIN_S, _thread.interrupt_main).start()
        else:
            plain(dropped)

    sys.unraisablehook = report
    try:
        yield
    except Exception as error:
        cause = error.__cause__
        while cause is not None and not isinstance(cause, KeyboardInterrupt):
            cause = cause.__cause__
        if cause is None:
            raise
        raise KeyboardInterrupt from error
    finally:
        sys.unraisablehook = plain
