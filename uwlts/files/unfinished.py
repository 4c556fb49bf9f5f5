"""Files that exist only while this process works: locks, and outputs that are not complete.

Whoever makes one removes it when its work ends. Where an interrupt falls between two steps of that, or the process
must end while it computes in a library that no interrupt reaches, `remove_unfinished` does it: at the interpreter's
end, and when a working process is stopped (`uwlts.runtime.workers`). Only a kill leaves such files behind.
"""

import atexit
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

_removals: dict[Path, Callable[[], None]] = {}
# A process that is forked has the same table, and none of the files.
_process = os.getpid()


@contextmanager
def unfinished(path: Path, remove: Callable[[], None]) -> Iterator[None]:
    """Call ``remove`` when the body ends, or for it when the process does; it may be called twice.

    The body makes the file: an interrupt before it does leaves nothing to remove.
    """
    _removals[path] = remove
    try:
        yield
    finally:
        remove()
        _removals.pop(path, None)


@atexit.register
def remove_unfinished() -> None:
    """Remove all such files of this process; called once, at its end."""
    if os.getpid() != _process:
        return
    for remove in list(_removals.values()):
        with suppress(OSError):
            remove()
    _removals.clear()
