"""Protection of inputs: no output of a command or function replaces one of its inputs, under whatever name.

Within `protect_inputs` every file opened for reading (`uwlts.files.reading`) is recorded. So is every file to be
written, before the work and again before it is moved to its place (`uwlts.files.writing`). A file that is recorded as
both is refused. Files are identified by device and inode, which all their names share.
"""

import os
import stat
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
from pathlib import Path

from uwlts.errors import OutputError

OUTPUTS = frozenset({"out", "coloured", "pictures", "aligned", "page", "poses_out"})
"""Names of command parameters that are outputs; all other parameters that name a file are inputs."""

_Identity = tuple[int, int]


@dataclass
class _Work:
    """Existing files that a task reads, will replace, and has made itself; claims on outputs until its end."""

    read: dict[_Identity, Path] = field(default_factory=dict)
    written: dict[_Identity, Path] = field(default_factory=dict)
    made: set[_Identity] = field(default_factory=set)
    claims: ExitStack = field(default_factory=ExitStack)


_work: ContextVar[_Work | None] = ContextVar("work", default=None)


@contextmanager
def protect_inputs() -> Iterator[None]:
    """Protect the inputs of a task, as a context or as a decorator; functions that it calls belong to it.

    It applies to this thread. Other threads, such as those of a page, have tasks of their own.
    """
    if _work.get() is not None:
        yield
        return
    work = _Work()
    token = _work.set(work)
    try:
        with work.claims:
            yield
    finally:
        _work.reset(token)


def refuse_named_inputs(arguments: Mapping[str, object]) -> None:
    """Raise OutputError if the same file is an input and an output among a command's arguments."""
    for name, value in arguments.items():
        if name not in OUTPUTS:
            for path in _paths(value):
                record_input(path)
    for name in OUTPUTS.intersection(arguments):
        for path in _paths(arguments[name]):
            refuse_input(path)


def record_input(path: str | os.PathLike[str]) -> None:
    """Record a file that the task reads; raises OutputError if the task will write it and has not made it itself."""
    if (work := _work.get()) and (identity := _identity(path)) and identity not in work.made:
        # A replaced file may have left its inode to another one.
        if (output := work.written.get(identity)) and _identity(output) == identity:
            raise _same(output, Path(path))
        work.read.setdefault(identity, Path(path))


def refuse_input(target: str | os.PathLike[str]) -> None:
    """Record a file to be written; raises OutputError if the task has read it."""
    if (work := _work.get()) and (identity := _identity(target)):
        if read := work.read.get(identity):
            raise _same(Path(target), read)
        work.written[identity] = Path(target)


def record_made(path: str | os.PathLike[str]) -> None:
    """Record a file that the task has made: it may read it, and write it again."""
    if (work := _work.get()) and (identity := _identity(path)):
        work.made.add(identity)
        # The file that was read there is gone, and has left its inode to this one.
        work.read.pop(identity, None)


def hold_until_end(claim: AbstractContextManager[None]) -> None:
    """Enter a claim on an output until the task ends; without a task nothing is claimed."""
    if work := _work.get():
        work.claims.enter_context(claim)


def _same(output: Path, read: Path) -> OutputError:
    also = "" if os.path.abspath(output) == os.path.abspath(read) else f" (it is the same file as {read})"
    return OutputError(f"cannot write {output}: it is an input of this command{also}; give another name")


def _paths(value: object) -> Iterable[Path]:
    """Iterate over paths that an argument may name, also after a prefix, as in replay:PATH."""
    if isinstance(value, str | os.PathLike):
        yield Path(value)
        yield Path(os.fspath(value).partition(":")[2])
    elif isinstance(value, Sequence) and not isinstance(value, bytes):
        for each in value:
            yield from _paths(each)


def _identity(path: str | os.PathLike[str]) -> _Identity | None:
    """Return device and inode of a regular file; None for anything else, and for names that cannot be files."""
    try:
        found = os.stat(path)
    except (OSError, ValueError):
        return None
    return (found.st_dev, found.st_ino) if stat.S_ISREG(found.st_mode) else None
