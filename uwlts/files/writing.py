"""Writing of outputs: completely or not at all, and without replacing inputs, or other files unless asked.

An output is written under a temporary name, flushed to the disk, then renamed.
"""

import errno
import hashlib
import os
import secrets
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

from uwlts.argument_types import refuse_input
from uwlts.errors import OutputError
from uwlts.files.reading import open_regular, shorten

_incomplete: set[Path] = set()


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
        file exists or is an input of the running command.
    """
    require_possible_name(Path(path))
    target = Path(os.path.realpath(path))
    refuse_unsuitable(target, overwrite=overwrite)
    aside = target.parent / f".{secrets.token_hex(8)}{target.suffix}"
    _incomplete.add(aside)
    try:
        with name_write_errors(target):
            # Not tempfile, whose files are private (mode 0600): the finished file would be, too.
            os.close(os.open(aside, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666))
            yield aside
            _flush(aside, os.O_RDWR)
            refuse_unsuitable(target, overwrite=overwrite)
            os.replace(aside, target)
            # Only POSIX systems can open a folder, to flush the renaming itself.
            if os.name == "posix":
                _flush(target.parent, os.O_RDONLY)
    finally:
        # A read-only file system refuses this too, which must not replace its first error.
        with suppress(OSError):
            aside.unlink(missing_ok=True)
        _incomplete.discard(aside)


def write_file(path: str | os.PathLike[str], content: str | bytes | memoryview, *, overwrite: bool = False) -> None:
    """Write text (UTF-8) or bytes like `write_atomically`."""
    with write_atomically(path, overwrite=overwrite) as aside:
        aside.write_bytes(content.encode() if isinstance(content, str) else content)


@contextmanager
def name_write_errors(target: Path) -> Iterator[None]:
    """Raise OutputError, which names ``target``, for any OSError of the body."""
    try:
        yield
    except OSError as error:
        raise OutputError(_describe_failure(target, error)) from error


def remove_incomplete() -> None:
    """Remove the temporary files of this process, before it ends regardless of the threads that write them."""
    for aside in tuple(_incomplete):
        aside.unlink(missing_ok=True)


def refuse_unsuitable(target: Path, *, overwrite: bool, endings: Sequence[str] = ()) -> None:
    """Raise OutputError if an output cannot be written; commands check this before the work, too.

    With ``endings``, the name must end with one of them.
    """
    require_possible_name(target)
    if not target.parent.is_dir():
        raise OutputError(f"cannot write {target}: the folder {target.parent} does not exist; create it first")
    if not os.access(target.parent, os.W_OK):
        raise OutputError(f"cannot write {target}: {target.parent.absolute()} is read-only, or permission is missing")
    if target.exists() and not target.is_file():
        raise OutputError(f"cannot write {target}: it exists and is not a regular file; choose another name")
    refuse_input(target)
    if target.exists() and not overwrite:
        raise OutputError(f"{target} exists already; give another name, or `overwrite` to replace it")
    require_ending(target, endings)


def require_ending(target: Path, endings: Sequence[str]) -> None:
    """Raise OutputError if a name lacks the required ending."""
    if endings and not target.name.lower().endswith(tuple(endings)):
        raise OutputError(
            f"{target} ends with none of {', '.join(endings)}, which name the format of this file; give a name like "
            f"{target.stem}{endings[0]}"
        )


def require_possible_name(target: Path) -> None:
    """Raise OutputError if no file can have this name: it is too long, or contains a null character."""
    try:
        os.stat(target)
    except (FileNotFoundError, NotADirectoryError):
        pass
    except OSError as error:
        raise OutputError(_describe_failure(target, error)) from error
    except ValueError as error:
        raise OutputError(f"cannot write {str(target)!r}: no file can have this name") from error


def _describe_failure(target: Path, error: OSError) -> str:
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
