"""Writing of outputs: completely or not at all, without replacing files unless asked, and by one writer at a time.

An output is written under a temporary name, flushed to the disk, then renamed. Its lock is advisory (flock) on the
hidden file ``.NAME.lock`` beside it, so that it also applies to other machines that share the folder. The system
releases the lock when the process ends; the next writer takes over the file of a killed process. On systems and file
systems without flock nothing is locked.
"""

import atexit
import errno
import hashlib
import os
import secrets
import socket
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

from uwlts.errors import OutputError
from uwlts.files.inputs import hold_until_end, record_made, refuse_input
from uwlts.files.reading import open_regular, shorten

try:
    import fcntl
except ImportError:
    fcntl = None

_PATIENCE_S = 10.0
"""Longest wait at the end of the work for a file that another process writes. Results are written faster, and several
machines may write those of one sweep."""
_AGAIN_S = 0.05  # until a lock is tried again


class OtherWriterError(OutputError):
    """Another process is writing the same output."""


@contextmanager
def write_atomically(path: str | os.PathLike[str], *, overwrite: bool = False) -> Iterator[Path]:
    """Give the body a temporary file to write; move it to `path` when the body ends without an exception.

    The temporary file is in the folder of `path`, because a rename is atomic only within a file system. It has the same
    suffix, because some libraries choose the format from it. It is removed if an exception leaves the body, and an
    existing file at `path` is untouched until the new one is complete. Without ``overwrite`` an existing file is
    refused, before the body runs and again at the end. A symbolic link is followed.

    Raises
    ------
    OutputError
        The folder is missing or not writable, `path` is a folder or a device, or the disk is full: for any OSError. The
        file exists, is an input of the running command, or is being written by another process.
    """
    require_possible_name(Path(path))
    target = Path(os.path.realpath(path))
    _require_suitable(target, overwrite=overwrite)
    aside = target.parent / f".{secrets.token_hex(8)}{target.suffix}"
    with (
        lock_output(target, patience_s=_PATIENCE_S),
        _remove_when_done(aside, lambda file: file.unlink(missing_ok=True)),
    ):
        try:
            # Not tempfile, whose files are private (mode 0600): the finished file would be, too.
            os.close(os.open(aside, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666))
            yield aside
            _flush(aside, os.O_RDWR)
            _require_suitable(target, overwrite=overwrite)
            os.replace(aside, target)
            record_made(target)
            # Only POSIX systems can open a folder, to flush the renaming itself.
            if os.name == "posix":
                _flush(target.parent, os.O_RDONLY)
        except OSError as error:
            raise OutputError(_cannot_write(target, error)) from error


def refuse_unsuitable(target: Path, *, overwrite: bool, endings: Sequence[str] = ()) -> None:
    """Raise OutputError if an output cannot be written; commands check this before the work, too.

    With ``endings``, the name must end with one of them. Other processes are refused the same output until the running
    command ends.
    """
    _require_suitable(target, overwrite=overwrite)
    require_ending(target, endings)
    hold_until_end(lock_output(target))


def require_ending(target: Path, endings: Sequence[str]) -> None:
    """Raise OutputError if a name lacks the required ending."""
    if endings and not target.name.lower().endswith(tuple(endings)):
        raise OutputError(
            f"{target} ends with none of {', '.join(endings)}, which name the format of this file; give a name like "
            f"{target.stem}{endings[0]}"
        )


def _require_suitable(target: Path, *, overwrite: bool) -> None:
    require_possible_name(target)
    if not target.parent.is_dir():
        raise OutputError(f"cannot write {target}: the folder {target.parent} does not exist; create it first")
    if target.exists() and not target.is_file():
        raise OutputError(f"cannot write {target}: it exists and is not a regular file; choose another name")
    refuse_input(target)
    if target.exists() and not overwrite:
        raise OutputError(f"{target} exists already; give another name, or `overwrite` to replace it")


def require_possible_name(target: Path) -> None:
    """Raise OutputError if no file can have this name: it is too long, or contains a null character."""
    try:
        os.stat(target)
    except (FileNotFoundError, NotADirectoryError):
        pass
    except OSError as error:
        raise OutputError(_cannot_write(target, error)) from error
    except ValueError as error:
        raise OutputError(f"cannot write {str(target)!r}: no file can have this name") from error


def _cannot_write(target: Path, error: OSError) -> str:
    advice = {
        errno.ENOSPC: "the disk is full; free some space",
        errno.EDQUOT: "the disk quota is used up; free some space",
        errno.EACCES: f"no permission to write in {target.parent}",
        errno.EPERM: f"no permission to write in {target.parent}",
        errno.EROFS: f"{target.parent} is on a read-only file system",
    }
    return f"cannot write {shorten(str(target))}: {advice.get(error.errno or 0, error.strerror or str(error))}"


def _flush(path: Path, flags: int) -> None:
    descriptor = os.open(path, flags)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def hash_file(path: str | Path) -> str:
    """Return the hash of a file in hexadecimal; raises CaptureError if it cannot be read."""
    with open_regular(path) as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


_locks: dict[Path, int] = {}
"""Descriptors of the locks that this process has, or is acquiring."""


@contextmanager
def lock_output(target: Path, *, patience_s: float = 0.0) -> Iterator[None]:
    """Lock a file for writing; raises OtherWriterError if another process still writes it after ``patience_s``."""
    target = Path(os.path.realpath(target))
    path = _lock_of(target)
    if fcntl is None or path in _locks:
        yield
        return
    until = time.monotonic() + patience_s
    with _remove_when_done(path, _unlock):
        while not _lock(path):
            # The previous writer may just have ended.
            if time.monotonic() >= until and path.exists():
                raise OtherWriterError(
                    f"cannot write {target}: {_holder(path)} is writing it; wait until it ends, or give another name"
                )
            time.sleep(_AGAIN_S)
        yield


def refuse_other_writer(target: Path) -> None:
    """Raise OtherWriterError if another process is writing a file; the lock file of a killed process is removed."""
    if _lock_of(Path(os.path.realpath(target))).exists():
        with lock_output(target):
            pass


def _lock_of(target: Path) -> Path:
    # Without the output's suffix, so that searches in the folder do not find it.
    return target.with_name(f".{target.name.replace('.', '-')}.lock")


def _lock(path: Path) -> bool:
    """Try to acquire a lock; return True also if nothing can be locked, because writing then reports the reason."""
    try:
        descriptor = _locks[path] = os.open(path, os.O_CREAT | os.O_RDWR, 0o666)
    except OSError:
        return True
    if _is_locked(descriptor, path):
        # On a full disk the lock file is empty, which suffices.
        with suppress(OSError):
            os.ftruncate(descriptor, 0)
            os.pwrite(descriptor, f"process {os.getpid()} on {socket.gethostname()}".encode(), 0)
        return True
    del _locks[path]
    os.close(descriptor)
    return False


def _holder(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8", errors="replace") or "another process"
    except OSError:
        return "another process"


def _unlock(path: Path) -> None:
    """Release a lock and remove its file, unless another process has it; may be called twice."""
    try:
        # An interrupt may have prevented its registration.
        descriptor = _locks[path] if path in _locks else os.open(path, os.O_RDWR)
    except OSError:
        return
    if _is_locked(descriptor, path):
        # Removed before the lock is released, so that waiting processes notice.
        path.unlink(missing_ok=True)
    _locks.pop(path, None)
    os.close(descriptor)


def _is_locked(descriptor: int, path: Path) -> bool:
    """Lock a file; return False if another process has the lock, or has just removed the file."""
    assert fcntl is not None
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        return os.path.samestat(os.fstat(descriptor), os.stat(path))
    except (BlockingIOError, FileNotFoundError):
        return False
    except OSError:
        return True


_removals: dict[Path, Callable[[Path], None]] = {}


@contextmanager
def _remove_when_done(path: Path, remove: Callable[[Path], None]) -> Iterator[None]:
    """Remove a file when the body that makes it ends; `remove_unfinished` does so if an interrupt prevents it."""
    _removals[path] = remove
    try:
        yield
    finally:
        remove(path)
        _removals.pop(path, None)


@atexit.register
def remove_unfinished() -> None:
    """Remove locks and incomplete outputs at the end of a process, even if it is inside a library."""
    for path, remove in list(_removals.items()):
        with suppress(OSError):
            remove(path)
    _removals.clear()
