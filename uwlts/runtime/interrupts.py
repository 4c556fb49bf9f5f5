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
    """Deliver an interrupt again that fell into the callback of a weak reference, where Python reports and drops it."""
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
    finally:
        sys.unraisablehook = plain
