"""The ground-truth file that lies beside a rendered capture; nothing but the comparison with truth reads it."""

from dataclasses import dataclass, fields
from enum import IntEnum
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from uwlts.errors import CaptureError
from uwlts.files import written_aside
from uwlts.sensor import Description, Medium, Sensor

FORMAT = "uwlts-truth"
VERSION = 1


class TruthStatus(IntEnum):
    """Whether a profile line truly shows the stripe."""

    VISIBLE = 0
    NO_STRIPE = 1


class TruthHeader(Description):
    """All true parameters: the sensor as rendered, its medium, and the scene's description."""

    sensor: Sensor
    medium: Medium
    scene: dict[str, Any]


@dataclass(frozen=True)
class Truth:
    """What every profile line of every frame truly shows; F frames, L lines.

    ``centre_px (F, L)`` is the image coordinate across the stripe where the line's centre sees the middle of the
    sheet; ``point_mm (F, L, 3)`` and ``normal (F, L, 3)`` are the surface there in scene coordinates; ``status (F, L)``
    is a `TruthStatus`; ``crossings (F, L)`` counts lit crossings of the sheet, of which the brightest is given.
    ``depth_mm (H, W)`` is the camera-frame z of what every pixel sees in the first frame. NaN where nothing is.
    """

    centre_px: np.ndarray
    point_mm: np.ndarray
    normal: np.ndarray
    status: np.ndarray
    crossings: np.ndarray
    depth_mm: np.ndarray


def truth_path(capture: str | Path) -> Path:
    """Where the truth of a capture lies."""
    path = Path(capture)
    return path.with_name(path.name.removesuffix(".h5") + ".truth.h5")


def write_truth(path: str | Path, header: TruthHeader, truth: Truth, *, overwrite: bool = False) -> None:
    """Write a truth file whole or not at all; OutputError where that fails."""
    with written_aside(path, overwrite=overwrite) as aside, h5py.File(aside, "w") as file:
        file.attrs.update(format=FORMAT, version=VERSION, header=header.model_dump_json())
        for field in fields(truth):
            file.create_dataset(field.name, data=getattr(truth, field.name), compression="gzip", compression_opts=1)


def read_truth(path: str | Path) -> tuple[TruthHeader, Truth]:
    """Read a truth file; CaptureError where it is missing, foreign, newer or damaged."""
    if not Path(path).is_file():
        raise CaptureError(f"no truth file at {path}")
    try:
        with h5py.File(path, "r") as file:
            if file.attrs.get("format") != FORMAT or file.attrs["version"] > VERSION:
                raise CaptureError(f"{path} is not a truth file this program reads: {dict(file.attrs).get('format')!r}")
            header = TruthHeader.model_validate_json(file.attrs["header"])
            return header, Truth(**{field.name: file[field.name][:] for field in fields(Truth)})
    except (OSError, KeyError, ValueError) as error:
        raise CaptureError(f"{path} is not a truth file, or is damaged: {error}") from error
