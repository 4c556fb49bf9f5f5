"""Files that appear whole or not at all, and files of JSON: one object, whose "format" and "version" say what it is.

Outputs are written beside their place, flushed to the disk, then renamed.
"""

import errno
import hashlib
import json
import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TypeVar

from pydantic import BaseModel, JsonValue, ValidationError

from uwlts.model.command_files import hold_until_end, note_made, refuse_input
from uwlts.model.errors import CaptureError, Error, OutputError, problems_of
from uwlts.model.input_file import MOST_JSON_BYTES, opened, parsed_json, read_text, shortened, with_article
from uwlts.storage.one_writer import one_writer

_PATIENCE_S = 10.0
"""How long a file that another process writes is waited for at the end of the work; results are written in less, and
several machines may write those of one sweep."""
_SHOWN, _BRIEF = 3, 80
"""Entries that are named where two descriptions differ, and characters of each value."""


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
    finally:
        aside.unlink(missing_ok=True)


def refuse_unsuitable(target: Path, *, overwrite: bool) -> None:
    """Raise OutputError where nothing may be written; commands ask before the work and not only after it.

    From here until the running command ends, other processes are refused the same output.
    """
    _require_suitable(target, overwrite=overwrite)
    hold_until_end(Path(os.path.realpath(target)), one_writer)


def _require_suitable(target: Path, *, overwrite: bool) -> None:
    require_possible_name(target)
    if not target.parent.is_dir():
        raise OutputError(f"cannot write {target}: the folder {target.parent} does not exist; create it first")
    if target.exists() and not target.is_file():
        raise OutputError(f"cannot write {target}: it exists and is not a regular file; choose another name")
    refuse_input(target)
    if target.exists() and not overwrite:
        raise OutputError(f"{target} exists already; give another name, or --overwrite to replace it")


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


AnyModel = TypeVar("AnyModel", bound=BaseModel)


def read_json(path: str | Path, *, called: str) -> dict[str, JsonValue]:
    """Object in a file; CaptureError where it is missing, no JSON or truncated. ``called`` is what it should be.

    Numbers are finite and no key occurs twice (`uwlts.model.input_file`).
    """
    text = read_text(path, most_bytes=MOST_JSON_BYTES, called=called)
    try:
        content = parsed_json(text)
    except json.JSONDecodeError as error:
        raise CaptureError(f"{path} is not {with_article(called)}, or is truncated: {error}") from error
    except ValueError as error:
        raise CaptureError(f"{path} is not a valid {called}: {error}") from error
    if not isinstance(content, dict):
        raise CaptureError(f"{path} is JSON but not {with_article(called)}: expected an object with named entries")
    return content


def read_model(
    path: str | Path, model: type[AnyModel], *, format: str, version: int, called: str, advice: str = ""
) -> AnyModel:
    """Content of a JSON file of the program; CaptureError where it is missing, foreign, newer or damaged."""
    content = read_json(path, called=called)
    return model_in(content, path, model, format=format, version=version, called=called, advice=advice)


def model_in(
    content: dict[str, JsonValue],
    path: str | Path,
    model: type[AnyModel],
    *,
    format: str,
    version: int,
    called: str,
    advice: str = "",
) -> AnyModel:
    """What `read_json` gave of a file as a model; CaptureError as from `read_model`."""
    content = dict(content)
    if content.pop("format", None) != format:
        raise CaptureError(f'{path} is JSON but not {with_article(called)}: expected "format": "{format}"')
    if (found := content.pop("version", None)) != version:
        raise CaptureError(f"{path} has version {found}; this program reads {version}")
    return validated_content(model, content, f"{path} is not a valid {called}", advice=advice)


def validated_content(model: type[AnyModel], content: object, complaint: str, *, advice: str = "") -> AnyModel:
    """The content of a file as a model; CaptureError that begins with ``complaint`` where it is not valid."""
    try:
        return model.model_validate(content)
    except ValidationError as error:
        raise CaptureError(f"{complaint}: {problems_of(error)}{advice}") from error
    except (Error, ArithmeticError) as error:
        raise CaptureError(f"{complaint}: {error}{advice}") from error


def write_model(path: str | Path, model: BaseModel, *, format: str, version: int, overwrite: bool) -> None:
    """Write a model with its format and version as indented JSON, whole or not at all; OutputError where that fails."""
    content = {"format": format, "version": version} | model.model_dump(mode="json")
    with written_aside(path, overwrite=overwrite) as aside:
        aside.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")


def differences(there: object, now: object) -> str:
    """Words for the entries in which two JSON values differ, each with both values; empty where they are the same.

    ``there`` is what a file holds, ``now`` what is wanted.
    """
    found = list(_different(there, now, ""))
    more = [f"and {len(found) - _SHOWN} more"] if len(found) > _SHOWN else []
    return "; ".join(
        [*(f"{entry} is {_brief(old)} in it, {_brief(new)} now" for entry, old, new in found[:_SHOWN])] + more
    )


def another(there: dict[str, JsonValue], now: dict[str, JsonValue]) -> str:
    """Words for a plan that a file holds and that is not the one wanted: "another" with its keys, and `differences`."""
    return f"another {', '.join(key for key in now if there.get(key) != now[key])} ({differences(there, now)})"


def _different(there: object, now: object, entry: str) -> Iterator[tuple[str, object, object]]:
    if isinstance(there, dict) and isinstance(now, dict):
        for key in dict.fromkeys((*now, *there)):
            yield from _different(there.get(key), now.get(key), f"{entry}.{key}" if entry else f"{key}")
    elif isinstance(there, list) and isinstance(now, list) and len(there) == len(now):
        for place, (old, new) in enumerate(zip(there, now, strict=True)):
            yield from _different(old, new, f"{entry}[{place}]")
    elif there != now:
        yield entry, there, now


def _brief(value: object) -> str:
    text = "not stated" if value is None else json.dumps(value, ensure_ascii=False)
    return text if len(text) <= _BRIEF else f"{text[:_BRIEF]}..."


def json_text(content: object, *, indent: int | None = None, ascii: bool = True) -> str:
    """Text of a JSON file, of a model with the fields that were set; ValueError for numbers that are not finite."""
    plain = content.model_dump(mode="json", exclude_unset=True) if isinstance(content, BaseModel) else content
    return json.dumps(plain, indent=indent, ensure_ascii=ascii, allow_nan=False) + "\n"
