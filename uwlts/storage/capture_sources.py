"""Identity of the captures that a calibration was made from, as its file holds it: names, hashes, numbers of images."""

import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from uwlts.model.errors import CaptureError
from uwlts.storage.capture import Capture


def captures_in(provenance: Mapping[str, Any]) -> list[dict[str, Any]]:
    """The captures, as from `source_of`, that a provenance names: of targets, steps and scans."""
    return [source for kind in ("air", "step", "scan") for source in provenance.get(f"{kind}_captures", [])]


def source_of(capture: Capture) -> dict[str, Any]:
    """Name, SHA-256 and number of images of a capture, what it was taken through, and of what."""
    header, laser = capture.header, int(np.count_nonzero(capture.laser_on))
    medium = header.medium
    source: dict[str, Any] = {
        "file": capture.path.name,
        "name": header.name,
        "sha256": sha256_of(capture.path),
        "lamp_images": len(capture) - laser,
        "laser_images": laser,
        "medium": header.medium_name,
        "window": header.sensor.camera.window.mounted,
    }
    if medium.kind in ("fresh", "sea"):
        source |= {"temperature_c": medium.temperature_c, "salinity_g_kg": medium.salinity_g_kg}
    return source | {key: thing for key in ("target", "artefact") if (thing := getattr(header, key)) is not None}


def sha256_of(path: str | Path) -> str:
    """Hash of a file in hexadecimal; CaptureError where it cannot be read."""
    try:
        with open(path, "rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise CaptureError(f"cannot read {path}: {error.strerror}") from error
