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
from contextlib import contextmanager, nullcontext
from functools import partial
from pathlib import Path

from uwlts.errors import OutputError
from uwlts.files.unfinished import unfinished

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
    with nullcontext() if _held[target] else _locked(target, time.monotonic() + patience_s):
        _held[target] += 1
        try:
            yield
        finally:
            _held[target] -= 1
            if not _held[target]:
                del _held[target]


def lock_path(target: Path) -> Path:
    """Path of an output's lock. Its name has no suffix of the output's, by which folders are searched."""
    name = os.fsencode(target.name.replace(".", "-"))[:_LONGEST_NAME]
    return target.with_name(f".{os.fsdecode(name)}.lock")


@contextmanager
def _locked(target: Path, until: float) -> Iterator[None]:
    """Hold the lock of a file; where nothing can be locked nothing is held, and writing will say why."""
    path, descriptors = lock_path(target), list[int]()
    with unfinished(path, partial(_unlock, path, descriptors)):
        while fcntl is not None:
            try:
                descriptors.append(os.open(path, os.O_CREAT | os.O_RDWR, 0o666))
            except OSError:
                break
            descriptor = descriptors[-1]
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                holder = os.pread(descriptor, 200, 0).decode(errors="replace") or "another process"
                if time.monotonic() >= until:
                    raise OutputError(
                        f"cannot write {target}: {holder} is writing it; wait until it ends, or give another name"
                    ) from None
                os.close(descriptors.pop())
                time.sleep(_AGAIN_S)
                continue
            except OSError:
                break
            if _is_at(descriptor, path):
                os.ftruncate(descriptor, 0)
                os.pwrite(descriptor, f"process {os.getpid()} on {socket.gethostname()}".encode(), 0)
                break
            # The one before has removed it between opening and locking.
            os.close(descriptors.pop())
        yield


def _unlock(path: Path, descriptors: list[int]) -> None:
    """Remove the lock's file and close it, unless another process holds it; harmless the second time."""
    if fcntl is None:
        return
    if not descriptors:
        # Made, but the interrupt came before it was noted; without one there is no such file, or another's.
        try:
            descriptors.append(os.open(path, os.O_RDWR))
        except OSError:
            return
    try:
        fcntl.flock(descriptors[-1], fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        free = False
    except OSError:
        free = True
    else:
        free = _is_at(descriptors[-1], path)
    if free:
        # Removed before it is unlocked: whoever waits for it then sees that it is gone.
        path.unlink(missing_ok=True)
    while descriptors:
        os.close(descriptors.pop())


def _is_at(descriptor: int, path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(descriptor), os.stat(path))
    except FileNotFoundError:
        return False
