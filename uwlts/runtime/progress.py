"""Reports of progress by long calculations, and delivery of Ctrl-C that cannot get lost; imports only fast modules."""

import _thread
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Protocol


class ProgressListener(Protocol):
    """Function that receives the progress of a calculation, to draw a bar or to write a line."""

    def __call__(self, done: int, total: int, stage: str = "") -> None:
        """Receive the number of finished parts, the total, and the name of the stage if there are several."""
        ...


def ignore_progress(done: int, total: int, stage: str = "") -> None:
    """Ignore the progress."""


_AGAIN_S = 0.01  # delay; callbacks of weak references take microseconds


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
