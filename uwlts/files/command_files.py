"""Files of the running command: an output never replaces an input.

A scope holds the files that the command reads and those that it is to write. Arguments are distinguished by name: those
in `OUTPUTS` are written, all others that name a file are read, so that a new command is covered without doing anything.
What arguments lead to is added when it is opened (`uwlts.files.reading`): images in a folder, a description's base.
All writing goes through `refuse_input`. The first of both that sees a file on both sides refuses it, which is before
the work in most cases.
"""

import inspect
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
from functools import wraps
from pathlib import Path
from typing import ParamSpec, TypeVar

from uwlts.errors import OutputError

OUTPUTS = frozenset({"out", "coloured", "pictures", "aligned", "page", "poses_out"})
"""Names of the parameters of commands and functions that say where to write."""

_Identity = tuple[int, int]
_Parameters = ParamSpec("_Parameters")
_Result = TypeVar("_Result")


@dataclass
class _CommandFiles:
    """Existing files by device and inode, which links share; ``made`` are those that the command wrote itself."""

    read: dict[_Identity, Path] = field(default_factory=dict)
    written: dict[_Identity, Path] = field(default_factory=dict)
    made: set[_Identity] = field(default_factory=set)
    claims: dict[Path, AbstractContextManager[None]] = field(default_factory=dict)
    held: ExitStack = field(default_factory=ExitStack)


# Not a context variable: threads that a command starts read for it.
_scopes: list[_CommandFiles] = []
_own: ContextVar[_CommandFiles | None] = ContextVar("own_files", default=None)


def _current() -> _CommandFiles | None:
    return _own.get() or (_scopes[-1] if _scopes else None)


@contextmanager
def own_files() -> Iterator[None]:
    """Scope apart from the running command's, for one piece of work of a program that goes on.

    It holds in this thread and in the tasks that are begun in it.
    """
    scope = _CommandFiles()
    token = _own.set(scope)
    try:
        with scope.held:
            yield
    finally:
        _own.reset(token)


@contextmanager
def command_files(arguments: Mapping[str, object]) -> Iterator[None]:
    """Scope of a command, or of a function that reads and writes, with its arguments by name; scopes may be nested.

    OutputError where an output is the same file as an input, under whatever name.
    """
    outer = _current()
    scope = outer or _CommandFiles()
    with ExitStack() as stack:
        if outer is None:
            _scopes.append(scope)
            stack.callback(_scopes.remove, scope)
            stack.push(scope.held)
        named = [(name in OUTPUTS, path) for name, value in arguments.items() for path in _paths(value)]
        for written, path in named:
            if not written:
                note_input(path)
        for written, path in named:
            if written:
                refuse_input(path)
        yield


def keeps_inputs(function: Callable[_Parameters, _Result]) -> Callable[_Parameters, _Result]:
    """Run a function that reads and writes files within a scope of its own arguments."""
    signature = inspect.signature(function)

    @wraps(function)
    def run(*args: _Parameters.args, **kwargs: _Parameters.kwargs) -> _Result:
        with command_files(signature.bind(*args, **kwargs).arguments):
            return function(*args, **kwargs)

    return run


def note_input(path: str | os.PathLike[str]) -> None:
    """Note a file that is about to be read; OutputError where the running command is to write it."""
    if (scope := _current()) is None or (identity := _identity(path)) is None:
        return
    if identity in scope.made:
        return
    # A file that was replaced has left its inode to others, here and below.
    if (output := scope.written.get(identity)) is not None and _identity(output) == identity:
        raise _same(output, Path(path))
    scope.read.setdefault(identity, Path(path))


def refuse_input(target: str | os.PathLike[str]) -> None:
    """Note a file that is to be written; OutputError where the running command reads it."""
    if (scope := _current()) is None or (identity := _identity(target)) is None:
        return
    target = Path(target)
    if (read := scope.read.get(identity)) is not None and _identity(read) == identity:
        raise _same(target, read)
    if identity not in scope.made:
        scope.written.setdefault(identity, target)


def note_made(path: str | os.PathLike[str]) -> None:
    """Note a file that the running command has written: it may read it, and write it again."""
    if (scope := _current()) is not None and (identity := _identity(path)) is not None:
        scope.made.add(identity)


def hold_until_end(target: Path, claim: Callable[[Path], AbstractContextManager[None]]) -> None:
    """Enter the claim on a file, once, until the running command ends; without a command nothing is claimed."""
    if (scope := _current()) is not None and target not in scope.claims:
        scope.claims[target] = claim(target)
        scope.held.enter_context(scope.claims[target])


def _same(output: Path, read: Path) -> OutputError:
    also = "" if os.path.abspath(output) == os.path.abspath(read) else f" (it is the same file as {read})"
    return OutputError(f"cannot write {output}: it is an input of this command{also}; give another name")


def _paths(value: object) -> Iterable[Path]:
    """Paths that an argument may name, also behind a prefix, as in replay:PATH."""
    if isinstance(value, os.PathLike):
        yield Path(value)
    elif isinstance(value, str):
        yield Path(value)
        if ":" in value:
            yield Path(value.partition(":")[2])
    elif isinstance(value, Sequence) and not isinstance(value, bytes):
        for each in value:
            yield from _paths(each)


def _identity(path: str | os.PathLike[str]) -> _Identity | None:
    """Device and inode of a regular file; None for anything else, and for names that cannot be files."""
    try:
        if not os.path.isfile(path):
            return None
        found = os.stat(path)
    except (OSError, ValueError):
        return None
    return found.st_dev, found.st_ino
