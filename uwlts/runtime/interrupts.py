"""Delivery of Ctrl-C that cannot get lost, for commands and their worker processes; imports only fast modules."""

import _thread
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

_AGAIN_S = 0.01
"""Delay; callbacks of weak references take microseconds."""


@contextmanager
def preserve_interrupts() -> Iterator[None]:
    """Deliver an interrupt that Python or a library has converted to something else.

    Python reports and drops an interrupt in the callback of a weak reference. An interrupt in a loop that Dr.Jit
    records becomes the cause of a RuntimeError.
    """
    plain = sys.unraisablehook

    def report(dropped: Any) -> None:
        if isinstance(dropped.exc_value, KeyboardInterrupt):
            # Not here, where it would be dropped, too.
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
