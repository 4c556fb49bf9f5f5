"""One writer per file: a second process that is to write the same is told so.

The lock is advisory (flock), on the hidden file ``.NAME.lock`` beside the output: the system ends it with the process,
however that ends. The file is removed with the lock; one that a killed process leaves is taken over by the next writer.
On systems and file systems without flock nothing is locked.
"""

import os
import socket
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from uwlts.model.errors import OutputError

try:
    import fcntl
except ImportError:
    fcntl = None

_LONGEST_NAME = 240
"""Bytes of an output's name in that of its lock; file systems take 255 in all."""
_AGAIN_S = 0.05

# Claims of this process, which may be nested: a command's and within it that of the writing itself.
_held: Counter[Path] = Counter()


@contextmanager
def one_writer(target: Path, *, patience_s: float = 0.0) -> Iterator[None]:
    """Be the only process that writes a file; OutputError where another one still does after ``patience_s``."""
    target = Path(os.path.realpath(target))
    lock = None if _held[target] else _locked(target, time.monotonic() + patience_s)
    _held[target] += 1
    try:
        yield
    finally:
        _held[target] -= 1
        if not _held[target]:
            del _held[target]
        if lock is not None:
            # Removed before it is unlocked: whoever waits for it then sees that it is gone.
            lock_path(target).unlink(missing_ok=True)
            os.close(lock)


def lock_path(target: Path) -> Path:
    """Path of an output's lock. Its name has no suffix of the output's, by which folders are searched."""
    name = os.fsencode(target.name.replace(".", "-"))[:_LONGEST_NAME]
    return target.with_name(f".{os.fsdecode(name)}.lock")


def _locked(target: Path, until: float) -> int | None:
    """Descriptor of the locked file; None where nothing can be locked, and writing will say why."""
    path = lock_path(target)
    while fcntl is not None:
        try:
            descriptor = os.open(path, os.O_CREAT | os.O_RDWR, 0o666)
        except OSError:
            return None
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            holder = os.pread(descriptor, 200, 0).decode(errors="replace") or "another process"
            os.close(descriptor)
            if time.monotonic() >= until:
                raise OutputError(
                    f"cannot write {target}: {holder} is writing it; wait until it ends, or give another name"
                ) from None
            time.sleep(_AGAIN_S)
            continue
        except OSError:
            path.unlink(missing_ok=True)
            os.close(descriptor)
            return None
        if _is_at(descriptor, path):
            os.ftruncate(descriptor, 0)
            os.pwrite(descriptor, f"process {os.getpid()} on {socket.gethostname()}".encode(), 0)
            return descriptor
        # The one before has removed it between opening and locking.
        os.close(descriptor)
    return None


def _is_at(descriptor: int, path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(descriptor), os.stat(path))
    except FileNotFoundError:
        return False
