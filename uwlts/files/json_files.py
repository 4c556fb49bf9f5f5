"""Files of JSON: an object identified by its "format" and "version" and sealed; and differences between two of them.

The seal is the SHA-256 of the content. A file whose seal is missing or does not fit is read with a warning, and the
result records that it was edited.
"""

import hashlib
import json
import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, TypeGuard, TypeVar

from pydantic import BaseModel, JsonValue, ValidationError

from uwlts.errors import CaptureError, Error, OutputError, describe_problems
from uwlts.files.reading import MOST_JSON_BYTES, add_article, find_not_finite, log_warnings, parse_json, read_text
from uwlts.files.writing import require_ending, write_file

_SHOWN = 3  # largest number of different entries that a message names
_BRIEF = 80  # largest number of characters of a value in a message

SEAL = "sha256"
EDITED = "edited"
"""Keys of a file's seal, and of the record that the file, or one that it comes from, was edited."""

AnyModel = TypeVar("AnyModel", bound=BaseModel)


def to_canonical_json(content: Mapping[str, Any]) -> bytes:
    """Return the content without its seal as canonical JSON bytes: sorted keys, no spaces, UTF-8."""
    bare = {key: value for key, value in content.items() if key != SEAL}
    text = json.dumps(bare, sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False)
    return text.encode("utf-8", "surrogatepass")


def compute_seal(content: Mapping[str, Any]) -> str:
    """Return the seal of a content: SHA-256 of its canonical bytes."""
    return hashlib.sha256(to_canonical_json(content)).hexdigest()


def add_seal(content: Mapping[str, Any]) -> dict[str, Any]:
    """Return the content as JSON, with its seal."""
    plain = json.loads(_dump(content))
    return plain | {SEAL: compute_seal(plain)}


def is_number(value: Any) -> TypeGuard[float]:
    """Return whether a value from JSON is a finite number."""
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def number_list(value: Any) -> list[float | None] | None:
    """Return a list from JSON if it contains only finite numbers and None, else None."""
    return value if isinstance(value, list) and all(each is None or is_number(each) for each in value) else None


def numbers_in(table: Any) -> dict[str, float]:
    """Return the finite numbers in a table from JSON by name; empty if the value is not a table."""
    return {name: value for name, value in table.items() if is_number(value)} if isinstance(table, dict) else {}


def read_json(path: str | Path, *, called: str, check_seal: bool = True) -> dict[str, JsonValue]:
    """Read the object in a file; raises CaptureError if it is missing, not JSON, or truncated.

    ``called`` names the expected content in messages. Numbers are finite and keys are unique (`uwlts.files.reading`).
    The object contains the seal, if there is one, and ``edited`` if it does not match, which a warning says.
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
    if check_seal and SEAL in content and content[SEAL] != compute_seal(content):
        log_warnings(path, [f"it was edited after it was written: its content does not match its seal ({SEAL})"])
        content[EDITED] = True
    return content


def read_model(
    path: str | Path, model: type[AnyModel], *, file_format: str, version: int, called: str, advice: str = ""
) -> AnyModel:
    """Read a JSON file of the program as a model.

    The keys "format" and "version" must have the given values. ``called`` names the expected content in messages;
    ``advice`` ends that about content that is not valid.

    Raises CaptureError if the file is missing, foreign, newer or damaged.
    """
    content = read_json(path, called=called)
    if content.pop("format", None) != file_format:
        raise CaptureError(f'{path} is JSON but not {add_article(called)}: expected "format": "{file_format}"')
    if (found := content.pop("version", None)) != version:
        raise CaptureError(f"{path} has version {found}; this program reads {version}")
    if SEAL not in content:
        log_warnings(path, [f"it has no seal ({SEAL}), and is treated as a file that was edited"])
    if content.pop(EDITED, False) or SEAL not in content:
        if EDITED in model.model_fields:
            content[EDITED] = True
        elif isinstance(provenance := content.get("provenance"), dict):
            content["provenance"] = provenance | {EDITED: True}
    content.pop(SEAL, None)
    try:
        return model.model_validate(content)
    except (ValidationError, Error, ArithmeticError) as error:
        problem = describe_problems(error) if isinstance(error, ValidationError) else error
        raise CaptureError(f"{path} is not a valid {called}: {problem}{advice}") from error


def write_model(path: str | Path, model: BaseModel, *, file_format: str, version: int, overwrite: bool) -> None:
    """Write a model as indented JSON with the keys "format" and "version" and a seal, completely or not at all.

    Raises OutputError if the file exists and ``overwrite`` is not set, or cannot be written.
    """
    content = {"format": file_format, "version": version} | model.model_dump(mode="json")
    write_record(path, content, overwrite=overwrite, indent=2)


def write_record(path: str | Path, record: object, *, overwrite: bool, indent: int = 1) -> None:
    """Write the record of a result as indented JSON, completely or not at all; raises OutputError if that fails."""
    require_ending(Path(path), (".json",))
    write_file(path, json_text(record, indent=indent), overwrite=overwrite)


def describe_differences(there: object, now: object) -> str:
    """Describe the different entries of two JSON values, with both values; empty if they are equal.

    ``there`` is the content of a file, ``now`` the wanted one.
    """
    found = [f"{entry} is {_shorten(old)} in it, {_shorten(new)} now" for entry, old, new in _compare(there, now, "")]
    more = [f"and {len(found) - _SHOWN} more"] if len(found) > _SHOWN else []
    return "; ".join(found[:_SHOWN] + more)


def _compare(there: object, now: object, entry: str) -> Iterator[tuple[str, object, object]]:
    if isinstance(there, dict) and isinstance(now, dict):
        for key in dict.fromkeys((*now, *there)):
            yield from _compare(there.get(key), now.get(key), f"{entry}.{key}" if entry else f"{key}")
    elif isinstance(there, list) and isinstance(now, list) and len(there) == len(now):
        for place, (old, new) in enumerate(zip(there, now, strict=True)):
            yield from _compare(old, new, f"{entry}[{place}]")
    elif there != now:
        yield entry, there, now


def _shorten(value: object) -> str:
    text = "not stated" if value is None else json.dumps(value, ensure_ascii=False)
    return text if len(text) <= _BRIEF else f"{text[:_BRIEF]}..."


def json_text(content: object, *, indent: int | None = None) -> str:
    """Return JSON text, for a model of its set fields only; raises OutputError for numbers that are not finite.

    Objects are sealed.
    """
    plain = content.model_dump(mode="json", exclude_unset=True) if isinstance(content, BaseModel) else content
    plain = add_seal(plain) if isinstance(plain, dict) else plain
    return _dump(plain, indent=indent) + "\n"


def _dump(content: object, **settings: Any) -> str:
    """Return JSON text; raises OutputError for numbers that are not finite, with the first one's place."""
    try:
        return json.dumps(content, allow_nan=False, **settings)
    except ValueError as error:
        raise OutputError(
            f"a result cannot be written: {find_not_finite(content) or error}; expected a finite number. Check the "
            "input for values that are extreme or missing"
        ) from error
