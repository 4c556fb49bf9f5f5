"""The seal of a certificate: a SHA-256 over its own content, and that of the calibration's file in it."""

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path

from pydantic import JsonValue

from uwlts.calibration.sources import sha256_of
from uwlts.errors import CaptureError
from uwlts.files import read_json

FORMAT = "uwlts-certificate"
VERSION = 1
_SEAL = "sha256"


def canonical(content: Mapping[str, JsonValue]) -> bytes:
    """The content but its seal as bytes that depend on nothing else: sorted keys, no spaces, UTF-8."""
    bare = {key: value for key, value in content.items() if key != _SEAL}
    text = json.dumps(bare, sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False)
    return text.encode("utf-8")


def seal_of(content: Mapping[str, JsonValue]) -> str:
    """The seal of a content: SHA-256 of its canonical bytes."""
    return hashlib.sha256(canonical(content)).hexdigest()


def read_certificate(path: str | Path) -> dict[str, JsonValue]:
    """A certificate's JSON as it stands in the file, all of it sealed; CaptureError if it is missing or foreign."""
    content = read_json(path, called="certificate")
    if content.get("format") != FORMAT:
        raise CaptureError(f'{path} is JSON but not a certificate: expected "format": "{FORMAT}"')
    if content.get("version") != VERSION:
        raise CaptureError(f"{path} has version {content.get('version')}; this program reads {VERSION}")
    return content


def check_certificate(path: str | Path, calibration: str | Path) -> list[str]:
    """What speaks against a certificate and against its belonging to a calibration's file; nothing where all is well.

    Raises
    ------
    CaptureError
        A file cannot be read, or is no certificate.
    """
    content, found = read_certificate(path), sha256_of(calibration)
    against = []
    if content.get(_SEAL) != seal_of(content):
        against.append(f"{path} was changed after it was issued: its seal does not fit its content")
    certified = content.get("calibration")
    if not isinstance(certified, dict):
        raise CaptureError(f"{path} is damaged: it does not name its calibration")
    if found != (told := certified.get("sha256")):
        against.append(
            f"{calibration} is not the calibration that {path} is about, or was changed since: its SHA-256 is {found}, "
            f"the certificate's {told}"
        )
    return against
