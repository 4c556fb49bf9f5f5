"""What a calibration's file tells of the captures it was made from, so that they can be found and proven the same."""

import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from uwlts.model.errors import CaptureError
from uwlts.storage.capture import Capture


def captures_in(provenance: Mapping[str, Any]) -> list[dict[str, Any]]:
    """The captures, as `source_of` tells of them, that a provenance names: of targets, steps and scans."""
    return [source for kind in ("air", "step", "scan") for source in provenance.get(f"{kind}_captures", [])]


def source_of(capture: Capture) -> dict[str, Any]:
    """Name, SHA-256 and number of images of a capture, what it was taken through, and of what."""
    header, laser = capture.header, int(np.count_nonzero(capture.laser_on))
    medium = header.medium
    told: dict[str, Any] = {
        "file": capture.path.name,
        "name": header.name,
        "sha256": sha256_of(capture.path),
        "lamp_images": len(capture) - laser,
        "laser_images": laser,
        "medium": header.medium_name,
        "window": header.sensor.camera.window.mounted,
    }
    if medium.kind in ("fresh", "sea"):
        told |= {"temperature_c": medium.temperature_c, "salinity_g_kg": medium.salinity_g_kg}
    return told | {key: thing for key in ("target", "artefact") if (thing := getattr(header, key)) is not None}


def sha256_of(path: str | Path) -> str:
    """Hash of a file in hexadecimal; CaptureError where it cannot be read."""
    try:
        with open(path, "rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise CaptureError(f"cannot read {path}: {error.strerror}") from error
