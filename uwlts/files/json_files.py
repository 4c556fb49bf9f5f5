"""Files of JSON: an object identified by its "format" and "version"; and differences between two of them."""

import json
from abc import ABC, abstractmethod
from collections.abc import Iterator
from pathlib import Path
from typing import TypeVar

from pydantic import BaseModel, JsonValue, ValidationError

from uwlts.errors import CaptureError, Error, describe_problems
from uwlts.files.reading import MOST_JSON_BYTES, add_article, parse_json, read_text
from uwlts.files.writing import write_atomically

_SHOWN = 3
"""Largest number of different entries that a message names."""
_BRIEF = 80
"""Largest number of characters of a value in a message."""

AnyModel = TypeVar("AnyModel", bound=BaseModel)


def read_json(path: str | Path, *, called: str) -> dict[str, JsonValue]:
    """Read the object in a file; raises CaptureError if it is missing, not JSON or truncated.

    ``called`` names the expected content in messages. Numbers are finite and keys are unique (`uwlts.files.reading`).
    """
    text = read_text(path, most_bytes=MOST_JSON_BYTES, called=called)
    try:
        content = parse_json(text)
    except json.JSONDecodeError as error:
        raise CaptureError(f"{path} is not {add_article(called)}, or is truncated: {error}") from error
    except ValueError as error:
        raise CaptureError(f"{path} is not a valid {called}: {error}") from error
    if not isinstance(content, dict):
        raise CaptureError(f"{path} is JSON but not {add_article(called)}: expected an object with named entries")
    return content


def read_model(
    path: str | Path, model: type[AnyModel], *, file_format: str, version: int, called: str, advice: str = ""
) -> AnyModel:
    """Read a JSON file of the program as a model.

    Parameters
    ----------
    path
        File to read.
    model
        Type of the content.
    file_format, version
        Expected values of the keys "format" and "version".
    called
        Name of the expected content in messages.
    advice
        End of the message about content that is not valid.

    Raises
    ------
    CaptureError
        The file is missing, foreign, newer or damaged.
    """
    content = read_json(path, called=called)
    return model_from_json(content, path, model, file_format=file_format, version=version, called=called, advice=advice)


def model_from_json(
    content: dict[str, JsonValue],
    path: str | Path,
    model: type[AnyModel],
    *,
    file_format: str,
    version: int,
    called: str,
    advice: str = "",
) -> AnyModel:
    """Convert the result of `read_json` to a model; raises CaptureError like `read_model`."""
    content = dict(content)
    if content.pop("format", None) != file_format:
        raise CaptureError(f'{path} is JSON but not {add_article(called)}: expected "format": "{file_format}"')
    if (found := content.pop("version", None)) != version:
        raise CaptureError(f"{path} has version {found}; this program reads {version}")
    return validate_content(model, content, f"{path} is not a valid {called}", advice=advice)


def validate_content(model: type[AnyModel], content: object, complaint: str, *, advice: str = "") -> AnyModel:
    """Convert content to a model; raises CaptureError, which begins with ``complaint``, if it is not valid."""
    try:
        return model.model_validate(content)
    except ValidationError as error:
        raise CaptureError(f"{complaint}: {describe_problems(error)}{advice}") from error
    except (Error, ArithmeticError) as error:
        raise CaptureError(f"{complaint}: {error}{advice}") from error


def write_model(path: str | Path, model: BaseModel, *, file_format: str, version: int, overwrite: bool) -> None:
    """Write a model as indented JSON, completely or not at all.

    Parameters
    ----------
    path
        File to write.
    model
        Content.
    file_format, version
        Values of the keys "format" and "version".
    overwrite
        Replace an existing file.

    Raises
    ------
    OutputError
        The file exists and ``overwrite`` is not set, or cannot be written.
    """
    content = {"format": file_format, "version": version} | model.model_dump(mode="json")
    with write_atomically(path, overwrite=overwrite) as aside:
        aside.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")


def write_record(path: str | Path, record: object, *, overwrite: bool) -> None:
    """Write the record of a result as indented JSON, completely or not at all; raises OutputError if that fails."""
    with write_atomically(path, overwrite=overwrite) as aside:
        aside.write_text(json_text(record, indent=1), encoding="utf-8")


class RecordFile(ABC):
    """Result whose record is written as JSON."""

    @abstractmethod
    def record(self) -> object:
        """Return the result as JSON."""

    def save(self, path: str | Path, *, overwrite: bool = False) -> None:
        """Write the record as indented JSON, completely or not at all; raises OutputError if that fails."""
        write_record(path, self.record(), overwrite=overwrite)


def describe_differences(there: object, now: object) -> str:
    """Describe the different entries of two JSON values, with both values; empty if they are equal.

    ``there`` is the content of a file, ``now`` the wanted one.
    """
    found = list(_different(there, now, ""))
    more = [f"and {len(found) - _SHOWN} more"] if len(found) > _SHOWN else []
    return "; ".join(
        [*(f"{entry} is {_brief(old)} in it, {_brief(new)} now" for entry, old, new in found[:_SHOWN])] + more
    )


def describe_other_plan(there: dict[str, JsonValue], now: dict[str, JsonValue]) -> str:
    """Describe how a file's plan differs from the wanted one: the different keys, and `describe_differences`."""
    return f"another {', '.join(key for key in now if there.get(key) != now[key])} ({describe_differences(there, now)})"


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


def json_text(content: object, *, indent: int | None = None, only_ascii: bool = True) -> str:
    """Return JSON text, for a model of its set fields only; raises ValueError for numbers that are not finite."""
    plain = content.model_dump(mode="json", exclude_unset=True) if isinstance(content, BaseModel) else content
    return json.dumps(plain, indent=indent, ensure_ascii=only_ascii, allow_nan=False) + "\n"
