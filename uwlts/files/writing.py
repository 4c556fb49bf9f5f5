"""Files that appear whole or not at all: outputs are written beside their place, flushed to the disk, then renamed."""

import errno
import hashlib
import os
import secrets
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path

from uwlts.errors import OutputError
from uwlts.files.command_files import hold_until_end, note_made, refuse_input
from uwlts.files.one_writer import one_writer
from uwlts.files.reading import opened, shortened
from uwlts.files.unfinished import unfinished

_PATIENCE_S = 10.0
"""How long a file that another process writes is waited for at the end of the work; results are written in less, and
several machines may write those of one sweep."""


@contextmanager
def written_aside(path: str | os.PathLike[str], *, overwrite: bool = False) -> Iterator[Path]:
    """Give the body a temporary file to write; move it to `path` when the body ends without an exception.

    The temporary file lies empty in the folder of `path` (a rename is atomic only within one file system) and keeps
    the suffix, by which some libraries choose the format. It is removed whatever exception leaves the body, and an
    existing file at `path` is untouched until the new one is complete. Without ``overwrite`` an existing file is
    refused, before the body runs and again at the end. A symbolic link is followed. OutputError where the folder is
    missing or not writable, the file exists, is an input of the running command or is being written by another process,
    `path` is a folder or a device, or the disk is full: for any OSError.
    """
    require_possible_name(Path(path))
    target = Path(os.path.realpath(path))
    _require_suitable(target, overwrite=overwrite)
    with one_writer(target, patience_s=_PATIENCE_S):
        yield from _aside(target, overwrite=overwrite)


def _aside(target: Path, *, overwrite: bool) -> Iterator[Path]:
    aside = target.parent / f".{secrets.token_hex(8)}{target.suffix}"
    with unfinished(aside, partial(aside.unlink, missing_ok=True)):
        try:
            # Not tempfile: its files are private (mode 0600), and the finished one would stay so.
            os.close(os.open(aside, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666))
        except OSError as error:
            raise OutputError(_cannot_write(target, error)) from error
        try:
            yield aside
            _flush(aside, os.O_RDWR)
            _require_suitable(target, overwrite=overwrite)
            os.replace(aside, target)
            note_made(target)
            # Only POSIX systems can open a folder, to make the renaming itself last.
            if os.name == "posix":
                _flush(target.parent, os.O_RDONLY)
        except OSError as error:
            raise OutputError(_cannot_write(target, error)) from error


def refuse_unsuitable(target: Path, *, overwrite: bool, endings: Sequence[str] = ()) -> None:
    """Raise OutputError where nothing may be written; commands ask before the work and not only after it.

    With ``endings``, the name has to end with one of them. From here until the running command ends, other processes
    are refused the same output.
    """
    _require_suitable(target, overwrite=overwrite)
    require_ending(target, endings)
    hold_until_end(Path(os.path.realpath(target)), one_writer)


def require_ending(target: Path, endings: Sequence[str]) -> None:
    """Raise OutputError where a name ends with none of the endings of formats, if there are any."""
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
    """OutputError where no file can have this name: it is too long, or holds a null character."""
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
    return f"cannot write {shortened(str(target))}: {advice.get(error.errno or 0, error.strerror or str(error))}"


def _flush(path: Path, flags: int) -> None:
    descriptor = os.open(path, flags)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def sha256_of(path: str | Path) -> str:
    """Hash of a file in hexadecimal; CaptureError where it cannot be read."""
    with opened(path) as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
