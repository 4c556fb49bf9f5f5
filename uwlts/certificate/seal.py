"""The seal of a certificate: a SHA-256 over its own content, and that of the calibration's file in it."""

import hashlib
import json
from pathlib import Path
from typing import Any

from uwlts.calibration.sources import sha256_of
from uwlts.errors import CaptureError
from uwlts.json_file import read_json

FORMAT = "uwlts-certificate"
VERSION = 1
_SEAL = "sha256"


def canonical(content: dict[str, Any]) -> bytes:
    """The content but its seal as bytes that depend on nothing else: sorted keys, no spaces, UTF-8."""
    bare = {key: value for key, value in content.items() if key != _SEAL}
    text = json.dumps(bare, sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False)
    return text.encode("utf-8")


def sealed(content: dict[str, Any]) -> dict[str, Any]:
    """The content with its seal."""
    return content | {_SEAL: hashlib.sha256(canonical(content)).hexdigest()}


def read_certificate(path: str | Path) -> dict[str, Any]:
    """Content of a certificate's JSON; CaptureError where the file is missing, foreign or newer."""
    content = read_json(path, called="certificate")
    if content.get("format") != FORMAT:
        raise CaptureError(f'{path} is JSON but not a certificate: expected "format": "{FORMAT}"')
    if content.get("version") != VERSION:
        raise CaptureError(f"{path} has version {content.get('version')}; this program reads {VERSION}")
    if not isinstance(content.get("calibration"), dict):
        raise CaptureError(f"{path} is damaged: it does not tell its calibration")
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
    if content.get(_SEAL) != sealed(content)[_SEAL]:
        against.append(f"{path} was changed after it was issued: its seal does not fit its content")
    told = content["calibration"].get("sha256")
    if found != told:
        against.append(
            f"{calibration} is not the calibration that {path} is about, or was changed since: its SHA-256 is {found}, "
            f"the certificate's {told}"
        )
    return against
