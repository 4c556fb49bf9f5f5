"""The project's files of JSON: one object, whose "format" and "version" say what it is."""

import json
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from uwlts.errors import CaptureError
from uwlts.sensor import Description

AnyDescription = TypeVar("AnyDescription", bound=Description)

_MOST_PROBLEMS = 5
"""A damaged table would be told of number by number."""


def read_json(path: str | Path, *, called: str) -> dict[str, Any]:
    """Object in a file; CaptureError where it is missing, no JSON or truncated. ``called`` is what it should be."""
    a_thing = f"{'an' if called[0] in 'aeiou' else 'a'} {called}"
    try:
        content = json.loads(Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        raise CaptureError(f"cannot read the {called} {path}: {error.strerror}") from error
    except (ValueError, RecursionError) as error:
        raise CaptureError(f"{path} is not {a_thing}, or is truncated: {error}") from error
    if not isinstance(content, dict):
        raise CaptureError(f'{path} is JSON but not {a_thing}: expected an object with a "format"')
    return content


def described(
    content: dict[str, Any], model: type[AnyDescription], *, path: str | Path, format: str, version: int,
    called: str, foreign: str,
) -> AnyDescription:  # fmt: skip
    """The description in a file's object; CaptureError where it is foreign (in these words), newer or damaged."""
    if content.pop("format", None) != format:
        raise CaptureError(f'{path} is JSON but {foreign}: expected "format": "{format}"')
    if (found := content.pop("version", None)) != version:
        raise CaptureError(f"{path} has version {found}; this program reads {version}")
    try:
        return model.model_validate(content)
    except ValidationError as error:
        problems = error.errors()[:_MOST_PROBLEMS]
        details = "; ".join(f"{'.'.join(map(str, p['loc']))}: {p['msg']}" for p in problems)
        raise CaptureError(f"{path} is not a valid {called}: {details}") from error


def json_text(content: BaseModel | dict[str, Any] | list[Any], *, indent: int | None = None, ascii: bool = True) -> str:
    """Text of a JSON file, of a model with the fields that were set; ValueError for numbers that are not finite."""
    plain = content.model_dump(mode="json", exclude_unset=True) if isinstance(content, BaseModel) else content
    return json.dumps(plain, indent=indent, ensure_ascii=ascii, allow_nan=False) + "\n"
