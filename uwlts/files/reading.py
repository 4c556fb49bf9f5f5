"""Reading of foreign files: regular files of limited size, and text formats of limited depth with plain numbers.

Every reader opens its file here, so that no pipe blocks it, and no size, depth or number in a file exhausts the
machine. Limits are checked before parsing; the reader checks the meaning of the content afterwards.
"""

import json
import logging
import math
import os
import re
import stat
import tomllib
from collections import Counter
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from io import BufferedReader
from pathlib import Path
from tokenize import TokenError
from typing import TYPE_CHECKING, Any, TypeVar
from zipfile import BadZipFile

from uwlts.errors import CaptureError, DescriptionError, Error, make_printable

if TYPE_CHECKING:
    from pydantic import JsonValue

Content = TypeVar("Content")
_LOG = logging.getLogger("uwlts")

MiB = 2**20
MOST_TOML_BYTES = MiB
"""The parser takes about a second for it; the longest descriptions, with lists of positions, have a tenth of it."""
MOST_JSON_BYTES = 32 * MiB  # several times the largest calibration
MOST_VALUES = 500_000
"""Values in a JSON file, enough for a covariance of 700 parameters. As Python objects they take less than 100 MB."""
MOST_DEPTH = 64  # nesting of tables and lists; the program's own files have fewer than ten levels
_LARGEST_INT = 2**63  # 64 bits, what NumPy and HDF5 hold
_LONGEST_KEY = 32  # parts of a dotted key; the parser takes time by the square of their number

_WORD = r"(?<![\w-])[\w-]++"
_QUOTED = r"""(?<!\\)"(?:[^"\\\n]|\\.)*+"|'[^'\n]*+'"""
_LONG_KEY = re.compile(rf"(?:(?:{_WORD}|{_QUOTED})[ \t]*+\.[ \t]*+){{{_LONGEST_KEY}}}")

_FOREIGN = {b"\x89HDF": "an HDF5 file, such as a capture or a cloud", b"ply": "a PLY file", b"\x89PNG": "a PNG image"}
_FOREIGN |= {b"\xff\xd8\xff": "a JPEG image", b"PK\x03\x04": "a ZIP archive", b"\x1f\x8b": "a gzip file"}
_FOREIGN |= {b"%PDF": "a PDF document"}


def is_regular_file(path: str | Path) -> bool:
    """Return whether there is a regular file; False also for names that no file can have."""
    try:
        return stat.S_ISREG(os.stat(path).st_mode)
    except (OSError, ValueError):
        return False


def require_regular_file(
    path: str | Path, *, most_bytes: int | None = None, error: type[Error] = CaptureError, called: str = "file"
) -> int:
    """Return the size in bytes of a regular file that can be opened; raises ``error`` like `open_regular`."""
    with open_regular(path, most_bytes=most_bytes, error=error, called=called) as file:
        return os.fstat(file.fileno()).st_size


@contextmanager
def open_regular(
    path: str | Path, *, most_bytes: int | None = None, error: type[Error] = CaptureError, called: str = "file"
) -> Iterator[BufferedReader]:
    """Return a context with a regular file opened for reading bytes.

    Raises ``error`` if the file is missing, unreadable, not regular (a pipe or device would block) or larger than
    ``most_bytes``, or its name is too long or contains a null character. ``called`` names the expected content.
    """
    cannot = f"cannot read the {called} {shorten(str(path))}"
    try:
        found = os.stat(path)
    except FileNotFoundError as problem:
        raise error(f"no {called} at {shorten(str(path))}") from problem
    except OSError as problem:
        raise error(f"{cannot}: {problem.strerror}") from problem
    except ValueError as problem:
        raise error(f"{cannot}: no file can have this name") from problem
    if not stat.S_ISREG(found.st_mode):
        what = "a directory" if stat.S_ISDIR(found.st_mode) else "a pipe or device"
        raise error(f"{cannot}: it is {what}, expected a regular file")
    if most_bytes is not None and found.st_size > most_bytes:
        sizes = f"{found.st_size / MiB:,.1f} MiB; this program reads up to {most_bytes / MiB:,.1f} MiB"
        raise error(f"the {called} {shorten(str(path))} has {sizes}")
    try:
        with open(path, "rb") as file:
            yield file
    except OSError as problem:
        raise error(f"{cannot}: {problem.strerror or problem}") from problem


def shorten(text: str, most: int = 300) -> str:
    """Shorten a text for a message."""
    return text if len(text) <= most else f"{text[: most // 2]} ... {text[-most // 4 :]}"


def natural_key(name: str) -> list[str | int]:
    """Return a sort key that orders image9 before image10."""
    return [int(part) if part.isascii() and part.isdigit() else part.casefold() for part in re.split(r"([0-9]+)", name)]


def log_warnings(path: str | os.PathLike[str], warnings: Iterable[str]) -> None:
    """Log warnings about the content of a file; without further settings, Python prints them on standard error."""
    for warning in warnings:
        _LOG.warning("%s", make_printable(f"warning: {path}: {warning}"))


NPY_DAMAGE = (ValueError, EOFError, OSError, SyntaxError, TokenError, MemoryError, OverflowError, BadZipFile)
"""Exceptions of NumPy for a damaged NPY file, depending on the kind of damage."""


def read_bytes(path: str | Path, *, most_bytes: int, error: type[Error] = CaptureError, called: str = "file") -> bytes:
    """Read a regular file; raises ``error`` like `open_regular`."""
    with open_regular(path, most_bytes=most_bytes, error=error, called=called) as file:
        # Python allocates what is asked for, and some system files report a size of 0.
        content = file.read(min(most_bytes, os.fstat(file.fileno()).st_size) + 1)
        while len(content) <= most_bytes and (more := file.read(MiB)):
            content += more
    if len(content) > most_bytes:
        raise error(f"the {called} {shorten(str(path))} has more than {most_bytes / MiB:,.1f} MiB")
    return content


def read_text(
    path: str | Path,
    *,
    most_bytes: int,
    error: type[Error] = CaptureError,
    called: str = "file",
    foreign: str | None = None,
) -> str:
    """Read a regular file of text in UTF-8, without byte order mark.

    Raises ``error`` like `open_regular`, or if the content is not text.

    ``called`` names the expected content in messages. ``foreign`` begins the message for other content; by default it
    is "is not a" and ``called``.
    """
    content = read_bytes(path, most_bytes=most_bytes, error=error, called=called)
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as problem:
        kind = next((kind for mark, kind in _FOREIGN.items() if content.startswith(mark)), "no text in UTF-8")
        raise error(f"{shorten(str(path))} {foreign or f'is not {add_article(called)}'}: it is {kind}") from problem


def add_article(called: str) -> str:
    """Return a name with its indefinite article."""
    return f"{'an' if called[0] in 'aeiou' else 'a'} {called}"


def parse_json(text: str) -> "JsonValue":
    """Parse JSON; raises ValueError if it is not valid, too large, or not plain (`require_plain`).

    Duplicate keys are refused as well, because readers differ in their choice.
    """
    if text.count(",") + text.count("[") + text.count("{") > MOST_VALUES:
        raise ValueError(f"it holds more than {MOST_VALUES:,} values")
    try:
        content = json.loads(text, object_pairs_hook=_require_unique)
    except RecursionError as error:
        raise json.JSONDecodeError(_TOO_DEEP, text, 0) from error
    return require_plain(content)


def read_toml(path: str | Path, *, called: str, error: type[Error] = CaptureError) -> "dict[str, JsonValue]":
    """Read a TOML file; raises ``error`` if it cannot be read, and DescriptionError if it is not valid TOML."""
    text = read_text(path, most_bytes=MOST_TOML_BYTES, error=error, called=called, foreign="is not valid TOML")
    try:
        return parse_toml(text)
    except ValueError as problem:
        raise DescriptionError(f"{path} is not valid TOML: {problem}") from problem


def parse_toml(text: str) -> "dict[str, JsonValue]":
    """Parse TOML; raises ValueError if it is not valid, has a key of too many parts, or is not plain (`require_plain`).

    Numbers that are not finite are left to the descriptions, which report all wrong keys at once.
    """
    if _LONG_KEY.search(text):
        raise ValueError(f"a key has more than {_LONGEST_KEY} parts")
    try:
        content = tomllib.loads(text)
    except RecursionError as error:
        raise ValueError(_TOO_DEEP) from error
    return require_plain(content, finite=False)


_TOO_DEEP = f"its tables and lists are nested more than {MOST_DEPTH} deep"


def require_plain(content: Content, *, finite: bool = True) -> Content:
    """Return the content; raises ValueError if it is nested too deep, or a number is not finite or exceeds 64 bits."""
    level: list[Any] = [content]
    depth = 0
    while level:
        if depth > MOST_DEPTH:
            raise ValueError(_TOO_DEEP)
        below: list[Any] = []
        for each in level:
            # Exact types, for speed with a million values; parsers return no others.
            kind = type(each)
            if kind is dict:
                below.extend(each.values())
            elif kind is list or kind is tuple:
                below.extend(each)
            elif kind is float:
                if finite and not math.isfinite(each):
                    raise ValueError(f"{find_not_finite(content)}; expected a finite number")
            elif kind is int and not -_LARGEST_INT <= each < _LARGEST_INT:
                raise ValueError("it holds a whole number of more than 64 bits")
        level, depth = below, depth + 1
    return content


def find_not_finite(content: object) -> str:
    """Return the path of keys and indices to a number that is not finite, with the number; empty without any."""
    waiting: list[tuple[object, str]] = [(content, "")]
    while waiting:
        each, place = waiting.pop()
        if isinstance(each, float) and not math.isfinite(each):
            return f"{shorten(place.removeprefix('.')) or 'it'} is {each}"
        inside = each.items() if isinstance(each, dict) else enumerate(each) if isinstance(each, list | tuple) else ()
        waiting.extend((below, f"{place}.{key}") for key, below in inside)
    return ""


def _require_unique(pairs: "list[tuple[str, JsonValue]]") -> "dict[str, JsonValue]":
    table = dict(pairs)
    if len(table) < len(pairs):
        counts = Counter(key for key, _ in pairs)
        twice = next(key for key, count in counts.items() if count > 1)
        raise ValueError(f"the key {shorten(twice)!r} occurs twice in a table")
    return table
